"""Types of command-line arguments: argparse calls these functions with the text of an argument."""

from __future__ import annotations

import argparse
import math
import re
from contextlib import suppress
from typing import TYPE_CHECKING

from flow.contracts import MAX_WORKERS
from flow.runtime.frame_selection import Every

if TYPE_CHECKING:
    import numpy as np

    At = float | str | np.datetime64 | np.timedelta64

_MIN_MEMORY_MB = 500
MAX_SECONDS = 9e9  # int64 nanoseconds hold no more
AT = "seconds after the log's first message, a time copied from the viewer, or cursor: the time in the open viewer"
CURSOR = "cursor"  # the instant of a viewer that is open


def count(text: str, low: int = 1) -> int:
    """A whole number of at least `low`."""
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if value < low:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least {low}, not '{text}'")
    return value


def workers(text: str) -> int:
    """A number of worker threads."""
    value = count(text)
    if value > MAX_WORKERS:
        raise argparse.ArgumentTypeError(f"must be at most {MAX_WORKERS}, not '{text}'; the cores are enough")
    return value


def memory(text: str) -> str:
    """An amount of memory, as Dask reads it; with less than 500 MB a worker process ends before its first frame."""
    found = re.fullmatch(r"(\d*\.?\d+) ?([MGT])i?B", text)
    if not found or float(found[1]) * {"M": 1, "G": 1e3, "T": 1e6}[found[2]] < _MIN_MEMORY_MB:
        least = f"at least {_MIN_MEMORY_MB}MB"
        raise argparse.ArgumentTypeError(f"must be a number with MB, GB or TB, {least}, such as 4GB, not '{text}'")
    return text


def seconds(text: str) -> float:
    """Seconds after a log's first message; the text may also have another unit, such as 2min."""
    from flow.units import quantity

    try:
        value = quantity(text if text[-1:].isalpha() else f"{text} s", "s")
    except (ValueError, OverflowError):
        value = math.nan
    if not 0 <= value <= MAX_SECONDS:
        raise argparse.ArgumentTypeError(
            f"must be seconds after the log's first message, at most {MAX_SECONDS:g}, not '{text}'"
        )
    return value


def instant(text: str) -> At:
    """Seconds after a log's first message, or a time as the viewer shows it: UTC, time of day, or ns since 1970.

    Examples
    --------
    >>> instant("12.3")
    12.3
    >>> instant("2min")
    120.0
    >>> instant("2023-11-15 22:13:20.513 000 000Z") == instant("1700086400513000000")
    np.True_
    """
    import numpy as np

    if text == CURSOR:
        return CURSOR
    time = r"([01]?\d|2[0-3]):([0-5]\d):([0-5]\d)(?:\.([\d ]+))?Z?"
    found = re.fullmatch(rf"(?:(\d{{4}}-\d\d-\d\d)[ T])?{time}", text.strip())
    if found:
        date, hours, minutes, whole, fraction = found.groups()
        ns = int((fraction or "0").replace(" ", "")[:9].ljust(9, "0"))
        of_day = np.timedelta64(((60 * int(hours) + int(minutes)) * 60 + int(whole)) * 1_000_000_000 + ns, "ns")
        if date is None:
            return of_day
        with suppress(ValueError):  # no such date
            if abs(int(np.datetime64(date, "s").astype(int))) < MAX_SECONDS:  # others wrap around in ns
                return np.datetime64(date, "ns") + of_day
    elif re.fullmatch(r"\d{18,19}|\d{1,19} ?ns", text.strip()):
        ns = int(text.strip().removesuffix("ns"))
        if ns < MAX_SECONDS * 1e9:
            return np.datetime64(ns, "ns")
    with suppress(argparse.ArgumentTypeError):
        return seconds(text)
    raise argparse.ArgumentTypeError(
        f"must be seconds after the log's first message, a time as the viewer shows it in UTC, such as 2023-11-15 "
        f"22:13:20.5 or 22:13:20.5, or {CURSOR}, not '{text}'"
    )


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


def rate(text: str) -> float:
    """How many times as fast as a log, above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, such as 1, not '{text}'")
    return value


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
