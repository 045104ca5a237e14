"""Maps with an estimated tilt are nearly as right as those with an inclinometer. Slow: run by `make check-all`."""

import json
from pathlib import Path

import numpy as np
import pytest

from flow.cli.main import main
from recordings.simulator import Simulation, write_log


def scored(folder: Path, imu: str, seed: int) -> tuple[list[float], float, list[str]]:
    """Errors of the tilt, rad, mean squared height error, m^2, and the notes about tilt of a simulated log."""
    log, out, score, summary = (folder / f"{imu}{seed}{end}" for end in (".mcap", "-out.mcap", "-score.json", ".json"))
    simulation = Simulation(
        scene="gravel", frames=20, width=320, height=240, seed=seed, slope=float(np.radians(6)), imu=imu, rest=5.0
    )
    write_log(simulation, log)
    assert (
        main(["run", str(log), "-o", str(out), "--no-rrd", "--summary", str(summary), "--set", "disparities=64"]) == 0
    )
    assert main(["score", str(out), "--truth", str(log), "--json", str(score)]) == 0
    found, findings = json.loads(score.read_text()), json.loads(summary.read_text())["findings"]
    tilts = [row["tilt"] for row in found["per_frame"]]
    rmse = found["terrain"]["heights"]["0-8 m"]["raw"]["rmse"]
    return tilts, rmse**2, [findings[name]["sentence"] for name in ("inclinometer", "health") if name in findings]


@pytest.mark.slow
def test_maps_with_an_estimated_tilt_have_at_most_1_5_of_the_errors(tmp_path):
    seeds = (1, 2, 3)
    exact, estimated = ([scored(tmp_path, imu, seed) for seed in seeds] for imu in ("orientation", "raw"))
    tilts = np.concatenate([tilt for tilt, _, _ in estimated])
    assert np.sqrt(np.mean(tilts**2)) < np.radians(0.3)
    assert np.sqrt(np.mean([square for _, square, _ in estimated])) < 1.5 * np.sqrt(
        np.mean([square for _, square, _ in exact])
    )
    for _, _, (source, health) in estimated:
        assert source.startswith("up is estimated from the accelerations and rates on /imu/data_raw")
        assert health.startswith("Tilt and camera agree")
