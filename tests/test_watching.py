"""`roverflow run --view` and `--serve`: a viewer costs nothing but its own picture."""

import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

from flow.cli import watching
from recordings import RerunSink
from tests.conftest import SMALL, roverflow
from tests.recordings.sinks.recorded_scene import START, STREAMS, Record, pictures, record_of, rows, scene
from tests.viewers import answers, send, viewer, wait_for, wait_for_bytes

FRAME_BYTES = 100_000  # fewer than a frame of the traverse has in the recording


def test_watching_needs_the_recording(traverse, tmp_path, refused):
    for option in (["--view"], ["--desk", "tilt"]):
        why = refused("run", traverse, *SMALL, "-o", tmp_path / "out.mcap", "--no-rrd", *option)
        assert "--view, --serve and --desk need the recording; leave out --no-rrd" in why


def check_same(out, result):
    assert roverflow("diff", out, result) == 0  # it prints what differs
    assert out.read_bytes() == result.read_bytes()
    assert pictures(out.with_suffix(".rrd")) == pictures(result.with_suffix(".rrd"))


def replaced(monkeypatch, words):
    """Start a process with other words, `words(those of the product)`, to watch a run; returns the processes."""
    started, start = [], subprocess.Popen

    def popen(command, **options):
        started.append(start(words(command), **options))
        return started[-1]

    monkeypatch.setattr(watching, "subprocess", SimpleNamespace(Popen=popen, DEVNULL=subprocess.DEVNULL))
    return started


def port_of(server):
    """The port of loopback that a browser gets the recording from."""
    return int(server.args[server.args.index("--port") + 1])


def test_a_viewer_that_never_opens_changes_nothing(traverse, result, tmp_path, said, monkeypatch):
    replaced(monkeypatch, lambda command: [sys.executable, "-c", "raise SystemExit(1)"])
    out = tmp_path / "my out.mcap"
    printed = said(0, "run", traverse, *SMALL, "-o", out, "--view").out
    assert f"No viewer opens (no display?). The run goes on; afterwards: rerun '{tmp_path / 'my out.rrd'}'" in printed
    check_same(out, result)
    made = said(0, "desk", out.with_suffix(".rrd"), "--desk", "tilt").out
    assert made.endswith(f"; rerun '{tmp_path / 'my out.rrd'}' '{tmp_path / 'my out-tilt.rbl'}' shows it\n")


@pytest.mark.parametrize("serve", [False, True])
def test_what_watches_a_run_listens_on_loopback_only(monkeypatch, serve):
    started = replaced(monkeypatch, lambda command: [sys.executable, "-c", "", *command])
    with watching.watched(not serve, serve, None):
        assert started[0].args[started[0].args.index("--bind") + 1] == "127.0.0.1"


@pytest.mark.slow
@pytest.mark.parametrize("fate", [signal.SIGSTOP, signal.SIGKILL])
@pytest.mark.parametrize("how", ["--view", "--serve"])
def test_a_viewer_that_stops_or_dies_changes_nothing(traverse, result, tmp_path, monkeypatch, how, fate):
    """A viewer without a screen saves what it gets; with --serve it is a browser, and the server has the same fate."""
    seen, out, write = tmp_path / "seen.rrd", tmp_path / "out.mcap", RerunSink.write
    shown = {"--view": lambda command: [*command[:3], "--save", seen, "-"], "--serve": lambda command: command}
    started = replaced(monkeypatch, shown[how])
    with ExitStack() as stack:

        def interrupted(sink, record):
            if record.index == 0 and how == "--serve":
                wait_for(lambda: answers(port_of(started[0])), "the server does not answer")  # a client does not wait
                started.append(
                    stack.enter_context(viewer("--save", seen, f"rerun+http://127.0.0.1:{port_of(started[0])}/proxy"))
                )
            if record.index == 1:
                wait_for_bytes(seen, FRAME_BYTES)
                for process in started:
                    send(process, fate)
            write(sink, record)

        monkeypatch.setattr(RerunSink, "write", interrupted)
        assert roverflow("run", traverse, *SMALL, "-o", out, how) == 0
        assert len(started) == 1 + (how == "--serve")
        assert how == "--view" or not answers(port_of(started[0]))
        for process in started:
            send(process, signal.SIGKILL)
    check_same(out, result)
    assert seen.stat().st_size < 0.9 * out.with_suffix(".rrd").stat().st_size  # it did not see the rest


@pytest.mark.slow
def test_a_served_run_writes_the_same_result_and_its_page_ends(traverse, result, tmp_path, said, monkeypatch):
    started, out = replaced(monkeypatch, lambda command: command), tmp_path / "out.mcap"
    assert "watch the run at http://127.0.0.1:" in said(0, "run", traverse, *SMALL, "-o", out, "--serve").out
    check_same(out, result)
    assert not answers(port_of(started[0]))


def test_the_page_of_a_killed_run_ends(tmp_path):
    seen = record_of(tmp_path / "seen.rrd", [Record(START, scene())])
    run = f"""
import os, pathlib, time
from flow.cli.watching import watched
with watched(False, True, None) as pipe:
    os.write(pipe, pathlib.Path({str(seen)!r}).read_bytes())
    time.sleep(100)
"""
    with subprocess.Popen([sys.executable, "-c", run], stdout=subprocess.PIPE, text=True) as killed:
        assert killed.stdout is not None
        try:
            port = int(killed.stdout.readline().partition("rerun+http://127.0.0.1:")[2].partition("/")[0])
            wait_for(lambda: answers(port), "the server does not answer")
        finally:
            killed.kill()
    wait_for(lambda: not answers(port), "the server is still there")


@pytest.mark.slow
@pytest.mark.parametrize("fate", [None, signal.SIGSTOP, signal.SIGKILL])
def test_a_viewer_that_stops_or_dies_does_not_hold_up_the_recording(tmp_path, fate):
    out, seen, (reading, writing) = tmp_path / "run.rrd", tmp_path / "seen.rrd", os.pipe()
    sink = RerunSink(live_pipe=writing)
    sink.open(out, STREAMS, {})
    with viewer("--save", seen, "-", stdin=reading) as watcher:
        os.close(reading)
        for number in range(150):
            if number == 10:
                wait_for_bytes(seen, 1000)
                send(watcher, fate or 0)
            sink.write(Record(START + number, scene()))
        sink.close({"verdict": "COMPLETE"})
        assert len(rows(out, "/disparity/pixels", "EncodedDepthImage:blob")) == 150
        if fate is None:
            wait_for_bytes(seen, out.stat().st_size // 2)
