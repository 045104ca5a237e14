"""The feeder: turns a log's messages, in log-time order, into frames ready for the engine.

It runs the aligners, keeps the ledger of what finds no place, and hands a frame on once every stream that no stage
makes has its value for that stamp, so that frames start whole and in stamp order.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from flow.align import Answers, Token
from flow.graph import Graph
from flow.ledger import Absent, Entry, Ledger, Reason

Event = tuple[int, str, Any]

# ns; a stamp that runs ahead of the log's clock by this much more than the one before it is taken for damaged
JUMP = 10_000_000_000


@dataclass(frozen=True)
class ReadyFrame:
    """A frame that may enter the engine: its values by stream, and the losses noticed since the frame before."""

    stamp: int
    values: dict[str, Any]
    entries: list[Entry]


class Feeder:
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
        self._last: dict[str, tuple[int, int]] = {}  # stamp, and how far it ran ahead of the log's clock
        self._suspect: dict[str, int] = {}  # how far ahead the last one was that was taken for damaged
        self._entries: list[Entry] = []
        self.messages: Counter[str] = Counter()

    def frames(self, events: Iterable[Event]) -> Iterator[ReadyFrame]:
        """The frames of the log, as they become ready.

        An event is (log time, stream, item); an item that is an exception stands for a message that was lost.
        """
        log_time = 0
        for log_time, stream, item in events:
            for name, aligner in self._aligners.items():
                self._answer(name, log_time, aligner.tick(log_time))
            if isinstance(item, Exception):
                self._lose(Entry(stream, log_time, "source", Reason.UNREADABLE, str(item)))
            elif stream in self._wanted:
                self.messages[stream] += 1
                if self._in_order(stream, item.stamp, log_time):
                    self._take(stream, log_time, Token(item.stamp, item))
            yield from self._ready()
        for name, aligner in self._aligners.items():
            self._answer(name, log_time, aligner.end())
        yield from self._ready()

    @property
    def late_entries(self) -> list[Entry]:
        """Losses noticed after the last frame that entered the engine."""
        tokens = [token for queue in self._waiting.values() for token in queue]
        return [*self._entries, *(token.value.cause for token in tokens if isinstance(token.value, Absent))]

    def give_back(self, frame: ReadyFrame) -> None:
        """Take back a frame that was not admitted: of what is not in the run, only its losses are told."""
        for stream, value in frame.values.items():
            self._waiting[stream].appendleft(Token(frame.stamp, value))
        self._entries = [*frame.entries, *self._entries]

    def _in_order(self, stream: str, stamp: int, log_time: int) -> bool:
        """Whether a stamp may follow the one before it; the ledger says why not."""
        ahead = stamp - log_time
        last, last_ahead = self._last.get(stream, (stamp - 1, ahead))
        suspect = self._suspect.get(stream)
        # One damaged stamp must not shut out all that follow; two in a row that agree are a clock that was set.
        if ahead - last_ahead > JUMP and (suspect is None or abs(suspect - ahead) > JUMP):
            self._suspect[stream] = ahead
            detail = f"its stamp jumps {(ahead - last_ahead) / 1e9:.1f} s ahead of the log's clock"
        elif stamp == last:
            detail = f"it repeats the stamp of the {stream} message before it"
        elif stamp < last:
            detail = f"its stamp is {(last - stamp) / 1e6:.1f} ms before that of the {stream} message read before it"
        else:
            self._last[stream] = (stamp, ahead)
            self._suspect.pop(stream, None)
            return True
        self._lose(Entry(stream, stamp, "source", Reason.OUT_OF_ORDER, detail))
        return False

    def _take(self, stream: str, log_time: int, token: Token) -> None:
        """Give a token to the aligners that read its stream, and to the frame it belongs to."""
        if stream in self._waiting:
            self._waiting[stream].append(token)
        for name, port in self._ports.get(stream, ()):
            self._answer(name, log_time, self._aligners[name].push(port, log_time, token))

    def _answer(self, name: str, log_time: int, answers: Answers) -> None:
        for answer in answers:
            if isinstance(answer, Entry):
                self._lose(answer)
            else:
                if isinstance(answer.value, Absent) and answer.value.cause.stage == name:
                    self._ledger.add(answer.value.cause)
                self._take(name, log_time, answer)

    def _lose(self, entry: Entry) -> None:
        self._entries.append(self._ledger.add(entry))

    def _ready(self) -> Iterator[ReadyFrame]:
        while self._entry_streams and all(self._waiting.values()):
            tokens = {stream: queue.popleft() for stream, queue in self._waiting.items()}
            entries, self._entries = self._entries, []
            yield ReadyFrame(
                next(iter(tokens.values())).stamp, {stream: token.value for stream, token in tokens.items()}, entries
            )
