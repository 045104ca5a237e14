"""The types that flow, stages and recordings share: what a source, a sink and a finding are. Types only, no work."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, ClassVar, Protocol


class LossReason(StrEnum):
    """Why something was lost."""

    UNREADABLE = "unreadable"  # the source could not read or decode it
    OUT_OF_ORDER = "out of order"  # its stamp does not follow the one before it
    UNMATCHED = "unmatched"  # no partner for a pair
    UNALIGNED = "unaligned"  # another clock's stream had nothing for the frame
    FAILED = "failed"  # a stage raised
    ABANDONED = "abandoned"  # the run was stopped, or broke off, before the frame was through


class Verdict(StrEnum):
    """How a run ended."""

    COMPLETE = "COMPLETE"
    INCOMPLETE = "INCOMPLETE"


@dataclass(frozen=True)
class Loss:
    """One loss. stamp: ns of the log's clock; stage: the node that noticed; detail: one sentence."""

    stream: str
    stamp: int
    stage: str
    reason: LossReason
    detail: str

    def as_dict(self) -> dict[str, str | int]:
        """The entry as plain JSON values."""
        return {**asdict(self), "reason": str(self.reason)}


@dataclass(frozen=True)
class Absent:
    """Stands in a frame for the item that was lost, so that nobody downstream waits for it."""

    cause: Loss


@dataclass(frozen=True)
class FrameRecord:
    """What a sink is given for one frame.

    index: 0, 1, ... in stamp order; items: stream -> item, without those that were lost; entries: the losses of this
    frame, and those of the log between the frame before and this one; seconds: wall time per stage; queues: frames in
    each stage's inbox as this one was delivered.
    """

    index: int
    stamp: int
    items: Mapping[str, Any]
    entries: tuple[Loss, ...]
    seconds: Mapping[str, float]
    queues: Mapping[str, int]


class Severity(StrEnum):
    """How much a finding matters. A run prints each WARNING last, because results may be wrong."""

    NOTE = "note"
    WARNING = "warning"


@dataclass(frozen=True)
class Finding:
    """One sentence about a whole run or log. A finding is no loss: it changes neither the ledger nor the verdict."""

    sentence: str
    severity: Severity = Severity.NOTE

    def as_dict(self) -> dict[str, str]:
        """The finding as plain JSON values."""
        return {"severity": str(self.severity), "sentence": self.sentence}


class StageError(ValueError):
    """Data that a stage cannot work with; the sentence says what is wrong, where, and what to do.

    The ledger shows the sentence as it is. It shows any other exception with its type, file and line.
    """


Event = tuple[int, str, Any]  # of a log: log time in ns, stream, item; an exception stands for an item that was lost


class Source(Protocol):
    """Where a log comes from. streams: stream -> the type of its items, of all that a log may provide."""

    @property
    def streams(self) -> Mapping[str, type]:
        """See above."""

    def open(self, path: Any, *, start: float | None, end: float | None) -> AbstractContextManager[Log]:
        """The log at `path`, from `start` to before `end`, s after its first message."""


class Log(Protocol):
    """What a source opens: its events in the order of log time, and what it says of itself before any is read.

    missing: stream -> why the log cannot provide it; refused: setting of the source -> why the log cannot be read so,
    whatever the graph needs; frames: how many are to come, where that is known.
    """

    missing: Mapping[str, str]
    refused: Mapping[str, str]

    @property
    def frames(self) -> int | None:
        """See above."""

    def events(self, streams: Collection[str]) -> Iterator[Event]:
        """The events of these streams, from the first one on, and losses of which it is not known of which stream."""

    def notes(self) -> Mapping[str, str]:
        """What there is to say of a stream, as a note of the run; asked at its end."""

    def excerpts(self, count: int, streams: Collection[str]) -> Iterable[Iterable[Event]]:
        """So many stretches of these streams, spread over the whole log; asked for where a stage surveys it."""


class Sink(Protocol):
    """Where frames go. `write` is called once for every frame, in stamp order, by one thread at a time.

    A sink whose parameters name streams says which do, in `names_streams`, for pipeline files to be checked. Its method
    `unwritable(stream, kind)` returns why it cannot write a stream, or an empty str, when a pipeline is loaded. With a
    method `discard` it gives up what `open` began, where another output of the run could not be opened, or no frame
    got through; by an attribute `empty` it says that it was given nothing worth keeping, and is to give up then, too.
    """

    suffix: str
    __dataclass_fields__: ClassVar[dict[str, Any]]  # a sink is a dataclass; every run opens a copy of its own

    def wants(self, stream: str, kind: type) -> bool:
        """Whether the sink has a use for a stream of this name and type."""

    def open(self, path: Any, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Begin an output; nothing stands under `path` itself until `close`."""

    def write(self, record: Any) -> None:
        """Take one `flow.runtime.engine.FrameRecord`."""

    def close(self, summary: Mapping[str, Any]) -> None:
        """Finish the output and give it its name."""


def counted(number: int, what: str, many: str = "") -> str:
    """A number of things in words: "1 frame", "2 frames"; many: the plural where it is not `what` with an s."""
    return f"{number} {what if number == 1 else many or what + 's'}"
