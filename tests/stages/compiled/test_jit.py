"""Compiled kernels are kept between runs, announced when compiled, and compiled again after any source has changed."""

import ast
import errno
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core import caching

from stages.matching.kernels.census import _census

ROOT = Path(__file__).parents[3]
JITS = {"kernel", "part", "fast_kernel", "fast_part", "typed_kernel", "borrowing_kernel", "njit"}
SCRIPT = """
import numpy as np
from stages.kernel_loading import imported_kernels, load, stop_timing_locks
from stages.matching.kernels.census import _census, census
stop_timing_locks()  # neither compiling nor loading needs it
print(_census in imported_kernels(), load(_census), len(_census.signatures))
planes = np.zeros((3, 3, 64), np.uint8)
census(np.arange(120, dtype=np.uint8).reshape(3, 40) // 2, planes)
print(planes[:, :, :40].sum())
"""

PLANES = """
import numpy as np
from stages.refinement.kernels.plane_fit import fit_planes
random = np.random.default_rng(0)
y, x = np.mgrid[:120, :160]
labels = (y // 11 * 15 + x // 11).astype(np.int32)
disparity = random.normal(0, 0.3, y.shape) + 0.01 * x + 0.1 * y + 3 * (random.random(y.shape) < 0.2)
weights = random.random(y.shape).astype(np.float32)
found = fit_planes(disparity.astype(np.float32), labels, labels.max() + 1, weights, 16, 7)
print(found.coefficients.tobytes().hex())
"""


DIGESTS = """
from pathlib import Path
from stages.compiled.jit import digest
for folder in ("stages/matching/kernels", "stages/terrain/kernels", "recordings/simulator"):
    print(digest(Path(folder).resolve()))
"""


@pytest.fixture
def run(tmp_path):
    for room in ("flow", "stages", "recordings"):
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))

    def call(script=SCRIPT):
        environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
        done = subprocess.run(
            [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout, done.stderr

    return call


def test_kernels_are_cached_loaded_early_and_recompiled_after_a_change(run, tmp_path):
    first, stderr = run()
    assert first.startswith("True 0 0\n")
    assert "compiling kernels" in stderr
    again, stderr = run()
    assert (again, stderr) == (first.replace("True 0 0", "True 1 1"), "")
    # the kernel calls the changed function, which is in another file
    layer = tmp_path / "stages" / "compiled" / "simd.py"
    changed = re.sub(r'icmp_unsigned\("<"', 'icmp_unsigned("<="', layer.read_text())
    assert changed != layer.read_text()
    layer.write_text(changed)
    after, stderr = run()
    assert after.startswith("True 0 0\n")
    assert after != first
    assert "compiling kernels" in stderr


def cache_in(folder: Path, stamp: str = "stamp") -> Any:
    return type(_census._cache._cache_file)(str(folder), "kernel", stamp)


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_damaged_file_of_the_cache_counts_as_missing(tmp_path, suffix):
    kept = cache_in(tmp_path)
    kept.save("key", "code" * 100)
    assert kept.load("key") == "code" * 100
    (file,) = tmp_path.glob(f"*.{suffix}")
    whole = file.read_bytes()
    for damaged in (b"", whole[:-2], whole[:-40] + bytes(40), whole[:20] + bytes(8) + whole[28:]):
        file.write_bytes(damaged)
        assert kept.load("key") is None
        kept.save("key", "code")
        assert kept.load("key") == "code"


@pytest.mark.parametrize(("number", "remedy"), [
    (errno.ENOSPC, "No space left on device; free some space, or set NUMBA_CACHE_DIR to a folder that can be written"),
    (errno.EACCES, "Permission denied; set NUMBA_CACHE_DIR to a folder that can be written"),
])  # fmt: skip
def test_code_that_cannot_be_kept_is_reported_once_and_never_taken_for_another(
    tmp_path, monkeypatch, caplog, number, remedy
):
    cache_in(tmp_path, "old").save("key", "old code")
    kept = cache_in(tmp_path, "new")

    def fail(name, data):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(type(kept), "reported", False)
    monkeypatch.setattr(kept, "_save_data", fail)  # after the index
    for _ in range(2):
        kept.save("key", "new code")
        assert kept.load("key") is None
    assert caplog.messages == [f"cannot keep compiled kernels in {tmp_path}: {remedy}"]


def test_functions_of_other_programs_are_kept_as_numba_keeps_them(tmp_path):
    kept = caching.IndexDataCacheFile(cache_path=str(tmp_path), filename_base="other", source_stamp=(1.5, 20))
    assert type(kept) is not type(_census._cache._cache_file)


@pytest.mark.slow
def test_compiled_and_loaded_kernels_give_the_same_bits(run):
    first, stderr = run(PLANES)
    assert "compiling kernels" in stderr
    assert run(PLANES) == (first, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "of_stages"),
    [
        ("recordings/simulator/raycast.py", False),
        ("stages/data/pixel_validity.py", True),
    ],  # its codes are compiled
)
def test_a_change_marks_the_kernels_of_its_own_family(run, tmp_path, file, of_stages):
    before = run(DIGESTS)[0].split()
    assert before[0] == before[1] != before[2]
    changed = tmp_path / file
    changed.write_text(f"{changed.read_text()}\n# changed\n")
    after = run(DIGESTS)[0].split()
    assert [one != other for one, other in zip(before, after, strict=True)] == [of_stages, of_stages, not of_stages]


def decorators(function):
    return {node.id for made in function.decorator_list for node in ast.walk(made) if isinstance(node, ast.Name)}


def functions(tree):
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def test_python_calls_no_function_that_only_kernels_can_call():
    """Such a call ends the process: `part` makes no wrapper for Python."""
    trees = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts): ast.parse(file.read_text())
        for room in ("flow", "stages", "recordings", "tests")
        for file in (ROOT / room).rglob("*.py")
    }
    parts = {
        module: {each.name for each in functions(tree) if decorators(each) & {"part", "fast_part"}}
        for module, tree in trees.items()
    }
    assert "root" in parts["stages.compiled.union_find"]
    for module, tree in trees.items():
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        known = parts[module].union(
            *({name.name for name in node.names} & parts.get(node.module, set()) for node in imports)
        )
        if not known:
            continue
        compiled = [each for each in functions(tree) if decorators(each) & JITS]
        inside = {id(node) for each in compiled for node in ast.walk(each)}
        called = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call) and id(node) not in inside]
        assert not known & {name.id for name in called if isinstance(name, ast.Name)}, module
