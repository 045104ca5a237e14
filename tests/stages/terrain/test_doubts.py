"""Binarise doubts ground beside what is out of view: obstacles that the edge of view cuts, drops and holes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from stages.data import Cell, CellReason
from stages.terrain.binarise import Binarise
from stages.terrain.features import TerrainFeatures
from stages.terrain.verdict_limits import doubts_at, turns_at
from tests.stages.terrain.terrain_scene import grid, map_of

X, Y = grid(80)


@pytest.mark.parametrize(("cut", "free"), [(True, 0.0), (False, 1.0)])
def test_a_low_flank_is_free_only_if_its_top_is_in_view(cut, free):
    top, slope = (0.3, 0.6) if cut else (0.09, 0.2)
    height = np.maximum(top - slope * np.hypot(X - 2, Y - 2), 0)
    seen = X < 1.65 if cut else X < 3
    terrain = map_of(np.where(seen, height, np.nan), occluded=np.where(seen, 0.0, np.nan).astype(np.float32))
    result = Binarise()(TerrainFeatures()(terrain))
    assert np.nanmax(terrain.layers["elevation"]) < 0.1
    flank = seen & (height > 0.05)
    assert flank.sum() > 5
    assert (result.cells[flank] == Cell.FREE).mean() == free
    assert (result.cells[seen & (np.hypot(X - 2, Y - 2) > 0.9)] == Cell.FREE).mean() > 0.9


def test_a_wall_that_the_edge_of_view_cuts_far_away_names_its_doubt():
    x, y = grid(160)
    seen = y < 6.5
    height = np.where(seen, np.where((y > 1) & (abs(x - 4) < 0.15), 0.12, 0.0), np.nan)
    terrain = TerrainFeatures()(map_of(height, occluded=np.where(seen, 0.0, np.nan)))
    rule, (row, col) = Binarise(), (30, 80)
    assert rule(terrain).reason[row, col] == CellReason.UNSURE
    assert doubts_at(rule, terrain, row, col) == ["on an obstacle that the edge of view cuts (min_rise)"]
    (turn,) = (turn for turn in turns_at(rule, terrain, row, col) if turn.parameter == "min_rise")
    short, enough = (replace(rule, min_rise=value)(terrain) for value in (turn.needed / 1.01, turn.needed))
    assert (short.cells[row, col], enough.cells[row, col]) == (Cell.UNKNOWN, turn.verdict) == (-1, 0)


def test_a_needed_value_has_the_digits_that_turn_the_verdict():
    flat = np.zeros((9, 9))
    layers = dict.fromkeys(("ground", "step", "roughness"), flat) | {"support": np.ones(flat.shape)}
    slope, steepness = (np.full(flat.shape, np.radians(angle)) for angle in (10.132, 10.312))
    terrain, rule = map_of(flat, **layers, slope=slope, steepness=steepness), Binarise()
    (turn,) = (turn for turn in turns_at(rule, terrain, 4, 4) if turn.parameter == "rover.max_slope")
    assert (np.degrees(turn.needed), turn.verdict) == (pytest.approx(10.26, abs=1e-12), Cell.UNKNOWN)
    changed = replace(rule, rover=replace(rule.rover, max_slope=turn.needed))
    assert changed(terrain).cells[4, 4] == Cell.UNKNOWN


@pytest.mark.parametrize(
    ("cells", "drop", "step", "free"),
    [(6, 0.05, 0.06, False), (5, 0.05, 0.06, True), (6, 0.02, 0.06, True), (6, 0.05, 0.03, True)],
    ids=["a hole", "a hole smaller than a wheel", "hidden ground that is not low", "even ground"],
)
def test_uneven_ground_at_a_hole_of_hidden_ground_is_unsure(cells, drop, step, free):
    hole = np.zeros((40, 40), bool)
    hole[17 : 17 + cells, 17 : 17 + cells] = True
    layers = dict.fromkeys(("ground", "slope", "steepness", "roughness"), np.zeros(hole.shape))
    layers |= {"step": np.full(hole.shape, step), "support": ~hole, "occluded": hole}
    terrain = map_of(np.where(hole, np.nan, 0), **layers, drop=np.where(hole, drop, np.nan))
    reason = Binarise()(terrain).reason
    beside = binary_dilation(hole, np.ones((3, 3))) & ~hole
    assert (reason[beside] == (CellReason.CLEAR if free else CellReason.UNSURE)).all()
    assert (reason[:10] == CellReason.CLEAR).all()


def even(hidden, **layers):
    """Level ground whose cells `hidden` (rows, cols) are occluded, with some other layers."""
    known = dict.fromkeys(("ground", "step", "slope", "steepness", "roughness"), np.zeros(hidden.shape))
    return map_of(np.where(hidden, np.nan, 0.0), **known | {"support": ~hidden, "occluded": hidden} | layers)


def test_hidden_ground_up_to_a_metre_from_a_drop_may_fall_away_already():
    hidden = (Y > 1) & (Y < 3)
    drop = np.where(hidden & (X < 0.5), 0.2, np.where(hidden, 0.0, np.nan))
    reason = Binarise()(even(hidden, drop=drop)).reason
    beside = binary_dilation(hidden, np.ones((3, 3))) & ~hidden
    assert (reason[beside & (X < 1.5)] == CellReason.UNSURE).all()
    assert (reason[beside & (X > 1.75)] == CellReason.CLEAR).all()


@pytest.mark.parametrize(("step", "free"), [(0.09, True), (0.11, False)])
def test_a_step_at_the_edge_of_view_may_continue_from_twice_the_least_rise(step, free):
    beyond = X > 3
    terrain = even(beyond, step=np.full(X.shape, step), occluded=np.where(beyond, np.nan, 0.0))
    assert (Binarise()(terrain).cells[(X > 2.9) & ~beyond] == Cell.FREE).all() == free
