"""The pipelines on scenes with truth: better than matching, the paper and its code, and as sure as they are right."""

import numpy as np
import pytest

from recordings.scoring.stereo_metrics import SEEN_BY_BOTH, SURFACES
from recordings.simulator import Simulation
from stages.data import PixelOrigin, StereoFrame
from stages.matching.match import Match
from tests.bench import weak_texture
from tests.bench.refining import RELEASED, stereo_part
from tests.bench.stereo_scores import errors, rows_filled
from tests.conftest import data_folder
from tests.study import real, simulated


def outcomes(frame, disparities):
    """Pixels of matching alone, rows filled, of `paper`, of `fast`, of `rover` and of `accurate`."""
    matched = rows_filled(Match(disparities=disparities)(frame).pixels)
    names = ("paper", "fast", "rover", "accurate")
    found = (stereo_part(name, frame, disparities, entry="rectified")["disparity"] for name in names)
    return [matched, *(disparity.pixels for disparity in found)]


def test_on_a_simulated_frame_rover_beats_paper_and_matching_alone():
    (case,) = simulated(480, 360, seeds=[2])
    scores = [errors(pixels, case.truth, case.mask, case.disparities) for pixels in outcomes(case.frame, 72)]
    matched, paper, fast, rover, accurate = scores
    assert (rover[:6] < 0.97 * matched[:6]).all()
    assert (rover[:6] < 0.9 * paper[:6]).all()
    assert (fast[:6] < 0.9 * paper[:6]).all()
    assert rover[6] < min(matched[6], paper[6])
    assert (accurate[:6] < 1.1 * rover[:6]).all()
    assert rover[7] > 99


@pytest.mark.slow
def test_support_removes_errors_on_sand_and_dust_and_adds_none_elsewhere():
    found = weak_texture.scores({"width": 640, "height": 480}, 1)
    bad = {key: errors.metrics()["bad_0.5"] for key, errors in found.items()}
    shares = {"sand": (0.75, 0.35), "dust": (0.65, 0.45), "gravel": (1, 0.5), "rock": (1, 0.6)}
    for surface, (of_plain, of_opencv) in shares.items():
        assert bad["rover", surface] < of_plain * bad["without support", surface]
        assert bad["rover", surface] < of_opencv * bad["OpenCV HH", surface]


@pytest.mark.slow
def test_rover_beats_paper_matching_and_the_released_code_on_real_scenes():
    cases = list(real(data_folder("middlebury-q")))
    scores = [[errors(p, c.truth, c.mask, c.disparities) for p in outcomes(c.frame, c.disparities)] for c in cases]
    released = np.array([RELEASED[case.name] for case in cases])
    matched, paper, fast, rover, accurate = np.mean(scores, axis=0)
    for found, limits in (
        (accurate, [0.574, 0.509, 0.435, 0.60, 0.53, 0.46, 0.578]),
        (rover, [0.60, 0.54, 0.45, 0.64, 0.59, 0.52, 0.66]),
    ):
        assert (found[:7] < matched[:7]).all()
        assert (found[:7] < paper[:7]).all()
        assert (found[:7] <= limits * released.mean(axis=0)).all()
    assert (fast[:3] <= [0.70, 0.63, 0.55] * released.mean(axis=0)[:3]).all()
    assert (np.array(scores)[:, 4, :7] < released).all()  # no scene worse in any column
    assert rover[7] > 99


@pytest.fixture(scope="module")
def near_ground():
    """A simulation, and its frame of ground up to 46 px near."""
    simulation = Simulation(scene="gravel", frames=1, width=320, height=240, seed=1, abundance=0.1)
    return simulation, simulation.frame(0)


@pytest.mark.parametrize(("pipeline", "off"), [("accurate", 0.02), ("rover", 0.2), ("fast", 0.4)])
def test_ground_nearly_four_times_as_near_as_the_range_is_known(near_ground, pipeline, off):
    simulation, found = near_ground
    camera = simulation.camera
    truth = camera.fx * camera.baseline / found.depth
    frame = StereoFrame(1, *found.images, camera)
    streams = stereo_part(pipeline, frame, 13, entry="rectified")
    refined = streams["disparity"]
    near = (truth > 20) & (found.seen == 255)
    assert near.mean() > 0.3
    assert (truth[near] > 3 * 13).mean() > 0.1
    if pipeline == "accurate":  # the right view reaches as near
        assert np.isfinite(streams["disparity/right"].pixels).mean() > 0.75
    measured = near & (refined.source == PixelOrigin.MEASURED)
    assert measured.sum() > 0.95 * near.sum()
    error = np.abs(refined.pixels - truth)[measured]
    assert (error > 2).mean() < 0.03
    assert (error > 0.5).mean() < off  # `rover` finds it at half the size, and `fast` at a quarter


def stated_and_right(scenes):
    """The confidence of each known pixel of (frame, disparities, truth) by `rover`, and whether it is right."""
    stated, right = [], []
    for frame, disparities, truth in scenes:
        refined = stereo_part("rover", frame, disparities, entry="rectified")["disparity"]
        error = np.abs(refined.pixels - truth)
        stated.append(refined.confidence[np.isfinite(error)])
        right.append(error[np.isfinite(error)] <= 1)
    return np.concatenate(stated), np.concatenate(right)


@pytest.mark.slow
def test_confidence_is_the_share_that_is_right_on_a_held_out_frame():
    scenes = []
    for seed, abundance in ((21, 0.08), (22, 0.18)):
        simulation = Simulation(scene="gravel", frames=2, width=480, height=360, seed=seed, abundance=abundance)
        camera, found = simulation.camera, simulation.frame(1)
        truth = camera.fx * camera.baseline / found.depth
        searched = np.where((truth > 0) & (truth < 70), truth, np.nan)
        scenes.append((StereoFrame(seed, *found.images, camera), 72, searched))
    claimed, right = stated_and_right(scenes)
    for low, high, tolerance in ((0.5, 0.8, 0.2), (0.8, 0.95, 0.1), (0.95, 1.01, 0.02)):
        within = (claimed >= low) & (claimed < high)
        assert within.sum() > 1000
        assert right[within].mean() == pytest.approx(claimed[within].mean(), abs=tolerance)
    assert right.mean() == pytest.approx(claimed.mean(), abs=0.03)


@pytest.mark.slow
def test_confidence_is_the_share_right_of_real_and_of_simulated_pixels():
    pools = [
        stated_and_right((case.frame, case.disparities, case.truth) for case in cases)
        for cases in (simulated(), real(data_folder("middlebury-q")))
    ]
    for low, high in ((0.5, 0.7), (0.7, 0.85), (0.85, 0.95), (0.95, 1.01)):
        within = [(stated >= low) & (stated < high) for stated, _ in pools]
        claimed = [stated[area].mean() for (stated, _), area in zip(pools, within, strict=True)]
        found = [right[area].mean() for (_, right), area in zip(pools, within, strict=True)]
        assert np.mean(found) == pytest.approx(np.mean(claimed), abs=0.1)
        assert found == pytest.approx(claimed, abs=0.25)


@pytest.mark.slow
def test_sigmas_contain_68_and_95_percent_on_sand_gravel_and_rock():
    ratios: dict[str, list[np.ndarray]] = {"sand": [], "gravel": [], "rock": []}
    for frame, disparities, truth, made in weak_texture.cases({}, 2):
        found = stereo_part("rover", frame, disparities)["disparity"]
        scored = (found.source == PixelOrigin.MEASURED) & (made.seen == SEEN_BY_BOTH) & np.isfinite(truth)
        for surface in ratios:
            within = scored & (made.terrain_class == SURFACES[surface])
            ratios[surface].append((np.abs(found.pixels - truth) / found.sigma)[within])
    for parts in ratios.values():
        ratio = np.concatenate(parts)
        assert (ratio <= 1).mean() == pytest.approx(0.68, abs=0.08)
        assert (ratio <= 2).mean() == pytest.approx(0.95, abs=0.04)
