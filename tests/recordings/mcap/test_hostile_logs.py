"""Small files that unpack to much, or state much, cost at most 500 MB and 20 s, and one sentence."""

import sqlite3
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakSet

import cv2
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin

from recordings import McapSource
from recordings.containers import container
from recordings.errors import LogError
from recordings.mcap import chunk
from recordings.mcap.file import McapFile
from tests.conftest import Extra, rewrite, write_mcap
from tests.fuzz.isolation import MAX_MEGABYTES, isolated
from tests.fuzz.targets import read_events, read_info, read_log
from tests.recordings import sample_log
from tests.recordings.containers.forms import rows_of, without_index, write_bag, write_rosbag2
from tests.recordings.sample_log import (
    LEFT,
    START,
    TILT,
    changed,
    compressed,
    essences,
    items_of,
    losses_in,
    missing_in,
    sound,
    write_sample,
)

NOTHING = b"\0\1\0\0" + bytes(8)
EMPTY = f"x'{NOTHING.hex()}'"  # in SQL
PLAIN = {"compression": CompressionType.NONE}
MILLISECOND = 1_000_000


def with_extra(extra: Extra, **options: Any) -> Callable[[Path], Path]:
    """A function that writes the sample log with something more."""
    return lambda folder: sample_log.with_extra(folder / "log.mcap", extra, **options)


def images(data: bytes, size: int) -> Callable[[Path], Path]:
    """The sample with a compressed image in place of each, and calibrations of its size."""
    edits = compressed("image_rect", data), changed("camera_info", {"width": size, "height": size})
    return lambda folder: write_sample(folder / "log.mcap", *edits)


def png(size: int, bits: int = 8, colour: int = 0) -> bytes:
    """A black picture; colour: 0 gray, 6 RGBA."""

    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, rows = zlib.compressobj(1), bytes((1 + size * bits // 8 * (4 if colour else 1)) * 100)
    packed = b"".join(packer.compress(rows) for _ in range(size // 100)) + packer.flush()
    head = struct.pack(">IIBBBBB", size, size, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", packed) + part(b"IEND", b"")


def jpeg(size: int) -> bytes:
    """A small picture that states another size."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((64, 64), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", size, size)
    return bytes(data)


def packed(megabytes: int, states_size: bool) -> bytes:
    """Zeros."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=megabytes << 20 if states_size else -1)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(megabytes)) + packer.flush()


def tiny(count: int, topic: str = "", apart: int = 1, **options: Any) -> Callable[[Path], Path]:
    """The sample log with many messages more, of a known topic, or of one of their own. apart: ns."""

    def many_messages(writer: Writer, channels: dict[str, int]) -> None:
        channel = channels[topic] if topic else writer.register_channel("/tiny", "cdr", number_schema(writer))
        for number in range(count):
            writer.add_message(channel, START + number * apart, NOTHING, START)

    return with_extra(many_messages, **options)


def number_schema(writer: Writer) -> int:
    return writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")


def many_topics(writer: Writer, channels: dict[str, int], count: int) -> None:
    for number in range(count):
        text = f"std_msgs/Header header\nfloat64 x{number}\n".encode()
        schema = writer.register_schema(f"own_msgs/msg/T{number}", "ros2msg", text)
        channel = writer.register_channel(f"/topics/{number}", "cdr", schema)
        writer.add_message(channel, START + number, bytes(32), START)


def large_channels(writer: Writer, channels: dict[str, int], count: int) -> None:
    schema = number_schema(writer)
    for number in range(count):
        writer.register_channel(f"/large/{number}", "cdr", schema, metadata={"x": "y" * 100_000})


def messages_of(data: bytes, count: int) -> Extra:
    """More messages of the left camera."""
    return lambda writer, channels: [
        writer.add_message(channels[LEFT], START + number, data, START) for number in range(count)
    ]


def bag(compression: BagWriter.CompressionFormat) -> Callable[[Path], Path]:
    """The sample as a ROS 1 bag, with chunks more that unpack to 60 MB each."""
    more = ((LEFT, START + number, bytes(60 << 20)) for number in range(200))
    return lambda folder: write_bag(
        rows_of(write_sample(folder / "sample.mcap")), folder / "log.mcap", compression, more
    )


def bag_in_use(count: int, has_index: bool) -> Callable[[Path], Path]:
    """The sample as a ROS 1 bag with more messages of the tilt."""
    more = ((TILT, START + number, NOTHING) for number in range(count))

    def write(folder: Path) -> Path:
        path = write_bag(rows_of(write_sample(folder / "sample.mcap")), folder / "log.mcap", None, more)
        return path if has_index else without_index(path)

    return write


def database(count: int, data: str, topic: str = LEFT, kind: str = "", apart: int = 1) -> Callable[[Path], Path]:
    """The sample as a database with more messages of a topic. data: in SQL; kind: the type of a new topic;
    apart: ns."""

    def write(folder: Path) -> Path:
        (path,) = write_rosbag2(
            rows_of(write_sample(folder / "sample.mcap")), folder / "bag", StoragePlugin.SQLITE3
        ).glob("*.db3")
        opened = sqlite3.connect(path.rename(folder / "log.mcap"))
        with opened:
            if kind:
                row = (topic, kind, "cdr", "", "")
                columns = "name, type, serialization_format, offered_qos_profiles, type_description_hash"
                opened.execute(f"INSERT INTO topics ({columns}) VALUES (?, ?, ?, ?, ?)", row)
            ((number,),) = opened.execute("SELECT id FROM topics WHERE name = ?", (topic,))
            more = ((number, START + place * apart) for place in range(count))
            opened.executemany(f"INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, {data})", more)
        opened.close()
        return folder / "log.mcap"

    return write


def schema_of(text: str) -> Extra:
    """A second Imu with this definition."""

    def extra(writer: Writer, channels: dict[str, int]) -> None:
        schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", text.encode())
        writer.add_message(writer.register_channel("/imu2", "cdr", schema), START, bytes(100), START)

    return extra


SMALL = {
    "png of 6000x6000": lambda: images(png(6000), 6000),
    "jpeg of 30000x30000": lambda: images(jpeg(30000), 30000),
    "messages of 200 MB": lambda: with_extra(messages_of(packed(200, states_size=False), 2)),
    "schema of 5 MB": lambda: with_extra(schema_of("".join(f"float64 f{number}\n" for number in range(300_000)))),
    "database with messages of 200 MB": lambda: database(2, "zeroblob(200000000)"),
    "channels of 20 MB": lambda: with_extra(lambda *to: large_channels(*to, 200)),
}
LARGE = {
    "png of 30000x30000": lambda: images(png(30000), 30000),
    "png of 16 bits": lambda: images(png(4500, bits=16, colour=6), 4500),
    "messages of 60 GB in all": lambda: with_extra(messages_of(packed(60, states_size=True), 1000)),
    "bag of 12 GB in bz2": lambda: bag(BagWriter.CompressionFormat.BZ2),
    "bag of 12 GB in lz4": lambda: bag(BagWriter.CompressionFormat.LZ4),
    "messages of 4 GB": lambda: with_extra(messages_of(packed(4000, states_size=False), 5)),
    "messages that state 4 GB": lambda: with_extra(messages_of(packed(4000, states_size=True), 5)),
    "comments of 5 MB": lambda: with_extra(schema_of("# x\n" * 1_300_000)),
    "20000 topics": lambda: with_extra(lambda *to: many_topics(*to, 20_000)),
    "channels of 200 MB": lambda: with_extra(lambda *to: large_channels(*to, 2000)),
    "chunk of 2 GB": lambda: with_extra(messages_of(bytes(2000 << 20), 1), chunk_size=1 << 31),
    "messages of 200 MB in chunks": lambda: with_extra(messages_of(bytes(200 << 20), 20), **PLAIN),
    "messages of 200 MB outside chunks": lambda: with_extra(messages_of(bytes(200 << 20), 20), use_chunking=False),
    "database with messages of 120 MB": lambda: database(20, "zeroblob(120000000)"),
    "2 million messages in one chunk": lambda: tiny(2_000_000, chunk_size=1 << 31),
    "6 million messages": lambda: tiny(6_000_000),
    "6 million messages outside chunks": lambda: tiny(6_000_000, use_chunking=False),
    "6 million messages in a database": lambda: database(6_000_000, EMPTY, "/tiny", "std_msgs/msg/Float64"),
    "6 million messages in use": lambda: tiny(6_000_000, TILT),
    "6 million messages in use outside chunks": lambda: tiny(6_000_000, TILT, use_chunking=False),
    "6 million messages in use in a bag": lambda: bag_in_use(6_000_000, has_index=True),
    "6 million messages in use in a bag without an index": lambda: bag_in_use(6_000_000, has_index=False),
    "6 million messages in use in a database": lambda: database(6_000_000, EMPTY, TILT),
}


@pytest.mark.parametrize("name", SMALL)
def test_a_hostile_log_costs_little(tmp_path, name):
    path = SMALL[name]()(tmp_path)
    assert isolated(lambda: read_log(path)).fault == ""


IN_USE = {
    "chunks": lambda: tiny(1_000_000, TILT, MILLISECOND),
    "a database": lambda: database(1_000_000, EMPTY, TILT, apart=MILLISECOND),
}


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", IN_USE)
def test_a_million_damaged_messages_in_use_cost_little_memory(tmp_path, name):
    assert isolated(lambda: IN_USE[name]()(tmp_path), limited=False).fault == ""
    found = [isolated(partial(read, tmp_path / "log.mcap"), limited=False) for read in (read_info, read_events)]
    assert [outcome.fault for outcome in found] == ["", ""]
    assert max(outcome.megabytes for outcome in found) < MAX_MEGABYTES


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", LARGE)
def test_a_large_hostile_log_costs_little(tmp_path, name):
    assert isolated(lambda: LARGE[name]()(tmp_path), limited=False).fault == ""
    path = tmp_path / "log.mcap"
    faults = [isolated(partial(read, path)).fault for read in (read_info, read_events)]
    path.unlink()
    assert faults == ["", ""]


def test_a_log_that_unpacks_to_far_more_than_its_size_is_refused(tmp_path, monkeypatch):
    path = with_extra(messages_of(bytes(1 << 20), 20))(tmp_path)
    monkeypatch.setattr(chunk, "_FREE_FILE_BYTES", 1 << 20)
    with pytest.raises(LogError, match="times its size, unlike any recording"):
        McapFile(path)


def test_a_topic_faster_than_any_sensor_is_refused_unless_a_setting_allows_it(tmp_path, whole):
    path = tiny(20, TILT, MILLISECOND)(tmp_path)
    why = missing_in(path, max_rate=2)["inclinometer"]
    assert "/imu/data: over 20 of its 25 messages were logged within 10 s" in why
    assert "set 'max_rate' of the source to the rate of the sensor" in why
    with McapSource(max_rate=3).open(path) as log:
        assert sound(log.events()) == essences(whole)


@pytest.fixture
def unpacked(monkeypatch):
    """The chunks that are unpacked, each time that they are."""
    times, unpack = [], McapFile._unpacked
    monkeypatch.setattr(McapFile, "_unpacked", lambda self, one: times.append(one) or unpack(self, one))
    return times


def test_chunks_that_overlap_are_unpacked_again_beyond_a_limit(sample, whole, tmp_path, monkeypatch, unpacked):
    shuffled = rewrite(
        sample, tmp_path / "log.mcap", order=lambda rows: rows[::3] + rows[1::3] + rows[2::3], chunk_size=3000
    )
    monkeypatch.setattr("recordings.mcap.file._RECENT_BYTES", 0)
    counts = []
    for limit in (1 << 27, 1):
        monkeypatch.setattr(container, "MAX_OPEN_BYTES", limit)
        unpacked.clear()
        assert essences(items_of(shuffled)) == essences(whole)
        counts.append(len(unpacked))
    assert counts[1] > counts[0]


def test_short_messages_keep_no_chunk_in_memory(sample):
    with McapFile(sample) as file:
        assert len(file.index.chunks) == 1
        assert all(len(item.data.obj) == len(item.data) for item in file.messages(set(file.channels)))


def test_a_chunk_that_was_just_read_is_not_unpacked_again(sample, unpacked):
    with McapFile(sample) as file:
        once, again = ([[*file.messages({number})] for number in file.channels] for _ in range(2))
        assert once == again
        assert len(unpacked) == len(file.index.chunks)


def test_large_chunks_are_let_go_one_after_the_other_and_on_close(tmp_path, monkeypatch):
    rows = [("/a", "cdr", ("a/A", "ros2msg", b"int8 a"), time, NOTHING) for time in (1, 2, 3)]
    log = write_mcap(tmp_path / "log.mcap", rows, chunk_size=1)
    alive, before = WeakSet(), []

    class Watched(chunk.ChunkTable):
        def __init__(self, *parts):
            super().__init__(*parts)
            before.append(len(alive))
            alive.add(self)

    monkeypatch.setattr("recordings.mcap.file.ChunkTable", Watched)
    for largest in (0, 1 << 20):  # bytes of a chunk that may be kept
        monkeypatch.setattr("recordings.mcap.file._RECENT_BYTES", largest)
        with McapFile(log) as file:
            reader = file.messages(set(file.channels))
            assert [next(reader).log_time, next(reader).log_time] == [1, 2]
        del reader  # in the middle
        assert not alive
    assert before == [0, 0, 0, 1]


@pytest.mark.parametrize("use_chunking", [True, False])
def test_a_message_that_no_recorder_writes_is_lost_alone(tmp_path, whole, use_chunking):
    found = items_of(with_extra(messages_of(bytes(140 << 20), 1), use_chunking=use_chunking, **PLAIN)(tmp_path))
    ((_, _, why),) = losses_in(found)
    assert why == f"{LEFT}: the message has 146800640 bytes; the limit is 134217728"
    assert sound(found) == essences(whole)
