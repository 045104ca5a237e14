"""Where things are and how they move: rigid transforms, tilts, poses, mounts, the camera's motion.

Part of the contract of `stages.data`, which has its conventions and all of its names; take them from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from flow.contracts import StageError
from stages.data.arrays import Array, check_rotation, publish_stamp, publish_vector
from stages.data.covariance import levered


@dataclass(frozen=True, eq=False)
class Transform:
    """A rigid transform: a point p of frame `child` is `rotation @ p + translation` in frame `parent`.

    rotation: (3, 3) float64, orthonormal; translation: (3,) float64, metres.
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
        """Points (N, 3) of `child`, m, expressed in `parent`."""
        return np.asarray(points) @ self.rotation.T + self.translation

    def inverse(self) -> Transform:
        """The transform from `parent` to `child`."""
        return Transform(self.child, self.parent, self.rotation.T, -self.rotation.T @ self.translation)

    def after(self, first: Transform) -> Transform:
        """The transform that applies `first`, then this one."""
        return Transform(self.parent, first.child, self.rotation @ first.rotation, self(first.translation))


@dataclass(frozen=True, eq=False)
class Tilt:
    """Where up is. up: (3,) float64 unit vector, gravity's opposite, in the inclinometer's frame `frame_id`."""

    stamp: int
    up: Array
    frame_id: str = "inclinometer"

    def __post_init__(self) -> None:
        publish_stamp(self)
        publish_vector(self, "up", (3,))
        if not abs(float(np.linalg.norm(self.up)) - 1.0) < 1e-6:
            raise StageError(f"Tilt.up must be a unit vector, not {self.up.tolist()}")

    def interpolated(self, later: Tilt, stamp: int) -> Tilt:
        """The tilt at `stamp`, ns, between this one and a later one, along the great circle."""
        return Tilt(stamp, _slerp(self.up, later.up, _share(self.stamp, later.stamp, stamp)), self.frame_id)

    @staticmethod
    def smoothed(samples: Sequence[Tilt], stamp: int) -> Tilt:
        """The tilt at `stamp`, ns, by the straight line, in time, that fits three samples about it or more."""
        seconds = (np.array([sample.stamp for sample in samples]) - stamp) / 1e9
        line = np.column_stack([np.ones_like(seconds), seconds])
        up = np.linalg.lstsq(line, np.array([sample.up for sample in samples]), rcond=None)[0][0]
        length = float(np.linalg.norm(up))
        if not length > 0.5:
            raise StageError("Tilt.smoothed: the samples point all ways")
        return Tilt(stamp, up / length, samples[0].frame_id)


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of frame `child_frame_id` in frame `frame_id`.

    position: (3,) float64, m; quaternion: (4,) float64, xyzw, unit; covariance: (6, 6) float64 of position (m) and of a
    turn (rad) about the fixed axes, or None.
    """

    stamp: int
    position: Array
    quaternion: Array
    frame_id: str
    child_frame_id: str
    covariance: Array | None = None

    def __post_init__(self) -> None:
        publish_stamp(self)
        publish_vector(self, "position", (3,))
        publish_vector(self, "quaternion", (4,))
        if self.covariance is not None:
            publish_vector(self, "covariance", (6, 6), finite=False)
        if not abs(float(np.linalg.norm(self.quaternion)) - 1.0) < 1e-3:
            raise StageError(f"Pose.quaternion must be a unit quaternion, not {self.quaternion.tolist()}")

    def interpolated(self, later: Pose, stamp: int) -> Pose:
        """The pose at `stamp`, ns, between this one and a later one in the same frames; the earlier covariance is
        kept."""
        if (self.frame_id, self.child_frame_id) != (later.frame_id, later.child_frame_id):
            raise StageError(
                f"the pose of '{self.child_frame_id}' in '{self.frame_id}' is followed by one of "
                f"'{later.child_frame_id}' in '{later.frame_id}'; nothing lies between two frames"
            )
        share = _share(self.stamp, later.stamp, stamp)
        position = (1 - share) * self.position + share * later.position
        near = later.quaternion if self.quaternion @ later.quaternion >= 0 else -later.quaternion
        return replace(self, stamp=stamp, position=position, quaternion=_slerp(self.quaternion, near, share))

    @property
    def placed(self) -> Transform:
        """Frame `child_frame_id` in frame `frame_id`."""
        rotation = Rotation.from_quat(self.quaternion).as_matrix()
        return Transform(self.frame_id, self.child_frame_id, rotation, self.position)

    def of(self, part: Transform) -> Pose:
        """The pose of another frame, `part.child`, that sits on this one, `part.parent`, as `part` tells."""
        turn = Rotation.from_quat(self.quaternion)
        way = turn.as_matrix() @ part.translation
        covariance = None if self.covariance is None else levered(self.covariance, way)
        quaternion = (turn * Rotation.from_matrix(part.rotation)).as_quat()
        return Pose(self.stamp, self.position + way, quaternion, self.frame_id, part.child, covariance)


@dataclass(frozen=True, eq=False)
class Mount:
    """How the camera sits on the rover.

    camera_from_inclinometer: (3, 3) float64 rotation; base_from_camera: the left camera in the rover's base frame
    (x forward, y left, z up), or None where the log does not say.
    """

    stamp: int
    camera_from_inclinometer: Array
    base_from_camera: Transform | None = None

    def __post_init__(self) -> None:
        publish_stamp(self)
        publish_vector(self, "camera_from_inclinometer", (3, 3))
        check_rotation(self.camera_from_inclinometer, "Mount.camera_from_inclinometer")

    def camera_on(self, part: str, camera: str) -> Transform | None:
        """The frame `camera` in the frame `part` of the rover; None where that is neither the camera nor the base."""
        if part == camera:
            return Transform(camera, camera, np.eye(3), np.zeros(3))
        base = self.base_from_camera
        return base if base is not None and base.parent == part else None


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """How the camera moved, by the images alone: nothing but they constrains it, gravity neither.

    camera: the camera in the camera of the frame that began its segment, None where the images do not tell; segment:
    counts from 1, 0 before anything was seen; a new one begins wherever tracking was lost, and nothing ties it to the
    one before; covariance: (6, 6) of `camera`, of position (m) and of a turn (rad) about the fixed axes, which grows
    from step to step; inliers: features that agree on the last step; lost: what to say where tracking was lost at this
    frame, else empty.
    """

    stamp: int
    segment: int
    camera: Transform | None
    covariance: Array
    inliers: int = 0
    lost: str = ""

    def __post_init__(self) -> None:
        publish_stamp(self)
        publish_vector(self, "covariance", (6, 6))


@dataclass(frozen=True, eq=False)
class TiltHealth:
    """Whether the tilt can be believed, judged by the camera and the ground it sees.

    turn: rad, between the tilt and the one before carried along by the camera's motion; ground: rad, between up and the
    upward normal of the ground in view; both NaN where unknown. frames: how many frames the judgement rests on. fault:
    what is wrong, in a word or two, empty where nothing is or nothing can be told; judgement: a sentence.
    """

    stamp: int
    turn: float
    ground: float
    frames: int
    fault: str
    judgement: str

    def __post_init__(self) -> None:
        publish_stamp(self)


def _share(first: int, last: int, stamp: int) -> float:
    """How far `stamp` is on the way from one stamp to the other, 0 to 1."""
    if not first <= stamp <= last:
        raise StageError(f"stamp {stamp} is outside [{first}, {last}]")
    return (stamp - first) / (last - first) if last > first else 0.0


def _slerp(start: Array, end: Array, share: float) -> Array:
    """The unit vector at this share of the great circle between two, (n,) each."""
    angle = float(np.arctan2(np.linalg.norm(end - start), np.linalg.norm(end + start))) * 2
    if angle < 1e-9:
        return start
    if angle > np.pi - 1e-6:
        raise StageError("cannot interpolate between opposite directions")
    return (np.sin((1 - share) * angle) * start + np.sin(share * angle) * end) / np.sin(angle)  # type: ignore[no-any-return]
