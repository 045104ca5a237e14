"""The five terrain stages together: from a disparity image to a navigation map that agrees with the scene."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.assess import Assess
from stages.binarise import Binarise
from stages.clean import Clean
from stages.data import Cell, Disparity, ElevationMap, Mount, NavigationMap, StereoCamera, StereoFrame, Tilt
from stages.level import Level
from stages.reproject import Reproject
from stages.voxelise import Voxelise
from tests.stages.terrain_scene import HEIGHT, ROCKS, UP, as_disparity, blank_frame, seen_disparity


def mapped(
    frame: StereoFrame, disparity: Disparity, tilt: Tilt, camera_height: float
) -> tuple[ElevationMap, NavigationMap]:
    cloud = Level(camera_height=camera_height)(Clean()(Reproject()(frame, disparity)), tilt, Mount(7, np.eye(3)))
    elevation = Assess()(Voxelise()(cloud))
    return elevation, Binarise()(elevation)


def test_a_simulated_scene_has_its_ground_at_zero_its_rocks_as_hazards_and_their_shadows_unknown() -> None:
    exact = seen_disparity()
    noisy = exact + np.random.default_rng(0).normal(0, 0.2, exact.shape)
    elevation, navigation = mapped(blank_frame(), as_disparity(noisy), Tilt(7, UP), HEIGHT)
    axis = elevation.origin[0] + (np.arange(elevation.shape[0]) + 0.5) * elevation.resolution
    x, y = np.meshgrid(axis, axis)
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


def test_the_boulder_of_a_real_scene_stands_on_level_ground() -> None:
    folder = Path(os.environ.get("ROVERFLOW_DATA", "/nonexistent")) / "devon"
    if not folder.is_dir():
        pytest.skip("needs the Devon Island pairs: set ROVERFLOW_DATA to the folder that holds devon/")
    left, right = (cv2.cvtColor(cv2.imread(str(folder / f"devon2-{side}.png")), cv2.COLOR_BGR2RGB)
                   for side in ("left", "right"))  # fmt: skip
    # The left image of a point lies 0.6 px lower than its right image in this data set.
    right = cv2.warpAffine(right, np.array([[1, 0, 0], [0, 1, 0.6]], np.float32), (1280, 960))
    matcher = cv2.StereoSGBM.create(0, 192, 5, 200, 800, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
    pixels = matcher.compute(*gray).astype(np.float32) / 16
    pixels[pixels <= 0] = np.nan
    camera = StereoCamera(968.999694824, 968.999694824, 635.139038086, 463.537109375, 0.239977002, 1280, 960)
    pitch = np.deg2rad(14.2)
    up = np.array([0, -np.cos(pitch), -np.sin(pitch)])
    elevation, navigation = mapped(
        StereoFrame(7, left, right, camera), as_disparity(pixels, camera), Tilt(7, up), 0.886
    )  # fmt: skip
    height = elevation.layers["elevation"]
    middle, per_metre = elevation.shape[0] // 2, round(1 / elevation.resolution)
    path = np.s_[middle - per_metre : middle + per_metre // 2, middle + 2 * per_metre : middle + 4 * per_metre]
    assert np.nanmax(np.abs(height[path])) < 0.15
    assert (navigation.cells[path] == Cell.FREE).mean() > 0.97
    boulder = height > 0.5
    assert boulder.sum() > 200
    assert (navigation.cells[boulder] == Cell.HAZARD).mean() > 0.97
