"""A simulated drive without images: the motion of its camera and the readings of its inclinometer."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.simulator import Simulation
from stages.data import Array, CameraMotion, Tilt, Transform
from stages.localisation.tilt.causes import Evidence

FRAMES = 50
SMOOTHED = 0.45  # of a sample's noise is left in the mean of those about a frame


@lru_cache(maxsize=8)
def simulation(seed: int, slope: float) -> Simulation:
    """A drive whose ground has this RMS slope, degrees."""
    tile = {"relief_cells": 512, "relief_resolution": 0.08}
    return Simulation(frames=FRAMES, seed=seed, slope=float(np.radians(slope)), **tile)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Drive:
    """One drive. noise: of an inclinometer sample, degrees; odometry: of the camera's turn, degrees a frame."""

    seed: int
    slope: float = 4.0
    noise: float = 0.3
    odometry: float = 0.01

    @property
    def truth(self) -> Simulation:
        return simulation(self.seed, self.slope)

    def stamps(self, frames: int = FRAMES) -> list[int]:
        return [self.truth.stamp(frame) for frame in range(frames)]

    def cameras(self, frames: int = FRAMES) -> list[Transform]:
        """world <- camera."""
        return [self.truth.base_at(stamp).after(self.truth.mounts[0]) for stamp in self.stamps(frames)]

    @property
    def mount(self) -> Array:
        """camera <- inclinometer."""
        return self.truth.mounts[0].rotation.T @ self.truth.mounts[2].rotation  # type: ignore[no-any-return]

    def orientations(self, frames: int = FRAMES, late: float = 0.0) -> Array:
        """world <- inclinometer at the frames, (n, 3, 3), as it measures it with stamps too late by `late` seconds."""
        rng, spread = np.random.default_rng([self.seed, 1]), np.radians(self.noise) * SMOOTHED
        found = []
        for stamp in self.stamps(frames):
            turned = self.truth.base_at(stamp - round(late * 1e9)).rotation @ self.truth.mounts[2].rotation
            found.append(Rotation.from_rotvec([*rng.normal(0, spread, 2), 0.0]).as_matrix() @ turned)
        return np.array(found)

    def ups(self, frames: int = FRAMES, late: float = 0.0) -> Array:
        """Readings of the inclinometer at the frames, with stamps too late by `late` seconds."""
        return self.orientations(frames, late)[:, 2]

    def turns(self, frames: int = FRAMES) -> Array:
        """Rotation of the camera since the first frame by visual odometry, (n, 3, 3)."""
        rng, cameras = np.random.default_rng([self.seed, 2]), self.cameras(frames)
        drift, turns = Rotation.identity(), []
        for camera in cameras:
            turns.append(drift.as_matrix() @ cameras[0].rotation.T @ camera.rotation)
            drift = drift * Rotation.from_rotvec(rng.normal(0, np.radians(self.odometry), 3))
        return np.array(turns)

    def ground(self, frames: int = FRAMES) -> Array:
        """Normal of the ground in view, which slopes by some degrees, in the camera."""
        rng = np.random.default_rng([self.seed, 3])
        normals = np.array([camera.rotation[2] for camera in self.cameras(frames)]) + rng.normal(0, 0.05, (frames, 3))
        return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])

    def evidence(
        self, frames: int = FRAMES, change: Callable[[Array], Array] | None = None, late: float = 0.0,
        turned: Array | None = None,
    ) -> Evidence:  # fmt: skip
        """Evidence of a tilt with a fault for the tilt check."""
        ups = self.ups(frames, late)
        ups = np.array([change(up) for up in ups]) if change else ups
        mount = self.mount if turned is None else self.mount @ turned
        drift = np.arange(frames) * np.radians(self.odometry) ** 2
        stamps = np.array(self.stamps(frames))
        return Evidence(stamps, np.ones(frames, int), self.turns(frames), drift, ups, mount, self.ground(frames))


def misread(drive: Drive, order: list[int], signs: list[int], heading: float) -> Evidence:
    """Evidence of orientations whose quaternion's numbers have another order and other signs."""
    true = Rotation.from_euler("z", heading) * Rotation.from_matrix(drive.orientations())
    return replace(drive.evidence(), ups=Rotation.from_quat(true.as_quat()[:, order] * signs).as_matrix()[:, 2])


def readings(drive: Drive, ups: Array | None = None, frames: int = FRAMES) -> list[tuple[CameraMotion, Tilt]]:
    """Motion of the camera and tilt at each frame."""
    moved = motions(drive.cameras(frames), drive.stamps(frames))
    tilts = drive.ups(frames) if ups is None else ups
    return [(motion, Tilt(motion.stamp, up)) for motion, up in zip(moved, tilts, strict=True)]


def motions(cameras: list[Transform], stamps: list[int], segment: int = 1) -> list[CameraMotion]:
    """Exact motion of a camera since the first frame."""
    start = cameras[0].inverse()
    return [
        CameraMotion(stamp, segment, start.after(camera), np.eye(6) * 1e-9 * count, 100)
        for count, (stamp, camera) in enumerate(zip(stamps, cameras, strict=True))
    ]
