"""A small stereo log with asymmetric images, and the same messages in other MCAP layouts."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import fields, is_dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType
from scipy.spatial.transform import Rotation
from zstandard import ZstdCompressor

from recordings import McapSource
from recordings.containers.container import LostMessage, RawMessage
from recordings.inventory.description import describe
from recordings.mcap.writer import Ros2Writer
from recordings.ros2.cdr import make
from recordings.ros2.to_msg import camera_info, image, imu, odometry, transform_message
from stages.data import CameraModel, Pose, StereoFrame, Transform
from tests.conftest import Extra, rewrite

WIDTH, HEIGHT = 24, 16
BASELINE = 0.25
FRAMES = 5
PERIOD = 100_000_000
START = 1_700_000_000_000_000_000
LEFT, RIGHT, TILT = "/stereo/left/image_rect", "/stereo/right/image_rect", "/imu/data"
SIDES = "left", "right"
INFOS = "/stereo/left/camera_info", "/stereo/right/camera_info"
UNSTAMPED = {"header.stamp.sec": 0, "header.stamp.nanosec": 0}  # for `changed`


def model(side: str = "left", **changes: Any) -> CameraModel:
    """The calibration of one camera of the sample."""
    k = np.array([[20.0, 0, 11.5], [0, 20.0, 7.5], [0, 0, 1]])
    p = np.hstack([k, [[-20.0 * BASELINE if side == "right" else 0.0], [0], [0]]])
    fields = {"width": WIDTH, "height": HEIGHT, "k": k, "d": np.zeros(5), "r": np.eye(3), "p": p, **changes}
    return CameraModel(**fields)


def picture(seed: int) -> np.ndarray:
    """An RGB picture that changes with any flip, transposition or exchange of channels."""
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def tilt_quaternion(number: int) -> np.ndarray:
    """The attitude at frame `number`."""
    return Rotation.from_euler("ZYX", [90, 3 + number, -5], degrees=True).as_quat()


def stereo_rows(stamp: int, number: int) -> list[tuple[int, str, Any]]:
    """Log time, topic and message of the calibrations and images of a frame with picture `number` on both sides."""
    infos = [(stamp, f"/{side}/camera_info", camera_info(stamp, f"{side}_optical", model(side))) for side in SIDES]
    return infos + [(stamp, f"/{side}/image_rect", image(stamp, f"{side}_optical", picture(number))) for side in SIDES]


TRANSFORMS = (
    Transform("base_link", "left_optical", np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), [0.5, 0.1, 0.9]),
    Transform("base_link", "imu_link", Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0, 0, 0.4]),
)
Event = tuple[int, str, Any]  # log time, stream, item
Edit = Callable[[str, int, Any], Any]  # (topic, number of the frame, message) -> message, or None to leave it out

LAYOUTS: dict[str, dict[str, Any]] = {
    "small chunks": {"chunk_size": 500},
    "lz4": {"compression": CompressionType.LZ4},
    "no compression": {"compression": CompressionType.NONE, "chunk_size": 4000},
    "no message index": {"index_types": IndexType.CHUNK},
    "no index": {
        "index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False,
    },
    "no chunks": {"use_chunking": False, "enable_data_crcs": True},
    "no crcs": {"enable_crcs": False},
    "messages compressed one by one": {
        "compression": CompressionType.NONE, "change": lambda topic, index, data: ZstdCompressor().compress(data),
    },
}  # fmt: skip


def write_sample(path: Path, *edits: Edit, names: tuple[str, str] = (LEFT, RIGHT)) -> Path:
    """Write the log. edits: each replaces a message (by topic and frame number), or leaves it out by returning None."""
    with Ros2Writer(path) as writer:

        def write(topic: str, number: int, message: Any, stamp: int) -> None:
            for edit in edits:
                message = None if message is None else edit(topic, number, message)
            if message is not None:
                writer.write(topic, message, stamp)

        write("/tf_static", 0, transform_message([(transform, START) for transform in TRANSFORMS]), START)
        for number in range(FRAMES):
            stamp = START + number * PERIOD
            write(TILT, number, imu(stamp, "imu_link", tilt_quaternion(number)), stamp)
            for side, topic in zip(SIDES, names, strict=True):
                info = topic.rpartition("/")[0] + "/camera_info"
                write(info, number, camera_info(stamp, f"{side}_optical", model(side)), stamp)
                pixels = picture(2 * number + (side == "right"))
                write(topic, number, image(stamp, f"{side}_optical", pixels), stamp + 1000)
            pose = Pose(stamp, [number, 2.0, 3.0], tilt_quaternion(number), "odom", "base_link", np.eye(6) * 0.01)
            write("/odom", number, odometry(pose), stamp + 2000)
    return path


def changed(topic: str | tuple[str, ...], values: dict[str, Any], numbers: Collection[int] = range(FRAMES)) -> Edit:
    """An edit for `write_sample`: sets fields, by their paths, in messages of topics that end so, in some frames.

    A value may be a function of the old value.
    """

    def edit(name: str, number: int, message: Any) -> Any:
        if name.endswith(topic) and number in numbers:
            for path, value in values.items():
                *parents, field = path.split(".")
                owner = attrgetter(".".join(parents))(message) if parents else message
                setattr(owner, field, value(getattr(owner, field)) if callable(value) else value)
        return message

    return edit


def dropped(*prefixes: str, numbers: Collection[int] = range(FRAMES)) -> Edit:
    """An edit for `write_sample` that leaves out the topics with these prefixes in some frames."""
    return lambda topic, number, message: None if topic.startswith(prefixes) and number in numbers else message


def replaced(topic: str | tuple[str, ...], change: Callable[[Any], Any]) -> Edit:
    """An edit for `write_sample`: other messages, made of the old ones, on topics that end so."""
    return lambda name, number, message: change(message) if name.endswith(topic) else message


def compressed(topic: str, data: bytes) -> Edit:
    """An edit for `write_sample`: one compressed image in place of each."""
    kind, pixels = "sensor_msgs/msg/CompressedImage", np.frombuffer(data, np.uint8)
    return replaced(topic, lambda message: make(kind, header=message.header, format="png", data=pixels))


def mounted(*transforms: Transform) -> Edit:
    """An edit for `write_sample`: other static transforms."""
    return replaced("/tf_static", lambda message: transform_message([(each, START) for each in transforms]))


def items_of(path: Path | Sequence[Path], source: McapSource | None = None, **bounds: float) -> list[Event]:
    with (source or McapSource()).open(path, **bounds) as log:
        return list(log.events())


def frame_of(path: Path) -> StereoFrame:
    """The last stereo frame of a log that lacks a pose alone."""
    with McapSource().open(path) as log:
        assert set(log.missing) == {"odometry"}
        images = {stream: item for _, stream, item in log.events(("left", "right"))}
    return images["left"].pair_with(images["right"])


def with_extra(path: Path, extra: Extra, **options: Any) -> Path:
    """Write the log with something more. extra, options: of `write_mcap`."""
    return rewrite(write_sample(path.with_name("sample.mcap")), path, extra=extra, **options)


def missing_in(path: Path, **settings: Any) -> dict[str, str]:
    """The streams that a log lacks, each with the reason. settings: of the source."""
    with McapSource(**settings).open(path) as log:
        return log.missing


def refused_in(path: Path, **settings: Any) -> dict[str, str]:
    """The settings of the source that a log does not allow, each with the reason."""
    with McapSource(**settings).open(path) as log:
        return log.refused


def stamps_in(events: Iterable[Event], stream: str = "left") -> list[int]:
    """The stamps of the sound items of a stream among events."""
    return [item.stamp for _, name, item in events if name == stream and not isinstance(item, Exception)]


def losses_in(events: Iterable[Event]) -> list[tuple[int, str, str]]:
    """The losses among events, with their sentences."""
    return [(time, stream, str(item)) for time, stream, item in events if isinstance(item, Exception)]


def parted(messages: Iterable[RawMessage | LostMessage]) -> tuple[list[RawMessage], list[str]]:
    """The sound ones of raw messages, and the reasons of the lost ones."""
    found = list(messages)
    return (
        [item for item in found if isinstance(item, RawMessage)],
        [item.reason for item in found if isinstance(item, LostMessage)],
    )


def inventory_of(path: Path, slop: int = 5_000_000, max_gap: int = 200_000_000) -> dict[str, Any]:
    """The inventory of a log."""
    with McapSource().open(path) as log:
        return describe(log, slop, lambda intervals: max_gap)


def essence(item: Any) -> Any:
    """An item's whole content, comparable; an error is itself."""
    if isinstance(item, np.ndarray):
        return item.dtype.str, item.shape, item.tobytes()
    return tuple(essence(getattr(item, field.name)) for field in fields(item)) if is_dataclass(item) else item


def essences(events: Iterable[Event]) -> list[Event]:
    """Events, comparable."""
    return [(time, stream, essence(item)) for time, stream, item in events]


def sound(events: Iterable[Event]) -> list[Event]:
    """The events that are no losses, comparable."""
    return essences(event for event in events if not isinstance(event[2], Exception))
