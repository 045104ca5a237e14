"""One log: the messages of one or several files, merged in the order of log time.

Where the recorder's clock was set, a file is read as two parts, each with its own correction of the log times. Files
and parts are opened when their time comes, so memory does not grow with their number.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import Any

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from recordings.containers.clock import ClockStep, clock_steps, split
from recordings.containers.container import Channel, Container, LostMessage, RawMessage
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


@dataclass(frozen=True)
class _Part:
    """A stretch of a file between two steps of the recorder's clock. places: in the file."""

    file: Container
    numbers: Numbers
    places: range
    step: ClockStep

    @property
    def whole(self) -> bool:
        return len(self.places) == len(self.file.timeline)

    @cached_property
    def ends(self) -> tuple[int, int]:
        """No message of the part is earlier than the first log time, and none later than the last, ns."""
        start, end = self.file.start, self.file.end
        if not self.whole:
            times = self.file.timeline.log_times[self.places.start : self.places.stop]
            start, end = int(np.min(times[times >= 0], initial=end)), int(np.max(times, initial=start))
        return start + self.step.shift, end + self.step.shift

    def times(self, channels: set[int], allow_repeats: bool) -> NDArray[np.int64]:
        """The log times of some channels of the recording, ns, in any order."""
        known = self.file.timeline.by_channel
        inside = (self._inside(known[channel]) for channel in _of_file(self.numbers, channels) & known.keys())
        times = np.concatenate([np.zeros(0, np.int64), *(self.file.timeline.log_times[places] for places in inside)])
        if self.step.repeats_until and not allow_repeats:
            times = times[times >= self.step.repeats_until]
        times += self.step.shift
        return times

    def _inside(self, places: Places) -> Places:
        """Those of some sorted places that are in the part."""
        first, last = np.searchsorted(places, [self.places.start, self.places.stop])
        return places[first:last]

    def messages(
        self, channels: set[int], start: int | None, end: int | None, allow_repeats: bool
    ) -> Iterator[RawMessage | LostMessage]:
        """The messages of some channels of the recording, in log-time order."""
        own = _of_file(self.numbers, channels)
        low, high = (None if time is None else max(time - self.step.shift, 0) for time in (start, end))
        for item in self.file.messages(own, low, high, None if self.whole else self.places):
            channel = None if item.channel is None else self.numbers[item.channel]
            log_time = item.log_time + self.step.shift
            if isinstance(item, LostMessage):
                yield LostMessage(channel, log_time, item.reason)
            elif item.log_time < self.step.repeats_until and not allow_repeats:
                yield LostMessage(channel, log_time, _repeated(self.step))
            elif channel is not None:
                yield RawMessage(channel, log_time, item.data)


def _repeated(step: ClockStep) -> str:
    return (
        f"the recorder's clock and the header stamps were set back by at least {step.fall / 1e9:.3g} s: times repeat, "
        "so messages are lost until the clock is 1 s past its old time"
    )


class Recording:
    """The messages of one or several files as one log; use it as a context manager.

    path: what the user gave, the file or the folder; files: in the order in which they were recorded; missing:
    sentences about files that are not there, whose messages are lost; part: a sentence if the path is only one of
    several files of a recording; on_close: closes the files. channels: of all files by number, a topic may have
    several; stamped: those whose messages begin with a header; start, end: log time of the first and the last
    message, ns.
    """

    def __init__(
        self,
        path: Path,
        files: Sequence[Container],
        missing: Sequence[str],
        part: str,
        on_close: Callable[[], object],
    ) -> None:
        self.path, self.files, self.part, self._missing = path, files, part, missing
        self._on_close = on_close
        self.size = sum(file.size for file in files)
        self.channels, self._numbers = _merged_channels(files)
        self.stamped = {number for number, channel in self.channels.items() if begins_with_header(channel)}
        try:
            self.start = min(part.ends[0] for part in self._parts)
            self.end = max(part.ends[1] for part in self._parts)
        except BaseException:
            self.close()
            raise

    @property
    def lost(self) -> list[LostMessage]:
        """The damage found so far."""
        found = ((file, item) for file in self.files for item in file.lost)
        gone = [LostMessage(None, self.end, why) for why in self._missing]
        return gone + [LostMessage(None, item.log_time, self._named(file, item.reason)) for file, item in found]

    @property
    def notes(self) -> list[str]:
        """Sentences: that the path is only a part, and that log times are corrected."""
        shifts = {part.step.shift for part in self._parts} - {0}
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
        """The messages of all parts, in log-time order."""
        begun = list[Iterator[RawMessage | LostMessage] | None]([None] * len(self._parts))
        queue: list[tuple[int, int, Any]] = [(part.ends[0], number, None) for number, part in enumerate(self._parts)]
        heapify(queue)
        while queue:
            log_time, number, item = heappop(queue)
            if end is not None and log_time >= end and item is None:
                continue
            if item is not None:
                yield item
            items = begun[number]
            if items is None:
                items = begun[number] = self._read(self._parts[number], channels, start, end, allow_repeats)
            if (following := next(items, None)) is not None:
                heappush(queue, (following.log_time, number, following))
        if end is None:
            yield from (LostMessage(None, self.end, why) for why in self._missing)

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
                yield item if item.channel is None else item._replace(channel=numbers[item.channel])

    def times(self, channels: set[int], allow_repeats: bool = False) -> NDArray[np.int64]:
        """The sorted log times of some channels, ns; by default without those that repeat."""
        times = np.concatenate([part.times(channels, allow_repeats) for part in self._parts])
        times.sort()
        return times

    def count(self, channels: set[int]) -> int:
        """The number of messages in some channels."""
        found = zip(self.files, self._numbers, strict=True)
        return sum(file.count(_of_file(numbers, channels)) for file, numbers in found)

    def close(self) -> None:
        """Close the files."""
        self._on_close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _named(self, file: Container, reason: str) -> str:
        return f"{file.path.name}: {reason}" if len(self.files) > 1 else reason

    def _read(self, part: _Part, *which: Any) -> Iterator[RawMessage | LostMessage]:
        for item in part.messages(*which):
            if isinstance(item, LostMessage):
                item = item._replace(reason=self._named(part.file, item.reason))
            yield item

    @cached_property
    def _parts(self) -> list[_Part]:
        """The parts of all files, in the order in which they were recorded."""
        parts, first = list[_Part](), 0
        steps = self._steps()
        for file, numbers in zip(self.files, self._numbers, strict=True):
            size = len(file.timeline)
            for places, step in split(steps, first, size):
                parts.append(_Part(file, numbers, places, step))
            first += size
        return parts

    def _steps(self) -> list[ClockStep]:
        """The steps of the recorder's clock over all files; their places are counted through the files.

        They are judged by channel: two channels of a topic, such as results beside inputs, are stored independently.
        """
        timelines = [file.timeline for file in self.files]
        firsts = [0, *np.cumsum([len(timeline) for timeline in timelines]).tolist()]  # places in the recording

        def stamp_at(place: int) -> int:
            number = int(np.searchsorted(firsts, place, side="right")) - 1
            return _stamp_at(self.files[number], place - firsts[number])

        if len(self.files) == 1:
            return clock_steps(timelines[0], self.stamped, stamp_at)
        channels = list[NDArray[np.int32]]()
        for numbers, timeline in zip(self._numbers, timelines, strict=True):
            merged_of = np.full(np.max(timeline.channels, initial=0) + 1, -1, np.int32)  # -1: of no known channel
            for own, number in numbers.items():
                merged_of[own : own + 1] = number
            channels.append(merged_of[timeline.channels])
        merged = Timeline(np.concatenate(channels), np.concatenate([timeline.log_times for timeline in timelines]))
        return clock_steps(merged, self.stamped, stamp_at)


def _stamp_at(file: Container, place: int) -> int:
    """The header stamp of the message at a place of a file; 0 if a damaged index gives it another log time."""
    channel = int(file.timeline.channels[place])
    for item in file.messages({channel}, places=range(place, place + 1)):
        if isinstance(item, RawMessage) and item.log_time == file.timeline.log_times[place]:
            return peek_stamp(item.data, file.channels[channel].message_encoding)
    return 0
