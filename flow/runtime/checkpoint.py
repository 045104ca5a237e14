"""Checkpoints: a run that was stopped or killed resumes from its last one, with identical results.

A checkpoint lies between two frames. Every stage and sink saves its state when it is through with the first of them,
while others are still behind or already ahead. The source and the aligners save none: the log is read from its
beginning again, and the frames before the checkpoint are left out.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from flow.contracts import Loss, Sink
from flow.errors import UsageError
from flow.runtime.graph import Node


@dataclass(frozen=True)
class Checkpoint:
    """The state of a run between two frames.

    frames: the number before it; complete: those of them without a loss; states: stage or sink -> its pickled state;
    losses: in stages so far. Those of the source and the aligners are found again.
    """

    frames: int
    complete: int
    states: Mapping[str, bytes]
    losses: tuple[Loss, ...]

    def state(self, name: str) -> Any:
        """The state of a stage or sink. It comes from a pickle: never resume from an untrusted source."""
        try:
            return pickle.loads(self.states[name])
        except Exception as error:  # a class of the user's own may be gone
            why = f"the state of '{name}' in the checkpoint cannot be read: {error}"
            raise UsageError(f"{why}; run without --resume to begin with the first frame") from error


class Checkpoints(Protocol):
    """Keeps the last checkpoint of a run. last: that one; at the start the one to go on from, None for a new run."""

    last: Checkpoint | None

    def due(self) -> bool:
        """Whether a checkpoint is to be made after the next frame."""

    def keep(self, checkpoint: Checkpoint) -> None:
        """Keep a checkpoint in place of the one before."""

    def give_up(self, why: str) -> None:
        """Make no further checkpoints. why: a sentence."""


def check_resumable(stages: Iterable[Node], sinks: Mapping[str, Sink]) -> None:
    """Raise UsageError for a stage whose state cannot be saved, or a sink that cannot go on."""
    for node in stages:
        try:
            pickle.dumps(node.actor.start() if node.stateful else None)
        except Exception as error:
            why = f"the state of '{node.name}' cannot be pickled: {error}"
            raise UsageError(f"this pipeline cannot be resumed: {why}; leave out --resume") from error
    for use, sink in sinks.items():
        if not (hasattr(sink, "checkpoint") and hasattr(sink, "resume")):
            raise UsageError(f"this pipeline cannot be resumed: {use} has no 'checkpoint'; leave out --resume")
