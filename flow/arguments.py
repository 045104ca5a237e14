"""What the command line's arguments may be, each a function from text that argparse calls."""

from __future__ import annotations

import argparse
import math


def count(text: str) -> int:
    """A whole number of at least 1."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, not '{text}'")
    return value


def seconds(text: str) -> float:
    """Seconds after a log's first message."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"must be seconds after the log's first message, not '{text}'")
    return value


def size(text: str) -> tuple[int, int]:
    """Width and height, px, such as 640x480."""
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, such as 640x480, not '{text}'")
    return int(width), int(height)
