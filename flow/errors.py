"""The exceptions of the runtime: one family, each a sentence saying what is wrong, where, and what to do."""

from __future__ import annotations

from typing import Any

COMPLETE, FAILED, UNUSABLE, INCOMPLETE, INTERRUPTED = 0, 1, 2, 3, 130  # exit codes


class RoverflowError(Exception):
    """Base of the family; `exit_code` is what the command line leaves with."""

    exit_code = 1


class UsageError(RoverflowError):
    """The command was given something it cannot use."""

    exit_code = 2


class PipelineError(RoverflowError):
    """A pipeline file does not describe a graph that can run."""

    exit_code = 2


class SinkError(RoverflowError):
    """An output could not be written; the run was stopped and the outputs closed. `summary` tells how far it came."""

    def __init__(self, sentence: str, summary: dict[str, Any]) -> None:
        super().__init__(sentence)
        self.summary = summary
