"""PoseFilter: the rover's pose as its log tells it, or else by visual odometry with gravity as a constraint.

The images turn and move the camera from frame to frame, the tilt says where up is. A tilt of some tenths of a degree is
noisier than a step of the images, but it does not drift: so the pose is carried along by the images and drawn towards
the tilt by as much as their variances say (a Kalman filter of the six errors of a pose). Heading and position have
nothing but the images to go by, and their covariance grows.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from flow.contracts import Finding, Severity, StageError, counted
from stages.cloud.level import level_transform
from stages.data import Array, CameraMotion, Mount, Pose, Tilt, Transform
from stages.data.covariance import translated_covariance
from stages.localisation.pose_check import PoseCheck
from stages.stage import Stage, parameter

VISUAL_FRAME = "visual_odom"  # the label of poses made here; "visual_odom/2" after tracking was lost once


@dataclass(frozen=True, eq=False)
class _Estimate:
    """What is known of the camera after a frame.

    segment, camera, told: as the motion tells, the camera in its segment's first and the covariance (6, 6) of that;
    world: the camera in its segment's world (z up); covariance: (6, 6) of that, of position (m) and turn (rad) about
    the world's axes; way: m driven in the segment.
    """

    segment: int
    camera: Transform
    told: Array
    world: Transform
    covariance: Array
    way: float


@dataclass
class PoseMemory:
    """The estimate after the last frame, how many poses were made, the last segment of the motion, and the check of the
    logged poses."""

    estimate: _Estimate | None = None
    visual: int = 0
    segment: int = 0
    check: PoseCheck = field(default_factory=PoseCheck)


@dataclass(frozen=True)
class PoseFilter(Stage):
    """Where the rover is; it remembers, so it takes frames in order."""

    tilt_noise: float = parameter(
        np.deg2rad(0.3), "standard deviation of a tilt", unit="rad", low=1e-5, high=float(np.deg2rad(10))
    )
    tilt_bias: float = parameter(
        np.deg2rad(0.1), "error of all tilts alike, which no filter lowers", unit="rad", low=0.0, high=0.2
    )
    scale_error: float = parameter(0.005, "error of all steps' length alike, as a share; half of it sideways", low=0.0)
    turn_error: float = parameter(
        np.deg2rad(0.015), "error of all steps' turn alike, per metre of way", unit="rad", low=0.0, high=0.1
    )

    def start(self) -> PoseMemory:
        """The memory of one run, empty."""
        return PoseMemory()

    def __call__(
        self, motion: CameraMotion, tilt: Tilt, mount: Mount, logged: Pose | None = None, *, state: PoseMemory
    ) -> Pose:
        """`logged` where it is connected; else the pose of base_link, or of the camera where base_link is unknown.

        Its frame is `visual_odom`: z up, origin and heading those of the first frame, and "visual_odom/2" and so on for
        what came after tracking was lost. Raises ValueError where the images do not tell the motion.
        """
        state.segment = motion.segment
        if logged is not None:
            state.check.add(motion, logged, mount)
            return logged
        if motion.camera is None:
            raise StageError(f"PoseFilter: no pose can be told from the images: {motion.lost}")
        before = state.estimate
        if before is None or before.segment != motion.segment:
            estimate = self._begun(motion, motion.camera, tilt, mount)
        else:
            estimate = self._drawn(_carried(before, motion, motion.camera), tilt, mount)
        state.estimate = estimate
        state.visual += 1
        return self._pose(motion.stamp, estimate, mount)

    def finding(self, state: PoseMemory) -> Finding | None:
        """Where poses come from, if not from the log, and how often tracking was lost: a warning where that parts them,
        and where those of the log do not fit the images; None where they are given and do."""
        if doubt := state.check.doubt():
            return Finding(doubt, Severity.WARNING)
        lost = "tracking was lost " + ("once" if state.segment == 2 else f"{state.segment - 1} times")
        if state.estimate is None:
            return Finding(f"{lost} by visual odometry; the poses are the log's own") if state.segment > 1 else None
        said = f"no pose is given: visual odometry supplies it ({counted(state.visual, 'pose')})"
        if state.segment < 2:
            return Finding(f"{said}, in frame {VISUAL_FRAME}")
        frames = f"{VISUAL_FRAME} {'and' if state.segment == 2 else 'to'} {_frame_of(state.segment)}"
        parted = f"{said}; {lost}, so they are in {state.segment} frames, {frames}, that nothing joins"
        return Finding(parted, Severity.WARNING)

    def _begun(self, motion: CameraMotion, camera: Transform, tilt: Tilt, mount: Mount) -> _Estimate:
        """The first frame of a segment: at its origin, upright by the tilt."""
        world = level_transform(tilt, mount, camera.child, camera_height=0.0)
        # About the origin, which is base_link where that is known, the tilt's error moves the camera as well.
        covariance = translated_covariance(
            np.diag([0, 0, 0, self.tilt_noise**2, self.tilt_noise**2, 0]), world.translation
        )
        return _Estimate(motion.segment, camera, motion.covariance, world, covariance, 0.0)

    def _drawn(self, estimate: _Estimate, tilt: Tilt, mount: Mount) -> _Estimate:
        """The estimate corrected by the tilt, which measures the turns about the two level axes."""
        world, covariance = estimate.world, estimate.covariance
        up = world.rotation @ mount.camera_from_inclinometer @ tilt.up
        gain = covariance[:, 3:5] @ np.linalg.inv(covariance[3:5, 3:5] + self.tilt_noise**2 * np.eye(2))
        change = gain @ np.array([up[1], -up[0]])  # the turn that brings up to z
        turn = np.asarray(Rotation.from_rotvec(change[3:]).as_matrix())
        drawn = Transform(world.parent, world.child, turn @ world.rotation, world.translation + change[:3])
        return replace(estimate, world=drawn, covariance=covariance - gain @ covariance[3:5])

    def _pose(self, stamp: int, estimate: _Estimate, mount: Mount) -> Pose:
        base = mount.base_from_camera
        placed = estimate.world if base is None else estimate.world.after(base.inverse())
        alike = self._alike(placed.translation, estimate.way)
        covariance = (
            translated_covariance(estimate.covariance, placed.translation - estimate.world.translation)
            + alike.T @ alike
        )
        np.fill_diagonal(covariance, np.maximum(np.diag(covariance), 0.0))  # the origin's is zero but for rounding
        return Pose(
            stamp, placed.translation, Rotation.from_matrix(placed.rotation).as_quat(canonical=True),
            _frame_of(estimate.segment), placed.child, covariance,
        )  # fmt: skip

    def _alike(self, place: Array, way: float) -> Array:
        """The errors (5, 6) of position and turn, one standard deviation each, that are the same in all steps: of their
        length, of their direction, of their turn (which bends the way by half of it), and of up about two axes."""
        x, y, z = place
        turned, bias = self.turn_error * way, self.tilt_bias
        return np.array([
            [self.scale_error * x, self.scale_error * y, self.scale_error * z, 0, 0, 0],
            [-self.scale_error / 2 * y, self.scale_error / 2 * x, 0, 0, 0, 0],
            [-turned / 2 * y, turned / 2 * x, 0, 0, 0, turned],
            [0, -bias * z, bias * y, bias, 0, 0],
            [bias * z, 0, -bias * x, 0, bias, 0],
        ])  # fmt: skip


def _carried(before: _Estimate, motion: CameraMotion, camera: Transform) -> _Estimate:
    """The estimate carried along by the images: the way levers the turns' errors, and the step adds its own."""
    world = before.world.after(before.camera.inverse().after(camera))
    way = world.translation - before.world.translation
    # What the motion's covariance, in the axes of its segment's first camera, has gained since the frame before.
    step = motion.covariance - translated_covariance(before.told, camera.translation - before.camera.translation)
    values, axes = np.linalg.eigh(step)
    added = (axes * np.clip(values, 0, None)) @ axes.T  # two frames tracked from one keyframe may err the same way
    turned = np.kron(np.eye(2), world.rotation @ camera.rotation.T)
    covariance = translated_covariance(before.covariance, way) + turned @ added @ turned.T
    driven = before.way + float(np.linalg.norm(way))
    return _Estimate(motion.segment, camera, motion.covariance, world, covariance, driven)


def _frame_of(segment: int) -> str:
    return VISUAL_FRAME if segment < 2 else f"{VISUAL_FRAME}/{segment}"
