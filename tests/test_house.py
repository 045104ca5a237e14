"""Rules of the code base: which folder may import which, and the words that each may use."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = {"flow", "stages", "recordings"}
SHARED = {
    "flow": (),
    "stages": ("flow.contracts", "flow.parameters"),
    "recordings": ("flow.contracts", "flow.parameters", "stages.compiled.jit", "stages.data"),
}
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


def test_a_public_class_name_occurs_once():
    names = Counter(
        node.name
        for room in ROOMS
        for file in (ROOT / room).rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, times in names.items() if times > 1] == []


def test_no_folder_has_more_than_15_modules():
    folders = Counter(file.parent for room in ROOMS for file in (ROOT / room).rglob("*.py") if file.stem != "__init__")
    assert {str(folder.relative_to(ROOT)): n for folder, n in folders.items() if n > 15} == {}


def test_the_import_rule_finds_a_forbidden_import(tmp_path):
    file = tmp_path / "wrong.py"
    file.write_text("from stages import Match\nimport recordings.ros2.to_msg\n")
    assert list(imported(file)) == ["stages.Match", "recordings.ros2.to_msg"]


def test_importing_a_stage_does_not_import_files_or_viewers():
    import subprocess
    import sys

    code = "import sys, stages; print([m for m in ('rerun', 'mcap', 'rosbags', 'flow.runtime') if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).strip() == "[]"
