"""Maps with an estimated tilt, or from a mast that pans, are as right as others. Slow: run by `make check-all`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flow.cli.main import main
from recordings.simulator import Simulation, write_log


def scored(folder: Path, seed: int, **parameters: Any) -> tuple[list[float], float, dict[str, str]]:
    """Errors of the tilt, rad, mean squared height error, m^2, and the notes by stream of a simulated log."""
    log, out, score, summary = (folder / name for name in ("log.mcap", "out.mcap", "score.json", "summary.json"))
    slope = float(np.radians(6))
    write_log(Simulation(scene="gravel", frames=20, width=320, height=240, seed=seed, slope=slope, **parameters), log)
    run = ["run", log, "-o", out, "--no-rrd", "--summary", summary, "--set", "disparities=64"]
    for command in (run, ["score", out, "--truth", log, "--json", score]):
        assert main([str(word) for word in command]) == 0
    found, findings = json.loads(score.read_text()), json.loads(summary.read_text())["findings"]
    rmse = found["terrain"]["heights"]["0-8 m"]["raw"]["rmse"]
    notes = {stream: finding["sentence"] for stream, finding in findings.items()}
    return [row["tilt"] for row in found["per_frame"]], rmse**2, notes


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_maps_with_an_estimated_tilt_have_at_most_1_5_of_the_errors(tmp_path):
    seeds = (1, 2, 3)
    exact, estimated = (
        [scored(tmp_path, seed, imu=imu, rest=5.0) for seed in seeds] for imu in ("orientation", "raw")
    )  # fmt: skip
    assert np.sqrt(np.mean(np.square([tilts for tilts, _, _ in estimated]))) < np.radians(0.3)
    squares = [np.mean([square for _, square, _ in results]) for results in (exact, estimated)]
    assert np.sqrt(squares[1] / squares[0]) < 1.5
    for _, _, notes in estimated:
        assert notes["inclinometer"].startswith("the tilt is estimated from the accelerations and rates on /imu/data")
        assert notes["health"].startswith("Tilt and camera agree")


@pytest.mark.slow
def test_maps_from_a_mast_that_pans_are_as_right_as_from_a_fixed_one(tmp_path):
    fixed, panned = (scored(tmp_path, 2, pan=float(np.radians(degrees))) for degrees in (0, 25))
    assert np.mean(panned[0]) < 1.2 * np.mean(fixed[0])
    assert panned[1] < 1.2 * fixed[1]
    assert "'base_link' <- 'mast_head' on /tf is interpolated" in panned[2]["mount"]
    assert panned[2]["health"].startswith("Tilt and camera agree")
