"""The frame assembler: turns the messages of a log, in the order of log time, into frames for the engine.

It runs the aligners and enters losses into the ledger. A frame is ready when every stream that no stage makes has its
value for that stamp, so frames start complete and in the order of stamps. Where a stamp jumps ahead, the next message
of its stream decides whether it is damaged; until then the log is read ahead.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from numbers import Integral
from operator import index
from typing import Any

from flow.align import Answers, Token
from flow.contracts import Absent, Event, Loss, LossReason, StageError, nearest
from flow.runtime.frame_selection import Every, FrameSelection
from flow.runtime.graph import Graph, frozen
from flow.runtime.ledger import Ledger

SUSPECT_JUMP = 1_000_000_000  # ns; a stamp that gains more than this on the log's clock is suspect
DAMAGED_JUMP = 10_000_000_000  # ns; a suspect stamp is damaged unless the next one is as far ahead, within this
MAX_READ_AHEAD = 128  # messages
SET_BACK = "; if a clock was set back, run the rest of the log separately (--start, a second later)"


@dataclass(frozen=True)
class ReadyFrame:
    """A frame for the engine: its values by stream, and the losses since the frame before."""

    stamp: int
    values: dict[str, Any]
    entries: list[Loss]


@dataclass(eq=False)
class _Message:
    """An event of a log. fault: what is wrong with its stamp; suspect: whether the next stamp may still clear it."""

    log_time: int
    stream: str
    item: Any
    fault: str = ""
    suspect: bool = False

    @property
    def ahead(self) -> int:
        """How far the stamp is ahead of the log's clock, ns."""
        return int(self.item.stamp) - self.log_time


class _StampCheck:
    """Checks that the stamps of one stream increase. One damaged stamp must not exclude all messages after it."""

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._last: _Message | None = None  # the last message with a valid stamp
        self._suspect: _Message | None = None

    def check(self, message: _Message) -> None:
        """Set the fault of a message, and decide about a suspect one before it.

        If the stamps continue from a jump, they are valid: messages were logged late, or a clock was set.
        """
        stamp, suspect = message.item.stamp, self._suspect
        if suspect is not None:
            self._decide(suspect, stamp > suspect.item.stamp and message.ahead - suspect.ahead <= DAMAGED_JUMP)
        last, jump = self._last, self._jump(message)
        if jump > SUSPECT_JUMP:
            message.fault = f"its stamp jumps {jump / 1e9:.1f} s ahead of the log's clock"
            message.suspect, self._suspect = True, message
        elif last is not None and stamp == last.item.stamp:
            message.fault = f"it repeats the stamp of the {self._stream} message before it"
        elif last is not None and stamp < last.item.stamp:
            back = last.item.stamp - stamp
            shown = f"{back / 1e6:.1f} ms" if back >= 100_000 else f"{back} ns"
            message.fault = f"its stamp is {shown} before that of the {self._stream} message read before it"
            message.fault += SET_BACK if back > DAMAGED_JUMP else ""
        else:
            self._last = message

    def tick(self, log_time: float) -> None:
        """Decide about a stamp that has been suspect for too long. A first stamp without a contradiction is valid."""
        suspect = self._suspect
        if suspect is not None and suspect.log_time + DAMAGED_JUMP < log_time:
            self._decide(suspect, self._last is None or self._jump(suspect) <= DAMAGED_JUMP)

    def _jump(self, message: _Message) -> int:
        """How much a stamp gains on the log's clock since the one before it, ns."""
        return message.ahead - (self._last.ahead if self._last is not None else 0)

    def _decide(self, suspect: _Message, valid: bool) -> None:
        self._suspect, suspect.suspect = None, False
        if valid:
            suspect.fault, self._last = "", suspect


def valid_event(event: Any, source: str, streams: Collection[str], log_time: int) -> Event:
    """An event of a source, or in its place one with the error that is wrong with it.

    streams: those that the source declares; log_time: that of the event before, ns.
    """
    try:
        log_time, stream, item = event
        log_time = index(log_time)
    except (TypeError, ValueError):
        return log_time, "log", StageError(f"{source} gave an event that is not (log time in whole ns, stream, item)")
    if isinstance(item, Exception):
        return log_time, stream, item
    if stream not in streams:
        meant = nearest(str(stream), streams)
        return log_time, str(stream), StageError(f"{source} declares no stream {str(stream)!r}{meant}")
    if not isinstance(getattr(item, "stamp", None), Integral):
        return log_time, stream, StageError(f"{source} gave an item whose 'stamp' is not in whole ns")
    return log_time, stream, frozen(item, copies=not source.startswith("recordings."))


def _checked(events: Iterable[Event], streams: set[str]) -> Iterator[_Message]:
    """The events in their order, with the faults of the stamps of `streams`."""
    checks = {stream: _StampCheck(stream) for stream in sorted(streams)}
    waiting = deque[_Message]()
    for event in events:
        message = _Message(*event)
        if waiting:
            for check in checks.values():
                check.tick(message.log_time)
        if message.stream in checks and not isinstance(message.item, Exception):
            checks[message.stream].check(message)
        waiting.append(message)
        if len(waiting) == MAX_READ_AHEAD:
            for check in checks.values():
                check.tick(math.inf)
        while waiting and not waiting[0].suspect:
            yield waiting.popleft()
    for check in checks.values():
        check.tick(math.inf)
    yield from waiting


class FrameAssembler:
    """Makes frames of one log with the aligners of a graph. selection: the frames to take, by default all."""

    def __init__(self, graph: Graph, ledger: Ledger, selection: FrameSelection | None = None) -> None:
        self._ledger, self._selection, self._clock = ledger, selection or FrameSelection(Every()), graph.clock
        self._aligners = {n.name: n.actor.start(n.name, dict(n.inputs)) for n in graph.aligners}
        self._ports: dict[str, list[tuple[str, str]]] = {}
        for node in graph.aligners:
            for port, stream in node.inputs.items():
                self._ports.setdefault(stream, []).append((node.name, port))
        self.wanted = graph.source_streams | {*filter(None, [self._selection.odometry])}
        made = {node.name for node in graph.stages}
        self._entry_streams = [stream for stream in graph.frame_streams if stream not in made]
        self._waiting: dict[str, deque[Token]] = {stream: deque() for stream in self._entry_streams}
        self._entries: list[Loss] = []
        self.messages: Counter[str] = Counter()

    def frames(self, events: Iterable[Event]) -> Iterator[ReadyFrame]:
        """The frames of the log, as soon as each is ready."""
        log_time = 0
        for message in _checked(events, self.wanted):
            log_time, stream, item = message.log_time, message.stream, message.item
            for name, aligner in self._aligners.items():
                self._answer(name, log_time, aligner.tick(log_time))
            if isinstance(item, Exception):
                self._lose(Loss(stream, log_time, "source", LossReason.UNREADABLE, str(item) or type(item).__name__))
            elif stream in self.wanted:
                self.messages[stream] += 1
                if message.fault:
                    self._lose(Loss(stream, item.stamp, "source", LossReason.OUT_OF_ORDER, message.fault))
                else:
                    if stream == self._selection.odometry:
                        self._selection.note(item)
                    if not self._leaves_out(stream, item.stamp):
                        self._take(stream, log_time, Token(item.stamp, item))
            yield from self._ready()
        for name, aligner in self._aligners.items():
            self._answer(name, log_time, aligner.end())
        yield from self._ready()

    @property
    def late_entries(self) -> list[Loss]:
        """The losses after the last frame that entered the engine."""
        tokens = [token for queue in self._waiting.values() for token in queue]
        return [*self._entries, *(token.value.cause for token in tokens if isinstance(token.value, Absent))]

    def give_back(self, frame: ReadyFrame) -> None:
        """Take back a frame that the engine did not admit, so that its losses count as late entries."""
        for stream, value in frame.values.items():
            self._waiting[stream].appendleft(Token(frame.stamp, value))
        self._entries = [*frame.entries, *self._entries]

    def drop(self, frame: ReadyFrame, why: str) -> None:
        """Count a frame that the engine did not admit as lost; its own losses go to the next frame."""
        causes = [value.cause for value in frame.values.values() if isinstance(value, Absent)]
        self._entries = [*frame.entries, *causes, *self._entries]
        self._lose(Loss("frame", frame.stamp, "engine", LossReason.DROPPED, why))

    def _take(self, stream: str, log_time: int, token: Token) -> None:
        """Give a token to the aligners that read its stream, and to its frame."""
        if stream in self._waiting:
            self._waiting[stream].append(token)
        for name, port in self._ports.get(stream, ()):
            self._answer(name, log_time, self._aligners[name].push(port, log_time, token))

    def _answer(self, name: str, log_time: int, answers: Answers) -> None:
        for answer in answers:
            if isinstance(answer, Loss):
                self._lose(answer)
            elif not self._leaves_out(name, answer.stamp):
                if isinstance(answer.value, Absent) and answer.value.cause.stage == name:
                    self._ledger.add(answer.value.cause)
                self._take(name, log_time, answer)

    def _leaves_out(self, stream: str, stamp: int) -> bool:
        """Whether a stamp of `stream` begins a frame that is left out."""
        return stream == self._clock and not self._selection.takes(stamp)

    def _lose(self, entry: Loss) -> None:
        self._entries.append(self._ledger.add(entry))

    def _ready(self) -> Iterator[ReadyFrame]:
        while self._entry_streams and all(self._waiting.values()):
            tokens = {stream: queue.popleft() for stream, queue in self._waiting.items()}
            stamp = next(iter(tokens.values())).stamp
            entries, self._entries = self._entries, []
            yield ReadyFrame(stamp, {stream: token.value for stream, token in tokens.items()}, entries)
