"""Regional maps are written for each step of the rover, and none that is needed is left out."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from recordings.sinks.regional_steps import RegionalSteps, regional_maps
from stages.data import ElevationMap, NavigationMap, Transform

ROOM = 1e-9


def region(stamp: int, x: float, turn: float = 0.0, frame: str = "odom", epoch: int = 0, cells: bool = True):
    level = Transform(frame, "level", Rotation.from_euler("z", turn).as_matrix(), [x, 0.0, 0.0])
    maps = {
        "region": ElevationMap(stamp, {"elevation": np.zeros((2, 2), np.float32)}, 0.05, (x, 0.0), frame, level, epoch),
        "local": ElevationMap(stamp, {"elevation": np.zeros((2, 2), np.float32)}, 0.05, (0.0, 0.0), "level"),
    }
    codes = np.zeros((2, 2), np.int8)
    more = {"cells": NavigationMap(stamp, codes, codes.view(np.uint8), 0.05, (x, 0.0), frame)} if cells else {}
    return regional_maps(stamp, maps | more, ["region", "cells", "local"])


def written(step: float, frames: list) -> list[int]:
    """The stamps of the maps that are written, in their order."""
    steps = RegionalSteps(step)
    return [maps.stamp for frame in frames for maps in steps.due(frame)] + [maps.stamp for maps in steps.rest()]


@given(st.lists(st.floats(-3, 3), min_size=1, max_size=30), st.floats(0.1, 1.5))
def test_every_map_left_out_is_within_a_step_of_the_maps_on_either_side(ways, step):
    places = np.cumsum(ways)
    found = written(step, [region(number, x) for number, x in enumerate(places)])
    assert found == sorted(set(found)), "each at most once, in the order of stamps"
    assert (found[0], found[-1]) == (0, len(places) - 1), "the first and the last are there"
    for before, after in pairwise(found):
        between = places[before : after + 1]
        assert after == before + 1 or np.abs(np.diff(between)).sum() <= step + ROOM
    for start, end in zip(found, found[2:], strict=False):
        assert np.abs(np.diff(places[start : end + 1])).sum() > step - ROOM, "and none of them is in vain"


@pytest.mark.parametrize(("step", "stamps"), [(0.0, [0, 1, 2, 3, 4]), (0.5, [0, 2, 4]), (1.5, [0, 4])])
def test_a_map_is_written_for_each_step(step, stamps):
    assert written(step, [region(number, 0.25 * number) for number in range(5)]) == stamps


def test_a_rover_that_turns_on_the_spot_takes_steps_too():
    assert written(1.0, [region(number, 0.0, turn=0.1 * number) for number in range(6)]) == [0, 2, 4, 5]
    assert written(1.0, [region(number, 0.0) for number in range(6)]) == [0, 5]


@pytest.mark.parametrize("change", [{"frame": "odom/2"}, {"epoch": 9}, {"cells": False}])
def test_the_last_map_before_another_one_is_written(change):
    frames = [region(number, 0.01 * number, **(change if number > 2 else {})) for number in range(6)]
    assert written(1.0, frames) == [0, 2, 3, 5]


def test_the_regional_maps_of_a_frame_are_those_outside_frame_level():
    found = region(3, 1.0)
    assert set(found.maps) == {"region", "cells"}
    assert found.level is found.maps["region"].level
