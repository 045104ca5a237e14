"""The terrain stages' neighbourhoods of cells: what scipy's morphology returns, also for maps without cells."""

import numpy as np
import pytest
from scipy import ndimage

from stages.terrain.features import _as_whole_obstacles
from stages.terrain.kernels.cell_layers import _beside_hole

SHAPES = [(0, 0), (0, 4), (1, 1), (40, 57)]


@pytest.mark.parametrize("shape", SHAPES)
def test_cells_beside_holes_are_those_that_an_erosion_removes(shape):
    height = np.where(np.random.default_rng(3).random(shape) < 0.9, 1.0, np.nan)
    eroded = ndimage.binary_erosion(np.isfinite(height), np.ones((3, 3)))
    found = [_beside_hole.py_func(height, row, col) for row, col in np.ndindex(shape)]
    assert np.array_equal(np.reshape(found, shape), ~eroded)


@pytest.mark.parametrize("shape", SHAPES)
def test_all_cells_of_an_obstacle_have_its_largest_step(shape):
    chance = np.random.default_rng(4)
    step, raised = chance.random(shape), chance.random(shape) < 0.3
    label, count = ndimage.label(raised, np.ones((3, 3)))
    highest = np.array([0.0, *ndimage.maximum(step, label, range(1, count + 1))]) if count else np.zeros(1)
    assert np.array_equal(_as_whole_obstacles(step, raised), np.where(raised, highest[label], step))
