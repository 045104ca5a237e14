"""`roverflow diff`: two results side by side."""

import json
import shutil

import pytest

from flow.contracts import FrameRecord, Loss, LossReason
from recordings import McapSink
from recordings.mcap.file import iter_decoded
from tests.conftest import FRAMES, SMALL, chunks_of, run_fast, slow, with_broken


@pytest.fixture(scope="module")
def variant_of(traverse, tmp_path_factory):
    """Makes a result of the traverse with some settings."""

    def make(*changes):
        settings = [f"--set={change}" for change in changes]
        return run_fast(tmp_path_factory.mktemp("variant") / "out.mcap", traverse, *settings)

    return make


def test_a_run_and_the_same_run_are_equal_and_make_no_recording(fast_result, variant_of, tmp_path, said):
    out = tmp_path / "diff.rrd"
    for other in (fast_result, variant_of()):
        equal, unwritten = said(0, "diff", fast_result, other, "-o", out).out.splitlines()[-2:]
        assert equal.startswith("equal: all ")
        assert unwritten == f"{out} is not written, as nothing differs"
        assert not out.exists()


@pytest.mark.parametrize(("change", "topic", "measure"), [
    ("disparity/full.paths=8", "/nav/disparity", "largest px"),
    *slow(
        ("cells.max_range=4 m", "/nav/elevation_map", "cells known only in A"),
        ("navigation_map.rover.max_step=5 cm", "/nav/navigation_map", "cells from free to hazard"),
    ),
])  # fmt: skip
def test_the_first_difference_is_in_the_stream_that_a_setting_touches(
    fast_result, variant_of, said, tmp_path, change, topic, measure
):
    found = json.loads(said(3, "diff", fast_result, variant_of(change), "--json", "-o", tmp_path / "diff.rrd").out)
    first = min(stamp for name, stamp, _ in iter_decoded(fast_result, [topic]))
    assert found["first"] == [topic, first]
    assert found["topics"][topic]["worst"][measure] > 0
    assert found["facts"] == {"overrides": [SMALL[1], f"{SMALL[1]}\n{change}"]}
    names = list(found["topics"])
    assert all(found["topics"][name]["first"] is None for name in names[: names.index(topic)])
    assert (tmp_path / "diff.rrd").stat().st_size > 10_000


def test_a_difference_is_also_a_message_that_only_one_result_has(fast_result, variant_of, said):
    differences = said(3, "diff", fast_result, variant_of("McapSink.results=[disparity]")).out
    assert f"/nav/elevation_map: {FRAMES} only in A\n" in differences


def test_results_of_other_logs_show_the_digests_of_the_logs(traverse, fast_result, tmp_path, said):
    (log := tmp_path / traverse.name).write_bytes(traverse.read_bytes() + b"\0")  # a byte that is reported as not read
    out = run_fast(tmp_path / "out.mcap", log, code=3)
    facts = json.loads(said(3, "diff", fast_result, out, "--json").out)["facts"]
    assert list(facts) == ["log_digest"]
    one, other = facts["log_digest"]
    assert one != other
    assert f"log_digest: A {one} | B {other}\n" in said(3, "diff", fast_result, out).out


def test_a_loss_of_the_last_frame_differs_beside_the_findings_of_the_end(tmp_path, said):
    def result(name, *losses):
        sink, path = McapSink(results=(), also=("blur",)), tmp_path / name
        sink.open(path, {"blur": float}, {"pipeline": "streams: {}", "log": "log.mcap", "overrides": ""})
        sink.write(FrameRecord(0, 10**18, {"blur": 1.0}, losses, {}, {}))
        sink.close({"findings": {"health": {"severity": "note", "sentence": "level"}}, "verdict": "COMPLETE"})
        return path

    lost = Loss("left", 10**18, "source", LossReason.UNREADABLE, "broken")
    one, same, other = result("a.mcap"), result("b.mcap"), result("c.mcap", lost)
    assert said(0, "diff", one, same).out.startswith("equal: ")
    topics = json.loads(said(3, "diff", one, other, "--json").out)["topics"]
    assert (topics["/nav/diagnostics"]["messages"], topics["/nav/diagnostics"]["differing"]) == (2, 1)


def test_a_log_without_results_is_refused(traverse, fast_result, tmp_path, refused):
    assert "is not a result log; give two logs that roverflow run wrote" in refused("diff", fast_result, traverse)
    assert "missing.mcap: No such file" in refused("diff", fast_result, tmp_path / "missing.mcap")


def test_a_damaged_result_is_refused(fast_result, tmp_path, refused):
    damaged = with_broken(shutil.copy(fast_result, tmp_path / "out.mcap"), chunks_of(fast_result)[0][0])
    found = refused("diff", fast_result, damaged)
    assert found.startswith(f"roverflow: {damaged}: the chunk at byte ")
    assert found.endswith("; run the pipeline again\n")
