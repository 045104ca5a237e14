"""`roverflow desk`: writes the layouts of a recording as files that its viewer opens."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.errors import COMPLETE, UsageError
from recordings.atomic_write import room_to_grow, unwritable, written
from recordings.sinks import DESKS

MAX_LAYOUT_BYTES = 4 << 20  # of a file; it grows with the number of streams, not with the length of the recording
HELP = "write viewer layouts for a recording, one for each kind of question"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("recording", type=Path, metavar="OUT.rrd", help="recording of roverflow run")
    sub.add_argument("--desk", action="append", choices=DESKS, help="layout to write (all of them)")
    sub.add_argument("--out", type=Path, metavar="FOLDER", help="folder for the layout files (that of the recording)")


def run(options: argparse.Namespace) -> int:
    """Write a file for each desk."""
    from recordings.scoring.result_log import about_run
    from recordings.sinks.blueprint import APPLICATION, read_layout

    if about_run(options.recording):
        recording = options.recording.with_suffix(".rrd").name
        raise UsageError(f"{options.recording} is a result log; give its recording, {recording}")
    folder = options.out or options.recording.parent
    paths = {name: folder / f"{options.recording.stem}-{name}.rbl" for name in options.desk or DESKS}
    for path in paths.values():
        check_outputs({"desk": path}, [options.recording])
    layout = read_layout(options.recording)
    for name, path in paths.items():
        with written(path) as temporary:
            if room_to_grow(temporary) < MAX_LAYOUT_BYTES:  # rerun's writer never returns from a full disk
                raise unwritable(path, f"less than {MAX_LAYOUT_BYTES >> 20} MB more can be written there")
            layout.blueprint(name).save(APPLICATION, str(temporary))
        say(f"wrote {path}; {shlex.join(['rerun', str(options.recording), str(path)])} shows it")
    return COMPLETE
