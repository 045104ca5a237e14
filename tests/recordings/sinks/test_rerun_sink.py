"""The rerun recording contains every intermediate at its own time, and clears those that a frame lacks."""

import math
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rerun as rr

from recordings.errors import LogError
from recordings.sinks.blueprint import CLOCK, FRAME
from recordings.sinks.canvas import MAX_POINTS
from recordings.sinks.rerun_recording import PLOT_BATCH, RESERVED_BYTES
from recordings.sinks.rerun_sink import RerunSink
from stages.data import Disparity, Mount
from tests.limits import file_size_limited
from tests.recordings.sinks.recorded_scene import (
    START,
    STEP,
    STREAMS,
    WIDTH,
    Loss,
    Record,
    decoded,
    entities,
    record_of,
    resized,
    rows,
    scene,
)


def opened(path):
    sink = RerunSink()
    sink.open(path, STREAMS, {})
    return sink


def test_every_intermediate_is_recorded_and_the_recording_passes_reruns_own_check(rrd):
    assert entities(rrd) >= {
        "/rectified/left", "/rectified/right", "/matched/pixels", "/matched/source/labels", "/disparity/pixels",
        "/disparity/source/labels", "/disparity/superpixels", "/points/points", "/elevation_map/relief",
        "/elevation_map/layers/slope", "/elevation_map/surface", "/navigation_map/cells/labels",
        "/navigation_map/reason/labels", "/navigation_map/hazards", "/rectified/camera", "/pose/trajectory",
        "/seconds/matched", "/queues/disparity", "/tilt/inclinometer\\ x\\ up", "/ledger", "/summary",
    }  # fmt: skip
    verify = [sys.executable, "-m", "rerun", "rrd", "verify", rrd]
    assert subprocess.run(verify, capture_output=True).returncode == 0


def test_entities_have_the_stamp_of_their_frame_in_nanoseconds(rrd):
    times = [row[:2] for row in rows(rrd, "/disparity/pixels", "EncodedDepthImage:blob")]
    assert times == [(START + n * STEP, n) for n in range(3)]


def test_only_the_logs_clock_and_the_frame_count_are_timelines(rrd):
    """The wall clock in a recording would make two equal runs differ."""
    names = {
        column.name for chunk in rr.chunk.RrdReader(str(rrd)).stream() for column in chunk.to_record_batch().schema
    }
    assert {CLOCK, FRAME} <= names
    assert not names & {"log_time", "log_tick"}


def test_the_names_of_origins_stand_in_a_column_beside_their_dots(rrd):
    paths = "/disparity/source/legend", "/disparity/source/legend/text"
    dots, pins = (np.array(rows(rrd, path, "Points2D:positions")[0][2]) for path in paths)
    ((_, _, names),) = rows(rrd, paths[1], "Points2D:labels")
    assert len(dots) == len(pins) == len(names) > 2
    assert len(set(dots[:, 0])) == len(set(pins[:, 0])) == 1
    assert "measured" in names


def test_legends_that_do_not_change_are_stored_once(rrd):
    for legend in ("/disparity/source/legend", "/disparity/pixels/scale/text", "/elevation_map/relief/lines/distances"):
        assert [frame for _, frame, _ in rows(rrd, legend, "Points2D:positions")] == [0], legend
    assert len(rows(rrd, "/disparity/source/labels", "AnnotationContext:context")) == 1


def test_entities_that_a_frame_lacks_are_cleared_at_that_frame(tmp_path):
    """Otherwise the viewer shows the earlier picture at this frame."""
    lost = ("stereo", "rectified", "disparity", "points", "elevation_map")
    second = {name: item for name, item in scene(START + STEP).items() if name not in lost}
    frames = [scene(), second, scene(START + 2 * STEP)]
    path = record_of(tmp_path / "lost.rrd", [Record(START + n * STEP, items) for n, items in enumerate(frames)])
    for entity in ("/points/points", "/elevation_map/surface", "/navigation_map/hazards"):
        cleared = [clock for clock, _, value in rows(path, entity, "Clear:is_recursive") if value is not None]
        assert cleared == [START + STEP], entity
    assert not rows(path, "/matched/source/labels", "Clear:is_recursive")
    for legend in ("/disparity/source/legend", "/elevation_map/relief/lines/distances"):
        shown = [(frame, bool(value)) for _, frame, value in rows(path, legend, "Points2D:positions")]
        assert shown == [(0, True), (2, True)], legend  # and once more when it hangs again
        assert [frame for _, frame, value in rows(path, legend, "Clear:is_recursive") if value is not None] == [1]
    # An encoded image is emptied instead, because the viewer ignores its clearing.
    for entity, kind in (
        ("/rectified/left", "EncodedImage"), ("/rectified/camera/image", "EncodedImage"),
        ("/disparity/superpixels", "EncodedImage"), ("/elevation_map/relief", "EncodedImage"),
        ("/disparity/pixels", "EncodedDepthImage"),
    ):  # fmt: skip
        blobs = [value for *_, value in rows(path, entity, f"{kind}:blob")]
        assert [bool(blob) for blob in blobs] == [True, False, True], entity


def test_stage_times_are_stored_once_with_gaps_for_missing_stages(tmp_path):
    """However many frames are sent at once."""
    count, without = 2 * PLOT_BATCH + 1, (5, PLOT_BATCH)
    records = [
        Record(START + n * STEP, {}, seconds={"matched": float(n)} if n not in without else {}, queues={"matched": n})
        for n in range(count)
    ]
    path = record_of(tmp_path / "long.rrd", records)
    expected = [(START + n * STEP, n, [float(n)]) for n in range(count)]
    assert rows(path, "/queues/matched", "Scalars:scalars") == expected
    times = rows(path, "/seconds/matched", "Scalars:scalars")
    assert [row[:2] for row in times] == [row[:2] for row in expected]
    assert [n for _, n, (value,) in times if math.isnan(value)] == list(without)
    assert [value for _, n, value in times if n not in without] == [row[2] for row in expected if row[1] not in without]


def test_a_sink_that_is_opened_again_starts_a_new_recording(tmp_path):
    sink = RerunSink()
    for name, end in (("given up", sink.discard), ("second", lambda: sink.close({"verdict": "COMPLETE"}))):
        sink.open(tmp_path / f"{name}.rrd", STREAMS, {})
        sink.write(Record(START, scene(), seconds={name: 1.0}))
        end()
    assert [path.name for path in tmp_path.iterdir()] == ["second.rrd"]
    drawn = {entity for entity in entities(tmp_path / "second.rrd") if entity.startswith("/seconds/")}
    assert drawn == {"/seconds/second"}


def test_a_long_line_of_the_ledger_is_continued_in_the_next_one(tmp_path):
    why = "the frame lies 0.00 m and 6.6 degrees off the map, unlike the frames before it; it is left out of the map"
    lost, sentence = Loss("map", START, "fuse", "failed", why), "the sign of pitch is flipped " * 9
    summary = {"verdict": "COMPLETE", "findings": {"health": {"severity": "fault", "sentence": sentence}}}
    path = record_of(tmp_path / "ledger.rrd", [Record(START, scene(), (lost,))], summary)
    found = [(clock, value[0]) for clock, _, value in rows(path, "/ledger", "TextLog:text")]
    assert max(len(line) for _, line in found) <= 80
    assert {clock for clock, line in found if "fuse lost" in line or "out of the map" in line} == {START}
    whole = " ".join(line.removeprefix("... ") for _, line in found)
    assert f"fuse lost map: failed. {why}" in whole
    assert f"health: {sentence.strip()}" in whole


def test_losses_are_logged_at_their_own_stamps(tmp_path):
    lost = Loss("tilt", START - 7, "tilt", "unaligned", "no message within 200 ms")
    late = Loss("right", START + 9, "left", "unmatched", "no partner within 5 ms")
    summary = {"verdict": "INCOMPLETE", "drops": {"unaligned": 1, "unmatched": 1}, "entries": (late,)}
    path = record_of(tmp_path / "ledger.rrd", [Record(START, scene(), (lost,))], summary)
    texts = {clock: value[0] for clock, _, value in rows(path, "/ledger", "TextLog:text")}
    assert texts[START - 7] == "tilt lost tilt: unaligned. no message within 200 ms"
    captions = [(clock, value[0]) for clock, _, value in rows(path, "/frames", "TextLog:text")]
    assert captions[0][0] == START
    assert captions[0][1].startswith("0.75 s of work; matched 92 % known")
    assert max(len(line) for _, line in captions) <= 80 < sum(len(line) for _, line in captions)
    last = [(clock, value[0]) for clock, _, value in rows(path, "/ledger", "TextLog:text")][-2:]
    assert last == [
        (START + 9, "left lost right: unmatched. no partner within 5 ms"),
        (START + 9, "INCOMPLETE: 1 frame, 1 unaligned, 1 unmatched"),
    ]
    documents = [value[0] for *_, value in rows(path, "/summary", "TextDocument:text")]
    assert documents[-1].startswith("# INCOMPLETE")
    assert "traverse.mcap" in documents[-1]


def test_the_bottleneck_is_named_first(tmp_path):
    slowest = {"stage": {"name": "disparity", "seconds_per_frame": 0.372138}, "another_worker": "nothing"}
    path = record_of(tmp_path / "slow.rrd", [Record(START, scene())], {"verdict": "COMPLETE", "bottleneck": slowest})
    *_, (*_, (document,)) = rows(path, "/summary", "TextDocument:text")
    table = "\n\n| | |\n|---|---|\n| slowest stage | disparity, 0.372 s a frame |\n| workers | nothing |\n"
    assert document.startswith(f"# COMPLETE{table}")


def test_a_recording_has_its_name_only_when_it_is_complete(tmp_path):
    path = tmp_path / "run.rrd"
    sink = opened(path)
    sink.write(Record(START, scene()))
    assert not path.exists()
    sink.close({"verdict": "COMPLETE"})
    sink.close({"verdict": "COMPLETE"})
    assert [file.name for file in tmp_path.iterdir()] == ["run.rrd"]


def test_a_run_without_frames_leaves_a_recording_with_its_verdict(tmp_path):
    path = record_of(tmp_path / "empty.rrd", [], {"verdict": "INCOMPLETE", "drops": {"unreadable": 2}})
    assert rows(path, "/ledger", "TextLog:text")[-1][2] == ["INCOMPLETE: 0 frames, 2 unreadable"]


def test_a_rerun_error_is_raised_and_not_only_a_warning(tmp_path):
    sink = opened(tmp_path / "run.rrd")
    with pytest.raises((ValueError, TypeError)):
        sink.write(Record(START, {}, seconds={"matched": "soon"}))  # type: ignore[dict-item]
    sink.close({})


def test_an_unwritable_end_leaves_no_file(tmp_path):
    lost = [Loss("left", 1 << 63, "source", "unreadable", "gone")]
    with pytest.raises(OverflowError):
        record_of(tmp_path / "run.rrd", [Record(START, scene(START))], {"entries": lost})
    assert not list(tmp_path.iterdir())


def test_an_unwritable_path_is_named(tmp_path):
    with pytest.raises(LogError, match="nowhere"):
        RerunSink().open(tmp_path / "nowhere" / "run.rrd", STREAMS, {})


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_full_disk_is_an_error_and_leaves_no_file(tmp_path, monkeypatch):
    """rerun reports an unexpected full disk only in its log, so the sink checks for it."""
    monkeypatch.setattr("recordings.sinks.rerun_recording.room_to_grow", lambda file: RESERVED_BYTES)
    sink = opened(tmp_path / "run.rrd")
    with file_size_limited(10_000):
        for n in range(3):
            sink.write(Record(START + n, scene(START + n)))
        with pytest.raises(LogError, match="cannot write"):
            sink.close({"verdict": "COMPLETE"})
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_recording_ends_before_the_disk_is_full(tmp_path):
    """rerun's writer never returns if the disk is full or the file cannot grow."""
    sink = opened(tmp_path / "run.rrd")
    with file_size_limited(RESERVED_BYTES // 2):
        with pytest.raises(LogError, match=r"cannot write .* 64 MB more can be written"):
            sink.write(Record(START, scene(START)))
        sink.close({"verdict": "INCOMPLETE"})
    assert [file.name for file in tmp_path.iterdir()] == ["run.rrd"]


def test_every_type_with_a_logger_is_wanted():
    wanted = {kind for kind in (*STREAMS.values(), Mount) if RerunSink().wants("any", kind)}
    assert wanted == set(STREAMS.values())


def test_a_sink_that_is_not_open_writes_nothing_and_closes(tmp_path):
    sink = RerunSink()
    sink.close({"verdict": "COMPLETE"})
    with pytest.raises(LogError, match="is a folder"):
        sink.open(tmp_path, STREAMS, {})
    sink.close({"verdict": "COMPLETE"})
    with pytest.raises(LogError, match="RerunSink is not open"):
        sink.write(Record(START, {}))
    assert list(tmp_path.iterdir()) == []


def test_two_sinks_on_one_path_do_not_mix(tmp_path):
    path = tmp_path / "run.rrd"
    sinks = [opened(path), opened(path)]
    assert len(list(tmp_path.iterdir())) == 2
    for sink in sinks:
        sink.close({"verdict": "COMPLETE"})
        assert b"RRF2FOOT" in path.read_bytes()[-20:]
    assert list(tmp_path.iterdir()) == [path]


def test_intermediates_are_drawn_smaller_than_results(tmp_path):
    path = record_of(tmp_path / "small.rrd", [Record(START, scene())], max_width=32)
    shapes = {}
    for stream in ("matched", "disparity"):
        blob = rows(path, f"/{stream}/pixels", "EncodedDepthImage:blob")[0][2][0]
        stored = decoded(blob, cv2.IMREAD_UNCHANGED) / 4.0
        shapes[stream] = stored.shape
        step = WIDTH // stored.shape[1]
        height, width = stored.shape
        truth = np.nan_to_num(scene()[stream].pixels[step // 2 :: step, step // 2 :: step])[:height, :width]
        assert np.abs(stored - truth).max() <= 1 / 8, stream  # px of the full size
    assert shapes == {"matched": (8, 10), "disparity": (24, 32)}
    left = rows(path, "/rectified/left", "EncodedImage:blob")[0][2][0]
    edges = rows(path, "/disparity/superpixels", "EncodedImage:blob")[0][2][0]
    assert decoded(left, cv2.IMREAD_GRAYSCALE).shape == decoded(edges, cv2.IMREAD_GRAYSCALE).shape == (24, 32)


def test_each_disparity_that_no_other_is_made_from_is_drawn_as_a_result(tmp_path):
    streams = {**STREAMS, "other": Disparity}
    items = scene() | {"other": replace(scene()["disparity"], segments=None)}
    path = tmp_path / "both.rrd"
    sink = RerunSink(finals=("disparity", "other"))
    sink.open(path, streams, {})
    sink.write(Record(START, items))
    sink.close({"verdict": "COMPLETE"})
    found = {chunk.entity_path for chunk in rr.chunk.RrdReader(str(path)).stream()}
    for part in ("depth", "confidence", "difference"):
        assert {name for name in found if name.endswith(f"/{part}")} >= {f"/disparity/{part}", f"/other/{part}"}, part
    assert "/matched/confidence" in found


def test_images_of_every_nth_frame_are_drawn_and_maps_of_all(tmp_path):
    records = [Record(START + n * STEP, scene(START + n * STEP)) for n in range(4)]
    path = record_of(tmp_path / "every.rrd", records, every=2)
    for frames, entity, component in (
        ([0, 2], "/rectified/left", "EncodedImage:blob"), ([0, 2], "/disparity/pixels", "EncodedDepthImage:blob"),
        ([0, 2], "/points/points", "Points3D:positions"),
        ([0, 2], "/elevation_map/surface", "Mesh3D:vertex_positions"),
        ([0, 1, 2, 3], "/elevation_map/relief", "EncodedImage:blob"),
        ([0, 1, 2, 3], "/navigation_map/cells/labels", "SegmentationImage:buffer"),
        ([0, 1, 2, 3], "/motion/features", "Scalars:scalars"),
    ):  # fmt: skip
        assert [frame for _, frame, value in rows(path, entity, component) if value] == frames, entity
    assert "2 of 4" in rows(path, "/summary", "TextDocument:text")[-1][2][0]


def test_the_surface_of_a_regional_map_is_drawn_whenever_its_cells_are(tmp_path):
    terrain, records = replace(scene()["elevation_map"], frame_id="odom"), []
    for n in range(6):
        items, unchanged = ({"elevation_map": terrain}, set()) if n % 2 else ({}, {"elevation_map"})
        records.append(Record(START + n * STEP, items, unchanged=frozenset(unchanged)))
    path = record_of(tmp_path / "every.rrd", records, every=4)
    for part, component in (("relief", "EncodedImage:blob"), ("surface", "Mesh3D:vertex_positions")):
        found = rows(path, f"/elevation_map/{part}", component)
        assert [(frame, bool(value)) for _, frame, value in found] == [(1, True), (3, True), (5, True)], part


def test_a_budget_thins_images_more_and_more_and_is_kept(tmp_path):
    records = []
    for n in range(40):
        items = scene(START + n * STEP)
        items["points"] = resized(items["points"], MAX_POINTS)
        records.append(Record(items["points"].stamp, items))
    path = record_of(tmp_path / "budget.rrd", records, max_megabytes=2)
    clouds = [frame for _, frame, value in rows(path, "/points/points", "Points3D:positions") if value]
    gaps = np.diff(clouds)
    assert gaps[0] == 1
    assert (np.diff(gaps) >= 0).all()
    assert gaps[-1] >= 4
    assert 3 < len(clouds) < 2e6 / 16 / MAX_POINTS
    assert len(rows(path, "/elevation_map/relief", "EncodedImage:blob")) == 40


def test_streams_may_be_left_out_by_patterns():
    sink = RerunSink(without=("disparity/*", "voxels"))
    wanted = {name: sink.wants(name, Disparity) for name in ("disparity", "disparity/half/full", "voxels")}
    assert wanted == {"disparity": True, "disparity/half/full": False, "voxels": False}


@pytest.mark.parametrize("stream", ["layout", "seconds/mean"])
def test_a_stream_with_the_name_of_an_entity_of_the_recording_is_refused(stream):
    entity = stream.partition("/")[0]
    why = f"RerunSink cannot draw '{stream}': the recording has an entity /{entity} of its own; rename the stream"
    assert RerunSink().unwritable(stream, float) == why
    assert not RerunSink().unwritable(f"{entity}_of_mine", float)
    assert not RerunSink().unwritable(stream, Mount)  # which is not drawn
    assert not RerunSink(without=(stream,)).unwritable(stream, float)
