"""The feeder: turns a log's messages, in log-time order, into frames ready for the engine.

It runs the aligners, keeps the ledger of what finds no place, and hands a frame on once every stream that no stage
makes has its value for that stamp, so that frames start whole and in stamp order. A stamp that jumps ahead is judged by
the next one of its stream, so there the log is read ahead.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from flow.align import Answers, Token
from flow.contracts import Absent, Event, Loss, LossReason
from flow.runtime.graph import Graph
from flow.runtime.ledger import Ledger

# ns; a stamp that runs ahead of the log's clock by this much more than the one before it is in doubt
DOUBT = 1_000_000_000
# ns; by so much more it is damaged, unless the next of its stream within as long is as far ahead
JUMP = 10_000_000_000
# messages that are read ahead, and kept, at most
AHEAD = 128
SET_BACK = "; if a clock was set back, run what follows by itself (--start, a second later)"


@dataclass(frozen=True)
class ReadyFrame:
    """A frame that may enter the engine: its values by stream, and the losses noticed since the frame before."""

    stamp: int
    values: dict[str, Any]
    entries: list[Loss]


@dataclass(eq=False)
class _Message:
    """An event of a log. fault: what is wrong with its stamp; doubted: whether the stream's next one may clear it."""

    log_time: int
    stream: str
    item: Any
    fault: str = ""
    doubted: bool = False

    @property
    def ahead(self) -> int:
        """How far the stamp runs ahead of the log's clock, ns."""
        return int(self.item.stamp) - self.log_time


class _Clock:
    """Judges the stamps of one stream, which must increase: one damaged stamp must not shut out all that follow."""

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._last: _Message | None = None  # the last one that was believed
        self._doubted: _Message | None = None

    def judge(self, message: _Message) -> None:
        """Find what is wrong with the stamp of a message, and settle what was in doubt.

        If what follows a jump goes on from there, messages were logged late, or a clock was set or is not the log's.
        """
        stamp, doubted = message.item.stamp, self._doubted
        if doubted is not None:
            self._settle(doubted, stamp > doubted.item.stamp and message.ahead - doubted.ahead <= JUMP)
        last, jump = self._last, self._jump(message)
        if jump > DOUBT:
            message.fault = f"its stamp jumps {jump / 1e9:.1f} s ahead of the log's clock"
            message.doubted, self._doubted = True, message
        elif last is not None and stamp == last.item.stamp:
            message.fault = f"it repeats the stamp of the {self._stream} message before it"
        elif last is not None and stamp < last.item.stamp:
            back = last.item.stamp - stamp
            message.fault = f"its stamp is {back / 1e6:.1f} ms before that of the {self._stream} message read before it"
            message.fault += SET_BACK if back > JUMP else ""
        else:
            self._last = message

    def tick(self, log_time: float) -> None:
        """Settle what has been in doubt for too long: a first stamp that none contradicts is believed."""
        doubted = self._doubted
        if doubted is not None and doubted.log_time + JUMP < log_time:
            self._settle(doubted, self._last is None or self._jump(doubted) <= JUMP)

    def _jump(self, message: _Message) -> int:
        """How much farther a stamp runs ahead of the log's clock than the one before it, ns."""
        return message.ahead - (self._last.ahead if self._last is not None else 0)

    def _settle(self, doubted: _Message, believed: bool) -> None:
        self._doubted, doubted.doubted = None, False
        if believed:
            doubted.fault, self._last = "", doubted


def _judged(events: Iterable[Event], streams: set[str]) -> Iterator[_Message]:
    """The events in their order; what is wrong with the stamps of `streams` stands in them."""
    clocks = {stream: _Clock(stream) for stream in sorted(streams)}
    waiting = deque[_Message]()
    for event in events:
        message = _Message(*event)
        for clock in clocks.values() if waiting else ():
            clock.tick(message.log_time)
        if message.stream in clocks and not isinstance(message.item, Exception):
            clocks[message.stream].judge(message)
        waiting.append(message)
        if len(waiting) == AHEAD:
            for clock in clocks.values():
                clock.tick(math.inf)
        while waiting and not waiting[0].doubted:
            yield waiting.popleft()
    for clock in clocks.values():
        clock.tick(math.inf)
    yield from waiting


class FrameAssembler:
    """Feeds the events of one log through the aligners of a graph."""

    def __init__(self, graph: Graph, ledger: Ledger) -> None:
        self._ledger = ledger
        self._aligners = {n.name: n.actor.start(n.name, dict(n.inputs)) for n in graph.aligners}
        self._ports: dict[str, list[tuple[str, str]]] = {}
        for node in graph.aligners:
            for port, stream in node.inputs.items():
                self._ports.setdefault(stream, []).append((node.name, port))
        self._wanted = graph.source_streams
        made = {node.name for node in graph.stages}
        self._entry_streams = [stream for stream in graph.frame_streams if stream not in made]
        self._waiting: dict[str, deque[Token]] = {stream: deque() for stream in self._entry_streams}
        self._entries: list[Loss] = []
        self.messages: Counter[str] = Counter()

    def frames(self, events: Iterable[Event]) -> Iterator[ReadyFrame]:
        """The frames of the log, as they become ready.

        An event is (log time, stream, item); an item that is an exception stands for a message that was lost.
        """
        log_time = 0
        for message in _judged(events, self._wanted):
            log_time, stream, item = message.log_time, message.stream, message.item
            for name, aligner in self._aligners.items():
                self._answer(name, log_time, aligner.tick(log_time))
            if isinstance(item, Exception):
                self._lose(Loss(stream, log_time, "source", LossReason.UNREADABLE, str(item)))
            elif stream in self._wanted:
                self.messages[stream] += 1
                if message.fault:
                    self._lose(Loss(stream, item.stamp, "source", LossReason.OUT_OF_ORDER, message.fault))
                else:
                    self._take(stream, log_time, Token(item.stamp, item))
            yield from self._ready()
        for name, aligner in self._aligners.items():
            self._answer(name, log_time, aligner.end())
        yield from self._ready()

    @property
    def late_entries(self) -> list[Loss]:
        """Losses noticed after the last frame that entered the engine."""
        tokens = [token for queue in self._waiting.values() for token in queue]
        return [*self._entries, *(token.value.cause for token in tokens if isinstance(token.value, Absent))]

    def give_back(self, frame: ReadyFrame) -> None:
        """Take back a frame that was not admitted: of what is not in the run, only its losses are told."""
        for stream, value in frame.values.items():
            self._waiting[stream].appendleft(Token(frame.stamp, value))
        self._entries = [*frame.entries, *self._entries]

    def _take(self, stream: str, log_time: int, token: Token) -> None:
        """Give a token to the aligners that read its stream, and to the frame it belongs to."""
        if stream in self._waiting:
            self._waiting[stream].append(token)
        for name, port in self._ports.get(stream, ()):
            self._answer(name, log_time, self._aligners[name].push(port, log_time, token))

    def _answer(self, name: str, log_time: int, answers: Answers) -> None:
        for answer in answers:
            if isinstance(answer, Loss):
                self._lose(answer)
            else:
                if isinstance(answer.value, Absent) and answer.value.cause.stage == name:
                    self._ledger.add(answer.value.cause)
                self._take(name, log_time, answer)

    def _lose(self, entry: Loss) -> None:
        self._entries.append(self._ledger.add(entry))

    def _ready(self) -> Iterator[ReadyFrame]:
        while self._entry_streams and all(self._waiting.values()):
            tokens = {stream: queue.popleft() for stream, queue in self._waiting.items()}
            entries, self._entries = self._entries, []
            yield ReadyFrame(
                next(iter(tokens.values())).stamp, {stream: token.value for stream, token in tokens.items()}, entries
            )
