"""The jobs of a fleet: which logs there are, where their results go, and which of them still have to run."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

from flow.cli.fleet.catalogue import ENDED
from flow.errors import UsageError
from recordings.containers.digest import log_digest
from recordings.containers.finding import RESULT_ENDING, SUFFIXES, find_files
from recordings.errors import LogError
from recordings.scoring.result_log import about_run

_COMMENT = re.compile(r"(?:^|\s)#(?:\s|$)")  # a name may contain #


@dataclass(frozen=True)
class Job:
    """One log. name: unique in the fleet; log: file or folder; size: bytes; digest: of its content."""

    name: str
    log: Path
    size: int
    digest: str


def jobs_of(given: Sequence[str], folder: Path, rows: Collection[Mapping[str, Any]] = ()) -> list[Job]:
    """The jobs of logs, folders of logs, patterns, and text files that list these; the largest first.

    A folder that is one recording is one job. A log of the catalogue's rows keeps its name, whatever else is given.
    Raises UsageError if there is no log, or if a log has the name of another one.
    """
    found = (path for word in given for path in _logs(word, folder))
    logs = list(dict.fromkeys(path.resolve() if ".." in path.parts else path.absolute() for path in found))
    if not logs:
        raise UsageError(f"there is no log in {', '.join(given)}; give files, folders, glob patterns or a list of them")
    root = Path(os.path.commonpath([log.parent for log in logs]))
    known = {row["log"]: row["name"] for row in rows}
    jobs = [_job(log, root, known.get(str(log))) for log in logs]
    names = [job.name for job in jobs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UsageError(f"two logs have the name {twice[0]}; give them in different folders, or rename one")
    digests = {row["name"]: row["log_digest"] for row in rows}
    for job in jobs:
        if str(job.log) not in known and digests.get(job.name, job.digest) != job.digest:
            other = next(log for log, name in known.items() if name == job.name)
            raise UsageError(
                f"{folder} has results of {other} under the name {job.name}; choose another --out, or rename {job.log}"
            )
    return sorted(jobs, key=lambda job: (-job.size, job.name))


def reason_to_run(
    job: Job, row: Mapping[str, Any] | None, pipeline_digest: str, version: str, folder: Path, recording: bool = False
) -> str:
    """Why a job has to run; empty if its row has the result of the same log, pipeline and version.

    recording: whether a recording has to be beside the result.
    """
    if row is None or not row["state"]:
        return "new"
    if row["log_digest"] != job.digest:
        return "changed"
    if row["pipeline_digest"] != pipeline_digest:
        return "of another pipeline"
    if row["version"] != version:
        return "of another version of roverflow"
    if row["state"] not in ENDED:
        return "failed before" if row["state"] == "failed" else "not finished"
    if row["state"] == "done" and row["result"] and not (folder / row["result"]).is_file():
        return "without its result"
    if recording and row["result"] and not (folder / row["result"]).with_suffix(".rrd").is_file():
        return "without its recording"
    return ""


def _logs(word: str, folder: Path, lists: tuple[Path, ...] = ()) -> Iterable[Path]:
    """The logs that a word of the command line names, or a line of a text file. lists: the files that name it."""
    path = Path(word)
    if path.is_dir():
        yield from _in_folder(path, folder)
    elif path.is_file() and path.suffix not in SUFFIXES:
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"{path} is neither a log nor a text file of logs") from error
        if path.resolve() in lists:
            raise UsageError(f"the text file {path} names itself; take it out of its lines")
        for line in filter(None, (_COMMENT.split(line)[0].strip() for line in lines)):
            yield from _logs(str(path.parent / line), folder, (*lists, path.resolve()))
    elif path.is_file():
        yield path
    else:
        found = sorted(glob(word, recursive=True))  # noqa: PTH207  # a pattern may be absolute
        if not found:
            where = f", which {lists[-1]} names" if lists else ""
            raise UsageError(f"no file, folder or pattern {word}{where}")
        for item in found:
            yield from _logs(item, folder, lists)


def _in_folder(path: Path, folder: Path) -> Iterable[Path]:
    """A folder that is one recording, or the logs in it and in its folders, without results and the fleet's own."""
    try:
        files = find_files(path).files
    except LogError:
        files = ()
    if len(files) > 1 or (path / "metadata.yaml").is_file():
        yield path
        return
    for item in sorted(path.iterdir()):
        if item.resolve() == folder.resolve() or item.name.startswith("."):
            continue
        if item.is_dir():
            yield from _in_folder(item, folder)
        elif item.suffix in SUFFIXES and not (item.stem.endswith(RESULT_ENDING) and about_run(item)):
            yield item


def _job(log: Path, root: Path, name: str | None) -> Job:
    files = find_files(log).files
    beside = log.relative_to(root)
    try:
        digest = log_digest(files)
        size = sum(file.stat().st_size for file in files)
    except OSError as error:
        raise UsageError(f"cannot read {error.filename}: {error.strerror or error}") from error
    return Job(name or (beside if log.is_dir() else beside.with_suffix("")).as_posix(), log, size, digest)
