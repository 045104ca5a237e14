"""`roverflow demo`: simulates a short traverse, replays it and scores it against its ground truth."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
from pathlib import Path

from flow.cli.arguments import count
from flow.cli.commands.simulate import simulate
from flow.cli.outputs import check_outputs, write_text
from flow.cli.replay import replay
from flow.cli.report import exit_code, report, say
from flow.errors import INTERRUPTED, UsageError
from recordings.atomic_write import writing
from recordings.sinks.overwrite import is_ours

HELP = "simulate a short traverse, replay it and score it against ground truth"
FRAME_MB = 15  # input log 10, result log 3.5, recording 1
MAPS_MB = 3  # pictures and exported maps


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Declare the options."""
    sub.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="folder for the results (demo)")
    sub.add_argument("--frames", type=count, default=8, metavar="N", help="number of frames to simulate (8)")


def run(options: argparse.Namespace) -> int:
    """Simulate, replay, score, draw and export."""
    from recordings.export.bundle import export
    from recordings.export.png_pages import draw
    from recordings.scoring.score import score
    from recordings.scoring.table import format_brief

    folder = options.out
    check_folder(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    log, out, rrd = folder / "traverse.mcap", folder / "result.mcap", folder / "result.rrd"
    outputs = {"input log": log, "result log": out, "recording": rrd, "summary": folder / "summary.json"}
    check_outputs(outputs)
    say(f"The demo writes about {FRAME_MB * options.frames + MAPS_MB} MB to {folder}.")
    say("Simulating a traverse ...")
    simulate(log, frames=options.frames)
    say("Replaying it through the pipeline 'rover', twice: the first time may compile kernels ...")
    for _ in range(2):
        summary = replay(log, "rover", out, rrd, workers=os.cpu_count() or 1)
        if summary["interrupted"]:
            break
    write_text(outputs["summary"], json.dumps(summary, indent=2))
    report(summary)
    if summary["interrupted"]:
        return INTERRUPTED
    say(f"\n{format_brief(score(out, log))}")
    say(f"Every figure: roverflow score {shlex.quote(str(out))} --truth {shlex.quote(str(log))}")
    shutil.rmtree(folder / "maps", ignore_errors=True)
    with writing(folder):
        pictures, maps = draw(out, folder / "pictures"), export(out, folder / "maps")
    say(f"\n{len(pictures)} pictures in {folder / 'pictures'}, {len(maps)} map files in {folder / 'maps'}")
    say(f"Timeline: rerun {shlex.quote(str(rrd))}")
    return exit_code(summary)


def check_folder(folder: Path) -> None:
    """Refuse a folder that contains files of anything but an earlier demo, because its log and maps are replaced."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; give the name of a folder with --out")
    if not folder.exists() or not any(folder.iterdir()):
        return
    log = folder / "traverse.mcap"
    finished = (folder / "summary.json").is_file() or not (folder / "maps").exists()
    if not log.is_file() or not is_ours(log, "input log") or not finished:
        raise UsageError(f"{folder} is not empty and not from an earlier demo; choose another folder with --out")
