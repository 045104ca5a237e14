"""Result logs: the results of a frame are in the log under its stamp, complete or not at all."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from recordings import McapSink
from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import read_disparity, read_grid_map, read_occupancy_grid, read_point_cloud, stamp_of
from recordings.scoring.result_log import end_of_run
from stages.data import (
    LEVEL_FRAME,
    Disparity,
    ElevationMap,
    NavigationMap,
    PointCloud,
    Region,
    StereoCamera,
    TiltHealth,
    Transform,
)  # fmt: skip
from tests.recordings.sinks.recorded_scene import Loss, Record
from tests.stages.terrain.region_scene import MOUNT, SECOND, Fusing, drive
from tests.stages.terrain.region_scene import START as DRIVE

START = 1_700_000_000_000_000_000
STREAMS = {"disparity": Disparity, "points": PointCloud, "elevation_map": ElevationMap, "navigation_map": NavigationMap}
ABOUT = {"pipeline": "rover", "numpy": "2"}


def items(stamp: int) -> dict[str, Any]:
    rng = np.random.default_rng(stamp % 1000)
    pixels = rng.uniform(1, 60, (6, 8)).astype(np.float32)
    pixels[0, 0] = np.nan
    source = rng.integers(0, 4, (6, 8), dtype=np.uint8)
    camera = StereoCamera(20.0, 20.0, 4.0, 3.0, 0.25, 8, 6, frame_id="left_optical")
    sensor = Transform("level", "left_optical", np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), [0.5, 0, 0.9])
    return {
        "disparity": Disparity(stamp, pixels, source, np.ones((6, 8), np.float32), camera=camera),
        "points": PointCloud(
            stamp, rng.normal(size=(5, 3)).astype(np.float32), rng.integers(0, 255, (5, 3), dtype=np.uint8),
            np.ones(5, np.float32), np.arange(5, dtype=np.int32), "level", sensor=sensor,
        ),
        "elevation_map": ElevationMap(stamp, {"elevation": pixels[:3]}, 0.05, (-1.0, 2.0), "level"),
        "navigation_map": NavigationMap(
            stamp, np.array([[0, 100, -1]], np.int8), np.zeros((1, 3), np.uint8), 0.05, (0.0, 0.0), "level"
        ),
    }  # fmt: skip


SUMMARY = {
    "verdict": "INCOMPLETE", "frames_in": 2, "frames_out": 1, "drops": {"failed": 1}, "messages": {"left": 2},
    "wall_seconds": 1.5, "entries": [Loss("left", START + 9, "source", "unreadable", "the log is cut")],
}  # fmt: skip


def logged(path: Path, *records: Record, streams: Any = STREAMS, summary: Any = None, **settings: Any) -> Path:
    """A result log of records. settings: of the sink."""
    sink = McapSink(**settings)
    sink.open(path, streams, ABOUT)
    try:
        for record in records:
            sink.write(record)
        sink.close(summary or {})
    finally:
        sink.discard()
    return path


def write(path: Path, seconds: float = 0.1, **settings: Any) -> Path:
    """A result log of a whole frame and of one that lost its elevation map."""
    lost = (Loss("elevation_map", START + 100, "match", "failed", "no texture"),)
    kept = {name: item for name, item in items(START + 100).items() if name != "elevation_map"}
    whole = Record(START, items(START), seconds={"match": seconds})
    part = Record(START + 100, kept, lost, queues={"match": int(seconds * 10)})
    return logged(path, whole, part, summary={**SUMMARY, "wall_seconds": seconds}, **settings)


def diagnostics_of(path: Path) -> list[Any]:
    """The statuses of each message of diagnostics."""
    return [message.status for _, _, message in iter_decoded(path, ["/nav/diagnostics"])]


def last_messages(path: Path) -> dict[str, Any]:
    """The last message of each topic."""
    return {topic: message for topic, _, message in iter_decoded(path)}


def test_every_result_is_in_the_log_under_its_frame_s_stamp(tmp_path):
    read = list(iter_decoded(write(tmp_path / "out.mcap")))
    topics = [(topic, stamp - START) for topic, stamp, _ in read]
    results = [f"/nav/{name}" for name in ("disparity", "points", "elevation_map", "navigation_map")]
    frame = [f"/nav/disparity{end}" for end in ("", "/source", "/camera_info")]
    frame += [*results[1:], "/nav/navigation_map/reason", "/tf", "/nav/diagnostics"]
    second = [topic for topic in frame if topic != "/nav/elevation_map"]
    assert topics == [(t, 0) for t in frame] + [(t, 100) for t in second] + [("/nav/diagnostics", 100)]
    first = {topic: message for topic, stamp, message in read if stamp == START}
    sent = items(START)
    np.testing.assert_allclose(read_disparity(first["/nav/disparity"]), sent["disparity"].pixels, rtol=0, atol=1 / 64)
    assert first["/nav/disparity"].delta_d == 1 / 32
    source = first["/nav/disparity/source"]
    assert (source.encoding, stamp_of(source.header), source.header.frame_id) == ("mono8", START, "left_optical")
    np.testing.assert_array_equal(source.data.reshape(source.height, source.width), sent["disparity"].source)
    elevation = read_grid_map(first["/nav/elevation_map"]).layers["elevation"]
    np.testing.assert_allclose(elevation, sent["elevation_map"].layers["elevation"], rtol=0, atol=1 / 2048)
    navigation = read_occupancy_grid(first["/nav/navigation_map"], first["/nav/navigation_map/reason"])
    np.testing.assert_array_equal(navigation.cells, sent["navigation_map"].cells)
    np.testing.assert_array_equal(navigation.reason, sent["navigation_map"].reason)
    moved = first["/tf"].transforms[0]
    assert (moved.header.frame_id, moved.child_frame_id) == ("level", "left_optical")
    assert moved.transform.translation.z == 0.9
    assert stamp_of(moved.header) == START


def test_the_end_of_a_run_contains_what_its_survey_and_its_stages_found(tmp_path):
    fault = {"severity": "fault", "sentence": "left and right are swapped"}
    note = {"severity": "note", "sentence": "level"}
    summary = SUMMARY | {"surveys": {"rectified": fault}, "findings": {"tilt": note}}
    path = logged(tmp_path / "out.mcap", Record(START, items(START)), summary=summary)
    found = {name: value for name, value in end_of_run(path).items() if name.startswith("findings.")}
    assert found == {"findings.rectified": "fault: left and right are swapped", "findings.tilt": "note: level"}


def test_losses_are_in_the_diagnostics_of_their_frame_or_at_the_end(tmp_path):
    whole, lost, late = diagnostics_of(write(tmp_path / "out.mcap"))
    assert [(s.level, s.message) for s in whole] == [(0, "nothing lost")]
    assert [(s.level, s.name, s.message) for s in lost] == [(2, "match/elevation_map", "no texture")]
    assert {v.key: v.value for v in lost[0].values}["reason"] == "failed"
    assert late[0].message == "the log is cut"


def test_the_diagnostics_contain_the_epoch_of_a_regional_map(tmp_path):
    fuse, records, epochs = Fusing(), [], {}
    for frame in range(3):
        cloud, pose = drive(frame)
        pose = replace(pose, frame_id="odom" if frame == 0 else "odom/2")  # the map starts again
        records.append(Record(cloud.stamp, {"regional_map": fuse(cloud, pose, MOUNT)}))
    path = logged(tmp_path / "out.mcap", *records, streams={"regional_map": ElevationMap})
    for _, stamp, message in iter_decoded(path, ["/nav/diagnostics"]):
        (about,) = (status for status in message.status if status.name == "regional_map")
        (epochs[stamp],) = (int(pair.value) for pair in about.values if pair.key == "epoch")
    assert list(epochs.values()) == [DRIVE, DRIVE + SECOND, DRIVE + SECOND]
    for _, stamp, message in iter_decoded(path, ["/nav/regional_map"]):
        assert epochs[stamp] + np.nanmax(read_grid_map(message).layers["last"]) * SECOND == stamp


def test_the_metadata_contain_the_inputs_and_the_verdict_of_the_run(tmp_path):
    with write(tmp_path / "out.mcap").open("rb") as file:
        records = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
    assert records["roverflow"] == ABOUT
    assert records["roverflow.run"] == {
        "verdict": "INCOMPLETE", "frames_in": "2", "frames_out": "1", "drops.failed": "1", "messages.left": "2",
    }  # fmt: skip


def test_the_log_has_a_digest_of_each_topic(tmp_path):
    def digests(path):
        with path.open("rb") as file:
            (found,) = (item.metadata for item in make_reader(file).iter_metadata() if item.name == "roverflow.digests")
        return found

    def drawn(name, step):
        streams = {stream: type(item) for stream, item in items(START).items()}
        return digests(logged(tmp_path / name, Record(START, items(START)), streams=streams, disparity_step=step))

    assert digests(write(tmp_path / "a", compression="lz4")) == digests(write(tmp_path / "b", compression="none"))
    fine, coarse = drawn("c", 0.0), drawn("d", 1.0)
    assert {"/nav/disparity", "/nav/elevation_map", "/tf", "/nav/diagnostics"} <= fine.keys() == coarse.keys()
    assert {topic for topic in fine if fine[topic] != coarse[topic]} == {"/nav/disparity"}


def test_timing_does_not_change_the_log(tmp_path):
    one, other = write(tmp_path / "a.mcap", 0.1), write(tmp_path / "b.mcap", 2.7)
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_the_log_has_the_given_compression_and_the_same_messages(tmp_path, compression):
    log = write(tmp_path / "out.mcap", compression=compression)
    with log.open("rb") as file:
        used = {index.compression for index in make_reader(file).get_summary().chunk_indexes}
    assert used == {"" if compression == "none" else compression}
    sent = [(topic, stamp, repr(message)) for topic, stamp, message in iter_decoded(write(tmp_path / "usual.mcap"))]
    assert [(topic, stamp, repr(message)) for topic, stamp, message in iter_decoded(log)] == sent
    with pytest.raises(ValueError, match=r"compression must be one of lz4, zstd, none, not '?gzip"):
        McapSink(compression="gzip")


def test_a_run_without_frames_leaves_a_readable_log(tmp_path):
    sink = McapSink()
    sink.open(tmp_path / "out.mcap", {}, {})
    assert not (tmp_path / "out.mcap").exists()
    sink.close({"verdict": "COMPLETE"})
    with (tmp_path / "out.mcap").open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == 0
    assert [p.name for p in tmp_path.iterdir()] == ["out.mcap"]


def test_only_the_named_streams_are_written():
    sink, more = McapSink(results=("disparity",)), McapSink(also=("dense", "points", "diagnosis", "diagnostics"))
    assert sink.wants("disparity", Disparity)
    assert not sink.wants("elevation_map", ElevationMap)
    assert sink.unwritable("disparity", complex).startswith("McapSink cannot write 'disparity': complex has no")
    assert not sink.unwritable("points", complex)
    assert all(more.wants(name, ElevationMap) for name in ("dense", "elevation_map"))
    assert not more.wants("denser", ElevationMap)
    assert {"results", "also"} == set(more.names_streams)
    assert not more.unwritable("diagnosis", Disparity)
    why = more.unwritable("diagnostics", Disparity)
    assert why == "McapSink cannot write 'diagnostics': /nav/diagnostics contains the losses; rename the stream"


def test_the_camera_is_placed_also_where_no_points_are_written(tmp_path):
    sink = McapSink(results=("disparity",))
    given = {name: item for name, item in items(START).items() if sink.wants(name, STREAMS[name])}
    read = last_messages(logged(tmp_path / "out.mcap", Record(START, given), results=("disparity",)))
    assert [topic for topic in read if topic.startswith("/nav/points")] == []
    (placed,) = read["/tf"].transforms
    assert (placed.header.frame_id, placed.child_frame_id) == ("level", read["/nav/disparity"].header.frame_id)


def test_tf_joins_the_frame_of_a_regional_map_to_frame_level(tmp_path):
    level = Transform("odom", "level", np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, 4.0, 0.5]))
    region = ElevationMap(START, {"elevation": np.ones((3, 4), np.float32)}, 0.05, (-1.0, 2.0), "odom", level=level)
    record = Record(START, {**items(START), "regional_map": region})
    read = last_messages(logged(tmp_path / "out.mcap", record, streams={"regional_map": ElevationMap}))
    assert read["/nav/regional_map"].header.frame_id == "odom"
    frames = {(item.header.frame_id, item.child_frame_id): item.transform for item in read["/tf"].transforms}
    assert set(frames) == {("level", "left_optical"), ("odom", "level")}
    assert (frames["odom", "level"].translation.x, frames["odom", "level"].translation.y) == (3.0, 4.0)


def test_tilt_health_and_findings_are_in_the_diagnostics(tmp_path):
    assert McapSink().wants("health", TiltHealth)
    fault = TiltHealth(START, 0.05, float("nan"), 40, "the sign of pitch is flipped", "turn it round")
    said = (("health", "fault", "turn it round"), ("region", "warning", "reset"), ("pose", "note", "visual"))
    found = {name: {"severity": severity, "sentence": sentence} for name, severity, sentence in said}
    summary = SUMMARY | {"findings": found, "entries": []}
    frame, end = diagnostics_of(logged(tmp_path / "out.mcap", Record(START, {"health": fault}), summary=summary))
    assert [(status.level, status.name) for status in frame] == [(0, "roverflow"), (1, "health")]
    assert frame[1].message == "turn it round"
    values = {value.key: value.value for value in frame[1].values}
    assert values == {"tilt off turn": "2.865 deg", "frames": "40", "fault": "the sign of pitch is flipped"}
    assert [(status.level, status.name, status.message) for status in end] == [
        (2, "health", "turn it round"), (1, "region", "reset"), (0, "pose", "visual"),
    ]  # fmt: skip


def test_frame_level_is_placed_in_frames_without_a_regional_map(tmp_path):
    fuse, records, places, moved = Fusing(), [], {}, {}
    for frame in range(4):
        cloud, pose = drive(frame)
        made = {"regional_map": fuse(cloud, pose, MOUNT), "regional_cells": fuse.region}
        records.append(Record(cloud.stamp, made if frame == 2 else {"regional_cells": fuse.region}))
        places[cloud.stamp] = fuse.region.level.translation.tolist()
    path = logged(tmp_path / "out.mcap", *records, streams={"regional_cells": Region, "regional_map": ElevationMap})
    for _, stamp, message in iter_decoded(path, ["/tf"]):
        at = message.transforms[0]
        assert (at.header.frame_id, at.child_frame_id, stamp_of(at.header)) == ("odom", LEVEL_FRAME, stamp)
        moved[stamp] = [getattr(at.transform.translation, axis) for axis in "xyz"]
    assert [stamp for _, stamp, _ in iter_decoded(path, ["/nav/regional_map"])] == [DRIVE + 2 * SECOND]
    assert moved == places


def test_the_map_of_an_earlier_frame_does_not_place_frame_level(tmp_path):
    """Where a region begins again, the map that the frame before lacked comes with the next frame."""
    fuse, made = Fusing(), []
    for frame in range(2):
        cloud, pose = drive(frame)
        made.append((fuse(cloud, pose, MOUNT), fuse.region))
    (held, _), (_, region) = made
    streams = {"regional_cells": Region, "regional_map": ElevationMap}
    record = Record(region.stamp, {"regional_cells": region, "regional_map": held})
    ((_, _, message),) = iter_decoded(logged(tmp_path / "out.mcap", record, streams=streams), ["/tf"])
    (at,) = message.transforms
    assert at.transform.translation.x == region.level.translation[0] != held.level.translation[0]


def test_frame_level_has_one_parent_though_the_first_frame_has_no_pose(tmp_path):
    fuse, records = Fusing(), []
    for frame in range(3):
        cloud, pose = drive(frame)
        fuse(cloud, pose, MOUNT)
        points = replace(items(cloud.stamp)["points"], stamp=cloud.stamp)
        records.append(Record(cloud.stamp, {"points": points, **({"regional_cells": fuse.region} if frame else {})}))
    streams = {"points": PointCloud, "regional_cells": Region}
    path = logged(tmp_path / "out.mcap", *records, streams=streams, viewers=True)
    transforms = [item for _, _, message in iter_decoded(path, ["/tf", "/tf_static"]) for item in message.transforms]
    parents = {(item.child_frame_id, item.header.frame_id) for item in transforms}
    assert parents == {("left_optical", LEVEL_FRAME), (LEVEL_FRAME, "odom"), ("odom", "tf#/")}


def test_no_rounding_keeps_every_bit(tmp_path):
    exact = {"disparity_step": 0.0, "point_spacing": 0.0, "length_step": 0.0, "precision": 0.0}
    sent = items(START)
    read = last_messages(logged(tmp_path / "out.mcap", Record(START, sent), **exact))
    np.testing.assert_array_equal(read_disparity(read["/nav/disparity"]), sent["disparity"].pixels)
    points = read_point_cloud(read["/nav/points"])
    np.testing.assert_array_equal(np.column_stack([points[axis] for axis in "xyz"]), sent["points"].points)
    np.testing.assert_array_equal(points["sigma"], sent["points"].sigma)
    elevation = read_grid_map(read["/nav/elevation_map"]).layers["elevation"]
    np.testing.assert_array_equal(elevation, sent["elevation_map"].layers["elevation"])
