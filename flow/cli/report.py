"""What a run prints at its end: the verdict, notes, losses, outputs, warnings, and faults last."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flow.contracts import LossReason, Severity, Verdict, counted
from flow.errors import COMPLETE, INCOMPLETE, INTERRUPTED
from flow.runtime.bottleneck import bottleneck_line
from flow.runtime.findings import lines

MAX_OFFSET = 1e6  # s; stamps farther from the log's beginning are of another clock


def say(text: str) -> None:
    """Print to stdout. A reader that closes the pipe does not stop the work."""
    try:
        print(text, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # later prints would fail as well
        if not isinstance(error, BrokenPipeError):
            raise OSError(error.errno, error.strerror, "stdout") from None


def duration(seconds: float) -> str:
    """An estimated time in s, min or h, with no more digits than an estimate has."""
    if seconds >= 7200:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{seconds:.0f} s"


def exit_code(summary: dict[str, Any]) -> int:
    """The exit code of a run."""
    if summary["interrupted"]:
        return INTERRUPTED
    return COMPLETE if summary["verdict"] == Verdict.COMPLETE else INCOMPLETE


def headline(summary: dict[str, Any]) -> str:
    """The verdict in one line: complete frames, losses by reason, and the rate.

    The rate counts all frames that went through, also those with losses. Frames in flight at an interrupt are reported
    as abandoned, but are not counted as losses of the log.
    """
    complete, total, drops = summary["frames_out"], summary["frames_in"], summary["drops"]
    of_total = summary["verdict"] == Verdict.COMPLETE or complete != total  # "18 of 18" would hide other losses
    frames = f"{complete} of {counted(total, 'frame')}" if of_total else counted(complete, "frame")
    cut_off = summary["interrupted"] and summary["verdict"] != Verdict.COMPLETE
    outcome = f"interrupted after {frames}" if cut_off else f"{frames} complete"
    losses = {reason: number for reason, number in by_cause(drops) if reason != LossReason.ABANDONED}
    abandoned = f", {drops[LossReason.ABANDONED]} abandoned" if LossReason.ABANDONED in drops else ""
    lost = ", ".join(f"{number} {reason}" for reason, number in losses.items())
    count = f", {counted(sum(losses.values()), 'loss', 'losses')}: {lost}" if losses else ""
    groups = [summary.get(group, {}) for group in ("surveys", "findings")]
    faulty = [name for group in groups for name, item in group.items() if item["severity"] == Severity.FAULT]
    faults = f", fault reported by {' and '.join(faulty)}" if faulty else ""
    return f"{summary['verdict']}: {outcome}{abandoned}{count}{faults}; {summary['frames_per_second']:.2f} frames/s"


def by_cause(drops: Mapping[str, int]) -> list[tuple[str, int]]:
    """The counts of losses, the causes of others first: a lost left image leaves the right one unmatched."""
    return [(str(reason), drops[reason]) for reason in LossReason if reason in drops]


def report(summary: dict[str, Any], compiled: bool = False) -> None:
    """Print the summary of a run. compiled: whether it compiled kernels, which lowers its rate."""
    say(headline(summary) + (" (including kernel compilation)" if compiled else ""))
    if summary["frames_left_out"]:
        say(f"  {counted(summary['frames_left_out'], 'frame')} left out by --every {summary['every']}")
    found = [summary["surveys"], summary["findings"]]
    for line in [line for part in found for line in lines(part, Severity.NOTE)]:
        say(f"  {line}")
    for reason, _ in by_cause(summary["drops"]):
        begin = summary.get("log_begin" if reason == LossReason.UNREADABLE else "first_stamp")  # log times, stamps
        lost = [entry for entry in summary["ledger"] if entry["reason"] == reason]
        named = reason in (LossReason.FAILED, LossReason.UNWRITABLE)
        by_stage = [entry["stage"] if named else "" for entry in lost]
        for stage in dict.fromkeys(by_stage):
            first = lost[by_stage.index(stage)]
            place = f"{first['stream']} at {_moment(first['stamp'], begin)}"
            say(f"  {by_stage.count(stage)} {reason}, first: {place}: {first['detail']}")
    if summary["rate"] is not None and (latency := summary["latency_seconds"]):
        late = f"{latency['median']:.2f} s after it, at most {latency['maximum']:.2f} s"
        say(f"  at {summary['rate']:g} times the pace of the log: the results of a frame are there {late}")
    if line := bottleneck_line(summary["bottleneck"]):
        say(f"  {line}")
    for path in summary["withheld"]:
        frameless = "" if summary["frames_in"] else " Nothing was lost: the log has no frame."
        losses = " --summary FILE lists the losses." if summary["ledger"] else frameless
        say(f"  {path} was not written because the run produced no results.{losses}")
    for path in map(Path, summary["outputs"]):
        say(f"  wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
    for line in [line for part in found for line in lines(part, Severity.WARNING)]:
        say(f"WARNING: {line}")
    for line in [line for part in found for line in lines(part, Severity.FAULT)]:
        say(f"FAULT: {line}")


def _moment(stamp: int, begin: int | None) -> str:
    """A stamp as seconds after the log's first message, as --start takes them, and in ns."""
    seconds = math.inf if begin is None else (stamp - begin) / 1e9
    return f"{seconds:+.1f} s ({stamp} ns)" if abs(seconds) < MAX_OFFSET else f"{stamp} ns"
