"""The exceptions of this folder: a recording that cannot be read or written."""

from __future__ import annotations


class LogError(Exception):
    """One sentence: what is wrong, where (file, topic, stamp), and what to do about it."""


class UnwritableError(LogError):
    """An output path that cannot be written, or a full disk."""


def sentence_of(error: BaseException) -> str:
    """The first line of an exception's message, or the name of its type."""
    return str(error).split("\n")[0] or type(error).__name__
