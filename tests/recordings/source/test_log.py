"""Changes in the middle of a log and types with wrong fields lose their own messages and are reported."""

from pathlib import Path
from typing import Any

import pytest

from recordings import McapSource
from tests.conftest import chunks_of, rewrite, with_broken
from tests.recordings.sample_log import (
    FRAMES,
    INFOS,
    LAYOUTS,
    LEFT,
    PERIOD,
    RIGHT,
    START,
    TILT,
    changed,
    dropped,
    inventory_of,
    items_of,
    losses_in,
    stamps_in,
    write_sample,
)

INFO = "/stereo/left/camera_info"
IMAGE_LAG = 1000  # ns between an image's stamp and its log time in the sample


@pytest.mark.parametrize("lag", [0, 50_000_000])
def test_an_image_under_another_calibration_is_lost(tmp_path, lag):
    plain = write_sample(tmp_path / "plain.mcap", changed(INFO, {"k": lambda k: k * 1.5}, [2, 3]))
    # The calibration is logged after its image.
    late = lambda topic, time: time + (lag if topic == INFO else 0)  # noqa: E731
    path = rewrite(plain, tmp_path / "log.mcap", time=late)
    events = items_of(path)
    assert [time for time, _, _ in events] == sorted(time for time, _, _ in events)
    lost = losses_in(events)
    assert [(time, stream) for time, stream, _ in lost] == [
        (START + number * PERIOD + IMAGE_LAG, "left") for number in (2, 3)
    ]
    assert all("split the log where it changes" in sentence for _, _, sentence in lost)
    assert stamps_in(events) == [START + number * PERIOD for number in (0, 1, 4)]
    assert sum(stream == "right" for _, stream, _ in events) == FRAMES


def test_a_clock_of_stamps_may_begin_at_0(tmp_path):
    stamped = (LEFT, RIGHT, TILT, "/odom", "camera_info")
    path = write_sample(tmp_path / "log.mcap", changed(stamped, {"header.stamp.sec": 0}))
    for stream in ("left", "right", "inclinometer", "odometry"):
        assert stamps_in(items_of(path), stream) == [number * PERIOD for number in range(FRAMES)]
    with McapSource().open(path) as log:
        assert log.notes() == {}
        assert log.first_stamp == -IMAGE_LAG


def calibrated_once_more(path: Path, layout: str, again: Any = 2) -> Path:
    """A log of half a hertz whose CameraInfo come with frame 0, and changed with frame 2 (and `again`)."""

    later = changed("camera_info", {"k": lambda k: k * 1.5}, range(1, FRAMES))
    rare = dropped(*INFOS, numbers={*range(FRAMES)} - {0, 2, again})
    slow = lambda topic, time: START + 20 * (time - START)  # noqa: E731
    plain = write_sample(path.with_name("plain.mcap"), later, rare)
    return rewrite(plain, path, time=slow, **LAYOUTS[layout])


def left_of(log: Any) -> tuple[list[int], list[str]]:
    """Numbers of the left images of an iteration, and the errors of the lost ones."""
    items = [(time, item) for time, stream, item in log if stream == "left"]
    lost = [str(item) for _, item in items if isinstance(item, Exception)]
    return [round((time - START) / (20 * PERIOD)) for time, item in items if not isinstance(item, Exception)], lost


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_calibration_change_before_the_range_is_known(tmp_path, layout):
    path = calibrated_once_more(tmp_path / "log.mcap", layout)
    with McapSource().open(path, start=7.5) as log:
        read, lost = left_of(log.events())
        assert (read, len(lost)) == ([], 1)
        excerpts = [left_of(events)[0] for events in log.excerpts(FRAMES, {"left", "right"})]
    assert excerpts == [[0, 1], [1], [], [], []]


def test_a_damaged_calibration_keeps_the_previous_one_in_force(tmp_path):
    path = calibrated_once_more(tmp_path / "log.mcap", "small chunks", again=3)
    infos = [chunk for chunk, topics in chunks_of(path) if INFO in topics]
    broken = max(infos, key=lambda chunk: chunk.message_start_time)
    assert broken.message_start_time >= START + 60 * PERIOD
    with McapSource().open(with_broken(path, broken), start=8.0) as log:
        read, lost = left_of(log.events())
        assert (read, len(lost)) == ([], 1)
        assert lost[-1].endswith("split the log where it changes")


def test_a_tilt_of_another_sensor_is_lost(tmp_path):
    edit = changed(TILT, {"header.frame_id": "other_imu"}, [3])
    ((time, stream, why),) = losses_in(items_of(write_sample(tmp_path / "log.mcap", edit)))
    assert (time, stream) == (START + 3 * PERIOD, "inclinometer")
    assert "its frame is 'other_imu', but the mount is that of 'imu_link'" in why


@pytest.mark.parametrize(("topic", "stream"), [(TILT, "inclinometer"), (LEFT, "left"), (INFO, "left")])
def test_undecodable_messages_of_a_used_topic_are_counted(sample, tmp_path, topic, stream):
    def encode(name, number, schema):
        return ("cbor" if name == topic and number >= 3 else "cdr"), schema

    path = rewrite(sample, tmp_path / "log.mcap", encode=encode)
    with McapSource().open(path) as log:
        assert log.missing == {}
        assert log.frames == (3 if topic == LEFT else FRAMES)
        ((_, lossy, why),) = losses_in(log.events())
    assert lossy == stream
    assert f"{topic}: 2 messages of its channel" in why
    assert "in 'cbor', which is not supported" in why
    described = inventory_of(path)
    counts = [(item["encoding"], item["messages"]) for item in described["topics"] if item["topic"] == topic]
    assert sorted(counts) == [("cbor", 2), ("cdr", 3)]
    assert described["damage"] == [why]


@pytest.mark.parametrize(("topic", "fields", "stream"), [
    (TILT, (b"orientation", b"orientatiox"), "inclinometer"),
    ("/tf_static", (b"transforms", b"transformed"), "mount"),
    ("/tf_static", (b"child_frame_id", b"child_frame_ix"), "mount"),
    (INFO, (b"float64[9] k", b"float64[9] q"), "left"),
    (INFO, (b"float64[12] p", b"float64[4] p\nfloat64[8] q"), "left"),
])  # fmt: skip
def test_a_type_with_wrong_fields_is_reported(sample, tmp_path, topic, fields, stream):
    def encode(name, number, schema):
        return "cdr", schema.replace(*fields) if name == topic else schema

    path = rewrite(sample, tmp_path / "log.mcap", encode=encode)
    with McapSource().open(path) as log:
        assert stream in log.missing
        list(log.events())
    inventory_of(path)


@pytest.mark.parametrize("start", [None, 0.35])
def test_excerpts_are_spread_over_the_whole_log(tmp_path, start):
    with McapSource().open(write_sample(tmp_path / "log.mcap"), start=start) as log:
        excerpts = [list(events) for events in log.excerpts(2, {"left", "right"})]
    stamps = [[(stream, (item.stamp - START) // PERIOD) for _, stream, item in events] for events in excerpts]
    assert [found[0] for found in stamps] == [("left", 1), ("left", 3)]
    for found, first in zip(stamps, (1, 3), strict=True):
        assert set(found) == {(side, number) for side in ("left", "right") for number in range(first, FRAMES)}


def test_at_most_one_excerpt_begins_at_a_frame(tmp_path):
    with McapSource().open(write_sample(tmp_path / "log.mcap")) as log:
        assert len(list(log.excerpts(20, {"left", "right"}))) == FRAMES
        assert len(list(log.excerpts(3, {"left", "right"}))) == 3
