"""Result logs with known errors: the truth of a simulated traverse with a known change."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.mcap.writer import Ros2Writer
from recordings.ros2 import to_msg as ros2
from recordings.scoring import score as scoring
from recordings.simulator import Simulation, ground_truth
from stages.data import Cell, Disparity, ElevationMap, NavigationMap, Transform

SMALL = Simulation(
    scene="mixed", frames=2, rate=1.0, width=320, height=240, relief_cells=512, abundance=0.2, color=False, seed=11
)  # fmt: skip
frame_of = cache(SMALL.frame)


@cache
def truth_of(index):
    """The true disparity and maps of a frame."""
    stamp, frame = SMALL.stamp(index), frame_of(index)
    return ground_truth.true_disparity(SMALL, stamp, frame), *ground_truth.truth_maps(SMALL, stamp, frame)


@dataclass
class Run:
    """A result log made from the truth; each field changes one property."""

    disparity: Callable[[np.ndarray], np.ndarray] = lambda pixels: pixels
    elevation: Callable[[np.ndarray], np.ndarray] = lambda layer: layer
    cells: Callable[[np.ndarray], np.ndarray] = lambda cells: cells
    tilt_error: float = 0.0
    lower: float = 0.0  # m, by which the origin of the maps is below base_link
    crop: int = 0
    resolution: float = 0.05
    navigation: float | None = None  # its resolution, where it is another
    skipped: tuple[int, ...] = ()
    shift: dict[int, int] = field(default_factory=dict)
    only: tuple[str, ...] = field(default=(*scoring.RESULTS, "/tf"))
    camera: str = "left_camera_optical"
    lens: dict[str, float] = field(default_factory=dict)
    blind: tuple[int, ...] = ()  # frames that say unknown everywhere

    def write(self, path: Path) -> Path:
        with Ros2Writer(path) as writer:
            for index in (number for number in range(SMALL.frames) if number not in self.skipped):
                stamp = SMALL.stamp(index) + self.shift.get(index, 0)
                run = replace(self, **BLIND) if index in self.blind else self
                for topic, message in run.messages(stamp, frame_of(index), index).items():
                    if topic in self.only:
                        writer.write(topic, message, stamp)
        return path

    def messages(self, stamp, frame, index):
        true, terrain, navigation = truth_of(index)
        disparity = Disparity(
            stamp, self.disparity(true.pixels.copy()), true.source, true.confidence,
            camera=replace(SMALL.camera, **self.lens),
        )  # fmt: skip
        inside = slice(self.crop, 320 - self.crop), slice(self.crop, 320 - 2 * self.crop)
        mean = np.where(np.isnan(terrain.layers["mean"]), terrain.layers["elevation"], terrain.layers["mean"])
        layer = np.ascontiguousarray(self.elevation(mean)[inside])
        cells = np.ascontiguousarray(self.cells(navigation.cells.copy())[inside])
        origin = (-8 + self.crop * 0.05, -8 + self.crop * 0.05)
        level_from_camera = frame.level.inverse().after(frame.base.after(SMALL.mounts[0]))
        off = Rotation.from_rotvec([0.6 * self.tilt_error, 0.8 * self.tilt_error, 0]).as_matrix()
        place = level_from_camera.translation + np.array([0.0, 0.0, self.lower])
        found = Transform("level", self.camera, off @ level_from_camera.rotation, place)
        picture = Transform("level", "navigation_map/above", np.eye(3), np.zeros(3))  # of a viewer's picture of the map
        reason = np.zeros(cells.shape, np.uint8)
        return {
            "/nav/disparity": ros2.disparity_image(disparity),
            "/nav/elevation_map": ros2.grid_map(
                ElevationMap(
                    stamp, {"elevation": layer, "interpolated": np.ones_like(layer)}, self.resolution, origin, "level"
                )
            ),
            "/nav/navigation_map": ros2.occupancy_grid(
                NavigationMap(stamp, cells, reason, self.navigation or self.resolution, origin, "level")
            ),
            "/tf": ros2.transform_message([(found, stamp), (picture, stamp)]),
        }


BLIND = {
    "disparity": lambda pixels: np.full_like(pixels, np.nan),
    "elevation": lambda layer: np.full_like(layer, np.nan),
    "cells": lambda cells: np.full_like(cells, Cell.UNKNOWN),
}
