"""VisualOdometry: the camera's motion from one stereo frame to the next (see `vo_tracking`).

Each frame is tracked from a keyframe, which is kept while it shares enough features with the current frame, so a rover
that stands still does not drift. A new segment begins where tracking is lost. Nothing aligns two segments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, counted
from stages.data import Array, CameraMotion, Disparity, StereoFrame, Transform
from stages.data.covariance import cross_matrix, translated_covariance
from stages.localisation.vo_tracking import MIN_FEATURES, Step, VoFrame, step_between, vo_frame
from stages.stage import Stage, check_joined, check_same_time

MAX_RMS = 2.0  # px, reprojection error of a motion
MAX_MOTION = 5.0  # m, between two frames
MAX_KEYFRAME_FLOW = 0.03  # of the image's width, since the keyframe
MIN_KEYFRAME_SHARE = 0.5  # of the keyframe's features that are still tracked


@dataclass
class _Keyframe:
    frame: VoFrame
    camera: Transform
    covariance: Array


@dataclass
class OdometryMemory:
    """The state of `VisualOdometry`."""

    keyframe: _Keyframe | None = None
    segment: int = 0  # 1 from the first usable frame on
    untracked: int = 0  # frames with too few features


@dataclass(frozen=True)
class VisualOdometry(Stage):
    """Tracks the camera through the frames of a run.

    Examples
    --------
    >>> from stages import StereoCamera
    >>> camera, dark = StereoCamera(100.0, 100.0, 32.0, 24.0, 0.2, 64, 48), np.zeros((48, 64), np.uint8)
    >>> unknown = Disparity(0, np.full((48, 64), np.nan, np.float32), dark, np.zeros((48, 64), np.float32))
    >>> odometry = VisualOdometry()
    >>> odometry(StereoFrame(0, dark, dark, camera), unknown, state=odometry.start()).lost
    'only 0 features have a disparity (minimum 40)'
    """

    def start(self) -> OdometryMemory:
        """The state of one run."""
        return OdometryMemory()

    def resumed(self, segment: int) -> OdometryMemory:
        """The state from which the next frame begins a segment of this number, as in the poses of a result log."""
        return OdometryMemory(segment=segment - 1)

    def __call__(self, frame: StereoFrame, disparity: Disparity, *, state: OdometryMemory) -> CameraMotion:
        """The camera's motion since its segment began; `camera` is None if the frame has too few features."""
        check_joined(self, frame, disparity)
        check_same_time(self, frame=frame.stamp, disparity=disparity.stamp)
        before, now = state.keyframe, vo_frame(frame, disparity)
        step = step_between(before.frame, now) if before is not None else None
        if before is not None and step is not None and _plausible(step):
            return _tracked(frame.stamp, before, step, now, state)
        # The first frame needs only one feature: it may be the only frame.
        if now.known < (1 if before is None else MIN_FEATURES):
            return _untracked(frame.stamp, now, state)
        lost = _loss(before.frame, now, step, state.segment + 1) if before is not None else ""
        return _new_segment(frame, now, lost, state)

    def finding(self, state: OdometryMemory) -> Finding | None:
        """The number of frames with too few features; PoseFilter reports lost tracking."""
        frames = counted(state.untracked, "frame")
        return Finding(f"Too few features to track in {frames}.") if state.untracked else None


def _plausible(step: Step) -> bool:
    return step.rms <= MAX_RMS and float(np.linalg.norm(step.translation)) <= MAX_MOTION


def _loss(before: VoFrame, now: VoFrame, step: Step | None, segment: int) -> str:
    """Why the segment before ends."""
    sizes = [f"{width}x{height}" for height, width in (before.gray.shape, now.gray.shape)]
    why = f"fewer than {MIN_FEATURES} features agree with the frame before"
    if sizes[0] != sizes[1]:
        why = f"the image size changed from {sizes[0]} to {sizes[1]}"
    elif step is not None:
        metres = float(np.linalg.norm(step.translation))
        why = f"the motion found, {metres:.1f} m with errors of {step.rms:.1f} px, is not plausible"
    return f"{why}; segment {segment} begins"


def _tracked(stamp: int, before: _Keyframe, step: Step, now: VoFrame, state: OdometryMemory) -> CameraMotion:
    """The motion from the keyframe; the frame becomes the keyframe if it is far from it."""
    back = Transform(before.camera.child, before.camera.child, step.rotation.T, -step.rotation.T @ step.translation)
    camera = before.camera.after(back)
    covariance = _propagated(before, step, camera)
    far = step.flow > MAX_KEYFRAME_FLOW * now.gray.shape[1]
    few = step.inliers < MIN_KEYFRAME_SHARE * before.frame.known
    if (far or few) and now.known >= MIN_FEATURES:
        state.keyframe = _Keyframe(now, camera, covariance)
    return CameraMotion(stamp, state.segment, camera, covariance, step.inliers)


def _untracked(stamp: int, now: VoFrame, state: OdometryMemory) -> CameraMotion:
    """No motion; the keyframe stays for the next frame."""
    state.untracked += 1
    lost = f"only {now.known} features have a disparity (minimum {MIN_FEATURES})"
    return CameraMotion(stamp, state.segment, None, np.zeros((6, 6)), lost=lost)


def _new_segment(frame: StereoFrame, now: VoFrame, lost: str, state: OdometryMemory) -> CameraMotion:
    """The first frame of a segment; `lost` is why the one before ended."""
    state.segment += 1
    camera = Transform(f"{frame.camera.frame_id}/start", frame.camera.frame_id, np.eye(3), np.zeros(3))
    state.keyframe = _Keyframe(now, camera, np.zeros((6, 6)))
    return CameraMotion(frame.stamp, state.segment, camera, np.zeros((6, 6)), lost=lost)


def _propagated(before: _Keyframe, step: Step, camera: Transform) -> Array:
    """Covariance (6, 6) of the camera in its segment, position then rotation: the keyframe's and the step's."""
    own = np.zeros((6, 6))
    # The camera is at -R' t of the keyframe; the step's rotation and translation are in the camera's own axes.
    own[:3, :3], own[:3, 3:], own[3:, :3] = -cross_matrix(step.translation), -np.eye(3), -np.eye(3)
    own = np.kron(np.eye(2), camera.rotation) @ own
    way = camera.translation - before.camera.translation
    covariance: Array = translated_covariance(before.covariance, way) + own @ step.covariance @ own.T
    return covariance
