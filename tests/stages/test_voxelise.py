"""Voxelise counts every point once, averages what it has, and leaves a hole where it has nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.data import LEVEL_FRAME, Array, PointCloud, Transform
from stages.kernels.grid import cell_statistics, cell_statistics_reference
from stages.voxelise import Voxelise
from tests.stages.terrain_scene import HEIGHT, level_from_camera

SENSOR = Transform(LEVEL_FRAME, "camera", level_from_camera(), np.array([0, 0, HEIGHT]))


def cloud_of(points: Array, sigma: float = 0.02, sensor: Transform | None = SENSOR) -> PointCloud:
    n = len(points)
    return PointCloud(
        5, points.astype(np.float32), np.zeros((n, 3), np.uint8), np.full(n, sigma, np.float32),
        np.arange(n, dtype=np.int32), LEVEL_FRAME, None, sensor,
    )  # fmt: skip


def scattered(seed: int, n: int = 3000, extent: float = 9.0) -> Array:
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(-extent, extent, (n, 2)), random.normal(0, 0.3, n)])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), resolution=st.sampled_from([0.05, 0.1, 0.3]), region=st.sampled_from([4.0, 8.0]))
def test_every_point_within_the_region_is_counted_once(seed: int, resolution: float, region: float) -> None:
    cloud = cloud_of(scattered(seed))
    grid = Voxelise(resolution=resolution, region=region)(cloud)
    within = np.hypot(*cloud.points[:, :2].T.astype(np.float64)) <= region
    assert grid.layers["count"].sum() == within.sum()
    heights = np.nansum(grid.layers["elevation"].astype(np.float64) * grid.layers["count"])
    assert heights == pytest.approx(cloud.points[within, 2].astype(np.float64).sum(), abs=1e-3)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_mirrored_cloud_gives_the_mirrored_map(seed: int) -> None:
    points = scattered(seed)
    # Of two cells a point on their border belongs to the upper one, and mirrored to the lower one.
    rows = points[:, 1] / 0.05
    points = points[np.abs(rows - np.round(rows)) > 1e-4]
    plain = Voxelise()(cloud_of(points, sensor=None))
    mirrored = Voxelise()(cloud_of(points * [1, -1, 1], sensor=None))
    for name, layer in plain.layers.items():
        np.testing.assert_array_equal(mirrored.layers[name], layer[::-1])


def test_the_order_of_points_moves_at_most_the_last_bits_and_one_order_gives_the_same_bits() -> None:
    points = scattered(3, 20000, 1.0)
    one, again = Voxelise()(cloud_of(points)), Voxelise()(cloud_of(points))
    other = Voxelise()(cloud_of(points[::-1]))
    for name, layer in one.layers.items():
        assert layer.tobytes() == again.layers[name].tobytes()
        np.testing.assert_allclose(other.layers[name], layer, rtol=1e-6)


def test_the_layers_of_one_cell_are_those_of_its_points() -> None:
    heights = np.array([0.1, 0.2, 0.6])
    points = np.column_stack([np.full(3, 2.01), np.full(3, -1.02), heights])
    grid = Voxelise()(cloud_of(points, sigma=0.0))
    row, col = int((-1.02 - grid.origin[1]) / 0.05), int((2.01 - grid.origin[0]) / 0.05)
    value = {name: float(layer[row, col]) for name, layer in grid.layers.items()}
    assert value == pytest.approx(
        {"elevation": 0.3, "minimum": 0.1, "maximum": 0.6, "count": 3, "variance": heights.var()}, rel=1e-5
    )
    assert (grid.layers["count"] > 0).sum() == 1


def test_a_hole_stays_a_hole_and_an_empty_cloud_is_an_empty_map_of_the_usual_shape() -> None:
    empty = Voxelise()(cloud_of(np.zeros((0, 3))))
    full = Voxelise()(cloud_of(scattered(0)))
    assert empty.shape == full.shape == (320, 320)
    assert empty.origin == full.origin == (-8.0, -8.0)
    assert not empty.layers["count"].any()
    for name in ("elevation", "minimum", "maximum", "variance"):
        assert np.isnan(empty.layers[name]).all()
        np.testing.assert_array_equal(np.isnan(full.layers[name]), full.layers["count"] == 0)


def test_variance_is_that_of_the_mean_when_errors_are_independent() -> None:
    """Flat ground 4 m ahead, each point wrong by its own depth error: the map's error is what the variance says."""
    random = np.random.default_rng(8)
    truth = np.column_stack([random.uniform(3, 5, 200_000), random.uniform(-1, 1, 200_000), np.zeros(200_000)])
    ray = truth - SENSOR.translation
    depth = ray @ SENSOR.rotation[:, 2]
    seen = truth + ray * (random.normal(0, 0.05, len(truth)) / depth)[:, None]
    grid = Voxelise(correlated=1.0)(cloud_of(seen, sigma=0.05))
    full = grid.layers["count"] > 60
    # Away from the ground's edges, where only points thrown outwards arrive.
    x = grid.origin[0] + (np.arange(320) + 0.5) * 0.05
    full &= (x > 3.3) & (x < 4.7)
    ratio = grid.layers["elevation"][full] ** 2 / grid.layers["variance"][full]
    # Scatter and depth noise are the same error here, counted twice on purpose: a cell never claims too little.
    assert 0.4 < ratio.mean() < 0.6
    correlated = Voxelise(correlated=25.0)(cloud_of(seen, sigma=0.05)).layers["variance"][full]
    np.testing.assert_allclose(correlated, grid.layers["variance"][full] * 25, rtol=1e-4)


def test_kernel_equals_the_plain_reference() -> None:
    points = scattered(9, 5000).astype(np.float32)
    points[3] = np.nan
    noise = np.random.default_rng(1).uniform(0, 0.1, len(points)).astype(np.float32)
    lever = np.concatenate([SENSOR.translation, SENSOR.rotation[:, 2], [1.0]])
    for at in (lever, np.zeros(7)):
        arguments = (points, noise, at, 0.1, (-8.0, -8.0), 160, 8.0)
        np.testing.assert_allclose(cell_statistics(*arguments), cell_statistics_reference(*arguments), rtol=1e-9)


def test_a_cloud_that_is_not_level_is_refused() -> None:
    cloud = PointCloud(
        0, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros(0, np.int32),
        "cam",
    )  # fmt: skip
    with pytest.raises(ValueError, match="'cam', not 'level'"):
        Voxelise()(cloud)
