"""The exceptions of the program. Each is one sentence: what is wrong, where, and what to do."""

from __future__ import annotations

from typing import Any

COMPLETE, FAILED, UNUSABLE, INCOMPLETE, INTERRUPTED = 0, 1, 2, 3, 130  # exit codes
DIFFERENT = 3  # of two results


class RoverflowError(Exception):
    """Base class. `exit_code` is the exit code of the command line."""

    exit_code = 1


class UsageError(RoverflowError):
    """A command cannot use an argument or a log."""

    exit_code = 2


class PipelineError(RoverflowError):
    """A pipeline file does not describe a graph that can run."""

    exit_code = 2


class SinkError(RoverflowError):
    """An output could not be written. The run was stopped and its outputs were closed; `summary` is its summary."""

    def __init__(self, sentence: str, summary: dict[str, Any]) -> None:
        super().__init__(sentence)
        self.summary = summary
