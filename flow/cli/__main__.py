"""Where the program begins: so little is imported here that an interrupt finds it ready from the first moment on."""

from __future__ import annotations

import sys

from flow.errors import INTERRUPTED


def program() -> int:
    """`flow.cli.main.main` for a process of its own: while it begins and when it is through, too, an interrupt is no
    traceback, and the exit code is that of `main`."""
    import os
    import signal

    try:
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, signal.default_int_handler)  # so that nothing half done is left behind
        _open_what_is_closed()
        from flow.runtime.malloc import keep_freed_memory

        keep_freed_memory()
        from flow.cli.main import main

        code = main()
    except KeyboardInterrupt:
        print("roverflow: interrupted", file=sys.stderr)
        code = INTERRUPTED
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: os._exit(code))
    # Python itself, asked to run a module, may end an interrupted process by the signal; and native code that the
    # interpreter is torn down under may abort it, where a stage of an abandoned frame still works.
    if code == INTERRUPTED or _working():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def _open_what_is_closed() -> None:
    """Give a program that was started without stdout or stderr ones that go nowhere."""
    import os

    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115
        getattr(sys, name).reconfigure(errors="backslashreplace")  # what its encoding lacks


def _working() -> bool:
    """Whether a stage still works."""
    import threading

    return any(thread.name.startswith("worker-") for thread in threading.enumerate())


if __name__ == "__main__":
    sys.exit(program())
