"""The file beside a result log from which `roverflow run --resume` goes on."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from flow.errors import UsageError
from flow.runtime.checkpoint import Checkpoint
from recordings.atomic_write import give_name, temporary_name, writing
from recordings.errors import UnwritableError

INTERVAL = 10.0  # s, between checkpoints
_REMEDY = "run without --resume to begin with the first frame"
_MAGIC = b"roverflow checkpoint\n"
_NAMES = {  # of facts, in words
    "pipeline": "the pipeline file", "overrides": "--set", "log": "the log's name", "log_digest": "the log",
    "files": "a calibration file",
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
        self.last = checkpoint
        if self._next == math.inf:  # an earlier one could not be written
            return
        try:
            with writing(self.path):
                unfinished = _unfinished(self.path)
                unfinished.write_bytes(_MAGIC + pickle.dumps((self._facts, checkpoint)))
                give_name(unfinished, self.path)
        except UnwritableError as error:
            self._next = math.inf
            self._say(f"no further checkpoints: {error}")

    def _read(self) -> Checkpoint | None:
        if not self.path.exists():
            return None
        content = self.path.read_bytes()
        if not content.startswith(_MAGIC):
            raise UsageError(f"{self.path} is not a checkpoint; remove it, or choose another name for the result log")
        try:
            facts, checkpoint = pickle.loads(content[len(_MAGIC) :])
        except Exception as error:  # a cut file, or one of another version, may fail in any way
            raise UsageError(f"cannot read the checkpoint {self.path}: {error}; {_REMEDY}") from error
        changed = [name for name in facts.keys() | self._facts.keys() if facts.get(name) != self._facts.get(name)]
        if changed:
            differing = " and ".join(sorted(_NAMES.get(name, f"the version of {name}") for name in changed))
            raise UsageError(f"{differing} changed since the run that {self.path} continues; {_REMEDY}")
        assert isinstance(checkpoint, Checkpoint)
        return checkpoint


def checkpoint_of(result: Path) -> Path:
    """The name of the checkpoint of a result log."""
    return result.with_name(f"{result.name}.checkpoint")


def remove_checkpoint(result: Path) -> None:
    """Remove the checkpoint of a result log, if there is one."""
    path = checkpoint_of(result)
    if path.is_file() and path.read_bytes()[: len(_MAGIC)] == _MAGIC:
        path.unlink()
        _unfinished(path).unlink(missing_ok=True)


def _unfinished(path: Path) -> Path:
    """The name of a checkpoint that is being written. A kill may leave such a file, which the next one replaces."""
    return temporary_name(path, "next")
