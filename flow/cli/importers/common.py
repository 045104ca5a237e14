"""What the importers of recordings share: the rig file, progress, and what they print."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE

if TYPE_CHECKING:
    from recordings.importers.recording import ImportedRecording
    from recordings.importers.rig import Rig


def add_recording_arguments(sub: argparse.ArgumentParser, source: str, rig: str) -> None:
    """Add SOURCE, OUT.mcap and --rig. source: what the folder contains; rig: what the rig file says."""
    sub.add_argument("source", type=Path, metavar="SOURCE", help=source)
    sub.add_argument("out", type=Path, metavar="OUT.mcap")
    sub.add_argument("--rig", type=Path, metavar="RIG.yaml", help=f"what the files do not say: {rig}")


def import_recording(
    options: argparse.Namespace, entries: Collection[str], read: Callable[[Rig], ImportedRecording]
) -> int:
    """Read and write a recording, and print notes, frames and size. entries: that the rig file may have."""
    from recordings.importers.recording import write_recording
    from recordings.importers.rig import read_rig

    check_outputs({"input log": options.out}, [path for path in [options.rig] if path is not None])
    recording = read(read_rig(options.rig, entries))
    with progress_bar(options.out, len(recording.pairs)) as shown:
        frames, notes = write_recording(recording, options.out, *shown)
    return complete(options, frames, notes)


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
            report(f"{out}: not complete; the same command continues the import")
            raise


def complete(options: argparse.Namespace, frames: int, notes: Iterable[str]) -> int:
    """Print notes, frames and size of a log; returns the exit code."""
    for note in notes:
        say(f"{options.source}: {note}")
    say(f"{options.out}: {counted(frames, 'stereo frame')} ({options.out.stat().st_size / 1e6:.1f} MB)")
    return COMPLETE
