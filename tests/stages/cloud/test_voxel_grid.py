"""VoxelGrid counts every measured point once, in its voxel."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flow.contracts import StageError
from stages.cloud.kernels.voxels import voxel_means, voxel_means_reference
from stages.cloud.voxel_grid import VoxelGrid
from stages.data import PixelOrigin
from tests.stages.builders import cloud_of


def some(seed, n=4000):
    random = np.random.default_rng(seed)
    return cloud_of(random.normal(0, 0.4, (n, 3)), colors=random.integers(0, 256, (n, 3), np.uint8))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), edge=st.sampled_from([0.05, 0.13, 1.0]))
def test_voxel_kernel_equals_the_reference(seed, edge):
    cloud = some(seed, 500)
    given = cloud.points, cloud.colors, edge
    np.testing.assert_equal(tuple(voxel_means(*given)), tuple(voxel_means_reference(*given)))


def test_every_measured_point_in_range_is_in_exactly_one_voxel():
    cloud = some(1)
    filled = np.arange(len(cloud.points)) % 4 == 0
    source = np.where(filled, PixelOrigin.FILLED, PixelOrigin.MEASURED).astype(np.uint8)
    points = cloud.points.copy()
    points[1::40, 2] = np.nan
    cloud = replace(cloud, points=points, source=source)
    voxels = VoxelGrid(max_range=0.6, resolution=0.1)(cloud)
    inside = ~filled & np.isfinite(points[:, 2]) & (np.hypot(cloud.points[:, 0], cloud.points[:, 1]) <= 0.6)
    assert voxels.count.sum() == inside.sum()
    cubes = {tuple(cube) for cube in np.floor(cloud.points[inside] / np.float64(0.1)).astype(int)}
    assert sorted(map(tuple, voxels.index)) == sorted(cubes)


def test_an_overhang_has_voxels_and_colours_of_its_own():
    points = np.array([[1.01, 1.01, 0.01], [1.02, 1.02, 0.02], [1.01, 1.01, 1.01]])
    colors = np.array([[10, 20, 30], [20, 30, 41], [200, 0, 0]], np.uint8)
    voxels = VoxelGrid()(cloud_of(points, colors=colors))
    assert voxels.index.tolist() == [[20, 20, 0], [20, 20, 20]]
    assert voxels.colors.tolist() == [[15, 25, 35], [200, 0, 0]]
    assert voxels.count.tolist() == [2, 1]


def test_a_map_of_too_many_voxels_is_refused():
    limit = r"VoxelGrid\.max_range = 100 m makes a map 40000 cells of 0\.005 m wide; the limit is 4000"
    with pytest.raises(ValueError, match=limit):
        VoxelGrid(resolution=0.005, max_range=100.0)
    corners = cloud_of([[9.902, 0, 0], [0, 9.902, 0], [0, -9.902, 0]])
    widest = VoxelGrid(resolution=0.005, max_range=10.0)(corners)
    assert widest.index.tolist() == [[0, -1981, 0], [1980, 0, 0], [0, 1980, 0]]


def test_a_point_far_above_the_ground_is_refused():
    with pytest.raises(StageError, match=r"a point is 1e\+06 m above or below the origin; the limit is 4000 voxels"):
        VoxelGrid()(cloud_of([[1, 1, 0], [1, 1, -1e6]]))


def test_no_points_make_no_voxels():
    assert VoxelGrid()(cloud_of(np.zeros((0, 3)))).index.shape == (0, 3)
