"""Digests of the messages of a log, topic by topic: of their stamps, lengths and CRC-32."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from pathlib import Path
from typing import Any

from isal import isal_zlib
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader


class Digests:
    """The digest of each topic so far."""

    def __init__(self) -> None:
        self._of: defaultdict[str, Any] = defaultdict(hashlib.sha1)

    def add(self, topic: str, stamp: int, data: bytes | memoryview) -> None:
        """Count the next message of a topic. stamp: its log time, ns."""
        self._of[topic].update(b"%d %d %d " % (stamp, len(data), isal_zlib.crc32(data)))

    def by_topic(self) -> dict[str, str]:
        """Topic -> its digest so far, hexadecimal."""
        return {topic: digest.hexdigest()[:32] for topic, digest in self._of.items()}


def digests_of(log: Path, copies: bool) -> dict[str, str]:
    """Topic -> digest of its messages. Raises mcap's errors if the log is damaged.

    copies: whether channels after the first one of a topic contain copies of inputs, which do not count.
    """
    digests, first, topics = Digests(), dict[str, int](), dict[int, str]()
    with log.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Channel) and (first.setdefault(record.topic, record.id) == record.id or not copies):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and record.channel_id in topics:
                digests.add(topics[record.channel_id], record.log_time, record.data)
    return digests.by_topic()
