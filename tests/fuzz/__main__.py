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
from tests.fuzz.isolation import isolated
from tests.fuzz.targets import TARGETS, Target

KEPT = Path("build/fuzz")


def main() -> int:
    """Fuzz until the time is over; the exit code is 1 if there are findings."""
    top = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Read changed files for some time.")
    top.add_argument("--seconds", type=float, default=60.0)
    top.add_argument("--case", metavar="TARGET:NUMBER", help="one case")
    options = top.parse_args()
    cv2.setNumThreads(1)
    names, numbers, until = list(TARGETS), itertools.count(int(time.time()) * 1000), time.monotonic() + options.seconds
    if options.case:
        name, _, number = options.case.partition(":")
        names, numbers, until = [name], iter([int(number)]), float("inf")
    found, counts = dict[tuple[str, str, str], str](), Counter[str]()
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
            key = name, outcome.fault.partition(":")[0], outcome.where
            if outcome.fault and key not in found:
                found[key] = f"{name}:{number}"
                print(f"{name}:{number}: {outcome.fault}\n    {outcome.where}", flush=True)
                KEPT.mkdir(parents=True, exist_ok=True)
                for path in filter(Path.is_file, own.iterdir()):
                    shutil.copy(path, KEPT)
            shutil.rmtree(own)
    for name, count in counts.items():
        print(f"{name}: {count} cases")
    print(f"{len(found)} findings{f'; their files are in {KEPT}' if found else ''}")
    return 1 if found else 0


def _warm_up(target: Target, valid: bytes, path: Path) -> None:
    """Read a valid file, so that the processes of the cases begin with everything imported."""
    path.write_bytes(valid)
    with contextlib.suppress(LogError), contextlib.redirect_stdout(None):
        target.read(path)


if __name__ == "__main__":
    sys.exit(main())
