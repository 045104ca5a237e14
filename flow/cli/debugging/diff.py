"""`roverflow diff`: where two results part, and by how much."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, DIFFERENT

HELP = "compare two result logs: the first difference, and how large the differences are"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("one", type=Path, metavar="A.mcap", help="result log")
    sub.add_argument("other", type=Path, metavar="B.mcap", help="result log to compare with it")
    sub.add_argument("-o", "--out", type=Path, metavar="DIFF.rrd", help="write a rerun recording of the differences")
    sub.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Print the differences; the exit code is 0 for equal results and 3 for different ones."""
    check_outputs({"difference": options.out}, [options.one, options.other])
    from recordings.comparison.diff import diff
    from recordings.comparison.recording import DiffRecording
    from recordings.comparison.text import format_diff, markdown

    recording = DiffRecording()
    found = diff(options.one, options.other, recording.of() if options.out else lambda change: None)
    say(json.dumps(asdict(found) | {"equal": found.equal}, indent=2) if options.json else format_diff(found))
    if options.out and found.equal:
        if not options.json:
            say(f"{options.out} is not written, as nothing differs")
    elif options.out:
        recording.write(options.out, f"{options.one.name} and {options.other.name}", markdown(found))
        if not options.json:
            left_out = counted(len(recording.left_out), "later frame")
            more = f"; differences of {left_out} are not drawn" if recording.left_out else ""
            say(f"wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB{more})")
    return COMPLETE if found.equal else DIFFERENT
