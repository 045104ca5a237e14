"""`roverflow export`: maps and points of a result log as files."""

from __future__ import annotations

import argparse
import shutil
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, INCOMPLETE, UsageError
from recordings.atomic_write import writing

if TYPE_CHECKING:
    from recordings.export.georeference import Georeference

HELP = "write the maps of a result log as GeoTIFF, PGM with YAML (map_server), PLY and PNG"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    several = "result log; several of them, or the folder of a fleet, with --merge"
    sub.add_argument("results", type=Path, nargs="+", metavar="OUT.mcap", help=several)
    sub.add_argument("folder", type=Path, metavar="DIR", help="folder for the files, created if missing")
    sub.add_argument("--frames", action="store_true", help="write maps and points of every frame, not the regional map")
    sub.add_argument(
        "--map", action="append", default=[], metavar="STREAM", dest="maps",
        help="write the elevation or navigation map of this stream, not the regional map",
    )  # fmt: skip
    sub.add_argument("--crs", metavar="CRS", help="georeference the regional map by fixes: utm, or a zone (EPSG:32633)")
    fixes = "log with the GNSS fixes, a file or a folder; repeatable (the result itself, or its input beside it)"
    sub.add_argument("--fixes", type=Path, action="append", metavar="LOG", help=fixes)
    one_map = "merge the regional maps of several logs into one; their poses must be in one frame"
    sub.add_argument("--merge", action="store_true", help=one_map)


def run(options: argparse.Namespace) -> int:
    """Write the files."""
    results = _results(options)
    if options.fixes and not options.crs:
        raise UsageError("--fixes needs --crs, such as --crs utm")
    if options.folder.exists() and not options.folder.is_dir():
        raise UsageError(f"{options.folder} is a file; give the name of a folder")
    if options.folder.exists() and any(options.folder.iterdir()):
        raise UsageError(f"{options.folder} is not empty; choose another folder, because maps of two runs must not mix")
    lost, existed = Counter[str](), options.folder.exists()
    try:
        with writing(options.folder):
            files, faults = _written(options, results, lost)
    except BaseException:  # a partial export looks like a whole one, and blocks the next attempt
        with suppress(OSError):  # the reason for the failure is the one to report
            for made in options.folder.glob("*"):
                shutil.rmtree(made) if made.is_dir() else made.unlink()
            if not existed:
                options.folder.rmdir()
        raise
    size = sum(file.stat().st_size for file in files)
    say(f"{options.folder}: {counted(len(files), 'file')} ({size / 1e6:.1f} MB)")
    for why in lost:
        say(f"WARNING: {why if options.merge else f'{results[0]}: {why}'}; the rest was exported")
    return INCOMPLETE if lost or faults else COMPLETE


def _written(options: argparse.Namespace, results: list[Path], lost: Counter[str]) -> tuple[list[Path], int]:
    """Write the files; returns them, and the number of pairs of logs that do not fit."""
    if not options.merge:
        from recordings.export.bundle import export

        places = _places(options, results[0], lost)
        files = export(results[0], options.folder, options.frames, lost, options.maps, places)
        for name, place in places.items():
            say(place.sentence(name))
        return files, 0
    from recordings.export.merge import merge

    merged = merge(results, options.folder, lost)
    found = list(merged.sentences())
    for fault, sentence in found:
        say(f"{'WARNING: ' if fault else ''}{sentence}")
    return merged.files, sum(fault for fault, _ in found)


def _places(options: argparse.Namespace, result: Path, lost: Counter[str]) -> dict[str, Georeference]:
    """The place of each frame of reference, if it is wanted."""
    if options.crs is None:
        return {}
    from recordings.export.georeference import georeferences
    from recordings.export.map_files import REGIONAL
    from recordings.scoring.result_log import input_beside

    if options.frames:
        raise UsageError("--crs georeferences regional maps only; leave out --frames")
    beside = input_beside(result)
    logs = [options.fixes] if options.fixes else [[result], *([beside] if beside[0].exists() else [])]
    maps = [f"/nav/{name}" for name in options.maps] or [topic for topic in REGIONAL if topic]
    return georeferences(result, logs, options.crs, maps, lost)


def _results(options: argparse.Namespace) -> list[Path]:
    """The result logs; those of a fleet if its folder is given."""
    if not options.merge:
        if len(options.results) > 1:
            raise UsageError("export takes one result log and a folder; add --merge to merge the maps of several logs")
        return list(options.results)
    if options.frames or options.maps or options.crs:
        raise UsageError("--merge merges regional maps in their own frame; leave out --frames, --map and --crs")
    from flow.cli.fleet.catalogue import Catalogue, outcome

    results: list[Path] = []
    for result in options.results:
        if not result.is_dir():
            results.append(result)
            continue
        for row in Catalogue(result).rows():
            if row["state"] == "done" and row["result"] is not None:
                results.append(result / row["result"])
            else:
                say(f"not merged: {row['name']} has no result ({outcome(row)})")
    if not results:
        raise UsageError(f"the fleet in {options.results[0]} has no result to merge; roverflow list says why")
    return results
