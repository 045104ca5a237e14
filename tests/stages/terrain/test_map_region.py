"""Few maps of a region are made, and laid over each other they are the whole region."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages import ElevationMap, Fuse, FuseRegion, MapRegion, Region, TerrainFeatures, Transform
from stages.data import Tiles
from stages.terrain.fused_map import CELL
from tests.stages.running import Running
from tests.stages.terrain.region_scene import MOUNT, drive, rolling

ROOM = 1e-9


def region(stamp: int, x: float, turn: float = 0.0, frame: str = "odom", epoch: int = 0) -> Region:
    level = Transform(frame, "level", Rotation.from_euler("z", turn).as_matrix(), [x, 0.0, 0.0])
    col = int(x / 0.5)
    return Region(stamp, Tiles(CELL), 0.5, level, epoch, (0, col, 1, col + 1), False)


def mapped(regions: list[Region], step: float, window: float = 2.0) -> list[ElevationMap]:
    """The maps of a run."""
    stage = MapRegion(step=step, window=window)
    state = stage.start()
    found = [stage(region, state=state) for region in regions]
    return [item for item in [*found, None if found[-1] else stage.flush(state)] if item is not None]


def stamps(regions: list[Region], step: float) -> list[int]:
    return [item.stamp for item in mapped(regions, step)]


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=30), st.floats(0.1, 5))
def test_every_region_left_out_is_within_a_step_of_the_map_before(ways, step):
    places = np.cumsum(ways)
    found = stamps([region(number, x) for number, x in enumerate(places)], step)
    assert found == sorted(set(found)), "each at most once, in the order of stamps"
    assert (found[0], found[-1]) == (0, len(places) - 1), "the first and the last are there"
    for before, after in pairwise(found):
        assert np.all(np.abs(places[before + 1 : after] - places[before]) < step + ROOM)
        assert after == len(places) - 1 or abs(places[after] - places[before]) >= step - ROOM, "and none is in vain"


@pytest.mark.parametrize(("step", "expected"), [(0.0, [0, 1, 2, 3, 4]), (0.5, [0, 2, 4]), (1.5, [0, 4])])
def test_there_is_a_map_for_each_step(step, expected):
    assert stamps([region(number, 0.25 * number) for number in range(5)], step) == expected


def test_a_rover_that_turns_on_the_spot_takes_steps_too():
    assert stamps([region(number, 0.0, turn=0.1 * number) for number in range(8)], 1.0) == [0, 3, 6, 7]
    assert stamps([region(number, 0.0) for number in range(6)], 1.0) == [0, 5]


@pytest.mark.parametrize("change", [{"frame": "odom/2"}, {"epoch": 9}])
def test_the_last_map_before_a_new_start_comes_first(change):
    regions = [region(number, 0.01 * number, **(change if number > 2 else {})) for number in range(6)]
    assert stamps(regions, 1.0) == [0, 2, 4, 5]
    assert [item.epoch for item in mapped(regions, 1.0)] == [0, 0, *[change.get("epoch", 0)] * 2]


@pytest.mark.parametrize(("jump", "expected"), [(19.0, [0, 2, 3]), (21.0, [0, 1, 3]), (40.0, [0, 1, 3])])
def test_a_map_precedes_a_jump_of_20_metres_that_no_map_spans(jump, expected):
    regions = [region(number, x) for number, x in enumerate((0.0, 0.3, 0.3 + jump, 0.4 + jump))]
    assert stamps(regions, 1.0) == expected
    assert max(item.shape[1] for item in mapped(regions, 1.0)) * 0.5 < 20 + 5


def test_the_features_of_what_a_frame_changes_do_not_depend_on_the_window():
    fuse, maps = Running(FuseRegion()), [Running(MapRegion(window=width)) for width in (1.0, 40.0)]
    for frame in (0, 4):
        fused = fuse(*drive(frame, ground=lambda x, y: 0.2 * rolling(x, y)), MOUNT)
        row, col, end_row, end_col = fused.changed
        small, large = (TerrainFeatures()(each(fused)) for each in maps)
        assert small.layers["elevation"].size < 0.4 * large.layers["elevation"].size
        for name in ("ground", "step", "slope", "steepness", "roughness"):
            parts = []
            for each in (small, large):
                left, low = (round(place / 0.05) for place in each.origin)
                parts.append(each.layers[name][row - low : end_row - low, col - left : end_col - left])
            np.testing.assert_allclose(*parts, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(("step", "ways"), [(0.0, [1.5] * 5), (1.0, [0.4] * 6), (2.0, [0.3, 0.3, 6.0, 0.3, 24.0, 1.0])])
def test_the_maps_laid_over_each_other_are_the_whole_region(step, ways):
    fuse, whole = Running(FuseRegion()), {}
    frames = (drive(frame, at=(float(x) - 9, 0.3 * frame, 0.2 * frame)) for frame, x in enumerate(np.cumsum(ways)))
    for terrain in mapped([fuse(*frame, MOUNT) for frame in frames], step, window=5.0):
        row, col = (round(place / 0.05) for place in terrain.origin[::-1])
        for name in ("elevation", "frames"):
            layer = np.nan_to_num(terrain.layers[name])
            whole.setdefault(name, Tiles(np.dtype("f4"))).write(row, col, layer, np.ones(layer.shape, bool))
    cells = fuse.state.cells.read(-300, -400, 800, 1100)
    assert (cells["frames"] > 0).sum() > 20_000
    np.testing.assert_array_equal(whole["elevation"].read(-300, -400, 800, 1100), cells["height"])
    np.testing.assert_array_equal(whole["frames"].read(-300, -400, 800, 1100), cells["frames"])


def test_a_later_frame_does_not_change_a_region():
    fuse = Running(FuseRegion())
    early = fuse(*drive(0), MOUNT)
    before = early.cells.read(-300, -300, 600, 600)
    fuse(*drive(1), MOUNT)
    assert early.cells.read(-300, -300, 600, 600).tobytes() == before.tobytes()
    assert fuse.state.cells.read(-300, -300, 600, 600).tobytes() != before.tobytes()


def test_fuse_returns_the_maps_of_both_stages():
    at_once, fuse, maps = Running(Fuse()), Running(FuseRegion()), Running(MapRegion())
    for frame in range(3):
        given = *drive(frame), MOUNT
        found, wanted = at_once(*given), maps(fuse(*given))
        assert (found.origin, found.shape, found.epoch) == (wanted.origin, wanted.shape, wanted.epoch)
        np.testing.assert_equal(dict(found.layers), dict(wanted.layers))
