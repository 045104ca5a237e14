"""The exceptions of this room: a recording that cannot be read or written, said in a sentence a user can act on."""

from __future__ import annotations


class LogError(Exception):
    """One sentence: what is wrong, where (file, topic, stamp), and what to do about it."""


class UnwritableError(LogError):
    """A place that cannot be written, or is full."""


def said(error: BaseException) -> str:
    """The first line of what an exception says."""
    return str(error).split("\n")[0] or type(error).__name__
