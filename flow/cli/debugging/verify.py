"""`roverflow verify`: whether a result log is as its run wrote it, and whether the same run gives it again."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from flow.cli.arguments import every, workers
from flow.cli.outputs import check_outputs
from flow.cli.replay import replay, versions
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, DIFFERENT, INTERRUPTED, UsageError

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
    from recordings.scoring.result_log import end_of_run, facts_of

    about, stated = facts_of(result, RESULT), end_of_run(result, "roverflow.digests")
    if not stated:
        raise UsageError(f"{result} has no digests of its topics, because its end is missing; run its log again")
    changed = _differing(stated, _digests(result, stated, about))
    topics = counted(len(stated), "topic")
    say(f"changed since its run: {', '.join(changed)}" if changed else f"{topics} as the run wrote them")
    try:
        return max(_second_run(options, about, stated, topics), DIFFERENT if changed else COMPLETE)
    except UsageError as error:
        if not changed:
            raise
        say(f"not run again: {error}")
        return DIFFERENT


def _second_run(options: argparse.Namespace, about: Mapping[str, str], stated: Mapping[str, str], topics: str) -> int:
    """Repeat the run of a result log and print what differs; returns the exit code. about, stated: of that run."""
    from flow.cli.debugging.result_input import graph_of, input_of
    from recordings.scoring.result_log import end_of_run, input_beside, names_of

    result: Path = options.result
    end = end_of_run(result)
    if end.get("interrupted") == "True" or "drops.dropped" in end:
        why = "dropped frames" if "drops.dropped" in end else "was interrupted"
        raise UsageError(f"the run of {result} {why}, so it cannot be repeated; only the file was checked")
    with TemporaryDirectory(prefix="roverflow-") as folder:
        again = options.out or Path(folder) / "again.mcap"
        with input_of(graph_of(result), result, options.log) as (_, notes):
            logs = options.log or input_beside(result)
        summary = _run_again(result, logs, about, again, options.workers)
        if summary["interrupted"]:
            say("interrupted: the second run was not compared")
            return INTERRUPTED
        written = str(again) in summary["outputs"]
        differing = _differing(stated, _digests(again, stated, about) if written else {})
    if not differing:
        say("\n".join([*notes, f"{topics} the same in a second run of {names_of(logs)}"]))
        return COMPLETE
    keep = f"roverflow diff {result} {again}" if options.out else "-o AGAIN.mcap keeps the second result"
    other = f" of {names_of(logs)}, which may be another log" if notes else ""
    say("\n".join([*notes, f"different in a second run{other}: {', '.join(differing)}", _versions(about), keep]))
    return DIFFERENT


def _run_again(result: Path, logs: list[Path], about: Mapping[str, str], out: Path, workers: int) -> dict[str, Any]:
    """Repeat the run of a result log; returns the summary. about: the facts of the run."""
    from flow.cli.debugging.result_input import pipeline_of_run
    from recordings.scoring.result_log import pipeline_of

    start, end = (float(about[name]) if about.get(name) else None for name in ("start", "end"))
    with pipeline_of_run(about, result, pipeline_of(result)) as pipeline:
        return replay(
            logs, pipeline, out, None, overrides=about["overrides"].splitlines(), start=start, end=end,
            every=every(about["every"]) if about.get("every") else None, profile=about.get("profile"),
            with_inputs="with_inputs" in about, workers=workers,
        )  # fmt: skip


def _digests(log: Path, stated: Mapping[str, str], about: Mapping[str, str]) -> dict[str, str]:
    """The digests of the topics of a log, without those of copied inputs; raises LogError if it is damaged."""
    from recordings.errors import LogError, sentence_of
    from recordings.mcap.digests import digests_of

    copies = "with_inputs" in about
    try:
        found = digests_of(log, copies)
    except Exception as error:  # mcap's reader and its decompressors fail on damage in any way
        raise LogError(f"{log} is damaged: {sentence_of(error)}; run its log again") from error
    return {topic: digest for topic, digest in found.items() if topic in stated or not copies}


def _differing(stated: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    return sorted({topic for topic, _ in stated.items() ^ found.items()})


def _versions(about: Mapping[str, str]) -> str:
    """How the versions, and the files that settings name, differ from those of the run."""
    from recordings.containers.digest import digest_lines

    changed = [f"{name} {about[name]}, now {now}" for name, now in versions().items() if about.get(name, now) != now]
    for line in about.get("files", "").splitlines():
        name = line.partition(" ")[2]
        changed += [] if digest_lines([Path(name)]) == [line] else [f"{name} has other content"]
    return f"since its run: {'; '.join(changed)}" if changed else "the versions are those of its run"
