"""What is wrong with a tilt, told without any truth: from the camera's own turns and the ground that it sees.

The images say how the camera turned since the first frame, so they carry every tilt back to that frame. There all must
point the same way: up. Each fault that a tilt can have is undone in turn, and the one counts that makes them agree, if
it does so beyond what noise can do. The ground in view is taken to lie level only on the whole, by some degrees; that
tells up from down, and a right angle, where the rover hardly moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stages.localisation.tilt.causes import (
    GROUND,
    LEAST_FRAMES,
    Cause,
    Evidence,
    Fit,
    degrees,
    exchanged_axes,
    late_stamps,
    radians_as_degrees,
    wrong_mount,
)

NOISE = float(np.deg2rad(0.2))  # of a tilt, against which the camera's own drift is weighed until more is known
LEAST_NOISE = float(np.deg2rad(0.05))
STEEPEST = float(np.deg2rad(20))  # ground that is steeper in every frame is taken for a wrong tilt
NOISIEST = float(np.deg2rad(2.0))  # beyond it tilt and camera do not agree, whatever the best explanation
MARGIN = 25.0  # by how much a fault must fit better than none, in units of the noise's variance: five sigma
RIVAL = 10.0  # and than other faults, or they are named with it
SAME = 0.3  # difference of two rotations, as a matrix, below which they are one fault under two names
HIDDEN = 0.33  # standard deviation of a fault, over the least that counts, beyond which a fault could go unseen
INCONSISTENT = "inconsistent"  # the fault of a tilt that no single fault explains
OFF_GROUND = "up is off the ground"  # of one that the ground contradicts, where the motion cannot tell why
_UNJUDGED = "its stamps are late or early"
_NOT_YET = "these frames are too few, or too far apart in time, to tell the two apart: check the clocks first"
WILD = 4.0  # how many times more than the camera the tilt must turn to have a wrong unit
WILD_ANGLE = float(np.deg2rad(4))


@dataclass(frozen=True)
class Diagnosis:
    """fault: in a word or two, empty where none is found; sentence: what to tell the user; clear: whether there was
    motion enough to see every fault."""

    fault: str
    sentence: str
    clear: bool


def diagnose(evidence: Evidence, least_angle: float = np.deg2rad(2.0), least_offset: float = 0.08) -> Diagnosis:
    """The fault that explains the evidence; none where the tilt is sound or where nothing can be told.

    least_angle: rad, least error of the mount that is a fault; least_offset: s, and of the time.
    """
    n = len(evidence.stamps)
    wild = _wild(evidence)
    if wild is not None:
        return wild
    free = 2 * (n - len(np.unique(evidence.segments)))
    if n < LEAST_FRAMES or free < LEAST_FRAMES:
        return Diagnosis("", f"too few frames to judge the tilt ({n})", False)
    found, noise = _judged(evidence, free, NOISE, least_angle, least_offset)
    if found.fault and noise < NOISE:  # then the camera's drift weighs more than was thought: it must stand that, too
        found, _ = _judged(evidence, free, noise, least_angle, least_offset)
    return found


def _judged(
    evidence: Evidence, free: int, noise: float, least_angle: float, least_offset: float
) -> tuple[Diagnosis, float]:
    """The diagnosis for tilts with that noise, rad, against the camera's drift; and what noise the tilts then seem to
    have. free: degrees of freedom."""
    n, fit = len(evidence.stamps), Fit(evidence, noise)
    sound = Cause("", "", fit.misfit(np.eye(3)), fit.slope(np.eye(3)))
    axes = exchanged_axes(fit)
    mount, offset = wrong_mount(fit, least_angle), late_stamps(fit, sound, least_offset)
    causes = [*axes, *(cause for cause in (radians_as_degrees(fit), mount, offset) if cause is not None)]
    # Noise is what the best explanation leaves; the ground has no say in that.
    least = min(cause.misfit for cause in [sound, *causes])
    variance = max(least / free, (LEAST_NOISE / noise) ** 2)
    best = min(causes, key=lambda cause: cause.score(variance))
    gain = sound.score(variance) - best.score(variance)
    before, after = (noise * np.sqrt(cause.misfit / free) for cause in (sound, best))
    seems = noise * float(np.sqrt(variance))
    if gain > MARGIN and best.size > 1:
        near = best.score(variance) + RIVAL
        rivals = [cause for cause in causes if cause is not best and cause.size > 1 and cause.score(variance) < near]
        if best is mount and offset is None:
            best = replace(best, fault=f"{best.fault} or {_UNJUDGED}", remedy=f"{_NOT_YET}; {best.remedy}")
        return _named(best, rivals, n, float(before), float(after)), seems
    return _passed(sound, axes, mount, offset, variance, n, float(before)), seems


def off_level(least: float, frames: int) -> Diagnosis | None:
    """What the ground alone tells, of one frame or two as of many; None where it may well be terrain.

    least: rad, the angle by which the ground in view is off level at least, in each of so many frames.
    """
    if not frames or least <= STEEPEST:
        return None
    every = "the only frame" if frames == 1 else f"every one of {frames} frames"
    sentence = (
        f"the ground in view is off level by {degrees(least)} or more in {every}, which is steeper than terrain is on "
        "the whole; look at the unit and the sign of pitch, the inclinometer's axes and its mount (source.pitch.sign, "
        "source.camera_from_inclinometer, --pitch-down of an import)"
    )
    return Diagnosis(OFF_GROUND, sentence, False)


def _named(best: Cause, rivals: list[Cause], n: int, before: float, after: float) -> Diagnosis:
    if after > NOISIEST:
        return _inconsistent(n, before)
    fault = " or ".join([best.fault, *(rival.fault for rival in rivals if not _same(best, rival))])
    sentence = (
        f"{fault}: undone, tilt and camera agree to {degrees(after)}, as they stand to {degrees(before)} "
        f"({n} frames); {best.remedy}"
    )
    return Diagnosis(fault, sentence, True)


def _inconsistent(n: int, residual: float) -> Diagnosis:
    sentence = (
        f"tilt and camera disagree by {degrees(residual)} ({n} frames), and no single fault of the inclinometer "
        "explains it; check its axes, its unit, its mount, its clock, and whether it is shaken"
    )
    return Diagnosis(INCONSISTENT, sentence, True)


def _same(one: Cause, other: Cause) -> bool:
    """Whether two faults turn the inclinometer alike, as a sign does and a mount that is wrong by a right angle."""
    if one.undone is None or other.undone is None:
        return False
    return float(np.linalg.norm(one.undone - other.undone)) < SAME


def _passed(
    sound: Cause, axes: list[Cause], mount: Cause, offset: Cause | None, variance: float, n: int, residual: float
) -> Diagnosis:
    """The verdict where no fault is found: that there is none, or that the motion cannot tell."""
    if residual > NOISIEST:
        return _inconsistent(n, residual)
    if sound.ground > MARGIN:
        slope = GROUND * np.sqrt(sound.ground)
        sentence = (
            f"up is {degrees(slope)} off the ground's own normal ({n} frames): check the inclinometer's axes and "
            "source.camera_from_inclinometer; the rover has moved too little to tell which"
        )
        return Diagnosis(OFF_GROUND, sentence, False)
    open_ = any(cause.score(variance) - sound.score(variance) < MARGIN for cause in axes)
    hidden = ["exchanged or flipped axes"] if open_ else []
    if mount.error * np.sqrt(variance) > HIDDEN:
        hidden.append("a wrong mount")
    if offset is None or offset.error * np.sqrt(variance) > HIDDEN:
        hidden.append("a time offset")
    if hidden:
        which = " or ".join([", ".join(hidden[:-1]), hidden[-1]] if len(hidden) > 1 else hidden)
        return Diagnosis("", f"not enough motion in {n} frames to rule out {which}", False)
    return Diagnosis("", f"tilt and camera agree to {degrees(residual)} ({n} frames)", True)


def _wild(evidence: Evidence) -> Diagnosis | None:
    """Degrees taken for radians: up turns much more than the camera, which nothing fixed to it can do. How far the
    camera's turn may swing it, the ground's normal tells, from which up leans by `STEEPEST` at most."""
    near = np.flatnonzero(evidence.segments[1:] == evidence.segments[:-1])
    if len(near) < LEAST_FRAMES - 1:
        return None
    ups, cameras = evidence.ups, evidence.cameras
    swings = np.arccos(np.clip(np.sum(ups[near] * ups[near + 1], axis=1), -1, 1))
    turned = np.swapaxes(cameras[near], 1, 2) @ cameras[near + 1]
    turns = Rotation.from_matrix(turned).magnitude()
    normals = evidence.ground[near]
    with_ground = np.arccos(np.clip(np.einsum("ki,kij,kj->k", normals, turned, normals), -1, 1))
    lean = 2 * np.sin(STEEPEST) * np.sin(turns / 2)
    swing, most = float(np.median(swings)), float(np.median(np.fmin(turns, with_ground + lean)))  # NaN: no ground
    if not swing > max(float(np.median(np.fmin(WILD * turns, WILD * with_ground + lean))), WILD_ANGLE):
        return None
    sentence = (
        f"degrees are taken for radians: between frames up swings by {degrees(swing)}, by the camera's turns "
        f"{degrees(most)} at most ({len(near)} pairs of frames); check the unit of source.pitch and source.roll "
        "(deg, not rad), or the inclinometer's driver"
    )
    return Diagnosis("degrees are taken for radians", sentence, True)
