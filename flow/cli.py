"""Where the program begins: so little is imported here that an interrupt finds it ready from the first moment on."""

from __future__ import annotations

import sys

INTERRUPTED = 130


def main(arguments: list[str] | None = None) -> int:
    """Do what the command line asks for; returns the exit code."""
    try:
        from flow.commands import perform

        return perform(arguments)
    except KeyboardInterrupt:
        print("roverflow: interrupted", file=sys.stderr)
        return INTERRUPTED


def program() -> int:
    """`main` for a process of its own: when it is through, an interrupt ends the interpreter, too, without a word."""
    try:
        return main()
    finally:
        import signal

        signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    sys.exit(program())
