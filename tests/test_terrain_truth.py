"""What the whole chain makes of simulated traverses, against their exact truth: slow, so run by `make check-all`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flow.cli import main


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
    assert rover["elevation"]["0-4 m"]["raw"]["rmse"] < 0.02
    assert rover["elevation"]["4-8 m"]["raw"]["rmse"] < 0.03
    assert rover["elevation"]["0-8 m"]["completeness"] > 0.85
    assert rover["navigation"]["false_alarm"] < 0.02
    assert rover["disparity"]["bad_1_known"] < 0.75 * paper["disparity"]["bad_1_known"]
    assert rover["elevation"]["4-8 m"]["raw"]["rmse"] < paper["elevation"]["4-8 m"]["raw"]["rmse"]
