"""Disparity, terrain and hazards against the exact truth of simulated traverses: `rover` and `paper`, seed by seed."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

SEEDS = (11, 12, 13)
FRAMES = 6
COLUMNS = (
    ("seed", 8), ("pipeline", 9), ("bad-1 %", 8), ("RMSE 0-4 m cm", 14), ("4-8 m cm", 9), ("rocks found", 12),
    ("hazard cells found %", 21), ("called free %", 14), ("false alarms %", 15),
)  # fmt: skip


def main() -> None:
    """Print a row per seed and pipeline."""
    print(f"\n{FRAMES} frames of 1280x960 per seed, inclinometer noise 0.1 degrees, rocks k = 0.10")
    print(" ".join(f"{name:>{width}}" for name, width in COLUMNS))
    with tempfile.TemporaryDirectory() as folder:
        log, out, scores = (Path(folder) / name for name in ("log.mcap", "out.mcap", "score.json"))
        for seed in SEEDS:
            _roverflow("simulate", log, "--frames", FRAMES, "--seed", seed)
            for pipeline in ("rover", "paper"):
                _roverflow("run", log, "-p", pipeline, "-o", out, "--no-rrd")
                _roverflow("score", out, "--truth", log, "--json", scores)
                values = _figures(json.loads(scores.read_text()))
                cells = [str(seed), pipeline, *values]
                print(" ".join(f"{cell:>{width}}" for cell, (_, width) in zip(cells, COLUMNS, strict=True)))


def _figures(score: dict[str, dict[str, dict[str, dict[str, float]]]]) -> list[str]:
    rings, navigation, rocks = score["elevation"], score["navigation"], score["rocks"]
    return [
        f"{100 * score['disparity']['bad_1_known']:.2f}",
        *(f"{100 * rings[ring]['raw']['rmse']:.2f}" for ring in ("0-4 m", "4-8 m")),
        f"{rocks['found']:.0f} of {rocks['seen']:.0f}",
        *(f"{100 * navigation[name]:.1f}" for name in ("recall", "false_safe", "false_alarm")),
    ]


def _roverflow(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "flow.cli", *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
