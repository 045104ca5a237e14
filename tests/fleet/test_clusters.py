"""Fleets on clusters of processes that start and die on their own; the same command ends with all results."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
from distributed import Client

from flow.cli.fleet import engine
from recordings.simulator import Simulation, write_log
from tests.conftest import roverflow
from tests.fleet.test_fleet import PIPELINE, rows_of

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
pytestmark = pytest.mark.timeout(600)
LIMIT = 300  # s; of a state that comes in seconds unless the machine is busy


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve logs of different length."""
    folder = tmp_path_factory.mktemp("campaign")
    for number in range(12):
        write_log(Simulation(frames=2 + number, width=160, height=120, seed=number), folder / f"log{number:02d}.mcap")
    return folder


@contextmanager
def cluster(port: int, modules: Path | None = None) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Address and scheduler of `dask scheduler` and two `dask worker`, started by their own commands.

    modules: a folder that all import first.
    """
    address = f"tcp://127.0.0.1:{port}"
    scheduler = ("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    worker = ("worker", address, "--nthreads", 1, "--host", "127.0.0.1", "--no-dashboard")
    started, environment = [], ENVIRONMENT
    if modules:
        path = os.pathsep.join((str(modules), ENVIRONMENT["PYTHONPATH"]))
        environment = {**ENVIRONMENT, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}  # else the folder of the run is first
    for words in (scheduler, worker, worker):
        command = [sys.executable, "-m", f"distributed.cli.dask_{words[0]}", *map(str, words[1:])]
        started.append(subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment))
    try:
        with Client(address, timeout=LIMIT) as client:
            client.wait_for_workers(2, timeout=LIMIT)
        yield address, started[0]
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            with suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()


def command(home: Path, out: Path, *more: object) -> list[str]:
    return [sys.executable, "-m", "flow", "fleet", str(home), "--out", str(out), *PIPELINE, *map(str, more)]


def until(words: list[str], beginning: str) -> subprocess.Popen[str]:
    """A fleet that has printed a line with that beginning."""
    fleet = subprocess.Popen(words, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert fleet.stdout is not None
    assert any(line.startswith(beginning) for line in fleet.stdout)
    return fleet


def ended(home: Path, out: Path, *more: object) -> str:
    """What a fleet prints that ends with all results; one is compared with that of a run."""
    done = subprocess.run(command(home, out, *more), env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {row["state"] for row in rows_of(out).values()} == {"done"}
    assert sorted(rows_of(out)) == sorted(log.stem for log in home.glob("*.mcap"))
    assert not list(out.glob("*.partial"))
    plain = out.with_suffix(".mcap")
    assert roverflow("run", home / "log03.mcap", *PIPELINE, "--no-rrd", "-o", plain) == 0
    assert (out / "log03-nav.mcap").read_bytes() == plain.read_bytes()
    return done.stdout


def command_of(process: psutil.Process) -> str:
    """The command line of a process; empty if it has ended."""
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def times(out: Path) -> dict[str, int]:
    done = [name for name, row in rows_of(out).items() if row["state"] == "done"]
    return {name: (out / f"{name}-nav.mcap").stat().st_mtime_ns for name in done}


@pytest.mark.slow
def test_a_scheduler_that_is_killed_is_continued_by_the_same_command(home, tmp_path):
    out = tmp_path / "out"
    with cluster(18787) as (address, scheduler):
        fleet = until(command(home, out, "--cluster", address), "2 of 12")
        scheduler.kill()
        said = fleet.communicate(timeout=LIMIT)[1]
    assert fleet.returncode == 3
    assert "run the same command again to continue" in said
    assert "Traceback" not in said
    before = times(out)
    assert 2 <= len(before) < 12
    with cluster(18787) as (address, _):
        printed = ended(home, out, "--cluster", address)
    assert f"12 logs: {len(before)} done before" in printed
    assert {name: times(out)[name] for name in before} == before


@pytest.mark.slow
def test_a_worker_that_is_killed_again_and_again_loses_no_log(home, tmp_path):
    out, killed = tmp_path / "out", 0
    fleet = until(command(home, out, "--processes", 2), "12 logs")
    assert fleet.stdout is not None
    for line in fleet.stdout:  # one more log has ended
        children = psutil.Process(fleet.pid).children(recursive=True)
        workers = [child for child in children if "spawn_main" in command_of(child)]
        # A log is set aside when its worker has died four times.
        if workers and killed < 3 and " of 12: " in line:
            workers[killed % len(workers)].kill()
            killed += 1
    said = fleet.communicate()[1]
    assert fleet.returncode == 0, said
    assert killed == 3
    assert "12 logs: 12 done before" in ended(home, out)


@pytest.mark.slow
def test_a_client_that_is_killed_is_continued_by_the_same_command(home, tmp_path):
    out = tmp_path / "out"
    fleet = until(command(home, out, "--processes", 2), "2 of 12")
    watching = [sys.executable, "-m", "flow", "fleet", "--out", str(out), "--watch"]
    watch = subprocess.Popen(watching, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)
    assert watch.stdout is not None
    assert " waiting; " in watch.stdout.readline()
    workers = psutil.Process(fleet.pid).children(recursive=True)
    fleet.send_signal(signal.SIGKILL)
    fleet.communicate()
    assert not psutil.wait_procs(workers, timeout=LIMIT)[1]
    assert "left; run its command again to continue" in watch.communicate(timeout=LIMIT)[0]
    assert watch.returncode == 3
    before = times(out)
    assert len(before) >= 2
    ended(home, out, "--processes", 2)
    assert {name: times(out)[name] for name in before} == before


@pytest.mark.slow
def test_an_interrupted_fleet_ends_its_workers(home, tmp_path):
    fleet = until(command(home, tmp_path / "out", "--processes", 2), "1 of 12")
    workers = psutil.Process(fleet.pid).children(recursive=True)
    fleet.send_signal(signal.SIGINT)
    said = fleet.communicate(timeout=LIMIT)[1]
    assert "roverflow: interrupted\n" in said
    assert "resource_tracker" not in said
    assert fleet.returncode == 130
    assert not psutil.wait_procs(workers, timeout=LIMIT)[1]


@pytest.mark.slow
@pytest.mark.parametrize("package", ["roverflow", "numpy"])
def test_workers_of_another_version_are_refused(home, tmp_path, refused, package):
    about = tmp_path / "modules" / f"{package}-99.0.dist-info" / "METADATA"
    about.parent.mkdir(parents=True)
    about.write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 99.0\n")
    with cluster(18796, tmp_path / "modules") as (address, _):
        why = refused("fleet", home, "--out", tmp_path / "out", *PIPELINE, "--cluster", address)
    name = "version" if package == "roverflow" else package
    assert f"has another {name} (99.0) than this machine" in why
    assert not list((tmp_path / "out").glob("*-nav.mcap"))


def test_a_scheduler_that_is_not_there_is_named(traverse, tmp_path, refused, monkeypatch):
    monkeypatch.setattr(engine, "CLUSTER_SECONDS", 1.0)
    words = ("fleet", traverse, "--out", tmp_path / "out", *PIPELINE, "--cluster", "tcp://127.0.0.1:1")
    assert "no Dask scheduler answers at tcp://127.0.0.1:1" in refused(*words)
