"""One log: the messages of one or several files, merged in the order of log time.

Their timelines are one, in which log times are corrected where the recorder's clock was set. A file is read when its
messages are due, so memory does not grow with the number of files.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from recordings.containers.clock import ClockStep, clock_steps, corrected
from recordings.containers.container import (
    Channel,
    Container,
    LostMessage,
    RawMessage,
    blocks,
    log_time_of,
    within,
)
from recordings.containers.header import begins_with_header, peek_stamp
from recordings.containers.timeline import Places, Timeline

_MAX_REMEMBERED = 32  # messages of a topic, to leave out those that were recorded twice

Numbers = Mapping[int, int]  # number of a channel in a file -> number in the recording


def _of_file(numbers: Numbers, channels: set[int]) -> set[int]:
    """The file's numbers of some channels of the recording."""
    return {own for own, number in numbers.items() if number in channels}


def _merged_channels(files: Sequence[Container]) -> tuple[dict[int, Channel], list[Numbers]]:
    """The channels of all files, and their numbers in each. Equal channels of several files are one."""
    merged, numbers, known = dict[int, Channel](), list[Numbers](), dict[Any, list[int]]()
    for file in files:
        own, taken = dict[int, int](), set[int]()
        for number, channel in file.channels.items():
            same = known.setdefault((channel.topic, channel.message_encoding, channel.schema), [])
            free = next((other for other in same if other not in taken), None)
            if free is None:
                free = number if number not in merged else max(merged) + 1
                merged[free] = replace(channel, number=free)
                same.append(free)
            own[number] = free
            taken.add(free)
        numbers.append(own)
    return merged, numbers


def _repeated(step: ClockStep) -> str:
    return (
        f"the recorder's clock and the header stamps were set back by at least {step.fall / 1e9:.3g} s: times repeat, "
        "so messages are lost until the clock is 1 s past its old time"
    )


class Recording(AbstractContextManager["Recording"]):
    """The messages of one or several files as one log; use it as a context manager.

    path: what the user gave, the file or the folder; files: in the order in which they were recorded; missing:
    sentences about files that are not there, whose messages are lost; part: a sentence if the path is only one of
    several files of a recording; on_close: closes the files. channels: of all files by number, a topic may have
    several; stamped: those whose messages begin with a header; start, end: log time of the first and the last
    message, ns.
    """

    def __init__(
        self, path: Path, files: Sequence[Container], missing: Sequence[str], part: str, on_close: Callable[[], object]
    ) -> None:
        self.path, self.files, self.part, self._missing = path, files, part, missing
        self._on_close = on_close
        self.size = sum(file.size for file in files)
        self.channels, self._numbers = _merged_channels(files)
        self.stamped = {number for number, channel in self.channels.items() if begins_with_header(channel)}
        self._firsts = np.cumsum([0, *(len(file.timeline) for file in files)])  # the places at which files begin
        try:
            stored = self._stored_timeline()
            self._steps = clock_steps(stored, self.stamped, self._stamp_at)
            self._timeline, self._repeated = corrected(stored, self._steps)
            times = self._timeline.log_times[self._timeline.log_times >= 0]
            self.start, self.end = int(np.min(times)), int(np.max(times))
        except BaseException:
            self.close()
            raise

    @property
    def lost(self) -> list[LostMessage]:
        """The damage found so far."""
        return self._losses(set())

    @property
    def notes(self) -> list[str]:
        """Sentences: that the path is only a part, and that log times are corrected."""
        shifts = {step.shift for step in self._steps} - {0}
        remedy = "and its log times are corrected by header stamps"
        corrected = [f"the recorder's clock was set back by {shift / 1e9:.3g} s, {remedy}" for shift in sorted(shifts)]
        return [*filter(None, [self.part]), *corrected]

    @property
    def profile(self) -> str:
        """The profile that the files state."""
        return self.files[0].profile

    @property
    def indexed(self) -> bool:
        """Whether all files have a valid index."""
        return all(file.indexed for file in self.files)

    def channels_of(self, topics: Iterable[str]) -> set[int]:
        """The channels of some topics."""
        return {number for topic in set(topics) for number in self._by_topic.get(topic, ())}

    @cached_property
    def _by_topic(self) -> dict[str, list[int]]:
        found = defaultdict[str, list[int]](list)
        for number, channel in self.channels.items():
            found[channel.topic].append(number)
        return found

    def messages(
        self, channels: set[int], start: int | None = None, end: int | None = None, allow_repeats: bool = False
    ) -> Iterator[RawMessage | LostMessage]:
        """Read the messages of `channels` with start <= log time < end, ns, in log-time order (ties: in file order).

        A `LostMessage` stands for lost messages, also for those whose times repeat because all clocks were set back;
        with `allow_repeats` these are kept. A message that was recorded twice is read once.
        """
        seen = defaultdict[str, deque[tuple[int, int]]](lambda: deque(maxlen=_MAX_REMEMBERED))
        for item in self._merged(channels, start, end, allow_repeats):
            if isinstance(item, RawMessage) and item.channel in self.stamped:
                channel = self.channels[item.channel]
                if stamp := peek_stamp(item.data, channel.message_encoding):
                    known, this = seen[channel.topic], (stamp, crc32(item.data))
                    if this in known:
                        continue
                    known.append(this)
            yield item

    def _merged(
        self, channels: set[int], start: int | None, end: int | None, allow_repeats: bool
    ) -> Iterator[RawMessage | LostMessage]:
        """The messages of all files, in log-time order."""
        lost = within(self._losses(channels), start, end)
        found = self._read(self._timeline.chosen(channels, start, end), allow_repeats)
        return merge(found, lost, key=log_time_of) if lost else found

    def _losses(self, channels: set[int]) -> list[LostMessage]:
        """The damage, and the messages of some channels whose log time is damaged."""
        lost = [LostMessage(None, self.end, why) for why in self._missing]
        for file, numbers in zip(self.files, self._numbers, strict=True):
            lost += [self._of_recording(file, numbers, item) for item in file.losses(_of_file(numbers, channels))]
        return lost

    def _read(self, places: Places, allow_repeats: bool) -> Iterator[RawMessage | LostMessage]:
        """The messages at some places, in that order."""
        of_file = np.searchsorted(self._firsts, places, "right") - 1
        readers = [
            file.read(places[of_file == number] - self._firsts[number]) for number, file in enumerate(self.files)
        ]
        if len(readers) == 1 and not self._steps:
            yield from readers[0]
            return
        for block, numbers in zip(blocks(places), blocks(of_file), strict=True):
            times, repeated = self._timeline.log_times[block].tolist(), self._repeated[block].tolist()
            for place, number, time, repeats in zip(block.tolist(), numbers.tolist(), times, repeated, strict=True):
                item = self._of_recording(self.files[number], self._numbers[number], next(readers[number]))
                if repeats and not allow_repeats:
                    step = self._steps[bisect_right(self._steps, place, key=attrgetter("place")) - 1]
                    item = LostMessage(item.channel, time, _repeated(step))
                yield item._replace(log_time=time)

    def heads(self, channels: set[int]) -> Iterator[RawMessage | LostMessage]:
        """At least the first bytes of some messages, with their headers, in any order and not verified.

        Messages that do not begin with a header are read as a whole.
        """
        if not channels <= self.stamped:
            yield from self.messages(channels)
            return
        for file, numbers in zip(self.files, self._numbers, strict=True):
            own = _of_file(numbers, channels)
            for item in file.heads(own) if own else ():
                yield self._of_recording(file, numbers, item)

    def times(self, channels: set[int], allow_repeats: bool = False) -> NDArray[np.int64]:
        """The sorted log times of some channels, ns; by default without those that repeat."""
        places = self._timeline.places_of(channels)
        return np.sort(self._timeline.log_times[places if allow_repeats else places[~self._repeated[places]]])

    def count(self, channels: set[int]) -> int:
        """The number of messages in some channels."""
        return self._timeline.count(channels)

    def close(self) -> None:
        """Close the files."""
        self._on_close()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _of_recording(self, file: Container, numbers: Numbers, item: Any) -> Any:
        """A message of a file with the number of its channel in the recording; a loss names the file."""
        channel = None if item.channel is None else numbers[item.channel]
        if isinstance(item, LostMessage):
            named = f"{file.path.name}: {item.reason}" if len(self.files) > 1 else item.reason
            return LostMessage(channel, item.log_time, named)
        return item._replace(channel=channel)

    def _stored_timeline(self) -> Timeline:
        """The timeline of all files, as the recorder's clock had it.

        Two channels of a topic, such as results beside inputs, are stored independently and stay two.
        """
        timelines = [file.timeline for file in self.files]
        if len(timelines) == 1:
            return timelines[0]
        channels = list[NDArray[np.int32]]()
        for numbers, timeline in zip(self._numbers, timelines, strict=True):
            merged_of = np.full(np.max(timeline.channels, initial=0) + 1, -1, np.int32)  # -1: of no known channel
            for own, number in numbers.items():
                merged_of[own : own + 1] = number
            channels.append(merged_of[timeline.channels])
        return Timeline(np.concatenate(channels), np.concatenate([timeline.log_times for timeline in timelines]))

    def _stamp_at(self, place: int) -> int:
        """The header stamp of the message at a place; 0 if it cannot be read."""
        number = int(np.searchsorted(self._firsts, place, "right")) - 1
        file, place = self.files[number], place - int(self._firsts[number])
        item = next(file.read(np.array([place])))
        if isinstance(item, LostMessage):
            return 0
        return peek_stamp(item.data, file.channels[item.channel].message_encoding)
