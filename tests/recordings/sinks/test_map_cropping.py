"""Maps without empty cells: the known ones keep their places and their values."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.scoring.metrics import aligned
from recordings.sinks.map_cropping import ahead, cropped
from stages.data import Cell, CellReason, ElevationMap, NavigationMap

ROWS, COLS, STEP = 120, 90, 0.05


def maps(known: np.ndarray, frame_id: str = "level") -> dict[str, ElevationMap | NavigationMap]:
    """An elevation map with values, and a navigation map with reasons, in some cells."""
    rng = np.random.default_rng(1)
    heights = np.where(known, rng.normal(size=known.shape), np.nan).astype(np.float32)
    layers = {"elevation": heights, "count": known.astype(np.float32)}
    reason = np.where(known, CellReason.OCCLUDED, CellReason.UNOBSERVED).astype(np.uint8)
    return {
        "terrain": ElevationMap(0, layers, STEP, (-2.0, -3.0), frame_id),
        "cells": NavigationMap(0, np.full(known.shape, Cell.UNKNOWN, np.int8), reason, STEP, (-2.0, -3.0), frame_id),
    }


@given(st.lists(st.tuples(st.integers(0, ROWS - 1), st.integers(0, COLS - 1)), min_size=1, max_size=4))
def test_a_cropped_map_laid_on_its_old_grid_is_the_map_before(places):
    known = np.zeros((ROWS, COLS), bool)
    known[tuple(np.transpose(places))] = True
    before = maps(known)
    after = cropped(before)
    low, high = np.min(places, axis=0), np.max(places, axis=0)
    assert after["terrain"].shape == after["cells"].cells.shape == tuple(high - low + 1)
    onto = known.shape, (-2.0, -3.0), STEP
    for name, fill in (("elevation", np.nan), ("count", 0)):
        found = aligned(after["terrain"].layers[name], after["terrain"].origin, *onto, fill)
        np.testing.assert_array_equal(found, before["terrain"].layers[name])
    found = aligned(after["cells"].reason, after["cells"].origin, *onto, CellReason.UNOBSERVED)
    np.testing.assert_array_equal(found, before["cells"].reason)


def test_maps_on_one_grid_get_one_rectangle_and_others_their_own():
    one, other = np.zeros((2, ROWS, COLS), bool)
    one[10:20, 30:40] = other[15:50, 5:35] = True
    items = {"terrain": maps(one)["terrain"], "cells": maps(other)["cells"], "odom": maps(one, "odom")["terrain"]}
    found = cropped({**items, "sharpness": 0.5})
    assert found["terrain"].shape == found["cells"].cells.shape == (40, 35)
    assert found["terrain"].origin == found["cells"].origin == pytest.approx((-1.75, -2.5))
    assert found["odom"].shape == (10 + 10 + 30, 30 + 10 + 30)  # a rim of 1.5 m, where there is room for it
    assert found["sharpness"] == 0.5


def test_a_map_without_known_cells_stays_whole():
    found = cropped(maps(np.zeros((ROWS, COLS), bool)))
    assert found["terrain"].shape == found["cells"].cells.shape == (ROWS, COLS)


def test_a_layer_of_zeros_is_known_unless_it_counts():
    zeros = np.zeros((ROWS, COLS), np.float32)
    terrain = maps(np.eye(ROWS, COLS, dtype=bool)[:, ::-1] & (np.arange(COLS) < 9))["terrain"]
    for name, shape in (("cost", (ROWS, COLS)), ("frames", (9, 9))):
        layers = {**terrain.layers, name: zeros}
        found = cropped({"terrain": ElevationMap(0, layers, STEP, terrain.origin, "level")})
        assert found["terrain"].shape == shape


@pytest.mark.parametrize("behind", [False, True])
def test_unknown_ground_behind_the_rover_is_not_drawn(behind):
    known = np.zeros((4, 80), bool)
    known[1, 50], known[2, 3] = True, behind
    terrain, cells = maps(known).values()
    cells = replace(cells, cells=np.where(known, Cell.FREE, Cell.UNKNOWN).astype(np.int8))
    left_out = 0 if behind else 20
    assert ahead(terrain).origin == ahead(cells).origin == pytest.approx((-2.0 + left_out * STEP, -3.0))
    np.testing.assert_array_equal(ahead(terrain).layers["count"], terrain.layers["count"][:, left_out:])
    np.testing.assert_array_equal(ahead(cells).reason, cells.reason[:, left_out:])


def test_a_map_far_behind_its_origin_without_known_cells_stays_whole():
    for item in maps(np.zeros((4, 80), bool)).values():
        assert ahead(replace(item, origin=(-9.0, 0.0))).origin == (-9.0, 0.0)
