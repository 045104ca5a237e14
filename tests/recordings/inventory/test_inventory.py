"""The inventory of a log for `roverflow info`."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType

from flow.contracts import Severity
from recordings import McapSource
from recordings.containers.container import HEAD_BYTES
from recordings.containers.header import peek_stamp
from recordings.containers.opening import open_recording
from recordings.inventory.description import Damage, _step, describe
from recordings.inventory.text import format_description
from recordings.mcap.file import McapFile
from stages.data import Transform
from tests.conftest import mcap_rows, patch, rewrite
from tests.recordings.sample_log import (
    BASELINE,
    FRAMES,
    INFOS,
    LAYOUTS,
    LEFT,
    PERIOD,
    RIGHT,
    START,
    TILT,
    TRANSFORMS,
    UNSTAMPED,
    Edit,
    changed,
    dropped,
    inventory_of,
    mounted,
    write_sample,
)


@pytest.fixture(scope="module")
def description(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = write_sample(tmp_path_factory.mktemp("log") / "sample.mcap")
    described: dict[str, Any] = json.loads(json.dumps(inventory_of(path)))
    return described


def text_of(folder: Path, *edits: Edit) -> str:
    """What `info` prints of the sample with edits."""
    return format_description(inventory_of(write_sample(folder / "log.mcap", *edits)))


def test_rates_and_gaps_are_those_of_the_log(description):
    topics = {topic["topic"]: topic for topic in description["topics"]}
    assert topics[LEFT]["messages"] == FRAMES
    assert topics[LEFT]["hz"] == pytest.approx(1e9 / PERIOD)
    assert topics[LEFT]["largest_gap_s"] == pytest.approx(PERIOD / 1e9)
    assert topics["/tf_static"]["hz"] is None
    assert description["indexed"]
    assert description["missing"] == {}


def test_static_transforms_have_no_rate(sample, tmp_path):
    twice = rewrite(sample, tmp_path / "log.mcap", extra=lambda writer, channels: (
        writer.add_message(channels["/tf_static"], START + 1, mcap_rows(sample)[0][-1], START + 1)
    ))  # fmt: skip
    (static,) = (topic for topic in inventory_of(twice)["topics"] if topic["topic"] == "/tf_static")
    assert (static["messages"], static["hz"], static["largest_gap_s"]) == (2, None, None)


def test_calibration_transforms_and_pairs_are_reported(description):
    assert description["calibration"]["baseline"] == BASELINE
    assert description["calibration"]["rectified"] is True
    assert description["transforms"] == ["base_link <- imu_link", "base_link <- left_optical"]
    assert description["mount"]["position"] == [0.5, 0.1, 0.9]
    frames = description["frames"]
    assert (frames["left"], frames["right"], frames["pairs"], frames["with_tilt"]) == (FRAMES,) * 4


def test_the_text_lists_topics_streams_and_missing_streams(tmp_path):
    text = text_of(tmp_path, dropped("/odom"))
    line = next(line for line in text.splitlines() if line.startswith(LEFT))
    columns = [LEFT, "sensor_msgs/msg/Image", "5", "10.00", "0.100 s", "left (the only stereo pair)"]
    assert re.split(r"  +", line) == columns
    assert "missing: odometry: the log has no nav_msgs/Odometry" in text
    frames = "frames: 5 stereo pairs (stamps within 5 ms) from 5 left images and 5 right images"
    assert f"{frames}; 5 left images with a tilt (readings at most 200 ms apart)" in text


def test_an_odometry_that_the_user_does_without_is_not_missing(sample):
    with McapSource(odometry="visual").open(sample) as log:
        described = describe(log)
        assert "odometry" in log.missing
    assert described["missing"] == {}
    why = "the source's 'odometry' is set to visual"
    lines = [line for line in format_description(described).splitlines() if why in line]
    assert lines == [f"note: odometry: {why}"]


def test_only_pairs_and_tilts_within_tolerance_are_counted(tmp_path):
    later = [
        changed(RIGHT, {"header.stamp.nanosec": lambda time, by=by: time + by}, [number])
        for number, by in ((1, 6_000_000), (2, 4_000_000))
    ]
    path = write_sample(tmp_path / "log.mcap", *later, dropped(TILT, numbers=[1, 2, 3]))
    described = inventory_of(path)
    frames = described["frames"]
    assert frames["pairs"] == FRAMES - 1
    assert frames["with_tilt"] == frames["pairs_with_tilt"] == 2  # the first and the last frame have one at their stamp
    lost = "2 of 4 stereo pairs in a gap of the tilts, over 0.2 s long; a run loses the tilt there"
    assert described["damage"] == [lost]
    wider = inventory_of(path, slop=6_000_000, max_gap=400_000_000)
    assert (wider["frames"]["pairs"], wider["frames"]["with_tilt"]) == (FRAMES, FRAMES)
    text = format_description(wider)
    assert "5 stereo pairs (stamps within 6 ms) from 5 left images and 5 right images; 5 left images with" in text
    assert "readings at most 400 ms apart), 5 of them in pairs" in text
    assert "damaged" not in text


def test_repeated_stamps_count_once_and_are_reported(tmp_path):
    edit = changed((LEFT, RIGHT, TILT), {"header.stamp.nanosec": lambda time: time - PERIOD}, [2])
    described = inventory_of(write_sample(tmp_path / "log.mcap", edit))
    frames = described["frames"]
    assert (frames["left"], frames["right"]) == (FRAMES, FRAMES)
    assert (frames["pairs"], frames["with_tilt"]) == (FRAMES - 1, FRAMES - 1)
    sentence = "1 of 5 messages repeat a stamp; a run drops them"
    assert described["damage"] == [f"{topic}: {sentence}" for topic in (LEFT, RIGHT, TILT)]


@pytest.mark.parametrize("verified_bytes", [1 << 30, 0])
def test_images_of_a_second_camera_on_a_topic_are_not_usable(tmp_path, monkeypatch, verified_bytes):
    monkeypatch.setattr("recordings.inventory.description.MAX_VERIFIED_BYTES", verified_bytes)
    path = write_sample(tmp_path / "log.mcap", changed(INFOS[0], {"k": lambda k: k * np.geomspace(1, 2, 9)}, [1, 3]))
    described = inventory_of(path)
    assert (described["frames"]["left"], described["frames"]["pairs"]) == (FRAMES, FRAMES - 2)
    assert "doubtful" not in format_description(described)
    (damage,) = described["damage"]
    why = "the calibration differs from the log's first one, so the image cannot be used"
    remedy = "record two cameras on two topics, or split the log where it changes"
    assert damage.startswith(f"2 similar, first: {LEFT} at {START + PERIOD} ns: {why}; {remedy}")


def test_without_cameras_no_pairs_are_reported(tmp_path):
    text = text_of(tmp_path, dropped(*INFOS))
    assert "missing: left: no CameraInfo belongs to" in text
    assert "frames:" not in text


def test_only_sentences_about_single_messages_are_counted_together():
    damage = Damage()
    for sentence in ("/a at 5 ns: cut at 1", "byte 5 is broken", "/a at 7 ns: cut at 2", *["byte 9 is broken"] * 2):
        damage.add(sentence)
    assert damage.listed() == ["2 similar, first: /a at 5 ns: cut at 1", "byte 5 is broken", "byte 9 is broken"]


def test_similar_tilt_errors_are_grouped_in_one_line(tmp_path):
    zero = changed(TILT, {f"orientation.{name}": 0.0 for name in "xyzw"}, range(1, FRAMES))
    other = changed(TILT, {"orientation.w": 0.25}, range(3, FRAMES))
    (line,) = (line for line in text_of(tmp_path, zero, other).splitlines() if line.startswith("damaged"))
    which = f"4 similar, first: {TILT} at {START + PERIOD} ns: the quaternion of the inclinometer"
    assert line.startswith(f"damaged: {which}")


def test_streams_without_stamps_are_noted(tmp_path):
    described = inventory_of(write_sample(tmp_path / "log.mcap", changed((LEFT, "/odom"), UNSTAMPED)))
    assert list(described["notes"]) == ["left", "odometry"]
    shown = [line for line in format_description(described).splitlines() if line.startswith("note: ")]
    sentence = "the header stamps are 0, so log times are used"
    assert shown == [f"note: {stream}: {sentence}" for stream in ("left", "odometry")]


def test_tilts_that_are_logged_too_late_for_a_run_are_doubted(tmp_path):
    doubt = "doubtful: tilts arrive in the log 2.0 s later than images of the same stamp; if no clock is wrong"
    earlier = changed(TILT, {"header.stamp.sec": lambda seconds: seconds - 2})
    assert doubt in text_of(tmp_path, earlier)
    assert doubt not in text_of(tmp_path)
    late, by = tmp_path / "late.mcap", {TILT: 20_000_000_000}
    rewrite(tmp_path / "log.mcap", late, time=lambda topic, at: at + by.get(topic, 0))
    assert "--set tilt.patience=22s" in format_description(inventory_of(late))


def test_stamps_of_tilts_that_are_set_back_within_the_log_are_doubted(tmp_path):
    doubt = "doubtful: the stamps of tilts jump by 3.0 s against their log times; if a clock was set"
    back = changed(TILT, {"header.stamp.sec": lambda seconds: seconds - 3}, range(3, FRAMES))
    assert doubt in text_of(tmp_path, back)
    assert "jump by" not in text_of(tmp_path, changed(TILT, {"header.stamp.sec": lambda seconds: seconds - 3}))


BATCHES = np.tile(np.linspace(2.5, 0, 250), 8)[100:-100]  # s, from stamps to log times


@pytest.mark.parametrize(("delays", "step"), [
    (BATCHES, 0), (BATCHES + 3600 * (np.arange(1800) >= 1640), 3600), (np.repeat([0, -3600, 0], 40), 3600),
    (np.repeat([0.1, 1.0], [99, 2]) + np.tile([0, 0.05], 51)[:101], 0.9), (np.repeat([0, 3600, 0], [50, 1, 50]), 0),
    (np.array([]), 0),
])  # fmt: skip
def test_a_clock_that_was_set_is_a_lasting_step_of_the_delays(delays, step):
    assert _step(delays) == pytest.approx(step, rel=0.01)


def test_tilts_that_are_logged_in_batches_need_patience_and_no_cut(tmp_path):
    text = text_of(tmp_path)
    described = inventory_of(tmp_path / "log.mcap")
    described["frames"] |= {"tilt_delay_s": 1.25, "tilt_delay_step_s": _step(BATCHES)}
    assert "--set tilt.patience=3s" in format_description(described)
    assert "jump by" not in format_description(described)
    described["frames"] |= {"tilt_delay_step_s": 3600.0}
    assert "--set tilt.patience=3s" in format_description(described)
    assert "jump by 3600.0 s" in format_description(described)
    assert "patience" not in text


WIDER = "differ by up to 8 ms; if they are taken at one time, --set stereo.slop=8ms pairs most of them"


@pytest.mark.parametrize(("offset", "number", "doubt"), [
    (4, FRAMES, ""), (PERIOD // 2_000_000, FRAMES, ""), (8, FRAMES, WIDER), (8, FRAMES - 2, WIDER),
])  # fmt: skip
def test_images_that_a_wider_tolerance_would_pair_are_doubted(tmp_path, offset, number, doubt):
    edit = changed(RIGHT, {"header.stamp.nanosec": lambda time: time + offset * 1_000_000}, range(number))
    path = write_sample(tmp_path / "log.mcap", edit)
    text = format_description(inventory_of(path))
    assert ("doubtful" in text, doubt in text) == (bool(doubt), True)
    assert not doubt or inventory_of(path, slop=8_000_000)["frames"]["pairs"] == FRAMES


def test_a_tilt_of_a_frame_whose_z_points_down_is_doubted(tmp_path):
    about_x = {"orientation.x": 1.0, "orientation.y": 0.0, "orientation.z": 0.0, "orientation.w": 0.0}
    doubt = "doubtful: by the tilt the rover is upside down"
    assert doubt in text_of(tmp_path, changed(TILT, about_x))
    assert doubt not in text_of(tmp_path)


def test_a_calibration_of_another_image_size_is_doubted(tmp_path):
    doubt = "cx of 11.5 px lies in the outer fifth of 60x32 images: check that the calibration is for this size"
    assert f"doubtful: {doubt}" in text_of(tmp_path, changed("camera_info", {"width": 60, "height": 32}))


BESIDE = "the static transform 'left_optical' <- 'right_optical'"


@pytest.mark.parametrize(("errors", "told_by_transform", "note"), [
    (BASELINE, BASELINE * 1.04, ""),
    (BASELINE, BASELINE * 1.06,
     f"the baseline is 0.25 m by P of the CameraInfo, which is used, but 0.265 m by {BESIDE}; correct the wrong one"),
    (0.0, 0.3, f"the baseline of 0.3 m comes from {BESIDE}, because P[0,3] of both CameraInfo is 0"),
])  # fmt: skip
def test_a_baseline_from_or_against_the_transform_is_noted(tmp_path, errors, told_by_transform, note):
    beside = Transform("left_optical", "right_optical", np.eye(3), [told_by_transform, 0, 0])
    by_p = changed("right/camera_info", {"p": lambda p: np.where(np.arange(12) == 3, -20 * errors, p)})
    edits = mounted(*TRANSFORMS, beside), by_p, changed(RIGHT, UNSTAMPED)
    path = write_sample(tmp_path / "log.mcap", *edits)
    described = inventory_of(path)
    assert described["calibration"]["baseline"] == pytest.approx(errors or told_by_transform)
    unstamped = "the header stamps are 0, so log times are used"
    assert described["notes"] == {"right": f"{unstamped}; {note}" if note else unstamped}
    assert f"note: right: {described['notes']['right']}" in format_description(described).splitlines()
    with McapSource().open(path) as log:
        contradicted = "correct the wrong one" in note
        assert [finding.severity for finding in log.faults().values()] == [Severity.WARNING] * contradicted


def test_a_missing_right_calibration_is_reported(tmp_path):
    text = text_of(tmp_path, dropped("/stereo/right/camera_info"))
    listed = "the log's CameraInfo topics are /stereo/left/camera_info"
    missing = [line.partition(" of the source")[0] for line in text.splitlines() if line.startswith("missing")]
    mount = "missing: mount: the mount needs a calibrated pair of cameras"
    assert missing == [f"missing: right: no CameraInfo belongs to {RIGHT} ({listed}); set 'right_info'", mount]


def test_undecodable_topics_are_listed_once(tmp_path):
    path = rewrite(write_sample(tmp_path / "log.mcap"), tmp_path / "odd.mcap", encode=lambda *of: ("cbor", of[2]))
    text = format_description(inventory_of(path))
    assert text.count("cannot be decoded") == text.count(f"{LEFT}: its messages are in 'cbor'") == 1
    assert "missing: left, right: the log has no camera image" in text
    with McapSource().open(path) as log:  # a refusal is complete without the others
        assert all(f"{LEFT}: its messages" in log.missing[stream] for stream in ("left", "inclinometer", "odometry"))


def test_damage_is_reported(tmp_path):
    path = rewrite(write_sample(tmp_path / "sample.mcap"), tmp_path / "log.mcap", chunk_size=500)
    os.truncate(path, path.stat().st_size // 2)
    description = inventory_of(path)
    assert not description["indexed"]
    assert "the log is truncated or damaged at byte" in description["damage"][0]
    assert "damaged: the log is truncated" in format_description(description)


def test_without_a_tilt_no_frame_has_one(tmp_path):
    edit = changed(TILT, {"orientation_covariance": np.full(9, -1.0)})
    found = inventory_of(write_sample(tmp_path / "log.mcap", edit))
    assert found["frames"]["with_tilt"] == 0
    assert "; 0 left images with a tilt; " in format_description(found)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_large_log_is_described_by_the_starts_of_its_messages(sample, tmp_path, monkeypatch, layout):
    path = rewrite(sample, tmp_path / "log.mcap", **LAYOUTS[layout])
    whole = inventory_of(path)
    monkeypatch.setattr("recordings.inventory.description.MAX_VERIFIED_BYTES", 0)
    assert inventory_of(path) == whole


def test_only_the_starts_of_the_images_of_a_large_log_are_read(sample, tmp_path, monkeypatch):
    path = rewrite(sample, tmp_path / "log.mcap", compression=CompressionType.NONE)
    with McapFile(path) as log:
        (image,) = (item for item in log.messages(log.channels_of([LEFT]), START, START + PERIOD // 2))
        data = bytes(image.data)
    middle = len(data) // 2  # the CRC of the only chunk does not match any more
    patch(path, path.read_bytes().index(data) + middle, bytes([data[middle] ^ 0xFF]))
    with open_recording(path) as log:
        heads = list(log.heads(log.channels_of([LEFT, RIGHT])))
    assert [peek_stamp(head.data) for head in heads] == [START + n // 2 * PERIOD for n in range(2 * FRAMES)]
    assert {len(head.data) for head in heads} == {HEAD_BYTES}
