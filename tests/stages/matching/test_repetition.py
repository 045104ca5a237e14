"""Ground that repeats itself may be matched a period off: a run warns of it, and not of other ground."""

from dataclasses import replace

import numpy as np
import pytest

from flow.contracts import Severity, StageError
from recordings.simulator import Simulation
from stages import CheckMatches, MatchHealth, StereoFrame
from tests.bench.refining import graph_of, stereo_part
from tests.conftest import slow
from tests.stages.builders import disparity_of
from tests.stages.matching.ground_patterns import pattern_pair, stripes
from tests.stages.running import Running

PIPELINES = "rover", "fast", "accurate", "paper"


def checked(pipeline, frame):
    """The disparities of one frame, and the stage that has checked them."""
    disparity = stereo_part(pipeline, frame, 80, 2, "rectified")["matched" if pipeline == "paper" else "disparity"]
    check = Running(CheckMatches())
    check(disparity, frame)
    return disparity, check


def wrong_share(disparity, truth):
    """Share of the known disparities that are off by a tenth, and so are distances."""
    known = np.isfinite(disparity.pixels)
    return float(np.mean(np.abs(disparity.pixels / truth - 1)[known] > 0.1))


@pytest.mark.parametrize(("pipeline", "period", "contrast"), [
    ("rover", 0.16, 4), ("rover", 0.16, 25), ("fast", 0.16, 25), ("paper", 0.12, 25), *slow(("accurate", 0.16, 25)),
])  # fmt: skip
def test_stripes_along_the_view_are_matched_a_period_off_with_a_warning(pipeline, period, contrast):
    frame, truth = pattern_pair(stripes(period), contrast)
    disparity, check = checked(pipeline, frame)
    assert wrong_share(disparity, truth) > 0.5
    found = check.finding()
    assert found.severity == Severity.WARNING
    assert "In 1 of 1 frames, first 0.0 s after the first one, the ground repeats itself" in found.sentence
    assert check.state[0].repeated > 0.7


def test_stripes_that_mislead_only_some_matches_are_a_warning():
    frame, truth = pattern_pair(stripes(0.12), 10, grains=2)
    disparity, check = checked("rover", frame)
    assert 0.05 < wrong_share(disparity, truth) < 0.5
    assert "repeats itself" in check.finding().sentence


@pytest.mark.parametrize(("contrast", "grains"), [(0, 3), (0, 10), (20, 6)])
def test_grains_and_stripes_across_the_view_are_no_warning(contrast, grains):
    frame, truth = pattern_pair(lambda x, y: np.sin(2 * np.pi * y / 0.3) + 0 * x, contrast, grains=grains)
    disparity, check = checked("rover", frame)
    assert wrong_share(disparity, truth) < 0.05
    assert check.state[0].repeated < 0.15
    assert check.finding() is None


@pytest.mark.parametrize("scene", [
    {"scene": "gravel"}, {"scene": "dunes", "sand": 1.0, "dust": 0.0, "sand_contrast": 1.0, "ripples": 0.0},
    *slow({"scene": "mixed"}, {"scene": "dusk"}, {"scene": "bedrock"}, {"scene": "dunes", "jpeg": 60}),
])  # fmt: skip
def test_ground_of_the_simulator_does_not_repeat_itself(scene):
    simulation = Simulation(frames=1, width=320, height=240, relief_cells=512, seed=1, **scene)
    _, check = checked("rover", StereoFrame(1, *simulation.frame(0).images, simulation.camera))
    assert check.state[0].repeated < 0.2


def test_the_warning_asks_for_frames_in_a_row():
    def sentence(shares):
        run = [MatchHealth(10**9 * index, 0.9, 0.9, share) for index, share in enumerate(shares)]
        found = CheckMatches().finding(run)
        return found and found.sentence

    assert sentence([0.9]) is not None
    assert sentence([np.nan, np.nan]) is None
    assert sentence([0.1, 0.1, 0.8, 0.1, 0.1, 0.1]) is None
    seen = sentence([0.1, 0.1, np.nan, 0.6, 0.8, 0.5, 0.1, 0.1])
    assert "In 3 of 8 frames, first 3.0 s after the first one, " in seen
    assert "up to 80 % of the sampled matches" in seen


def test_few_and_ambiguous_matches_are_one_warning_of_two_sentences():
    found = CheckMatches().finding([MatchHealth(0, 0.4, 0.4, 0.9)])
    assert found.sentence.startswith("Only 40 % of the nearest ground is matched")
    assert "repeats itself" in found.sentence


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_all_pipelines_give_the_check_the_rectified_frame(pipeline):
    (check,) = (node for node in graph_of(pipeline).nodes if isinstance(node.actor, CheckMatches))
    assert check.inputs["frame"] == "rectified"


def test_repetition_is_not_tested_without_images_or_in_tiny_ones():
    frame, truth = pattern_pair(stripes(0.12), 10)
    assert np.isnan(Running(CheckMatches())(disparity_of(truth, stamp=1)).repeated)
    tiny, image = disparity_of(np.ones((8, 24)), stamp=1), np.zeros((8, 24), np.uint8)
    small = StereoFrame(1, image, image, replace(frame.camera, width=24, height=8))
    assert np.isnan(Running(CheckMatches())(tiny, small).repeated)
    with pytest.raises(StageError, match="join data"):
        Running(CheckMatches())(disparity_of(truth, stamp=2), frame)
    with pytest.raises(StageError, match="join the disparity with the rectified frame"):
        Running(CheckMatches())(tiny, frame)
