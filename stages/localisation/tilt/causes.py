"""Candidate faults of a tilt, each fitted to the evidence, and how well it explains it.

The camera's rotations transform every tilt to the first frame. There all tilts must be equal once the fault is undone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.data import Array
from stages.data.rotations import canonical, quaternion_of, turn_by

if TYPE_CHECKING:
    from scipy.spatial.transform import RotationSpline

GROUND_SIGMA = float(np.deg2rad(8))  # rad, of the mean slope of the ground in view
PARAMETER_COST = 4.0  # added to the score for each fitted number
MIN_FRAMES = 8
MIN_ANGLE = float(np.deg2rad(2.0))  # rad, of a mount error that is a fault
MIN_SPREAD = float(np.deg2rad(0.5))  # rad, RMS of an axis's directions that show how quaternions are misread
MIN_OFFSET = 0.08  # s, of a time offset that is a fault
MAX_OFFSET, MAX_LARGE_OFFSET = 0.6, 3.0  # s, of the time offsets tried; the large ones if the tilt is not sound
MAX_FRAME_GAP = 1.5  # s, for a time offset to be measurable

_Z_DOWN = "Check the axes of the inclinometer's driver; z of its frame must point up where /tf_static has it so."
_TURN = (
    "z of its frame points down, as in FRD. Rotate the inclinometer's frame by 180 degrees about {axis} in /tf_static, "
    "or convert the messages to a frame whose z points up (FLU). Quaternions with w first look alike: their order must "
    "be x, y, z, w."
)
_REVERSED = (
    "If the log has orientations, z of their world points down, as in NED; convert them to a world with z up (ENU). If "
    "it has accelerations, their sign is opposite: at rest an accelerometer reads +9.8 m/s2 along the axis that points "
    "up. 'accelerations' of the source, with their field and sign -1, negates them."
)
_UPSIDE_DOWN = {  # exchanged, signs of pitch and roll -> fault and remedy, where the sign of up is flipped too
    (False, -1, -1): ("up and down are exchanged", _REVERSED),
    (False, 1, -1): ("the signs of roll and up are flipped", _TURN.format(axis="x")),
    (False, -1, 1): ("the signs of pitch and up are flipped", _TURN.format(axis="y")),
}
_MISREAD = (  # fault, remedy, axis of the inclinometer whose direction in the world is read as up, and mirrored by
    (
        "the quaternions are inverse, from the world to the inclinometer's frame",
        "They must rotate its frame into the world (REP 145). Negate x, y and z in the driver or the log.",
        (0.0, 0.0, 1.0), np.eye(3),
    ),
    (
        "the quaternions have w first",
        "Their order must be x, y, z, w. Correct the driver or the log.",
        (1.0, 0.0, 0.0), np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    ),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Evidence:
    """The measurements of n frames."""

    stamps: Array  # (n,) int64, ns
    segments: Array  # (n,) int, of visual odometry
    cameras: Array  # (n, 3, 3), rotation from the camera to the first camera of its segment
    drift: Array  # (n,) rad^2, variance of that rotation
    ups: Array  # (n, 3), in the inclinometer's frame
    mount: Array  # (3, 3), rotation from the inclinometer to the camera
    ground: Array  # (n, 3), upward normal of the ground in view, in the camera; NaN if unknown
    estimated: bool = False  # from accelerations and rates


@dataclass(frozen=True, eq=False)
class Cause:
    """One explanation of the evidence."""

    fault: str
    remedy: str
    misfit: float  # squared residuals, over a tilt's variance
    ground: float  # squared slope of the ground, over its variance
    parameters: int = 0  # fitted numbers
    size: float = np.inf  # over the smallest that is a fault
    error: float = 0.0  # standard deviation of the size, for tilts with that variance
    jumps: float = np.nan  # half of the squared differences of residuals between frames, over a tilt's variance
    undone: Array | None = None  # the corrected rotation from the inclinometer to the camera

    def score(self, variance: float) -> float:
        """Misfit in all, for tilts with that variance; the lowest score is the best explanation."""
        return self.misfit / variance + self.ground + PARAMETER_COST * self.parameters


class Fit:
    """How well tilts agree under a hypothesis, once the camera's rotations transform them to one frame."""

    def __init__(self, evidence: Evidence, noise: float) -> None:
        self.evidence, self.noise = evidence, noise
        self.ups = evidence.ups @ evidence.mount.T
        self.operator = _operator(evidence.segments, evidence.drift, noise)
        known = np.isfinite(evidence.ground).all(axis=1)
        self.normal = evidence.ground[known].mean(axis=0) if known.any() else None
        self.known = known

    def residuals(self, ups: Array, cameras: Array | None = None) -> Array:
        """Whitened residuals (n, 3) of directions in the camera."""
        turned = np.einsum("kij,kj->ki", self.evidence.cameras if cameras is None else cameras, ups)
        return np.asarray(self.operator @ turned)

    def misfit(self, ups: Array, cameras: Array | None = None) -> float:
        """Squared residuals of directions in the camera."""
        return float(np.sum(np.square(self.residuals(ups, cameras))))

    def jumps(self, ups: Array) -> float:
        """Half of the squared differences of residuals between frames; as large as the misfit if these are noise."""
        within = self.evidence.segments[1:] == self.evidence.segments[:-1]
        return float(np.sum(np.square(np.diff(self.residuals(ups), axis=0)[within]))) / 2

    def slope(self, ups: Array) -> float:
        """Squared mean slope of the ground in view, over its variance, by directions in the camera."""
        if self.normal is None:
            return 0.0
        return float(np.sum(np.square(self.normal - ups[self.known].mean(axis=0)))) / GROUND_SIGMA**2

    def cause(self, fault: str, remedy: str, ups: Array, parameters: int = 0, **more: Any) -> Cause:
        """The cause `fault`, judged by the directions (n, 3) in the camera that up has once it is undone."""
        return Cause(fault, remedy, self.misfit(ups), self.slope(ups), parameters, **more)


def _operator(segments: Array, drift: Array, noise: float) -> Array:
    """The matrix (n, n) that whitens the residuals of each segment and removes its mean."""
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
    """Flipped signs and exchanged axes; motion alone does not determine the sign of up."""
    found = []
    for fault, remedy, undo in _exchanges():
        if undo[2, 2] > 0 or fit.normal is not None:
            mount = fit.evidence.mount @ undo
            found.append(fit.cause(fault, remedy, fit.evidence.ups @ mount.T, 1, undone=mount))
    return found


@cache
def _exchanges() -> tuple[tuple[str, str, Array], ...]:
    """Flipped signs and exchanged axes: name, remedy, and the matrix that undoes each."""
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
        fault = " and ".join(parts)
        remedy = f"Check the axes of the inclinometer's driver; for a log of bare angles, {' and '.join(settings)}."
        if z < 0:  # no setting of bare angles does that
            own, remedy = _UPSIDE_DOWN.get((swapped, x, y), (fault, _Z_DOWN))
            fault = f"{own}: by the tilt the rover is upside down"
        found.append((fault, remedy, undo))
    return tuple(found)


def radians_as_degrees(fit: Fit) -> Cause | None:
    """Radians taken for degrees, which makes the tilt nearly vertical; None if it is too large for that."""
    level = fit.evidence.ups[:, :2] * (180 / np.pi)
    rest = 1 - np.sum(np.square(level), axis=1)
    if np.any(rest < 0):
        return None
    ups = np.column_stack([level, np.sqrt(rest)]) @ fit.evidence.mount.T
    remedy = "Check the unit of source.pitch and source.roll (rad, not deg), or the inclinometer's driver."
    return fit.cause("radians are taken for degrees", remedy, ups, 1)


def misread_quaternions(fit: Fit) -> list[Cause]:
    """Quaternions read in another convention: "up" is then the direction in the world of an axis of the inclinometer.

    The camera's rotations show these directions but for the attitude of each segment's first frame, which is fitted.
    There are no causes if these are too much alike for that.
    """
    evidence, found = fit.evidence, list[Cause]()
    segments = np.unique(evidence.segments)
    for fault, remedy, axis, mirror in _MISREAD:
        seen = evidence.cameras @ (evidence.mount @ axis)  # in the first camera of the segment
        read = evidence.ups @ mirror
        residuals, ups, spread = np.empty_like(seen), np.empty_like(seen), 0.0
        for inside in (evidence.segments == segment for segment in segments):
            left, _, right = np.linalg.svd(read[inside].T @ seen[inside])
            world = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
            residuals[inside] = read[inside] - seen[inside] @ world.T
            ups[inside] = world[2] @ evidence.cameras[inside]
            spread += float(np.sum(np.var(seen[inside], axis=0))) * np.count_nonzero(inside)
        if spread > MIN_SPREAD**2 * len(seen):
            misfit = float(np.sum(np.square(fit.operator @ residuals)))
            found.append(Cause(fault, remedy, misfit, fit.slope(ups), 1 + len(segments)))
    return found


@cache
def _right_angles() -> Array:
    """The 24 rotations (24, 3, 3) that map axes to axes, the identity first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.diag(signs)[list(order)]
        if np.linalg.det(matrix) > 0:
            found.append(matrix)
    return np.array(sorted(found, key=lambda matrix: -np.trace(matrix)))


def wrong_mount(fit: Fit) -> Cause:
    """The rotation missing from the mount, by Gauss-Newton from the best right angle of the inclinometer or camera."""
    from scipy.spatial.transform import Rotation  # takes long to import

    mount = fit.evidence.mount
    starts = [*(mount @ turn @ mount.T for turn in _right_angles()), *_right_angles()]
    cost = [fit.misfit(fit.ups @ s.T) + fit.slope(fit.ups @ s.T) for s in starts]
    turn = starts[int(np.argmin(cost))] if min(cost) < 0.25 * cost[0] else np.eye(3)
    for _ in range(8):
        ups = fit.ups @ turn.T
        # d(exp(e) u) / de = -[u]x
        x, y, z = ups.T
        o = np.zeros_like(x)
        jacobian = np.array([[o, z, -y], [-z, o, x], [y, -x, o]]).transpose(2, 0, 1)
        turned = np.einsum("kij,kjl->kil", fit.evidence.cameras, jacobian)
        columns = np.einsum("mk,kil->mil", fit.operator, turned).reshape(-1, 3)
        normal = columns.T @ columns + np.eye(3)  # a prior for directions that the motion does not determine
        change = -np.linalg.solve(normal, columns.T @ fit.residuals(ups).ravel())
        turn = turn_by(change) @ turn
    ups = fit.ups @ turn.T
    error = Rotation.from_matrix(turn).as_rotvec()
    angle = float(np.linalg.norm(error))
    sigma = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal))[-1]))
    along = mount.T @ error / max(angle, 1e-12)
    x, y, z, w = canonical(quaternion_of(turn @ mount))
    fault = f"the mount of the inclinometer is wrong by {degrees(angle)}"
    remedy = (
        f"It is rotated by {degrees(angle)} about axis ({along[0]:.2f}, {along[1]:.2f}, {along[2]:.2f}). Correct "
        "/tf_static. If the camera is right in it, or the log has none, set source.camera_from_inclinometer to "
        f"[{x:.4f}, {y:.4f}, {z:.4f}, {w:.4f}] instead."
    )
    size, error = angle / MIN_ANGLE, sigma / MIN_ANGLE
    return fit.cause(fault, remedy, ups, 3, size=size, error=error, jumps=fit.jumps(ups), undone=turn @ mount)


def late_stamps(whole: Fit, sound: Cause, limit: float) -> Cause | None:
    """The delay of the tilt's stamps, at most `limit` s; None if frames are too far apart or too few to measure it."""
    evidence = whole.evidence
    within, splines = _splines(evidence, limit)
    kept = within >= 0
    if np.count_nonzero(kept) < MIN_FRAMES:
        return None
    part = Evidence(
        evidence.stamps[kept], evidence.segments[kept], evidence.cameras[kept], evidence.drift[kept],
        evidence.ups[kept], evidence.mount, evidence.ground[kept],
    )  # fmt: skip
    fit = Fit(part, whole.noise)
    seconds = (part.stamps - evidence.stamps[0]) / 1e9

    def misfits(*late: float) -> list[float]:
        """With the tilt delayed by each of these times, s."""
        cameras = np.empty((len(late), *part.cameras.shape))
        for stretch, spline in splines.items():
            inside = within[kept] == stretch
            if inside.any():
                turns = spline(np.subtract.outer(seconds[inside], late).T.ravel())  # at once: each call takes 0.1 ms
                cameras[:, inside] = turns.as_matrix().reshape(len(late), -1, 3, 3)
        return [fit.misfit(fit.ups, each) for each in cameras]

    step = 0.05
    times = np.arange(-limit, limit + step / 2, step)
    costs = misfits(*times)
    lowest = int(np.clip(np.argmin(costs), 1, len(times) - 2))
    low, middle, high = costs[lowest - 1 : lowest + 2]
    curvature = max((low - 2 * middle + high) / step**2, 1e-9)
    late = float(np.clip(times[lowest] - (high - low) / (2 * step) / curvature, -limit, limit))
    misfit_best, misfit_sound = misfits(late, 0.0)
    left = sound.misfit * misfit_best / max(misfit_sound, 1e-9)
    fault = f"the tilt's stamps are {abs(late) * 1000:.0f} ms {'late' if late > 0 else 'early'}"
    remedy = (
        f"Set source.time_offset.inclinometer to {-late * 1000:.0f} ms, plus its present value, or correct the clocks "
        "or the driver."
    )
    return Cause(
        fault, remedy, left, sound.ground, 1, abs(late) / MIN_OFFSET,
        float(np.sqrt(2 / curvature)) / MIN_OFFSET,
    )  # fmt: skip


def _splines(evidence: Evidence, margin: float) -> tuple[Array, dict[int, RotationSpline]]:
    """The camera's rotation over time, s, for each stretch of rising stamps without long gaps; and the stretch of each
    frame, -1 within `margin` s of its ends."""
    from scipy.spatial.transform import Rotation, RotationSpline  # takes long to import

    seconds = (evidence.stamps - evidence.stamps[0]) / 1e9
    steps = np.diff(seconds)
    breaks = (steps <= 0) | (steps > MAX_FRAME_GAP) | (np.diff(evidence.segments) != 0)
    stretches = np.concatenate([[0], np.cumsum(breaks)])
    within, splines = np.full(len(seconds), -1), dict[int, RotationSpline]()
    for stretch in np.unique(stretches):
        inside = stretches == stretch
        times = seconds[inside]
        if len(times) < 4:
            continue
        splines[int(stretch)] = RotationSpline(times, Rotation.from_matrix(evidence.cameras[inside]))
        within[inside & (seconds - margin >= times[0]) & (seconds + margin <= times[-1])] = stretch
    return within, splines


def degrees(angle: float) -> str:
    """An angle, rad, as text in degrees."""
    size = float(np.rad2deg(angle))
    return f"{size:.2f} degrees" if size < 1 else f"{size:.1f} degrees"
