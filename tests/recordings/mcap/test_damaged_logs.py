"""Damaged and foreign logs: the readable part is read correctly, the rest is reported as lost."""

import math
import os
import re
import struct
from array import array
from dataclasses import replace
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Statistics
from mcap.writer import CompressionType, IndexType, Writer

from recordings import McapSource
from recordings.containers.container import LostMessage
from recordings.containers.header import peek_stamp
from recordings.containers.opening import open_recording
from recordings.containers.timeline import MAX_LOG_TIME
from recordings.errors import LogError
from recordings.mcap.chunk import unpack_chunk
from recordings.mcap.file import McapFile
from recordings.mcap.index import MAGIC, Index
from tests.conftest import chunks_of, patch, rewrite, with_broken, write_mcap
from tests.limits import memory_limited
from tests.recordings.sample_log import (
    LAYOUTS,
    LEFT,
    PERIOD,
    RIGHT,
    START,
    essences,
    inventory_of,
    items_of,
    losses_in,
    parted,
    sound,
)

TIMES = [1001, 1002, 1003, 1004]  # ns


def tiny(path: Path, times: list[int] = TIMES, **options: Any) -> Path:
    """A log of a small message at each of these times. options: of `write_mcap`."""
    schema = ("a/A", "ros2msg", b"int8 a")
    return write_mcap(path, [("/a", "cdr", schema, time, b"\0\1\0\0\0") for time in times], **options)


def read(path: Path) -> tuple[list[int], list[str]]:
    """The log times of the sound messages of a log, and the reasons of the lost ones."""
    with McapFile(path) as log:
        good, lost = parted(log.messages(set(log.channels)))
    return [item.log_time for item in good], lost


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def stored(sample: Path, folder: Path, layout: str) -> bytearray:
    """The content of full.mcap, the sample in a layout."""
    full = folder / "full.mcap"
    return bytearray((full if full.exists() else rewrite(sample, full, **LAYOUTS[layout])).read_bytes())


def times_of(full: Path, first: int, last: float) -> tuple[float, float]:
    """The first and last time in the chunks between two bytes (also partly); any time without an index."""
    with full.open("rb") as file:
        summary = make_reader(file).get_summary()
    chunks = summary.chunk_indexes if summary else []
    if not chunks or first < len(MAGIC):
        return 0, math.inf
    harmed = [c for c in chunks if c.chunk_start_offset < last and first < c.chunk_start_offset + c.chunk_length]
    starts, ends = [c.message_start_time for c in harmed], [c.message_end_time for c in harmed]
    return min(starts, default=math.inf), max(ends, default=0)


def check_nothing_is_lost_silently(path: Path, whole: list[tuple[int, str, Any]], harmed: tuple[float, float]) -> None:
    """A damaged log gives only recorded items, all of them outside the harmed times, and reports the lost ones."""
    problems: set[str] = set()
    events: list[tuple[int, str, Any]] = []
    try:
        with McapSource().open(path) as log:
            problems = set(log.missing)
            events = list(log.events())
    except LogError as error:
        events = [(0, "log", error)]
    known = {event for event in essences(whole) if event[1] != "mount"}
    good = [event for event in sound(events) if event[1] != "mount"]
    assert set(good) <= known
    assert len(set(good)) == len(good)
    losses = [item for _, _, item in events if isinstance(item, Exception)]
    assert all(isinstance(item, LogError) for item in losses)
    missing = known - set(good)
    assert not [stream for time, stream, _ in missing if stream not in problems and not harmed[0] <= time <= harmed[1]]
    absent = {stream for _, stream, _ in missing}
    lossy = {stream for _, stream, item in events if isinstance(item, Exception)}
    assert "log" in lossy or absent <= problems | lossy


@pytest.mark.parametrize("layout", ["small chunks", "no chunks", "no compression", "lz4", "no index"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_cut_log_loses_only_the_part_after_the_cut(sample, whole, tmp_path, layout, share):
    content = stored(sample, tmp_path, layout)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: int(share * len(content))])
    harmed = times_of(tmp_path / "full.mcap", int(share * len(content)), math.inf)
    check_nothing_is_lost_silently(cut, whole, harmed)


def test_messages_before_the_cut_in_a_chunk_are_rescued(sample, whole, tmp_path):
    full = rewrite(sample, tmp_path / "full.mcap", compression=CompressionType.NONE)  # one chunk
    os.truncate(full, int(full.stat().st_size * 0.6))
    events = items_of(full)
    assert "the log is truncated or damaged at byte" in str(events[-1][2])
    assert isinstance(events[-1][2], LogError)
    assert sum(stream == "left" for _, stream, _ in events[:-1]) == 3
    assert essences(events[:-1]) == essences(whole[: len(events) - 1])


@pytest.mark.parametrize("layout", ["small chunks", "no index", "no compression"])
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@example(share=0.8027289957765081, bit=0)  # a log time in the index, which no CRC covers
@example(share=0.32102434907711075, bit=0)  # the length of a message index
def test_a_flipped_bit_never_becomes_data(sample, whole, tmp_path, layout, share, bit):
    content = stored(sample, tmp_path, layout)
    place = int(share * len(content))
    content[place] ^= 1 << bit
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    check_nothing_is_lost_silently(damaged, whole, times_of(tmp_path / "full.mcap", place, place + 1))


def test_a_broken_chunk_loses_its_own_messages_with_their_times(sample, whole, tmp_path):
    full = rewrite(sample, tmp_path / "full.mcap", chunk_size=500)
    broken = next(chunk for chunk, topics in chunks_of(full)[3:] if topics == {LEFT})
    damaged = with_broken(full, broken)
    events = items_of(damaged)
    lost = [(time, stream) for time, stream, item in events if isinstance(item, Exception)]
    assert lost == [(broken.message_start_time, "left")]
    assert any(str(item).startswith(f"{LEFT}: the chunk at byte") for _, _, item in events)
    assert sound(events) == essences(event for event in whole if event[:2] not in lost)
    assert inventory_of(damaged)["damage"]


def test_a_log_that_lost_all_images_reports_the_damage(sample, tmp_path):
    full = rewrite(sample, tmp_path / "full.mcap", chunk_size=500, use_statistics=False)
    broken = [chunk for chunk, topics in chunks_of(full) if topics & {LEFT, RIGHT}]
    with McapSource().open(with_broken(full, *broken)) as log:
        assert log.missing["left"].startswith(
            "the log has no camera images (sensor_msgs/Image or CompressedImage): "
            f"no message of {LEFT}, {RIGHT} can be read; give a log with images "
            f"(messages were lost: the chunk at byte {broken[0].chunk_start_offset} is broken and its messages are lost"
        )
        assert log.resolution.unavailable["left"].endswith("give a log with images")


def test_a_broken_record_length_loses_that_record(sample, whole, tmp_path):
    full = rewrite(sample, tmp_path / "full.mcap", chunk_size=500, index_types=IndexType.NONE, use_statistics=False)
    found = re.finditer(rb"\x06.{5}\0{3}.{28}\x04\0\0\0zstd", full.read_bytes(), re.DOTALL)
    chunks = [match.start() for match in found]
    assert len(chunks) > 10
    patch(full, chunks[3] + 1, struct.pack("<Q", 1 << 39))
    events = items_of(full)
    ((_, _, lost),) = losses_in(events)
    where = f"from byte {chunks[3]} to byte {chunks[4]}"
    assert lost == f"full.mcap: the log is damaged {where}; messages there may be lost"
    assert sound(events) == essences(whole)  # the chunk itself was whole


def test_a_broken_length_does_not_fill_the_memory(tmp_path):
    path = tmp_path / "sparse.mcap"
    with path.open("wb") as file:
        file.write(MAGIC + record(1, b"\0" * 8) + struct.pack("<BQ", 6, 1 << 40))
        file.truncate(1 << 30)
    damage = "no messages that can be read: the log is truncated or damaged at byte 25"
    with memory_limited(300_000), pytest.raises(LogError, match=damage):
        McapFile(path)


@pytest.mark.parametrize("compression", [b"zstd", b"lz4"])
def test_a_chunk_larger_than_stated_is_broken_and_not_unpacked(tmp_path, compression):
    pack = {b"zstd": zstandard.ZstdCompressor(level=1).compress, b"lz4": lz4.frame.compress}[compression]
    packed = pack(bytes(1 << 28))
    head = struct.pack("<QQQII", 0, 1, 100, 0, len(compression)) + compression + struct.pack("<Q", len(packed))
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + record(1, b"\0" * 8) + record(6, head + packed))
    with memory_limited(100_000), pytest.raises(LogError, match="it unpacks to more than 100"):
        McapFile(path)


def test_a_chunk_beyond_the_size_limit_is_broken():
    content = struct.pack("<QQQII", 0, 1, 1 << 50, 0, 4) + b"zstd" + struct.pack("<Q", 1) + b"x"
    with pytest.raises(ValueError, match="the limit is"):
        unpack_chunk(content)


def test_a_log_whose_only_chunk_and_its_index_are_gone_is_refused(sample, tmp_path):
    path = rewrite(sample, tmp_path / "log.mcap", compression=CompressionType.NONE)
    with McapFile(path) as log:
        (chunk,) = log.index.chunks
    patch(path, chunk.offset, bytes(chunk.length + chunk.index_length))
    with pytest.raises(LogError, match=r"contains no messages that can be read: the log is truncated or damaged"):
        McapSource().open(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("layout", ["small chunks", "no message index", "no index", "no chunks"])
def test_an_impossible_log_time_loses_its_message(sample, whole, tmp_path, layout):
    third = [time for time, stream, _ in whole if stream == "left"][2]

    def damage(topic, time):
        return time | 1 << 63 if (topic, time) == (LEFT, third) else time

    path = rewrite(sample, tmp_path / "log.mcap", time=damage, **LAYOUTS[layout])
    *events, (time, stream, error) = items_of(path)
    assert essences(events) == essences(event for event in whole if event[:2] != (third, "left"))
    assert (time, stream) == (whole[-1][0], "left")
    assert "log time is damaged" in str(error)
    assert inventory_of(path)["end"] == whole[-1][0]


def test_losses_are_placed_after_the_last_message_before_them():
    index = Index()
    for time in (5, 9, 7):
        index.add(0, 0, 0, array("H", [1, 1]), array("Q", [time, 1 << 63]))
        index.note_damage("gone")
    index.note_damage("a chunk of damaged time is gone", 1 << 63)
    assert [lost.log_time for lost in index.lost] == [5, 9, 9, MAX_LOG_TIME]


def test_statistics_without_channel_counts_do_not_mean_an_empty_log(sample, whole, tmp_path, monkeypatch):
    written = Statistics.write
    monkeypatch.setattr(Statistics, "write", lambda self, to: written(replace(self, channel_message_counts={}), to))
    path = rewrite(sample, tmp_path / "log.mcap", chunk_size=500)
    assert essences(items_of(path)) == essences(whole)


def test_messages_that_only_the_statistics_count_are_losses_of_their_channel(sample, tmp_path, monkeypatch):
    def more(self: Statistics, to: Any) -> None:
        counts = {number: count + 2 for number, count in self.channel_message_counts.items()}
        written(replace(self, channel_message_counts=counts), to)

    written = Statistics.write
    monkeypatch.setattr(Statistics, "write", more)
    with McapFile(rewrite(sample, tmp_path / "log.mcap", chunk_size=500)) as log:
        one, *_ = channels = sorted(log.channels)
        for wanted in ({one}, set(channels)):
            lost = [item for item in log.messages(wanted) if isinstance(item, LostMessage)]
            assert {item.channel for item in lost} == wanted
        count = log.count({one})
        assert lost[0].reason == f"the log's statistics count {count + 2} messages, but the log contains {count}"


@pytest.mark.parametrize("layout", ["small chunks", "no chunks", "no index", "no crcs"])
@pytest.mark.parametrize("second", ["log", "zeros"])
def test_bytes_after_the_end_of_a_log_are_reported(sample, whole, tmp_path, layout, second):
    first = rewrite(sample, tmp_path / "first.mcap", **LAYOUTS[layout]).read_bytes()
    path = tmp_path / "log.mcap"
    path.write_bytes(first + (first if second == "log" else bytes(5000)))
    *events, (_, stream, lost) = items_of(path)
    assert essences(events) == essences(whole)
    size = len(first) if second == "log" else 5000
    sentence = f"the log ends at byte {len(first)}, and the {size} bytes after it are not read; "
    sentence += "give each log as its own file"
    assert (stream, str(lost)) == ("log", f"log.mcap: {sentence}")
    assert inventory_of(path)["damage"] == [sentence]


def test_an_index_entry_beyond_the_end_loses_only_its_chunk(sample, tmp_path):
    full = rewrite(sample, tmp_path / "full.mcap", chunk_size=500)
    whole = len(read(full)[0])
    with McapFile(full) as log:
        for number, offset in ((2, (1 << 63) - 1), (3, 1 << 63)):
            log.index.chunks[number] = log.index.chunks[number]._replace(offset=offset)
        good, lost = parted(log.messages(set(log.channels)))
    assert len(lost) >= 2
    assert whole > len(good) > whole / 2


@pytest.mark.parametrize(("content", "sentence"), [
    (b"", "is empty"),
    (b"hello, I am a text file\n", "is not an MCAP log"),
    (b"#ROSBAG V2.0\n....", "cannot be read"),
    (b"SQLite format 3\0....", "is not a rosbag2 recording or is damaged"),
    (b"\x89MCAP0\r\n", "contains no messages that can be read: the log is truncated"),
])  # fmt: skip
def test_a_file_of_another_format_is_refused_by_its_name(tmp_path, content, sentence):
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=rf"log\.mcap {sentence}"):
        McapSource().open(path)


def test_a_missing_file_and_an_empty_log_are_refused(tmp_path):
    with pytest.raises(LogError, match=r"cannot read .*none\.mcap: No such file"):
        McapSource().open(tmp_path / "none.mcap")
    with pytest.raises(LogError, match=r"no\.mcap contains no messages"):
        McapSource().open(tiny(tmp_path / "no.mcap", []))


@pytest.mark.parametrize(("options", "start", "opcode", "found"), [
    ({"use_chunking": False}, struct.pack("<BQHIQ", Opcode.MESSAGE, 27, 1, 0, 1002), Opcode.HEADER, [1001, 1003, 1004]),
    ({"chunk_size": 1}, struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 22, 1, 16), Opcode.DATA_END, TIMES),
])  # fmt: skip
def test_a_record_of_a_wrong_opcode_is_lost_alone(tmp_path, options, start, opcode, found):
    log = tiny(tmp_path / "log.mcap", use_statistics=False, **options)
    place = log.read_bytes().index(start)
    patch(log, place, bytes([opcode]))
    times, (lost,) = read(log)
    assert times == found
    assert lost.startswith(f"the record at byte {place} is broken (")


def test_a_schema_whose_text_is_cut_is_damage():
    text = b"int8 a"
    content = struct.pack("<HI3sI7sI", 1, 3, b"a/A", 7, b"ros2msg", len(text) + 1) + text
    with pytest.raises(ValueError, match="cut short"):
        Index().define(Opcode.SCHEMA, content)


def test_messages_of_an_undefined_channel_are_reported(tmp_path):
    log = tiny(tmp_path / "log.mcap", use_chunking=False)
    place = log.read_bytes().index(struct.pack("<BQHIQ", Opcode.MESSAGE, 27, 1, 0, 1002))
    patch(log, place + 9, struct.pack("<H", 999))
    lost = "1 message of channel 999 cannot be read: the log does not define it"
    assert read(log) == ([1001, 1003, 1004], [lost])


def test_the_starts_of_short_messages_in_one_chunk_are_their_own(tmp_path):
    stamps = [START + number * PERIOD for number in range(2)]
    with (path := tmp_path / "log.mcap").open("wb") as file:
        (writer := Writer(file)).start()
        schema = writer.register_schema("geometry_msgs/msg/Vector3Stamped", "ros2msg", b"std_msgs/Header header\n")
        channel = writer.register_channel("/inclinometer", "cdr", schema)
        for number, stamp in enumerate(stamps):
            data = b"\0\1\0\0" + struct.pack("<II", *divmod(stamp, 10**9)) + bytes(40)
            # Its second byte is the opcode of a message.
            writer.add_message(channel, stamp, data, stamp, sequence=Opcode.MESSAGE << 8 | number)
        writer.finish()
    with open_recording(path) as log:
        assert [peek_stamp(head.data) for head in log.heads({channel})] == stamps


def test_a_damaged_definition_in_a_cut_chunk_costs_its_chunk(tmp_path):
    log = tiny(tmp_path / "log.mcap", list(range(1, 9)), compression=CompressionType.NONE)
    name = log.read_bytes().index(b"a/A")
    patch(log, name - 4, struct.pack("<I", 10**6))  # the length of the name
    os.truncate(log, name + 200)
    with pytest.raises(LogError, match="contains no messages that can be read: the log is truncated or damaged"):
        McapFile(log)


def test_a_damaged_log_time_in_a_message_index_loses_no_message(tmp_path):
    log = tiny(tmp_path / "log.mcap")
    patch(log, log.read_bytes().rindex(struct.pack("<Q", 1002)), struct.pack("<Q", 10**6))
    with McapFile(log) as file:
        assert [message.log_time for message in file.messages(set(file.channels), 1001, 1004)] == TIMES[:3]
        assert file.end == 1004


@pytest.mark.parametrize(("place", "found", "why"), [
    (0, [1001, 1003, 1004], ["the message is lost: its log time in the message index is wrong"]), (8, TIMES, []),
])  # fmt: skip
def test_wrong_entries_of_a_message_index_keep_the_order(tmp_path, place, found, why):
    log = tiny(tmp_path / "log.mcap")
    at = log.read_bytes().rindex(struct.pack("<Q", 1002)) + place  # its log time, or its offset in the chunk
    patch(log, at, struct.pack("<H", 1003 if place == 0 else 10**4))
    assert read(log) == (found, why)


def test_stamps_of_zero_are_recognised_if_the_first_message_is_lost(sample, tmp_path):
    def unstamped(topic, index, data):
        return data[:4] + bytes(8) + data[12:] if topic == LEFT else data

    log = rewrite(sample, tmp_path / "log.mcap", unstamped, chunk_size=500)
    first = next(chunk for chunk, topics in chunks_of(log) if topics == {LEFT})
    with McapSource().open(with_broken(log, first)) as opened:
        assert "the header stamps are 0" in opened.notes()["left"]
