"""Too few matches on the nearest ground are a warning at the end of a run; few elsewhere are not."""

import numpy as np
import pytest

from flow.contracts import Severity
from recordings.simulator import Simulation
from stages import CheckMatches, Disparity, PixelOrigin, StereoFrame
from tests.bench.refining import stereo_part
from tests.conftest import slow
from tests.stages.running import Running


def disparity_with(matched: np.ndarray) -> Disparity:
    source = np.where(matched, np.uint8(PixelOrigin.MEASURED), np.uint8(PixelOrigin.FILLED))
    return Disparity(0, np.ones(matched.shape, np.float32), source, np.ones(matched.shape, np.float32))


def test_the_warning_asks_for_the_lowest_rows_and_for_most_frames():
    sky, ground = np.ones((80, 100), bool), np.ones((80, 100), bool)
    sky[:60] = False
    ground[68:] = False
    check = Running(CheckMatches())
    assert check(disparity_with(sky)).near == check(disparity_with(sky)).near == 1
    health = check(disparity_with(ground))
    assert (health.all, health.near) == (0.85, 0)
    assert check.finding() is None
    check(disparity_with(ground))
    check(disparity_with(ground))
    found = check.finding()
    assert found.severity == Severity.WARNING
    assert "Only 0 % of the nearest ground is matched" in found.sentence


@pytest.fixture(scope="module")
def frame():
    """A simulated frame of ground up to 46 px near."""
    simulation = Simulation(frames=1, width=320, height=240, relief_cells=512, seed=1, abundance=0.1)
    return StereoFrame(1, *simulation.frame(0).images, simulation.camera)


@pytest.mark.parametrize("pipeline", ["rover", "fast", *slow("accurate")])
def test_only_a_search_range_that_ends_short_of_the_ground_is_a_warning(frame, pipeline):
    for disparities, words in ((48, None), (16, None), (8, "increase `disparities`")):
        check = Running(CheckMatches())
        check(stereo_part(pipeline, frame, disparities, entry="rectified")["disparity"])
        found = check.finding()
        assert (found is None) == (words is None)
        assert words is None or words in found.sentence
