"""`roverflow import middlebury`: makes a log from each Middlebury stereo scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.errors import COMPLETE
from recordings.atomic_write import writing
from recordings.errors import LogError

HELP = "a Middlebury scene with ground truth (camera pose unknown: assumes level, 1 m above ground)"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("source", type=Path, metavar="SOURCE", help="folder of a scene, or a folder of scenes")
    sub.add_argument("out", type=Path, metavar="OUT", help="log; for a folder of scenes, the folder of their logs")


def run(options: argparse.Namespace) -> int:
    """Write the logs."""
    from recordings.importers.middlebury import import_scene, logs_of

    scenes, broken = logs_of(options.source, options.out), list[LogError]()
    for folder, log in scenes:
        if log != options.out and not options.out.exists():
            check_outputs({"folder": options.out})
            with writing(options.out):
                options.out.mkdir()
        check_outputs({"input log": log}, list(folder.iterdir()))
        try:
            say(f"{log}: {import_scene(folder, log)}")
        except LogError as error:  # the other scenes can still be imported
            broken.append(error)
    if broken:
        more = f" ({len(broken)} of {len(scenes)} scenes could not be imported)" if len(scenes) > 1 else ""
        raise type(broken[0])(f"{broken[0]}{more}")
    return COMPLETE
