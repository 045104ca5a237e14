"""Is the logged pose one of this drive? Its steps are held against those that the images tell.

Neither is exact: wheels slip, and visual odometry drifts. But a pose that stands still while the ground goes by, that
looks another way than it moves, or that jumps, is off by as much as the steps themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stages.data import Array, CameraMotion, Mount, Pose, Transform

LEAST_STEPS = 5
LEAST_STEP = 0.02  # m; of shorter ones noise is a large part
UNLIKE = 0.3  # of a step, beyond which the two do not tell of one drive
JUMP = 0.5  # m, and
WILD = 10.0  # times the usual difference, beyond which one is a jump


@dataclass
class PoseCheck:
    """What has been seen so far. last: segment, pose's frame, and the camera by images and by pose, of the frame
    before; steps: (3,) each, m: by the images, by the pose, how far apart."""

    last: tuple[int, str, Transform, Transform] | None = None
    steps: list[Array] = field(default_factory=list)

    def add(self, motion: CameraMotion, pose: Pose, mount: Mount) -> None:
        """Take note of a frame."""
        seat = None if motion.camera is None else mount.camera_in(pose.child_frame_id, motion.camera.child)
        if motion.camera is None or seat is None:
            self.last = None
            return
        now = motion.segment, pose.frame_id, motion.camera, pose.transform.after(seat)
        if self.last is not None and self.last[:2] == now[:2]:
            seen, told = (_step(before, after) for before, after in zip(self.last[2:], now[2:], strict=True))
            self.steps.append(np.linalg.norm([seen, told, seen - told], axis=1))
        self.last = now

    def doubt(self) -> str:
        """What is wrong with the poses, in a sentence; empty where nothing is or too little is known."""
        if len(self.steps) < LEAST_STEPS:
            return ""
        seen, told, apart = np.array(self.steps).T
        usual = float(np.median(apart))
        step = max(float(np.median(seen)), float(np.median(told)))
        if step > LEAST_STEP and usual > UNLIKE * step:
            return (
                f"the logged pose does not move as the images tell: steps of {np.median(told):.2f} m for theirs of "
                f"{np.median(seen):.2f} m, {usual:.2f} m apart (medians of {len(apart)}); check its frame, its heading "
                "and its unit, or leave it out, and visual odometry supplies one"
            )
        jumps = apart[(apart > JUMP) & (apart > WILD * usual)]
        if len(jumps):
            times = "once" if len(jumps) == 1 else f"{len(jumps)} times"
            return f"the logged pose jumps {times} against the images, by up to {jumps.max():.1f} m"
        return ""


def _step(before: Transform, after: Transform) -> Array:
    """How the camera moved (3,), m, in its own axes before."""
    step: Array = before.rotation.T @ (after.translation - before.translation)
    return step
