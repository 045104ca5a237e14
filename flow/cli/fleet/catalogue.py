"""The catalogue of a fleet: one row for each log in an SQLite file, written by the client alone."""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flow.errors import UsageError
from recordings.atomic_write import unwritable, writing

NAME = "catalogue.sqlite"
# state: waiting, running, done, unusable (a run refuses the log), failed, killed (it ends its workers), hung
COLUMNS = {
    "name": "TEXT PRIMARY KEY", "log": "TEXT", "bytes": "INTEGER", "log_digest": "TEXT", "pipeline": "TEXT",
    "pipeline_digest": "TEXT", "version": "TEXT", "state": "TEXT", "verdict": "TEXT", "frames": "INTEGER",
    "complete": "INTEGER", "losses": "TEXT", "findings": "TEXT", "scores": "TEXT", "seconds": "REAL",
    "cpu_seconds": "REAL", "stage_seconds": "REAL", "node": "TEXT", "result": "TEXT", "why": "TEXT", "ended": "TEXT",
}  # fmt: skip
ENDED = ("done", "unusable", "killed", "hung")  # states that a second call leaves, unless log or pipeline change
# Of a log that has not ended. The verdict is no NULL, so that "verdict != 'COMPLETE'" finds the log.
WAITING = dict.fromkeys(list(COLUMNS)[8:]) | {"state": "waiting", "verdict": ""}
HOLD_SECONDS = 2.0  # for which a client waits for --watch, which holds the lock for an instant


class Catalogue:
    """The rows of a fleet's folder. create: whether to make a catalogue that is not there.

    Raises UsageError if there is no catalogue, or the file is not one, and UnwritableError if it cannot be written, as
    on a full disk.
    """

    def __init__(self, folder: Path, create: bool = False) -> None:
        self.path = folder / NAME
        if not create and not self.path.is_file():
            raise UsageError(f"{folder} has no {NAME}; give the folder of roverflow fleet")
        with self._opened(write=create) as database:
            if create:
                columns = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
                database.execute(f"CREATE TABLE IF NOT EXISTS logs ({columns})")

    def rows(self, where: str = "", sort: str = "name") -> list[dict[str, Any]]:
        """The rows that fulfil an SQL condition, sorted by SQL columns. Raises UsageError for wrong SQL."""
        query = f"SELECT * FROM logs{f' WHERE {where}' if where else ''} ORDER BY {sort}"
        try:
            with self._opened() as database:
                return [dict(row) for row in database.execute(query)]
        except sqlite3.Error as error:
            columns = ", ".join(COLUMNS)
            raise UsageError(
                f"the catalogue cannot answer '{where or sort}': {error}; its columns are {columns}"
            ) from error

    def put(self, name: str, values: Mapping[str, Any]) -> None:
        """Change columns of a row, or add it."""
        self.put_all({name: values})

    def put_all(self, rows: Mapping[str, Mapping[str, Any]]) -> None:
        """Change columns of rows, or add them, all or none."""
        if not rows:
            return
        with self._opened(write=True) as database:
            for name, values in rows.items():
                known = {"name": name, **values}
                names, marks = ", ".join(known), ", ".join("?" * len(known))
                updates = ", ".join(f"{column} = excluded.{column}" for column in values)
                query = f"INSERT INTO logs ({names}) VALUES ({marks}) ON CONFLICT (name) DO UPDATE SET {updates}"
                plain = (json.dumps(value) if isinstance(value, dict | list) else value for value in known.values())
                database.execute(query, tuple(plain))

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder, if its file system has locks. Raises UsageError if another client does."""
        with writing(self._lock):
            file = os.open(self._lock, os.O_CREAT | os.O_RDWR, 0o644)
        try:
            end = time.monotonic() + HOLD_SECONDS
            while _locked(file, fcntl.LOCK_EX) is False:
                if time.monotonic() > end:
                    raise UsageError(f"another roverflow fleet runs in {self.path.parent}; --watch shows it")
                time.sleep(HOLD_SECONDS / 20)
            yield
        finally:
            os.close(file)

    def is_held(self) -> bool | None:
        """Whether a client holds the folder; None if its file system has no locks."""
        try:
            with self._lock.open() as file:
                locked = _locked(file.fileno(), fcntl.LOCK_SH)
        except FileNotFoundError:
            return False
        return None if locked is None else not locked

    @property
    def _lock(self) -> Path:
        return self.path.with_suffix(".lock")

    @contextmanager
    def _opened(self, write: bool = False) -> Iterator[sqlite3.Connection]:
        mode = "rwc" if write else "ro"
        database = sqlite3.connect(f"file:{self.path.resolve()}?mode={mode}", uri=True, timeout=30)
        database.row_factory = sqlite3.Row
        try:
            with database:
                yield database
        except sqlite3.DatabaseError as error:
            if "not a database" in str(error):
                raise UsageError(f"{self.path} is not a catalogue; remove it or choose another folder") from error
            if write:
                raise unwritable(self.path, str(error)) from error
            raise
        finally:
            database.close()


def outcome(row: Mapping[str, Any]) -> str:
    """How a log ended: the verdict of its run, or the state of one that has none."""
    return str(row["verdict"] if row["state"] == "done" else row["state"])


def as_table(rows: Iterable[Mapping[str, Any]], columns: Iterable[str]) -> str:
    """Rows as an aligned text table."""
    names = list(columns)
    cells = [names, *([shown(row[name]) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells
    )


def _locked(file: int, kind: int) -> bool | None:
    """Whether a file could be locked; None where the file system has no locks."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def shown(value: Any) -> str:
    """A value of a row as text."""
    if value is None:
        return ""
    return f"{value:.1f}" if isinstance(value, float) else str(value)
