"""Visual odometry: the camera's own motion from one stereo frame to the next (see `tracking`).

Each frame is tracked from a keyframe, which stays as long as it shares enough with what is seen: a rover that stands
still does not drift. Where tracking is lost, as when the images change their size, a new segment begins, and says so;
poses of different segments have nothing to do with each other, and nothing is made up to join them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding
from stages.data import Array, CameraMotion, Disparity, StereoFrame, Transform
from stages.data.covariance import cross_matrix, translated_covariance
from stages.localisation.vo_tracking import Step, VoFrame, step_between, view
from stages.stage import Stage, check_joined, parameter


@dataclass
class _Keyframe:
    view: VoFrame
    camera: Transform
    covariance: Array


@dataclass
class OdometryMemory:
    """The keyframe, the number of the segment, and how many frames showed too little to track."""

    keyframe: _Keyframe | None = None
    segment: int = 0  # 1 from the first frame on that shows something
    blind: int = 0


@dataclass(frozen=True)
class VisualOdometry(Stage):
    """Tracks the camera through the frames; it remembers, so it takes them in order."""

    min_features: int = parameter(40, "features that must agree on a motion", low=6)
    max_rms: float = parameter(2.0, "root mean square reprojection error beyond which they do not", unit="px", low=0.1)
    max_motion: float = parameter(
        5.0, "a motion between two frames beyond it is taken for a mistake", unit="m", low=0.0
    )
    max_keyframe_flow: float = parameter(
        0.03, "a keyframe stays while features move less, in widths of the image", low=0.0
    )
    min_keyframe_share: float = parameter(
        0.5, "and while this share of its features is still tracked", low=0.0, high=1.0
    )

    def start(self) -> OdometryMemory:
        """The memory of one run, empty."""
        return OdometryMemory()

    def __call__(self, frame: StereoFrame, disparity: Disparity, *, state: OdometryMemory) -> CameraMotion:
        """The camera's motion since its segment began; without `camera` where the frame shows too little to track."""
        check_joined(self, frame, disparity)
        before, seen = state.keyframe, view(frame, disparity)
        step = step_between(before.view, seen, self.min_features) if before is not None else None
        if before is not None and step is not None and self._likely(step):
            return self._followed(frame.stamp, before, step, seen, state)
        # What all is counted from needs no more than to show something: it may be the only frame.
        if seen.known < (1 if before is None else self.min_features):
            return self._blind(frame.stamp, seen, state)
        lost = self._parted(before.view, seen, state.segment + 1) if before is not None else ""
        return _begun(frame, seen, lost, state)

    def finding(self, state: OdometryMemory) -> Finding | None:
        """How many frames show too little; None where all show enough. That tracking was lost is for PoseFilter to
        tell, which knows what that does to the poses."""
        blind = state.blind
        shows = "frame shows" if blind == 1 else "frames show"
        return Finding(f"{blind} {shows} too little to track") if blind else None

    def _likely(self, step: Step) -> bool:
        return step.error <= self.max_rms and float(np.linalg.norm(step.translation)) <= self.max_motion

    def _parted(self, before: VoFrame, seen: VoFrame, segment: int) -> str:
        """Why the segment ends."""
        sizes = [f"{width}x{height}" for height, width in (before.gray.shape, seen.gray.shape)]
        why = f"less than {self.min_features} features agree with the frame before"
        if sizes[0] != sizes[1]:
            why = f"the images, {sizes[0]} before, are {sizes[1]} now"
        return f"{why}; segment {segment} begins"

    def _followed(
        self, stamp: int, before: _Keyframe, step: Step, seen: VoFrame, memory: OdometryMemory
    ) -> CameraMotion:
        back = Transform(before.camera.child, before.camera.child, step.rotation.T, -step.rotation.T @ step.translation)
        camera = before.camera.after(back)
        covariance = _grown(before, step, camera)
        far = step.flow > self.max_keyframe_flow * seen.gray.shape[1]
        few = step.inliers < self.min_keyframe_share * before.view.known
        # A keyframe that shows too little to go on from is no better than the old one.
        if (far or few) and seen.known >= self.min_features:
            memory.keyframe = _Keyframe(seen, camera, covariance)
        return CameraMotion(stamp, memory.segment, camera, covariance, step.inliers)

    def _blind(self, stamp: int, seen: VoFrame, memory: OdometryMemory) -> CameraMotion:
        """No motion; the keyframe stays, so that the next frame that shows enough goes on from it."""
        memory.blind += 1
        lost = f"only {seen.known} features with a disparity are in view, less than {self.min_features}"
        return CameraMotion(stamp, memory.segment, None, np.zeros((6, 6)), lost=lost)


def _begun(frame: StereoFrame, seen: VoFrame, lost: str, memory: OdometryMemory) -> CameraMotion:
    """The first frame of a segment; `lost` says why the one before ended."""
    memory.segment += 1
    camera = Transform(f"{frame.camera.frame_id}/start", frame.camera.frame_id, np.eye(3), np.zeros(3))
    memory.keyframe = _Keyframe(seen, camera, np.zeros((6, 6)))
    return CameraMotion(frame.stamp, memory.segment, camera, np.zeros((6, 6)), lost=lost)


def _grown(before: _Keyframe, step: Step, camera: Transform) -> Array:
    """The covariance (6, 6) of the camera in its segment, position then turn: the keyframe's, which the way to here
    levers, and the step's."""
    own = np.zeros((6, 6))
    # The camera is at -R' t of the keyframe; the step's turn and shift are in the camera's own axes.
    own[:3, :3], own[:3, 3:], own[3:, :3] = -cross_matrix(step.translation), -np.eye(3), -np.eye(3)
    own = np.kron(np.eye(2), camera.rotation) @ own
    way = camera.translation - before.camera.translation
    grown: Array = translated_covariance(before.covariance, way) + own @ step.covariance @ own.T
    return grown
