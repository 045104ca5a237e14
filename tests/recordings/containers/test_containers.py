"""rosbag2 databases and ROS 1 bags, sound and damaged: what can be read is read, the rest is reported."""

import os
import shlex
import sqlite3
import subprocess
import sys
from weakref import WeakSet

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin

from recordings.containers.container import LostMessage, OpenChunks, within
from recordings.containers.opening import open_recording
from recordings.errors import LogError
from tests.conftest import patch
from tests.recordings.containers.forms import rows_of, without_index, write_bag, write_rosbag2
from tests.recordings.sample_log import INFOS, LEFT, RIGHT, TILT, essences, items_of, parted


@pytest.fixture
def database(sample, tmp_path):
    folder = write_rosbag2(rows_of(sample), tmp_path / "bag", StoragePlugin.SQLITE3)
    return folder / "bag_0.db3"


def edit(database, *statements):
    with sqlite3.connect(database) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


def read(path):
    """The sound messages as (topic, log time, data), and the reasons of the lost ones."""
    with open_recording(path) as log:
        sound, lost = parted(log.files[0].messages(set(log.channels)))
        return [(log.channels[item.channel].topic, item.log_time, bytes(item.data)) for item in sound], lost


def without_types(rows):
    return [(topic, time, data) for topic, _, time, data in rows]


def test_a_database_is_not_written_to_and_keeps_its_definitions(database, sample):
    before = sorted(database.parent.iterdir()), database.read_bytes()
    with open_recording(database) as log:
        schema = next(c.schema for c in log.channels.values() if c.topic == LEFT)
    assert (schema.name, schema.encoding) == ("sensor_msgs/msg/Image", "ros2msg")
    assert schema.text.startswith(b"std_msgs/Header header")
    assert read(database) == (without_types(rows_of(sample)), [])
    assert (sorted(database.parent.iterdir()), database.read_bytes()) == before


def test_a_database_without_definitions_has_those_of_the_standard_types(database, whole):
    edit(database, "DELETE FROM message_definitions")
    assert essences(items_of(database)) == essences(whole)
    with open_recording(database) as log:
        assert {log.channels[number].topic for number in log.stamped} == {LEFT, RIGHT, TILT, "/odom", *INFOS}


def test_a_broken_row_loses_itself(database, sample):
    edit(database, "UPDATE messages SET data = 7 WHERE id = 3", "UPDATE messages SET timestamp = -5 WHERE id = 4")
    rows = without_types(rows_of(sample))
    sound, lost = read(database)
    assert sound == [*rows[:2], *rows[4:]]
    assert lost == [
        "row 3 of the file is broken (cannot open value of type integer)",
        "the message is lost: its log time is damaged",
    ]


def test_a_message_that_no_recorder_writes_is_not_loaded(database):
    edit(database, "UPDATE messages SET data = zeroblob(200000000) WHERE id = 3")
    assert read(database)[1] == ["row 3 of the file has 200000000 bytes; the limit is 134217728"]


def test_a_cut_database_is_read_as_far_as_it_goes(sample, tmp_path):
    written = [(row[0], row[1], row[2] + number, row[3]) for number in range(20) for row in rows_of(sample)]
    database = write_rosbag2(written, tmp_path / "bag", StoragePlugin.SQLITE3) / "bag_0.db3"
    rows, content = without_types(written), database.read_bytes()
    database.write_bytes(content[: len(content) // 2])
    sound, lost = read(database)
    assert 0 < len(sound) < len(rows)
    assert set(sound) < set(rows)
    assert lost


def test_rows_that_a_damaged_page_has_lost_are_reported(database, sample):
    with sqlite3.connect(database) as connection:
        root, page_bytes = connection.execute(
            "SELECT rootpage, page_size FROM sqlite_master, pragma_page_size() WHERE name = 'messages'"
        ).fetchone()
    connection.close()
    content = database.read_bytes()

    def number(at, size):
        return int.from_bytes(content[at : at + size], "big")

    page = page_bytes * (number(page_bytes * (root - 1) + 8, 4) - 1)  # the last page of rows
    rows, records = number(page + 3, 2), number(page + 5, 2)
    patch(database, page + records, bytes(page_bytes - records))
    kept = without_types(rows_of(sample))[:-rows]
    reason = f"the file is truncated or damaged (rows without a topic or a time); intact: {len(kept)} messages"
    assert read(database) == (kept, [reason])


def test_messages_of_an_unknown_topic_and_in_a_journal_are_reported(database):
    edit(database, "UPDATE messages SET topic_id = 99 WHERE id = 3")
    database.with_name(f"{database.name}-wal").write_bytes(b"journal")
    _, lost = read(database)
    assert lost[0] == "1 message of topic 99 cannot be read: the file does not define it"
    assert lost[1].startswith("the recorder was stopped and bag_0.db3-wal has messages that are not read; `python3 -c ")


@pytest.mark.parametrize("tables_too", [False, True])
def test_the_advice_for_a_stopped_recorder_adds_its_messages(database, tmp_path, tables_too):
    sound, _ = read(database)
    path, opened = tmp_path / "stopped.db3", sqlite3.connect(tmp_path / "running.db3", isolation_level=None)
    opened.execute("PRAGMA journal_mode = WAL")
    opened.execute("ATTACH ? AS whole", (str(database),))
    tables = "SELECT sql FROM whole.sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
    for (statement,) in opened.execute(tables).fetchall():
        opened.execute(statement)
    opened.execute("INSERT INTO topics SELECT * FROM whole.topics")
    if not tables_too:
        opened.execute("PRAGMA wal_checkpoint")
    opened.execute("INSERT INTO messages SELECT * FROM whole.messages")
    for ending in ("", "-wal"):  # as a stopped recorder leaves them
        path.with_name(f"{path.name}{ending}").write_bytes((tmp_path / f"running.db3{ending}").read_bytes())
    opened.close()
    with pytest.raises(LogError, match=r"the recorder was stopped and stopped\.db3-wal has messages") as refused:
        open_recording(path)
    python, *rest = shlex.split(str(refused.value).split("`")[1])
    assert python == "python3"
    subprocess.run([sys.executable, *rest], check=True)
    assert read(path) == (sound, [])


@pytest.mark.parametrize(("statements", "sentence"), [
    (["DROP TABLE topics"], "is an SQLite file, but no rosbag2 recording: it has no table of messages"),
    (
        [
            "CREATE TABLE other AS SELECT NULL AS id, name, type, serialization_format FROM topics",
            "DROP TABLE topics",
            "ALTER TABLE other RENAME TO topics",
        ],
        "is not a rosbag2 recording or is damaged (int() argument must be",
    ),
    (["DELETE FROM messages"], "contains no messages; record it again"),
    (["ALTER TABLE topics RENAME COLUMN type TO kind"], "is not a rosbag2 recording or is damaged (no such column"),
])  # fmt: skip
def test_a_database_without_messages_is_refused(database, statements, sentence):
    edit(database, *statements)
    with pytest.raises(LogError) as refused:
        open_recording(database)
    assert str(refused.value).startswith(f"{database} {sentence}")


@pytest.mark.parametrize("compression", [None, *Bag1Writer.CompressionFormat])
def test_a_ros_1_bag_is_the_same_log_with_the_schemas_of_ros_1(sample, whole, tmp_path, compression):
    path = write_bag(rows_of(sample), tmp_path / "log.bag", compression)
    assert essences(items_of(path)) == essences(whole)
    sound, lost = read(path)
    assert [(topic, time) for topic, time, _ in sound] == [(topic, time) for topic, _, time, _ in rows_of(sample)]
    assert lost == []
    with open_recording(path) as log:
        (channel,) = (channel for channel in log.channels.values() if channel.topic == LEFT)
    assert (channel.message_encoding, channel.schema.encoding, channel.schema.name) == (
        "ros1", "ros1msg", "sensor_msgs/Image",
    )  # fmt: skip
    assert b"MSG: std_msgs/Header" in channel.schema.text


def test_a_broken_chunk_of_a_bag_loses_its_messages(sample, tmp_path):
    rows = rows_of(sample) * 100  # several chunks
    rows = [(topic, kind, rows[0][2] + 1000 * number, data) for number, (topic, kind, _, data) in enumerate(rows)]
    path = write_bag(rows, tmp_path / "log.bag", Bag1Writer.CompressionFormat.LZ4)
    sound, _ = read(path)
    patch(path, path.read_bytes().index(b"\x04\x22\x4d\x18"), b"\xff")  # the first byte of the first chunk
    kept, lost = read(path)
    assert len(kept) + len(lost) == len(sound) == len(rows) > len(kept) > 0
    assert kept == sound[len(lost) :]
    assert lost[0].startswith("the chunk at byte 4109 is broken and its messages are lost (")


@pytest.mark.parametrize("compression", [None, *Bag1Writer.CompressionFormat])
def test_a_bag_of_a_stopped_recorder_is_read_without_its_index(sample, tmp_path, compression):
    path = write_bag(rows_of(sample), tmp_path / "log.bag", compression)
    sound, content = read(path), path.read_bytes()
    index = int.from_bytes(content.partition(b"index_pos=")[2][:8], "little")
    assert read(without_index(path)) == sound
    path.write_bytes(content[:index])
    assert read(path) == sound
    path.write_bytes(content[:index] + content[4109:][:3000])  # a chunk that is cut
    kept, lost = read(path)
    assert kept == sound[0]
    where = f"at byte {index} of {index + 3000} (no whole record is there)"
    assert lost == [f"the bag is truncated or damaged {where}; intact before it: {len(kept)} messages"]


def test_the_last_chunk_of_a_stopped_recorder_has_no_stated_size(sample, tmp_path):
    path = write_bag(rows_of(sample), tmp_path / "log.bag")
    sound, content = read(path)[0], path.read_bytes()
    with Reader(path) as bag:
        place, chunk = max(bag.chunks.items())
    for size in (content.index(b"size=", place) + len(b"size="), chunk.datapos - 4):
        patch(path, size, bytes(4))
    last = content.rindex(b"time=", chunk.datapos, chunk.datapos + chunk.datasize)
    os.truncate(path, last + 100)
    kept, lost = read(path)
    assert kept == sound[:-1]
    assert len(lost) == 1
    assert "is broken" in lost[0]


def test_messages_of_an_unknown_connection_of_a_bag_are_reported(sample, tmp_path):
    path = write_bag(rows_of(sample), tmp_path / "log.bag")
    sound, content = read(path)[0], path.read_bytes()
    patch(path, content.index(b"conn=", content.index(b"op=\x02")) + len(b"conn="), b"\x63")  # of the first message
    assert read(without_index(path)) == (sound[1:], ["1 message of an undefined connection cannot be read"])


def test_a_bag_without_messages_is_refused(sample, tmp_path):
    path = write_bag(rows_of(sample), tmp_path / "log.bag")
    why = r"log\.bag cannot be read \(Bag is not indexed\); record it again, as no message is found"
    for size in (4200, 4109):  # in the first record of the first chunk, and after the header
        os.truncate(path, size)
        with pytest.raises(LogError, match=why):
            open_recording(without_index(path))


def test_losses_outside_the_part_that_is_read_are_not_its_losses():
    lost = [LostMessage(None, time, "broken") for time in (30, 10, 20)]
    assert [item.log_time for item in within(lost, 10, 30)] == [10, 20]
    assert [item.log_time for item in within(lost, None, None)] == [10, 20, 30]


def test_a_chunk_is_let_go_after_its_last_message():
    class Chunk:
        def __len__(self):
            return 1

    def unpack(number):
        alive.add(chunk := Chunk())
        return chunk

    alive, due = WeakSet(), np.array([0, 1, 0, 1, 1])
    chunks = OpenChunks(due, unpack)
    assert [bool(chunks.of_next(number)) and len(alive) for number in due] == [1, 2, 1, 1, 0]
