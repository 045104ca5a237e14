"""What the engine schedules: the frames in flight, and the work that each stage and sink does on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from flow.contracts import Absent, Loss, Unchanged

NO_ITEM = (Absent, Unchanged)


@dataclass(eq=False)
class Frame:
    """A frame in flight. values: stream -> item, Absent, Unchanged, or None where the item was freed; coming: its
    streams that are there or being made; due: when, s; seconds: of its stages and sinks; begun, done: the work on it;
    served: whether the stages that do not wait for the next frame are through; saved: stage or sink -> its state after
    this frame, pickled, None where no checkpoint follows it."""

    index: int
    stamp: int
    due: float
    values: dict[str, Any]
    entries: list[Loss]
    coming: set[str]
    seconds: dict[str, float] = field(default_factory=dict)
    begun: set[Work] = field(default_factory=set)
    done: set[Work] = field(default_factory=set)
    served: bool = False
    saved: dict[str, bytes] | None = None


@dataclass(eq=False)
class Work:
    """A stage, or a sink (`output` is then None).

    inputs: the streams that must be there before it starts; reads: those of them whose items it uses; large: whether it
    needs much memory; flushes: whether it must know the last frame; consumers: what waits for its output; inbox:
    indices of frames; next: the frame that an ordered work takes next; seconds, cpu_seconds: its time so far; state: of
    an ordered work, to be saved.
    """

    name: str
    inputs: tuple[str, ...]
    reads: tuple[str, ...]
    output: str | None
    ordered: bool
    run: Callable[[Frame], Any]
    state: Callable[[], Any] = lambda: None
    large: bool = False
    flushes: bool = False
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    consumers: list[Work] = field(default_factory=list)
    inbox: set[int] = field(default_factory=set)
    next: int = 0


def missing_of(values: Iterable[Any]) -> Absent | Unchanged | None:
    """What stands for the first lost item among these, else for the first unchanged one; None if all are there."""
    found = [value for value in values if isinstance(value, NO_ITEM)]
    return next((value for value in found if isinstance(value, Absent)), found[0] if found else None)
