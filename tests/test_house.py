"""The house's own rules: who may import whom, and that a package speaks of nothing it does not know."""

import ast
from pathlib import Path

import numpy as np
import pytest

from flow.config.loader import load

ROOT = Path(__file__).parent.parent
ROOMS = {"flow", "stages", "recordings"}
SHARED = {"flow": (), "stages": ("flow.contracts",), "recordings": ("flow.contracts", "stages.data")}
COMPOSITION_ROOT = ROOT / "flow" / "cli"


def imported(file):
    """Dotted names that a file imports, `from a import b` as a.b."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_imports_run_one_way(room):
    for file in sorted((ROOT / room).rglob("*.py")):
        if COMPOSITION_ROOT in file.parents:
            continue
        shared = SHARED[room]
        names = [name for name in imported(file) if name.split(".")[0] in ROOMS - {room}]
        strangers = [name for name in names if not name.startswith(shared)]
        assert strangers == [], f"{file.relative_to(ROOT)} must not import {strangers}"


def test_the_rule_would_notice_a_stranger(tmp_path):
    file = tmp_path / "wrong.py"
    file.write_text("from stages import Match\nimport recordings.ros2.to_msg\n")
    assert list(imported(file)) == ["stages.Match", "recordings.ros2.to_msg"]


def test_importing_a_stage_does_not_import_files_or_viewers():
    import subprocess
    import sys

    code = "import sys, stages; print([m for m in ('rerun', 'mcap', 'rosbags', 'flow.runtime') if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).strip() == "[]"


@pytest.mark.parametrize("pipeline", ["rover", "fast"])
def test_what_the_rover_is_reaches_every_stage_that_asks(pipeline):
    told = {
        "wheel": "60 cm",
        "max_step": "40 cm",
        "max_slope": "25 deg",
        "wheel_track": "2 m",
        "ground_clearance": "1 m",
        "resolution": "10 cm",
        "max_range": "6 m",
    }
    nodes = load(pipeline, [f"{name}={value}" for name, value in told.items()]).nodes
    assert [node.actor.resolution for node in nodes if hasattr(node.actor, "resolution")] == [0.1] * 3
    assert [node.actor.max_range for node in nodes if node.name in ("cleaned", "cells")] == [6.0] * 2
    actors = [node.actor for node in nodes if type(node.actor).__name__ in ("TerrainFeatures", "Binarise")]
    assert len(actors) == 4
    wanted = {"wheel": 0.6, "max_step": 0.4, "max_slope": np.radians(25), "wheel_track": 2, "ground_clearance": 1}
    for actor in actors:
        for name in wanted.keys() & vars(actor).keys():
            assert getattr(actor, name) == pytest.approx(wanted[name])
