"""A Kalman filter for gravity in the gyroscope's frame, with the biases of both sensors, and its smoother.

The state is the force of gravity s, m/s^2, in the frame that the gyroscope integrates to, and the biases b of the
gyroscope and a of the accelerometer, in the sensor's frame. With C the rotation from the sensor to that frame:

    ds/dt = C (b - bias used) x s + noise        mean acceleration = s + mean C a + disturbance

So the model is nearly linear and no heading is needed. The length of s is part of the state: gravity is measured.
At rest the disturbance is small, so accelerations that turn show a rate across gravity. A steady turn about gravity
looks like rest and a bias. A mean rate of `MIN_TURN` or more at rest may be such a turn. The state then contains its
rate t, whose sigma is the mean rate when the rest begins:

    rate about gravity = b about gravity + t + noise        at rest

The smoother is that of Rauch, Tung and Striebel (1965).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recordings.inertial.blocks import BLOCK_NS, MAX_REST_RATE_STD, Blocks
from stages.data import Array
from stages.data.covariance import cross_matrix

# Of common MEMS sensors; rates in rad/s, accelerations in m/s^2, densities for 1 Hz.
GYROSCOPE_NOISE = 5e-4
GYROSCOPE_SCALE = 0.005  # share of an angle
GYROSCOPE_BIAS_SIGMA = 0.1
GYROSCOPE_RESTART_SIGMA = 0.02  # of the change of a bias if the sensor was off
GYROSCOPE_BIAS_WALK = 2e-5
GYROSCOPE_BIAS_STEP = GYROSCOPE_RESTART_SIGMA / np.sqrt(10)  # walk of a bias that changes within ten seconds
ACCELEROMETER_BIAS_WALK = 1e-4
REST_RATE_SIGMA = 5e-4  # of a mean rate at rest: instability of the bias, and the planet's own rotation
MIN_TURN = 0.01  # of a rover; a smaller mean rate at rest is a bias about all axes
REST_SIGMA = 0.005  # of a mean acceleration at rest
MIN_DISTURBANCE = 0.02**2  # (m/s^2)^2/Hz, of a sensor that moves
START_SIGMA = 0.5  # of gravity before the first block
GIVEN_GRAVITY_SIGMA = 0.02
USUAL_DISTURBANCE = 0.02  # (m/s^2)^2/Hz, of a rover that drives
USUAL_BLOCKS = 100  # measured blocks that count as much as the usual disturbance
DISTURBANCE_BLOCKS = 100  # over which the disturbance is measured
DISTURBANCE_SPANS = (1, 2, 4, 8, 16)  # blocks
MAX_SURPRISE = 3.0  # sigmas; a block that is farther off counts less
LASTING_BLOCKS = 50  # whose median surprise shows a change of the gyroscope's bias
LASTING_SURPRISE = 2.5  # sigmas of that median

S, B, A, T = slice(0, 3), slice(3, 6), slice(6, 9), 9
SIZE = 10


@dataclass(frozen=True)
class GravityState:
    """Mean (10,) and covariance (10, 10)."""

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class FilterStep:
    """One block: the transition (10, 10) to it, the state predicted, the state with its measurements, whether the
    sensor is at rest, and how far the acceleration is off the predicted one: (3,) sigmas, NaN where there is none."""

    transition: Array
    predicted: GravityState
    updated: GravityState
    rest: bool
    off: Array


def first_state(force: Array, accelerometer_bias: float, gravity: float | None) -> GravityState:
    """The state before the first block; force: (3,) m/s^2 of the first accelerations; gravity: its magnitude, if it is
    known."""
    up = force / np.linalg.norm(force)
    variances = np.repeat([START_SIGMA**2, GYROSCOPE_BIAS_SIGMA**2, accelerometer_bias**2], 3)
    covariance: Array = np.diag([*variances, 0.0])
    if gravity is not None:
        covariance[S, S] -= (START_SIGMA**2 - GIVEN_GRAVITY_SIGMA**2) * np.outer(up, up)
    return GravityState(np.concatenate([force if gravity is None else gravity * up, np.zeros(SIZE - 3)]), covariance)


def restarted(state: GravityState, force: Array, seconds: float, gravity: float | None) -> GravityState:
    """The state after a gap of `seconds`: gravity is new in a new frame, the biases have drifted or, of the gyroscope,
    changed with a restart of the sensor.

    force, gravity: as of `first_state`.
    """
    first = first_state(force, 0.0, gravity)
    covariance = first.covariance
    drift = GYROSCOPE_RESTART_SIGMA**2 + GYROSCOPE_BIAS_WALK**2 * seconds
    covariance[B, B] = state.covariance[B, B] + drift * np.eye(3)
    covariance[A, A] = state.covariance[A, A] + ACCELEROMETER_BIAS_WALK**2 * seconds * np.eye(3)
    return GravityState(np.concatenate([first.mean[S], state.mean[3:]]), covariance)


def disturbance(forces: Array) -> float:
    """Density, (m/s^2)^2/Hz, of a white noise that disturbs means as much as the sensor's motion does.

    forces: (n, 3) of blocks in motion. The variance of a mean of T seconds, times T, is that density where it is white;
    slow accelerations show in the longer means. The largest counts. A drift of the gyroscope is a trend, left out.
    Few blocks measure it badly, so it is drawn to the usual one.
    """
    number = len(forces)
    if number < 2 * DISTURBANCE_SPANS[1]:
        return MIN_DISTURBANCE
    line = np.column_stack([np.ones(number), np.linspace(-1, 1, number)])
    rest = forces - line @ np.linalg.lstsq(line, forces, rcond=None)[0]
    densities = []
    for span in DISTURBANCE_SPANS:
        means = number // span
        if means >= 4:
            part = rest[: means * span].reshape(means, span, 3).mean(axis=1)
            densities.append(float(part.var(axis=0, ddof=1).mean()) * span * BLOCK_NS / 1e9)
    measured = (number * max(densities) + USUAL_BLOCKS * USUAL_DISTURBANCE) / (number + USUAL_BLOCKS)
    return max(measured, MIN_DISTURBANCE)


def is_rest(blocks: Blocks, at: int, state: GravityState) -> bool:
    """Whether a block is at rest: it hardly varies, and its mean rate may be the gyroscope's bias."""
    spread = state.covariance[B, B] + _rate_variance(blocks, at) * np.eye(3)
    return bool(blocks.still[at]) and _surprise(blocks.rate[at] - state.mean[B], spread) < MAX_SURPRISE**2


def advance(
    state: GravityState, blocks: Blocks, at: int, density: float, resting: bool, walk: float = GYROSCOPE_BIAS_WALK
) -> FilterStep:
    """The step over block `at`.

    density: the disturbance in motion, (m/s^2)^2/Hz; resting: whether the block before is at rest; walk: of the
    gyroscope's bias, rad/s for 1 s.
    """
    up = blocks.axes[at].T @ state.mean[S] / np.linalg.norm(state.mean[S])
    rate = float(up @ blocks.rate[at]) if np.isfinite(up).all() else 0.0
    predicted, transition = _predicted(state, blocks, at, None if resting else rate, walk)
    rest, updated, off = is_rest(blocks, at, predicted), predicted, np.full(3, np.nan)
    if np.isfinite(blocks.force[at]).all():
        model = np.hstack([np.eye(3), np.zeros((3, 3)), blocks.axes[at], np.zeros((3, 1))])
        if rest:
            variance = REST_SIGMA**2 + blocks.shaking[at] ** 2 / 3 / blocks.samples[at]
        else:
            variance = density / max(blocks.seconds[at], 1e-3)
        spread = float(np.trace(model @ predicted.covariance @ model.T)) / 3 + variance
        off = (blocks.force[at] - model @ predicted.mean) / np.sqrt(spread)
        updated = _updated(updated, model, blocks.force[at], variance)
        if rest and np.linalg.norm(blocks.rate[at]) < MIN_TURN:
            model = np.hstack([np.zeros((3, 3)), np.eye(3), np.zeros((3, 4))])
            updated = _updated(updated, model, blocks.rate[at], _rate_variance(blocks, at))
        elif rest:
            model = np.concatenate([np.zeros(3), up, np.zeros(3), [1.0]])[None]
            updated = _updated(updated, model, np.array([rate]), _rate_variance(blocks, at))
    return FilterStep(transition, predicted, updated, rest, off)


def filtered(first: FilterStep, blocks: Blocks, density: float, walk: float = GYROSCOPE_BIAS_WALK) -> list[FilterStep]:
    """The steps over blocks after `first`; density, walk: as of `advance`."""
    steps = [first]
    for at in range(len(blocks)):
        steps.append(advance(steps[-1].updated, blocks, at, density, steps[-1].rest, walk))
    return steps[1:]


def surprise_lasts(steps: list[FilterStep]) -> bool:
    """Whether most of the last accelerations are off in one direction, as those of a gyroscope with another bias are.

    A bump or a rover that speeds up disturbs few blocks. Rough ground disturbs all of them, in changing directions.
    """
    off = np.array([step.off for step in steps[-LASTING_BLOCKS:]])
    off = off[np.isfinite(off).all(axis=1)]
    if len(off) < LASTING_BLOCKS:
        return False
    of_median = np.pi / 2 / LASTING_BLOCKS  # variance of the median of normal values
    return float((np.median(off, axis=0) ** 2).mean()) > LASTING_SURPRISE**2 * of_median


def smoothed(steps: list[FilterStep]) -> list[GravityState]:
    """The states of consecutive blocks by all of their measurements."""
    states = [steps[-1].updated]
    for step, later in zip(reversed(steps[:-1]), reversed(steps[1:]), strict=True):
        after, here = states[-1], step.updated
        gain = np.linalg.solve(later.predicted.covariance, later.transition @ here.covariance).T
        mean = here.mean + gain @ (after.mean - later.predicted.mean)
        covariance = here.covariance + gain @ (after.covariance - later.predicted.covariance) @ gain.T
        states.append(GravityState(mean, (covariance + covariance.T) / 2))
    return states[::-1]


def sigma_of(state: GravityState) -> float:
    """Standard deviation of up, rad, about each horizontal axis."""
    force = state.mean[S]
    length = float(np.linalg.norm(force))
    up = force / length
    variance = np.trace(state.covariance[S, S]) - up @ state.covariance[S, S] @ up
    return float(np.sqrt(max(variance, 0.0) / 2)) / length


def _predicted(
    state: GravityState, blocks: Blocks, at: int, turn: float | None, walk: float
) -> tuple[GravityState, Array]:
    """The state and the transition to it; turn: rad/s, about gravity, of a rest that may begin, None within one."""
    force, seconds = state.mean[S], blocks.seconds[at]
    drift = blocks.turned[at] @ (state.mean[B] - blocks.bias[at])
    transition = np.eye(SIZE)
    transition[S, S] += cross_matrix(drift)
    transition[S, B] = -cross_matrix(force) @ blocks.turned[at]
    mean = state.mean.copy()
    mean[S] += np.cross(drift, force)
    noise = np.zeros((SIZE, SIZE))
    if turn is not None:
        mean[T] = transition[T, T] = 0.0
        noise[T, T] = turn**2
    across = float(force @ force) * np.eye(3) - np.outer(force, force)
    noise[S, S] = (GYROSCOPE_NOISE**2 * seconds + (GYROSCOPE_SCALE * blocks.angle[at]) ** 2) * across
    noise[B, B] = walk**2 * seconds * np.eye(3)
    noise[A, A] = ACCELEROMETER_BIAS_WALK**2 * seconds * np.eye(3)
    noise += 1e-12 * np.eye(SIZE)
    return GravityState(mean, transition @ state.covariance @ transition.T + noise), transition


def _rate_variance(blocks: Blocks, at: int) -> float:
    """Of the mean rate of a block at rest, (rad/s)^2, about each axis."""
    return REST_RATE_SIGMA**2 + MAX_REST_RATE_STD**2 / 3 / float(blocks.samples[at])


def _surprise(off: Array, spread: Array) -> float:
    """The mean square of `off` in sigmas, by its covariance."""
    return float(off @ np.linalg.solve(spread, off)) / len(off)


def _updated(state: GravityState, model: Array, measured: Array, variance: float) -> GravityState:
    """The state with one measurement (k,) of isotropic variance, which grows where the measurement is a surprise."""
    off, every = measured - model @ state.mean, np.eye(len(measured))
    spread = model @ state.covariance @ model.T
    noise = variance * max(_surprise(off, spread + variance * every) / MAX_SURPRISE**2, 1.0) * every
    gain = np.linalg.solve(spread + noise, model @ state.covariance).T
    rest = np.eye(SIZE) - gain @ model
    covariance = rest @ state.covariance @ rest.T + gain @ noise @ gain.T
    return GravityState(state.mean + gain @ off, (covariance + covariance.T) / 2)
