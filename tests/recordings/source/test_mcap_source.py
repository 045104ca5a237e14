"""Reading logs: recorded data bit for bit, damage and missing streams reported."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings import McapSource
from recordings.errors import LogError
from recordings.ros2.cdr import make
from recordings.ros2.tilt_from_msg import AngleField
from stages.data import CameraImage, Mount
from tests.conftest import mcap_rows, rewrite, write_mcap
from tests.recordings.sample_log import (
    BASELINE,
    FRAMES,
    HEIGHT,
    LAYOUTS,
    LEFT,
    PERIOD,
    RIGHT,
    START,
    TILT,
    TRANSFORMS,
    UNSTAMPED,
    WIDTH,
    changed,
    dropped,
    essences,
    inventory_of,
    items_of,
    missing_in,
    model,
    picture,
    replaced,
    stamps_in,
    tilt_quaternion,
    with_extra,
    write_sample,
)  # fmt: skip

INFO = "/stereo/left/camera_info"
MS = 1_000_000


def test_messages_are_read_bit_for_bit(sample):
    with McapSource().open(sample) as log:
        assert (log.missing, log.frames) == ({}, FRAMES)
        assert log.topics == {"left": LEFT, "right": RIGHT, "inclinometer": TILT, "odometry": "/odom"}
        events = list(log.events())
    assert [time for time, _, _ in events] == sorted(time for time, _, _ in events)
    by_stream = {stream: [item for _, name, item in events if name == stream] for stream in McapSource.streams}
    assert [len(by_stream[name]) for name in ("left", "right", "inclinometer", "mount", "odometry")] == [5, 5, 5, 1, 5]
    for number in range(FRAMES):
        stamp = START + number * PERIOD
        left, right = by_stream["left"][number], by_stream["right"][number]
        np.testing.assert_array_equal(left.pixels, picture(2 * number))
        np.testing.assert_array_equal(right.pixels, picture(2 * number + 1))
        frame = left.pair_with(right)
        assert (frame.stamp, frame.camera.baseline, frame.camera.fx, frame.camera.raw) == (stamp, BASELINE, 20.0, None)
        up = Rotation.from_quat(tilt_quaternion(number)).inv().apply([0, 0, 1])
        np.testing.assert_allclose(by_stream["inclinometer"][number].up, up, atol=1e-12)
        pose = by_stream["odometry"][number]
        assert (pose.stamp, pose.position.tolist(), pose.frame_id, pose.child_frame_id) == (
            stamp, [number, 2, 3], "odom", "base_link",
        )  # fmt: skip


def test_the_mount_comes_first_and_follows_the_static_transforms(whole):
    time, stream, mount = whole[0]
    assert (time, stream) == (START, "mount")
    assert isinstance(mount, Mount)
    camera, sensor = TRANSFORMS
    np.testing.assert_allclose(mount.camera_from_inclinometer, camera.rotation.T @ sensor.rotation, atol=1e-12)
    assert mount.base_from_camera is not None
    np.testing.assert_allclose(mount.base_from_camera([[0, 0, 2.0]]), [[2.5, 0.1, 0.9]], atol=1e-12)


def test_the_mount_holds_after_a_clock_was_set_back(tmp_path):
    set_back = changed("", {"header.stamp.sec": lambda seconds: seconds - 3600}, range(3, FRAMES))
    items = [item for _, _, item in items_of(write_sample(tmp_path / "log.mcap", set_back), start=0.25)]
    (mount,) = (item for item in items if isinstance(item, Mount))
    images = [item for item in items if isinstance(item, CameraImage)]
    assert len(images) == 4
    assert all(mount.stamp <= image.stamp for image in images)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_file_layout_gives_the_same_items(sample, whole, tmp_path, layout):
    other = rewrite(sample, tmp_path / "other.mcap", **LAYOUTS[layout])
    assert essences(items_of(other)) == essences(whole)
    assert inventory_of(other)["frames"]["pairs"] == FRAMES


def test_a_range_contains_complete_frames_and_their_tilts(sample, tmp_path):
    with McapSource().open(sample, start=0.1, end=0.3) as log:
        assert log.frames == 2
        events = list(log.events())
    assert stamps_in(events, "left") == stamps_in(events, "right") == [START + PERIOD, START + 2 * PERIOD]
    assert stamps_in(events, "inclinometer") == [START + number * PERIOD for number in range(FRAMES)]
    late = rewrite(sample, tmp_path / "late.mcap", time=lambda topic, log_time: log_time + MS * ("stereo" in topic))
    only = rewrite(late, tmp_path / "images.mcap", lambda topic, _, data: data if "stereo" in topic else None)
    for start in (None, 0.0):  # images are logged after their stamps, also the log's first message
        with McapSource().open(only, start=start) as log:
            assert sum(stream == "left" for _, stream, _ in log.events()) == FRAMES
            first, *_ = (item.stamp for events in log.excerpts(20, {"left"}) for _, _, item in events)
            assert first == START
    with pytest.raises(LogError, match=r"sample\.mcap is 0\.400 s long; start 9 s is after its end"):
        McapSource().open(sample, start=9)
    with pytest.raises(LogError, match=r"start 0\.3 s is not before end 0\.2 s; give a smaller start or a larger end"):
        McapSource().open(sample, start=0.3, end=0.2)


@pytest.mark.parametrize(("edit", "stream", "sentence"), [
    (dropped("/stereo/right"), "right", f"the log has only one image topic \\({LEFT}\\), but stereo needs two"),
    (dropped("/stereo"), "left", "the log has no camera image"),
    (dropped(INFO), "left", f"no CameraInfo belongs to {LEFT} .*; set 'left_info' of the source"),
    (dropped(TILT), "inclinometer", "the log has no tilt"),
    (dropped(TILT), "mount", "the mount needs an inclinometer"),
    (dropped("/tf_static"), "mount", r"static transform joins the camera \('left_optical'\) and the inclinometer"),
    (dropped("/odom"), "odometry", "the log has no nav_msgs/Odometry"),
    (changed(TILT, {"orientation_covariance": np.full(9, -1.0)}), "inclinometer", "contains no orientation"),
    (changed("right/camera_info", {"p": np.hstack([model().k, np.zeros((3, 1))]).reshape(-1)}), "left",
     "does not contain the baseline"),
    (changed("right/camera_info", {"p": np.hstack([model().k, [[5.0], [0], [0]]]).reshape(-1)}), "left",
     f"the baseline is -0.25 m, so {LEFT} is the right camera"),
    (changed("right/camera_info", {"p": np.array([20.0, 0, 11.5, 0, 0, 20, 7.5, -10, 0, 0, 1, 0])}), "left",
     "is above or below that of .*rotate the images by 90 degrees before they are calibrated and logged$"),
    (changed(INFO, {"k": np.zeros(9), "p": np.zeros(12)}), "left", "is not calibrated"),
])  # fmt: skip
def test_missing_streams_are_reported_with_the_remedy(tmp_path, edit, stream, sentence):
    assert re.search(sentence, missing_in(write_sample(tmp_path / "log.mcap", edit))[stream])


@pytest.mark.parametrize("names", [
    ("/cam0/image_raw", "/cam1/image_raw"),
    ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
    ("/rover0/stereo/l/image", "/rover0/stereo/r/image"),
    ("/stereoLeft/image", "/stereoRight/image"),
    ("/nav/left/image_rect", "/nav/right/image_rect"),
])  # fmt: skip
def test_pairs_are_found_by_common_camera_names(tmp_path, names):
    with McapSource().open(write_sample(tmp_path / "log.mcap", names=names)) as log:
        assert (log.topics["left"], log.topics["right"]) == names
        assert stamps_in(log.events()) == [START + n * PERIOD for n in range(FRAMES)]


def test_a_bad_message_is_lost_alone(tmp_path):
    edits = (
        changed(LEFT, {"data": lambda data: data[:-5]}, [1]), changed(RIGHT, {"encoding": "packed10"}, [2]),
        changed(TILT, {"orientation.x": 5.0}, [3]), changed("/odom", {"header.stamp.nanosec": 2**32 - 1}, [2]),
    )  # fmt: skip
    events = items_of(write_sample(tmp_path / "log.mcap", *edits))
    problems = {stream: str(item) for _, stream, item in events if isinstance(item, Exception)}
    assert f"the image is truncated: it has {WIDTH * HEIGHT * 3 - 5} of {WIDTH * HEIGHT * 3} bytes" in problems["left"]
    assert "image encoding 'packed10' is not supported" in problems["right"]
    assert "the quaternion of the inclinometer is not a rotation" in problems["inclinometer"]
    assert "its stamp is damaged (4294967295 ns beyond the second)" in problems["odometry"]
    assert len(events) == 4 * FRAMES + 1


def test_an_unsupported_encoding_is_reported_before_the_run(tmp_path):
    path = write_sample(tmp_path / "log.mcap", changed(RIGHT, {"encoding": "packed10"}))
    missing = missing_in(path)
    assert list(missing) == ["right"]
    assert missing["right"].startswith(f"{RIGHT}: the image encoding 'packed10' is not supported")
    assert "record it in one of mono8, 8UC1, " in missing["right"]
    described = inventory_of(path)
    assert (described["frames"]["pairs"], described["missing"]) == (0, missing)


@pytest.mark.parametrize("whole", [None, FRAMES // 2])
def test_a_camera_with_only_broken_images_is_missing(tmp_path, whole, monkeypatch):
    edit = changed(RIGHT, {"data": lambda data: data[:-5]}, {*range(FRAMES)} - {whole})
    monkeypatch.setattr("recordings.source.topics._MAX_SAMPLES", 1)
    problems = missing_in(write_sample(tmp_path / "log.mcap", edit))
    assert list(problems) == (["right"] if whole is None else [])
    assert all(why.startswith(f"{RIGHT}: the image is truncated: ") for why in problems.values())


DEEP = {"encoding": "mono16", "step": 2 * WIDTH, "data": lambda data: data[: 2 * WIDTH * HEIGHT]}
CROPPED = {"height": HEIGHT - 2, "data": lambda data: data[: 3 * WIDTH * (HEIGHT - 2)]}
UNLIKE = f"the images on {LEFT} are 24x16 of 8 bit, those on {RIGHT} are 24x16 of 16 bit; record both in one format"
UNCALIBRATED = f"the images on {LEFT} are 24x14, but the calibration on {INFO} is for 24x16 (after binning and region "
UNCALIBRATED += "of interest); set 'left_info' of the source to the matching CameraInfo, or 'calibration' to its file"


@pytest.mark.parametrize("odd", [range(FRAMES), range(1), range(FRAMES - 1, FRAMES), range(1, FRAMES - 1)])
@pytest.mark.parametrize(("topic", "values", "streams", "why"), [
    (RIGHT, DEEP, ("left", "right"), UNLIKE), (LEFT, CROPPED, ("left",), UNCALIBRATED),
])  # fmt: skip
def test_mismatched_images_are_reported_unless_some_match(tmp_path, topic, values, streams, why, odd):
    problems = missing_in(write_sample(tmp_path / "log.mcap", changed(topic, values, odd)))
    assert problems == dict.fromkeys(streams if len(odd) == FRAMES else (), why)


# Plain angles


def bare(tmp_path: Path, x: float, y: float) -> Path:
    vector = make("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0)
    angles = lambda message: make("geometry_msgs/msg/Vector3Stamped", header=message.header, vector=vector)  # noqa: E731
    return write_sample(tmp_path / "bare.mcap", replaced(TILT, angles))


PITCH, ROLL = AngleField("vector.x", "deg", 1), AngleField("vector.y", "deg", -1)


def test_plain_angles_are_read_by_the_settings(tmp_path):
    source = McapSource(pitch=PITCH, roll=ROLL, tilt_model="axis")
    tilt = next(item for _, stream, item in items_of(bare(tmp_path, 10, 20), source) if stream == "inclinometer")
    p, r = np.deg2rad([10, -20])
    np.testing.assert_allclose(tilt.up, [np.sin(p), np.sin(r), np.sqrt(1 - np.sin(p) ** 2 - np.sin(r) ** 2)])
    assert (tilt.frame_id, tilt.stamp) == ("imu_link", START)


@pytest.mark.parametrize(("settings_", "sentence"), [
    ({"pitch": PITCH}, "needs 'roll'"),
    ({"pitch": PITCH, "roll": ROLL}, "needs 'tilt_model'"),
    ({"pitch": PITCH, "roll": ROLL, "tilt_model": "best"}, "tilt_model must be one of axis, euler"),
    *(({"camera_from_inclinometer": odd}, "must be a unit quaternion") for odd in (
        (1.0, 1.0, 0.0, 0.0), 1, "abcd", [0, 0, 0, None], ["0", "0", "0", "1"], [[1, 0], [0, 1], [0, 0], [0, 0]],
    )),
])  # fmt: skip
def test_incomplete_angle_settings_are_refused(settings_, sentence):
    with pytest.raises(ValueError, match=sentence):
        McapSource(**settings_)


def test_a_stamp_of_zero_is_replaced_by_the_log_time(tmp_path):
    path = write_sample(tmp_path / "log.mcap", changed((LEFT, RIGHT), UNSTAMPED))
    assert stamps_in(items_of(path)) == [START + n * PERIOD + 1000 for n in range(FRAMES)]


@pytest.mark.parametrize("bounds", [{"start": float("nan")}, {"end": float("inf")}])
def test_a_range_that_is_not_finite_is_refused(sample, bounds):
    with pytest.raises(LogError, match="must be in seconds after the log's first message, not"):
        McapSource().open(sample, **bounds)


def test_channels_in_other_encodings_are_ignored(whole, tmp_path):
    def odd(writer, _):
        numbers = (
            writer.register_channel("/json", "json", writer.register_schema("x", "jsonschema", b"{}")),
            writer.register_channel("/none", "", 0),
            writer.register_channel("/broken", "cdr", writer.register_schema("a/msg/B", "ros2msg", b"((")),
        )
        for number in numbers:
            for time in range(START, START + FRAMES * PERIOD, PERIOD):
                writer.add_message(number, time, b"\xff\xfe", time)

    assert essences(items_of(with_extra(tmp_path / "mixed.mcap", odd))) == essences(whole)


def test_channels_whose_schema_has_no_format_and_no_text_have_the_standard_types(sample, whole, tmp_path):
    rows = [(topic, encoding, (name, "", b""), *rest) for topic, encoding, (name, *_), *rest in mcap_rows(sample)]
    assert essences(items_of(write_mcap(tmp_path / "log.mcap", rows))) == essences(whole)
