"""What an estimate of up from a raw Imu errs by, in simulated drives, and how much of it is the accelerometer's bias.

Run as `python -m tests.bench.tilt [--seeds 12]`. Every second drive begins with five seconds at rest. The figures are
RMS values over all drives: of the error, of the error if the accelerometer had no bias, of error over stated sigma, and
the error of a smoother that knows everything but the accelerometer's bias. Where the rover turns, ours sees some of it.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.simulator import Simulation, inertial
from tests.recordings.inertial.drive import errors_of_estimate

SLOPE = float(np.radians(8))
LIMIT = 0.3  # deg
DRIVES: dict[str, dict[str, float]] = {
    "30 s, 100 Hz": {"frames": 60}, "30 s, 50 Hz": {"frames": 60, "imu_rate": 50.0},
    "30 s, 200 Hz": {"frames": 60, "imu_rate": 200.0}, "30 s, 1 m/s": {"frames": 60, "speed": 1.0},
    "2 min, 100 Hz": {"frames": 240},
}  # fmt: skip


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(prog="python -m tests.bench.tilt", description=__doc__)
    options.add_argument("--seeds", type=int, default=12, help="drives of each kind (12)")
    seeds = range(1, options.parse_args().seeds + 1)
    alone = np.degrees(np.sqrt(2) * inertial.ACCELEROMETER_BIAS / inertial.GRAVITY)
    print(f"RMS over {len(seeds)} drives, degrees; a bias of the accelerometer alone is {alone:.2f}")
    for name, parameters in DRIVES.items():
        found = np.array([_errors(seed, parameters) for seed in seeds])
        error, of_sigma, without, ideal = np.sqrt(np.mean(found**2, axis=0))
        beyond, of_ideal = (found[:, [0, 3]] > LIMIT).sum(axis=0)
        print(f"{name:14} {error:.2f}, without bias {without:.2f}, of sigma {of_sigma:.2f}, ideal {ideal:.2f}; "
              f"beyond {LIMIT}: {beyond}, of the ideal {of_ideal}")  # fmt: skip


def _errors(seed: int, parameters: dict[str, float]) -> tuple[float, float, float, float]:
    """The error, deg; the error over sigma; the error without a bias; that of the ideal."""
    drive = Simulation(width=64, height=48, imu="raw", relief_cells=512, seed=seed, rest=5.0 * (seed % 2), slope=SLOPE,
                       **parameters)  # type: ignore[arg-type]  # fmt: skip
    with patch.object(Simulation, "base_at", lru_cache(maxsize=None)(Simulation.base_at)):
        error, of_sigma = errors_of_estimate(drive)
        measured = drive.__dict__.pop("inertial")
        with patch.object(inertial, "ACCELEROMETER_BIAS", 0.0):
            without = errors_of_estimate(drive, 1e-4)[0]
        return error, of_sigma, without, _ideal(drive, measured, drive.inertial)


def _ideal(drive: Simulation, measured: inertial.InertialDrive, unbiased: inertial.InertialDrive) -> float:
    """The error, deg, of a smoother while driving that knows all but the accelerometer's bias.

    An angle that drifts with density q and is measured with density r is smoothed to the variance sqrt(q r) / 2, about
    each of two axes. The bias adds to that, as level driving does not show it. unbiased: measured, without the bias.
    """
    stamps, gravity = np.array(drive.sensor_stamps(drive.imu_rate)), np.array([0.0, 0.0, inertial.GRAVITY])
    driven, step = stamps >= drive.start, 1 / drive.imu_rate
    attitudes = Rotation.from_matrix(
        np.array([drive.base_at(stamp).after(drive.mounts[2]).rotation for stamp in stamps[driven].tolist()])
    )
    rates = (attitudes[:-2].inv() * attitudes[2:]).as_rotvec() / (2 * step)
    drift = float((measured.rates[driven][1:-1] - rates)[:, :2].var(axis=0).mean()) * step
    forces, second = attitudes.apply(unbiased.accelerations[driven]) - gravity, int(drive.imu_rate)
    means = forces[: len(forces) // second * second].reshape(-1, second, 3).mean(axis=1)
    density = float(means[:, :2].var(axis=0, ddof=1).mean()) / inertial.GRAVITY**2
    bias = attitudes.apply(measured.accelerations[0] - unbiased.accelerations[0]).mean(axis=0)[:2] / inertial.GRAVITY
    return float(np.degrees(np.sqrt(np.sqrt(drift * density) + bias @ bias)))


if __name__ == "__main__":
    main()
