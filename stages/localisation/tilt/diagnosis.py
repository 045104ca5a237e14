"""Diagnosis of a tilt without ground truth: from the camera's own rotations and the ground that it sees.

Visual odometry transforms every tilt to the first frame, where all must point up. Each candidate fault is undone in
turn. The fault whose removal makes the tilts agree, by more than noise can, is reported. The ground in view is assumed
to be level only on average; it determines the sign of up, and right angles if the rover hardly moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stages.data.rotations import angle_of
from stages.localisation.tilt.causes import (
    GROUND_SIGMA,
    MAX_LARGE_OFFSET,
    MAX_OFFSET,
    MIN_ANGLE,
    MIN_FRAMES,
    MIN_OFFSET,
    Cause,
    Evidence,
    Fit,
    degrees,
    exchanged_axes,
    late_stamps,
    misread_quaternions,
    radians_as_degrees,
    wrong_mount,
)

NOISE = float(np.deg2rad(0.2))  # rad, prior for a tilt, against which the camera's drift is weighed
MIN_NOISE = float(np.deg2rad(0.05))  # rad
MAX_NOISE = float(np.deg2rad(2.0))  # rad; beyond it tilt and camera disagree, whatever the best explanation
MAX_SOUND_NOISE = float(np.deg2rad(0.5))  # rad; beyond it large time offsets are tried
MAX_DELAY_NOISE = float(np.deg2rad(1.0))  # rad; a sound tilt of noise 0.6 degrees has less, and so has a late one
MIN_DELAY_RATIO = 2.0  # of residuals without and with a large time offset; one of seconds fits any tilt a little
MAX_SMALL_MOUNT = float(np.deg2rad(20))  # rad, of a mount error; a larger one explains a part of any fault, so it may
MAX_MOUNT_JITTERS, MAX_MOUNT_NOISE = 1.3, float(np.deg2rad(0.15))  # leave so many times the jitter, or so much, rad
MAX_SLOPE = float(np.deg2rad(20))  # rad; ground that is steeper in every frame means a wrong tilt
MIN_GAIN = 25.0  # of a fault's score over that of no fault: five sigma
MIN_RIVAL_GAIN = 10.0  # over the scores of other faults; those within it are named too
MAX_SAME = 0.3  # norm of the difference of two rotation matrices that are one fault under two names
MAX_UNSEEN = 0.33  # standard deviation of a fault over the smallest that counts; beyond it a fault may go unseen
MIN_SWING_RATIO, MIN_SWING = 4.0, float(np.deg2rad(4))  # of up over the camera's rotation, if the unit is wrong
INCONSISTENT = "inconsistent"  # no single fault explains the tilt
ESTIMATED = (
    "The tilt is estimated from accelerations and rates. Check the axes, the signs and the unit (rad/s) of the "
    "gyroscope, and that both sensors have the axes of their frames in /tf_static."
)
OFF_GROUND = "up is off the ground"  # the ground contradicts the tilt, and the motion does not show why


@dataclass(frozen=True)
class Diagnosis:
    """The result for the frames so far."""

    fault: str  # short name, empty if none is found
    sentence: str
    clear: bool  # whether the motion was sufficient to see every fault
    firm: bool = True  # false of a large mount error, which more frames may contradict


class _Hypotheses(NamedTuple):
    """All causes fitted to the evidence, with the noise, rad, that was assumed for the tilts."""

    evidence: Evidence
    degrees_of_freedom: int
    noise: float
    sound: Cause
    axes: list[Cause]
    mount: Cause
    offset: Cause | None
    units: Cause | None
    quaternions: list[Cause]

    @property
    def frames(self) -> int:
        return len(self.evidence.stamps)

    @property
    def faults(self) -> list[Cause]:
        others = self.units, self.mount, self.offset
        return [*self.axes, *self.quaternions, *(cause for cause in others if cause is not None)]

    @property
    def variance(self) -> float:
        """Variance of the tilts over the assumed one, by the residuals of the best explanation."""
        misfit = min(cause.misfit for cause in [self.sound, *self.faults])
        return max(misfit / self.degrees_of_freedom, (MIN_NOISE / self.noise) ** 2)

    def residual(self, cause: Cause) -> float:
        """RMS angle, rad, between tilt and camera under a cause."""
        return float(self.noise * np.sqrt(cause.misfit / self.degrees_of_freedom))

    def jitter(self, cause: Cause) -> float:
        """The same by the jumps between frames; both are alike if the cause leaves only noise."""
        return float(self.noise * np.sqrt(cause.jumps / self.degrees_of_freedom))

    def is_large_mount(self, cause: Cause) -> bool:
        """Whether the cause is an error of the mount that explains a part of any fault."""
        return cause is self.mount and cause.size * MIN_ANGLE > MAX_SMALL_MOUNT

    def is_upside_down(self, cause: Cause) -> bool:
        """Whether the cause inverts up in the inclinometer's frame, as no gyroscope does."""
        return cause.undone is not None and (self.evidence.mount.T @ cause.undone)[2, 2] < 0

    def explains(self, cause: Cause) -> bool:
        """Whether tilt and camera agree well enough under a time offset or a large error of the mount to name it; true
        of other causes."""
        left = self.residual(cause)
        if self.is_large_mount(cause):
            return left <= max(MAX_MOUNT_NOISE, MAX_MOUNT_JITTERS * self.jitter(cause))
        if cause is not self.offset:
            return True
        large = cause.size * MIN_OFFSET > MAX_OFFSET
        return left <= MAX_DELAY_NOISE and not (large and self.residual(self.sound) < MIN_DELAY_RATIO * left)


def diagnose(evidence: Evidence) -> Diagnosis:
    """The fault that explains the evidence; none if the tilt is sound or the evidence is insufficient."""
    n = len(evidence.stamps)
    wrong_unit = _degrees_as_radians(evidence)
    if wrong_unit is not None:
        return wrong_unit
    degrees_of_freedom = 2 * (n - len(np.unique(evidence.segments)))
    if n < MIN_FRAMES or degrees_of_freedom < MIN_FRAMES:
        why = f"too few frames in which the rover moved ({n}; it takes {MIN_FRAMES} in a row)"
        return Diagnosis("", f"The tilt was not checked: {why}.", False)
    found, noise = _judged(evidence, degrees_of_freedom, NOISE)
    if found.fault and noise < NOISE:  # the camera's drift weighs more than assumed; the fault must remain with it
        found, _ = _judged(evidence, degrees_of_freedom, noise)
    return found


def _judged(evidence: Evidence, degrees_of_freedom: int, noise: float) -> tuple[Diagnosis, float]:
    """The diagnosis for tilts with an assumed noise, rad; and the noise that results from it."""
    fit = Fit(evidence, noise)
    sound = fit.cause("", "", fit.ups)
    tried = _Hypotheses(
        evidence, degrees_of_freedom, noise, sound, exchanged_axes(fit), wrong_mount(fit),
        late_stamps(fit, sound, MAX_OFFSET), radians_as_degrees(fit),
        [] if evidence.estimated else misread_quaternions(fit),
    )  # fmt: skip
    if tried.residual(sound) > MAX_SOUND_NOISE:
        offsets = [cause for cause in (tried.offset, late_stamps(fit, sound, MAX_LARGE_OFFSET)) if cause is not None]
        tried = tried._replace(offset=min(offsets, key=lambda cause: cause.misfit, default=None))
    variance = tried.variance
    best = min(tried.faults, key=lambda cause: cause.score(variance))
    resulting_noise = noise * float(np.sqrt(variance))
    if sound.score(variance) - best.score(variance) > MIN_GAIN and best.size > 1:
        return _faulty(tried, best), resulting_noise
    return _passed(tried), resulting_noise


def off_level(min_slope: float, frames: int) -> Diagnosis | None:
    """The diagnosis by the ground alone; None if it may well be terrain.

    min_slope: rad, the smallest angle between up and the ground in view in any of so many frames.
    """
    if not frames or min_slope <= MAX_SLOPE:
        return None
    every = "the only frame" if frames == 1 else f"every one of {frames} frames"
    sentence = (
        f"The ground in view is off level by {degrees(min_slope)} or more in {every}, steeper than terrain is on "
        "average. Check the unit and the sign of pitch, the inclinometer's axes and its mount (source.pitch.sign, "
        "source.camera_from_inclinometer, --pitch-down of an import)."
    )
    return Diagnosis(OFF_GROUND, sentence, False)


def _faulty(tried: _Hypotheses, best: Cause) -> Diagnosis:
    """The best cause, with the rivals that explain the evidence nearly as well."""
    variance = tried.variance
    limit = best.score(variance) + MIN_RIVAL_GAIN
    rivals = [c for c in tried.faults if c is not best and c.size > 1 and c.score(variance) < limit]
    if tried.residual(best) > MAX_NOISE or not tried.explains(best):
        return _inconsistent(tried)
    rivals = [rival for rival in rivals if tried.explains(rival)]
    faults = [best.fault, *(rival.fault for rival in rivals if not _same(best, rival))]
    remedy = best.remedy
    if tried.evidence.estimated and best in (*tried.axes, tried.units) and not tried.is_upside_down(best):
        remedy = ESTIMATED
    if best is tried.mount and tried.offset is None:
        faults.insert(1, "its stamps are late or early")
        remedy = (
            f"The frames are too few or too far apart in time to separate the two. Check the clocks first. {remedy}"
        )
    fault = " or ".join(faults)
    sentence = (
        f"{fault[0].upper()}{fault[1:]}. Without this fault {_agreement(tried, best)} ({tried.frames} frames). {remedy}"
    )
    return Diagnosis(fault, sentence, True, not tried.is_large_mount(best))


def _agreement(tried: _Hypotheses, best: Cause) -> str:
    """How much better the camera agrees with the tilt under a cause, by its motion, or else by the ground in view."""
    if (tried.sound.misfit - best.misfit) / tried.variance > MIN_GAIN:
        left, whole = (degrees(tried.residual(cause)) for cause in (best, tried.sound))
        return f"tilt and camera agree to {left}, with it to {whole}"
    before, after = (GROUND_SIGMA * np.sqrt(cause.ground) for cause in (tried.sound, best))  # chords of a unit circle
    left, whole = (degrees(2 * np.arcsin(min(chord / 2, 1))) for chord in (after, before))
    return f"the ground in view is {left} off level on average, with it {whole if before < np.sqrt(2) else 'overhead'}"


def _inconsistent(tried: _Hypotheses) -> Diagnosis:
    likely = (
        "the axes, signs and units of gyroscope and accelerometer, their mount and clock"
        if tried.evidence.estimated
        else "its axes, unit, mount and clock, the convention of its quaternions, if it has any"
    )
    sentence = (
        f"Tilt and camera disagree by {degrees(tried.residual(tried.sound))} ({tried.frames} frames), and no single "
        f"fault of the inclinometer explains it, so no remedy is known. Check {likely}, and whether it is shaken."
    )
    return Diagnosis(INCONSISTENT, sentence, True)


def _same(one: Cause, other: Cause) -> bool:
    """Whether two faults are one rotation of the inclinometer, such as flipped signs and a wrong mount."""
    if one.undone is None or other.undone is None:
        return False
    return float(np.linalg.norm(one.undone - other.undone)) < MAX_SAME


def _passed(tried: _Hypotheses) -> Diagnosis:
    """The diagnosis if no fault is found: the tilt is sound, or the motion was insufficient."""
    sound, variance, n = tried.sound, tried.variance, tried.frames
    if tried.residual(sound) > MAX_NOISE:
        return _inconsistent(tried)
    if sound.ground > MIN_GAIN:
        slope = GROUND_SIGMA * np.sqrt(sound.ground)
        sentence = (
            f"The tilt is {degrees(slope)} off the normal of the ground ({n} frames). Check the inclinometer's axes "
            "and source.camera_from_inclinometer. The rover has moved too little to identify the fault."
        )
        return Diagnosis(OFF_GROUND, sentence, False)
    undecided = any(cause.score(variance) - sound.score(variance) < MIN_GAIN for cause in tried.axes)
    unseen = ["axes are exchanged or flipped"] if undecided else []
    if tried.mount.error * np.sqrt(variance) > MAX_UNSEEN:
        unseen.append("the mount is wrong")
    if tried.offset is None or tried.offset.error * np.sqrt(variance) > MAX_UNSEEN:
        unseen.append("the tilt's stamps are early or late")
    if unseen:
        which = " or ".join([", ".join(unseen[:-1]), unseen[-1]] if len(unseen) > 1 else unseen)
        return Diagnosis("", f"The rover moved too little in {n} frames to decide whether {which}.", False)
    return Diagnosis("", f"Tilt and camera agree to {degrees(tried.residual(sound))} ({n} frames).", True)


def _degrees_as_radians(evidence: Evidence) -> Diagnosis | None:
    """Degrees taken for radians: the tilt swings more than any camera fixed to the inclinometer can.

    The ground's normal bounds the swing by the camera's rotation, because up leans from it by at most `MAX_SLOPE`.
    """
    near = np.flatnonzero(evidence.segments[1:] == evidence.segments[:-1])
    if len(near) < MIN_FRAMES - 1:
        return None
    ups, cameras = evidence.ups, evidence.cameras
    swings = np.arccos(np.clip(np.sum(ups[near] * ups[near + 1], axis=1), -1, 1))
    turned = np.swapaxes(cameras[near], 1, 2) @ cameras[near + 1]
    turns = np.array([angle_of(turn) for turn in turned])
    normals = evidence.ground[near]
    with_ground = np.arccos(np.clip(np.einsum("ki,kij,kj->k", normals, turned, normals), -1, 1))  # NaN: no ground
    lean = 2 * np.sin(MAX_SLOPE) * np.sin(turns / 2)
    swing, possible = float(np.median(swings)), float(np.median(np.fmin(turns, with_ground + lean)))
    limit = float(np.median(np.fmin(MIN_SWING_RATIO * turns, MIN_SWING_RATIO * with_ground + lean)))
    if not swing > max(limit, MIN_SWING):
        return None
    fault = "degrees are taken for radians"
    sentence = (
        f"D{fault[1:]}: between frames the tilt swings by {degrees(swing)}, but the camera's rotations allow "
        f"{degrees(possible)} ({len(near)} pairs of frames). Check the inclinometer's driver: the unit of source.pitch "
        "and source.roll (deg, not rad) for bare angles, that of the gyroscope (rad/s) for an estimated tilt."
    )
    return Diagnosis(fault, sentence, True)
