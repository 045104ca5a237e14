"""`make fuzz`: reads changed files for some time; each must end in time with a result or one sentence.

A finding is printed with the name of its case, which `--case` repeats, and its file is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import cv2

from recordings.errors import LogError
from tests.fuzz.isolation import Outcome, isolated
from tests.fuzz.targets import TARGETS, Target


def main() -> int:
    """Fuzz until the time is over; the exit code is 1 if there are findings."""
    options = _parser().parse_args()
    cv2.setNumThreads(1)
    first = int(time.time()) * 1000 if options.first is None else options.first
    if options.case:
        name, _, number = options.case.partition(":")
        names, numbers, until = [name], iter([int(number)]), float("inf")
    else:
        names, numbers = options.target or list(TARGETS), itertools.count(first)
        until = time.monotonic() + options.seconds
    found, counts, worst = dict[tuple[str, str, str], str](), Counter[str](), dict[str, tuple[float, float]]()
    with tempfile.TemporaryDirectory(prefix="roverflow-fuzz-") as folder:
        seeds = {}
        for name in names:
            (Path(folder) / name).mkdir()
            seeds[name] = TARGETS[name].seeds(Path(folder) / name)
            _warm_up(TARGETS[name], seeds[name][0], Path(folder) / f"valid{TARGETS[name].ending}")
        for number, name in ((number, name) for number in numbers for name in names):
            if time.monotonic() > until:
                break
            own = Path(folder, "case")
            own.mkdir()
            outcome = isolated(TARGETS[name].case(name, number, seeds[name], own))
            counts[name] += 1
            worst[name] = _larger(worst.get(name, (0.0, 0.0)), outcome)
            key = name, outcome.fault.partition(":")[0], outcome.where
            if outcome.fault and key not in found:
                found[key] = f"{name}:{number}"
                print(f"{name}:{number}: {outcome.fault}\n    {outcome.where}", flush=True)
                for path in own.iterdir() if not options.case else ():
                    if path.is_file():
                        options.keep.mkdir(parents=True, exist_ok=True)
                        shutil.copy(path, options.keep)
            shutil.rmtree(own)
    for name, count in counts.items():
        print(f"{name}: {count} cases, at most {worst[name][0]:.1f} s and {worst[name][1]:.0f} MB")
    print(f"{len(found)} findings{f'; their files are in {options.keep}' if found and not options.case else ''}")
    return 1 if found else 0


def _warm_up(target: Target, valid: bytes, path: Path) -> None:
    """Read a valid file, so that the processes of the cases begin with everything imported."""
    path.write_bytes(valid)
    with contextlib.suppress(LogError), contextlib.redirect_stdout(None):
        target.read(path)


def _larger(worst: tuple[float, float], outcome: Outcome) -> tuple[float, float]:
    return max(worst[0], outcome.seconds), max(worst[1], outcome.megabytes)


def _parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Read changed files for some time.")
    top.add_argument("--seconds", type=float, default=60.0)
    top.add_argument("--target", action="append", choices=sorted(TARGETS), help="all by default")
    top.add_argument("--first", type=int, help="number of the first case; by default it depends on the time")
    top.add_argument("--case", metavar="TARGET:NUMBER", help="one case")
    top.add_argument("--keep", type=Path, default=Path("build/fuzz"), metavar="DIR", help="for files of findings")
    return top


if __name__ == "__main__":
    sys.exit(main())
