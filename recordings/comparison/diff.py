"""The first stream and stamp where two result logs part, and by how much."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import unified_diff
from heapq import merge
from itertools import groupby, zip_longest
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from recordings.comparison.measures import Measures, measures
from recordings.containers.container import Channel, LostMessage
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
        logs = first, second
        topics = {channel.topic for log in logs for channel in log.channels.values() if _is_result(channel)}
        found.topics = {topic: TopicDiff() for topic in _in_order(topics, about[one]["pipeline"])}
        for change in _changes(logs, found.topics):
            found.topics[change.topic].add(change)
            on_change(change)
            found.first = found.first or (change.topic, change.stamp)
    return found


class _Message(NamedTuple):
    """A message of the first or the second result: 0 or 1."""

    stamp: int
    result: int
    channel: Channel
    data: bytes


def _messages(log: McapFile, result: int) -> Iterator[_Message]:
    """The messages under /nav, in the order of stamps."""
    for raw in log.messages({number for number, channel in log.channels.items() if _is_result(channel)}):
        if isinstance(raw, LostMessage):
            raise LogError(f"{log.path}: {raw.reason}; run the pipeline again")
        yield _Message(raw.log_time, result, log.channels[raw.channel], bytes(raw.data))


def _is_result(channel: Channel) -> bool:
    return channel.topic.startswith("/nav/")


def _changes(logs: Sequence[McapFile], topics: Mapping[str, TopicDiff]) -> Iterator[MessageDifference]:
    """The messages that differ, by stamp and then in the order of `topics`; messages that both have are counted."""
    messages = merge(*(_messages(log, result) for result, log in enumerate(logs)), key=attrgetter("stamp"))
    for stamp, group in groupby(messages, key=attrgetter("stamp")):
        found: dict[str, tuple[list[_Message], list[_Message]]] = {topic: ([], []) for topic in topics}
        for message in group:  # the last frame has two messages of diagnostics
            found[message.channel.topic][message.result].append(message)
        for topic, a, b in ((topic, a, b) for topic, both in found.items() for a, b in zip_longest(*both)):
            topics[topic].messages += a is not None and b is not None
            if (a and a.data) == (b and b.data):
                continue
            one, other = (None if message is None else _decoded(message) for message in (a, b))
            schema = a.channel.schema if a is not None and b is not None else None
            values = {} if schema is None else measures(schema.name, one, other)
            yield MessageDifference(topic, stamp, one, other, values)


def _decoded(message: _Message) -> Any:
    schema = message.channel.schema
    return message.data if schema is None else decoder_for(schema.name, schema.encoding, schema.text)(message.data)


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
