"""Viewers as real processes. `python -m rerun` starts another process, so a viewer is a group of processes."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


@contextmanager
def viewer(*words: object, **options: Any) -> Iterator["subprocess.Popen[bytes]"]:
    """`rerun` with these words, until the end of the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rerun", *map(str, words)],
        **{"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True, **options},
    )
    try:
        yield process
    finally:
        send(process, signal.SIGKILL)
        process.wait()


def send(process: "subprocess.Popen[bytes]", what: int) -> None:
    """Send a signal to a viewer."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, what)


def answers(port: int) -> bool:
    """Whether a process listens on a port of loopback."""
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


def wait_for(true: Callable[[], bool], otherwise: str) -> None:
    """Wait until something is true, for a minute at most."""
    for _ in range(600):
        if true():
            return
        time.sleep(0.1)
    raise TimeoutError(otherwise)


def wait_for_bytes(path: Path, size: int) -> None:
    """Wait until a file has at least `size` bytes."""
    wait_for(lambda: path.exists() and path.stat().st_size >= size, f"{path} has not {size} bytes")
