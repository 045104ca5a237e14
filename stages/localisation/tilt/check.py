"""CheckTilt: can the tilt be believed? The camera and the ground it sees are asked, no truth is needed.

Frames between which the rover has moved are kept, the last fifty of them, and `tilt_diagnosis` tries on them every
fault that a tilt can have. A rover that stands still proves nothing and crowds nothing out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from flow.contracts import Finding, Severity
from stages.data import Array, CameraMotion, Mount, PointCloud, Tilt, TiltHealth, Transform
from stages.localisation.tilt.causes import Evidence
from stages.localisation.tilt.diagnosis import INCONSISTENT, Diagnosis, diagnose, off_level
from stages.robust_weights import MAD_TO_SIGMA, tukey_weights
from stages.stage import Stage, parameter

MOVED = 0.05  # m, or
TURNED = float(np.deg2rad(0.3))  # rad, by which a frame must differ from the one kept before
GROUND_FROM, GROUND_TO = 0.5, 8.0  # m of depth, of the ground that a plane is laid through
GROUND_POINTS = 4000
GROUND_ROUNDS = 6
GROUND_NOISE = 0.03  # m
NOTHING_YET = Diagnosis("", "no frames to judge the tilt by", False)


@dataclass(frozen=True, eq=False)
class _TiltSample:
    stamp: int
    segment: int
    camera: Transform
    drift: float
    up: Array
    mount: Array
    ground: Array


@dataclass(frozen=True)
class _Verdict:
    """What all judgements come to. last: of them; fault: the one to tell at the end, None where none was found; faults:
    how many judgements found one; clear: how many found one or could rule out all."""

    last: Diagnosis = NOTHING_YET
    fault: Diagnosis | None = None
    faults: int = 0
    clear: int = 0

    def and_then(self, judged: Diagnosis) -> _Verdict:
        """The verdict after one more judgement."""
        if not judged.fault:
            return replace(self, last=judged, clear=self.clear + judged.clear)
        vague = judged.fault == INCONSISTENT  # as where a fault begins or ends
        told = self.fault if vague and self.fault is not None else judged
        return _Verdict(judged, told, self.faults + 1, self.clear + 1)


@dataclass
class TiltMemory:
    """The frames that count, the last frame of all, how many were kept since they were judged, the verdict, and the
    least angle, rad, by which the ground was off level in any frame that shows it, with the number of these."""

    kept: deque[_TiltSample] = field(default_factory=deque)
    last: _TiltSample | None = None
    since: int = 0
    verdict: _Verdict = field(default_factory=_Verdict)
    least_slope: float = np.inf
    slopes: int = 0


@dataclass(frozen=True)
class CheckTilt(Stage):
    """Judges the tilt; it remembers, so it takes frames in order."""

    window: int = parameter(50, "frames that a judgement rests on at most", low=10)
    interval: int = parameter(5, "frames after which the tilt is judged again", low=1)
    min_angle: float = parameter(
        np.deg2rad(2.0), "least error of the mount that is called a fault", unit="rad", low=1e-3, high=0.5
    )
    min_offset: float = parameter(0.08, "least error of the tilt's stamps that is", unit="s", low=0.01, high=1.0)

    def start(self) -> TiltMemory:
        """The memory of one run, empty."""
        return TiltMemory()

    def __call__(
        self, motion: CameraMotion, tilt: Tilt, mount: Mount, cloud: PointCloud | None = None, *, state: TiltMemory
    ) -> TiltHealth:
        """The tilt's health so far. `cloud`, of the same camera, shows the ground; without it only motion counts."""
        ground = _ground_normal(cloud) if cloud is not None else np.full(3, np.nan)
        up = mount.camera_from_inclinometer @ tilt.up
        turn = np.nan
        if motion.camera is not None:
            drift = max(float(np.trace(motion.covariance[3:, 3:])) / 3, 0.0)
            sight = _TiltSample(
                motion.stamp, motion.segment, motion.camera, drift, tilt.up, mount.camera_from_inclinometer, ground
            )  # fmt: skip
            turn = _residual(sight, state.last)
            state.last = sight
            self._keep(sight, state)
        slope = np.nan
        if np.isfinite(ground).all():
            slope = _angle(up, ground)
            state.least_slope, state.slopes = min(state.least_slope, slope), state.slopes + 1
        judged = _told(state.verdict, state)
        return TiltHealth(motion.stamp, turn, slope, len(state.kept), judged.fault, judged.sentence)

    def finding(self, state: TiltMemory) -> Finding:
        """What to say of the whole run, the frames after the last judgement included; a fault is a warning."""
        verdict = state.verdict
        if state.since:
            verdict = verdict.and_then(self._diagnosis(state))
        if verdict.fault is None:
            told = _told(verdict, state)
            return Finding(told.sentence, Severity.WARNING if told.fault else Severity.NOTE)
        where = "" if verdict.faults == verdict.clear else f" ({verdict.faults} of {verdict.clear} judgements)"
        return Finding(verdict.fault.sentence + where, Severity.WARNING)

    def _keep(self, sight: _TiltSample, memory: TiltMemory) -> None:
        before = memory.kept[-1] if memory.kept else None
        if before is not None and before.segment == sight.segment:
            step = before.camera.inverse().after(sight.camera)
            if np.linalg.norm(step.translation) < MOVED and Rotation.from_matrix(step.rotation).magnitude() < TURNED:
                return
        if before is not None and not np.array_equal(before.mount, sight.mount):
            memory.kept.clear()  # what was seen speaks of another mount
        memory.kept.append(sight)
        if len(memory.kept) > self.window:
            memory.kept.popleft()
        memory.since += 1
        if memory.since >= self.interval:
            memory.verdict, memory.since = memory.verdict.and_then(self._diagnosis(memory)), 0

    def _diagnosis(self, memory: TiltMemory) -> Diagnosis:
        """What the frames that are kept now show."""
        kept = memory.kept
        evidence = Evidence(
            np.array([sight.stamp for sight in kept]), np.array([sight.segment for sight in kept]),
            np.array([sight.camera.rotation for sight in kept]), np.array([sight.drift for sight in kept]),
            np.array([sight.up for sight in kept]), kept[-1].mount, np.array([sight.ground for sight in kept]),
        )  # fmt: skip
        return diagnose(evidence, self.min_angle, self.min_offset)


def _told(verdict: _Verdict, memory: TiltMemory) -> Diagnosis:
    """The last judgement; as long as none could tell anything, what the ground alone says of every frame so far."""
    steep = off_level(memory.least_slope, memory.slopes) if verdict.clear == 0 and not verdict.last.fault else None
    return steep or verdict.last


def _residual(sight: _TiltSample, last: _TiltSample | None) -> float:
    """By how much up differs from the last frame's, carried along by the camera; NaN in a new segment."""
    if last is None or last.segment != sight.segment:
        return float("nan")
    carried = sight.camera.rotation.T @ last.camera.rotation @ last.mount @ last.up
    return _angle(sight.mount @ sight.up, carried)


def _ground_normal(cloud: PointCloud) -> Array:
    """The upward normal (3,), in the camera, of the plane through most of the ground in view; NaN where there is none.

    Least squares of the measured points with Tukey's weights, so that rocks do not tilt it.
    """
    cloud = cloud.only(cloud.measured)
    some = cloud.points[:: -(-len(cloud.points) // GROUND_POINTS) or 1].astype(np.float64)
    if cloud.sensor is not None:
        some = cloud.sensor.inverse()(some)
    some = some[np.isfinite(some).all(axis=1) & (some[:, 2] > GROUND_FROM) & (some[:, 2] < GROUND_TO)]
    if len(some) < GROUND_POINTS // 20:
        return np.full(3, np.nan)
    weights = np.ones(len(some))
    for _ in range(GROUND_ROUNDS):
        centre = weights @ some / weights.sum()
        spread = (some - centre) * np.sqrt(weights)[:, None]
        values, axes = np.linalg.eigh(spread.T @ spread / weights.sum())
        normal = axes[:, 0]
        distance = (some - centre) @ normal
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(distance))), GROUND_NOISE)
        weights = tukey_weights(distance, scale) + 1e-9
    if values[1] < 4 * values[0]:  # a heap of points rather than a plane
        return np.full(3, np.nan)
    towards: Array = normal * (-np.sign(normal @ centre) or 1.0)
    return towards


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))
