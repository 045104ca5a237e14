"""Every fault of a tilt is named within fifty frames, and no sound log is accused: slow, so run by `make check-all`.

The logs are simulated traverses of 50 frames at the rate and speed of the simulator's default; the inclinometer has a
noise of 0.3 degrees a sample.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flow.cli import main
from recordings.simulator import Simulation
from tests.tilt_faults import FAULTS, PIPELINE

SLOPES = {21: 4.0, 22: 6.0, 23: 3.0}  # seed -> RMS slope over 1 m, degrees


@pytest.fixture(scope="module", params=SLOPES)
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tilt") / "log.mcap"
    rocks = 0.05 if request.param % 2 else 0.15
    Simulation(
        frames=50, width=320, height=240, seed=request.param, slope=float(np.radians(SLOPES[request.param])),
        abundance=rocks, tilt_noise=float(np.radians(0.3)), map_half_width=1.0,
    ).write(path)  # fmt: skip
    return path


def judged(log: Path, folder: Path) -> str:
    """What a run says of the tilt."""
    pipeline, summary = folder / "check.yaml", folder / "summary.json"
    pipeline.write_text(PIPELINE)
    arguments = ["-p", pipeline, "-o", folder / "out.mcap", "--no-rrd", "--summary", summary]
    main(["run", *map(str, [log, *arguments])])
    return str(json.loads(summary.read_text())["findings"]["health"])


@pytest.mark.slow
def test_a_sound_log_is_not_accused(log: Path, tmp_path: Path) -> None:
    found = judged(log, tmp_path)
    assert found.startswith(("tilt and camera agree to 0.", "not enough motion in 50 frames to rule out a wrong mount"))


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(log: Path, tmp_path: Path, fault: str) -> None:
    plant, name = FAULTS[fault]
    found = judged(plant(log, tmp_path / "faulty.mcap"), tmp_path)
    assert name in found.split(":")[0], found
    assert " or " not in found.split(":")[0], found
