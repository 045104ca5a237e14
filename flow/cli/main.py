"""The command line: `main` finds the command, runs it and turns errors into one sentence and an exit code.

Each command is a module of `flow.cli.commands` with HELP, `add_arguments` and `run`. A command imports heavy modules
inside `run`, so that `roverflow --help` answers at once.
"""

from __future__ import annotations

import argparse
import logging
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType
from typing import Any, NoReturn

from flow.cli.commands import demo, export, fleet, graph, info, listing, pipeline, run, score, simulate, stages
from flow.cli.debugging import attempt, desk, diff, report, verify, why
from flow.cli.importers import images
from flow.cli.importers.data_sets import DATA_SETS, DataSet
from flow.cli.replay import product_version
from flow.contracts import nearest
from flow.errors import FAILED, INTERRUPTED, UNUSABLE, RoverflowError
from recordings.errors import LogError, UnwritableError

COMMANDS: dict[str, ModuleType] = {
    "demo": demo,
    "run": run,
    "info": info,
    "graph": graph,
    "stages": stages,
    "pipeline": pipeline,
    "simulate": simulate,
    "score": score,
    "verify": verify,
    "diff": diff,
    "try": attempt,
    "why": why,
    "report": report,
    "desk": desk,
    "export": export,
    "fleet": fleet,
    "list": listing,
}
_IMPORTERS: dict[str, ModuleType | DataSet] = {"images": images, **{each.kind: each for each in DATA_SETS}}
IMPORTERS = {kind: _IMPORTERS[kind] for kind in sorted(_IMPORTERS)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code. An error is one sentence on stderr."""
    options = _parsed(sys.argv[1:] if arguments is None else list(arguments))
    logging.basicConfig(level=logging.DEBUG if options.debug else logging.ERROR, format="%(message)s")
    logging.getLogger("numba").setLevel(logging.WARNING)
    try:
        return int(options.command(options))
    except (Exception, KeyboardInterrupt) as error:
        interrupted = _interrupted(error)
        with suppress(OSError):  # stderr may be full
            if options.debug and not interrupted:
                traceback.print_exc()
            print(f"roverflow: {'interrupted' if interrupted else _sentence(error, options.debug)}", file=sys.stderr)
        return INTERRUPTED if interrupted else _exit_code(error)


def _parsed(given: Sequence[str]) -> argparse.Namespace:
    """The options of a command line. An unknown name ends the program with the nearest valid one."""
    first = given[:1] == ["--debug"]  # it may stand before the command
    options, unknown = parser().parse_known_args([*given[1:], "--debug"] if first else given or ["--help"])
    if unknown:
        valid = [option for action in options.parser._actions for option in action.option_strings]
        near = [each for each in valid if nearest(unknown[0].lstrip("-"), [each.lstrip("-")])]  # all share the dashes
        pipeline = ", and --set STREAM.PARAM=VALUE changes the pipeline" if "--set" in valid else ""
        remedy = nearest(unknown[0], near) or f"; {options.parser.prog} --help lists the options{pipeline}"
        options.parser.error(f"unknown: {' '.join(unknown)}{remedy}")
    return options


def _interrupted(error: BaseException | None) -> bool:
    """Whether an interrupt caused the error. An interrupt inside compiled code becomes a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _sentence(error: BaseException, traced: bool) -> str:
    """The error in one sentence; traced: whether the traceback is already printed."""
    if isinstance(error, RoverflowError | LogError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the output'}: {error.strerror}"
    if "cannot cache function" in str(error):  # numba's own message names neither reason nor remedy
        return "compiled kernels have no cache folder; set NUMBA_CACHE_DIR to a writable folder"
    return f"internal failure, {type(error).__name__}: {error}{'' if traced else ' (--debug prints the traceback)'}"


def _exit_code(error: BaseException) -> int:
    if isinstance(error, RoverflowError):
        return error.exit_code
    return UNUSABLE if isinstance(error, LogError) and not isinstance(error, UnwritableError) else FAILED


class CommandParser(argparse.ArgumentParser):
    """Names all that a command line lacks at once, and the nearest valid name of a command, a desk and the like.

    argparse itself names alternatives only when the rest is there.
    """

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """The options and the unknown words of a command line."""
        self._given = argparse.Namespace() if namespace is None else namespace
        return super().parse_known_args(args, self._given)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += nearest(value, action.choices or ())
            raise

    def error(self, message: str) -> NoReturn:
        """End the program with the usage and a sentence."""
        if message.startswith("the following arguments are required"):
            for group in self._mutually_exclusive_groups:
                options = group._group_actions
                if group.required and all(getattr(self._given, each.dest) == each.default for each in options):
                    message += f", {' or '.join(each.option_strings[-1] for each in options)}"
        super().error(message)


def parser() -> argparse.ArgumentParser:
    """The parser of the command line; every command declares its own arguments."""
    top = CommandParser(
        prog="roverflow",
        description="Turn a rover's log into disparity, point clouds, elevation maps and navigation maps.",
        epilog="Exit codes: 0 complete; 1 an output or the program failed; 2 wrong usage, or an unusable log; "
        "3 finished but incomplete; 130 interrupted (the outputs of a run are closed and readable).",
    )
    top.add_argument("--version", action="version", version=f"roverflow {product_version()}")
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        _add(commands, name, command)
    make = "make a log from a data set or a folder of images"
    kinds = commands.add_parser("import", help=make, description=_titled(make))
    importers = kinds.add_subparsers(required=True, metavar="KIND")
    for name, importer in IMPORTERS.items():
        _add(importers, name, importer)
    return top


def _add(commands: Any, name: str, command: ModuleType | DataSet) -> None:
    texts = {"help": command.HELP, "description": _titled(command.HELP), "epilog": "Defaults are in parentheses."}
    sub: argparse.ArgumentParser = commands.add_parser(name, **texts)
    command.add_arguments(sub)
    sub.add_argument("--debug", action="store_true", help="print tracebacks")
    sub.set_defaults(command=command.run, parser=sub)


def _titled(help: str) -> str:
    return f"{help[0].upper()}{help[1:]}."
