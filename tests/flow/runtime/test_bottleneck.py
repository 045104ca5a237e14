"""The summary names what limits the rate of a run, and says about workers only what follows from busy times."""

import pytest

from flow.cli.report import headline
from flow.runtime.bottleneck import bottleneck, bottleneck_line
from tests.flow.toys import graph, replayed, traverse

BUSY = {"match": 6.0, "fuse": 2.0, "recordings.McapSink": 1.0, "recordings.RerunSink": 3.0}
SINKS = ["recordings.McapSink", "recordings.RerunSink"]


def found(workers=2, frames=20, cores=8, serial=None):
    serial = serial or {"fuse": 2.0, "recordings.McapSink": 1.0, "recordings.RerunSink": 3.0, "reading the log": 0.5}
    return bottleneck(BUSY, SINKS, serial, workers, frames, cores)


def test_the_slowest_stage_and_sink_are_named():
    line = bottleneck_line(found())
    assert line.startswith("slowest stage: match, 300 ms a frame; slowest sink: RerunSink, 150 ms a frame; another")


@pytest.mark.parametrize(("workers", "cores", "serial", "said"), [
    (2, 8, {}, "up to 50% more frames/s"),
    (3, 8, {}, "up to 33% more frames/s"),
    (4, 8, {}, "would not help, because RerunSink takes one frame at a time"),
    (2, 8, {"reading the log": 6.0}, "would not help, because reading the log takes one frame at a time"),
    (2, 8, {"fuse": 5.0}, "up to 20% more frames/s"),
    (2, 2, {}, "would not help, because each of the 2 cores has one"),
])  # fmt: skip
def test_another_worker_brings_what_serial_work_and_cores_allow(workers, cores, serial, said):
    serial = serial and {"recordings.RerunSink": 3.0, **serial}
    assert found(workers, cores=cores, serial=serial)["another_worker"].endswith(said)


def test_nothing_is_said_about_workers_after_few_frames_or_without_work():
    assert "another_worker" not in found(frames=11)
    assert bottleneck({"match": 0.0}, [], {}, 2, 0, 2) == {}
    assert bottleneck_line({}) == ""


def test_the_rate_counts_frames_with_losses(tmp_path):
    _, summary = replayed(graph(tmp_path, bad=[float(i) for i in range(20)]), traverse(20))
    assert (summary["frames_out"], summary["frames_through"]) == (0, 20)
    assert summary["frames_per_second"] == pytest.approx(20 / summary["wall_seconds"], rel=1e-2)
    assert not headline(summary).endswith(" 0.00 frames/s")
