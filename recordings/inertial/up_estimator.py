"""Tilts from the samples of an accelerometer and a gyroscope.

Each tilt is estimated from all samples before it and those of the next ten seconds; the first ones of a sensor that
moves, from those of the next thirty. Samples are kept only that long, so memory does not grow with the log.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from recordings.inertial.blocks import BLOCK_NS, Blocks, InertialSample, Knot, integrate
from recordings.inertial.gravity_filter import (
    DISTURBANCE_BLOCKS,
    GYROSCOPE_BIAS_STEP,
    SIZE,
    FilterStep,
    GravityState,
    disturbance,
    filtered,
    first_state,
    restarted,
    sigma_of,
    smoothed,
    surprise_lasts,
)
from stages.data import Array, Tilt

BATCH_NS = 25 * BLOCK_NS  # integrated with one estimate of the gyroscope's bias
LAG_BLOCKS = 50  # after a tilt that it is estimated from
FIRST_LAG_BLOCKS = 150  # after the first tilt, unless the sensor is at rest at first
LOOKAHEAD_NS = BATCH_NS + LAG_BLOCKS * BLOCK_NS
MAX_GAP_NS = 500_000_000  # without a rate; a new estimate begins after a longer time
MIN_TILT_INTERVAL_NS = 9_000_000
FIRST_PASSES = 3  # over the first batch
START_BLOCKS = 5  # whose mean acceleration is the first guess of gravity
SPAN_BLOCKS = 5  # whose mean accelerations are compared with the rates
MIN_COMPARED = 20  # of these spans
MIN_TURNED = float(np.radians(1.0))  # RMS of the turns that the rates show within a batch
MAX_BIASES = 3.0  # sigmas of the accelerometer's bias, by which measured gravity may differ from the given one
MAX_GRAVITY_SHARE = 0.03  # of gravity, in addition: the accelerometer's scale, and the motion
MAX_SPIKE = 0.5  # of gravity, by which a block's mean acceleration may differ from the median
MIN_EXPLAINED = 0.3  # share of these turns that accelerations confirm; near 1 for a sound sensor, else below 0


@dataclass
class UpEstimator:
    """Estimates up from samples in the order of stamps; `push` and `finish` return tilts as they become final.

    accelerometer_bias: standard deviation of each axis, m/s^2; gravity: its magnitude, m/s^2, None if it is to be
    measured. rest_seconds, seconds: time at rest, and in all; measured_gravity: mean magnitude of batches, m/s^2,
    without blocks of spikes.
    """

    frame_id: str
    accelerometer_bias: float
    gravity: float | None = None
    rest_seconds: float = 0.0
    seconds: float = 0.0
    measured_gravity: float = 0.0
    _compared: Array = field(default_factory=lambda: np.zeros(4))  # spans; variances: see `_compare`
    _waiting: list[InertialSample] = field(default_factory=list)
    _knot: Knot | None = None
    _origin: int = 0
    _ended: int = 0  # stamp of the end of the estimate before a gap
    _state: GravityState | None = None
    _steps: list[FilterStep] = field(default_factory=list)
    _blocks: Blocks | None = None  # those without tilts yet; one step more than these
    _forces: Array = field(default_factory=lambda: np.zeros((0, 3)))  # of the last blocks in motion
    _first: bool = True  # no tilt has been made
    _last: int = 0  # stamp of the last tilt

    def push(self, sample: InertialSample) -> list[Tilt]:
        """Add a sample. Its stamp must be later than that of the last one."""
        made, last = list[Tilt](), self._last_rated()
        if sample.rate is not None and last is not None and sample.stamp - last > MAX_GAP_NS:
            made = self.finish()
        if self._waiting and sample.stamp - self._waiting[0].stamp > BATCH_NS:
            if self._has_rate():
                self._integrate()
                made += self._tilts(LAG_BLOCKS)
            else:
                self._waiting = []
        self._waiting.append(sample)
        return made

    @property
    def contradicts(self) -> bool:
        """Whether accelerations and rates contradict each other, as of a gyroscope with wrong axes or a wrong unit."""
        spans, own, turned, predicted = self._compared
        clear = spans >= MIN_COMPARED and predicted > MIN_TURNED**2 * spans
        return bool(clear and own - turned < MIN_EXPLAINED * predicted)

    @property
    def contradicts_gravity(self) -> bool:
        """Whether measured gravity differs from the given one by more than the accelerometer's errors explain. Rates
        that are wrong make it too small."""
        if self.gravity is None or not self.seconds:
            return False
        explained = MAX_BIASES * self.accelerometer_bias + MAX_GRAVITY_SHARE * self.gravity
        excess = self.measured_gravity - self.gravity
        return excess > explained or (excess < -explained and not self.contradicts)

    def finish(self) -> list[Tilt]:
        """The tilts of all samples so far; a new estimate then begins."""
        if self._has_rate():
            self._integrate()
        made = self._tilts(0)
        self._ended = self._ended if self._knot is None else self._knot.stamp
        self._waiting, self._steps, self._blocks, self._knot = [], [], None, None
        self._forces = self._forces[:0]  # the next ones are in another frame
        return made

    def _has_rate(self) -> bool:
        return any(sample.rate is not None for sample in self._waiting)

    def _last_rated(self) -> int | None:
        stamps = (sample.stamp for sample in reversed(self._waiting) if sample.rate is not None)
        return next(stamps, None if self._knot is None else self._knot.stamp)

    def _integrate(self) -> None:
        """Filter the batch that waits."""
        samples, self._waiting = self._waiting, []
        bias = np.zeros(3) if self._state is None else self._state.mean[3:6]
        if self._knot is None:
            before, first = self._knot_before(samples), self._state
            self._origin = before.stamp
            for _ in range(FIRST_PASSES):  # each with the bias that the one before found
                blocks, _ = integrate(samples, before, bias, self._origin)
                started = self._started(blocks, first)
                if started is None:
                    return
                begin = FilterStep(np.eye(SIZE), started, started, rest=False, off=np.full(3, np.nan))
                steps = filtered(begin, blocks, disturbance(self._in_motion(blocks)))
                bias = steps[-1].updated.mean[3:6]
            self._knot, self._steps = before, [begin]
        blocks, self._knot = integrate(samples, self._knot, bias, self._origin)
        self._filter(blocks)

    @staticmethod
    def _knot_before(samples: list[InertialSample]) -> Knot:
        """The beginning of the gyroscope's frame, just before the first sample."""
        rate = next(sample.rate for sample in samples if sample.rate is not None)
        return Knot(samples[0].stamp - 1, np.array(rate), np.eye(3))

    def _started(self, blocks: Blocks, before: GravityState | None) -> GravityState | None:
        """The state before the first batch; None where it has no accelerations. before: the state before a gap."""
        forces = blocks.force[np.isfinite(blocks.force).all(axis=1)][:START_BLOCKS]
        if not len(forces) or not np.linalg.norm(forces.mean(axis=0)) > 0:
            return None
        force = forces.mean(axis=0)
        if before is not None:
            return restarted(before, force, (self._origin - self._ended) / 1e9, self.gravity)
        return first_state(force, self.accelerometer_bias, self.gravity)

    def _filter(self, blocks: Blocks) -> None:
        """Add blocks and the steps over them. If accelerations stay off, the gyroscope's bias may have changed in any
        block without a tilt."""
        self._forces = self._in_motion(blocks)
        density, rested = disturbance(self._forces), self._rested()
        self._steps += filtered(self._steps[-1], blocks, density)
        self._blocks = blocks if self._blocks is None else self._blocks.then(blocks)
        if surprise_lasts(self._steps):
            self._steps[1:] = filtered(self._steps[0], self._blocks, density, GYROSCOPE_BIAS_STEP)
        self._state = self._steps[-1].updated
        self.seconds += float(blocks.seconds.sum())
        self.rest_seconds += self._rested() - rested
        self._compare(blocks)
        force = blocks.force[np.isfinite(blocks.force).all(axis=1)]
        middle = np.median(force, axis=0) if len(force) else np.zeros(3)
        force = force[np.linalg.norm(force - middle, axis=1) < MAX_SPIKE * np.linalg.norm(middle)]
        if len(force):
            weight = float(blocks.seconds.sum()) / self.seconds
            self.measured_gravity += weight * (float(np.linalg.norm(force.mean(axis=0))) - self.measured_gravity)

    def _rested(self) -> float:
        """Time at rest, s, in the blocks without tilts."""
        if self._blocks is None:
            return 0.0
        return float(self._blocks.seconds[[step.rest for step in self._steps[1:]]].sum())

    def _in_motion(self, blocks: Blocks) -> Array:
        """The mean accelerations of the last blocks in motion up to these."""
        moving = blocks.force[~blocks.still & np.isfinite(blocks.force).all(axis=1)]
        return np.concatenate([self._forces, moving])[-DISTURBANCE_BLOCKS:]

    def _compare(self, blocks: Blocks) -> None:
        """Add the variances of mean accelerations, over that of gravity: in the sensor's frame, in the gyroscope's, and
        that of gravity in the sensor's frame by the rates alone. For a sound sensor the first is the sum of the others.
        """
        count = len(blocks) // SPAN_BLOCKS * SPAN_BLOCKS
        force, axes = blocks.force[:count], np.swapaxes(blocks.axes[:count], 1, 2)
        if count < 2 * SPAN_BLOCKS or not np.isfinite(force).all():
            return
        mean = force.mean(axis=0)
        kinds = (axes @ force[:, :, None])[:, :, 0], force, axes @ mean
        means = [kind.reshape(-1, SPAN_BLOCKS, 3).mean(axis=1) / np.linalg.norm(mean) for kind in kinds]
        self._compared += [len(means[0]), *(float(((m - m.mean(axis=0)) ** 2).sum()) for m in means)]

    def _tilts(self, kept: int) -> list[Tilt]:
        """The tilts of all blocks but the last `kept`, which wait for later samples."""
        count = 0 if self._blocks is None else len(self._blocks) - kept
        moving = kept and self._first and not self.rest_seconds
        if self._blocks is None or count <= 0 or (moving and len(self._blocks) < FIRST_LAG_BLOCKS):
            return []
        self._first = False
        states, blocks = smoothed(self._steps), self._blocks[:count]
        self._steps, self._blocks = self._steps[count:], self._blocks[count:]
        ups = _ups(blocks, np.array([state.mean[:3] for state in states[: count + 1]]))
        of_blocks = np.array([sigma_of(state) for state in states[1 : count + 1]])
        sigmas = np.hypot(of_blocks[blocks.block], _step_sigmas(ups))
        made = list[Tilt]()
        for stamp, up, sigma in zip(blocks.stamps.tolist(), ups, sigmas.tolist(), strict=True):
            if stamp - self._last >= MIN_TILT_INTERVAL_NS:
                made.append(Tilt(stamp, up, self.frame_id, sigma, filtered=True))
                self._last = stamp
        return made


def _ups(blocks: Blocks, gravity: Array) -> Array:
    """Up in the sensor's frame at each sample, (m, 3); gravity: (n + 1, 3) at the ends of the blocks."""
    at = blocks.block
    ends = blocks.stamps[np.searchsorted(at, np.arange(len(blocks)), side="right") - 1]
    left = (ends[at] - blocks.stamps) / np.maximum(blocks.seconds[at] * 1e9, 1.0)
    force = left[:, None] * gravity[at] + (1 - left[:, None]) * gravity[at + 1]
    up = (np.swapaxes(blocks.rotations, 1, 2) @ force[:, :, None])[:, :, 0]
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def _step_sigmas(ups: Array) -> Array:
    """What the steps between samples err by, rad, about each horizontal axis: (m,). ups: (m, 3).

    A rate may be a sample or the mean since the sample before: `integrate` is a quarter of a step's turn off either.
    What happens between samples shows in the change of the turn from step to step.
    """
    if len(ups) < 3:
        return np.zeros(len(ups))
    turns = np.diff(ups, axis=0)
    sizes = np.hypot(np.linalg.norm(turns[:-1], axis=1) / 4, np.linalg.norm(np.diff(turns, axis=0), axis=1) / 2)
    return np.pad(sizes / np.sqrt(2), 1, mode="edge")
