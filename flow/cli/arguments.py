"""What the command line's arguments may be: functions from text that argparse calls, and the check of outputs."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from flow.errors import UsageError

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


def seconds(text: str) -> float:
    """Seconds after a log's first message."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= _LATEST:
        raise argparse.ArgumentTypeError(
            f"must be seconds after the log's first message, at most {_LATEST:g}, not '{text}'"
        )
    return value


def size(text: str) -> tuple[int, int]:
    """Width and height, px, such as 640x480."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, such as 640x480, not '{text}'")
    return int(width), int(height)


def check_outputs(
    outputs: Mapping[str, Path | None], inputs: Sequence[Path], is_ours: Callable[[Path, str], bool]
) -> None:
    """Refuse outputs that cannot be written, that would replace what is being read or what is none of ours, or that are
    one file twice.

    outputs: kind -> path; is_ours: whether an existing file is an earlier output of that kind, which may be replaced.
    """
    taken: list[str] = []
    for kind, path in outputs.items():
        if path is None:
            continue
        if not path.parent.is_dir():
            raise UsageError(f"there is no folder {path.parent} for {path.name}; make it first")
        if path.exists() and not path.is_file():
            raise UsageError(f"{path} is a folder or a device; give the name of a file")
        for given in inputs:
            if path.exists() and given.exists() and path.samefile(given):
                raise UsageError(f"{path} is what is being read; choose another name for the output")
        if (resolved := os.path.realpath(path)) in taken:
            raise UsageError(f"{path} is given for two outputs; choose another name for one")
        if path.suffix.lower() == ".mcap" and not kind.endswith("log"):
            raise UsageError(f"{path} has the name of a log; choose another for a {kind}")
        if path.exists() and not is_ours(path, kind):
            raise UsageError(f"{path} is there already and no {kind} of roverflow; choose another name or remove it")
        taken.append(resolved)


def check_demo(folder: Path, is_ours: Callable[[Path, str], bool]) -> None:
    """Refuse a folder for the demo that holds what no earlier demo wrote: its log and its maps are replaced."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; give the name of a folder with --out")
    if not folder.exists() or not any(folder.iterdir()):
        return
    log = folder / "traverse.mcap"
    finished = (folder / "summary.json").is_file() or not (folder / "maps").exists()
    if not log.is_file() or not is_ours(log, "input log") or not finished:
        raise UsageError(f"{folder} is not empty, and not of an earlier demo; choose another folder with --out")
