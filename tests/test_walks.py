"""Planted faults are named on any ground, and sound logs have none."""

import json

import numpy as np
import pytest

from recordings.simulator import Simulation, write_log
from recordings.simulator.scenes import SCENES
from tests.conftest import SMALL, roverflow, slow
from tests.walks import wrong_baseline


@pytest.mark.parametrize(("scene", "slope"), [("mixed", 4), *slow(*((scene, 10) for scene in SCENES))])
def test_a_baseline_that_is_too_long_shows_against_the_odometry(scene, slope, tmp_path):
    sound, summary = tmp_path / "sound.mcap", tmp_path / "summary.json"
    ground = {"scene": scene, "slope": float(np.radians(slope)), "relief_cells": 512}
    write_log(Simulation(frames=14, width=320, height=240, map_half_width=1.0, **ground), sound)  # type: ignore[arg-type]
    found = {}
    for log in (sound, wrong_baseline(sound, tmp_path / "long.mcap")):
        words = ("-p", "fast", *SMALL, "--no-rrd", "--summary", summary)
        assert roverflow("run", log, *words, "-o", tmp_path / "out.mcap") == 0
        found[log.stem] = json.loads(summary.read_text())["findings"].get("pose")
    assert found["sound"] is None
    assert found["long"]["severity"] == "warning"
    assert "The baseline or the focal length is too large" in found["long"]["sentence"]
