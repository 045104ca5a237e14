"""The command line, and the one place where runtime, stages and recordings meet.

Heavy modules are imported by the command that needs them, so that `roverflow --help` answers at once.
"""

from __future__ import annotations

import argparse
import errno
import json
import logging
import math
import os
import shlex
import shutil
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from flow.cli.arguments import check_demo, check_outputs, count, seconds, size, workers
from flow.cli.report import headline, report, say
from flow.contracts import counted
from flow.errors import (
    COMPLETE,
    FAILED,
    INCOMPLETE,
    INTERRUPTED,
    UNUSABLE,
    RoverflowError,
    SinkError,
    UsageError,
)
from flow.runtime.graph import Graph
from flow.runtime.replay import as_json, product_version, replay
from recordings.atomic_write import writing, written
from recordings.errors import LogError, UnwritableError
from recordings.sinks.overwrite import is_ours

BEGINNING = 0.6  # s of the demo's traverse, one frame


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks for, and say why where it cannot be done; returns the exit code."""
    options = parser().parse_args(arguments)
    logging.basicConfig(level=logging.DEBUG if options.debug else logging.ERROR, format="%(message)s")
    logging.getLogger("numba").setLevel(logging.WARNING)
    try:
        return int(options.command(options))
    except (Exception, KeyboardInterrupt) as error:
        if _interrupted(error):
            print("roverflow: interrupted", file=sys.stderr)
            return INTERRUPTED
        if options.debug:
            traceback.print_exc()
        print(f"roverflow: {_sentence(error, options.debug)}", file=sys.stderr)
        return _exit_code(error)


def _interrupted(error: BaseException | None) -> bool:
    """Whether an interrupt is behind it: of one that comes while compiled code runs, Python makes a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _sentence(error: BaseException, shown: bool) -> str:
    """What is wrong; shown: whether the way there is shown already."""
    if isinstance(error, RoverflowError | LogError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the output'}: {error.strerror}"
    if "cannot cache function" in str(error):  # numba, whose own words name neither the reason nor the remedy
        return "there is no folder to keep compiled kernels in; set NUMBA_CACHE_DIR to one that can be written"
    return f"internal failure, {type(error).__name__}: {error}{'' if shown else ' (--debug shows where)'}"


def _exit_code(error: BaseException) -> int:
    if isinstance(error, RoverflowError):
        return error.exit_code
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        return UNUSABLE
    return UNUSABLE if isinstance(error, LogError) and not isinstance(error, UnwritableError) else FAILED


def parser() -> argparse.ArgumentParser:
    """The command line's grammar: every command brings its own arguments."""
    top = argparse.ArgumentParser(
        prog="roverflow",
        description="Replay rover traverses into terrain one can trust.",
        epilog="Exit codes: 0 complete; 1 an output or the program failed; 2 usage, or a log that cannot be used; "
        "3 finished but incomplete; 130 interrupted, with the outputs of a run closed and readable.",
    )
    top.add_argument("--version", action="version", version=f"roverflow {product_version()}")
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    short = "simulate a short traverse, run it and score it against the truth"
    _command(commands, "demo", short, _demo_arguments, _demo)
    _command(commands, "run", "replay a log through a pipeline", _run_arguments, _run)
    _command(commands, "info", "what a log holds, and what is missing", _info_arguments, _info)
    _command(commands, "graph", "draw the dataflow of a pipeline", _graph_arguments, _graph)
    truth = "make a synthetic traverse with ground truth topics under /truth"
    _command(commands, "simulate", truth, _simulate_arguments, _simulate)
    make = "make a log out of other recordings"
    kinds = commands.add_parser("import", help=make, description=_titled(make)).add_subparsers(
        required=True, metavar="KIND"
    )
    images = "a folder of rectified left and right images"
    _command(kinds, "images", images, _import_images_arguments, _import_images)
    scenes = "a Middlebury scene with its truth; how its camera stood is not told: it is taken to look level from 1 m"
    _command(kinds, "middlebury", scenes, _import_middlebury_arguments, _import_middlebury)
    _command(commands, "score", "errors of a result log against ground truth", _score_arguments, _score)
    maps = "a result log's maps as GeoTIFF, PGM with YAML (map_server), PLY and PNG"
    _command(commands, "export", maps, _export_arguments, _export)
    return top


def _command(
    among: Any,
    name: str,
    help: str,
    add_arguments: Callable[[argparse.ArgumentParser], None],
    work: Callable[[argparse.Namespace], int],
) -> None:
    sub: argparse.ArgumentParser = among.add_parser(name, help=help, description=_titled(help))
    add_arguments(sub)
    sub.add_argument("--debug", action="store_true", help="show tracebacks")
    sub.set_defaults(command=work)


def _titled(help: str) -> str:
    return f"{help[0].upper()}{help[1:]}."


def _write(path: Path | None, text: str) -> None:
    """Write an output of text, where it is asked for."""
    if path is None:
        return
    with written(path) as temporary:
        temporary.write_text(f"{text}\n")


def _pipeline_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("-p", "--pipeline", default="rover", help="rover, fast, paper, or a YAML file (rover)")
    sub.add_argument(
        "--set", action="append", default=[], metavar="STREAM.PARAM=VALUE", help="change a parameter of the pipeline"
    )


def _run_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("log", type=Path, metavar="LOG.mcap")
    _pipeline_arguments(sub)
    sub.add_argument("-o", "--out", type=Path, metavar="OUT.mcap", help="result log (LOG-nav.mcap)")
    recording = sub.add_mutually_exclusive_group()
    recording.add_argument("--rrd", type=Path, metavar="OUT.rrd", help="rerun recording (beside the result log)")
    recording.add_argument("--no-rrd", action="store_true", help="write no rerun recording")
    sub.add_argument("--start", type=seconds, metavar="T", help="begin T seconds after the log's first message")
    sub.add_argument("--end", type=seconds, metavar="T", help="stop T seconds after the log's first message")
    sub.add_argument("--workers", type=workers, default=os.cpu_count() or 1, metavar="N", help="threads (all cores)")
    sub.add_argument("--summary", type=Path, metavar="OUT.json", help="counts, drops, times and verdict as JSON")


def _run(options: argparse.Namespace) -> int:
    out = options.out or options.log.parent / f"{options.log.stem}-nav.mcap"
    rrd = None if options.no_rrd else options.rrd or out.parent / f"{out.stem}.rrd"
    outputs = {"result log": out, "recording": rrd, "summary": options.summary}
    check_outputs(outputs, [options.log, Path(options.pipeline)], is_ours)

    try:
        summary = replay(
            options.log, options.pipeline, out, rrd,
            overrides=options.set, workers=options.workers, start=options.start, end=options.end,
        )  # fmt: skip
    except SinkError as error:
        say(headline(error.summary))
        with suppress(UnwritableError):  # the log's own fault is the one to tell
            _write(options.summary, json.dumps(as_json(error.summary), indent=2))
        raise
    report(summary)
    _write(options.summary, json.dumps(summary, indent=2))
    return _exit_code_of(summary)


def _exit_code_of(summary: dict[str, Any]) -> int:
    if summary["interrupted"]:
        return INTERRUPTED
    return COMPLETE if summary["verdict"] == "COMPLETE" else INCOMPLETE


def _info_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("log", type=Path, metavar="LOG.mcap")
    _pipeline_arguments(sub)
    sub.add_argument("--json", action="store_true", help="print JSON")


def _info(options: argparse.Namespace) -> int:
    from flow.config.loader import load
    from flow.runtime.run import fitted
    from recordings import McapSource
    from recordings.source.inventory import describe, format_description

    graph = load(options.pipeline, options.set)
    if not isinstance(graph.source, McapSource):
        raise UsageError(f"{graph.source_use} is no recordings.McapSource, through which alone info can look at a log")
    with graph.source.open(options.log) as log:
        description = describe(log, *_tolerances(graph))
        try:
            fitted(graph, log)
            description["refused"] = ""
        except UsageError as error:
            description["refused"] = str(error)
    say(json.dumps(description, indent=2) if options.json else format_description(description))
    if not options.json:
        why = description["refused"]
        fits = f"would be refused: {why}" if why else f"has all it needs{_but(graph, description['frames'])}"
        say(f"run -p {options.pipeline}: {fits}")
    return INCOMPLETE if description["damage"] else COMPLETE


def _but(graph: Graph, frames: dict[str, Any]) -> str:
    """What keeps a run from making a single frame of a log that has all streams, in words."""
    if not frames["pairs"] and {"left", "right"} <= graph.source_streams:
        return ", but no left image would find its right one (see frames)"
    return ", but no frame would find its tilt (see frames)" if frames["with_tilt"] == 0 else ""


def _tolerances(graph: Graph) -> tuple[int, int | None]:
    """How far apart the pipeline lets the two images of a frame be, and the tilts around one, ns; None where it does
    not interpolate them."""
    from flow.align import Interpolate, Pair

    slop, max_gap = Pair.slop, None
    for node in graph.aligners:
        if isinstance(node.actor, Pair) and {*node.inputs.values()} == {"left", "right"}:
            slop = node.actor.slop
        if isinstance(node.actor, Interpolate) and node.inputs["stream"] == "inclinometer":
            max_gap = node.actor.max_gap
    return slop, max_gap


def _graph_arguments(sub: argparse.ArgumentParser) -> None:
    _pipeline_arguments(sub)
    sub.add_argument("--format", choices=("text", "mermaid", "svg"), default="text")


def _graph(options: argparse.Namespace) -> int:
    from flow.config.draw import draw
    from flow.config.loader import load

    say(draw(load(options.pipeline, options.set), options.format))
    return COMPLETE


def _simulate_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("out", type=Path, metavar="OUT.mcap")
    sub.add_argument("--frames", type=int, help="stereo frames (default 12)")
    sub.add_argument("--seed", type=int, help="another seed, another terrain (1)")
    sub.add_argument("--size", type=size, default=(1280, 960), metavar="WxH", help="image size (1280x960)")
    sub.add_argument("--baseline", type=float, metavar="M", help="distance between the cameras (0.24)")
    sub.add_argument("--camera-height", type=float, metavar="M", help="of the cameras above the ground (0.9)")
    sub.add_argument("--pitch-down", type=float, metavar="DEG", help="how far the cameras look down (15)")
    sub.add_argument("--rocks", type=float, metavar="K", help="share of ground under rocks (Golombek's k, 0.1)")
    sub.add_argument("--slope", type=float, metavar="DEG", help="RMS slope of the terrain (4)")
    sub.add_argument("--tilt-noise", type=float, metavar="DEG", help="inclinometer noise, one sigma (0.1)")
    scale = "by how much odometry overstates the way (1); 0, with --odometry-turn 0, is exact"
    sub.add_argument("--odometry-scale", type=float, metavar="PERCENT", help=scale)
    turn = "drift of odometry's heading, one sigma after 1 m; it grows with the root of the way (0.2)"
    sub.add_argument("--odometry-turn", type=float, metavar="DEG", help=turn)


def _simulate(options: argparse.Namespace) -> int:
    check_outputs({"input log": options.out}, [], is_ours)
    plain = ("frames", "seed", "baseline", "camera_height")
    settings = {name: getattr(options, name) for name in plain} | {"abundance": options.rocks}
    units = dict.fromkeys(("pitch_down", "slope", "tilt_noise", "odometry_turn"), math.radians(1))
    for name, unit in {**units, "odometry_scale": 0.01}.items():
        given = getattr(options, name)
        settings[name] = None if given is None else given * unit
    settings["width"], settings["height"] = options.size
    try:
        simulate(options.out, **{name: value for name, value in settings.items() if value is not None})
    except UsageError as error:
        other = {"abundance": "--rocks", "width": "the width of --size", "height": "the height of --size"}
        named = {f"Simulation.{name} ": other.get(name, f"--{name.replace('_', '-')}") for name in settings}
        sentence = str(error)
        for name, option in named.items():
            sentence = sentence.replace(name, f"{option} ")
        raise UsageError(sentence) from None
    return COMPLETE


def simulate(out: Path, **settings: Any) -> None:
    """Write a simulated traverse; `settings` are fields of `recordings.simulator.Simulation`."""
    from tqdm import tqdm

    from recordings.simulator import Simulation, write_log

    try:
        simulation = Simulation(**settings)
    except ValueError as error:
        raise UsageError(str(error)) from None
    with tqdm(total=simulation.frames, unit="frame", disable=not sys.stderr.isatty()) as bar:

        def progress(done: int, total: int) -> None:
            bar.update(done - bar.n)

        write_log(simulation, out, progress)
    say(f"{out}: {counted(simulation.frames, 'frame')} with ground truth ({out.stat().st_size / 1e6:.1f} MB)")


def _import_images_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("source", type=Path, metavar="SOURCE", help="folder of left and right images")
    sub.add_argument("out", type=Path, metavar="OUT.mcap")
    camera = "of the rectified pair: fx, cx, cy (px), baseline (m), and fy, cx_right, width, height if need be"
    sub.add_argument("--calibration", type=Path, required=True, metavar="CAM.yaml", help=camera)
    sub.add_argument("--pitch-down", type=float, required=True, metavar="DEG", help="how far the camera looks down")
    sub.add_argument("--roll", type=float, default=0.0, metavar="DEG", help="camera roll, right side down positive")
    sub.add_argument("--height", type=float, required=True, metavar="M", help="camera height above the ground")
    sub.add_argument("--rate", type=float, default=1.0, metavar="HZ", help="frames per second of the log (1)")


def _import_images(options: argparse.Namespace) -> int:
    from recordings.importers.images import import_images, pair_images

    left, right = pair_images(options.source)
    check_outputs({"input log": options.out}, [options.calibration, *left, *right], is_ours)
    frames = import_images(
        left, right, options.calibration, options.out,
        pitch_down=options.pitch_down, roll=options.roll, height=options.height, rate=options.rate,
    )  # fmt: skip
    say(f"{options.out}: {counted(frames, 'stereo frame')} ({options.out.stat().st_size / 1e6:.1f} MB)")
    return COMPLETE


def _import_middlebury_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("source", type=Path, metavar="SOURCE", help="a scene's folder, or a folder of scenes")
    sub.add_argument("out", type=Path, metavar="OUT", help="log; of a folder of scenes, folder for their logs")


def _import_middlebury(options: argparse.Namespace) -> int:
    from recordings.importers.middlebury import import_scene, logs_of

    scenes, broken = logs_of(options.source, options.out), list[LogError]()
    for folder, log in scenes:
        if log != options.out and not options.out.exists():
            check_outputs({"folder": options.out}, [], is_ours)
            with writing(options.out):
                options.out.mkdir()
        check_outputs({"input log": log}, list(folder.iterdir()), is_ours)
        try:
            say(f"{log}: {import_scene(folder, log)}")
        except LogError as error:  # the other scenes can still be had
            broken.append(error)
    if broken:
        more = f" ({len(broken)} of {len(scenes)} scenes could not be imported)" if len(scenes) > 1 else ""
        raise type(broken[0])(f"{broken[0]}{more}")
    return COMPLETE


def _score_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap")
    sub.add_argument("--truth", type=Path, metavar="LOG.mcap", help="log with the /truth topics (the result itself)")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write every figure as JSON")


def _score(options: argparse.Namespace) -> int:
    from recordings.scoring.score import score
    from recordings.scoring.table import format_score

    truth = options.truth or options.result
    check_outputs({"score": options.json}, [options.result, truth], is_ours)
    result = score(options.result, truth)
    _write(options.json, result.to_json())
    say(format_score(result))
    return INCOMPLETE if result.lost or result.unscored else COMPLETE


def _export_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap")
    sub.add_argument("folder", type=Path, metavar="DIR", help="folder for the files, made where it is missing")
    sub.add_argument("--frames", action="store_true", help="maps and points of every frame, not the regional map")


def _export(options: argparse.Namespace) -> int:
    from recordings.export.bundle import export

    if options.folder.exists() and not options.folder.is_dir():
        raise UsageError(f"{options.folder} is a file; give the name of a folder")
    if options.folder.exists() and any(options.folder.iterdir()):
        raise UsageError(f"{options.folder} is not empty, and maps of two runs must not mix; choose another folder")
    lost, made = Counter[str](), not options.folder.exists()
    try:
        with writing(options.folder):
            files = export(options.result, options.folder, options.frames, lost)
    except BaseException:  # half of the maps would look like all, and stand in the way of another try
        for part in [options.folder] if made else list(options.folder.iterdir()):
            if part.is_dir():
                shutil.rmtree(part, ignore_errors=True)
            else:
                part.unlink(missing_ok=True)
        raise
    size = sum(file.stat().st_size for file in files)
    say(f"{options.folder}: {counted(len(files), 'file')} ({size / 1e6:.1f} MB)")
    for why in lost:
        say(f"WARNING: {options.result}: {why}; what is left was exported")
    return INCOMPLETE if lost else COMPLETE


def _demo_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="folder for the results (demo)")
    sub.add_argument("--frames", type=count, default=8, metavar="N", help="frames to simulate (8)")


def _demo(options: argparse.Namespace) -> int:
    from recordings.export.bundle import export
    from recordings.export.png_pages import draw
    from recordings.scoring.score import score
    from recordings.scoring.table import format_brief

    folder = options.out
    check_demo(folder, is_ours)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    log, out, rrd = folder / "traverse.mcap", folder / "result.mcap", folder / "result.rrd"
    outputs = {"input log": log, "result log": out, "recording": rrd, "summary": folder / "summary.json"}
    check_outputs(outputs, [], is_ours)
    say("Simulating a traverse ...")
    simulate(log, frames=options.frames)
    say("Replaying it through the pipeline 'rover', first the beginning, for that compiles what is needed ...")
    for end in (BEGINNING, None):
        summary = replay(log, "rover", out, rrd, workers=os.cpu_count() or 1, end=end)
        if summary["interrupted"]:
            break
    _write(outputs["summary"], json.dumps(summary, indent=2))
    report(summary)
    if summary["interrupted"]:
        return INTERRUPTED
    say(f"\n{format_brief(score(out, log))}")
    say(f"all of it: roverflow score {shlex.quote(str(out))} --truth {shlex.quote(str(log))}")
    shutil.rmtree(folder / "maps", ignore_errors=True)
    with writing(folder):
        pictures, maps = draw(out, folder / "pictures"), export(out, folder / "maps")
    say(f"\n{len(pictures)} pictures in {folder / 'pictures'}, {len(maps)} files of the map in {folder / 'maps'}")
    say(f"the timeline: rerun {shlex.quote(str(rrd))}")
    return _exit_code_of(summary)
