"""Finds the files of a log: of those that the user names, and of folders.

The files of a folder are those that metadata.yaml lists. Without it, as after a recorder that was stopped, they are
NAME_0, NAME_1 and so on. Nothing is imported that takes time, so a wrong name is refused at once.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recordings.errors import LogError

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3", ".bag")
ZSTD_SUFFIXES = (".zstd", ".zst")
RESULT_ENDING = "-nav"  # of the name of a result log, which may be beside the log
_MAX_METADATA_BYTES = 1 << 24
_MAX_LISTED = 5  # names in a sentence


@dataclass(frozen=True)
class FoundFiles:
    """The files of a log.

    files: in the order of recording; missing: sentences about files that are not there; part: a sentence if the only
    file is one of several of a recording.
    """

    files: Sequence[Path]
    missing: Sequence[str] = ()
    part: str = ""


def find_files(given: Path | str | Sequence[Path | str]) -> FoundFiles:
    """The files of a log. Raises LogError for no file, and for a folder without a recording or with several."""
    paths = [Path(given)] if isinstance(given, Path | str) else list(dict.fromkeys(map(Path, given)))
    if not paths:
        raise LogError("the list of files is empty; give a log")
    folders = {path: _files_of(path) for path in paths if path.is_dir()}
    named = [path for path in paths if path not in folders]
    for path in named:
        if path.name == METADATA:
            raise LogError(f"{path} only describes a recording; give its folder {path.absolute().parent}")
        if path.name.endswith(ZSTD_SUFFIXES) and path.is_file():
            remedy = f"give the folder of the recording, or unpack it by `zstd -d {shlex.quote(str(path))}`"
            raise LogError(f"{path} is compressed as a whole; {remedy}")
    files = [file for path in paths for file in (folders[path].files if path in folders else [path])]
    missing = [sentence for folder in folders.values() for sentence in folder.missing]
    return FoundFiles(files, missing, _split_of(files[0]) if len(files) == 1 and named else "")


def first_bytes(path: Path, kind: str = "a log") -> bytes:
    """The first bytes of a file. kind: of the file, for the message. Raises LogError if it is no file, or empty."""
    if path.exists() and not path.is_file():
        what, where = ("a folder", " in it") if path.is_dir() else ("a pipe or a device", "")
        raise LogError(f"{path} is {what}; give {kind}{where}")
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error
    if not start:
        raise LogError(f"{path} is empty (0 bytes); record it again")
    return start


def _files_of(folder: Path) -> FoundFiles:
    """The files of the recording in a folder."""
    try:
        present = sorted(filter(_is_recording, folder.iterdir()), key=lambda path: natural(path.name))
    except OSError as error:
        raise LogError(f"cannot read {folder}: {error.strerror or error}") from error
    listed = _listed(folder / METADATA)
    if listed:
        names = [path.name for path in present]
        there = [folder / name for name in listed if name in names]
        if there:
            gone = [name for name in listed if name not in names]
            return FoundFiles(there, [f"{name} is missing in {folder}, although {METADATA} lists it" for name in gone])
    if not present:
        inside = sorted(path.parent.name for path in folder.glob(f"*/{METADATA}"))
        hint = f"; its folders {_named(inside)} are recordings, give one" if inside else "; give a log or its folder"
        raise LogError(f"{folder} contains no recording (no {', '.join(SUFFIXES)} file){hint}")
    if len(present) > 1 and not _is_split([path.name for path in present]):
        raise LogError(
            f"{folder} contains several recordings ({_named([path.name for path in present])}); give the files of one; "
            "roverflow fleet runs all"
        )
    return FoundFiles(present, [])


def _listed(metadata: Path) -> list[str]:
    """The names of the files that a metadata.yaml lists; none if it cannot be read."""
    if not metadata.is_file():
        return []
    import yaml

    try:
        with metadata.open("rb") as file:
            content = yaml.load(file.read(_MAX_METADATA_BYTES), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        names = content["rosbag2_bagfile_information"]["relative_file_paths"]
        return [Path(str(name)).name for name in names]  # old versions put the folder's name before it
    except Exception:  # foreign text may fail the parser in any way
        return []


def is_log_name(name: str) -> bool:
    """Whether a file of this name may be a log, compressed or not, by its ending."""
    return name.lower().removesuffix(".zstd").removesuffix(".zst").endswith(SUFFIXES)


def _is_recording(path: Path) -> bool:
    stem = path.name.removesuffix(".zstd").removesuffix(".zst")
    return is_log_name(path.name) and not Path(stem).stem.endswith(RESULT_ENDING) and path.is_file()


def _is_split(names: Sequence[str]) -> bool:
    """Whether files, in their natural order, are NAME_0, NAME_1 and so on; some may be missing."""
    return len(set(map(_group, names))) == 1 and re.search(r"_0+\.", names[0]) is not None


def natural(name: str) -> list[Any]:
    """A key that sorts _2 before _10: texts and numbers by turns."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r"(\d+)", name))]


def _group(name: str) -> str:
    """The name of a file of a recording of several without the number of the file."""
    return re.sub(r"_\d+(?=\.)", "", name)


def _split_of(path: Path) -> str:
    """A sentence, if a file is one of several of a recording; else an empty string."""
    group = _group(path.name)
    siblings = [other for other in _neighbours(path) if _group(other.name) == group and _is_recording(other)]
    listed = _listed(path.with_name(METADATA))
    names = (
        listed
        if path.name in listed
        else [other.name for other in sorted(siblings, key=lambda path: natural(path.name))]
    )
    if len(names) < 2 or path.name not in names or not (path.name in listed or _is_split(names)):
        return ""
    return (
        f"{path.name} is file {names.index(path.name) + 1} of {len(names)} of a recording ({names[0]} to {names[-1]}); "
        f"give the folder {path.absolute().parent} to read all of them"
    )


def _neighbours(path: Path) -> list[Path]:
    try:
        return list(path.absolute().parent.iterdir())
    except OSError:
        return []


def _named(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return ", ".join(names[:_MAX_LISTED]) + more
