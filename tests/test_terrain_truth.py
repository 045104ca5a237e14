"""The whole chain on simulated traverses, log to score: the map is near the truth, knows it, and finds the rocks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flow.cli import main
from recordings.simulator.simulation import Simulation
from tests.bench.terrain import SLOPE, TILT_NOISE, nodes, tilt_errors


@pytest.mark.parametrize("pipeline", ["rover", "fast", "paper"])
def test_the_tilt_is_as_far_off_as_its_pipeline_states(pipeline: str) -> None:
    ground = {"frames": 30, "slope": float(SLOPE), "relief_cells": 512, "abundance": 0.0}
    errors = tilt_errors(pipeline, Simulation(**ground, tilt_noise=float(TILT_NOISE), seed=21))
    stated = next(node.actor for node in nodes(pipeline) if node.name == "points").tilt_sigma
    assert errors.shape == (120, 2)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(stated, rel=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 13])
def test_terrain_is_within_centimetres_of_the_truth_and_better_than_the_papers(tmp_path: Path, seed: int) -> None:
    log = tmp_path / "log.mcap"
    assert main(["simulate", str(log), "--frames", "4", "--size", "960x720", "--seed", str(seed)]) == 0
    scores: dict[str, dict[str, Any]] = {}
    for pipeline in ("rover", "paper"):
        out, score = tmp_path / f"{pipeline}.mcap", tmp_path / f"{pipeline}.json"
        assert main(["run", str(log), "-p", pipeline, "-o", str(out), "--no-rrd"]) == 0
        assert main(["score", str(out), "--truth", str(log), "--json", str(score)]) == 0
        scores[pipeline] = json.loads(score.read_text())
    rover, paper = scores["rover"], scores["paper"]
    heights, hazards, rocks = (rover["terrain"][name] for name in ("heights", "hazards", "rocks"))
    assert heights["0-4 m"]["levelled"]["rmse"] < 0.01
    assert heights["4-8 m"]["levelled"]["rmse"] < 0.02
    assert heights["0-8 m"]["completeness"] > 0.85
    assert heights["0-8 m"]["levelled"]["within_5cm"] > 0.98
    assert rover["terrain"]["made_up"]["of_cells"] < 0.01
    random, total = (rover["terrain"]["intervals"][name] for name in ("random", "total"))
    assert 0.61 < random["1"] < 0.80
    assert 0.90 < random["2"] < 0.99
    assert total["2"] > 0.90
    assert rocks["0.2 m"]["recall"] in (None, 1.0)
    assert hazards["free_on_rock"] < 0.002
    assert hazards["rock_false_safe"] < 0.05
    assert hazards["false_alarm"] < 0.05
    assert rover["disparity"]["bad_1_known"] < 0.75 * paper["disparity"]["bad_1_known"]
    theirs = paper["terrain"]
    assert heights["4-8 m"]["levelled"]["rmse"] < theirs["heights"]["4-8 m"]["levelled"]["rmse"]
    assert heights["0-8 m"]["completeness"] > theirs["heights"]["0-8 m"]["completeness"]
    assert hazards["rock_false_safe"] < 0.1 * theirs["hazards"]["rock_false_safe"]
    assert rocks["0.2 m"]["found"] > theirs["rocks"]["0.2 m"]["found"]
