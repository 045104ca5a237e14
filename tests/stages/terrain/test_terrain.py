"""The terrain stages together: from a disparity image to a navigation map that agrees with the scene."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from stages import Binarise, Clean, Fuse, Level, Reproject, TerrainFeatures, Voxelise
from stages.data import Array, Cell, ElevationMap, NavigationMap, Pose, Rover, Tilt
from tests.bench.stereo_scores import devon
from tests.conftest import data_folder
from tests.stages.running import Running
from tests.stages.terrain.region_scene import centres
from tests.stages.terrain.terrain_scene import FRAME, HEIGHT, ROCKS, TILT, as_disparity, profile_seen, rocks_seen


def mapped(frame, disparity, tilt=TILT, camera_height=HEIGHT, reach=0.0) -> ElevationMap:
    cloud = Level(camera_height=camera_height)(Clean()(Reproject()(frame, disparity)), tilt)
    return TerrainFeatures()(Voxelise(splat_sigmas=reach)(cloud))


def test_a_scene_has_level_ground_hazard_rocks_and_unknown_shadows():
    exact = rocks_seen()
    noisy = exact + np.random.default_rng(0).normal(0, 0.2, exact.shape)
    elevation = mapped(FRAME, as_disparity(noisy))
    navigation, (x, y) = Binarise()(elevation), centres(elevation)
    distance = np.min([np.hypot(x - cx, y - cy) - radius for cx, cy, radius in ROCKS], axis=0)
    height = elevation.layers["elevation"]
    ground = np.isfinite(height) & (distance > 0.3)
    assert np.sqrt(np.mean(height[ground & (x < 6)] ** 2)) < 0.01
    assert (navigation.cells[ground] == Cell.HAZARD).mean() < 0.001
    assert (navigation.cells[np.isnan(height)] == Cell.UNKNOWN).all()
    for cx, cy, radius in ROCKS:
        on_rock = np.hypot(x - cx, y - cy) < radius
        assert (navigation.cells[on_rock] == Cell.HAZARD).sum() >= 5
        behind = np.isnan(height) & (x > cx) & (np.hypot(x - cx, y - cy) < 2 * radius)
        assert behind.any()


def profiled(profile: Callable[[Array], Array], seed: int = 1, **limits: Any) -> tuple[Array, NavigationMap]:
    """Distance ahead (rows, cols), m, and the navigation map of ground with this profile, before a noisy camera."""
    exact = profile_seen(profile)
    noisy = exact + np.random.default_rng(seed).normal(0, 0.1, exact.shape)
    elevation = mapped(FRAME, as_disparity(noisy), reach=2.25)
    ahead, aside = centres(elevation)
    navigation, lane = Binarise(**limits)(elevation), np.abs(aside[:, 0]) < 0.8
    return ahead[lane], replace(navigation, cells=navigation.cells[lane], reason=navigation.reason[lane])


BLIND = {"min_drop": 100.0}  # no drop is ever suspected


def drop(edge: float, depth: float = 3.0) -> Callable[[Array], Array]:
    return lambda x: np.where(x < edge, 0.0, -depth)


@pytest.mark.parametrize("edge", [3.0, 4.5, 6.5])
def test_the_edge_of_a_drop_with_a_hidden_foot_is_not_free(edge):
    ahead, cliff = profiled(drop(edge))
    brink, way = (ahead > edge - 0.1) & (ahead < edge), (ahead > 2.0) & (ahead < edge - 0.3)
    assert not (cliff.cells[brink | (ahead > edge)] == Cell.FREE).any()
    assert (cliff.cells[way] == Cell.FREE).mean() > 0.98
    _, blind = profiled(drop(edge), **BLIND)
    assert (blind.cells[brink] == Cell.FREE).mean() > 0.5  # so no other rule finds it


@pytest.mark.parametrize(
    ("edge", "depth"), [(2, 0.3), (2.5, 0.4), (2.5, 0.6), (3, 0.3), (3, 0.5), (4, 0.3), (4, 0.4), (5, 0.4)]
)
def test_the_edge_of_a_drop_to_visible_ground_is_not_free(edge, depth):
    ahead, cliff = profiled(drop(edge, depth))
    assert not (cliff.cells[(ahead > edge - 0.1) & (ahead < edge)] == Cell.FREE).any()
    assert (cliff.cells[(ahead > 1.6) & (ahead < edge - 0.3)] == Cell.FREE).mean() > 0.98


def test_nothing_is_free_within_half_a_wheel_of_a_drop():
    for wheel in (0.3, 0.6, 1.0):
        ahead, cliff = profiled(drop(4.5), rover=Rover(wheel=wheel))
        assert not (cliff.cells[(ahead > 4.5 - wheel / 2 + 0.05) & (ahead < 4.5)] == Cell.FREE).any()
        assert (cliff.cells[(ahead > 2.0) & (ahead < 4.35 - wheel / 2)] == Cell.FREE).mean() > 0.98


@pytest.mark.parametrize(("near", "width"), [(2.5, 0.5), (4.0, 0.6), (5.5, 1.0)])
def test_the_near_edge_of_a_ditch_with_a_hidden_bottom_is_not_free(near, width):
    def ditched(x: Array) -> Array:
        return np.where((x < near) | (x > near + width), 0.0, -1.0)

    ahead, ditch = profiled(ditched)
    _, blind = profiled(ditched, **BLIND)
    brink, before = (ahead > near - 0.1) & (ahead < near), (ahead > 1.8) & (ahead < near - 0.3)
    inside, after = (ahead > near) & (ahead < near + width), (ahead > near + width + 0.4) & (ahead < 7.5)
    assert not (ditch.cells[brink | inside] == Cell.FREE).any()
    assert (ditch.cells[before] == Cell.FREE).mean() > 0.98
    np.testing.assert_array_equal(ditch.cells[after], blind.cells[after])
    assert (blind.cells[brink] == Cell.FREE).mean() > 0.9  # so no other rule finds it


@pytest.mark.parametrize("at", [3.0, 4.5, 6.0])
@pytest.mark.parametrize("slope", [0.0, 0.1, -0.05])
def test_the_ground_around_a_bump_stays_free(at, slope):
    def bumpy(x: Array) -> Array:
        return np.asarray(slope * x + 0.1 * np.exp(-(((x - at) / 0.25) ** 2)))

    ahead, bump = profiled(bumpy)
    _, blind = profiled(bumpy, **BLIND)
    about = (np.abs(ahead - at) < 1.5) & (ahead > 2.0)
    assert (blind.cells[about] == Cell.FREE).sum() > 500
    assert (bump.cells[about] == Cell.FREE).sum() > 0.98 * (blind.cells[about] == Cell.FREE).sum()


def test_the_edge_of_a_drop_is_not_free_in_the_regional_map():
    cloud = Clean()(Reproject()(FRAME, as_disparity(profile_seen(drop(4.5)))))
    pose = Pose(7, [100.0, 50.0, 3.0], [-0.5, 0.5, -0.5, 0.5], "odom", "camera")
    elevation = TerrainFeatures()(Running(Fuse())(Level(camera_height=HEIGHT)(cloud, TILT), pose))
    ahead, lane = centres(elevation)[0][0] - 100, elevation.shape[0] // 2 + np.arange(-15, 15)
    cells, blind = (Binarise(**limits)(elevation).cells[lane] for limits in ({}, BLIND))
    brink = (ahead > 4.4) & (ahead < 4.5)
    assert not (cells[:, brink] == Cell.FREE).any()
    assert (cells[:, (ahead > 2) & (ahead < 4.2)] == Cell.FREE).mean() > 0.98
    assert (blind[:, brink] == Cell.FREE).mean() > 0.5


def test_the_boulder_of_a_real_scene_stands_on_level_ground():
    given = dict(devon(data_folder("devon").parent))["devon2"]
    # The left image of a point lies 0.6 px lower than its right image in this data set.
    right = cv2.warpAffine(given.right, np.array([[1, 0, 0], [0, 1, 0.6]], np.float32), (1280, 960))
    frame = replace(given, right=right)
    matcher = cv2.StereoSGBM.create(0, 192, 5, 200, 800, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame.left, frame.right)]
    pixels = matcher.compute(*gray).astype(np.float32) / 16
    pixels[pixels <= 0] = np.nan
    pitch = np.deg2rad(14.2)
    tilt = Tilt(frame.stamp, np.array([0, -np.cos(pitch), -np.sin(pitch)]), frame.camera.frame_id)
    elevation = mapped(frame, as_disparity(pixels, frame.camera, frame.stamp), tilt, camera_height=0.886)
    height, navigation = elevation.layers["elevation"], Binarise()(elevation)
    middle, per_metre = elevation.shape[0] // 2, round(1 / elevation.resolution)
    path = np.s_[middle - per_metre : middle + per_metre // 2, middle + 2 * per_metre : middle + 4 * per_metre]
    assert np.nanmax(np.abs(height[path])) < 0.15
    assert (navigation.cells[path] == Cell.FREE).mean() > 0.97
    boulder = height > 0.5
    assert boulder.sum() > 200
    assert (navigation.cells[boulder] == Cell.HAZARD).mean() > 0.97
