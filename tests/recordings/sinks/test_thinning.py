"""Thinned clouds keep the first point of each cube."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.sinks.thinning import first_in_cubes, first_in_cubes_reference, thinned
from stages.data import PointCloud


@given(st.integers(0, 20_000), st.sampled_from([0.02, 0.3, 5.0]), st.integers(0, 2**31))
def test_the_first_point_of_each_cube_is_kept(count, spacing, seed):
    points = np.random.default_rng(seed).normal(0, 1, (count, 3)).astype(np.float32)
    assert np.array_equal(first_in_cubes(points, spacing), first_in_cubes_reference(points, spacing))


@pytest.mark.parametrize(("spacing", "kept"), [(0.0, [0, 1, 2, 3]), (0.1, [0, 2, 3])])
def test_a_thinned_cloud_keeps_everything_about_its_points(spacing, kept):
    points = np.float32([[0.01, 0.02, 0.03], [0.02, 0.03, 0.01], [-0.01, 0.02, 0.03], [3, 0, 0]])
    cloud = PointCloud(
        0, points, np.zeros((4, 3), np.uint8), np.float32([1, 2, 3, 4]), np.arange(4, dtype=np.int32), "level"
    )
    found = thinned(cloud, spacing)
    assert found.pixel.tolist() == kept
    assert found.sigma.tolist() == [1 + place for place in kept]
