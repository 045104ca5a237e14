"""The start: foreign modules with roverflow's package names are named in one sentence, not in a traceback."""

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
START = "import sys, roverflow; sys.exit(roverflow.program())"


def start(folder: Path, *path: Path) -> subprocess.CompletedProcess[str]:
    """`roverflow --version` in `folder`, with `path` as the PYTHONPATH."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, "-c", START, "--version"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("name", ["flow.py", "stages.py", "recordings/__init__.py"])
def test_a_foreign_module_on_the_path_is_named(tmp_path, name):
    foreign = tmp_path / "path" / name
    foreign.parent.mkdir(parents=True, exist_ok=True)
    foreign.write_text("raise RuntimeError('not ours')\n")
    done = start(tmp_path, tmp_path / "path", ROOT)
    assert done.returncode == 2
    assert done.stderr.startswith(f"roverflow: {foreign} is in the way of roverflow's package")
    assert done.stderr.count("\n") == 1


def test_a_foreign_module_is_named_by_python_m_flow(tmp_path):
    (tmp_path / "stages.py").touch()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "flow", "--version"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr.partition(" in the way of")[0]) == (2, f"roverflow: {tmp_path}/stages.py is")


def test_without_foreign_modules_the_program_starts(tmp_path):
    done = start(tmp_path, ROOT)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("roverflow ")


def test_python_m_flow_runs_the_program():
    done = subprocess.run([sys.executable, "-m", "flow", "--version"], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout[:10]) == (0, "roverflow ")


def test_idle_threads_of_blas_do_not_spin_while_the_program_starts():
    code = "from flow.cli.__main__ import program; program(); import numpy, threadpoolctl; "
    code += "print([pool['num_threads'] for pool in threadpoolctl.threadpool_info()])"
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    command = [sys.executable, "-c", code, "pipeline", "rover"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.stdout.endswith("\n[1]\n")


@pytest.mark.slow
def test_an_overwritten_package_of_the_wheel_is_named(tmp_path):
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "--quiet", "--no-deps", str(ROOT)]
    subprocess.run(pip, cwd=tmp_path, check=True, capture_output=True)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    ask = [str(python), "-c", "import importlib.util as u; print(u.find_spec('stages').origin)"]
    installed = subprocess.check_output(ask, cwd=tmp_path, env=environment, text=True).strip()
    Path(installed).write_text("# another package\n")
    command = [str(tmp_path / "venv" / "bin" / "roverflow"), "--version"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith(f"roverflow: another package overwrote {installed}")
