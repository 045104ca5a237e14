"""The first stream and stamp where two result logs part, and by how much."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import unified_diff
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from recordings.comparison.measures import Measures, measures
from recordings.containers.container import LostMessage
from recordings.errors import LogError
from recordings.mcap.file import McapFile
from recordings.ros2.cdr import decoder_for
from recordings.scoring.result_log import check_profile, facts_of


class MessageDifference(NamedTuple):
    """One topic at one stamp. one, other: the messages, None where a result has none; values: how much they differ."""

    topic: str
    stamp: int
    one: Any
    other: Any
    values: Measures


@dataclass
class TopicDiff:
    """A topic in two results.

    Attributes
    ----------
    messages : int
        Stamps that both results have.
    differing : int
        Those at which the bytes differ.
    only_one, only_other : int
        Stamps that only one of the results has.
    first : int or None
        Stamp, ns, of the first difference.
    worst : dict
        The largest of each of `recordings.comparison.measures`, over all stamps.
    """

    messages: int = 0
    differing: int = 0
    only_one: int = 0
    only_other: int = 0
    first: int | None = None
    worst: Measures = field(default_factory=dict)

    def add(self, change: MessageDifference) -> None:
        """Count a difference."""
        self.only_one += change.other is None
        self.only_other += change.one is None
        self.differing += change.one is not None and change.other is not None
        self.first = change.stamp if self.first is None else min(self.first, change.stamp)
        for name, value in change.values.items():
            self.worst[name] = max(value, self.worst.get(name, 0.0))


@dataclass
class Diff:
    """What differs between two results.

    Attributes
    ----------
    first : tuple of (str, int) or None
        Topic and stamp, ns, at which the results part; of topics that part at one stamp the first in the pipeline.
    topics : dict
        Topic -> `TopicDiff`, in the order of the pipeline.
    facts : dict
        Fact of the run -> its values in both results, where these differ. The pipelines are a unified diff.
    """

    first: tuple[str, int] | None = None
    topics: dict[str, TopicDiff] = field(default_factory=dict)
    facts: dict[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def equal(self) -> bool:
        """Whether both results have the same messages under /nav, byte by byte."""
        return self.first is None


def diff(
    one: Path | str, other: Path | str, on_change: Callable[[MessageDifference], None] = lambda change: None
) -> Diff:
    """Compare the results, all topics under /nav, of two result logs. Their transforms follow from these.

    Parameters
    ----------
    one, other : Path
        Result logs of `roverflow run`.
    on_change : callable
        Called with each `MessageDifference`, in the order of stamps.

    Returns
    -------
    Diff
        What differs.

    Raises
    ------
    LogError
        If a log cannot be read, or is not a result log.

    Examples
    --------
    >>> from pathlib import Path
    >>> diff(Path("a.mcap"), Path("b.mcap")).first  # doctest: +SKIP
    ('/nav/elevation_map', 1700086400013000000)
    """
    one, other = Path(one), Path(other)
    about = {path: facts_of(path, "two logs that roverflow run wrote") for path in (one, other)}
    for path, facts in about.items():
        check_profile(path, facts)
    found = Diff(facts=_facts(about[one], about[other]))
    with McapFile(one) as first, McapFile(other) as second:
        readers = _Reader(first), _Reader(second)
        topics = {topic for reader in readers for topic in reader.topics.values()}
        found.topics = {topic: TopicDiff() for topic in _in_order(topics, about[one]["pipeline"])}
        for change in _changes(*readers, found.topics):
            found.topics[change.topic].add(change)
            on_change(change)
            found.first = found.first or (change.topic, change.stamp)
    return found


class _Reader:
    """Reads the results of a log by groups of one stamp. topics: of the results, by the numbers of their channels."""

    def __init__(self, log: McapFile) -> None:
        self.log = log
        channels = log.channels.items()
        self.topics = {number: channel.topic for number, channel in channels if channel.topic.startswith("/nav/")}

    def groups(self) -> Iterator[tuple[int, dict[str, tuple[int, bytes]]]]:
        """(Stamp, topic -> number of its channel and bytes)."""
        for stamp, group in groupby(self.log.messages(set(self.topics)), key=lambda raw: raw.log_time):
            messages = dict[str, tuple[int, bytes]]()
            for raw in group:
                if isinstance(raw, LostMessage):
                    raise LogError(f"{self.log.path}: {raw.reason}; run the pipeline again")
                messages[self.topics[raw.channel]] = (raw.channel, bytes(raw.data))
            yield stamp, messages

    def schema(self, number: int) -> str:
        schema = self.log.channels[number].schema
        return "" if schema is None else schema.name

    def decoded(self, number: int, data: bytes) -> Any:
        schema = self.log.channels[number].schema
        if schema is None:
            return data
        return decoder_for(schema.name, schema.encoding, schema.text)(data)


def _changes(one: _Reader, other: _Reader, topics: Mapping[str, TopicDiff]) -> Iterator[MessageDifference]:
    """The messages that differ, by stamp and then in the order of `topics`; messages that both have are counted."""
    for stamp, first, second in _aligned(one.groups(), other.groups()):
        for topic in topics:
            a, b = first.get(topic), second.get(topic)
            topics[topic].messages += a is not None and b is not None
            if (a and a[1]) == (b and b[1]):
                continue
            decoded = [None if item is None else log.decoded(*item) for log, item in ((one, a), (other, b))]
            values = measures(one.schema(a[0]), *decoded) if a is not None and b is not None else {}
            yield MessageDifference(topic, stamp, decoded[0], decoded[1], values)


def _aligned(
    one: Iterator[tuple[int, dict[str, Any]]], other: Iterator[tuple[int, dict[str, Any]]]
) -> Iterator[tuple[int, dict[str, Any], dict[str, Any]]]:
    """(Stamp, group of one, group of the other) of all stamps; a missing group is empty."""
    a, b = next(one, None), next(other, None)
    while a is not None or b is not None:
        if b is None or (a is not None and a[0] < b[0]):
            assert a is not None  # by the condition of the loop
            yield a[0], a[1], {}
            a = next(one, None)
        elif a is None or b[0] < a[0]:
            yield b[0], {}, b[1]
            b = next(other, None)
        else:
            yield a[0], a[1], b[1]
            a, b = next(one, None), next(other, None)


def _in_order(topics: set[str], pipeline: str) -> list[str]:
    """The topics in the order of the pipeline's streams."""
    try:
        streams = list(yaml.safe_load(pipeline)["streams"])
    except (yaml.YAMLError, TypeError, KeyError):  # another version of roverflow wrote it
        streams = []
    order = {stream: place for place, stream in enumerate(streams)}

    def place(topic: str) -> tuple[int, str]:
        stream = topic.removeprefix("/nav/").partition("/")[0]
        return order.get(stream, len(order)), topic

    return sorted(topics, key=place)


def _facts(one: Mapping[str, str], other: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """The facts of the runs that differ."""
    names = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    found = {name: (one.get(name, ""), other.get(name, "")) for name in names}
    if "pipeline" in found:
        before, after = (text.splitlines() for text in found["pipeline"])
        changed = [line for line in unified_diff(before, after, n=0) if not line.startswith(("---", "+++", "@@"))]
        removed, added = (
            "\n".join(line[1:] for line in changed if line[0] == sign and line[1:].strip()) for sign in "-+"
        )
        found["pipeline"] = (removed, added)
    return found
