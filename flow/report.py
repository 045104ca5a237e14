"""What a run prints when it is through: the verdict, notes, what was lost and written, and last of all any warnings."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from flow.findings import NOTE, WARNING, lines


def say(text: str) -> None:
    """Print to stdout; a reader that has left does not stop the work."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def report(summary: dict[str, Any]) -> None:
    """Print the summary of a run."""
    rate = f"{summary['frames_per_second']:.2f} frames/s"
    say(f"{summary['verdict']}: {summary['frames_out']} of {summary['frames_in']} frames whole, {rate}")
    found = [summary["surveys"], summary["findings"]]
    for line in [line for part in found for line in lines(part, NOTE)]:
        say(f"  {line}")
    for reason, number in summary["drops"].items():
        first = next(entry for entry in summary["ledger"] if entry["reason"] == reason)
        say(f"  {number} {reason}, first: {first['stream']} at {first['stamp']}: {first['detail']}")
    for path in map(Path, summary["outputs"]):
        say(f"  {path} ({path.stat().st_size / 1e6:.1f} MB)")
    for line in [line for part in found for line in lines(part, WARNING)]:
        say(f"WARNING: {line}")
