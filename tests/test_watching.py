"""`roverflow run --view` and `--serve`: a viewer costs nothing but its own picture."""

import os
import signal
import subprocess
import sys
import time

import pytest

from recordings import RerunSink
from tests.conftest import SMALL, roverflow
from tests.recordings.sinks.recorded_scene import START, STREAMS, Record, rows, scene

PORT = 19871


def test_watching_needs_the_recording(traverse, tmp_path, capsys):
    assert roverflow("run", traverse, *SMALL, "-o", tmp_path / "out.mcap", "--no-rrd", "--view") == 2
    assert "watching needs the recording; leave out --no-rrd" in capsys.readouterr().err


@pytest.mark.slow
def test_a_served_run_writes_the_same_result_and_listens_on_loopback_only(traverse, result, tmp_path, capsys):
    out = tmp_path / "out.mcap"
    assert roverflow("run", traverse, *SMALL, "-o", out, "--serve") == 0
    assert "watch the run at http://127.0.0.1:" in capsys.readouterr().out
    assert out.read_bytes() == result.read_bytes()
    for entity, component in (
        ("/disparity/pixels", "EncodedDepthImage:blob"),
        ("/navigation_map/cells/labels", "SegmentationImage:buffer"),
    ):
        both = [rows(path.with_suffix(".rrd"), entity, component) for path in (out, result)]
        assert both[0] == both[1] != []


@pytest.mark.slow
@pytest.mark.parametrize("fate", [None, signal.SIGSTOP, signal.SIGKILL])
def test_a_viewer_that_stops_or_dies_does_not_hold_up_the_recording(tmp_path, fate):
    port = PORT + (fate or 0)
    sink, out = RerunSink(live_port=port), tmp_path / "run.rrd"
    sink.open(out, STREAMS, {})
    address = f"rerun+http://127.0.0.1:{port}/proxy"
    seen = tmp_path / "seen.rrd"
    words = [sys.executable, "-m", "rerun", "--save", str(seen), address]
    viewer = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        time.sleep(3)
        for number in range(150):
            if fate is not None and number == 10:
                os.kill(viewer.pid, fate)
            sink.write(Record(START + number, scene()))
        sink.close({"verdict": "COMPLETE"})
        assert len(rows(out, "/disparity/pixels", "EncodedDepthImage:blob")) == 150
        if fate is None:
            time.sleep(3)
            assert seen.stat().st_size > 0.5 * out.stat().st_size
    finally:
        viewer.kill()
        viewer.wait()
