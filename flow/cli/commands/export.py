"""`roverflow export`: maps and points of a result log as files."""

from __future__ import annotations

import argparse
import shutil
from collections import Counter
from pathlib import Path

from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, INCOMPLETE, UsageError
from recordings.atomic_write import writing

HELP = "maps of a result log as GeoTIFF, PGM with YAML (map_server), PLY and PNG"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap")
    sub.add_argument("folder", type=Path, metavar="DIR", help="folder for the files, made where it is missing")
    sub.add_argument("--frames", action="store_true", help="maps and points of every frame, not the regional map")
    sub.add_argument(
        "--map", action="append", default=[], metavar="STREAM", dest="maps",
        help="an elevation or navigation map of the pipeline by its stream's name, not the regional one",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Write the files."""
    from recordings.export.bundle import export

    if options.folder.exists() and not options.folder.is_dir():
        raise UsageError(f"{options.folder} is a file; give the name of a folder")
    if options.folder.exists() and any(options.folder.iterdir()):
        raise UsageError(f"{options.folder} is not empty, and maps of two runs must not mix; choose another folder")
    lost, made = Counter[str](), not options.folder.exists()
    try:
        with writing(options.folder):
            files = export(options.result, options.folder, options.frames, lost, options.maps)
    except BaseException:  # a partial export looks like a whole one, and blocks the next attempt
        for part in [options.folder] if made else list(options.folder.iterdir()):
            if part.is_dir():
                shutil.rmtree(part, ignore_errors=True)
            else:
                part.unlink(missing_ok=True)
        raise
    size = sum(file.stat().st_size for file in files)
    say(f"{options.folder}: {counted(len(files), 'file')} ({size / 1e6:.1f} MB)")
    for why in lost:
        say(f"WARNING: {options.result}: {why}; the rest was exported")
    return INCOMPLETE if lost else COMPLETE
