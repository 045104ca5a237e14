"""What an estimate of up from a raw Imu errs by, in simulated drives, and how much of it is the accelerometer's bias.

Run as `python -m tests.bench.tilt [--seeds 12]`. Every second drive begins with five seconds at rest. The figures are
RMS values over all drives: of the error, of the error if the accelerometer had no bias, and of error over stated sigma.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from unittest.mock import patch

import numpy as np

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
        error, of_sigma, without = np.sqrt(np.mean(found**2, axis=0))
        beyond = int((found[:, 0] > LIMIT).sum())
        print(f"{name:14} {error:.2f}, without bias {without:.2f}, of sigma {of_sigma:.2f}, beyond {LIMIT}: {beyond}")


def _errors(seed: int, parameters: dict[str, float]) -> tuple[float, float, float]:
    """The error, deg; the error over sigma; the error without a bias."""
    drive = Simulation(width=64, height=48, imu="raw", relief_cells=512, seed=seed, rest=5.0 * (seed % 2), slope=SLOPE,
                       **parameters)  # type: ignore[arg-type]  # fmt: skip
    with patch.object(Simulation, "base_at", lru_cache(maxsize=None)(Simulation.base_at)):
        error, of_sigma = errors_of_estimate(drive)
        drive.__dict__.pop("inertial")
        with patch.object(inertial, "ACCELEROMETER_BIAS", 0.0):
            return error, of_sigma, errors_of_estimate(drive, 1e-4)[0]


if __name__ == "__main__":
    main()
