"""A log in other containers, written by the rosbags library."""

from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from recordings.ros2.cdr import standard_types
from tests.conftest import mcap_rows, patch
from tests.recordings.encodings.rewritten import ROS1, as_ros1

Row = tuple[str, str, int, bytes]  # topic, type, log time, data


def rows_of(log: Path) -> list[Row]:
    """The messages of an MCAP log in the order of log time."""
    return [(topic, schema[0], log_time, data) for topic, _, schema, log_time, data in mcap_rows(log)]


def write_rosbag2(
    rows: list[Row], folder: Path, plugin: StoragePlugin = StoragePlugin.MCAP, parts: int = 1,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:  # fmt: skip
    """Write a rosbag2 folder of some parts, as `ros2 bag record --max-bag-size` splits it, with metadata.yaml."""
    folder.mkdir()
    names, information = [], dict[str, Any]()
    for number, (low, high) in enumerate(pairwise(round(part * len(rows) / parts) for part in range(parts + 1))):
        own = folder.parent / f"{folder.name}-{number}"
        writer = Writer(own, version=8, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            _add(writer, rows[low:high], standard_types(), lambda kind, data: data)
        (file,) = (path for path in own.iterdir() if path.name != "metadata.yaml")
        names.append(f"{folder.name}_{number}{file.name.removeprefix(own.name)}")
        file.rename(folder / names[-1])
        information = yaml.safe_load((own / "metadata.yaml").read_text())
    information["rosbag2_bagfile_information"]["relative_file_paths"] = names
    (folder / "metadata.yaml").write_text(yaml.safe_dump(information))
    return folder


def _add(writer: Any, rows: list[Row], types: Any, convert: Callable[[str, bytes], bytes]) -> dict[str, Any]:
    """Write rows, each with its data converted; returns the connections of the topics."""
    connections = dict[str, Any]()
    for topic, kind, log_time, data in rows:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=types)
        writer.write(connections[topic], log_time, convert(kind, data))
    return connections


def write_bag(
    rows: list[Row], path: Path, compression: Bag1Writer.CompressionFormat | None = None,
    more: Iterable[tuple[str, int, bytes]] = (),
) -> Path:  # fmt: skip
    """Write a ROS 1 bag. more: topic of the rows, log time and data of messages that are written as they are."""
    writer = Bag1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = _add(writer, rows, ROS1, _as_ros1)
        for topic, log_time, data in more:
            writer.write(connections[topic], log_time, data)
    return path


def _as_ros1(kind: str, data: bytes) -> bytes:
    return bytes(ROS1.serialize_ros1(as_ros1(standard_types().deserialize_cdr(data, kind)), kind))


def without_index(bag: Path) -> Path:
    """A bag whose header does not say where the index is, as a stopped recorder leaves it; all chunks are whole."""
    patch(bag, bag.read_bytes().index(b"index_pos=") + len(b"index_pos="), bytes(8))
    return bag
