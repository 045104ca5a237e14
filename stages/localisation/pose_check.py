"""Compares the steps of the logged pose with those of visual odometry.

Neither is exact: wheels slip, and visual odometry drifts. But a pose that stands still while the images move, that has
a wrong heading, or that jumps, differs by as much as the steps themselves. If most steps are longer by the images, the
scale of the stereo camera or of the odometry is wrong. Slip does the opposite: then the logged steps are longer.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flow.contracts import counted
from stages.data import Array, CameraMotion, Mount, Pose, Transform

MIN_STEPS = 5
MIN_STEP = 0.02  # m; shorter steps are mostly noise
MAX_DIFFERENCE_SHARE = 0.3  # of a step
MAX_SCALE_ERROR = 0.05  # share by which three of four steps may be longer by the images than in the log
MAX_SCALE = 3.0  # of the images' steps over logged ones; beyond it the logged pose stands still
MIN_SCALED_STEPS = 10  # for a comparison of the scales
MIN_JUMP = 0.5  # m, and
MIN_JUMP_RATIO = 10.0  # over the median difference


@dataclass
class PoseCheck:
    """The steps so far."""

    last: tuple[int, str, Transform, Transform] | None = None  # segment, pose's frame, camera by images and by pose
    steps: list[Array] = field(default_factory=list)  # (3,) each, m: by the images, by the pose, their difference

    def add(self, motion: CameraMotion, pose: Pose, mount: Mount) -> None:
        """Add a frame."""
        camera = None if motion.camera is None else mount.camera_in(pose.child_frame_id, motion.camera.child)
        if motion.camera is None or camera is None:
            self.last = None
            return
        now = motion.segment, pose.frame_id, motion.camera, pose.transform.after(camera)
        if self.last is not None and self.last[:2] == now[:2]:
            visual, logged = (_step(before, after) for before, after in zip(self.last[2:], now[2:], strict=True))
            self.steps.append(np.linalg.norm([visual, logged, visual - logged], axis=1))
        self.last = now

    def problem(self) -> str:
        """What is wrong with the poses, in a sentence; empty if nothing is or too little is known."""
        if len(self.steps) < MIN_STEPS:
            return ""
        visual, logged, difference = np.array(self.steps).T
        if scale := _scale_problem(visual, logged):
            return scale
        usual = float(np.median(difference))
        step = max(float(np.median(visual)), float(np.median(logged)))
        if step > MIN_STEP and usual > MAX_DIFFERENCE_SHARE * step:
            return (
                f"Logged odometry disagrees with visual odometry: median step {np.median(logged):.2f} m vs "
                f"{np.median(visual):.2f} m, difference {usual:.2f} m ({len(difference)} steps). Check its frame, its "
                "heading and its unit, or set source.odometry to visual: visual odometry then supplies the pose."
            )
        jumps = difference[(difference > MIN_JUMP) & (difference > MIN_JUMP_RATIO * usual)]
        if len(jumps):
            times = counted(len(jumps), "time")
            return f"Logged odometry jumps {times} relative to visual odometry, by up to {jumps.max():.1f} m."
        return ""


def _scale_problem(visual: Array, logged: Array) -> str:
    """What makes most steps of the images, m, longer than the logged ones; empty if they are not."""
    shares = visual[logged > MIN_STEP] / logged[logged > MIN_STEP]
    if len(shares) < MIN_SCALED_STEPS or not 1 + MAX_SCALE_ERROR <= np.quantile(shares, 0.25) <= MAX_SCALE:
        return ""
    return (
        f"Steps of visual odometry are {100 * (np.median(shares) - 1):.0f} % longer than those of the logged odometry "
        f"({len(shares)} steps), which slip does not explain. The baseline or the focal length is too large, and all "
        "distances with it, or the odometry's scale is too small."
    )


def _step(before: Transform, after: Transform) -> Array:
    """The camera's motion (3,), m, in its own axes before."""
    step: Array = before.rotation.T @ (after.translation - before.translation)
    return step
