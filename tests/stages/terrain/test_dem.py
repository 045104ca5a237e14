"""Voxelise counts every point once, averages each cell, and leaves cells without points empty."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import find_objects

from stages.cloud.clean import Clean
from stages.cloud.level import Level
from stages.cloud.reproject import Reproject
from stages.data import LEVEL_FRAME, Array, ElevationMap, MatchFailure, PixelOrigin, PointCloud, Transform
from stages.terrain.dem import Voxelise
from stages.terrain.kernels import grid as grid_kernels
from stages.terrain.kernels.cell_gradient import gradient_and_curvature, gradient_and_curvature_reference
from stages.terrain.kernels.cell_layers import LAYERS, VARIANCE, VarianceModel, cell_layers, cell_layers_reference
from stages.terrain.kernels.grid import Grid, cell_statistics_reference
from stages.terrain.kernels.occlusion import occlusion_ceiling, occlusion_ceiling_reference
from stages.terrain.kernels.splats import splat_statistics, splat_statistics_reference
from stages.terrain.kernels.staying_points import staying_points, staying_points_reference
from tests.stages import builders
from tests.stages.terrain.region_scene import centres
from tests.stages.terrain.terrain_scene import FRAME, HEIGHT, LEVEL_FROM_CAMERA, TILT, as_disparity, rocks_seen

GRID = Grid(0.1, (-8.0, -8.0), (140, 150), 8.0, (13, 5))
SENSOR = Transform(LEVEL_FRAME, "camera", LEVEL_FROM_CAMERA, np.array([0, 0, HEIGHT]))


cloud_of = partial(builders.cloud_of, sensor=SENSOR)


def scattered(seed: int, n: int = 3000, extent: float = 9.0) -> Array:
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(-extent, extent, (n, 2)), random.normal(0, 0.3, n)])


@given(seed=st.integers(0, 2**32 - 1), resolution=st.sampled_from([0.05, 0.1, 0.3]), region=st.sampled_from([4.0, 8.0]))
def test_every_point_in_range_is_counted_once(seed, resolution, region):
    cloud = cloud_of(scattered(seed))
    grid = Voxelise(resolution=resolution, max_range=region)(cloud)
    within = np.hypot(*cloud.points[:, :2].T.astype(np.float64)) <= region
    assert grid.layers["count"].sum() == within.sum()
    heights = np.nansum(grid.layers["elevation"].astype(np.float64) * grid.layers["count"])
    assert heights == pytest.approx(cloud.points[within, 2].astype(np.float64).sum(), abs=1e-3)


@given(seed=st.integers(0, 2**32 - 1))
def test_a_mirrored_cloud_gives_the_mirrored_map(seed):
    points = scattered(seed)
    # Of two cells a point on their border belongs to the upper one, and mirrored to the lower one.
    rows = points[:, 1] / 0.05
    points = points[np.abs(rows - np.round(rows)) > 1e-4]
    plain, mirrored = (Voxelise()(cloud_of(points * [1, side, 1], sensor=None)).layers for side in (1, -1))
    np.testing.assert_equal(dict(mirrored), {name: layer[::-1] for name, layer in plain.items()})


def test_the_order_of_points_changes_at_most_the_last_bits():
    points = scattered(3, 20000, 1.0)
    one, again, other = (Voxelise()(cloud_of(some)).layers for some in (points, points, points[::-1]))
    for name, layer in one.items():
        assert layer.tobytes() == again[name].tobytes()
        np.testing.assert_allclose(other[name], layer, rtol=1e-6)


def test_hidden_cells_do_not_depend_on_the_order_of_the_points():
    cloud = Level()(Clean()(Reproject()(FRAME, as_disparity(rocks_seen()))), TILT)
    one, other = (Voxelise()(some).layers for some in (cloud, cloud.only(np.arange(len(cloud.pixel))[::-1].copy())))
    assert (one["occluded"] == 1).any()
    for name, layer in one.items():
        assert layer.tobytes() == other[name].tobytes()


def test_the_layers_of_one_cell_are_those_of_its_points():
    heights = np.array([0.1, 0.2, 0.6])
    points = np.column_stack([np.full(3, 2.01), np.full(3, -1.02), heights])
    grid = Voxelise()(cloud_of(points, 0.0, sensor=None))
    row, col = int((-1.02 - grid.origin[1]) / 0.05), int((2.01 - grid.origin[0]) / 0.05)
    value = {name: float(layer[row, col]) for name, layer in grid.layers.items()}
    expected = {"elevation": 0.3, "minimum": 0.1, "maximum": 0.6, "count": 3, "common_variance": 0.0}
    assert value == pytest.approx(expected | {"variance": 0.2 * heights.var()}, rel=1e-5)
    assert (grid.layers["count"] > 0).sum() == 1


def test_tilt_uncertainty_is_the_common_variance_not_the_random_one():
    """A cloud rotated by the tilt's sigma has an error of its common standard deviation at every point."""
    cloud = cloud_of(scattered(5, 20000) * [1, 1, 0])
    sure, unsure = Voxelise()(cloud), Voxelise()(replace(cloud, tilt_sigma=0.01))
    np.testing.assert_array_equal(sure.layers["variance"], unsure.layers["variance"])
    assert np.nanmax(sure.layers["common_variance"]) == 0
    turned = cloud.points.astype(np.float64).copy()
    turned[:, 2] = -np.sin(0.01) * turned[:, 0]
    heights = Voxelise()(replace(cloud, points=turned.astype(np.float32))).layers["elevation"]
    row = 160  # along x, so that the turn is all there is
    known = np.isfinite(heights[row]) & (np.abs(np.arange(320) - 160) > 20)
    assert known.sum() > 20
    ratio = np.abs(heights[row, known]) / np.sqrt(unsure.layers["common_variance"][row, known])
    np.testing.assert_allclose(ratio, 1.0, atol=0.05)


@pytest.mark.parametrize("filled", [PixelOrigin.PLANE, PixelOrigin.FILLED])
def test_filled_points_are_a_layer_of_their_own_unless_counted(filled):
    points = np.array([[2.01, 0.01, 0.1], [2.01, 0.01, 0.9], [3.01, 0.01, 0.5]])
    cloud = replace(cloud_of(points), source=np.array([PixelOrigin.MEASURED, filled, filled], np.uint8))
    apart, counted = Voxelise()(cloud), Voxelise(filled="counted")(cloud)
    known = np.isfinite(apart.layers["elevation"])
    assert apart.layers["elevation"][known] == pytest.approx([0.1])
    assert apart.layers["filled"][np.isfinite(apart.layers["filled"])] == pytest.approx([0.5])
    assert not np.isfinite(apart.layers["filled"][known]).any()
    assert counted.layers["elevation"][np.isfinite(counted.layers["elevation"])] == pytest.approx([0.5, 0.5])
    assert "filled" not in counted.layers
    assert "filled" not in Voxelise()(cloud_of(points)).layers


def test_cells_of_filled_pixels_have_the_cause_of_the_failed_match():
    textured = np.tile([60, 140], 5)
    shades = {MatchFailure.DARK: 5, MatchFailure.BURNT_OUT: 255, MatchFailure.BARE: 120, MatchFailure.OTHER: textured}
    x = np.arange(2.02, 2.5, 0.1)[:5]
    points = np.column_stack([x.repeat(10), np.full(50, 0.01), np.zeros(50)])
    gray = np.concatenate([np.broadcast_to(shade, 10) for shade in (*shades.values(), 90)])
    source = np.repeat([PixelOrigin.FILLED] * 4 + [PixelOrigin.MEASURED], 10).astype(np.uint8)
    cloud = replace(cloud_of(points), source=source, colors=gray.astype(np.uint8)[:, None].repeat(3, axis=1))
    cells = Voxelise()(cloud)
    codes = cells.layers["unmatched"][160, 200:210:2]
    np.testing.assert_array_equal(codes, [*shades, np.nan])
    assert np.isfinite(cells.layers["unmatched"]).sum() == 4


@pytest.mark.parametrize(("pixels", "cause"), [(3, MatchFailure.OTHER), (4, MatchFailure.BARE)])
def test_few_pixels_of_one_shade_are_not_bare(pixels, cause):
    cloud = cloud_of(np.tile([2.02, 0.01, 0.0], (pixels, 1)), colors=np.full((pixels, 3), 120, np.uint8))
    cells = Voxelise()(replace(cloud, source=np.full(pixels, PixelOrigin.FILLED, np.uint8)))
    assert cells.layers["unmatched"][160, 200] == cause


def test_cells_behind_a_rock_are_occluded_and_cells_out_of_view_are_not():
    cloud = Clean()(Reproject()(FRAME, as_disparity(rocks_seen([(4.0, 0.0, 0.4)]))))
    grid = Voxelise()(Level(camera_height=HEIGHT)(cloud, TILT))
    x, y = centres(grid)
    occluded, known = grid.layers["occluded"], np.isfinite(grid.layers["elevation"])
    np.testing.assert_array_equal(occluded[known], 0)
    # The camera at 1 m sees the top of the rock, 0.4 m high at 4 m, before ground at 6.7 m.
    shadow = (np.abs(y) < 0.2) & (x > 4.6) & (x < 6.3)
    assert shadow.sum() > 200
    assert (occluded[shadow] == 1).all()
    beside = (np.abs(np.arctan2(y, x)) > np.deg2rad(40)) & (np.hypot(x, y) < 8)
    below = (np.hypot(x, y) < 1.0) & (x > 0)
    assert np.isnan(occluded[beside | below | (x < 0)]).all()


def test_holes_stay_empty_and_an_empty_cloud_makes_an_empty_map():
    empty, full = (Voxelise()(cloud_of(points)) for points in (np.zeros((0, 3)), scattered(0)))
    assert empty.shape == full.shape == (320, 320)
    assert empty.origin == full.origin == (-8.0, -8.0)
    assert not empty.layers["count"].any()
    for name in ("elevation", "minimum", "maximum", "variance"):
        assert np.isnan(empty.layers[name]).all()
        np.testing.assert_array_equal(np.isnan(full.layers[name]), full.layers["count"] == 0)


def variance_of_noise(points: Array, shared: float = 1.0) -> ElevationMap:
    """The map with the variance of the points' noise only; shared: neighbouring points that share one error."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("stages.terrain.dem.VARIANCE", VarianceModel(shared, 0.0, 0.0, 0.0, 0.0, 0.0))
        return Voxelise()(cloud_of(points, sigma=0.02))


@pytest.mark.parametrize("slope", [-0.1, 0.0, 0.3])
def test_variance_is_that_of_the_mean_for_independent_errors(slope):
    """Ground 4 m ahead, level or sloping, each point wrong by its own depth error: the map's error is as stated."""
    random = np.random.default_rng(8)
    truth = np.column_stack([random.uniform(3, 5, 200_000), random.uniform(-1, 1, 200_000), np.zeros(200_000)])
    truth[:, 2] = slope * (truth[:, 0] - 4)
    ray = truth - SENSOR.translation
    seen = truth + ray * (random.normal(0, 0.02, len(truth)) / (ray @ SENSOR.rotation[:, 2]))[:, None]
    grid = variance_of_noise(seen)
    x, _ = centres(grid)
    # Away from the ground's edges, where only points thrown outwards arrive.
    full = (grid.layers["count"] > 60) & (x > 3.3) & (x < 4.7)
    error = (grid.layers["elevation"] - slope * (x - 4))[full]
    # What a slope adds by where in the cell the points happen to lie is no error of theirs.
    unevenness = slope**2 * 0.05**2 / 12 / grid.layers["count"][full]
    ratio = (error**2 - unevenness) / grid.layers["variance"][full]
    assert 0.85 < ratio.mean() < 1.25
    correlated = variance_of_noise(seen, 25.0).layers["variance"][full]
    np.testing.assert_allclose(correlated, grid.layers["variance"][full] * 25, rtol=1e-4)


def test_points_that_share_one_error_have_the_variance_of_one():
    stated = []
    for n in (1, 5, 10, 40):
        places = np.linspace(-0.02, 0.02, n)[:, None] + np.array([[4.025, 0.025, 0.0]])
        variance = variance_of_noise(places, 10.0).layers["variance"]
        stated.append(variance[np.isfinite(variance)].item())
    np.testing.assert_allclose(stated[1:3], stated[0], rtol=0.05)
    assert stated[3] == pytest.approx(stated[2] / 4, rel=0.02)


def test_statistics_kernel_equals_the_reference():
    points = scattered(9, 5000).astype(np.float32)
    points[3] = np.nan
    given = points, np.random.default_rng(1).uniform(0, 0.1, len(points)).astype(np.float32), GRID
    np.testing.assert_allclose(grid_kernels.cell_statistics(*given), cell_statistics_reference(*given), rtol=1e-9)


def test_extent_contains_all_points_and_no_more():
    points = scattered(9, 50).astype(np.float32)
    count = cell_statistics_reference(points, np.zeros(50), GRID)[:, :, 0]
    rows, cols = find_objects((count > 0).astype(int))[0]
    assert grid_kernels.extent(points, GRID).tolist() == [rows.start, cols.start, rows.stop, cols.stop]


def test_gradient_kernel_equals_the_reference():
    random = np.random.default_rng(2)
    heights = random.normal(0, 1, (20, 30))
    heights[random.random(heights.shape) < 0.4] = np.nan
    np.testing.assert_allclose(gradient_and_curvature(heights), gradient_and_curvature_reference(heights), atol=1e-12)


@pytest.mark.parametrize("sensor", [SENSOR, None])
def test_layers_kernel_equals_the_reference(sensor):
    random, points = np.random.default_rng(7), scattered(7, 20000, 6.0).astype(np.float32)
    figures = cell_statistics_reference(points, random.uniform(0, 0.05, len(points)), GRID)
    staying = None if sensor is None else random.integers(0, 12, GRID.shape, np.int32)
    arguments = figures, staying, sensor, 0.004, VARIANCE, GRID
    got, want = cell_layers(*arguments), cell_layers_reference(*arguments)
    assert list(got) == list(LAYERS if sensor else LAYERS[:-1]) == list(want)
    np.testing.assert_allclose(list(got.values()), list(want.values()), rtol=1e-6)


def test_occlusion_kernel_equals_the_reference():
    random = np.random.default_rng(3)
    cloud = Reproject()(FRAME, as_disparity(rocks_seen()))
    some = np.sort(random.choice(len(cloud.points), 3000, replace=False))
    levelled = Level(camera_height=HEIGHT)(cloud.only(some), TILT)
    arguments = (levelled.points, levelled.pixel, 640, SENSOR.translation, GRID)
    got, want = occlusion_ceiling(*arguments), occlusion_ceiling_reference(*arguments)
    assert 0.05 < np.isfinite(want).mean() < 0.5
    alike = np.isclose(got, want, atol=1e-6) | (np.isnan(got) & np.isnan(want))
    assert (~alike).mean() < 1e-3  # samples on the border of two cells round either way


def test_a_line_of_sight_hides_the_same_cells_at_any_length():
    """It is followed only within the range: the farthest of these would take years."""
    hidden = []
    for far in (30.0, 1e6, 1e15):
        points = np.array([[far, 0.3 * far, far / 10], [1.0, 0.3, 0.0]], np.float32)
        hidden.append(occlusion_ceiling(points, np.array([5, 15]), 10, SENSOR.translation, GRID))
    assert 50 < np.isfinite(hidden[0]).sum() < 150
    np.testing.assert_allclose(hidden[1:], [hidden[0]] * 2, atol=0.2)


def test_splat_kernel_equals_the_reference():
    random = np.random.default_rng(3)
    ahead = SENSOR.translation + random.uniform(1, 8, (500, 1)) * SENSOR.rotation[:, 2]
    points = (ahead + random.normal(0, 0.3, (500, 3))).astype(np.float32)
    sigma, empty = random.uniform(0, 0.1, 500).astype(np.float32), random.random(GRID.shape) < 0.5
    arguments = points, sigma, SENSOR, (2.0, 0.05, 0.12), GRID, empty
    got, want = splat_statistics(*arguments), splat_statistics_reference(*arguments)
    assert 100 < want[:, :, 0].sum() < 4 * len(points)
    assert (want[~empty][:, 0] == 0).all()
    np.testing.assert_allclose(got, want, atol=1e-9)


def rows_apart(sigma: float) -> PointCloud:
    """Level ground with a row of points every 20 cm, 8 points per cell, with an uncertain depth."""
    x, y = (layer.ravel() for layer in np.meshgrid(np.arange(5.02, 6.0, 0.2), np.linspace(0.005, 0.045, 8)))
    return cloud_of(np.column_stack([x, y, np.zeros(len(x))]), sigma)


def test_splats_fill_cells_that_points_miss_by_their_depth_sigma():
    cloud = rows_apart(sigma=0.06)
    bare, reached = Voxelise()(cloud).layers, Voxelise(splat_sigmas=2.0)(cloud).layers
    own = bare["count"] > 0
    gained = (reached["count"] > 0) & ~own
    assert own.sum() == 5
    assert gained.sum() >= 15
    for name in ("elevation", "minimum", "maximum", "count", "common_variance"):
        np.testing.assert_array_equal(reached[name][own], bare[name][own])
    np.testing.assert_array_equal(np.isnan(reached["elevation"]), reached["count"] == 0)
    assert (reached["count"][gained] == 0.5).all()
    assert np.abs(reached["elevation"][gained]).max() < 0.05
    assert reached["variance"][gained].min() > 0
    near = Voxelise(splat_sigmas=2.0, max_splat=0.05)(cloud).layers["count"] > 0
    assert gained[near & ~own].all()
    assert own.sum() < near.sum() < own.sum() + gained.sum()


def test_staying_points_kernel_equals_the_reference():
    points = scattered(4).astype(np.float32)
    ahead = points[(points - SENSOR.translation) @ SENSOR.rotation[:, 2] > 1].repeat(4, axis=0)
    sigma = np.random.default_rng(5).uniform(0, 0.1, len(ahead)).astype(np.float32)
    count = cell_statistics_reference(ahead, sigma, GRID)[:, :, 0]
    arguments = (ahead, sigma, SENSOR, GRID, count)
    got, want = staying_points(*arguments), staying_points_reference(*arguments)
    assert 0 < want.sum() < len(ahead)
    np.testing.assert_array_equal(got, want)


def test_cells_whose_points_may_belong_to_neighbours_are_interpolated():
    sure, doubtful, splatted = (Voxelise(splat_sigmas=4.0)(rows_apart(sigma)).layers for sigma in (0.002, 0.04, 0.06))
    own = sure["count"] > 0
    assert (sure["interpolated"][own] == 0).all()
    assert np.isnan(sure["interpolated"][~own]).all()
    assert (doubtful["interpolated"][own] == 1).all()
    assert (splatted["interpolated"][splatted["count"] == 0.5] == 1).all()
    # Beside a hole the ground may fall as steeply as the line of sight, here by about 1 cm within a cell.
    assert np.sqrt(doubtful["variance"][own].min()) > 0.9 * 0.05 * HEIGHT / 6 > np.sqrt(sure["variance"][own].max())


@pytest.mark.parametrize(
    ("points", "x", "reach", "known"),
    [(1, 5.025, 0.04, 1), (2, 5.025, 0.04, 3), (1, 5.025, 0.06, 3), (2, 5.045, 0.024, 1), (2, 5.045, 0.026, 2)],
)
def test_a_cell_needs_two_splats_of_points_that_reach_half_a_cell(points, x, reach, known):
    cloud = cloud_of(np.tile([x, 0.02, 0.0], (points, 1)), reach / 2)
    assert (Voxelise(splat_sigmas=2.0)(cloud).layers["count"] > 0).sum() == known


def test_only_measured_points_are_splatted():
    cloud = rows_apart(sigma=0.06)
    plane = replace(cloud, source=np.full(len(cloud.points), PixelOrigin.PLANE, np.uint8))
    bare, splatted = (Voxelise(splat_sigmas=sigmas)(plane).layers for sigmas in (0.0, 2.0))
    np.testing.assert_equal(dict(splatted), dict(bare))
