"""Blocks of inertial samples, integrated by the gyroscope.

The gyroscope rotates every acceleration into one frame, which does not turn with the sensor. In it gravity is constant
but for the gyroscope's errors, so accelerations can be averaged over a block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from stages.data import Array
from stages.data.rotations import nearest_rotation

BLOCK_NS = 200_000_000
REST_BLOCKS = 2  # to both sides of a block, which must be at rest as well
REST_MEANS = 20  # of a block's samples, whose spread counts; noise grows with the rate of samples
MAX_REST_RATE_STD = 0.01  # rad/s, about all axes; of the noise and hum of a sensor at rest
MAX_REST_ACCELERATION_STD = 0.1  # m/s^2, likewise


@dataclass(frozen=True)
class InertialSample:
    """What a sensor measured at one time. rate: rad/s; acceleration: m/s^2, up at rest; None where it is not there."""

    stamp: int
    rate: tuple[float, float, float] | None
    acceleration: tuple[float, float, float] | None


@dataclass(frozen=True)
class Knot:
    """The last sample with a rate: its rotation is that from the sensor to the frame of the gyroscope."""

    stamp: int
    rate: Array
    rotation: Array


@dataclass(frozen=True)
class Blocks:
    """n consecutive blocks with m samples of the rate.

    seconds: (n,); turned: (n, 3, 3), s, the integral of the rotation from sensor to gyroscope's frame; angle: (n,) rad,
    that the sensor turned through; force: (n, 3) m/s^2, mean acceleration in the gyroscope's frame, NaN where there is
    none; axes: (n, 3, 3), mean of the rotations of these accelerations; still: (n,) whether the sensor hardly moves;
    rate: (n, 3) rad/s, mean; shaking: (n,) m/s^2, standard deviation of the accelerations; samples: (n,) of the rate;
    bias: (n, 3) rad/s, of the gyroscope, that the rotations leave out; stamps: (m,) ns; rotations: (m, 3, 3); block:
    (m,) index.
    """

    seconds: Array
    turned: Array
    angle: Array
    force: Array
    axes: Array
    still: Array
    rate: Array
    shaking: Array
    samples: Array
    bias: Array
    stamps: Array
    rotations: Array
    block: Array

    def __len__(self) -> int:
        return len(self.seconds)

    def __getitem__(self, part: slice) -> Blocks:
        """Some of the blocks, with their samples."""
        first, last, _ = part.indices(len(self))
        kept = (self.block >= first) & (self.block < last)
        values = {known.name: getattr(self, known.name) for known in fields(self)}
        of_samples = {name: values.pop(name)[kept] for name in ("stamps", "rotations")}
        of_blocks = {name: value[first:last] for name, value in values.items() if name != "block"}
        return Blocks(**of_blocks, **of_samples, block=self.block[kept] - first)

    def then(self, later: Blocks) -> Blocks:
        """These blocks and later ones."""
        joined = {
            known.name: np.concatenate([getattr(self, known.name), getattr(later, known.name)])
            for known in fields(self)
        }
        return Blocks(**{**joined, "block": np.concatenate([self.block, later.block + len(self)])})


def integrate(samples: Sequence[InertialSample], begin: Knot, bias: Array, origin: int) -> tuple[Blocks, Knot]:
    """The blocks of samples after `begin`, in the order of stamps, and the last knot; at least one has a rate.

    bias: (3,) rad/s of the gyroscope; origin: ns, the time at which a block begins. The rate of some sensors is a
    sample, of others the mean since the sample before. So each counts for a quarter of an interval before its stamp.
    """
    from scipy.spatial.transform import Rotation  # takes long to import

    rated = [sample for sample in samples if sample.rate is not None]
    stamps = np.array([begin.stamp, *(sample.stamp for sample in rated)])
    rates = np.array([begin.rate, *(sample.rate for sample in rated)])
    steps = np.diff(stamps) / 1e9
    mean_rates = (3 * rates[1:] + rates[:-1]) / 4
    turns = Rotation.from_rotvec((mean_rates - bias) * steps[:, None]).as_matrix()
    rotations = np.empty((len(stamps), 3, 3))
    rotations[0] = begin.rotation
    for number, turn in enumerate(turns):
        np.matmul(rotations[number], turn, out=rotations[number + 1])
    _, block = np.unique((stamps[1:] - origin) // BLOCK_NS, return_inverse=True)
    count = int(block[-1]) + 1
    samples_of = np.bincount(block, minlength=count)
    force, axes, accelerations, of_block = _accelerations(samples, stamps, rates - bias, rotations, block, count)
    scatter = _spread(accelerations, of_block, count)
    blocks = Blocks(
        seconds=np.bincount(block, steps, count),
        turned=_sums((rotations[1:] + rotations[:-1]) / 2 * steps[:, None, None], block, count),
        angle=np.bincount(block, np.linalg.norm(mean_rates - bias, axis=1) * steps, count),
        force=force, axes=axes, still=_still(rates[1:], block, accelerations, of_block, count),
        rate=_sums(rates[1:], block, count) / samples_of[:, None], shaking=scatter, samples=samples_of,
        bias=np.tile(bias, (count, 1)), stamps=stamps[1:], rotations=rotations[1:], block=block,
    )  # fmt: skip
    return blocks, Knot(int(stamps[-1]), rates[-1], nearest_rotation(rotations[-1]))


def _accelerations(
    samples: Sequence[InertialSample], stamps: Array, rates: Array, rotations: Array, block: Array, count: int
) -> tuple[Array, Array, Array, Array]:
    """Force and axes of `Blocks`; the accelerations (k, 3) and the block (k,) of each."""
    from scipy.spatial.transform import Rotation  # takes long to import

    taken = [sample for sample in samples if sample.acceleration is not None]
    accelerations = np.array([sample.acceleration for sample in taken], np.float64).reshape(-1, 3)
    times = np.array([sample.stamp for sample in taken], np.int64)
    knot = np.maximum(np.searchsorted(stamps, times, side="right") - 1, 0)
    since = (times - stamps[knot]) / 1e9
    turned = rotations[knot] @ Rotation.from_rotvec(rates[knot] * since[:, None]).as_matrix().reshape(-1, 3, 3)
    of_block = block[np.maximum(knot - 1, 0)]
    number = np.bincount(of_block, minlength=count).astype(np.float64)
    number[number == 0] = np.nan
    force = _sums((turned @ accelerations[:, :, None])[:, :, 0], of_block, count) / number[:, None]
    return force, _sums(turned, of_block, count) / number[:, None, None], accelerations, of_block


def _still(rates: Array, block: Array, accelerations: Array, of_block: Array, count: int) -> Array:
    """Which blocks, with their neighbours, vary so little that the sensor may be at rest: (count,) bool."""
    still = np.zeros(count, bool)
    for at in range(count):
        near, close = (np.abs(places - at) <= REST_BLOCKS for places in (block, of_block))
        if near.sum() >= 2 and close.sum() >= 2:
            sizes = [int((places == at).sum()) // REST_MEANS for places in (block, of_block)]
            spread = [_spread_of_means(rates[near], sizes[0]), _spread_of_means(accelerations[close], sizes[1])]
            still[at] = spread[0] < MAX_REST_RATE_STD and spread[1] < MAX_REST_ACCELERATION_STD
    return still


def _spread_of_means(values: Array, size: int) -> float:
    """The standard deviation, of all axes together, of the means of each `size` values (k, 3), or of the values."""
    size = max(size, 1)
    means = values[: len(values) // size * size].reshape(-1, size, 3).mean(axis=1)
    return float(np.linalg.norm(means.std(axis=0)))


def _spread(values: Array, block: Array, count: int) -> Array:
    """The standard deviation of the values (k, 3) of each block, of all axes together: (count,)."""
    number = np.maximum(np.bincount(block, minlength=count), 1)
    mean = _sums(values, block, count) / number[:, None]
    return np.asarray(np.sqrt(_sums(((values - mean[block]) ** 2).sum(axis=1), block, count) / number))


def _sums(values: Array, block: Array, count: int) -> Array:
    """The sums of `values` (k, ...) by block: (count, ...)."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, block, values)
    return total
