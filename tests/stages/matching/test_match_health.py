"""Too few matches on the nearest ground are a warning at the end of a run; few elsewhere are not."""

import numpy as np
import pytest

from flow.contracts import Severity
from recordings.simulator import Simulation
from stages import CheckMatches, Disparity, PixelOrigin, StereoFrame
from tests.bench.refining import stereo_part
from tests.conftest import slow
from tests.stages.builders import disparity_of
from tests.stages.running import Running


def test_the_warning_asks_for_the_lowest_rows_and_for_most_frames():
    matched = np.full((2, 80, 100), PixelOrigin.MEASURED)
    matched[0, :60] = matched[1, 68:] = PixelOrigin.FILLED
    sky, ground = (disparity_of(np.ones(part.shape), part) for part in matched)
    check = Running(CheckMatches())
    assert check(sky).near == check(sky).near == 1
    health = check(ground)
    assert (health.all, health.near) == (0.85, 0)
    assert check.finding() is None
    matched[1, :, :50] = PixelOrigin.OUT_OF_VIEW
    assert Running(CheckMatches())(disparity_of(np.ones((80, 100)), matched[1])).all == 0.425
    check(ground)
    check(ground)
    found = check.finding()
    assert found.severity == Severity.WARNING
    assert "Only 0 % of the nearest ground is matched" in found.sentence


@pytest.mark.parametrize(("confidence", "near"), [(0.36, 1), (0.34, 0), (np.nan, 1)])
def test_doubtful_matches_of_the_nearest_ground_do_not_count(confidence, near):
    assert Running(CheckMatches())(disparity_of(np.ones((80, 100)), confidence=np.float64(confidence))).near == near


@pytest.fixture(scope="module")
def frame():
    """A simulated frame of ground up to 46 px near."""
    simulation = Simulation(frames=1, width=320, height=240, relief_cells=512, seed=1, abundance=0.1)
    return StereoFrame(1, *simulation.frame(0).images, simulation.camera)


def test_images_that_are_upside_down_are_a_warning():
    simulation = Simulation(frames=1, width=320, height=240, relief_cells=512, seed=2, abundance=0.1)
    left, right = (image[::-1, ::-1].copy() for image in simulation.frame(0).images[::-1])
    check = Running(CheckMatches())
    check(stereo_part("rover", StereoFrame(1, left, right, simulation.camera), 48, entry="rectified")["disparity"])
    assert "upside down" in check.finding().sentence


def warned_of_range(disparity: Disparity) -> bool:
    check = Running(CheckMatches())
    check(disparity)
    found = check.finding()
    assert found is None or "increase `disparities`" in found.sentence
    return found is not None


@pytest.mark.parametrize(("disparities", "warned"), [(64, False), (32, True), (16, True)])
def test_matches_beyond_the_search_range_of_opencv_do_not_count(frame, disparities, warned):
    assert warned_of_range(stereo_part("paper", frame, disparities, entry="rectified")["matched"]) == warned


@pytest.mark.parametrize(("disparities", "warned"), [(48, False), (16, False), (8, True)])
@pytest.mark.parametrize("pipeline", ["rover", "fast", *slow("accurate")])
def test_only_a_search_range_that_ends_short_of_the_ground_is_a_warning(frame, pipeline, disparities, warned):
    assert warned_of_range(stereo_part(pipeline, frame, disparities, entry="rectified")["disparity"]) == warned
