"""The command line as a process of its own: signals, closed streams and the exit. Imports little, to start at once."""

from __future__ import annotations

import sys

from flow.errors import INTERRUPTED


def program() -> int:
    """Run `flow.cli.main.main`; returns its exit code. An interrupt at any moment prints no traceback."""
    import gc
    import os
    import signal

    gc.set_threshold(20_000, 50, 50)  # imports make many objects and no garbage
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # frames fill the cores; idle threads of BLAS spin at the start
    try:
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, signal.default_int_handler)  # outputs are then closed or removed
        _open_closed_streams()
        from flow.malloc import keep_freed_memory

        keep_freed_memory()
        from flow.cli.main import main

        code = main()
    except KeyboardInterrupt:
        print("roverflow: interrupted", file=sys.stderr)
        code = INTERRUPTED
    gc.freeze()  # the end of the process frees all memory, so the interpreter's last collection is wasted time
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: os._exit(code))
    # Python may end an interrupted `-m` process by the signal instead of the code. Native code in a stage of an
    # abandoned frame may abort the process while the interpreter is torn down.
    if code == INTERRUPTED or _stage_at_work():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def _open_closed_streams() -> None:
    """Replace a closed stdout or stderr by the null device."""
    import os

    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115
        getattr(sys, name).reconfigure(errors="backslashreplace")  # characters that its encoding lacks


def _stage_at_work() -> bool:
    """Whether a worker thread is alive."""
    import threading

    return any(thread.name.startswith("worker-") for thread in threading.enumerate())


if __name__ == "__main__":
    sys.exit(program())
