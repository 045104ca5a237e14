"""One log in every encoding that is read, and foreign content in each."""

import json
import re
import struct
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer as ProtobufWriter

from recordings import McapSource
from recordings.containers.container import Channel, MessageSchema
from recordings.encodings import decoding
from recordings.encodings.decoding import MAX_MESSAGE_BYTES, decoder_of, json_decoder
from recordings.errors import LogError
from recordings.mcap import chunk
from recordings.ros2.cdr import make
from recordings.ros2.image_from_msg import pixels_of
from recordings.ros2.tilt_from_msg import AngleField
from recordings.ros2.to_msg import camera_info, image
from recordings.source.topics import MAX_CHANNELS
from stages.data import Tilt
from tests.conftest import write_mcap
from tests.recordings.encodings.rewritten import ROS1, WRITERS, as_ros1, json_log
from tests.recordings.sample_log import FRAMES, essences, items_of, model, stamps_in

NOTHING = f"c/E[{{}}] x\n{'=' * 80}\nMSG: c/E\n"


@pytest.mark.parametrize("name", WRITERS)
def test_the_same_items_are_read_from_every_encoding(sample, whole, tmp_path, name):
    log = WRITERS[name](sample, tmp_path / name)
    assert essences(items_of(log)) == essences(whole)


def test_a_part_of_a_log_begins_at_the_same_frame_in_every_encoding(sample, tmp_path):
    expected = stamps_in(items_of(sample, start=0.15))
    assert len(expected) == 3
    for name, write in WRITERS.items():
        assert stamps_in(items_of(write(sample, tmp_path / name), start=0.15)) == expected, name


def test_an_image_in_json_is_decoded_once_also_in_a_part_of_a_log(sample, tmp_path, monkeypatch):
    decoded = Counter()

    def counting(data):
        decoded[bytes(data)] += 1
        return json_decoder(data)

    monkeypatch.setattr(decoding, "json_decoder", counting)
    with McapSource().open(json_log(sample, tmp_path / "log.mcap"), end=9.0) as log:
        list(log.events(["left", "right"]))  # also looks at the last ones, to compare clocks
        decoded.clear()
        list(log.events(["left", "right"]))
    assert [number for data, number in decoded.items() if b'"step"' in data] == [1] * 2 * FRAMES


def json_angles(path: Path, angles: list[dict[str, Any]], schema: bool) -> Path:
    """A log of JSON messages with bare angles."""
    form = ("Tilt", "jsonschema", b"{}") if schema else None
    rows = [("/tilt", "json", form, 10**9 + count, json.dumps(angle).encode()) for count, angle in enumerate(angles)]
    return write_mcap(path, rows, profile="")


def protobuf_angles(path: Path, seconds: int, nanoseconds: int, pitch: float) -> Path:
    """A log of one message of a type of one's own in protobuf."""
    file = FileDescriptorProto(name="rover.proto", package="rover", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    tilt, body = file.message_type.add(name="Tilt"), file.message_type.add(name="Body")
    number = {"label": 1, "type": FieldDescriptorProto.TYPE_DOUBLE}
    body.field.add(name="pitch", number=1, **number)
    body.field.add(name="roll", number=2, **number)
    part = {"label": 1, "type": FieldDescriptorProto.TYPE_MESSAGE}
    tilt.field.add(name="timestamp", number=1, type_name=".google.protobuf.Timestamp", **part)
    tilt.field.add(name="body", number=2, type_name=".rover.Body", **part)
    pool = DescriptorPool()
    pool.AddSerializedFile(Timestamp.DESCRIPTOR.file.serialized_pb)
    pool.Add(file)
    made = GetMessageClass(pool.FindMessageTypeByName("rover.Tilt"))()
    made.timestamp.seconds, made.timestamp.nanos, made.body.pitch = seconds, nanoseconds, pitch
    with path.open("wb") as out, ProtobufWriter(out) as writer:
        writer.write_message("/tilt", made, 10**9, 10**9)
    return path


def tilts_of(log: Path) -> list[Any]:
    """The tilts of a log with the fields body.pitch and body.roll."""
    pitch, roll = (AngleField(field=f"body.{angle}", unit="deg", sign=1) for angle in ("pitch", "roll"))
    source = McapSource(inclinometer="/tilt", tilt_model="axis", pitch=pitch, roll=roll)
    return [item for _, _, item in items_of(log, source)]


def test_bare_angles_in_a_protobuf_message_of_ones_own_are_a_tilt(tmp_path):
    (tilt,) = tilts_of(protobuf_angles(tmp_path / "log.mcap", 5, 7, 2.0))
    assert tilt.stamp == 5_000_000_007
    assert np.degrees(np.arcsin(tilt.up[0])) == pytest.approx(2.0)


@pytest.mark.parametrize("schema", [True, False])
def test_bare_angles_in_json_are_a_tilt_at_their_own_time(tmp_path, schema):
    angles = [{"timestamp": {"sec": 5, "nsec": 7}, "body": {"pitch": 2.0, "roll": 0.0}}]
    (tilt,) = tilts_of(json_angles(tmp_path / "log.mcap", angles, schema))
    assert isinstance(tilt, Tilt)
    assert tilt.stamp == 5_000_000_007
    assert np.degrees(np.arcsin(tilt.up[0])) == pytest.approx(2.0)


def test_an_absent_field_of_json_is_refused_with_those_that_are_there():
    with pytest.raises(LogError, match=r"no 'nod' in its JSON object \(it has pitch, roll\)"):
        AngleField("nod", "deg", 1)(SimpleNamespace(pitch=1.0, roll=2.0))


@pytest.mark.parametrize("data", [[1.0, 2.0], np.array([1.0, 2.0])], ids=["list", "array"])
def test_an_angle_may_be_a_number_of_an_array(data):
    message = SimpleNamespace(data=data)
    assert AngleField("data.1", "rad", -1)(message) == -2.0
    with pytest.raises(LogError, match=r"no '2' in its (list|ndarray) \(it has 0, 1\)"):
        AngleField("data.2", "rad", 1)(message)


def test_a_number_may_name_a_field_of_a_json_object():
    assert AngleField("angles.0", "rad", 1)(SimpleNamespace(angles=SimpleNamespace(**{"0": 0.5}))) == 0.5


@pytest.mark.parametrize("data", [
    b"", b"[1]", b"{", b'{"timestamp": 3}', b"[" * 100_000, b'{"a": [' + b"[]," * 4_000_000,
], ids=["empty", "list", "cut", "other type", "deep", "large"])  # fmt: skip
def test_foreign_json_is_an_error_in_one_sentence(data):
    _, decode = decoder_of(Channel(1, "/image", "json", MessageSchema("foxglove.RawImage", "jsonschema", b"")))
    with pytest.raises((LogError, AttributeError)):
        decode(data)


@pytest.mark.parametrize(("frame", "seconds", "sentence"), [
    (r"\ud800", 1, "it is not JSON"),
    ("a", 1 << 40, "its timestamp is damaged"),
], ids=["half a character", "large seconds"])  # fmt: skip
def test_json_values_that_no_result_could_contain_are_refused(frame, seconds, sentence):
    _, decode = decoder_of(Channel(1, "/tf", "json", MessageSchema("foxglove.FrameTransforms", "jsonschema", b"")))
    zero = dict.fromkeys("xyz", 0.0)
    transform = {"timestamp": {"sec": seconds, "nsec": 0}, "parent_frame_id": "FRAME", "child_frame_id": "b",
                 "translation": zero, "rotation": {**zero, "w": 1.0}}  # fmt: skip
    with pytest.raises(LogError, match=sentence):
        decode(json.dumps({"transforms": [transform]}).replace("FRAME", frame).encode())


def test_a_calibration_converted_to_ros_1_may_keep_the_names_of_ros_2():
    info, kind = camera_info(1, "left", model("left")), "sensor_msgs/msg/CameraInfo"
    text = re.sub(r"(?m)[DKRP]$", lambda name: name[0].lower(), ROS1.generate_msgdef(kind, ros_version=1)[0])
    _, decode = decoder_of(Channel(1, "/info", "ros1", MessageSchema(kind, "ros1msg", text.encode())))
    np.testing.assert_array_equal(decode(bytes(ROS1.serialize_ros1(as_ros1(info), kind))).p, info.p)


@pytest.mark.parametrize(("encoding", "schema", "sentence"), [
    ("protobuf", MessageSchema("a.B", "protobuf", b"\xff\xff"), "schema 'a.B' cannot be used"),
    ("protobuf", MessageSchema("a.B", "jsonschema", b"{}"), "is in 'jsonschema', not in 'protobuf'"),
    ("ros1", MessageSchema("a/B", "ros1msg", b"Nothing nothing"), "schema 'a/B' cannot be parsed"),
    ("ros1", MessageSchema("a/B", "ros1msg", NOTHING.format("").encode()), "a list of c/msg/E, which has no fields"),
    ("ros1", MessageSchema("a/B", "ros1msg", NOTHING.format(2000).encode()), "a/msg/B.x has 2000 elements"),
    ("cdr", MessageSchema("a/B", "ros2msg", b"string[2000] x"), "a/msg/B.x has 2000 elements"),
    ("ros1", None, "its messages have no schema"),
    ("cdr", MessageSchema("a/B", "ros2msg", b"int32 x\n" * 2000), "a definition has more than 1000 lines"),
])  # fmt: skip
def test_a_schema_that_cannot_be_used_is_refused(encoding, schema, sentence):
    with pytest.raises(LogError, match=sentence):
        decoder_of(Channel(1, "/topic", encoding, schema))


@pytest.mark.parametrize(("encoding", "step", "place"), [
    ("uyvy", 12, 1), ("yuv422", 12, 1), ("yuyv", 12, 0), ("yuv422_yuy2", 12, 0), ("nv12", 6, 0),
])  # fmt: skip
def test_the_brightness_of_yuv_images_is_read(encoding, step, place):
    luma = np.random.default_rng(1).integers(0, 256, (4, 6), np.uint8)
    packed = np.full((4 if step == 12 else 6, step), 128, np.uint8)  # nv12 has the colours in rows below
    packed[:4, place :: step // 6] = luma
    message = image(0, "camera", luma)
    message.encoding, message.step, message.data = encoding, step, packed.ravel()
    np.testing.assert_array_equal(pixels_of(message), luma)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_mosaic_gives_the_colours_that_it_was_made_of(pattern, bits):
    kind, colour = np.dtype(f"u{bits // 8}"), {"r": 200, "g": 90, "b": 30}
    mosaic = np.tile(np.array([colour[letter] for letter in pattern], kind).reshape(2, 2), (4, 5))
    message = image(0, "camera", mosaic)
    message.encoding = f"bayer_{pattern}{bits}"
    pixels = pixels_of(message)
    assert pixels.dtype == kind
    assert (pixels == [200, 90, 30]).all()


def png_head(width: int, height: int) -> bytes:
    """The beginning and the end of a PNG file, which is all that a check of its size may read."""
    return b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", width, height) + b"\0" * 64 + b"IEND\xaeB`\x82"


def test_an_image_bomb_is_refused_before_it_is_decoded():
    message = image(0, "camera", np.zeros((4, 6), np.uint8))
    message.height, message.width = 30_000, 30_000
    data = np.frombuffer(png_head(30_000, 30_000), np.uint8)
    packed = make("sensor_msgs/msg/CompressedImage", header=message.header, format="png", data=data)
    for bomb in (message, packed):
        with pytest.raises(LogError, match="the image is 30000x30000, more than 'max_pixels' of the source"):
            pixels_of(bomb)


def test_a_picture_of_many_scans_is_refused_before_it_is_decoded():
    content = bytes(cv2.imencode(".jpg", np.zeros((16, 16), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1])
    scan = content[content.index(b"\xff\xda") : -2]
    for times, is_refused in ((1, False), (100, True)):
        data = np.frombuffer(content[:-2] + scan * times + content[-2:], np.uint8)
        header = image(0, "camera", np.zeros((4, 6), np.uint8)).header
        message = make("sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=data)
        if is_refused:
            with pytest.raises(LogError, match=r"the compressed image has [0-9]+ scans; the limit is 64"):
                pixels_of(message)
        else:
            assert pixels_of(message).shape == (16, 16)


def test_only_images_may_have_many_bytes():
    decode = decoder_of(Channel(1, "/tf", "json", MessageSchema("foxglove.FrameTransforms", "jsonschema", b"")))[1]
    with pytest.raises(LogError, match="it has more than 4000000 bytes, the limit of tf2_msgs/msg/TFMessage"):
        decode(b" " * (MAX_MESSAGE_BYTES + 1))


def test_json_of_many_names_is_refused_before_it_is_parsed():
    names = b",".join(b'"%x":1' % number for number in range(400_002))
    with pytest.raises(LogError, match="it has more than 400000 names"):
        json_decoder(b"{%s}" % names)


def test_compressed_messages_may_unpack_to_200_times_their_size_in_all(monkeypatch):
    monkeypatch.setattr(chunk, "_FREE_PARTS_BYTES", 1_000_000)
    decode = decoder_of(Channel(1, "/name", "cdr", MessageSchema("std_msgs/msg/String", "ros2msg", b"string data")))[1]
    packed = zstandard.compress(b"\0\1\0\0" + struct.pack("<I", 400_000) + bytes(400_000))
    assert [len(decode(packed).data) for _ in range(3)] == [399_999] * 3
    with pytest.raises(LogError, match="the log's parts unpack to over 50 times their size"):
        decode(packed)


def test_a_log_of_thousands_of_topics_opens_quickly(tmp_path):
    rows = [(f"/t{number}", "cdr", (f"a/B{number}", "ros2msg", b"int32 x"), 0, None) for number in range(MAX_CHANNELS)]
    last = "/last", "cdr", ("a/Last", "ros2msg", b"int32 x"), 10**9, b"\0\1\0\0\0\0\0\0"
    with McapSource().open(write_mcap(tmp_path / "log.mcap", [*rows, last])) as log:
        assert len(log.resolution.messages.decoders) == MAX_CHANNELS
        assert "the log has more than 1000 channels" in log.missing["left"]


def test_schemas_are_parsed_up_to_a_limit_for_all(tmp_path, monkeypatch):
    monkeypatch.setattr("recordings.source.topics.MAX_SCHEMA_BYTES", 30)
    text, data = b"int32 xxxxxx # " + b"comment" * 9, b"\0\1\0\0\0\0\0\0"
    rows = [(f"/t{number}", "cdr", (f"a/B{number}", "ros2msg", text), 10**9, data) for number in range(3)]
    with McapSource().open(write_mcap(tmp_path / "log.mcap", rows)) as log:
        assert list(log.resolution.messages.schemas) == ["/t0", "/t1"]
        assert "the schemas of the log have more than 30 bytes" in log.missing["left"]
