"""Where the program begins: so little is imported here that an interrupt finds it ready from the first moment on."""

from __future__ import annotations

import sys


def program() -> int:
    """`flow.cli.main` for a process of its own: while it begins and when it is through, too, an interrupt is no
    traceback."""
    try:
        _open_what_is_closed()
        from flow.cli import main

        code = main()
        _leave_workers_behind(code)
    except KeyboardInterrupt:
        print("roverflow: interrupted", file=sys.stderr)
        code = 130
    import os
    import signal

    signal.signal(signal.SIGINT, lambda *_: os._exit(code))
    return code


def _open_what_is_closed() -> None:
    """Give a program that was started without stdout or stderr ones that go nowhere."""
    import os

    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115


def _leave_workers_behind(code: int) -> None:
    """End at once where a stage of an abandoned frame still works: native code that the interpreter is torn down
    under may abort the process."""
    import os
    import threading

    if any(thread.name.startswith("worker-") for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    sys.exit(program())
