"""Types of command-line arguments: argparse calls these functions with the text of an argument."""

from __future__ import annotations

import argparse
import math

from flow.runtime.frame_selection import Every

DESKS = ("overview", "matching", "terrain", "runtime", "tilt")  # of `recordings.sinks.blueprint`, loaded only when used
_MAX_WORKERS = 1024
_MAX_SECONDS = 9e9  # int64 nanoseconds hold no more


def count(text: str, low: int = 1) -> int:
    """A whole number of at least 1."""
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if value < low:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least {low}, not '{text}'")
    return value


def count_or_none(text: str) -> int:
    """A whole number of at least 0."""
    return count(text, low=0)


def workers(text: str) -> int:
    """A number of worker threads."""
    value = count(text)
    if value > _MAX_WORKERS:
        raise argparse.ArgumentTypeError(f"must be at most {_MAX_WORKERS}, not '{text}'; the cores are enough")
    return value


def seconds(text: str) -> float:
    """Seconds after a log's first message."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= _MAX_SECONDS:
        raise argparse.ArgumentTypeError(
            f"must be seconds after the log's first message, at most {_MAX_SECONDS:g}, not '{text}'"
        )
    return value


def every(text: str) -> Every:
    """Which frames to take: every n-th one ("2"), or one for each stretch driven ("0.5m")."""
    number, metres = text.strip(), text.strip().endswith("m")
    try:
        value = float(number[:-1]) if metres else int(number)
    except ValueError:
        value = 0
    if metres and 0 < value < math.inf:
        return Every(metres=float(value))
    if metres or value < 1:
        raise argparse.ArgumentTypeError(
            f"must be a whole number of frames of at least 1, such as 2, or a length above 0 m, such as 0.5m, "
            f"not '{text}'"
        )
    return Every(frames=int(value))


def pair(text: str) -> tuple[float, float]:
    """Two numbers, such as 3.4,-0.6."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = math.nan
    if not math.isfinite(first + second):
        raise argparse.ArgumentTypeError(f"must be two numbers with a comma, such as 3.4,-0.6, not '{text}'")
    return first, second


def size(text: str) -> tuple[int, int]:
    """Width and height, px, such as 640x480."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, such as 640x480, not '{text}'")
    return int(width), int(height)
