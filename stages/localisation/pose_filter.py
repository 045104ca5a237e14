"""PoseFilter: the rover's pose from its log, or else from visual odometry with gravity as a constraint.

Visual odometry is precise from frame to frame but drifts. The tilt is noisier but does not drift. A Kalman filter of
the six errors of a pose predicts with the images and corrects with the tilt. Heading and position have only the images,
so their covariance grows.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from flow.contracts import Finding, Severity, StageError, counted
from stages.cloud.level import level_transform
from stages.data import Array, CameraMotion, Mount, Pose, Tilt, Transform
from stages.data.covariance import translated_covariance
from stages.data.rotations import canonical, quaternion_of, turn_by
from stages.localisation.pose_check import PoseCheck
from stages.localisation.pose_gaps import gap_problem
from stages.stage import Stage, check_types, parameter

VISUAL_FRAME = "visual_odom"  # "visual_odom/2" after tracking was lost once
SCALE_ERROR = 0.005  # relative error common to all steps' lengths; half of it sideways
MIN_TILT_SIGMA = 1e-5  # rad
TURN_ERROR = float(np.deg2rad(0.015))  # rad per metre, common to all steps


@dataclass(frozen=True, eq=False)
class _Estimate:
    """The camera after a frame."""

    segment: int
    camera: Transform  # in the first camera of its segment, by the motion
    motion_covariance: Array  # (6, 6), of that
    world: Transform  # the camera in its segment's world, z up
    covariance: Array  # (6, 6), of position (m) and rotation (rad) about the world's axes
    distance: float  # m, driven in the segment


@dataclass
class PoseMemory:
    """The state of `PoseFilter`."""

    estimate: _Estimate | None = None
    poses: int = 0  # made here
    segment: int = 0  # of the last motion
    logged: Pose | None = None  # of the next frame, from a result log
    distance: float = 0.0  # m, driven up to there
    check: PoseCheck = field(default_factory=PoseCheck)


@dataclass(frozen=True)
class PoseFilter(Stage):
    """Passes the logged pose through, or estimates it from visual odometry and the tilt.

    Examples
    --------
    >>> motion = CameraMotion(0, 1, Transform("start", "camera", np.eye(3), np.zeros(3)), np.zeros((6, 6)))
    >>> pose_filter = PoseFilter()
    >>> pose = pose_filter(motion, Tilt(0, [0.0, -1.0, 0.0]), Mount(0, np.eye(3)), state=pose_filter.start())
    >>> pose.frame_id, pose.child_frame_id, pose.position.tolist()
    ('visual_odom', 'camera', [0.0, 0.0, 0.0])
    """

    tilt_noise: float = parameter(
        np.deg2rad(0.3),
        "standard deviation of a tilt of unknown sigma",
        unit="rad",
        low=1e-5,
        high=float(np.deg2rad(10)),
    )
    tilt_bias: float = parameter(
        np.deg2rad(0.1), "standard deviation of the error common to all tilts", unit="rad", low=0.0, high=0.2
    )

    def start(self) -> PoseMemory:
        """The state of one run."""
        return PoseMemory()

    def resumed(self, pose: Pose, distance: float) -> PoseMemory:
        """The state from which the next frame has a pose from a result log, `distance` m after its segment began."""
        return PoseMemory(logged=pose, distance=distance)

    def __call__(
        self, motion: CameraMotion, tilt: Tilt, mount: Mount, logged: Pose | None = None, *, state: PoseMemory
    ) -> Pose:
        """`logged` if it is connected; else the pose of base_link, or of the camera if base_link is unknown.

        Its frame is `visual_odom`: z up, with the origin and heading of the first frame. After tracking is lost a new
        frame begins, "visual_odom/2" and so on. Raises StageError if the images do not determine the motion.
        """
        check_types(self, motion=motion, tilt=tilt, mount=mount, logged=logged)
        state.segment = motion.segment
        if logged is not None:
            state.check.add(motion, logged, mount, mount.camera_from_inclinometer @ tilt.up)
            return logged
        if motion.camera is None:
            raise StageError(f"PoseFilter: no pose from the images: {motion.lost}")
        before = state.estimate
        bias = self._bias(tilt)
        if state.logged is not None and state.logged.stamp == motion.stamp:
            estimate = _logged(state.logged, motion, motion.camera, mount, state.distance, bias)
        elif before is None or before.segment != motion.segment:
            estimate = self._first(motion, motion.camera, tilt, mount)
        else:
            estimate = self._corrected(_predicted(before, motion, motion.camera), tilt, mount)
        state.estimate = estimate
        state.poses += 1
        return self._pose(motion.stamp, estimate, mount, bias)

    def finding(self, state: PoseMemory) -> Finding | None:
        """The source of the poses if it is not the log; a warning if tracking was lost or the log's poses are wrong."""
        problem = state.check.problem()
        if unseen := gap_problem(state.check.jumps):
            return Finding(" ".join(filter(None, (unseen, problem))), Severity.WARNING)
        if problem:
            return Finding(problem, Severity.WARNING, assumes="tilt")  # both use the mount of the camera
        losses = counted(state.segment - 1, "time")
        if state.estimate is None:
            if state.segment < 2:
                return None
            return Finding(f"Visual odometry lost track {losses}. The poses are those of the log.")
        source = f"Visual odometry supplies the pose ({counted(state.poses, 'pose')}"
        if state.segment < 2:
            return Finding(f"{source}, frame {VISUAL_FRAME}).")
        frames = f"{VISUAL_FRAME} {'and' if state.segment == 2 else 'to'} {_frame_of(state.segment)}"
        unaligned = f"{source}). It lost track {losses}: the poses are in {state.segment} unaligned frames, {frames}."
        return Finding(unaligned, Severity.WARNING)

    def _variance(self, tilt: Tilt) -> float:
        """Variance of a tilt about each horizontal axis, rad^2."""
        return max(self.tilt_noise if tilt.sigma is None else tilt.sigma, MIN_TILT_SIGMA) ** 2

    def _bias(self, tilt: Tilt) -> float:
        """Standard deviation, rad, of the error common to all tilts, and for a filtered one to its neighbours."""
        return float(np.hypot(self.tilt_bias, tilt.sigma or 0.0)) if tilt.filtered else self.tilt_bias

    def _first(self, motion: CameraMotion, camera: Transform, tilt: Tilt, mount: Mount) -> _Estimate:
        """The first frame of a segment: at its origin, upright by the tilt."""
        world = level_transform(tilt, mount, camera.child, camera_height=0.0)
        # The origin is base_link if it is known; then the tilt's error moves the camera.
        variance = self._variance(tilt)
        tilt_covariance = np.diag([0, 0, 0, variance, variance, 0])
        covariance = translated_covariance(tilt_covariance, world.translation)
        return _Estimate(motion.segment, camera, motion.covariance, world, covariance, 0.0)

    def _corrected(self, estimate: _Estimate, tilt: Tilt, mount: Mount) -> _Estimate:
        """The estimate corrected by the tilt, which measures the rotation about the two level axes."""
        world, covariance = estimate.world, estimate.covariance
        up = world.rotation @ mount.camera_from_inclinometer @ tilt.up
        gain = covariance[:, 3:5] @ np.linalg.inv(covariance[3:5, 3:5] + self._variance(tilt) * np.eye(2))
        change = gain @ np.array([up[1], -up[0]])  # the rotation that brings up to z
        turn = turn_by(change[3:])
        corrected = Transform(world.parent, world.child, turn @ world.rotation, world.translation + change[:3])
        return replace(estimate, world=corrected, covariance=covariance - gain @ covariance[3:5])

    def _pose(self, stamp: int, estimate: _Estimate, mount: Mount, bias: float) -> Pose:
        base = mount.base_from_camera
        rover = estimate.world if base is None else estimate.world.after(base.inverse())
        common = _common_errors(rover.translation, estimate.distance, bias)
        covariance = translated_covariance(estimate.covariance, rover.translation - estimate.world.translation)
        covariance = covariance + common.T @ common
        np.fill_diagonal(covariance, np.maximum(np.diag(covariance), 0.0))  # at the origin zero but for rounding
        quaternion = canonical(quaternion_of(rover.rotation))
        return Pose(stamp, rover.translation, quaternion, _frame_of(estimate.segment), rover.child, covariance)


def _logged(
    pose: Pose, motion: CameraMotion, camera: Transform, mount: Mount, distance: float, bias: float
) -> _Estimate:
    """The estimate of a frame that became this pose in a result log. distance, bias: of its common errors."""
    base = mount.base_from_camera
    world = pose.transform if base is None else pose.transform.after(base)
    errors = _common_errors(pose.position, distance, bias)
    own = np.zeros((6, 6)) if pose.covariance is None else pose.covariance - errors.T @ errors
    covariance = translated_covariance(own, world.translation - pose.position)
    return _Estimate(motion.segment, camera, motion.covariance, world, covariance, distance)


def _predicted(before: _Estimate, motion: CameraMotion, camera: Transform) -> _Estimate:
    """The estimate moved along by the images, with the covariance of the step added."""
    world = before.world.after(before.camera.inverse().after(camera))
    way = world.translation - before.world.translation
    # The motion's covariance gained since the frame before, in the axes of its segment's first camera.
    gained = motion.covariance - translated_covariance(
        before.motion_covariance, camera.translation - before.camera.translation
    )  # fmt: skip
    values, axes = np.linalg.eigh(gained)
    added = (axes * np.clip(values, 0, None)) @ axes.T  # two frames tracked from one keyframe may have common errors
    turned = np.kron(np.eye(2), world.rotation @ camera.rotation.T)
    covariance = translated_covariance(before.covariance, way) + turned @ added @ turned.T
    distance = before.distance + float(np.linalg.norm(way))
    return _Estimate(motion.segment, camera, motion.covariance, world, covariance, distance)


def _common_errors(position: Array, distance: float, bias: float) -> Array:
    """One standard deviation (5, 6) of position and rotation for each error common to all steps.

    Length, direction and rotation of the steps (a rotation bends the track by half of it), and up about two axes, by
    `bias`, rad.
    """
    x, y, z = position
    turned = TURN_ERROR * distance
    return np.array([
        [SCALE_ERROR * x, SCALE_ERROR * y, SCALE_ERROR * z, 0, 0, 0],
        [-SCALE_ERROR / 2 * y, SCALE_ERROR / 2 * x, 0, 0, 0, 0],
        [-turned / 2 * y, turned / 2 * x, 0, 0, 0, turned],
        [0, -bias * z, bias * y, bias, 0, 0],
        [bias * z, 0, -bias * x, 0, bias, 0],
    ])  # fmt: skip


def _frame_of(segment: int) -> str:
    return VISUAL_FRAME if segment < 2 else f"{VISUAL_FRAME}/{segment}"


def segment_of(frame_id: str) -> int | None:
    """The segment whose poses are in a frame of visual odometry; None for another frame."""
    name, _, number = frame_id.partition("/")
    return int(number or 1) if name == VISUAL_FRAME and (number or "1").isdecimal() else None
