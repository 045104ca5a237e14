"""Our data as ROS 2 messages: other decoders read the same values."""

import struct
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from recordings.containers.container import Channel, MessageSchema
from recordings.containers.header import begins_with_header
from recordings.errors import LogError
from recordings.mcap.file import iter_decoded
from recordings.mcap.writer import Ros2Writer
from recordings.ros2 import to_msg
from recordings.ros2.cdr import decoder_for, standard_types
from recordings.ros2.from_msg import read_disparity, read_grid_map, read_occupancy_grid, read_point_cloud, stamp_of
from stages.data import (
    Disparity,
    ElevationMap,
    NavigationMap,
    PixelOrigin,
    PointCloud,
    Pose,
    StereoCamera,
    Transform,
)  # fmt: skip
from tests.conftest import data_folder
from tests.recordings.sample_log import model

STAMP = 1_700_000_000_123_456_789


def terrain(rows: int = 2, cols: int = 3) -> ElevationMap:
    elevation = np.arange(rows * cols, dtype=np.float32).reshape(rows, cols)
    elevation[0, -1] = np.nan
    return ElevationMap(STAMP, {"elevation": elevation, "count": elevation + 10}, 0.5, (-1.0, 4.0), "level")


def cloud() -> PointCloud:
    points = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    colors = np.array([[255, 2, 3], [4, 128, 6]], np.uint8)
    return PointCloud(STAMP, points, colors, np.array([0.1, 0.2], np.float32), np.array([0, 5], np.int32), "level")


def disparity(cx_right: float = 10.0) -> Disparity:
    pixels = np.array([[1.5, np.nan, 3.25], [4, 5, 6]], np.float32)
    camera = StereoCamera(100.0, 100.0, 10.0, 5.0, 0.25, 3, 2, cx_right=cx_right, frame_id="left_optical")
    return Disparity(STAMP, pixels, np.ones((2, 3), np.uint8), np.ones((2, 3), np.float32), camera=camera)


def navigation() -> NavigationMap:
    cells = np.array([[0, 100, -1], [0, 0, 100]], np.int8)
    return NavigationMap(STAMP, cells, np.zeros((2, 3), np.uint8), 0.05, (-1.0, 4.0), "level")


def one_of_each() -> dict[str, Any]:
    transform = Transform("level", "camera", np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), [1, 2, 3])
    return {
        "/image": to_msg.image(STAMP, "cam", np.arange(24, dtype=np.uint8).reshape(2, 4, 3)),
        "/info": to_msg.camera_info(STAMP, "cam", model("right")),
        "/disparity": to_msg.disparity_image(disparity()),
        "/points": to_msg.point_cloud(cloud()),
        "/grid": to_msg.grid_map(terrain()),
        "/map": to_msg.occupancy_grid(navigation()),
        "/tf": to_msg.transform_message([(transform, STAMP)]),
        "/imu": to_msg.imu(STAMP, "imu", np.array([0.1, 0.2, 0.3, 0.927]), np.eye(3) * 0.5),
        "/odom": to_msg.odometry(Pose(STAMP, [1, 2, 3], [0, 0, 0.6, 0.8], "odom", "base", np.eye(6))),
        "/diagnostics": to_msg.diagnostics(STAMP, [(2, "match", "no texture", {"reason": "failed"})]),
    }


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "each.mcap"
    with Ros2Writer(path) as writer:
        for topic, message in one_of_each().items():
            writer.write(topic, message, STAMP)
    return path


def plain(value: Any) -> Any:
    """A message of any library as plain, comparable values."""
    if isinstance(value, bytes | bytearray | memoryview):
        return list(value)
    if isinstance(value, np.ndarray):
        return [plain(item) for item in value.tolist()]
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return repr(value)
    named = [f.name for f in fields(value)] if is_dataclass(value) else getattr(value, "__slots__", ())
    names = [name for name in named if name.islower() and not name.startswith("_")]  # no constants
    return {name: plain(getattr(value, name)) for name in names} or value


def through_rosbags(message: Any) -> Any:
    """A message as rosbags' own store decodes it (it knows all of ours but grid_map_msgs)."""
    store, name = get_typestore(Stores.ROS2_JAZZY), message.__msgtype__
    return (store if name in store.types else standard_types()).deserialize_cdr(
        standard_types().serialize_cdr(message, name), name
    )


def test_another_decoder_reads_the_same_numbers(written):
    sent = one_of_each()
    with written.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        read = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
    assert read.keys() == sent.keys()
    for topic, message in sent.items():
        if topic != "/diagnostics":  # level is a `byte`, which that decoder returns as bytes
            assert plain(read[topic]) == plain(through_rosbags(message)), topic
    assert read["/diagnostics"].status[0].message == "no texture"


def test_a_grid_map_starts_at_the_corner_of_largest_x_and_y():
    ours = terrain()
    message = to_msg.grid_map(ours)
    assert (message.info.length_x, message.info.length_y) == (1.5, 1.0)
    assert (message.info.pose.position.x, message.info.pose.position.y) == (-0.25, 4.5)
    layer = message.data[message.layers.index("count")]
    assert [(d.label, d.size, d.stride) for d in layer.layout.dim] == [("column_index", 2, 6), ("row_index", 3, 3)]
    matrix = layer.data.reshape((3, 2), order="F")  # as Eigen reads it: rows along -x, columns along -y
    for i in range(3):
        for j in range(2):
            x = -0.25 + 1.5 / 2 - (i + 0.5) * 0.5  # grid_map_core getPositionFromIndex
            y = 4.5 + 1.0 / 2 - (j + 0.5) * 0.5
            col, row = int((x - ours.origin[0]) / 0.5), int((y - ours.origin[1]) / 0.5)
            np.testing.assert_equal(matrix[i, j], ours.layers["count"][row, col])


@given(st.integers(0, 7), st.integers(0, 7), st.floats(0.01, 2.0), st.floats(-50, 50))
@example(0, 3, 0.5, 0.0)
def test_a_grid_map_is_read_back_unchanged(rows, cols, cell, x):
    layer = np.random.default_rng(rows * 10 + cols).normal(size=(rows, cols)).astype(np.float32)
    ours = ElevationMap(STAMP, {"elevation": layer}, cell, (x, -x / 3), "odom")
    back = read_grid_map(to_msg.grid_map(ours))
    np.testing.assert_array_equal(back.layers["elevation"], layer)
    np.testing.assert_allclose(back.origin, ours.origin, atol=1e-9)
    assert (back.resolution, back.frame_id, back.stamp) == (cell, "odom", STAMP)


def test_unknown_cells_of_a_grid_map_have_one_form():
    layer = np.float32([[np.nan, -np.nan, 1], [0, -np.inf, -np.nan]])
    message = to_msg.grid_map(ElevationMap(STAMP, {"elevation": layer}, 0.5, (0.0, 0.0), "odom"))
    found = message.data[0].data
    np.testing.assert_array_equal(found, layer.ravel()[::-1])
    assert {*found.view(np.uint32)[np.isnan(found)].tolist()} == {0x7FC00000}


def test_an_occupancy_grid_starts_at_the_lower_left():
    message = to_msg.occupancy_grid(navigation())
    assert (message.info.width, message.info.height) == (3, 2)
    assert (message.info.origin.position.x, message.info.origin.position.y) == (-1.0, 4.0)
    assert message.data.tolist() == [0, 100, -1, 0, 0, 100]
    back = read_occupancy_grid(message)
    np.testing.assert_array_equal(back.cells, navigation().cells)
    assert (back.resolution, back.origin, back.frame_id) == (0.05, (-1.0, 4.0), "level")


def test_disparity_obeys_depth_equals_f_times_t_over_d():
    message = to_msg.disparity_image(disparity(cx_right=12.0))
    d = read_disparity(message)
    np.testing.assert_array_equal(d, disparity().pixels + 2)
    assert np.isnan(d[0, 1])
    assert (message.f, message.t, message.min_disparity, message.max_disparity) == (100.0, 0.25, 3.5, 8.0)
    np.testing.assert_array_equal(read_disparity(to_msg.disparity_image(disparity())), disparity().pixels)


def test_a_cloud_packs_colours_as_in_pcl():
    message = to_msg.point_cloud(cloud())
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("rgb", 12, 7), ("sigma", 16, 7),
    ]  # fmt: skip
    rows = message.data.reshape(2, 20)
    assert rows[0, 12:16].tolist() == [3, 2, 255, 0]  # little-endian 0x00RRGGBB
    np.testing.assert_array_equal(rows[:, :12].copy().view("<f4"), cloud().points)
    np.testing.assert_array_equal(rows[:, 16:].copy().view("<f4")[:, 0], cloud().sigma)


def test_a_transform_message_turns_points_like_its_transform():
    transform = Transform("level", "camera", np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]]), [1, 2, 3])
    sent = to_msg.transform_message([(transform, STAMP)]).transforms[0]
    assert (sent.header.frame_id, sent.child_frame_id, stamp_of(sent.header)) == ("level", "camera", STAMP)
    q, v = sent.transform.rotation, np.array([1.0, -2.0, 0.5])
    u = np.array([q.x, q.y, q.z])
    turned = v + 2 * np.cross(u, np.cross(u, v) + q.w * v)  # q v q*
    t = sent.transform.translation
    np.testing.assert_allclose(turned + np.array([t.x, t.y, t.z]), transform(v), atol=1e-12)


def test_codecs_are_built_safely_by_many_threads():
    text = "".join(f"float64 field{number}\n" for number in range(20)).encode()

    def decoded(number):
        decoder = decoder_for(f"vendor_msgs/msg/Kind{number % 4}", "ros2msg", text)
        return float(decoder(b"\0\1\0\0" + np.arange(20.0).tobytes()).field19)

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(decoded, range(64))) == {19.0}


# As rosidl writes it.
IDL = rb"""// with input from vendor_msgs/msg/Sample.msg
#include "std_msgs/msg/Header.idl"

module vendor_msgs {
  module msg {
    typedef double double__9[9];
    module Sample_Constants {
      const octet KIND = 3;
    };
    @verbatim (language="comment", text=
      "a Sample; # of" "\n"
      "things")
    struct Sample {
      @verbatim (language="comment", text=
        "the time (of" "\n"
        "its start)")
      @unit (value="1")
      std_msgs::msg::Header header;

      boolean valid;
      double__9 covariance;
      sequence<vendor_msgs::msg::Place> places;
    };
  };
};
================================================================================
IDL: vendor_msgs/msg/Place
module vendor_msgs { module msg { struct Place { float x; float y; }; }; };
================================================================================
IDL: std_msgs/msg/Header
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
================================================================================
IDL: builtin_interfaces/msg/Time
module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };
"""


def test_idl_schemas_of_rosidl_are_read():
    kind, data = "vendor_msgs/msg/Sample", struct.pack("<iII4s?7x9dI4f", 5, 6, 4, b"cam", True, *range(9), 2, *range(4))
    schema = MessageSchema(kind, "ros2idl", b"=" * 80 + b"\nIDL: vendor_msgs/msg/Sample\n" + IDL)
    sample = decoder_for(kind, schema.encoding, schema.text)(b"\0\1\0\0" + data)
    assert (sample.header.stamp.sec, sample.header.stamp.nanosec, sample.header.frame_id) == (5, 6, "cam")
    assert (sample.KIND, sample.valid, sample.covariance.tolist()) == (3, True, [*range(9)])
    assert [(place.x, place.y) for place in sample.places] == [(0, 1), (2, 3)]
    assert begins_with_header(Channel(1, "/sample", "cdr", schema))


def test_blank_lines_and_comments_before_a_header_are_skipped():
    for text, is_first in ((b"Header header\n", True), (b"float64 x\nHeader header\n", False)):
        schema = MessageSchema("a/A", "ros2msg", b"# Header header\n" + 1000 * b" \n" + text)
        assert begins_with_header(Channel(1, "/a", "cdr", schema)) == is_first


RECURSIVE = {
    "itself": b"Odd[] kids\nfloat64 x\n",
    "by another": b"Other c\n" + b"=" * 80 + b"\nMSG: vendor_msgs/Other\nOdd[] b\n",
}


@pytest.mark.parametrize("text", RECURSIVE.values(), ids=RECURSIVE)
def test_a_schema_that_contains_itself_is_refused(text):
    with pytest.raises(LogError, match="vendor_msgs/msg/Odd contains itself"):
        decoder_for("vendor_msgs/msg/Odd", "ros2msg", text)


def test_a_schema_with_byte_order_mark_or_crlf_is_read():
    plain = "std_msgs/Header header\nfloat32 pitch # 0 to 90 °\n"
    for text in (plain.encode("latin-1"), plain.replace("\n", "\r\n").encode(), plain.encode("utf-8-sig")):
        decode = decoder_for("vendor_msgs/msg/Tilt", "ros2msg", text)
        assert decode(b"\0\1\0\0" + struct.pack("<iII4xf", 5, 6, 1, 0.25)).pitch == 0.25


def test_an_empty_schema_means_a_type_without_fields():
    decoder = decoder_for("test_msgs/msg/Empty", "ros2msg", b"")
    assert type(decoder(b"\0\1\0\0\0")).__name__.endswith("Empty")
    with pytest.raises(Exception, match="size mismatch"):
        decoder(b"\0\1\0\0" + bytes(12))  # the unknown fields


def test_a_type_without_a_definition_that_is_no_standard_type_is_named():
    with pytest.raises(LogError, match="schema 'vendor_msgs/msg/Arm' has no definition, and is no standard type"):
        decoder_for("vendor_msgs/msg/Arm", "", b"")


@settings(max_examples=30)
@given(st.binary(max_size=80))
def test_an_invalid_schema_is_a_log_error(text):
    with suppress(LogError):  # any other exception fails the test
        decoder_for("vendor_msgs/msg/Odd", "ros2msg", text)


def test_messages_of_real_recorders_are_decoded():
    folder = data_folder("logs/rosbag2")
    talker = folder / "rosbag2_py__test__resources__mcap__talker__talker.mcap"
    assert sum(1 for _ in iter_decoded(talker)) == 20
    cdr = folder / "rosbag2_tests__resources__mcap__cdr_test__cdr_test_0.mcap"
    assert sum(1 for _ in iter_decoded(cdr)) == 7


def test_a_point_cloud_is_read_back_unchanged():
    rng = np.random.default_rng(3)
    points, colors = rng.normal(size=(7, 3)).astype(np.float32), rng.integers(0, 256, (7, 3), dtype=np.uint8)
    points[2] = np.nan
    sigma = rng.uniform(0.01, 0.2, 7).astype(np.float32)
    source = rng.choice([PixelOrigin.MEASURED, PixelOrigin.FILLED, PixelOrigin.PLANE], 7).astype(np.uint8)
    sent = PointCloud(5, points, colors, sigma, np.arange(7, dtype=np.int32), "level", source=source)
    message = to_msg.point_cloud(sent)
    read = read_point_cloud(message)
    np.testing.assert_array_equal(np.column_stack([read[name] for name in "xyz"]), points)
    for name, values in (("colors", colors), ("sigma", sigma), ("source", source)):
        np.testing.assert_array_equal(read[name], values)
    assert "source" not in read_point_cloud(to_msg.point_cloud(replace(sent, source=None)))
    with pytest.raises(ValueError, match="fields of one float32 each"):
        read_point_cloud(replace(message, fields=[replace(message.fields[0], datatype=8), *message.fields[1:]]))


def test_the_error_of_an_unparsable_schema_is_short():
    text = b"MSG: what is this\n" + b"int64 number\n" * 200
    with pytest.raises(LogError, match="schema 'vendor_msgs/msg/Long' cannot be parsed") as caught:
        decoder_for("vendor_msgs/msg/Long", "ros2msg", text)
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)
