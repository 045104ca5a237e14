"""Reading logs: what was recorded comes out bit for bit, what is damaged is told, what is missing is said."""

from __future__ import annotations

import io
import json
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from scipy.spatial.transform import Rotation

from recordings import McapSource
from recordings.decode import pixels_of, up_of
from recordings.errors import LogError
from recordings.inventory import describe, format_description
from recordings.mcap_index import Lost
from recordings.mcap_reader import McapFile
from recordings.ros2 import header, image, make, transform_message
from stages.data import CameraImage, Mount, Pose, Tilt, Transform
from tests.recordings.sample_log import (
    BASELINE,
    FRAMES,
    HEIGHT,
    LEFT,
    PERIOD,
    RIGHT,
    START,
    TILT,
    TRANSFORMS,
    WIDTH,
    data_folder,
    model,
    picture,
    rewritten,
    tilt_quaternion,
    write_sample,
)  # fmt: skip

INFO = "/stereo/left/camera_info"
LAYOUTS: dict[str, dict[str, Any]] = {
    "small chunks": {"chunk_size": 500},
    "lz4": {"compression": CompressionType.LZ4},
    "no compression": {"compression": CompressionType.NONE, "chunk_size": 4000},
    "no message index": {"index_types": IndexType.CHUNK},
    "no index": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
    },
    "no chunks": {"use_chunking": False, "enable_data_crcs": True},
    "no crcs": {"enable_crcs": False},
}


def items_of(path: Path, source: McapSource | None = None, **bounds: float) -> list[tuple[int, str, Any]]:
    with (source or McapSource()).open(path, **bounds) as log:
        return list(log)


def missing(path: Path, source: McapSource | None = None) -> dict[str, str]:
    with (source or McapSource()).open(path) as log:
        return log.missing


def essence(item: Any) -> Any:
    """An item's whole content, comparable."""
    if isinstance(item, CameraImage):
        return (
            item.stamp,
            item.pixels.tobytes(),
            item.pixels.shape,
            item.model.p.tobytes(),
            item.frame_id,
            item.rectified,
        )
    if isinstance(item, Tilt):
        return item.stamp, item.up.tobytes(), item.frame_id
    if isinstance(item, Pose):
        return item.stamp, item.position.tobytes(), item.quaternion.tobytes(), item.frame_id, item.child_frame_id
    return item.stamp, item.camera_from_inclinometer.tobytes()


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("log") / "sample.mcap")


@pytest.fixture(scope="module")
def whole(sample: Path) -> list[tuple[int, str, Any]]:
    return items_of(sample)


def test_what_was_written_is_read_bit_for_bit(sample: Path) -> None:
    with McapSource().open(sample) as log:
        assert (log.missing, log.frames) == ({}, FRAMES)
        assert log.topics == {"left": LEFT, "right": RIGHT, "inclinometer": TILT, "odometry": "/odom"}
        events = list(log)
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


def test_the_mount_comes_first_and_follows_the_static_transforms(whole: list[tuple[int, str, Any]]) -> None:
    time, stream, mount = whole[0]
    assert (time, stream) == (START, "mount")
    assert isinstance(mount, Mount)
    camera, sensor = TRANSFORMS
    np.testing.assert_allclose(mount.camera_from_inclinometer, camera.rotation.T @ sensor.rotation, atol=1e-12)
    assert mount.base_from_camera is not None
    np.testing.assert_allclose(mount.base_from_camera([[0, 0, 2.0]]), [[2.5, 0.1, 0.9]], atol=1e-12)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_of_file_gives_the_same_items(
    sample: Path, whole: list[tuple[int, str, Any]], tmp_path: Path, layout: str
) -> None:
    other = rewritten(sample, tmp_path / "other.mcap", **LAYOUTS[layout])
    assert [(t, s, essence(i)) for t, s, i in items_of(other)] == [(t, s, essence(i)) for t, s, i in whole]
    assert describe(other, McapSource())["frames"]["pairs"] == FRAMES


def test_messages_come_in_log_time_order_whatever_their_order_in_the_file(sample: Path, tmp_path: Path) -> None:
    backwards = tmp_path / "backwards.mcap"
    with sample.open("rb") as source, backwards.open("wb") as target:
        writer = Writer(target, chunk_size=2000)
        writer.start()
        known: dict[int, int] = {}
        for schema, channel, message in reversed(list(make_reader(source).iter_messages())):
            if channel.id not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    times = [time for time, _, _ in items_of(backwards)]
    assert times == sorted(times)
    assert len(times) == 4 * FRAMES + 1


def test_a_range_holds_whole_frames_and_the_tilts_around_them(sample: Path) -> None:
    with McapSource().open(sample, start=0.1, end=0.3) as log:
        assert log.frames == 2
        events = list(log)
    stamps = {s: [i.stamp - START for _, stream, i in events if stream == s] for s in ("left", "right", "inclinometer")}
    assert stamps["left"] == stamps["right"] == [PERIOD, 2 * PERIOD]
    assert stamps["inclinometer"] == [number * PERIOD for number in range(FRAMES)]
    with pytest.raises(LogError, match=r"sample\.mcap is 0\.400 s long; start 9 s is behind its end"):
        McapSource().open(sample, start=9)
    with pytest.raises(LogError, match=r"start 0\.3 s is not before end 0\.2 s"):
        McapSource().open(sample, start=0.3, end=0.2)


def check_nothing_is_lost_silently(path: Path, whole: list[tuple[int, str, Any]]) -> None:
    """What comes of a damaged log is what was recorded; what does not come is told of."""
    told: set[str] = set()
    events: list[tuple[int, str, Any]] = []
    try:
        with McapSource().open(path) as log:
            told = set(log.missing)
            events = list(log)
    except LogError as error:
        events = [(0, "log", error)]
    known = {(time, stream, essence(item)) for time, stream, item in whole if stream != "mount"}
    good = [(time, stream, essence(item)) for time, stream, item in events
            if stream != "mount" and not isinstance(item, Exception)]  # fmt: skip
    assert set(good) <= known
    assert len(set(good)) == len(good)
    losses = [item for _, _, item in events if isinstance(item, Exception)]
    assert all(isinstance(item, LogError) for item in losses)
    absent = {stream for _, stream, _ in known - set(good)}
    assert losses or absent <= told


@pytest.mark.parametrize("layout", ["small chunks", "no chunks", "no compression", "lz4", "no index"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_log_cut_anywhere_loses_only_what_was_cut(
    sample: Path, whole: list[tuple[int, str, Any]], tmp_path: Path, layout: str, share: float
) -> None:
    full = tmp_path / "full.mcap"
    if not full.exists():
        rewritten(sample, full, **LAYOUTS[layout])
    content = full.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: int(share * len(content))])
    check_nothing_is_lost_silently(cut, whole)


def test_a_cut_chunk_still_gives_the_messages_before_the_cut(
    sample: Path, whole: list[tuple[int, str, Any]], tmp_path: Path
) -> None:
    full = rewritten(sample, tmp_path / "full.mcap", compression=CompressionType.NONE)  # one chunk
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(full.read_bytes()[: int(full.stat().st_size * 0.6)])
    events = items_of(cut)
    assert "the log is cut or damaged at byte" in str(events[-1][2])
    assert isinstance(events[-1][2], LogError)
    assert sum(stream == "left" for _, stream, _ in events[:-1]) == 3
    assert [essence(i) for _, _, i in events[:-1]] == [essence(i) for _, _, i in whole[: len(events) - 1]]


@pytest.mark.parametrize("layout", ["small chunks", "no index", "no compression"])
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_anywhere_is_never_taken_for_data(
    sample: Path, whole: list[tuple[int, str, Any]], tmp_path: Path, layout: str, share: float, bit: int
) -> None:
    full = tmp_path / "full.mcap"
    if not full.exists():
        rewritten(sample, full, **LAYOUTS[layout])
    content = bytearray(full.read_bytes())
    content[int(share * len(content))] ^= 1 << bit
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    check_nothing_is_lost_silently(damaged, whole)


def test_a_broken_chunk_costs_its_own_messages_each_with_its_time(
    sample: Path, whole: list[tuple[int, str, Any]], tmp_path: Path
) -> None:
    full = rewritten(sample, tmp_path / "full.mcap", chunk_size=500)
    with full.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
        topics = {number: c.topic for number, c in make_reader(file).get_summary().channels.items()}
    broken = next(c for c in chunks[3:] if [topics[n] for n in c.message_index_offsets] == [LEFT])
    content = bytearray(full.read_bytes())
    content[broken.chunk_start_offset + broken.chunk_length // 2] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    events = items_of(damaged)
    lost = [(time, stream) for time, stream, item in events if isinstance(item, Exception)]
    assert lost == [(broken.message_start_time, "left")]
    assert any(str(item).startswith(f"{LEFT}: the chunk at byte") for _, _, item in events)
    kept = [essence(item) for _, _, item in events if not isinstance(item, Exception)]
    assert kept == [essence(item) for time, stream, item in whole if (time, stream) not in lost]
    assert describe(damaged, McapSource())["damage"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"hello, I am a text file\n", "is not an MCAP log"),
        (b"#ROSBAG V2.0\n....", "is a ROS 1 bag; convert it"),
        (b"SQLite format 3\0....", "is a rosbag2 SQLite bag; convert it"),
        (b"\x89MCAP0\r\n", "holds no messages that can be read: the log is cut"),
    ],
)
def test_what_is_no_log_is_refused_with_what_it_is(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=rf"log\.mcap {said}"):
        McapSource().open(path)


def test_no_file_a_folder_and_no_messages_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"cannot read .*none\.mcap: No such file"):
        McapSource().open(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="is a folder; give the"):
        McapSource().open(tmp_path)
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.finish()
    (tmp_path / "no.mcap").write_bytes(stream.getvalue())
    with pytest.raises(LogError, match=r"no\.mcap holds no messages"):
        McapSource().open(tmp_path / "no.mcap")


def drop(*prefixes: str) -> Any:
    return lambda topic, number, message: None if topic.startswith(prefixes) else message


def change(topic: str, **values: Any) -> Any:
    def edit(name: str, number: int, message: Any) -> Any:
        if name == topic:
            for field, value in values.items():
                setattr(message, field, value)
        return message

    return edit


@pytest.mark.parametrize(
    ("edit", "stream", "said"),
    [
        (drop("/stereo/right"), "right", f"the log has one image topic only \\({LEFT}\\), stereo needs two"),
        (drop("/stereo"), "left", "the log has no camera image"),
        (drop(INFO), "left", f"no CameraInfo belongs to {LEFT} .*; set 'left_info' of the source"),
        (drop(TILT), "inclinometer", "the log has no tilt"),
        (drop(TILT), "mount", "without an inclinometer there is no mount"),
        (drop("/tf_static"), "mount", r"no static transform joins the camera \('left_optical'\) and the inclinometer"),
        (drop("/odom"), "odometry", "the log has no nav_msgs/Odometry"),
        (change(TILT, orientation_covariance=np.full(9, -1.0)), "inclinometer", "holds no orientation"),
        (change("/stereo/right/camera_info", p=np.hstack([model().k, np.zeros((3, 1))]).reshape(-1)), "left",
         "does not tell the baseline"),
        (change("/stereo/right/camera_info", p=np.hstack([model().k, [[5.0], [0], [0]]]).reshape(-1)), "left",
         f"the baseline is -0.25 m, so {LEFT} is the right camera"),
        (change(INFO, k=np.zeros(9), p=np.zeros(12)), "left", "is not calibrated"),
    ],
)  # fmt: skip
def test_what_is_missing_is_said_with_the_remedy(tmp_path: Path, edit: Any, stream: str, said: str) -> None:
    told = missing(write_sample(tmp_path / "log.mcap", edit))
    assert stream in told
    assert re.search(said, told[stream]), told[stream]


@pytest.mark.parametrize(
    "names",
    [
        ("/cam0/image_raw", "/cam1/image_raw"),
        ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
        ("/rover0/stereo/l/image", "/rover0/stereo/r/image"),
        ("/stereoLeft/image", "/stereoRight/image"),
    ],
)
def test_pairs_are_found_by_the_names_cameras_go_by(tmp_path: Path, names: tuple[str, str]) -> None:
    with McapSource().open(write_sample(tmp_path / "log.mcap", names=names)) as log:
        assert (log.topics["left"], log.topics["right"]) == names
        assert {item.stamp for _, stream, item in log if stream == "left"} == {
            START + n * PERIOD for n in range(FRAMES)
        }


def test_two_equal_pairs_are_not_chosen_between_but_named(sample: Path, tmp_path: Path) -> None:
    both = tmp_path / "both.mcap"
    front = write_sample(tmp_path / "front.mcap", names=("/front/left/image_rect", "/front/right/image_rect"))
    with both.open("wb") as target:
        writer = Writer(target)
        writer.start()
        for path in (sample, front):
            with path.open("rb") as source:
                for schema, channel, message in make_reader(source).iter_messages():
                    if path == sample or channel.topic.startswith("/front"):
                        number = writer.register_schema(schema.name, schema.encoding, schema.data)
                        known = writer.register_channel(channel.topic, "cdr", number)
                        writer.add_message(known, message.log_time, message.data, message.publish_time)
        writer.finish()
    told = missing(both)["left"]
    assert "/front/left/image_rect with /front/right/image_rect" in told
    assert "set 'left' and 'right' of the source" in told
    with McapSource(left="/front/left/image_rect").open(both) as log:
        assert log.topics["right"] == "/front/right/image_rect"
        assert "left" not in log.missing
    assert "which is not such a topic of the log" in missing(both, McapSource(left="/nope"))["left"]


def test_baseline_and_rectification_of_two_single_calibrations_come_from_their_transform(tmp_path: Path) -> None:
    turned = Rotation.from_euler("y", 2, degrees=True).as_matrix()
    beside = Transform("left_optical", "right_optical", turned, [0.3, 0, 0.01])

    def edit(topic: str, number: int, message: Any) -> Any:
        if topic == "/tf_static":
            return transform_message([(t, START) for t in (*TRANSFORMS, beside)])
        if topic.endswith("camera_info"):
            message.p, message.d = np.zeros(12), np.array([-0.1, 0, 0, 0, 0])
        return message

    path = write_sample(tmp_path / "log.mcap", edit, names=("/left/image_raw", "/right/image_raw"))
    with McapSource().open(path) as log:
        events = list(log)
    left, right = (next(i for _, s, i in events if s == side) for side in ("left", "right"))
    camera = left.pair_with(right).camera
    assert camera.baseline == pytest.approx(np.hypot(0.3, 0.01))
    assert camera.raw is not None
    # A point far to the front: its rays, each turned by its camera's R and projected by its P, meet in one row.
    point = np.array([0.4, -0.3, 5.0])
    seen_left = camera.raw[0].p @ [*(camera.raw[0].r @ point), 1]
    in_right = beside.inverse()(point)
    seen_right = camera.raw[1].p[:, :3] @ camera.raw[1].r @ in_right
    assert seen_left[1] / seen_left[2] == pytest.approx(seen_right[1] / seen_right[2], abs=1e-9)
    disparity = seen_left[0] / seen_left[2] - seen_right[0] / seen_right[2]
    depth = camera.fx * camera.baseline / (disparity + camera.cx_right - camera.cx)
    assert depth == pytest.approx((camera.raw[0].r @ point)[2], rel=1e-9)


def test_a_changed_calibration_is_told_once(tmp_path: Path) -> None:
    def edit(topic: str, number: int, message: Any) -> Any:
        if topic == INFO and number >= 2:
            message.k = message.k * 1.5
        return message

    told = [
        (t, s, str(i)) for t, s, i in items_of(write_sample(tmp_path / "log.mcap", edit)) if isinstance(i, Exception)
    ]
    assert [(t, s) for t, s, _ in told] == [(START + 2 * PERIOD, "left")]
    assert "the calibration changes here" in told[0][2]


def test_one_bad_message_is_lost_alone(tmp_path: Path) -> None:
    def edit(topic: str, number: int, message: Any) -> Any:
        if topic == LEFT and number == 1:
            message.data = message.data[:-5]
        if topic == RIGHT and number == 2:
            message.encoding = "yuv422"
        if topic == TILT and number == 3:
            message.orientation.x = 5.0
        return message

    events = items_of(write_sample(tmp_path / "log.mcap", edit))
    told = {stream: str(item) for _, stream, item in events if isinstance(item, Exception)}
    assert f"the image is cut: {WIDTH * HEIGHT * 3 - 5} of {WIDTH * HEIGHT * 3} bytes" in told["left"]
    assert "image encoding 'yuv422' is not one of those that can be read" in told["right"]
    assert "the quaternion of the inclinometer is not a rotation" in told["inclinometer"]
    assert len(events) == 4 * FRAMES + 1


# Bare angles


def bare(tmp_path: Path, x: float, y: float) -> Path:
    def edit(topic: str, number: int, message: Any) -> Any:
        vector = make("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0)
        stamped = message.header if topic == TILT else None
        return make("geometry_msgs/msg/Vector3Stamped", header=stamped, vector=vector) if topic == TILT else message

    return write_sample(tmp_path / "bare.mcap", edit)


PITCH = {"field": "vector.x", "unit": "deg", "sign": 1}
ROLL = {"field": "vector.y", "unit": "deg", "sign": -1}


def test_bare_angles_are_not_guessed(tmp_path: Path) -> None:
    told = missing(bare(tmp_path, 10, 20))["inclinometer"]
    assert "set 'pitch', 'roll' (each field, unit, sign) and 'tilt_model' of the source" in told


def test_bare_angles_are_read_as_the_settings_say(tmp_path: Path) -> None:
    source = McapSource(pitch=PITCH, roll=ROLL, tilt_model="axis")
    tilt = next(item for _, stream, item in items_of(bare(tmp_path, 10, 20), source) if stream == "inclinometer")
    p, r = np.deg2rad([10, -20])
    np.testing.assert_allclose(tilt.up, [np.sin(p), np.sin(r), np.sqrt(1 - np.sin(p) ** 2 - np.sin(r) ** 2)])
    assert (tilt.frame_id, tilt.stamp) == ("imu_link", START)


@pytest.mark.parametrize(
    ("settings_", "said"),
    [
        ({"pitch": PITCH}, "needs 'roll' as well"),
        ({"pitch": PITCH, "roll": ROLL}, "needs 'tilt_model' as well"),
        ({"pitch": PITCH, "roll": {"field": "vector.y", "sign": 1}, "tilt_model": "axis"}, "roll lacks 'unit'"),
        ({"pitch": PITCH, "roll": {**ROLL, "unit": "grad"}, "tilt_model": "axis"}, "roll.unit must be deg or rad"),
        ({"pitch": PITCH, "roll": ROLL, "tilt_model": "best"}, "tilt_model must be axis or euler"),
        ({"camera_from_inclinometer": (1.0, 1.0, 0.0, 0.0)}, "must be a unit quaternion"),
    ],
)
def test_half_told_angles_are_refused(settings_: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        McapSource(**settings_)


@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(-180, 180))
def test_up_agrees_with_a_rover_that_is_turned(pitch: float, roll: float, yaw: float) -> None:
    # Euler: nose up is a negative turn about y (left), left side up a positive one about x (forward).
    attitude = Rotation.from_euler("ZYX", [yaw, -pitch, roll], degrees=True)
    up = attitude.inv().apply([0, 0, 1])
    np.testing.assert_allclose(up_of(np.deg2rad(pitch), np.deg2rad(roll), "euler"), up, atol=1e-12)
    # Axis: the angles that the x and y axes themselves make with the horizon.
    forward, left = (float(np.arcsin(attitude.apply(axis)[2])) for axis in np.eye(3)[:2])
    np.testing.assert_allclose(up_of(forward, left, "axis"), up, atol=1e-7)
    if pitch > 1:
        assert attitude.apply([1, 0, 0])[2] > 0  # the nose is up
    if roll > 1:
        assert attitude.apply([0, 1, 0])[2] > 0  # the left side is up


def test_angles_that_no_attitude_has_are_refused() -> None:
    with pytest.raises(LogError, match="check unit and tilt_model"):
        up_of(1.2, 1.2, "axis")


# Images


def raw_image(encoding: str, rows: np.ndarray, width: int, big: bool = False) -> Any:
    message = image(1, "cam", np.zeros((1, 1), np.uint8))
    message.encoding, message.height, message.width, message.step = encoding, rows.shape[0], width, rows.shape[1]
    message.data, message.is_bigendian = rows.reshape(-1).copy(), int(big)
    return message


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "order"),
    [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("8UC3", [2, 1, 0]), ("rgba8", [0, 1, 2, 0]), ("bgra8", [2, 1, 0, 0])],
)
def test_colour_comes_as_rgb_from_every_order(encoding: str, order: list[int], padding: int) -> None:
    rgb = picture(7)
    rows = np.pad(rgb[:, :, order].reshape(HEIGHT, -1), ((0, 0), (0, padding)), constant_values=99)
    np.testing.assert_array_equal(pixels_of(raw_image(encoding, rows, WIDTH)), rgb)


@pytest.mark.parametrize("big", [False, True])
def test_gray_of_16_bit_is_read_in_its_byte_order(big: bool) -> None:
    gray = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 257 + 3
    rows = gray.astype(">u2" if big else "<u2").view(np.uint8)
    out = pixels_of(raw_image("mono16", rows, WIDTH, big))
    np.testing.assert_array_equal(out, gray)
    assert out.dtype == np.uint16
    np.testing.assert_array_equal(pixels_of(raw_image("mono8", picture(1)[:, :, 0], WIDTH)), picture(1)[:, :, 0])


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_mosaic_of_one_colour_is_that_colour(pattern: str) -> None:
    colour = {"r": 200, "g": 90, "b": 30}
    tile = np.array([colour[letter] for letter in pattern], np.uint8).reshape(2, 2)
    out = pixels_of(raw_image(f"bayer_{pattern}8", np.tile(tile, (8, 12)), 24))
    np.testing.assert_array_equal(out, np.broadcast_to([200, 90, 30], (16, 24, 3)))


def compressed(data: bytes, kind: str) -> Any:
    content = np.frombuffer(data, np.uint8)
    return make("sensor_msgs/msg/CompressedImage", header=header(1, "cam"), format=kind, data=content)


def test_compressed_images_are_decoded_to_rgb_and_cut_ones_refused() -> None:
    rgb = picture(3)
    png = cv2.imencode(".png", rgb[:, :, ::-1])[1].tobytes()
    np.testing.assert_array_equal(pixels_of(compressed(png, "rgb8; png compressed bgr8")), rgb)
    flat = np.full((16, 24, 3), (200, 90, 30), np.uint8)
    jpeg = cv2.imencode(".jpg", flat[:, :, ::-1])[1].tobytes()
    np.testing.assert_allclose(pixels_of(compressed(jpeg, "jpeg")).astype(int), flat, atol=3)
    for data, kind in ((png, "png"), (jpeg, "jpeg")):
        with pytest.raises(LogError, match="the compressed image is cut"):
            pixels_of(compressed(data[:-20], kind))
    with pytest.raises(LogError, match="cannot be decoded"):
        pixels_of(compressed(b"nonsense", "jpeg"))


def test_a_stamp_of_zero_is_the_time_of_logging(tmp_path: Path) -> None:
    def edit(topic: str, number: int, message: Any) -> Any:
        if topic in (LEFT, RIGHT):
            message.header = header(0, message.header.frame_id)
        return message

    events = items_of(write_sample(tmp_path / "log.mcap", edit))
    assert [i.stamp for _, s, i in events if s == "left"] == [START + n * PERIOD + 1000 for n in range(FRAMES)]


def test_channels_in_other_encodings_do_no_harm(sample: Path, whole: list[Any], tmp_path: Path) -> None:
    out = tmp_path / "mixed.mcap"
    with sample.open("rb") as source, out.open("wb") as target:
        writer = Writer(target)
        writer.start()
        odd = [
            writer.register_channel("/json", "json", writer.register_schema("x", "jsonschema", b"{}")),
            writer.register_channel("/none", "", 0),
            writer.register_channel("/broken", "cdr", writer.register_schema("a/msg/B", "ros2msg", b"((")),
        ]
        known: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
            for number in odd:
                writer.add_message(number, message.log_time, b"\xff\xfe", message.log_time)
        writer.finish()
    assert [essence(i) for _, _, i in items_of(out)] == [essence(i) for _, _, i in whole]


# Logs that nobody here made


def test_every_file_of_the_conformance_suite_gives_all_its_messages() -> None:
    folder, checked = data_folder("logs/conformance"), 0
    for path in sorted(folder.rglob("*.mcap")):
        records = json.loads(path.with_suffix(".json").read_text())["records"]
        wanted = sum(record["type"] == "Message" for record in records)
        read: list[Any] = []
        with suppress(LogError), McapFile(path) as log:
            read = list(log.messages(set(log.index.channels)))
        assert not [item for item in read if isinstance(item, Lost)], path
        assert len(read) == wanted, path
        checked += 1
    assert checked == 205


def test_every_real_log_is_described_or_refused_in_a_sentence() -> None:
    refused = []
    paths = [path for path in sorted(data_folder("logs").rglob("*")) if path.suffix in (".mcap", ".bag")]
    for path in paths:
        try:
            text = format_description(json.loads(json.dumps(describe(path, McapSource()))))
        except LogError as error:
            refused.append(str(error))
            continue
        assert "missing: left" in text
        assert not [item for _, _, item in items_of(path) if isinstance(item, Exception)], path
    assert (len(paths), len(refused)) == (232, 22)
    assert all("holds no messages" in text or "is a ROS 1 bag" in text or "is empty" in text for text in refused)


def test_the_field_log_has_its_tilt_at_ten_hertz() -> None:
    path = data_folder("logs/field") / "SO_bag_0.mcap"
    tilts = [item for _, stream, item in items_of(path) if stream == "inclinometer"]
    assert len(tilts) == 161
    assert all(abs(np.linalg.norm(tilt.up) - 1) < 1e-9 for tilt in tilts)
