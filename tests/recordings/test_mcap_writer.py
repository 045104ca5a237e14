"""What our writer of MCAP files writes is what the mcap library would have written, and its readers read it."""

from __future__ import annotations

import io
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.writer import Writer

from recordings.mcap_writer import CHUNK, MAGIC, McapWriter

SIZES = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 99), st.sampled_from([0, 7, 5000, CHUNK])), max_size=8)


def ours(messages: list[tuple[int, int, bytes]]) -> bytes:
    file = io.BytesIO()
    writer = McapWriter(file, "ros2", "test")
    writer.metadata("before", {"a": "1"})
    schema = writer.schema("pkg/msg/Kind", "ros2msg", b"uint8 x")
    channels = [writer.channel(f"/topic/{number}", "cdr", schema) for number in range(3)]
    for count, (number, stamp, data) in enumerate(messages):
        writer.message(channels[number], count, stamp, data)
    writer.metadata("behind", {"b": "2"})
    writer.finish()
    return file.getvalue()


def theirs(messages: list[tuple[int, int, bytes]]) -> bytes:
    file = io.BytesIO()
    writer: Any = Writer(file, chunk_size=CHUNK)
    writer.start("ros2", "test")
    writer.add_metadata("before", {"a": "1"})
    schema = writer.register_schema("pkg/msg/Kind", "ros2msg", b"uint8 x")
    channels = [writer.register_channel(f"/topic/{number}", "cdr", schema) for number in range(3)]
    for count, (number, stamp, data) in enumerate(messages):
        writer.add_message(channels[number], stamp, data, stamp, count)
    writer.flush()
    writer.add_metadata("behind", {"b": "2"})
    writer.finish()
    return file.getvalue()


def read(log: bytes, kind: Callable[..., Any]) -> list[Any]:
    def reader() -> Any:
        return kind(io.BytesIO(log), validate_crcs=True)

    return [*reader().iter_messages(), *reader().iter_metadata()]


@settings(max_examples=25, deadline=None)
@given(SIZES)
def test_the_librarys_readers_see_no_difference(sizes: list[tuple[int, int, int]]) -> None:
    """Indexed and as a stream, with CRCs checked: messages, metadata, and the summary but for where things lie."""
    noise = random.Random(1)
    messages = [(number, stamp, noise.randbytes(size)) for number, stamp, size in sizes]
    mine, known = ours(messages), theirs(messages)
    assert read(mine, SeekingReader) == read(known, SeekingReader)
    assert read(mine, NonSeekingReader) == read(known, NonSeekingReader)
    summary, other = (SeekingReader(io.BytesIO(log), validate_crcs=True).get_summary() for log in (mine, known))
    assert summary is not None
    assert other is not None
    assert (summary.channels, summary.schemas) == (other.channels, other.schemas)
    first = replace(other.statistics, message_end_time=summary.statistics.message_end_time)
    assert summary.statistics == first  # the library takes the last message's time for the latest
    ends = [(chunk.message_start_time, chunk.message_end_time) for chunk in summary.chunk_indexes]
    assert ends == [(chunk.message_start_time, chunk.message_end_time) for chunk in other.chunk_indexes]
    sizes_of_chunks = [chunk.uncompressed_size for chunk in summary.chunk_indexes]
    assert sizes_of_chunks == [chunk.uncompressed_size for chunk in other.chunk_indexes]


def test_indexes_point_at_their_messages() -> None:
    log = ours([(number % 3, number, bytes([number]) * 3000) for number in range(20)])
    reader = SeekingReader(io.BytesIO(log), validate_crcs=True)
    for number in range(20):
        found = [message.data for _, _, message in reader.iter_messages(starting_at=number, ending_before=number + 1)]
        assert found == [bytes([number]) * 3000]


def test_the_same_calls_make_the_same_bytes_and_none_make_an_empty_log() -> None:
    messages = [(0, 5, b"x" * 100)]
    assert ours(messages) == ours(messages)
    assert ours([]).startswith(MAGIC)
    assert ours([]).endswith(MAGIC)
