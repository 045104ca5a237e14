"""The types that flow, stages and recordings share: losses, findings, frames, sources, logs and sinks."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from enum import StrEnum
from functools import reduce
from operator import or_
from pathlib import PurePath
from types import UnionType
from typing import Any, ClassVar, Protocol, Union, get_args, get_origin

MAX_WORKERS = 1024  # of a run
MIN_ALIKE = 2 / 3  # of the letters of two names that are near; 'rnu' and 'run' share as many


class LossReason(StrEnum):
    """Why a message or a frame was lost."""

    UNREADABLE = "unreadable"  # the source could not read or decode it
    OUT_OF_ORDER = "out of order"  # its stamp is not after that of the message before it
    UNMATCHED = "unmatched"  # no partner for a pair
    UNALIGNED = "unaligned"  # no sample of another clock's stream for the frame
    DROPPED = "dropped"  # the workers were busy until the next frame was due (run --rate)
    FAILED = "failed"  # a stage raised an exception
    UNWRITABLE = "unwritable"  # a sink has no form for a value
    ABANDONED = "abandoned"  # the run ended before the frame was finished


class Verdict(StrEnum):
    """How a run ended."""

    COMPLETE = "COMPLETE"
    INCOMPLETE = "INCOMPLETE"


@dataclass(frozen=True)
class Loss:
    """One loss. stamp: ns of the log's clock; stage: the node that noticed it; detail: one sentence."""

    stream: str
    stamp: int
    stage: str
    reason: LossReason
    detail: str

    def as_dict(self) -> dict[str, str | int]:
        """The loss in plain JSON values."""
        return {**asdict(self), "stamp": int(self.stamp), "reason": str(self.reason)}


@dataclass(frozen=True)
class Absent:
    """Takes the place of a lost item in a frame, so that no stage waits for it."""

    cause: Loss


@dataclass(frozen=True)
class Unchanged:
    """Takes the place of an item in a frame in which a stage returned None: its last item stays valid."""


@dataclass(frozen=True)
class FrameRecord:
    """One frame, as a sink gets it.

    Attributes
    ----------
    index
        0, 1, ... in the order of stamps.
    stamp
        ns of the log's clock.
    items
        Stream -> item, without the lost and the unchanged ones.
    entries
        The losses of this frame, and those of the log since the frame before.
    seconds
        Stage -> wall time; sink -> that of the last frame that was through.
    queues
        Stage -> frames in its inbox when this frame was delivered.
    unchanged
        Streams without a new item and without a loss in this frame: their last items stay valid.
    """

    index: int
    stamp: int
    items: Mapping[str, Any]
    entries: tuple[Loss, ...]
    seconds: Mapping[str, float]
    queues: Mapping[str, int]
    unchanged: frozenset[str] = frozenset()


class Severity(StrEnum):
    """How much a finding matters. A run prints warnings and faults last."""

    NOTE = "note"
    WARNING = "warning"  # results may be wrong
    FAULT = "fault"  # results are wrong


@dataclass(frozen=True)
class Finding:
    """One sentence about a whole run or log. It is not a loss. A fault makes the verdict INCOMPLETE.

    about: what a fault is in, such as "tilt"; assumes: what a warning takes for sound. A warning whose assumption has a
    fault becomes a note, so that one cause gives one warning.
    """

    sentence: str
    severity: Severity = Severity.NOTE
    about: str = ""
    assumes: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "severity", Severity(self.severity))

    def as_dict(self) -> dict[str, str]:
        """The finding in plain JSON values."""
        return {"severity": str(self.severity), "sentence": self.sentence}


class StageError(ValueError):
    """Data that a stage cannot work with; the sentence says what is wrong, where, and what to do.

    The ledger shows the sentence as it is. It shows any other exception with its type, file and line.
    """


Event = tuple[int, str, Any]  # log time in ns, stream, item; an exception takes the place of a lost item


class Source(Protocol):
    """Opens logs. streams: every stream that its logs may provide -> the type of its items."""

    @property
    def streams(self) -> Mapping[str, type]:
        """See above."""

    def open(self, path: Any, *, start: float | None, end: float | None) -> AbstractContextManager[Log]:
        """The log at `path`, from `start` to before `end`, in s after its first message."""


class Log(Protocol):
    """An opened log.

    missing: stream -> why this log does not have it; refused: setting of the source -> why this log cannot be read with
    it; frames: the number of frames, where it is known. Optional: `begin`, the log time of its first message, ns;
    `first_stamp`, the same on the clock of the stamps; `faults()`, stream -> a Finding about it, which the run asks for
    at its end.
    """

    missing: Mapping[str, str]
    refused: Mapping[str, str]

    @property
    def frames(self) -> int | None:
        """See above."""

    def events(self, streams: Collection[str]) -> Iterator[Event]:
        """The events of these streams in the order of log time, and losses whose stream is unknown."""

    def notes(self) -> Mapping[str, str]:
        """Stream -> a note about it. The run asks for them at its end."""

    def excerpts(self, count: int, streams: Collection[str]) -> Iterable[Iterable[Event]]:
        """`count` stretches of these streams, spread over the whole log. Only the pre-pass asks for them."""


class Sink(Protocol):
    """Takes the frames of a run, one at a time, in the order of stamps. A sink is a dataclass; each run opens a copy.

    Optional members:

    - `names_streams`, `names_patterns`: the parameters that name streams, and those that name them by patterns such as
      disparity/*, so that a pipeline file can be checked;
    - `unwritable(stream, kind)`: why the sink cannot write a stream, or an empty str; asked when a pipeline is loaded;
    - `asks`: parameter -> value that the run gives to the stages that have the parameter at its default, so that they
      make more for this sink; no other result may change by it;
    - `discard()`: gives up the output and keeps an existing file, where no frame got through or another output failed;
    - `empty`: whether there is nothing worth keeping; the run then calls `discard`;
    - `checkpoint()`, `resume(saved)`: returns what a later run of the same output needs to go on behind the last frame,
      and goes on from it, after `open`; without them `run --resume` refuses the pipeline.
    """

    suffix: str
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def wants(self, stream: str, kind: type) -> bool:
        """Whether the sink uses a stream of this name and type."""

    def open(self, path: Any, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Begin an output. No file with the name `path` appears before `close`."""

    def write(self, record: Any) -> Mapping[str, str] | None:
        """Write one FrameRecord. May return the streams that it has no form for in this frame -> why, as losses."""

    def close(self, summary: Mapping[str, Any]) -> None:
        """Finish the output and give it its name."""


def unaliased(kind: Any) -> Any:
    """A type with its type aliases expanded: `NDArray[...]` is an alias from numpy 2.5 on."""
    origin, arguments = get_origin(kind), get_args(kind)
    if hasattr(origin, "__value__"):
        return unaliased(origin.__value__[arguments])
    if hasattr(kind, "__value__"):
        return unaliased(kind.__value__)
    if origin in (Union, UnionType):
        return reduce(or_, map(unaliased, arguments))
    if origin in (dict, list, tuple, Mapping):
        return origin[tuple(map(unaliased, arguments))]
    return kind


def nearest(name: str, valid: Iterable[str]) -> str:
    """The end of a sentence about an invalid `name`: the valid name nearest to it, if one is near."""
    close = get_close_matches(name, list(valid), n=1, cutoff=MIN_ALIKE)
    return f"; did you mean '{close[0]}'?" if close else ""


def as_text(name: str | PurePath) -> str:
    """A name as outputs contain it: what is not Unicode, as in a name of another encoding, has escapes."""
    return str(name).encode("utf-8", "backslashreplace").decode()


def remedy_for(package: str) -> str:
    """How to install a package that the environment of this process lacks."""
    return f"install it by `{shlex.quote(sys.executable)} -m pip install {package}`"


def counted(number: int, what: str, many: str = "") -> str:
    """A number of things in words: "1 frame", "2 frames". many: the plural where it is not `what` with an s."""
    return f"{number} {what if number == 1 else many or what + 's'}"
