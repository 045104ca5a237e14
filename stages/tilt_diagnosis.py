"""What is wrong with a tilt, told without any truth: from the camera's own turns and the ground that it sees.

The images say how the camera turned since the first frame, so they carry every tilt back to that frame. There all must
point the same way: up. Each fault that a tilt can have is undone in turn, and the one counts that makes them agree, if
it does so beyond what noise can do. The ground in view is taken to lie level only on the whole, by some degrees; that
tells up from down, and a right angle, where the rover hardly moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

from stages.data import Array

NOISE = float(np.deg2rad(0.2))  # of a tilt, against which the camera's own drift is weighed until more is known
LEAST_NOISE = float(np.deg2rad(0.05))
GROUND = float(np.deg2rad(8))  # standard deviation of the slope of all ground in view
STEEPEST = float(np.deg2rad(20))  # ground that is steeper in every frame is taken for a wrong tilt
NOISIEST = float(np.deg2rad(2.0))  # beyond it tilt and camera do not agree, whatever the best explanation
MARGIN = 25.0  # by how much a fault must fit better than none, in units of the noise's variance: five sigma
RIVAL = 10.0  # and than other faults, or they are named with it
SAME = 0.3  # difference of two rotations, as a matrix, below which they are one fault under two names
HIDDEN = 0.33  # standard deviation of a fault, over the least that counts, beyond which a fault could go unseen
PARAMETER = 4.0  # by how much a fault must fit better for each number that is fitted to it
LEAST_FRAMES = 8
INCONSISTENT = "inconsistent"  # the fault of a tilt that no single fault explains
OFF_GROUND = "up is off the ground"  # of one that the ground contradicts, where the motion cannot tell why
LONGEST = 0.6  # s, of time offsets that are tried
SLOWEST = 1.5  # s between frames, beyond which no offset can be told
WILD = 4.0  # how many times more than the camera the tilt must turn to have a wrong unit
WILD_ANGLE = float(np.deg2rad(4))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What n frames show.

    stamps: (n,) int64 ns; segments: (n,) int, within which `cameras`, (n, 3, 3), turn vectors of the camera into those
    of the segment's first; drift: (n,) rad^2, variance of that turn; ups: (n, 3) in the inclinometer's frame; mount:
    (3, 3), from there to the camera; ground: (n, 3) upward normal of the ground in view in the camera, NaN if unknown.
    """

    stamps: Array
    segments: Array
    cameras: Array
    drift: Array
    ups: Array
    mount: Array
    ground: Array


@dataclass(frozen=True)
class Diagnosis:
    """fault: in a word or two, empty where none is found; sentence: what to tell the user; clear: whether there was
    motion enough to see every fault."""

    fault: str
    sentence: str
    clear: bool


@dataclass(frozen=True, eq=False)
class _Cause:
    """One explanation of the evidence, and how badly it fits: `misfit` in units of a tilt's variance, `ground` of its
    own."""

    fault: str
    remedy: str
    misfit: float
    ground: float
    parameters: int = 0
    size: float = np.inf  # how large it is, over the least that counts
    error: float = 0.0  # standard deviation of that, for tilts with that variance
    undone: Array | None = None  # what then turns the inclinometer's vectors into the camera's

    def score(self, variance: float) -> float:
        return self.misfit / variance + self.ground + PARAMETER * self.parameters


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
    n, fit = len(evidence.stamps), _Fit(evidence, noise)
    sound = _Cause("", "", fit.misfit(np.eye(3)), fit.slope(np.eye(3)))
    mount, offset = _mount(fit, least_angle), _offset(fit, sound, least_offset)
    axes = [
        _Cause(fault, remedy, fit.misfit(undo), fit.slope(undo), 1, undone=evidence.mount @ undo)
        for fault, remedy, undo in _exchanges()
        if undo[2, 2] > 0 or fit.normal is not None  # a motion alone does not tell up from down
    ]
    causes = [*axes, *_scaled(fit), mount, *([offset] if offset else [])]
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
        f"the ground in view is off level by {_deg(least)} or more in {every}, which is steeper than terrain is on the "
        "whole; look at the unit and the sign of pitch, the inclinometer's axes and its mount (source.pitch.sign, "
        "source.camera_from_inclinometer, --pitch-down of an import)"
    )
    return Diagnosis(OFF_GROUND, sentence, False)


def _named(best: _Cause, rivals: list[_Cause], n: int, before: float, after: float) -> Diagnosis:
    if after > NOISIEST:
        return _inconsistent(n, before)
    fault = " or ".join([best.fault, *(rival.fault for rival in rivals if not _same(best, rival))])
    sentence = (
        f"{fault}: undone, tilt and camera agree to {_deg(after)}, as they stand to {_deg(before)} ({n} frames); "
        f"{best.remedy}"
    )
    return Diagnosis(fault, sentence, True)


def _inconsistent(n: int, residual: float) -> Diagnosis:
    sentence = (
        f"tilt and camera disagree by {_deg(residual)} ({n} frames), and no single fault of the inclinometer explains "
        "it; check its axes, its unit, its mount, its clock, and whether it is shaken"
    )
    return Diagnosis(INCONSISTENT, sentence, True)


def _same(one: _Cause, other: _Cause) -> bool:
    """Whether two faults turn the inclinometer alike, as a sign does and a mount that is wrong by a right angle."""
    if one.undone is None or other.undone is None:
        return False
    return float(np.linalg.norm(one.undone - other.undone)) < SAME


def _passed(
    sound: _Cause, axes: list[_Cause], mount: _Cause, offset: _Cause | None, variance: float, n: int, residual: float
) -> Diagnosis:
    """The verdict where no fault is found: that there is none, or that the motion cannot tell."""
    if residual > NOISIEST:
        return _inconsistent(n, residual)
    if sound.ground > MARGIN:
        slope = GROUND * np.sqrt(sound.ground)
        sentence = (
            f"up is {_deg(slope)} off the ground's own normal ({n} frames): check the inclinometer's axes and "
            "source.camera_from_inclinometer; the rover has moved too little to tell which"
        )
        return Diagnosis(OFF_GROUND, sentence, False)
    open_ = [c.fault for c in axes if c.score(variance) - sound.score(variance) < MARGIN]
    hidden = ["exchanged or flipped axes"] if open_ else []
    if mount.error * np.sqrt(variance) > HIDDEN:
        hidden.append("a wrong mount")
    if offset is None or offset.error * np.sqrt(variance) > HIDDEN:
        hidden.append("a time offset")
    if hidden:
        which = " or ".join([", ".join(hidden[:-1]), hidden[-1]] if len(hidden) > 1 else hidden)
        return Diagnosis("", f"not enough motion in {n} frames to rule out {which}", False)
    return Diagnosis("", f"tilt and camera agree to {_deg(residual)} ({n} frames)", True)


class _Fit:
    """How well tilts, changed by some hypothesis, agree once the camera's turns carry them to one frame."""

    def __init__(self, evidence: Evidence, noise: float) -> None:
        self.evidence, self.noise = evidence, noise
        self.ups = evidence.ups @ evidence.mount.T
        self.operator = _operator(evidence.segments, evidence.drift, noise)
        known = np.isfinite(evidence.ground).all(axis=1)
        self.normal = evidence.ground[known].mean(axis=0) if known.any() else None
        self.known = known

    def carried(self, ups: Array, cameras: Array | None = None) -> Array:
        """Residuals (n, 3), whitened, of directions in the camera."""
        turned = np.einsum("kij,kj->ki", self.evidence.cameras if cameras is None else cameras, ups)
        residuals: Array = self.operator @ turned
        return residuals

    def misfit(self, undo: Array) -> float:
        """The squared residuals after `undo`, (3, 3), has changed the inclinometer's vectors."""
        return float(np.sum(np.square(self.carried(self.evidence.ups @ (self.evidence.mount @ undo).T))))

    def slope(self, undo: Array) -> float:
        """The squared slope of the ground in view, on the average, in units of what is likely."""
        return self.slope_of(self.evidence.ups @ (self.evidence.mount @ undo).T)

    def slope_of(self, ups: Array) -> float:
        """The same for directions in the camera."""
        if self.normal is None:
            return 0.0
        return float(np.sum(np.square(self.normal - ups[self.known].mean(axis=0)))) / GROUND**2


def _operator(segments: Array, drift: Array, noise: float) -> Array:
    """The matrix (n, n) that whitens the residuals of each segment and takes its mean away."""
    n = len(segments)
    covariance = np.where(segments[:, None] == segments, np.minimum(drift[:, None], drift), 0.0)
    first = np.array([drift[segments == segment].min() for segment in segments])
    covariance -= np.where(segments[:, None] == segments, np.minimum(first[:, None], first), 0.0)
    whitening = np.linalg.inv(np.linalg.cholesky(noise**2 * np.eye(n) + covariance))
    means = whitening @ (segments[:, None] == np.unique(segments)).astype(float)
    basis = np.linalg.qr(means)[0]
    operator: Array = whitening - basis @ (basis.T @ whitening)
    return operator


@cache
def _exchanges() -> tuple[tuple[str, str, Array], ...]:
    """Flipped signs and exchanged axes: their names, what to do, and the matrix that undoes each."""
    found = []
    for swapped, x, y, z in product((False, True), (1, -1), (1, -1), (1, -1)):
        if (swapped, x, y, z) == (False, 1, 1, 1):
            continue
        flips = np.diag([float(x), float(y), float(z)])
        undo = flips[[1, 0, 2]] if swapped else flips
        names = [name for name, sign in (("pitch", x), ("roll", y), ("up", z)) if sign < 0]
        parts = ["pitch and roll are exchanged"] if swapped else []
        if names:
            flipped = f"{'the signs' if len(names) > 1 else 'the sign'} of {' and '.join(names)}"
            parts.append(f"{flipped} {'are' if len(names) > 1 else 'is'} flipped")
        settings = ["the fields of source.pitch and source.roll"] if swapped else []
        settings += [f"source.{name}.sign" for name in names if name != "up"]
        settings += ["whether up or down is meant"] if z < 0 else []
        remedy = f"check {' and '.join(settings)}, or the axes of the inclinometer's driver"
        found.append((" and ".join(parts), remedy, undo))
    return tuple(found)


def _scaled(fit: _Fit) -> list[_Cause]:
    """Radians taken for degrees: the tilt hardly leaves the vertical."""
    level = fit.evidence.ups[:, :2] * (180 / np.pi)
    rest = 1 - np.sum(np.square(level), axis=1)
    if np.any(rest < 0):
        return []
    ups = np.column_stack([level, np.sqrt(rest)]) @ fit.evidence.mount.T
    misfit = float(np.sum(np.square(fit.carried(ups))))
    remedy = "check the unit of source.pitch and source.roll (rad, not deg), or the inclinometer's driver"
    return [_Cause("radians are taken for degrees", remedy, misfit, fit.slope_of(ups), 1)]


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
        f"degrees are taken for radians: between frames up swings by {_deg(swing)}, by the camera's turns {_deg(most)} "
        f"at most ({len(near)} pairs of frames); check the unit of source.pitch and source.roll (deg, not rad), "
        "or the inclinometer's driver"
    )
    return Diagnosis("degrees are taken for radians", sentence, True)


@cache
def _right_angles() -> Array:
    """The 24 rotations (24, 3, 3) that map axes to axes; the first is none."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.diag(signs)[list(order)]
        if np.linalg.det(matrix) > 0:
            found.append(matrix)
    return np.array(sorted(found, key=lambda matrix: -np.trace(matrix)))


def _mount(fit: _Fit, least: float) -> _Cause:
    """The rotation that the mount lacks, by Gauss-Newton from the most fitting of all right angles."""
    mount = fit.evidence.mount
    starts = [mount @ turn @ mount.T for turn in _right_angles()]
    cost = [float(np.sum(np.square(fit.carried(fit.ups @ s.T)))) + fit.slope_of(fit.ups @ s.T) for s in starts]
    turn = starts[int(np.argmin(cost))] if min(cost) < 0.25 * cost[0] else np.eye(3)
    for _ in range(8):
        ups = fit.ups @ turn.T
        # d(exp(e) u) / de = -[u]x
        x, y, z = ups.T
        o = np.zeros_like(x)
        slopes = np.array([[o, z, -y], [-z, o, x], [y, -x, o]]).transpose(2, 0, 1)
        carried = np.einsum("kij,kjl->kil", fit.evidence.cameras, slopes)
        columns = np.einsum("mk,kil->mil", fit.operator, carried).reshape(-1, 3)
        normal = columns.T @ columns + np.eye(3)  # what the motion cannot tell stays where it is
        change = -np.linalg.solve(normal, columns.T @ fit.carried(ups).ravel())
        turn = Rotation.from_rotvec(change).as_matrix() @ turn
    ups = fit.ups @ turn.T
    error = Rotation.from_matrix(turn).as_rotvec()
    angle = float(np.linalg.norm(error))
    spread = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal))[-1]))
    along = mount.T @ error / max(angle, 1e-12)
    x, y, z, w = Rotation.from_matrix(turn @ mount).as_quat(canonical=True)
    fault = f"the mount of the inclinometer is wrong by {_deg(angle)}"
    remedy = (
        f"it is turned by that about ({along[0]:.2f}, {along[1]:.2f}, {along[2]:.2f}) of its own axes; check "
        f"/tf_static, or set source.camera_from_inclinometer to [{x:.4f}, {y:.4f}, {z:.4f}, {w:.4f}]"
    )
    misfit = float(np.sum(np.square(fit.carried(ups))))
    return _Cause(fault, remedy, misfit, fit.slope_of(ups), 3, angle / least, spread / least, turn @ mount)


def _offset(whole: _Fit, sound: _Cause, least: float) -> _Cause | None:
    """The time by which the tilt's stamps are late; None where frames are too far apart or too few to tell."""
    evidence = whole.evidence
    within, splines = _splines(evidence)
    kept = within >= 0
    if np.count_nonzero(kept) < LEAST_FRAMES:
        return None
    part = Evidence(
        evidence.stamps[kept], evidence.segments[kept], evidence.cameras[kept], evidence.drift[kept],
        evidence.ups[kept], evidence.mount, evidence.ground[kept],
    )  # fmt: skip
    fit = _Fit(part, whole.noise)
    seconds = (part.stamps - evidence.stamps[0]) / 1e9

    def misfit(late: float) -> float:
        cameras = np.empty_like(part.cameras)
        for stretch, spline in splines.items():
            inside = within[kept] == stretch
            if inside.any():
                cameras[inside] = spline(seconds[inside] - late).as_matrix()
        return float(np.sum(np.square(fit.carried(fit.ups, cameras))))

    step = 0.05
    times = np.arange(-LONGEST, LONGEST + step / 2, step)
    costs = np.array([misfit(float(late)) for late in times])
    place = int(np.clip(np.argmin(costs), 1, len(times) - 2))
    low, middle, high = costs[place - 1 : place + 2]
    bend = max((low - 2 * middle + high) / step**2, 1e-9)
    late = float(np.clip(times[place] - (high - low) / (2 * step) / bend, -LONGEST, LONGEST))
    misfit_best = misfit(late)
    gained = misfit(0.0) - misfit_best
    way = "late" if late > 0 else "early"
    fault = f"the tilt's stamps are {abs(late) * 1000:.0f} ms {way}"
    remedy = "check the clocks of camera and inclinometer, and what delays the driver"
    return _Cause(
        fault, remedy, max(sound.misfit - gained, misfit_best), sound.ground, 1, abs(late) / least,
        float(np.sqrt(2 / bend)) / least,
    )  # fmt: skip


def _splines(evidence: Evidence) -> tuple[Array, dict[int, RotationSpline]]:
    """Per stretch of rising stamps without long gaps the camera's turn as a function of time, s; and for each frame its
    stretch, -1 for one that does not lie `LONGEST` within its own."""
    seconds = (evidence.stamps - evidence.stamps[0]) / 1e9
    steps = np.diff(seconds)
    breaks = (steps <= 0) | (steps > SLOWEST) | (np.diff(evidence.segments) != 0)
    stretches = np.concatenate([[0], np.cumsum(breaks)])
    within, splines = np.full(len(seconds), -1), dict[int, RotationSpline]()
    for stretch in np.unique(stretches):
        inside = stretches == stretch
        times = seconds[inside]
        if len(times) < 4:
            continue
        splines[int(stretch)] = RotationSpline(times, Rotation.from_matrix(evidence.cameras[inside]))
        within[inside & (seconds - LONGEST >= times[0]) & (seconds + LONGEST <= times[-1])] = stretch
    return within, splines


def _deg(angle: float) -> str:
    degrees = float(np.rad2deg(angle))
    return f"{degrees:.2f} degrees" if degrees < 1 else f"{degrees:.1f} degrees"
