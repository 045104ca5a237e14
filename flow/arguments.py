"""What the command line's arguments may be: functions from text that argparse calls, and the check of outputs."""

from __future__ import annotations

import argparse
import math
import os
import struct
from collections.abc import Sequence
from pathlib import Path

from flow.errors import UsageError

_MCAP = b"\x89MCAP0\r\n"
_OWN = _MCAP + struct.pack("<BQI4sI9s", 1, 21, 4, b"ros2", 9, b"roverflow")  # header: its length, profile and library
_OTHERS = b"RRF", b"{"  # how recordings of rerun begin, and JSON
_MOST_WORKERS = 1024
_LATEST = 9e9  # s, beyond what stamps in nanoseconds can hold


def count(text: str) -> int:
    """A whole number of at least 1."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, not '{text}'")
    return value


def workers(text: str) -> int:
    """A number of threads: more than there are cores only wait for each other."""
    value = count(text)
    if value > _MOST_WORKERS:
        raise argparse.ArgumentTypeError(f"must be at most {_MOST_WORKERS}, not '{text}'; the cores are enough")
    return value


def magnitude(text: str, what: str = "a number of at least 0") -> float:
    """A number of at least 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"must be {what}, not '{text}'")
    return value


def share(text: str) -> float:
    """A percentage that is no less than -50, as a share."""
    try:
        value = float(text) / 100
    except ValueError:
        value = math.nan
    if not -0.5 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a percentage of at least -50, not '{text}'")
    return value


def seconds(text: str) -> float:
    """Seconds after a log's first message."""
    value = magnitude(text, what := "seconds after the log's first message")
    if value > _LATEST:
        raise argparse.ArgumentTypeError(f"must be {what}, at most {_LATEST:g}, not '{text}'")
    return value


def size(text: str) -> tuple[int, int]:
    """Width and height, px, such as 640x480."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, such as 640x480, not '{text}'")
    return int(width), int(height)


def check_outputs(log: Path | None, others: Sequence[Path | None], inputs: Sequence[Path]) -> None:
    """Refuse outputs that cannot be written, that would replace what is being read, or that are one file twice.

    log: the one output that is a log, if any: no other may take a log's place.
    """
    taken: list[str] = []
    for path in filter(None, (log, *others)):
        if not path.parent.is_dir():
            raise UsageError(f"there is no folder {path.parent} for {path.name}; make it first")
        if path.exists() and not path.is_file():
            raise UsageError(f"{path} is a folder or a device; give the name of a file")
        for given in inputs:
            if path.exists() and given.exists() and path.samefile(given):
                raise UsageError(f"{path} is what is being read; choose another name for the output")
        if (resolved := os.path.realpath(path)) in taken:
            raise UsageError(f"{path} is given for two outputs; choose another name for one")
        if path is not log and (path.suffix.lower() == ".mcap" or _start_of(path).startswith(_MCAP)):
            raise UsageError(f"{path} has the name of a log or is one; choose another for what is none")
        if _is_of_others(path, path is log):
            raise UsageError(f"{path} is there already and no output of roverflow; choose another name or remove it")
        taken.append(resolved)


def check_demo(folder: Path) -> None:
    """Refuse a folder for the demo that holds what no earlier demo wrote: its log and its maps are replaced."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; give the name of a folder with --out")
    if not folder.exists() or not any(folder.iterdir()):
        return
    log = folder / "traverse.mcap"
    finished = (folder / "summary.json").is_file() or not (folder / "maps").exists()
    if not log.is_file() or _is_of_others(log, True) or not finished:
        raise UsageError(f"{folder} is not empty, and not of an earlier demo; choose another folder with --out")


def _is_of_others(path: Path, log: bool) -> bool:
    """Whether there is a file that, by its first bytes, is nothing that roverflow wrote there: a log, or else."""
    start = _start_of(path)
    return bool(start) and (start != _OWN if log else not start.startswith(_OTHERS))


def _start_of(path: Path) -> bytes:
    """As many bytes as tell whose file it is; of one that is not there, none."""
    if not path.exists():
        return b""
    with path.open("rb") as file:
        return file.read(len(_OWN))
