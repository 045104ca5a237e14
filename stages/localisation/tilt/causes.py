"""What may be wrong with a tilt: each fault that it can have, as large as suits the evidence best, and how well.

The camera's turns carry every tilt back to the first frame, where all must point the same way once the fault is undone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

from stages.data import Array

GROUND = float(np.deg2rad(8))  # standard deviation of the slope of all ground in view
PARAMETER = 4.0  # by how much a fault must fit better for each number that is fitted to it
LEAST_FRAMES = 8
LONGEST = 0.6  # s, of time offsets that are tried
SLOWEST = 1.5  # s between frames, beyond which no offset can be told


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


@dataclass(frozen=True, eq=False)
class Cause:
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
        """How badly it explains tilts with that variance; each number that is fitted must pay."""
        return self.misfit / variance + self.ground + PARAMETER * self.parameters


class Fit:
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
        return self.misfit_of(self.evidence.ups @ (self.evidence.mount @ undo).T)

    def misfit_of(self, ups: Array, cameras: Array | None = None) -> float:
        """The same for directions in the camera."""
        return float(np.sum(np.square(self.carried(ups, cameras))))

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


def exchanged_axes(fit: Fit) -> list[Cause]:
    """Flipped signs and exchanged axes; a motion alone does not tell up from down."""
    return [
        Cause(fault, remedy, fit.misfit(undo), fit.slope(undo), 1, undone=fit.evidence.mount @ undo)
        for fault, remedy, undo in _exchanges()
        if undo[2, 2] > 0 or fit.normal is not None
    ]


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


def radians_as_degrees(fit: Fit) -> Cause | None:
    """Radians taken for degrees: the tilt hardly leaves the vertical; None where it leaves that too far."""
    level = fit.evidence.ups[:, :2] * (180 / np.pi)
    rest = 1 - np.sum(np.square(level), axis=1)
    if np.any(rest < 0):
        return None
    ups = np.column_stack([level, np.sqrt(rest)]) @ fit.evidence.mount.T
    remedy = "check the unit of source.pitch and source.roll (rad, not deg), or the inclinometer's driver"
    return Cause("radians are taken for degrees", remedy, fit.misfit_of(ups), fit.slope_of(ups), 1)


@cache
def _right_angles() -> Array:
    """The 24 rotations (24, 3, 3) that map axes to axes; the first is none."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.diag(signs)[list(order)]
        if np.linalg.det(matrix) > 0:
            found.append(matrix)
    return np.array(sorted(found, key=lambda matrix: -np.trace(matrix)))


def wrong_mount(fit: Fit, least: float) -> Cause:
    """The rotation that the mount lacks, by Gauss-Newton from the most fitting of all right angles."""
    mount = fit.evidence.mount
    starts = [mount @ turn @ mount.T for turn in _right_angles()]
    cost = [fit.misfit_of(fit.ups @ s.T) + fit.slope_of(fit.ups @ s.T) for s in starts]
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
    fault = f"the mount of the inclinometer is wrong by {degrees(angle)}"
    remedy = (
        f"it is turned by that about ({along[0]:.2f}, {along[1]:.2f}, {along[2]:.2f}) of its own axes; check "
        f"/tf_static, or set source.camera_from_inclinometer to [{x:.4f}, {y:.4f}, {z:.4f}, {w:.4f}]"
    )
    return Cause(
        fault, remedy, fit.misfit_of(ups), fit.slope_of(ups), 3, angle / least, spread / least, turn @ mount
    )  # fmt: skip


def late_stamps(whole: Fit, sound: Cause, least: float) -> Cause | None:
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
    fit = Fit(part, whole.noise)
    seconds = (part.stamps - evidence.stamps[0]) / 1e9

    def misfit(late: float) -> float:
        cameras = np.empty_like(part.cameras)
        for stretch, spline in splines.items():
            inside = within[kept] == stretch
            if inside.any():
                cameras[inside] = spline(seconds[inside] - late).as_matrix()
        return fit.misfit_of(fit.ups, cameras)

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
    return Cause(
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


def degrees(angle: float) -> str:
    """An angle, rad, in words."""
    size = float(np.rad2deg(angle))
    return f"{size:.2f} degrees" if size < 1 else f"{size:.1f} degrees"
