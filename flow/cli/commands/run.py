"""`roverflow run`: replays a log through a pipeline."""

from __future__ import annotations

import argparse
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from flow.cli.arguments import every, rate, seconds, workers
from flow.cli.checkpoint_file import checkpoint_of
from flow.cli.outputs import add_log, add_pipeline_options, check_outputs, check_used, default_result, write_text
from flow.cli.replay import as_json, replay
from flow.cli.report import exit_code, headline, report, say
from flow.cli.watching import watched
from flow.errors import SinkError, UsageError
from recordings.containers.finding import find_files
from recordings.errors import UnwritableError
from recordings.sinks import DESKS

HELP = "replay a log through a pipeline"
OF_OUTPUTS = {".mcap": ("out", "profile", "with_inputs"), ".rrd": ("rrd", "desk", "view", "serve")}  # ending -> options


def add_arguments(sub: argparse.ArgumentParser) -> None:
    add_log(sub)
    add_pipeline_options(sub)
    sub.add_argument("-o", "--out", type=Path, metavar="OUT.mcap", help="result log (LOG-nav.mcap)")
    sub.add_argument(
        "--profile",
        choices=("ros2", "foxglove"),
        help="message types of the result log (ros2); score, export, diff and report read only ros2",
    )
    sub.add_argument(
        "--with-inputs", action="store_true", help="copy the input messages into the result log, byte for byte"
    )
    recording = sub.add_mutually_exclusive_group()
    recording.add_argument("--rrd", type=Path, metavar="OUT.rrd", help="rerun recording (beside the result log)")
    recording.add_argument("--no-rrd", action="store_true", help="write no rerun recording")
    sub.add_argument("--desk", choices=DESKS, help="viewer layout that the recording opens with (overview)")
    watching = sub.add_mutually_exclusive_group()
    watching.add_argument("--view", action="store_true", help="open the viewer and watch the run")
    watching.add_argument(
        "--serve", action="store_true", help="show the run in a browser on this machine until it ends"
    )
    sub.add_argument("--start", type=seconds, metavar="T", help="begin T seconds after the log's first message")
    sub.add_argument("--end", type=seconds, metavar="T", help="stop T seconds after the log's first message")
    sub.add_argument(
        "--every",
        type=every,
        metavar="N|LENGTH",
        help="take every N-th stereo frame, or one per LENGTH driven, such as 0.5m, by the log's odometry (1)",
    )
    sub.add_argument(
        "--rate",
        type=rate,
        metavar="R",
        help="replay at R times the pace of the log and drop the frames that find no free worker, as on the vehicle "
        "(as fast as possible, no frame dropped)",
    )
    sub.add_argument(
        "--resume",
        action="store_true",
        help="make checkpoints, and go on from the last one of a run of this command that was stopped or killed",
    )
    sub.add_argument("--workers", type=workers, default=os.cpu_count() or 1, metavar="N", help="threads (all cores)")
    sub.add_argument("--summary", type=Path, metavar="OUT.json", help="write counts, losses, times and verdict as JSON")


def run(options: argparse.Namespace) -> int:
    """Run the pipeline, print the verdict and write the summary."""
    from flow.config.loader import load, pipeline_file

    find_files(options.log)  # refuses a wrong name at once
    pipeline_file(options.pipeline)
    out = options.out or default_result(options.log)
    rrd = None if options.no_rrd else options.rrd or out.parent / f"{out.stem}.rrd"
    outputs = {"result log": out, "recording": rrd, "summary": options.summary}
    check_outputs(outputs, [*options.log, Path(options.pipeline)])
    if rrd is None and (options.view or options.serve or options.desk):
        raise UsageError("--view, --serve and --desk need the recording; leave out --no-rrd")
    given = {
        ending: [f"--{name.replace('_', '-')}" for name in names if getattr(options, name)]
        for ending, names in OF_OUTPUTS.items()
    }
    check_used(load(options.pipeline, options.set), given)
    names = ("workers", "start", "end", "every", "rate", "profile", "desk", "with_inputs", "resume")
    settings: dict[str, Any] = {name: getattr(options, name) for name in names}
    try:
        with watched(options.view, options.serve, rrd) as pipe:
            summary = replay(options.log, options.pipeline, out, rrd, overrides=options.set, live_pipe=pipe, **settings)
    except SinkError as error:
        say(headline(error.summary))
        with suppress(UnwritableError):  # the failed sink is the error to report
            write_text(options.summary, json.dumps(as_json(error.summary), indent=2))
        _say_how_to_go_on(options, out)
        raise
    from stages.kernel_loading import compiled_now

    report(summary, compiled_now())
    _say_how_to_go_on(options, out)
    write_text(options.summary, json.dumps(summary, indent=2))
    return exit_code(summary)


def _say_how_to_go_on(options: argparse.Namespace, out: Path) -> None:
    """Print that a run which was stopped can go on."""
    if options.resume and checkpoint_of(out).exists():
        say("the same command goes on from the last checkpoint")
