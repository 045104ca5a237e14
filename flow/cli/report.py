"""What a run prints when it is through: the verdict, notes, what was lost and written, and last of all any warnings."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from flow.contracts import LossReason, Verdict, counted
from flow.runtime.findings import NOTE, WARNING, lines


def say(text: str) -> None:
    """Print to stdout; a reader that has left does not stop the work."""
    try:
        print(text, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or what is left would fail again at the end
        if not isinstance(error, BrokenPipeError):
            raise


def headline(summary: dict[str, Any]) -> str:
    """The verdict of a run in a line: how many frames are whole, and what was lost, be it frames or what made none.

    Frames that were in work as the run was stopped, or broke off, are told, but are no losses of the log.
    """
    whole, of, drops = summary["frames_out"], summary["frames_in"], summary["drops"]
    all_but = summary["verdict"] == Verdict.COMPLETE or whole != of  # else "18 of 18" would hide what made no frame
    frames = f"{whole} of {counted(of, 'frame')}" if all_but else counted(whole, "frame")
    cut_off = summary["interrupted"] and summary["verdict"] != Verdict.COMPLETE
    said = f"interrupted after {frames}" if cut_off else f"{frames} whole"
    losses = {reason: number for reason, number in drops.items() if reason != LossReason.ABANDONED}
    abandoned = f", {drops[LossReason.ABANDONED]} abandoned" if LossReason.ABANDONED in drops else ""
    lost = ", ".join(f"{number} {reason}" for reason, number in losses.items())
    count = f", {counted(sum(losses.values()), 'loss', 'losses')}: {lost}" if losses else ""
    return f"{summary['verdict']}: {said}{abandoned}{count}; {summary['frames_per_second']:.2f} frames/s"


def report(summary: dict[str, Any]) -> None:
    """Print the summary of a run."""
    say(headline(summary))
    found = [summary["surveys"], summary["findings"]]
    for line in [line for part in found for line in lines(part, NOTE)]:
        say(f"  {line}")
    for reason, number in summary["drops"].items():
        first = next(entry for entry in summary["ledger"] if entry["reason"] == reason)
        say(f"  {number} {reason}, first: {first['stream']} at {first['stamp']}: {first['detail']}")
    for path in summary["withheld"]:
        say(f"  {path} was not written or replaced: it would hold no result; --summary has what was lost")
    for path in map(Path, summary["outputs"]):
        say(f"  {path} ({path.stat().st_size / 1e6:.1f} MB)")
    for line in [line for part in found for line in lines(part, WARNING)]:
        say(f"WARNING: {line}")
