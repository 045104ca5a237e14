"""The jobs of a fleet: which logs there are, where their results go, and which of them still have to run."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from glob import glob
from itertools import chain, count
from pathlib import Path
from typing import Any

from flow.cli.fleet.catalogue import ENDED
from flow.contracts import as_text
from flow.errors import UsageError
from recordings.containers.digest import log_digest
from recordings.containers.finding import METADATA, RESULT_ENDING, ZSTD_SUFFIXES, find_files, is_log_name
from recordings.errors import LogError
from recordings.scoring.result_log import about_run

UNREADABLE = "unreadable"  # instead of a digest
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

    The files of one recording are one job. A log of the catalogue's rows keeps its name, whatever else is given, also
    where it was moved. Links to another one of the logs are left out. Raises UsageError if there is no log, or if a
    log has the name of another one.
    """
    found = (path for word in given for path in _logs(word, folder))
    known = {row["log"]: row["name"] for row in rows}
    places: dict[Path, Path] = {}
    for path in found:
        own = path.resolve() if ".." in path.parts else path.absolute()
        real = _real(own)
        if real not in places or as_text(own) in known or (real == own and as_text(places[real]) not in known):
            places[real] = own
    logs = list(places.values())
    if not logs:
        raise UsageError(f"there is no log in {', '.join(given)}; give files, folders, glob patterns or a list of them")
    root = Path(os.path.commonpath([log.parent for log in logs]))
    jobs = _renamed([_job(log, root, known.get(as_text(log))) for log in logs], rows)
    names = [job.name for job in jobs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UsageError(f"two logs have the name {twice[0]}; give them in different folders, or rename one")
    digests = {row["name"]: row["log_digest"] for row in rows}
    for job in jobs:
        if as_text(job.log) not in known and digests.get(job.name, job.digest) != job.digest:
            other = next(log for log, name in known.items() if name == job.name)
            raise UsageError(
                f"{folder} has results of {other} under the name {job.name}; choose another --out, or rename {job.log}"
            )
    return sorted(jobs, key=lambda job: (-job.size, job.name))


def _renamed(jobs: Sequence[Job], rows: Collection[Mapping[str, Any]]) -> list[Job]:
    """The jobs with the names of the catalogue, also of moved logs; a new log of such a name gets a number."""
    known = {row["log"]: row["name"] for row in rows}
    names = {job.log: known[as_text(job.log)] for job in jobs if as_text(job.log) in known}
    gone = {
        row["log_digest"]: row["name"]
        for row in rows
        if row["log_digest"] != UNREADABLE
        and row["name"] not in names.values()
        and not os.path.lexists(row["log"])
        and "\\udc" not in row["log"]  # the escape of a name that is not Unicode
    }
    for job in jobs:
        if job.log not in names and job.digest in gone:
            names[job.log] = gone.pop(job.digest)
    held = set(names.values())
    for job in jobs:
        if job.log not in names:
            numbered = (f"{job.name}-{number}" for number in count(2))
            names[job.log] = next(name for name in chain([job.name], numbered) if name not in held)
    return [replace(job, name=names[job.log]) for job in jobs]


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
    elif path.is_file() and not is_log_name(path.name):
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


def _in_folder(path: Path, folder: Path, above: tuple[Path, ...] = ()) -> Iterable[Path]:
    """The logs in a folder and in its folders, without results and the fleet's own.

    The files of one recording, a split or listed one, are the log `path`. above: the folders around it.
    """
    try:
        files = find_files(path).files
    except LogError:
        files = ()
    packed = any(file.name.endswith(ZSTD_SUFFIXES) for file in files)
    if len(files) > 1 or packed or (files and (path / METADATA).is_file()):
        yield path
    else:
        files = ()
    inside = (*above, _real(path))
    for item in sorted(path.iterdir()):
        if item in files or item.name.startswith(".") or _real(item) in (folder.resolve(), *inside):
            continue
        if item.is_dir():
            yield from _in_folder(item, folder, inside)
        elif is_log_name(item.name) and not (item.stem.endswith(RESULT_ENDING) and about_run(item)):
            yield item


def _real(path: Path) -> Path:
    """Where links lead to; a link that leads nowhere is its own place."""
    try:
        return path.resolve(strict=True)
    except (OSError, RuntimeError):  # a loop
        return path


def _job(log: Path, root: Path, name: str | None) -> Job:
    beside = log.relative_to(root)
    try:
        files = find_files(log).files
        digest, size = log_digest(files), sum(file.stat().st_size for file in files)
    except (OSError, LogError):  # its run says why
        digest, size = UNREADABLE, 0
    return Job(name or as_text(beside if log.is_dir() else beside.with_suffix("")), log, size, digest)
