"""Watching a run: a viewer of this machine, or a browser, which another process serves.

Both get the recording through a pipe (`recordings.follower`). A viewer that is slow, suspended or closed costs
only its own picture: the run waits for it at its end, for 3 s at most.
"""

from __future__ import annotations

import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from flow.cli.report import say
from flow.errors import UsageError

PORT, WEB_PORT = 9877, 9090  # the first ones tried, on loopback; the viewer itself listens on 9876
LIVE_MEMORY = "512MB"  # of what a browser that comes later still gets; beyond it the oldest is dropped
# Starts a command, and ends all of its group once no process holds the other end of a pipe, even after a kill.
GUARD = """
import os, subprocess, sys
subprocess.Popen(sys.argv[2:])
os.close(0)
os.read(int(sys.argv[1]), 1)
os.killpg(0, 9)
"""


@contextmanager
def watched(view: bool, serve: bool, recording: Path | None) -> Iterator[int]:
    """Start what watches a run; yields the file descriptor that it reads the recording from, 0 for none.

    view: open the viewer, which stays open after the run; serve: serve a page to browsers, which ends with the run;
    recording: the file that a viewer can open afterwards.
    """
    if not (view or serve):
        yield 0
        return
    port, web = _free(PORT), _free(WEB_PORT)
    page = ["--serve-web", "--web-viewer-port", str(web), "--server-memory-limit", LIVE_MEMORY]
    words = ["--bind", "127.0.0.1", *([*page, "--port", str(port)] if serve else ["--port", "auto"])]
    (reading, writing), (lifeline, held) = os.pipe(), os.pipe()
    guard = [sys.executable, "-Ic", GUARD, str(lifeline)] if serve else []
    process = subprocess.Popen(
        [*guard, sys.executable, "-m", "rerun", *words, "-"],
        stdin=reading, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, pass_fds=(lifeline,),
        start_new_session=True,  # Ctrl-C is for the run; its processes are one group
    )  # fmt: skip
    os.close(reading)
    os.close(lifeline)

    def report_failure() -> None:
        if process.wait() > 0:
            say(f"No viewer opens (no display?). The run goes on; afterwards: rerun {shlex.quote(str(recording))}")

    reporter = threading.Thread(target=report_failure, name="viewer", daemon=True)
    if serve:
        say(f"watch the run at http://127.0.0.1:{web}/?url=rerun+http://127.0.0.1:{port}/proxy until it ends")
    else:
        reporter.start()
    try:
        yield writing
    finally:
        os.close(writing)
        os.close(held)
        if serve:  # it has started another process, and neither ends by itself while it is suspended
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        elif process.poll() is not None:
            reporter.join()


def _free(first: int) -> int:
    """The first port of loopback from `first` on that nobody uses."""
    for port in range(first, first + 100):
        with socket.socket() as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                tried.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise UsageError(f"no port from {first} to {first + 99} is free for the viewer; end another run")
