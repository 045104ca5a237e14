"""Logs whose images are compressed video, encoded by x264 or x265."""

from collections.abc import Callable
from fractions import Fraction
from itertools import starmap
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from recordings.mcap.file import iter_decoded
from recordings.ros2.cdr import standard_types
from recordings.ros2.image_from_msg import pixels_of
from tests.conftest import Row, write_mcap
from tests.recordings.encodings.rewritten import as_foxglove, foxglove, json_log, protobuf_log

KEY_INTERVAL = 3  # frames from one key frame to the next
VIDEO = "foxglove_msgs/msg/CompressedVideo"
VIDEO_TEXT = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"


class Encoder:
    """Encodes gray images nearly without loss, one message each."""

    def __init__(self, video_format: str) -> None:
        self.format = video_format
        self._codec: Any = None

    def __call__(self, gray: np.ndarray) -> bytes:
        if self._codec is None:
            codec: Any = av.CodecContext.create({"h264": "libx264", "h265": "libx265"}[self.format], "w")
            codec.height, codec.width = gray.shape
            codec.pix_fmt, codec.time_base, codec.gop_size, codec.max_b_frames = "yuv420p", Fraction(1, 30), 3, 0
            x265 = f"bframes=0:repeat-headers=1:log-level=none:keyint={KEY_INTERVAL}:min-keyint={KEY_INTERVAL}:qp=2"
            own = {"qp": "2"} if self.format == "h264" else {"x265-params": x265}
            codec.options = {"tune": "zerolatency", "preset": "ultrafast", **own}
            self._codec = codec
        colours = np.full((gray.shape[0] // 2, gray.shape[1]), 128, np.uint8)
        frame: Any = av.VideoFrame.from_ndarray(np.concatenate([gray, colours]), format="yuv420p")
        (packet,) = self._codec.encode(frame)
        return bytes(packet)


def gray_of(pixels: np.ndarray) -> np.ndarray:
    """The brightness of an image."""
    return pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)


def as_video(video_format: str) -> Callable[[str, Any], Any]:
    """A function to Foxglove's messages, in which images are video."""
    encoders = dict[str, Encoder]()

    def convert(topic: str, message: Any) -> Any:
        if not message.__msgtype__.endswith("/Image"):
            return as_foxglove(message)
        encode = encoders.setdefault(topic, Encoder(video_format))
        data, header = encode(gray_of(pixels_of(message))), message.header
        return foxglove("CompressedVideo", header, data=data, format=video_format, frame_id=header.frame_id)

    return convert


def cdr_log(source: Path, out: Path, convert: Callable[[str, Any], Any]) -> Path:
    """A ROS 2 log with Foxglove's messages of video."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(VIDEO_TEXT, VIDEO))

    def row(topic: str, log_time: int, message: Any) -> Row:
        kind, types = message.__msgtype__, standard_types()
        if kind.endswith("/Image"):
            made, kind, types = convert(topic, message), VIDEO, store
            data = np.frombuffer(made.data, np.uint8)
            time = store.types["builtin_interfaces/msg/Time"](made.timestamp.seconds, made.timestamp.nanos)
            message = store.types[VIDEO](time, made.frame_id, data, made.format)
        text = types.generate_msgdef(kind, ros_version=2)[0].encode()
        return topic, "cdr", (kind, "ros2msg", text), log_time, bytes(types.serialize_cdr(message, kind))

    return write_mcap(out, starmap(row, iter_decoded(source)))


def video_log(source: Path, out: Path, video_format: str, encoding: str = "protobuf") -> Path:
    """The log with its images as video. encoding: of the messages, protobuf, json or cdr."""
    write = {"protobuf": protobuf_log, "json": json_log, "cdr": cdr_log}[encoding]
    return write(source, out, as_video(video_format))
