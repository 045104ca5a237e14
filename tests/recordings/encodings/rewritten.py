"""The messages of a log in other encodings, written by other people's writers."""

import json
from base64 import b64encode
from collections.abc import Callable
from importlib import import_module
from itertools import starmap
from pathlib import Path
from typing import Any

import foxglove_schemas_protobuf as schemas
import numpy as np
from google.protobuf.json_format import MessageToDict
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from recordings.mcap.file import iter_decoded
from tests.conftest import Row, write_mcap

Convert = Callable[[str, Any], Any]  # (topic, message) -> Foxglove's message
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))


def as_ros1(message: Any) -> Any:
    """The same message of ROS 1."""
    if isinstance(message, list):
        return [as_ros1(each) for each in message]
    if not hasattr(message, "__msgtype__"):
        return message
    cls: Any = ROS1.types[message.__msgtype__]
    fields = [name for name in cls.__dataclass_fields__ if not name.startswith("__")]
    own = {name: getattr(message, name, getattr(message, name.lower(), 0)) for name in fields}
    return cls(**{name: as_ros1(value) for name, value in own.items()})


def ros1_in_mcap(source: Path, out: Path) -> Path:
    """ROS 1 messages in an MCAP file."""

    def row(topic: str, log_time: int, message: Any) -> Row:
        kind = message.__msgtype__
        text = ROS1.generate_msgdef(kind, ros_version=1)[0].encode()
        data = bytes(ROS1.serialize_ros1(as_ros1(message), kind))
        return topic, "ros1", (kind.replace("/msg/", "/"), "ros1msg", text), log_time, data

    return write_mcap(out, starmap(row, iter_decoded(source)), profile="ros1")


def foxglove(name: str, header: Any = None, **fields: Any) -> Any:
    cls = getattr(import_module(f"{schemas.__name__}.{name}_pb2"), name)
    made = cls(**fields)
    if header is not None:
        made.timestamp.seconds, made.timestamp.nanos = header.stamp.sec, header.stamp.nanosec
    return made


def _xyz(vector: Any) -> dict[str, float]:
    return {name: getattr(vector, name) for name in "xyz"}


def _xyzw(quaternion: Any) -> dict[str, float]:
    return {name: getattr(quaternion, name) for name in "xyzw"}


def as_foxglove(message: Any) -> Any:
    """The Foxglove message with the same content; an Imu becomes a PoseInFrame, because Foxglove has none."""
    kind, header = message.__msgtype__.rpartition("/")[2], getattr(message, "header", None)
    if kind == "Image":
        return foxglove("RawImage", header, width=message.width, height=message.height, encoding=message.encoding,
                         step=message.step, data=message.data.tobytes(), frame_id=header.frame_id)  # fmt: skip
    if kind == "CameraInfo":
        matrices = {name.upper(): getattr(message, name).tolist() for name in "dkrp"}
        return foxglove("CameraCalibration", header, width=message.width, height=message.height,
                         distortion_model=message.distortion_model, frame_id=header.frame_id, **matrices)  # fmt: skip
    if kind == "TFMessage":
        each = [
            foxglove("FrameTransform", item.header, parent_frame_id=item.header.frame_id,
                      child_frame_id=item.child_frame_id, translation=_xyz(item.transform.translation),
                      rotation=_xyzw(item.transform.rotation))
            for item in message.transforms
        ]  # fmt: skip
        return foxglove("FrameTransforms", transforms=each)
    if kind == "Odometry":
        pose = {"position": _xyz(message.pose.pose.position), "orientation": _xyzw(message.pose.pose.orientation)}
        return foxglove("Odometry", header, frame_id=header.frame_id, body_frame_id=message.child_frame_id, pose=pose,
                         pose_covariance=message.pose.covariance.tolist())  # fmt: skip
    raise KeyError(kind)


def _converted(topic: str, message: Any) -> Any:
    return as_foxglove(message)


def ros_json(message: Any) -> Any:
    """A ROS message as plain values."""
    if isinstance(message, np.ndarray | list | tuple):
        return [ros_json(each) for each in (message.tolist() if isinstance(message, np.ndarray) else message)]
    if not hasattr(message, "__msgtype__"):
        return message
    names = [name for name in message.__dataclass_fields__ if not name.startswith("__")]
    return {name: ros_json(getattr(message, name)) for name in names}


def foxglove_json(message: Any) -> dict[str, Any]:
    """A Foxglove message as its JSON schema has it: bytes in base64, times as sec and nsec."""
    plain: dict[str, Any] = MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )

    def restore(value: Any, given: Any) -> None:
        for known in given.DESCRIPTOR.fields:
            if known.name == "timestamp":
                value["timestamp"] = {"sec": given.timestamp.seconds, "nsec": given.timestamp.nanos}
            elif known.name == "data":
                value["data"] = b64encode(given.data).decode()
            elif known.name == "transforms":
                for one, other in zip(value["transforms"], given.transforms, strict=True):
                    restore(one, other)

    restore(plain, message)
    return plain


def protobuf_log(source: Path, out: Path, convert: Convert = _converted) -> Path:
    """Foxglove's messages in protobuf; the Imu in JSON."""
    with out.open("wb") as file, ProtobufWriter(file) as writer:
        imu, channel = writer._writer.register_schema("sensor_msgs/msg/Imu", "jsonschema", b"{}"), 0
        for topic, log_time, message in iter_decoded(source):
            if message.__msgtype__.endswith("Imu"):
                data = json.dumps(ros_json(message)).encode()
                channel = channel or writer._writer.register_channel(topic, "json", imu)
                writer._writer.add_message(channel, log_time, data, log_time)
            else:
                writer.write_message(_renamed(topic), convert(topic, message), log_time, log_time)
    return out


def json_log(source: Path, out: Path, convert: Convert = _converted) -> Path:
    """Foxglove's messages in JSON."""

    def row(topic: str, log_time: int, message: Any) -> Row:
        if message.__msgtype__.endswith("Imu"):
            name, plain = message.__msgtype__, ros_json(message)
        else:
            made = convert(topic, message)
            name, plain = made.DESCRIPTOR.full_name, foxglove_json(made)
        return _renamed(topic), "json", (name, "jsonschema", b"{}"), log_time, json.dumps(plain).encode()

    return write_mcap(out, starmap(row, iter_decoded(source)), profile="")


def _renamed(topic: str) -> str:
    """Foxglove has no topic of static transforms, and its calibrations may have any name."""
    return {"/tf_static": "/tf"}.get(topic, topic.replace("camera_info", "calibration"))


WRITERS: dict[str, Callable[[Path, Path], Path]] = {
    "ros1.mcap": ros1_in_mcap,
    "protobuf.mcap": protobuf_log,
    "json.mcap": json_log,
}
