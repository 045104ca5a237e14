"""What a fleet shows while it runs: a line for each log that ends, and on a terminal a bar."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from flow.cli.fleet.catalogue import Catalogue, outcome
from flow.cli.report import duration, say
from flow.contracts import counted
from flow.errors import COMPLETE, INCOMPLETE
from recordings.containers.finding import RESULT_ENDING

WATCH_SECONDS = 2.0


class Progress(AbstractContextManager["Progress"]):
    """Logs, frames and bytes of a fleet.

    left: name -> bytes of each log that has not ended; logs, frames: those that have ended before, and their frames.
    """

    def __init__(self, left: Mapping[str, int], logs: int = 0, frames: int = 0) -> None:
        from tqdm import tqdm

        self._left, self._ended, self._all = dict(left), logs, logs + len(left)
        self._frames, self._frames_before, self._size = frames, frames, sum(left.values())
        self._running = dict[str, int]()
        self._begun = time.monotonic()
        hidden = not sys.stderr.isatty()
        self._bar = tqdm(total=self._size, unit="B", unit_scale=True, smoothing=0, disable=hidden)

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        with self._bar.external_write_mode():
            say(text)

    def show(self, running: Mapping[str, int]) -> None:
        """Move the bar; running: name -> frames so far of each log that runs."""
        self._running = dict(running)
        self._bar.n = round(self._size - self._bytes_left())
        frames = counted(self._frames + sum(running.values()), "frame")
        self._bar.set_postfix_str(f"{self._ended} of {counted(self._all, 'log')}, {frames}")

    def end(self, name: str, row: Mapping[str, Any]) -> None:
        """Print the line of a log that has ended."""
        self._left.pop(name, None)
        self._running.pop(name, None)
        self._ended += 1
        self._frames += row.get("frames") or 0
        line = f"{self._ended} of {self._all}: {name}: {line_of(row)}"
        if left := self._bytes_left():
            seconds = (time.monotonic() - self._begun) * left / max(self._size - left, 1)
            frames = counted(self._frames + sum(self._running.values()), "frame")
            line += f"; {frames} so far, {left / 1e9:.2f} GB left, about {duration(seconds)}"
        self.say(line)

    def _bytes_left(self) -> float:
        """Bytes that are not read yet, by the mean size of the frames of logs that have ended."""
        left, frames = sum(self._left.values()), self._frames - self._frames_before
        size = (self._size - left) / frames if frames else 0.0
        return left - sum(min(size * self._running.get(name, 0), whole) for name, whole in self._left.items())


def watch(catalogue: Catalogue) -> int:
    """Show a fleet of another process until its logs have ended; the exit code is 3 unless all are COMPLETE."""
    rows = _rows(catalogue)
    while not _active(rows) and catalogue.is_held():  # it starts
        time.sleep(WATCH_SECONDS / 10)
        rows = _rows(catalogue)
    say(_states(rows))
    left = {name: row["bytes"] for name, row in _active(rows).items()}
    frames, any_left = sum(row["frames"] or 0 for row in rows.values()), bool(left)
    with Progress(left, len(rows) - len(left), frames) as progress:
        while left:
            held = catalogue.is_held()  # before the rows, so that these are the last ones of a process that ended
            rows = _rows(catalogue)
            for name in left.keys() - _active(rows).keys():
                progress.end(name, rows[name])
                del left[name]
            files = {name: catalogue.path.parent / f"{name}{RESULT_ENDING}.progress" for name in left}
            progress.show({name: frames_so_far(file) or 0 for name, file in files.items()})
            if left and held is False:
                progress.say(
                    f"no process runs this fleet, {counted(len(left), 'log')} left; run its command again to continue"
                )
                return INCOMPLETE
            time.sleep(WATCH_SECONDS if left else 0.0)
    if any_left:
        say(_states(rows))
    return COMPLETE if {outcome(row) for row in rows.values()} <= {"COMPLETE"} else INCOMPLETE


def frames_so_far(file: Path) -> int | None:
    """The frames of a log that runs, by its file; None if it has not begun, or ends or writes just now."""
    try:
        return int(file.read_text()) - 1
    except (OSError, ValueError):
        return None


def is_progress(file: Path) -> bool:
    """Whether a file contains the frames of a log that runs, or nothing, as one that is being written."""
    try:
        return (file.read_text() or "0").isdecimal()
    except (OSError, ValueError):
        return False


def line_of(row: Mapping[str, Any]) -> str:
    """One line about a log that has ended."""
    if row["state"] != "done":
        return f"{row['state']}: {row['why']}"
    why = f", {row['why']}" if row.get("why") else ""
    frames = f"{row['complete']} of {row['frames']} frames{why}"
    return f"{row['verdict']}, {frames}; {row['seconds']:.0f} s on {row['node']}"


def _rows(catalogue: Catalogue) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in catalogue.rows(sort="ended, name")}


def _active(rows: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {name: row for name, row in rows.items() if row["state"] in ("waiting", "running")}


def _states(rows: Mapping[str, dict[str, Any]]) -> str:
    """How many logs have which state, with the frames of those that have ended and the bytes of the others."""
    states = Counter(str(row["state"]) for row in rows.values())
    line = ", ".join(f"{number} {state}" for state, number in sorted(states.items()))
    frames = sum(row["frames"] or 0 for row in rows.values())
    left = sum(row["bytes"] for row in _active(rows).values())
    return f"{line}; {counted(frames, 'frame')} so far, {left / 1e9:.2f} GB left"
