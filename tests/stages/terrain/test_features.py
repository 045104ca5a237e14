"""TerrainFeatures measures heights above the ground on any grid; its kernels equal their references."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from stages.data import Array, Cell
from stages.terrain.binarise import Binarise
from stages.terrain.features import TerrainFeatures, _as_whole_obstacles
from stages.terrain.kernels.cell_steps import cell_steps, cell_steps_reference
from stages.terrain.kernels.local_minimum import local_minimum, local_minimum_reference
from stages.terrain.kernels.nearest_known import nearest_known, nearest_known_reference
from stages.terrain.kernels.plane_window import window_planes, window_planes_reference
from tests.stages.terrain.terrain_scene import map_of, rolling_terrain


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), radius=st.integers(1, 20), share=st.floats(0.0, 1.0))
def test_local_minimum_kernel_equals_the_reference(seed, radius, share):
    random = np.random.default_rng(seed)
    heights, trend = random.normal(0, 1, (12, 15)), random.normal(0, 0.1, (2, 12, 15))
    use = random.random(heights.shape) < share
    arguments = (heights, use, trend, radius)
    np.testing.assert_allclose(local_minimum(*arguments), local_minimum_reference(*arguments), atol=1e-12)


def test_steps_kernel_equals_the_reference():
    random = np.random.default_rng(8)
    height, lowest, ground, top, bottom = random.normal(0, 0.2, (5, 40, 50))
    top, bottom, ground = height + np.abs(top), height - np.abs(bottom), np.where(ground > 0.2, np.nan, ground)
    top[:5] = bottom[3:8] = np.nan
    extremes = top.astype(np.float32), bottom.astype(np.float32)
    trend, observed = random.normal(0, 0.02, (2, 40, 50)), random.random((40, 50)) < 0.7
    arguments = height, observed, *extremes, np.minimum(lowest, height), ground, trend
    np.testing.assert_array_equal(cell_steps(*arguments), cell_steps_reference(*arguments))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), radius=st.integers(1, 20), share=st.floats(0.0, 1.0))
def test_plane_kernel_equals_the_reference(seed, radius, share):
    random = np.random.default_rng(seed)
    heights = random.normal(0, 1, (12, 15))
    use = random.random(heights.shape) < share
    got, want = window_planes(heights, use, radius, 0.2503), window_planes_reference(heights, use, radius, 0.2503)
    np.testing.assert_array_equal(np.isnan(got), np.isnan(want))
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-7)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), radius=st.integers(1, 20), share=st.floats(0.0, 1.0))
def test_planes_of_some_cells_are_the_same_to_the_bit(seed, radius, share):
    random = np.random.default_rng(seed)
    heights = random.normal(0, 1, (25, 30))
    use, where = random.random((2, 25, 30)) < share
    use[:, 22:], where[:4] = False, False
    some, everywhere = window_planes(heights, use, radius, 0.2503, where), window_planes(heights, use, radius, 0.2503)
    np.testing.assert_array_equal(some[:, where], everywhere[:, where])
    assert np.isnan(some[:, :4]).all()


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 30), st.integers(1, 30)),
    reach=st.integers(1, 10),
    share=st.sampled_from((0.0, 0.01, 0.1, 0.5)),
)
def test_nearest_known_cells_equal_those_of_scipy(seed, shape, reach, share):
    known = np.random.default_rng(seed).random(shape) < share
    known.flat[seed % known.size] = True
    cells = np.nonzero(~known)
    distances, nearest = ndimage.distance_transform_edt(~known, return_indices=True)
    distances, near = distances[cells], distances[cells] <= reach
    row, col, distance = found = nearest_known(known, *cells, reach)
    np.testing.assert_equal(tuple(found), tuple(nearest_known_reference(known, *cells, reach)))
    assert (distance[near] == distances[near]).all()
    assert (distance[~near] > reach).all()
    assert (np.stack([row, col])[:, near] == nearest[:, *cells][:, near]).all()


def test_all_cells_of_an_obstacle_have_its_largest_step():
    chance = np.random.default_rng(4)
    step, raised = chance.random((40, 57)), chance.random((40, 57)) < 0.3
    label, count = ndimage.label(raised, np.ones((3, 3)))
    highest = np.array([0.0, *ndimage.maximum(step, label, range(1, count + 1))])
    assert np.array_equal(_as_whole_obstacles(step, raised), np.where(raised, highest[label], step))


def test_empty_cells_around_the_ground_do_not_change_the_features():
    terrain = rolling_terrain(3)
    small = terrain.elevation
    rows, cols = small.shape
    patch = np.s_[70 : 70 + rows, 31 : 31 + cols]

    def widened(layer: Array) -> Array:
        wide = np.full((rows + 150, cols + 90), np.nan, np.float32)
        wide[patch] = layer
        return wide

    large = replace(small, layers={name: widened(layer) for name, layer in small.layers.items()})
    found = TerrainFeatures()(large).layers
    for name, layer in TerrainFeatures()(small).layers.items():
        np.testing.assert_allclose(found[name][patch], layer, atol=1e-6, err_msg=name)


def test_a_rough_plane_has_its_slope_and_its_roughness():
    rows, cols = np.mgrid[:40, :40]
    layers = TerrainFeatures()(map_of(0.05 * (0.2 * cols - 0.1 * rows) + 0.02 * (-1.0) ** (rows + cols))).layers
    slope = np.arctan(np.hypot(0.2, 0.1))
    for name, expected in (("slope", slope), ("steepness", slope), ("roughness", 0.02)):
        np.testing.assert_allclose(layers[name][10:-10, 10:-10], expected, atol=1e-4, err_msg=name)


def test_an_empty_map_has_unknown_features():
    nothing = TerrainFeatures()(map_of(np.full((60, 60), np.nan)))
    assert all(np.isnan(layer).all() for layer in nothing.layers.values())
    assert (Binarise()(nothing).cells == Cell.UNKNOWN).all()
