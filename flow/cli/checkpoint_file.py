"""The file beside a result log from which `roverflow run --resume` goes on."""

from __future__ import annotations

import fcntl
import math
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from flow.errors import UsageError
from flow.runtime.checkpoint import Checkpoint
from recordings.atomic_write import give_name, temporary_name, unfinished, writing
from recordings.errors import UnwritableError

INTERVAL = 10.0  # s, between checkpoints
MAX_SHARE = 0.02  # of the time, that may go into writing them
_REMEDY = "run without --resume to begin with the first frame"
_MAGIC = b"roverflow checkpoint\n"
_NAMES = {  # of facts, in words
    "pipeline": "the pipeline file", "overrides": "--set", "log": "the log's name", "log_digest": "the log",
    "files": "a calibration file", "modules": "a module beside the pipeline file",
    "start": "--start", "end": "--end", "every": "--every", "outputs": "an output or its options",
}  # fmt: skip


class CheckpointFile:
    """The last checkpoint of a run, as a file that is there until the run is through.

    result: the result log, beside which the file is; facts: what must be the same for a run to go on; say: prints a
    sentence. Raises UsageError if the file is of a run with other facts, or is no checkpoint.
    """

    def __init__(self, result: Path, facts: Mapping[str, str], say: Callable[[str], None]) -> None:
        self.path, self._facts, self._say = checkpoint_of(result), dict(facts), say
        self.last = self._read()
        self._next = time.monotonic() + INTERVAL

    def due(self) -> bool:
        """Whether a checkpoint is to be made after the next frame."""
        if time.monotonic() < self._next:
            return False
        self._next = time.monotonic() + INTERVAL
        return True

    def keep(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint in place of the one before. If it cannot be written, the run goes on without."""
        self.last, begun = checkpoint, time.monotonic()
        if self._next == math.inf:
            return
        try:
            with writing(self.path):
                partial = _unfinished(self.path)
                partial.write_bytes(_MAGIC + pickle.dumps(self._facts) + pickle.dumps(checkpoint))
                give_name(partial, self.path)
        except UnwritableError as error:
            self.give_up(str(error))
        self._next = max(self._next, time.monotonic() + (time.monotonic() - begun) / MAX_SHARE)

    def give_up(self, why: str) -> None:
        """Make no further checkpoints."""
        if self._next != math.inf:
            self._next = math.inf
            self._say(f"no further checkpoints: {why}")

    def _read(self) -> Checkpoint | None:
        if not self.path.exists():
            return None
        if not _is_checkpoint(self.path):
            raise UsageError(f"{self.path} is not a checkpoint; remove it, or choose another name for the result log")
        try:
            with self.path.open("rb") as file:
                file.seek(len(_MAGIC))
                self._compare(pickle.load(file))
                checkpoint = pickle.load(file)
        except UsageError:
            raise
        except Exception as error:  # a cut file may fail in any way
            raise UsageError(f"cannot read the checkpoint {self.path}: {error}; {_REMEDY}") from error
        assert isinstance(checkpoint, Checkpoint)
        return checkpoint

    def _compare(self, facts: Mapping[str, str]) -> None:
        """Raise UsageError for facts of another run."""
        changed = [name for name in facts.keys() | self._facts.keys() if facts.get(name) != self._facts.get(name)]
        if changed:
            differing = " and ".join(sorted(_NAMES.get(name, f"the version of {name}") for name in changed))
            raise UsageError(f"{differing} changed since the run that {self.path} continues; {_REMEDY}")


@contextmanager
def only_run_of(result: Path) -> Iterator[None]:
    """Hold a lock beside the result log, so that no two resumed runs write it. Raises UnwritableError if one does."""
    path = result.with_name(f"{result.name}.lock")
    with writing(path), path.open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UnwritableError(f"{result} is being written by another run; wait for it, or stop it") from None
        except OSError:  # the file system has no locks
            pass
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def is_being_written(result: Path) -> bool:
    """Whether a run that may be resumed writes a result log just now, if the file system has locks."""
    try:
        with result.with_name(f"{result.name}.lock").open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # there is no lock
        pass
    return False


def checkpoint_of(result: Path) -> Path:
    """The name of the checkpoint of a result log."""
    return result.with_name(f"{result.name}.checkpoint")


def remove_checkpoint(outputs: Iterable[Path]) -> None:
    """Remove the checkpoint of a run, if there is one, and what a kill has left of its outputs, the log first."""
    first, *others = outputs
    path = checkpoint_of(first)
    if path.is_file() and _is_checkpoint(path):
        for output in (first, *others):
            for left in unfinished(output):
                left.unlink(missing_ok=True)
        path.unlink()


def _is_checkpoint(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except IsADirectoryError:
        return False


def _unfinished(path: Path) -> Path:
    """The name of a checkpoint that is being written. A kill may leave such a file, which the next one replaces."""
    return temporary_name(path, "next")
