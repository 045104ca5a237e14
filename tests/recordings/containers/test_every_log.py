"""Every published log at hand is read to exactly the messages that another reader finds, or refused in a sentence."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Bag1Reader
from rosbags.rosbag2 import Reader as Bag2Reader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from recordings.containers.opening import open_recording
from recordings.errors import LogError
from recordings.inventory.text import format_description
from tests.conftest import data_folder
from tests.recordings.sample_log import inventory_of, items_of

Message = tuple[int, str, bytes]  # log time, topic, data


def conformance(path: Path) -> list[Message]:
    """The messages that the JSON beside a file of the conformance suite lists."""
    topics, found = dict[str, str](), list[Message]()
    for record in json.loads(path.with_suffix(".json").read_text())["records"]:
        fields = dict(record["fields"])
        if record["type"] == "Channel":
            topics[fields["id"]] = fields["topic"]
        elif record["type"] == "Message":
            found.append((int(fields["log_time"]), topics[fields["channel_id"]], bytes(map(int, fields["data"]))))
    return sorted(found)


def by_rosbags(reader: Any) -> list[Message]:
    """The messages that a reader of the rosbags library finds."""
    reader.open()
    try:
        found = list(reader.messages(reader.connections)) if reader.connections else []
        return sorted((time, connection.topic, bytes(data)) for connection, time, data in found)
    finally:
        reader.close()


def by_each_file(suffix: str, reader: Callable[[Path], Any]) -> Callable[[Path], list[Message]]:
    return lambda folder: sorted(m for path in folder.glob(f"*{suffix}") for m in by_rosbags(reader(path)))


READERS: list[tuple[str, str, int, Callable[[Path], list[Message]]]] = [
    ("conformance", "*/*.mcap", 205, conformance),
    ("rosbag2", "*.mcap", 20, lambda path: by_rosbags(McapReader(path))),
    ("rosbag2", "*/*.mcap", 8, lambda path: by_rosbags(McapReader(path))),
    ("rosbag2", "*/*.db3", 8, lambda path: by_rosbags(Sqlite3Reader(path))),
    ("rosbag2", "*-wbag", 2, lambda path: by_rosbags(Bag2Reader(path))),
    ("rosbag2", "mcap-multiple_files", 1, by_each_file(".mcap", McapReader)),
    ("rosbag2", "sqlite3-multiple_files", 1, by_each_file(".db3", Sqlite3Reader)),
    ("field", "*.mcap", 1, lambda path: by_rosbags(McapReader(path))),
    ("ros1", "example*.bag", 4, lambda path: by_rosbags(Bag1Reader(path))),
]


@pytest.mark.parametrize(
    ("folder", "pattern", "number", "expected"), READERS, ids=[f"{row[0]}-{row[1]}" for row in READERS]
)
def test_every_log_is_read_to_the_messages_that_another_reader_finds(folder, pattern, number, expected):
    paths = sorted(data_folder(f"logs/{folder}").glob(pattern))
    assert len(paths) == number
    for path in paths:
        wanted = expected(path)
        if not wanted:
            with pytest.raises(LogError, match="contains no messages"):
                open_recording(path)
            continue
        with open_recording(path) as log:
            items = list(log.messages(set(log.channels)))
            read = [(item.log_time, log.channels[item.channel].topic, bytes(item.data)) for item in items]
            assert log.count(set(log.channels)) == len(log.times(set(log.channels))) == len(wanted)
            assert (log.start, log.end) == (wanted[0][0], wanted[-1][0])
        assert [time for time, _, _ in read] == [time for time, _, _ in wanted]
        assert sorted(read) == wanted, path


@pytest.mark.parametrize(("name", "sentence"), [
    ("ros1/no-messages.bag", "contains no messages; record it again"),
    ("rosbag2/mcap-wbag/metadata.yaml", "only describes a recording; give its folder"),
])  # fmt: skip
def test_what_is_no_log_is_refused_in_a_sentence(name, sentence):
    path = data_folder("logs") / name
    with pytest.raises(LogError) as refused:
        open_recording(path)
    assert str(refused.value).startswith(f"{path} {sentence}")


def test_every_real_log_is_described_or_refused():
    refused = []
    paths = [path for path in sorted(data_folder("logs").rglob("*")) if path.suffix in (".mcap", ".db3", ".bag")]
    for path in paths:
        try:
            text = format_description(json.loads(json.dumps(inventory_of(path))))
        except LogError as error:
            refused.append(str(error))
            continue
        assert "missing: left" in text
        assert not [item for _, _, item in items_of(path) if isinstance(item, Exception)], path
    assert len(paths) >= 232
    assert len(refused) <= len(paths) // 10
    assert all("contains no messages" in text or "is empty" in text for text in refused)


def test_the_field_log_has_its_tilt_at_ten_hertz():
    path = data_folder("logs/field") / "SO_bag_0.mcap"
    tilts = [item for _, stream, item in items_of(path) if stream == "inclinometer"]
    assert len(tilts) == 161
    assert all(abs(np.linalg.norm(tilt.up) - 1) < 1e-9 for tilt in tilts)
