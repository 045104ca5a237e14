"""Runs a function in a process of its own, with limits on its time and memory."""

from __future__ import annotations

import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from flow.errors import RoverflowError
from recordings.errors import LogError

MAX_SECONDS = 20
MAX_MEGABYTES = 500  # beyond those of the program itself
_STOP_BYTES = 6 << 30  # of addresses beyond those of the program; the machine is safe by them
_FAILED = 70


@dataclass(frozen=True)
class Outcome:
    """What became of a function. fault: empty, or what is wrong with it; where: the place in the program."""

    fault: str
    where: str
    megabytes: float


def isolated(work: Callable[[], object], limited: bool = True) -> Outcome:
    """Run `work`, which may raise the program's own errors but no others, end the process, hang or fill the memory.

    limited: whether its time and memory are.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        _run(work, writer, limited)
    os.close(writer)
    with open(reader, "rb") as pipe:  # noqa: PTH123  # a descriptor
        base, _, told = pipe.read().decode("utf-8", "replace").partition("\n")
    _, status, used = os.wait4(child, 0)
    megabytes = (used.ru_maxrss - int(base)) / 1000
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        late = number in (signal.SIGALRM, signal.SIGXCPU)
        return Outcome(f"took {MAX_SECONDS} s" if late else f"ended by signal {number}", told, megabytes)
    if os.WEXITSTATUS(status):
        fault, _, where = told.partition("\n")
        return Outcome(fault or f"ended with exit code {os.WEXITSTATUS(status)}", where, megabytes)
    is_large = limited and megabytes > MAX_MEGABYTES
    return Outcome(f"took {megabytes:.0f} MB" if is_large else "", "", megabytes)


def _run(work: Callable[[], object], writer: int, limited: bool) -> None:
    """Run `work` in the child, and end it."""
    os.write(writer, f"{_status('VmRSS')}\n".encode())
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    if limited:
        limit = _status("VmSize") * 1000 + _STOP_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CPU, (MAX_SECONDS, MAX_SECONDS + 1))
        signal.alarm(2 * MAX_SECONDS)  # the machine may be busy
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    sys.stdout = open(os.devnull, "w", errors="backslashreplace")  # noqa: PTH123, SIM115  # as the program's own
    try:
        work()
    except (RoverflowError, LogError) as error:
        if not str(error).strip():
            os.write(writer, f"{type(error).__name__} without a sentence\n{_place(error)}".encode())
            os._exit(_FAILED)
    except BaseException as error:  # every other exception is what is searched
        os.write(writer, f"{type(error).__name__}: {str(error)[:200]!r}\n{_place(error)}".encode())
        os._exit(_FAILED)
    os._exit(0)


def _place(error: BaseException) -> str:
    """Where an exception was raised, and the last lines of the program that it went through."""
    frames = traceback.extract_tb(error.__traceback__)
    root = f"{Path(__file__).parents[2]}/"
    own = [frame for frame in frames if frame.filename.startswith(root) and "/tests/" not in frame.filename]
    raised = [frames[-1], *reversed(own[-3:])] if frames[-1] not in own else list(reversed(own[-3:]))
    return " <- ".join(f"{frame.filename.removeprefix(root)}:{frame.lineno}" for frame in raised)


def _status(name: str) -> int:
    """A figure of this process, kB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next((int(line.split()[1]) for line in lines if line.startswith(f"{name}:")), 0)
