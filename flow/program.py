"""Where the program begins: so little is imported here that an interrupt finds it ready from the first moment on."""

from __future__ import annotations

import sys


def program() -> int:
    """`flow.cli.main` for a process of its own: while it begins and when it is through, too, an interrupt is no
    traceback."""
    try:
        from flow.cli import main

        return main()
    except KeyboardInterrupt:
        print("roverflow: interrupted", file=sys.stderr)
        return 130
    finally:
        import signal

        signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    sys.exit(program())
