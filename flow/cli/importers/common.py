"""What importers share: progress, and what they print."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE


@contextmanager
def progress_bar(out: Path, frames: int) -> Iterator[tuple[Callable[[int], None], Callable[[str], None]]]:
    """Yield what shows the frames done so far, and what prints a sentence; an interrupt prints how to continue."""
    from tqdm import tqdm

    with tqdm(total=frames, unit="frame", disable=not sys.stderr.isatty()) as bar:

        def progress(done: int) -> None:
            bar.update(done - bar.n)

        def report(sentence: str) -> None:
            with tqdm.external_write_mode():
                say(sentence)

        try:
            yield progress, report
        except KeyboardInterrupt:
            report(f"{out}: not complete; run the same command again to continue the import")
            raise


def complete(options: argparse.Namespace, frames: int, notes: Iterable[str]) -> int:
    """Print notes, frames and size of a log; returns the exit code."""
    for note in notes:
        say(f"{options.source}: {note}")
    say(f"{options.out}: {counted(frames, 'stereo frame')} ({options.out.stat().st_size / 1e6:.1f} MB)")
    return COMPLETE
