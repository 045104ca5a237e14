"""`roverflow try`: an instant of a log with and without a change of the pipeline."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from flow.cli.arguments import AT, count, instant, workers
from flow.cli.debugging.viewer_cursor import without_cursor
from flow.cli.outputs import add_log, check_outputs
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, UsageError
from recordings.containers.finding import find_files

if TYPE_CHECKING:
    from recordings.comparison.diff import Diff
    from recordings.comparison.recording import DiffRecording
    from recordings.comparison.sweep import Sweep

HELP = "run one instant of a log with and without a pipeline change, and compare the results"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    add_log(sub)
    sub.add_argument("--at", type=instant, required=True, metavar="T", help=AT)
    sub.add_argument("--frames", type=count, default=1, metavar="N", help="number of frames from that instant on (1)")
    before = "frames to run before it, for stages with state: regional map, pose, tilt check (0)"
    state = sub.add_mutually_exclusive_group()
    state.add_argument("--before", type=partial(count, low=0), default=0, metavar="N", help=before)
    logged = "result log of the whole run: supplies pipeline A, and the regional map and pose to begin with"
    state.add_argument("--result", type=Path, metavar="OUT.mcap", help=logged)
    sub.add_argument("-p", "--pipeline", help="rover, fast, accurate, paper, or a YAML file (rover)")
    several = "the change; repeat it with other values of one parameter to compare them all"
    sub.add_argument("--set", action="append", default=[], required=True, metavar="STREAM.PARAM=VALUE", help=several)
    sub.add_argument("-o", "--out", type=Path, metavar="OUT.rrd", help="recording of the comparison (LOG-try.rrd)")
    sub.add_argument("--workers", type=workers, default=os.cpu_count() or 1, metavar="N", help="threads (all cores)")


def run(options: argparse.Namespace) -> int:
    """Run the variants, print how they differ, and write the recording."""
    find_files(options.log)
    out = options.out or options.log[0].with_name(f"{options.log[0].stem}-try.rrd")
    result: Path | None = options.result
    if result is not None and options.pipeline:
        raise UsageError(f"the pipeline is that of {result}; leave out -p")
    check_outputs({"difference": out}, [*options.log, *filter(None, [result])])
    from flow.cli.debugging.what_if import changes_of, run_variants, summary_lines, swept_setting

    changes, pipeline = changes_of(options.set), result or options.pipeline or "rover"
    unchanged = f"A: {pipeline}, unchanged" if result is None else f"A: the run of {result}"
    at, frames, before = without_cursor(options.at), options.frames, options.before
    with TemporaryDirectory(prefix="roverflow-try-") as folder:
        paths, variants, part, notes = run_variants(
            options.log, pipeline, changes, Path(folder), at=at, frames=frames, before=before, workers=options.workers
        )
        say("\n".join([*summary_lines(variants, part), *notes, "", unchanged]))
        recording, differences, tables = compared(paths, changes)
        if all(found.equal for found in differences.values()):
            say(f"\nthe change has no effect on {counted(part.frames, 'frame')}, so there is no recording to write")
            return COMPLETE
        title, setting = f"{options.log[0].name} at {part.at:g} s", swept_setting(changes)
        text = "\n\n".join([unchanged, *notes, *tables])
        recording.write(out, title, text, _sweep(setting, {}, differences))
        say(f"\nwrote {out} ({out.stat().st_size / 1e6:.1f} MB)")
        errors, unscored = _errors(paths, options.log)
        if errors:
            from recordings.comparison.truth import error_pages

            rows = _rows(errors)
            say("\n" + "\n".join([*("  ".join(f"{cell:>12}" for cell in row) for row in rows), *unscored]))
            recording.errors = [*error_pages(paths, options.log)]
            text = "\n\n".join(["## Errors", _markdown(rows), text])
            recording.write(out, title, text, _sweep(setting, errors, differences))
            say(f"\nadded the errors to {out}")
    return COMPLETE


def compared(
    paths: Mapping[str, Path], changes: Mapping[str, Sequence[str]]
) -> tuple[DiffRecording, dict[str, Diff], list[str]]:
    """Compare the variants with A, and print how they differ. Returns the recording, variant -> difference, and tables.

    paths: variant -> its result log; changes: variant -> its changes.
    """
    from recordings.comparison.diff import diff
    from recordings.comparison.recording import DiffRecording
    from recordings.comparison.text import comparison, markdown

    recording, differences, tables = DiffRecording(), dict[str, "Diff"](), list[str]()
    for label, path in list(paths.items())[1:]:
        title = f"{label}: {', '.join(changes[label])}"
        differences[label] = found = diff(paths["A"], path, recording.of(label, f"{label}: {changes[label][-1]}"))
        say(f"\n{title}\n{comparison(found)}")
        tables += [f"## {title}", markdown(found)]
    return recording, differences, tables


def _errors(paths: dict[str, Path], truth: Sequence[Path]) -> tuple[dict[str, list[float]], list[str]]:
    """Variant -> its errors against the truth of the log, as `brief_figures`, and what is not scored and why.

    Both are empty without truth.
    """
    from recordings.errors import LogError
    from recordings.scoring.score import score
    from recordings.scoring.table import SCORES, brief_figures

    errors, unscored = dict[str, list[float]](), list[str]()
    for label, path in paths.items():
        try:
            found = score(path, truth, whole=False)
        except LogError as error:
            errors[label] = [math.nan] * len(SCORES[1:])
            unscored.append(f"{label} not scored: {str(error).replace(f'{path} ', 'it ', 1)}")
            continue
        errors[label] = brief_figures(found)
        unscored += [f"{label} not scored: {topic}: {why}" for topic, whys in found.unscored.items() for why in whys]
    if all(math.isnan(figure) for figures in errors.values() for figure in figures):  # the log has no truth
        return {}, []
    return errors, unscored


def _rows(errors: Mapping[str, Sequence[float]]) -> list[tuple[str, ...]]:
    """A table of the errors, with a head."""
    from recordings.scoring.table import SCORES, brief_row

    return [("", *SCORES[1:]), *(brief_row(label, figures) for label, figures in errors.items())]


def _sweep(
    setting: tuple[str, list[str]] | None, errors: Mapping[str, Sequence[float]], differences: Mapping[str, Diff]
) -> Sweep | None:
    """The errors, and the numbers of changed pixels and cells, over the values of a setting; None without one."""
    from recordings.comparison.sweep import Sweep, changed
    from recordings.scoring.table import brief_columns

    if setting is None:
        return None
    figures = brief_columns(errors.values())
    counts = {label: changed(found) for label, found in differences.items()}
    for topic in dict.fromkeys(topic for each in counts.values() for topic in each):
        title = f"{topic}: changed {'pixels' if 'disparity' in topic else 'cells'}"
        figures[title] = [0.0, *(each.get(topic, 0.0) for each in counts.values())]
    return Sweep(*setting, figures) if figures else None


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    head, *lines = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join([head, "|" + "---|" * len(rows[0]), *lines])
