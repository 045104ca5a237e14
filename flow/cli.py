"""The command line, and the one place where runtime, stages and recordings meet.

Heavy modules are imported by the command that needs them, so that `roverflow --help` answers at once.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from flow.arguments import count, seconds, size
from flow.errors import RoverflowError, SinkError, UsageError

COMPLETE, FAILED, UNUSABLE, INCOMPLETE, INTERRUPTED = 0, 1, 2, 3, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = parser().parse_args(arguments)
    logging.basicConfig(level=logging.DEBUG if options.debug else logging.ERROR, format="%(message)s")
    logging.getLogger("numba").setLevel(logging.WARNING)
    try:
        return int(options.command(options))
    except KeyboardInterrupt:
        print("roverflow: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if options.debug:
            raise
        print(f"roverflow: {_sentence(error)}", file=sys.stderr)
        return _exit_code(error)


def _say(text: str) -> None:
    """Print to stdout; a reader that has left does not stop the work."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _sentence(error: Exception) -> str:
    if isinstance(error, RoverflowError) or _is_log_error(error):
        return str(error)
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return f"internal failure, {type(error).__name__}: {error} (--debug shows where)"


def _exit_code(error: Exception) -> int:
    if isinstance(error, RoverflowError):
        return error.exit_code
    return UNUSABLE if _is_log_error(error) or isinstance(error, OSError) else FAILED


def _is_log_error(error: Exception) -> bool:
    from recordings.errors import LogError

    return isinstance(error, LogError)


def parser() -> argparse.ArgumentParser:
    """The command line's grammar."""
    top = argparse.ArgumentParser(
        prog="roverflow",
        description="Replay rover traverses into terrain one can trust.",
        epilog="Exit codes: 0 complete; 1 an output or the program failed; 2 usage, or a log that cannot be used; "
        "3 finished but incomplete; 130 interrupted, with the outputs closed and readable.",
    )
    top.add_argument("--version", action="version", version=f"roverflow {_version()}")
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    def command(
        name: str, work: Callable[[argparse.Namespace], int], help: str, among: Any = commands
    ) -> argparse.ArgumentParser:
        sub: argparse.ArgumentParser = among.add_parser(name, help=help, description=help[0].upper() + help[1:] + ".")
        sub.add_argument("--debug", action="store_true", help="show tracebacks")
        sub.set_defaults(command=work)
        return sub

    demo = command("demo", _demo, "simulate a short traverse, run it and score it against the truth")
    demo.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="folder for the results (demo)")
    demo.add_argument("--frames", type=count, default=8, metavar="N", help="frames to simulate (8)")

    run = command("run", _run, "replay a log through a pipeline")
    run.add_argument("log", type=Path, metavar="LOG.mcap")
    _pipeline_options(run)
    run.add_argument("-o", "--out", type=Path, metavar="OUT.mcap", help="result log (LOG-nav.mcap)")
    recording = run.add_mutually_exclusive_group()
    recording.add_argument("--rrd", type=Path, metavar="OUT.rrd", help="rerun recording (beside the result log)")
    recording.add_argument("--no-rrd", action="store_true", help="write no rerun recording")
    run.add_argument("--start", type=seconds, metavar="T", help="begin T seconds after the log's first message")
    run.add_argument("--end", type=seconds, metavar="T", help="stop T seconds after the log's first message")
    run.add_argument("--workers", type=count, default=os.cpu_count() or 1, metavar="N", help="threads (all cores)")
    run.add_argument("--summary", type=Path, metavar="OUT.json", help="counts, drops, times and verdict as JSON")

    info = command("info", _info, "what a log holds, and what is missing")
    info.add_argument("log", type=Path, metavar="LOG.mcap")
    info.add_argument("--json", action="store_true", help="print JSON")

    graph = command("graph", _graph, "draw the dataflow of a pipeline")
    _pipeline_options(graph)
    graph.add_argument("--format", choices=("text", "mermaid", "svg"), default="text")

    simulate = command("simulate", _simulate, "make a synthetic traverse with ground truth topics under /truth")
    simulate.add_argument("out", type=Path, metavar="OUT.mcap")
    _simulation_options(simulate)

    help = "make a log out of other recordings"
    imports = commands.add_parser("import", help=help, description=help.capitalize() + ".")
    kinds = imports.add_subparsers(required=True, metavar="KIND")
    images = command("images", _import_images, "a folder of rectified left and right images", kinds)
    images.add_argument("source", type=Path, metavar="SOURCE", help="folder of left and right images")
    images.add_argument("out", type=Path, metavar="OUT.mcap")
    _image_options(images)
    scenes = "a Middlebury scene with its truth; how its camera stood is not told: it is taken to look level from 1 m"
    middlebury = command("middlebury", _import_middlebury, scenes, kinds)
    middlebury.add_argument("source", type=Path, metavar="SOURCE", help="a scene's folder, or a folder of scenes")
    middlebury.add_argument("out", type=Path, metavar="OUT", help="log; of a folder of scenes, folder for their logs")

    score = command("score", _score, "errors of a result log against ground truth")
    score.add_argument("result", type=Path, metavar="OUT.mcap")
    score.add_argument("--truth", type=Path, metavar="LOG.mcap", help="log with the /truth topics (the result itself)")
    score.add_argument("--json", type=Path, metavar="FILE", help="write every figure as JSON")

    export = command("export", _export, "a result log's maps as GeoTIFF, PGM with YAML (map_server), PLY and PNG")
    export.add_argument("result", type=Path, metavar="OUT.mcap")
    export.add_argument("folder", type=Path, metavar="DIR", help="folder for the files, made where it is missing")
    export.add_argument("--frames", action="store_true", help="maps and points of every frame, not the regional map")
    return top


def _pipeline_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("-p", "--pipeline", default="rover", help="rover, paper, or a YAML file (rover)")
    sub.add_argument(
        "--set", action="append", default=[], metavar="STREAM.PARAM=VALUE", help="change a parameter of the pipeline"
    )


def _simulation_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--frames", type=count, help="stereo frames (default 12)")
    sub.add_argument("--seed", type=int, help="another seed, another terrain")
    sub.add_argument("--size", type=size, default=(1280, 960), metavar="WxH", help="image size (1280x960)")
    sub.add_argument("--rocks", type=float, metavar="K", help="share of the ground covered by rocks (Golombek's k)")
    sub.add_argument("--slope", type=float, metavar="DEG", help="RMS slope of the terrain")
    sub.add_argument("--tilt-noise", type=float, metavar="DEG", help="inclinometer noise, one sigma")


def _image_options(sub: argparse.ArgumentParser) -> None:
    camera = "of the rectified pair: fx, cx, cy (px), baseline (m), and fy, cx_right, width, height if need be"
    sub.add_argument("--calibration", type=Path, required=True, metavar="CAM.yaml", help=camera)
    sub.add_argument("--pitch-down", type=float, required=True, metavar="DEG", help="how far the camera looks down")
    sub.add_argument("--roll", type=float, default=0.0, metavar="DEG", help="camera roll, right side down positive")
    sub.add_argument("--height", type=float, required=True, metavar="M", help="camera height above the ground")
    sub.add_argument("--rate", type=float, default=1.0, metavar="HZ", help="frames per second of the log (1)")


def _version() -> str:
    try:
        return version("roverflow")
    except PackageNotFoundError:
        return "unknown"


_OF_OTHERS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pfm", ".txt", ".py", ".yaml", ".yml", ".bag", ".db3"}


def _check_outputs(outputs: Sequence[Path | None], inputs: Sequence[Path]) -> None:
    """Refuse outputs that cannot be written, that would replace what is being read, or that are one file twice."""
    taken: list[Path] = []
    for path in filter(None, outputs):
        if not path.parent.is_dir():
            raise UsageError(f"there is no folder {path.parent} for {path.name}; make it first")
        if path.exists() and not path.is_file():
            raise UsageError(f"{path} is a folder or a device; give the name of a file")
        for given in inputs:
            if path.exists() and given.exists() and path.samefile(given):
                raise UsageError(f"{path} is what is being read; choose another name for the output")
        if path.exists() and path.suffix.lower() in _OF_OTHERS:
            raise UsageError(f"{path} is there already, and not the output of an earlier run; choose another name")
        if path.resolve() in taken:
            raise UsageError(f"{path} is given for two outputs; choose another name for one")
        taken.append(path.resolve())


def _run(options: argparse.Namespace) -> int:
    out = options.out or options.log.with_name(f"{options.log.stem}-nav.mcap")
    rrd = None if options.no_rrd else options.rrd or out.with_suffix(".rrd")
    _check_outputs([out, rrd, options.summary], [options.log, Path(options.pipeline)])

    def keep(summary: dict[str, Any]) -> None:
        if options.summary:
            options.summary.write_text(json.dumps(summary, indent=2) + "\n")

    try:
        summary = replay(
            options.log, options.pipeline, out, rrd,
            overrides=options.set, workers=options.workers, start=options.start, end=options.end,
        )  # fmt: skip
    except SinkError as error:
        keep(_as_json(error.summary))
        raise
    keep(summary)
    _report(summary)
    return _exit_code_of(summary)


def _exit_code_of(summary: dict[str, Any]) -> int:
    if summary["interrupted"]:
        return INTERRUPTED
    return COMPLETE if summary["verdict"] == "COMPLETE" else INCOMPLETE


def replay(
    log: Path,
    pipeline: str,
    out: Path,
    rrd: Path | None,
    *,
    overrides: Sequence[str] = (),
    workers: int = 2,
    start: float | None = None,
    end: float | None = None,
) -> dict[str, Any]:
    """Run a log through a pipeline into a result log and, unless None, a rerun recording; returns the summary."""
    import cv2
    from threadpoolctl import threadpool_limits
    from tqdm import tqdm

    from flow import pipeline as pipelines
    from flow.allocator import keep_freed_memory
    from flow.run import Stop, interrupts, run

    graph = pipelines.load(pipeline, overrides)
    outputs = {}
    for use, sink in graph.sinks:
        path = {".mcap": out, ".rrd": rrd}.get(sink.suffix)
        if path is not None:
            outputs[use] = path
    keep_freed_memory()
    cv2.setNumThreads(1)  # frames in flight fill the cores, not threads inside one call
    stop = Stop()
    with graph.source.open(log, start=start, end=end) as opened, threadpool_limits(1):
        about = {
            "roverflow": _version(),
            "pipeline": graph.text,
            "overrides": "\n".join(overrides),
            "log": log.name,
            **{name: version(name) for name in ("numpy", "opencv-python-headless", "numba", "scikit-image")},
        }
        with tqdm(total=opened.frames, unit="frame", disable=not sys.stderr.isatty()) as bar:
            drops = 0

            def on_frame(whole: bool) -> None:
                nonlocal drops
                drops += not whole
                bar.set_postfix(dropped=drops, refresh=False)
                bar.update()

            with interrupts(stop, lambda sentence: bar.write(f"roverflow: {sentence}", file=sys.stderr)):
                summary = run(graph, opened, outputs, workers=workers, about=about, stop=stop, on_frame=on_frame)
    return _as_json(summary | {"overrides": list(overrides)})


def _as_json(summary: dict[str, Any]) -> dict[str, Any]:
    """A run's summary without the ledger's entry objects; "ledger" has them as plain values."""
    return {name: value for name, value in summary.items() if name != "entries"}


def _report(summary: dict[str, Any]) -> None:
    rate = f"{summary['frames_per_second']:.2f} frames/s"
    _say(f"{summary['verdict']}: {summary['frames_out']} of {summary['frames_in']} frames whole, {rate}")
    for stream, finding in [*summary["surveys"].items(), *summary["findings"].items()]:
        _say(f"  {stream}: {finding}")
    for reason, number in summary["drops"].items():
        first = next(entry for entry in summary["ledger"] if entry["reason"] == reason)
        _say(f"  {number} {reason}, first: {first['stream']} at {first['stamp']}: {first['detail']}")
    for path in map(Path, summary["outputs"]):
        _say(f"  {path} ({path.stat().st_size / 1e6:.1f} MB)")


def _info(options: argparse.Namespace) -> int:
    from recordings import McapSource
    from recordings.inventory import describe, format_description

    description = describe(options.log, McapSource())
    _say(json.dumps(description, indent=2) if options.json else format_description(description))
    return COMPLETE


def _graph(options: argparse.Namespace) -> int:
    from flow.draw import draw
    from flow.pipeline import load

    _say(draw(load(options.pipeline, options.set), options.format))
    return COMPLETE


def _simulate(options: argparse.Namespace) -> int:
    _check_outputs([options.out], [])
    settings = {
        "frames": options.frames,
        "seed": options.seed,
        "abundance": options.rocks,
        "slope": None if options.slope is None else math.radians(options.slope),
        "tilt_noise": None if options.tilt_noise is None else math.radians(options.tilt_noise),
    }
    width, height = options.size
    simulate(options.out, width=width, height=height, **{k: v for k, v in settings.items() if v is not None})
    return COMPLETE


def simulate(out: Path, **settings: Any) -> None:
    """Write a simulated traverse; `settings` are fields of `recordings.simulator.Simulation`."""
    from tqdm import tqdm

    from recordings.simulator import Simulation

    try:
        simulation = Simulation(**settings)
    except ValueError as error:
        raise UsageError(str(error)) from None
    with tqdm(total=simulation.frames, unit="frame", disable=not sys.stderr.isatty()) as bar:

        def progress(done: int, total: int) -> None:
            bar.update(done - bar.n)

        simulation.write(out, progress)
    _say(f"{out}: {simulation.frames} frames with ground truth ({out.stat().st_size / 1e6:.1f} MB)")


def _import_images(options: argparse.Namespace) -> int:
    from recordings.image_log import import_images, pair_images

    left, right = pair_images(options.source)
    _check_outputs([options.out], [options.calibration, *left, *right])
    frames = import_images(
        left, right, options.calibration, options.out,
        pitch_down=options.pitch_down, roll=options.roll, height=options.height, rate=options.rate,
    )  # fmt: skip
    _say(f"{options.out}: {frames} stereo frames ({options.out.stat().st_size / 1e6:.1f} MB)")
    return COMPLETE


def _import_middlebury(options: argparse.Namespace) -> int:
    from recordings.errors import LogError
    from recordings.middlebury import import_scene, logs_of

    scenes, broken = logs_of(options.source, options.out), list[LogError]()
    for folder, log in scenes:
        if log != options.out and not options.out.exists():
            _check_outputs([options.out], [])
            options.out.mkdir()
        _check_outputs([log], list(folder.iterdir()))
        try:
            _say(f"{log}: {import_scene(folder, log)}")
        except LogError as error:  # the other scenes can still be had
            broken.append(error)
    if broken:
        more = f" ({len(broken)} of {len(scenes)} scenes could not be imported)" if len(scenes) > 1 else ""
        raise LogError(f"{broken[0]}{more}")
    return COMPLETE


def _score(options: argparse.Namespace) -> int:
    from recordings.score_table import format_score
    from recordings.scoring import score

    truth = options.truth or options.result
    _check_outputs([options.json], [options.result, truth])
    result = score(options.result, truth)
    if options.json:
        options.json.write_text(result.to_json() + "\n")
    _say(format_score(result))
    return COMPLETE


def _export(options: argparse.Namespace) -> int:
    from recordings.export.bundle import export

    if options.folder.exists() and not options.folder.is_dir():
        raise UsageError(f"{options.folder} is a file; give the name of a folder")
    if options.folder.exists() and any(options.folder.iterdir()):
        raise UsageError(f"{options.folder} is not empty, and maps of two runs must not mix; choose another folder")
    files = export(options.result, options.folder, options.frames)
    size = sum(file.stat().st_size for file in files)
    _say(f"{options.folder}: {len(files)} files ({size / 1e6:.1f} MB)")
    return COMPLETE


def _demo(options: argparse.Namespace) -> int:
    from recordings.export.bundle import export
    from recordings.pictures import draw
    from recordings.score_table import format_score
    from recordings.scoring import score

    folder = options.out
    folder.mkdir(parents=True, exist_ok=True)
    log, out, rrd = folder / "traverse.mcap", folder / "result.mcap", folder / "result.rrd"
    _say("Simulating a traverse ...")
    simulate(log, frames=options.frames)
    _say("Replaying it through the pipeline 'rover' ...")
    summary = replay(log, "rover", out, rrd, workers=os.cpu_count() or 1)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    _report(summary)
    _say(f"\n{format_score(score(out, log))}")
    shutil.rmtree(folder / "maps", ignore_errors=True)
    pictures, maps = draw(out, folder / "pictures"), export(out, folder / "maps")
    _say(f"\n{len(pictures)} pictures in {folder / 'pictures'}, {len(maps)} files of the map in {folder / 'maps'}")
    _say(f"the timeline: rerun {rrd}")
    return _exit_code_of(summary)


if __name__ == "__main__":
    sys.exit(main())
