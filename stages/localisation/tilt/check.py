"""CheckTilt: is the tilt consistent with the camera and the ground that it sees?

The last frames between which the rover has moved are kept, and `diagnosis` tries every fault of a tilt on them. Frames
of a rover that stands still add no information and are not kept.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from flow.contracts import Finding, Severity
from stages.data import Array, CameraMotion, Mount, PointCloud, Tilt, TiltHealth, Transform
from stages.data.rotations import angle_of
from stages.localisation.tilt.causes import Evidence
from stages.localisation.tilt.diagnosis import INCONSISTENT, OFF_GROUND, Diagnosis, diagnose, off_level
from stages.robust_weights import MAD_TO_SIGMA, tukey_weights
from stages.stage import Stage, check_types, parameter

MIN_STEP = 0.05  # m, or
MIN_TURN = float(np.deg2rad(0.3))  # rad, from the last frame kept
JUDGEMENT_INTERVAL = 5  # frames kept
MIN_GROUND_DEPTH, MAX_GROUND_DEPTH = 0.5, 8.0  # m
MAX_GROUND_POINTS = 4000
MIN_GROUND_SIGMA = 0.03  # m
FIT_ROUNDS = 6
NO_JUDGEMENT = Diagnosis("", "No frames to judge the tilt by.", False)


@dataclass(frozen=True, eq=False)
class _TiltSample:
    stamp: int
    segment: int
    camera: Transform
    drift: float
    up: Array
    mount: Array
    ground: Array
    estimated: bool


@dataclass(frozen=True)
class _Verdict:
    """All judgements so far."""

    last: Diagnosis = NO_JUDGEMENT
    fault: Diagnosis | None = None  # to report at the end
    faults: int = 0  # judgements that found a fault
    clear: int = 0  # judgements that found a fault or could rule out all

    def and_then(self, judged: Diagnosis) -> _Verdict:
        """The verdict after one more judgement."""
        if not judged.fault:
            return replace(self, last=judged, clear=self.clear + judged.clear)
        vague = judged.fault == INCONSISTENT  # as when a fault begins or ends
        reported = self.fault if vague and self.fault is not None and self.fault.firm else judged
        return _Verdict(judged, reported, self.faults + 1, self.clear + 1)


@dataclass
class TiltMemory:
    """The state of `CheckTilt`."""

    kept: deque[_TiltSample] = field(default_factory=deque)
    last: _TiltSample | None = None
    since: int = 0  # frames kept since the last judgement
    verdict: _Verdict = field(default_factory=_Verdict)
    min_slope: float = np.inf  # rad, between up and the ground in any frame that shows it
    slopes: int = 0  # number of those frames


@dataclass(frozen=True)
class CheckTilt(Stage):
    """Compares the tilt with the camera's rotation and the ground in view.

    Examples
    --------
    >>> motion = CameraMotion(0, 1, Transform("start", "camera", np.eye(3), np.zeros(3)), np.zeros((6, 6)))
    >>> check = CheckTilt()
    >>> state = check.start()
    >>> check(motion, Tilt(0, [0.0, -1.0, 0.0]), Mount(0, np.eye(3)), state=state).judgement
    'No frames to judge the tilt by.'
    >>> check.finding(state).sentence
    'The tilt was not checked: too few frames in which the rover moved (1; it takes 8 in a row).'
    """

    window: int = parameter(50, "largest number of frames for a judgement", low=10)

    def start(self) -> TiltMemory:
        """The state of one run."""
        return TiltMemory()

    def __call__(
        self, motion: CameraMotion, tilt: Tilt, mount: Mount, cloud: PointCloud | None = None, *, state: TiltMemory
    ) -> TiltHealth:
        """The tilt's health so far; `cloud`, of the same camera, shows the ground."""
        check_types(self, motion=motion, tilt=tilt, mount=mount, cloud=cloud)
        ground = _ground_normal(cloud) if cloud is not None else np.full(3, np.nan)
        up = mount.camera_from_inclinometer @ tilt.up
        turn = np.nan
        if motion.camera is not None:
            drift = max(float(np.trace(motion.covariance[3:, 3:])) / 3, 0.0)
            sample = _TiltSample(
                motion.stamp, motion.segment, motion.camera, drift, tilt.up, mount.camera_from_inclinometer, ground,
                tilt.filtered,
            )  # fmt: skip
            turn = _residual(sample, state.last)
            state.last = sample
            self._keep(sample, state)
        slope = np.nan
        if np.isfinite(ground).all():
            slope = _angle(up, ground)
            state.min_slope, state.slopes = min(state.min_slope, slope), state.slopes + 1
        judged = _reported(state.verdict, state)
        return TiltHealth(motion.stamp, turn, slope, len(state.kept), judged.fault, judged.sentence)

    def finding(self, state: TiltMemory) -> Finding:
        """The verdict of the whole run, including the frames after the last judgement.

        If only the ground contradicts the tilt, that is a warning, because it may be steep.
        """
        verdict = state.verdict
        if state.since:
            verdict = verdict.and_then(_diagnosis(state))
        if verdict.fault is None:
            judged = _reported(verdict, state)
            return _finding(judged)
        where = "" if verdict.faults == verdict.clear else f" ({verdict.faults} of {verdict.clear} judgements)"
        return _finding(verdict.fault, where)

    def _keep(self, sample: _TiltSample, state: TiltMemory) -> None:
        """Keep the frame if the rover has moved, and judge again at intervals."""
        before = state.kept[-1] if state.kept else None
        if before is not None and before.segment == sample.segment:
            step = before.camera.inverse().after(sample.camera)
            turn = angle_of(step.rotation)
            if np.linalg.norm(step.translation) < MIN_STEP and turn < MIN_TURN:
                return
        state.kept.append(sample)
        if len(state.kept) > self.window:
            state.kept.popleft()
        state.since += 1
        if state.since >= JUDGEMENT_INTERVAL:
            state.verdict, state.since = state.verdict.and_then(_diagnosis(state)), 0


def _finding(judged: Diagnosis, where: str = "") -> Finding:
    severity = Severity.FAULT if judged.fault else Severity.NOTE
    if judged.fault == OFF_GROUND:
        severity = Severity.WARNING
    return Finding(judged.sentence + where, severity, about="tilt", assumes="cameras")


def _diagnosis(state: TiltMemory) -> Diagnosis:
    """The diagnosis of the frames kept, as if the camera stood still on the rover as it does in the last one."""
    mount, estimated = state.kept[-1].mount, state.kept[-1].estimated
    stamps, segments, cameras, drift, ups, ground = (
        np.array(column)
        for column in zip(*((s.stamp, s.segment, *_as_mounted(s, mount)) for s in state.kept), strict=True)
    )
    return diagnose(Evidence(stamps, segments, cameras, drift, ups, mount, ground, estimated))


def _as_mounted(sample: _TiltSample, mount: Array) -> tuple[Array, float, Array, Array]:
    """The rotation of a camera with this mount, its drift, up, and the ground's normal in that camera."""
    if np.array_equal(sample.mount, mount):
        return sample.camera.rotation, sample.drift, sample.up, sample.ground
    turn = sample.mount @ mount.T  # from that camera to the one of the sample
    return sample.camera.rotation @ turn, sample.drift, sample.up, turn.T @ sample.ground


def _reported(verdict: _Verdict, state: TiltMemory) -> Diagnosis:
    """The last judgement; until one is clear, the judgement by the ground alone."""
    steep = off_level(state.min_slope, state.slopes) if verdict.clear == 0 and not verdict.last.fault else None
    return steep or verdict.last


def _residual(sample: _TiltSample, last: _TiltSample | None) -> float:
    """Angle, rad, between up and the last frame's up rotated by the camera's motion; NaN in a new segment."""
    if last is None or last.segment != sample.segment:
        return float("nan")
    predicted = sample.camera.rotation.T @ last.camera.rotation @ last.mount @ last.up
    return _angle(sample.mount @ sample.up, predicted)


def _ground_normal(cloud: PointCloud) -> Array:
    """Upward normal (3,), in the camera, of the ground in view; NaN if there is none.

    A plane fitted to the measured points with Tukey's weights, so that rocks do not tilt it.
    """
    measured = np.flatnonzero(cloud.measured)
    some = cloud.points[measured[:: -(-len(measured) // MAX_GROUND_POINTS) or 1]].astype(np.float64)
    if cloud.sensor is not None:
        some = cloud.sensor.inverse()(some)
    some = some[np.isfinite(some).all(axis=1) & (some[:, 2] > MIN_GROUND_DEPTH) & (some[:, 2] < MAX_GROUND_DEPTH)]
    if len(some) < MAX_GROUND_POINTS // 20:
        return np.full(3, np.nan)
    weights = np.ones(len(some))
    for _ in range(FIT_ROUNDS):
        centre = weights @ some / weights.sum()
        offsets = some - centre
        weighted = offsets * np.sqrt(weights)[:, None]
        values, axes = np.linalg.eigh(weighted.T @ weighted / weights.sum())
        normal = axes[:, 0]
        distance = offsets @ normal
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(distance))), MIN_GROUND_SIGMA)
        weights = tukey_weights(distance, scale) + 1e-9
    if values[1] < 4 * values[0]:  # not a plane
        return np.full(3, np.nan)
    upward: Array = normal * (-np.sign(normal @ centre) or 1.0)
    return upward


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))
