"""Frames and motion: rigid transforms, tilts, poses, mounts, the camera's motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from flow.contracts import StageError
from stages.data.arrays import Array, check_rotation, publish_plain, publish_vector
from stages.data.covariance import translated_covariance
from stages.data.rotations import matrix_of, product, quaternion_of, unit


@dataclass(frozen=True, eq=False)
class Transform:
    """A rigid transform: a point p of frame `child` is `rotation @ p + translation` in frame `parent`.

    Parameters
    ----------
    rotation : (3, 3) float64
        Orthonormal and right-handed.
    translation : (3,) float64
        Metres.

    Examples
    --------
    >>> mast = Transform("base_link", "camera", np.eye(3), [0.5, 0.0, 1.2])
    >>> mast([[0.0, 0.0, 1.0]]).tolist()
    [[0.5, 0.0, 2.2]]
    >>> mast.inverse().after(mast).translation.tolist()
    [0.0, 0.0, 0.0]
    """

    parent: str
    child: str
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        publish_vector(self, "rotation", (3, 3))
        publish_vector(self, "translation", (3,))
        check_rotation(self.rotation, f"Transform {self.parent} <- {self.child}: rotation")

    def __call__(self, points: ArrayLike) -> Array:
        """Points (N, 3) of `child`, m, in `parent`."""
        return np.asarray(points) @ self.rotation.T + self.translation

    def inverse(self) -> Transform:
        """The transform from `parent` to `child`."""
        return Transform(self.child, self.parent, self.rotation.T, -self.rotation.T @ self.translation)

    def after(self, first: Transform) -> Transform:
        """The transform that applies `first`, then this one."""
        return Transform(self.parent, first.child, self.rotation @ first.rotation, self(first.translation))


@dataclass(frozen=True, eq=False)
class Tilt:
    """The up direction, as the inclinometer measures it.

    Parameters
    ----------
    up : (3,) float64
        Unit vector against gravity, in the inclinometer's frame `frame_id`.
    sigma : float, optional
        Standard deviation, rad, about each horizontal axis; None if unknown.
    filtered : bool
        Whether a filter estimated it. Its neighbours then have the same error, and smoothing does not reduce it.

    Examples
    --------
    >>> level, nose_up = Tilt(0, [0.0, 0.0, 1.0]), Tilt(10, [np.sin(0.2), 0.0, np.cos(0.2)])
    >>> float(np.arcsin(level.interpolated(nose_up, 5).up[0]).round(6))
    0.1
    """

    stamp: int
    up: Array
    frame_id: str = "inclinometer"
    sigma: float | None = None
    filtered: bool = False

    def __post_init__(self) -> None:
        publish_plain(self)
        publish_vector(self, "up", (3,))
        if self.sigma is not None and not 0 <= self.sigma < np.inf:
            raise StageError(f"Tilt.sigma must be at least 0 and finite, not {self.sigma}")
        if not abs(math.hypot(*self.up) - 1.0) < 1e-6:
            raise StageError(f"Tilt.up must be a unit vector, not {self.up.tolist()}")

    def with_sigma(self, sigma: float) -> Tilt:
        """The same direction with another sigma, rad. It is not checked again: an Imu gives hundreds per second."""
        made = copy(self)
        object.__setattr__(made, "sigma", sigma)
        return made

    def interpolated(self, later: Tilt, stamp: int) -> Tilt:
        """The tilt at `stamp`, ns, between this one and a later one, along the great circle."""
        share = _fraction(self.stamp, later.stamp, stamp)
        sigma = _sigma_of([self, later], np.array([1 - share, share]))
        return Tilt(stamp, _slerp(self.up, later.up, share), self.frame_id, sigma, self.filtered)

    @staticmethod
    def smoothed(samples: Sequence[Tilt], stamp: int) -> Tilt:
        """The tilt at `stamp`, ns, on the line fitted over time to three or more samples around it.

        Samples of a filter are smooth already, so the tilt is interpolated between two of them.
        """
        if not samples:
            raise StageError("Tilt.smoothed: there are no samples")
        if samples[0].filtered:
            for sample, later in pairwise(samples):
                if later.stamp >= stamp:
                    return sample.interpolated(later, stamp)
            raise StageError(f"Tilt.smoothed: no two samples lie around {stamp} ns")
        seconds = (np.array([sample.stamp for sample in samples]) - stamp) / 1e9
        line = np.column_stack([np.ones_like(seconds), seconds])
        weights = np.linalg.pinv(line)[0]
        up = weights @ np.array([sample.up for sample in samples])
        length = float(np.linalg.norm(up))
        if not length > 0.5:
            raise StageError("Tilt.smoothed: the samples have no common direction")
        return Tilt(stamp, up / length, samples[0].frame_id, _sigma_of(samples, weights))


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of frame `child_frame_id` in frame `frame_id`.

    Parameters
    ----------
    position : (3,) float64
        Metres.
    quaternion : (4,) float64
        Unit quaternion x, y, z, w.
    covariance : (6, 6) float64, optional
        Of position (m) and rotation (rad) about the fixed axes.

    Examples
    --------
    >>> start = Pose(0, [0, 0, 0], [0, 0, 0, 1], "odom", "base_link")
    >>> start.interpolated(Pose(4, [8, 0, 0], [0, 0, 0, 1], "odom", "base_link"), 1).position.tolist()
    [2.0, 0.0, 0.0]
    """

    stamp: int
    position: Array
    quaternion: Array
    frame_id: str
    child_frame_id: str
    covariance: Array | None = None

    def __post_init__(self) -> None:
        publish_plain(self)
        publish_vector(self, "position", (3,))
        publish_vector(self, "quaternion", (4,))
        if self.covariance is not None:
            publish_vector(self, "covariance", (6, 6), finite=False)
        if not abs(float(np.linalg.norm(self.quaternion)) - 1.0) < 1e-3:
            raise StageError(f"Pose.quaternion must be a unit quaternion, not {self.quaternion.tolist()}")

    def distance_to(self, other: Pose) -> float:
        """The distance of the two positions, m; infinite where their frames differ."""
        if self.frame_id != other.frame_id:
            return math.inf
        return float(np.linalg.norm(self.position - other.position))

    def interpolated(self, later: Pose, stamp: int) -> Pose:
        """The pose at `stamp`, ns, between this one and a later one of the same frames, with this covariance."""
        if (self.frame_id, self.child_frame_id) != (later.frame_id, later.child_frame_id):
            raise StageError(
                f"cannot interpolate from the pose of '{self.child_frame_id}' in '{self.frame_id}' to the pose of "
                f"'{later.child_frame_id}' in '{later.frame_id}': the frames differ"
            )
        share = _fraction(self.stamp, later.stamp, stamp)
        position = (1 - share) * self.position + share * later.position
        near = later.quaternion if self.quaternion @ later.quaternion >= 0 else -later.quaternion
        return replace(self, stamp=stamp, position=position, quaternion=_slerp(self.quaternion, near, share))

    @property
    def transform(self) -> Transform:
        """The transform from `child_frame_id` to `frame_id`."""
        return Transform(self.frame_id, self.child_frame_id, matrix_of(self.quaternion), self.position)

    def of(self, part: Transform) -> Pose:
        """The pose of `part.child`, a frame fixed to this one, `part.parent`."""
        offset = matrix_of(self.quaternion) @ part.translation
        covariance = None if self.covariance is None else translated_covariance(self.covariance, offset)
        quaternion = product(unit(self.quaternion), quaternion_of(part.rotation))
        return Pose(self.stamp, self.position + offset, quaternion, self.frame_id, part.child, covariance)


@dataclass(frozen=True, eq=False)
class Mount:
    """How the camera and the inclinometer are mounted on the rover.

    Parameters
    ----------
    camera_from_inclinometer : (3, 3) float64
        Rotation from the inclinometer's frame to the rectified left camera's.
    base_from_camera : Transform, optional
        The left camera in the rover's base frame (x forward, y left, z up), if the log contains it.

    Examples
    --------
    >>> Mount(0, np.eye(3)).camera_in("camera", "camera").translation.tolist()
    [0.0, 0.0, 0.0]
    """

    stamp: int
    camera_from_inclinometer: Array
    base_from_camera: Transform | None = None

    def __post_init__(self) -> None:
        publish_plain(self)
        publish_vector(self, "camera_from_inclinometer", (3, 3))
        check_rotation(self.camera_from_inclinometer, "Mount.camera_from_inclinometer")

    def camera_in(self, frame: str, camera: str) -> Transform | None:
        """The frame `camera` in a frame of the rover; None unless that is the camera or the base."""
        if frame == camera:
            return Transform(camera, camera, np.eye(3), np.zeros(3))
        base = self.base_from_camera
        return base if base is not None and base.parent == frame else None


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """The camera's motion by visual odometry alone, without gravity.

    Parameters
    ----------
    segment : int
        Number of the track, from 1; 0 before the first usable frame. A new one begins where tracking is lost.
    camera : Transform or None
        Pose of the camera in the first camera of its segment; None if this frame cannot be tracked.
    covariance : (6, 6) float64
        Of `camera`: position (m) and rotation (rad) about the fixed axes. It grows along the segment.
    inliers : int
        Features that agree on the last step.
    lost : str
        Why tracking was lost at this frame, else empty.
    """

    stamp: int
    segment: int
    camera: Transform | None
    covariance: Array
    inliers: int = 0
    lost: str = ""

    def __post_init__(self) -> None:
        publish_plain(self)
        publish_vector(self, "covariance", (6, 6))


@dataclass(frozen=True, eq=False)
class TiltHealth:
    """Whether the tilt agrees with the camera's rotation and the ground in view.

    Parameters
    ----------
    turn : float
        Angle, rad, between the tilt and the previous tilt rotated by the camera's motion; NaN if unknown.
    ground : float
        Angle, rad, between up and the normal of the ground in view; NaN if unknown.
    frames : int
        Number of frames behind the judgement.
    fault : str
        Short name of the fault; empty if none is found.
    judgement : str
        One sentence.
    """

    stamp: int
    turn: float
    ground: float
    frames: int
    fault: str
    judgement: str

    def __post_init__(self) -> None:
        publish_plain(self)


def _fraction(first: int, last: int, stamp: int) -> float:
    """Position of `stamp` between two stamps, 0 to 1."""
    if not first <= stamp <= last:
        raise StageError(f"stamp {stamp} is outside [{first}, {last}]")
    return (stamp - first) / (last - first) if last > first else 0.0


def _sigma_of(tilts: Sequence[Tilt], weights: Array) -> float | None:
    """Standard deviation, rad, of a weighted sum of tilts; None if one of them is unknown.

    The errors are independent, but for those of a filter, which neighbours share.
    """
    sigmas = [tilt.sigma for tilt in tilts]
    if None in sigmas:
        return None
    weighted = weights * np.array(sigmas, np.float64)
    return float(weighted.sum() if tilts[0].filtered else np.linalg.norm(weighted))


def _slerp(start: Array, end: Array, share: float) -> Array:
    """Spherical linear interpolation between two unit vectors (n,)."""
    angle = float(np.arctan2(np.linalg.norm(end - start), np.linalg.norm(end + start))) * 2
    if angle < 1e-9:
        return start
    if angle > np.pi - 1e-6:
        raise StageError("cannot interpolate between opposite directions")
    return (np.sin((1 - share) * angle) * start + np.sin(share * angle) * end) / np.sin(angle)  # type: ignore[no-any-return]
