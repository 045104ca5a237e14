"""The simulator's loops are compiled again when any of their sources has changed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
BELOW = """
import numpy as np
from recordings.simulator import ground_truth, raycast
flat, nothing = np.zeros((4, 4)), np.zeros(0, np.int32)
scene = raycast.scene(
    flat, 1.0, flat, flat[:2, :2], np.zeros((0, 8)), nothing, np.zeros((1, 1, 4)), np.zeros(5, np.int32), nothing
)
clear = np.zeros(1, np.bool_)
ground_truth._clear_lines(scene, np.array([1.2, 1.3, 1.0]), np.array([[1.7, 1.6, -1.0]]), clear)
print(clear)
"""


@pytest.mark.slow
def test_no_machine_code_outlives_the_source_of_a_loop_that_it_calls(tmp_path):
    for part in ("flow", "stages", "recordings"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__"))
    environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}

    def what_is_hidden_below_ground():
        script = [sys.executable, "-c", BELOW]
        return subprocess.run(script, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout

    assert what_is_hidden_below_ground() == what_is_hidden_below_ground() == "[False]\n"
    source = tmp_path / "recordings" / "simulator" / "raycast.py"
    text, begin = source.read_text(), 'and facet of the first hit."""\n'
    assert text.count(begin) == 1
    source.write_text(text.replace(begin, f"{begin}    if far < 2.0:\n        return inf, SKY, 0\n"))
    assert what_is_hidden_below_ground() == "[ True]\n"
