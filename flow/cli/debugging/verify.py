"""`roverflow verify`: whether a result log is as its run wrote it, and whether the same run gives it again."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from flow.cli.arguments import every, workers
from flow.cli.outputs import check_outputs
from flow.cli.replay import replay, versions
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, DIFFERENT, UsageError

HELP = "check that a result log is as its run wrote it, and that the same run gives the same messages again"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap", help="result log of a run")
    beside = "input of the run, one or more files (the log that the result names, beside it)"
    sub.add_argument("--log", nargs="+", type=Path, metavar="LOG", help=beside)
    sub.add_argument("-o", "--out", type=Path, metavar="AGAIN.mcap", help="keep the result of the second run")
    sub.add_argument("--workers", type=workers, default=os.cpu_count() or 1, metavar="N", help="threads (all cores)")


def run(options: argparse.Namespace) -> int:
    """Print what differs; the exit code is 0 if nothing does, and 3 otherwise."""
    result: Path = options.result
    check_outputs({"result log": options.out}, [result, *(options.log or [])])
    from flow.cli.debugging.result_input import RESULT
    from recordings.scoring.result_log import end_of_run, facts_of, names_of

    about, stated = facts_of(result, RESULT), end_of_run(result, "roverflow.digests")
    if not stated:
        raise UsageError(f"{result} has no digests of its topics, because its end is missing; run its log again")
    found = _digests(result)
    changed = _differing(stated, found)
    topics = counted(len(stated), "topic")
    say(f"changed since its run: {', '.join(changed)}" if changed else f"{topics} as the run wrote them")
    end = end_of_run(result)
    if end.get("interrupted") == "True" or "drops.dropped" in end:
        why = "dropped frames" if "drops.dropped" in end else "was interrupted"
        raise UsageError(f"the run of {result} {why}, so it cannot be repeated; only the file was checked")
    with TemporaryDirectory(prefix="roverflow-") as folder:
        again = options.out or Path(folder) / "again.mcap"
        logs, notes = _input(result, options.log)
        _run_again(result, logs, about, again, options.workers, with_inputs=bool(found.keys() - stated.keys()))
        differing = _differing(stated, _digests(again)) if again.exists() else sorted(stated)
    if differing:
        keep = f"roverflow diff {result} {again}" if options.out else "-o AGAIN.mcap keeps the second result"
        notes += [f"different in a second run: {', '.join(differing)}", _versions(about), keep]
    else:
        notes.append(f"{topics} the same in a second run of {names_of(logs)}")
    say("\n".join(notes))
    return DIFFERENT if changed or differing else COMPLETE


def _input(result: Path, given: list[Path] | None) -> tuple[list[Path], list[str]]:
    """The files of the input of a result log, and notes about them. given: by the user."""
    from flow.cli.debugging.result_input import graph_of, input_of
    from recordings.scoring.result_log import input_beside

    with input_of(graph_of(result), result, given) as (_, notes):
        return given or input_beside(result), notes


def _run_again(
    result: Path, logs: list[Path], about: Mapping[str, str], out: Path, workers: int, with_inputs: bool
) -> None:
    """Repeat the run of a result log. about: its facts."""
    from flow.cli.debugging.result_input import pipeline_of_run
    from recordings.scoring.result_log import pipeline_of

    start, end = (float(about[name]) if about.get(name) else None for name in ("start", "end"))
    with pipeline_of_run(about, pipeline_of(result)) as pipeline:
        replay(
            logs, pipeline, out, None, overrides=about["overrides"].splitlines(), start=start, end=end,
            every=every(about["every"]) if about.get("every") else None, profile=about.get("profile"),
            with_inputs=with_inputs, workers=workers,
        )  # fmt: skip


def _digests(result: Path) -> dict[str, str]:
    """The digests of the topics of a log; raises LogError if it is damaged."""
    from mcap.exceptions import McapError

    from recordings.errors import LogError
    from recordings.mcap.digests import digests_of

    try:
        return digests_of(result)
    except (McapError, ValueError) as error:
        raise LogError(f"{result} is damaged: {error}; run its log again") from error


def _differing(stated: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    return [topic for topic in sorted(stated) if found.get(topic) != stated[topic]]


def _versions(about: Mapping[str, str]) -> str:
    """How the versions of the run differ from those of today."""
    changed = [f"{name} {about.get(name)}, now {now}" for name, now in versions().items() if about.get(name) != now]
    return f"versions of its run: {'; '.join(changed)}" if changed else "the versions are those of its run"
