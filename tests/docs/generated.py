"""Writes the generated pages: docs/stages.md and docs/command-line.md. Run as `python -m tests.docs.generated`.

The tables of stages come from the fields of the dataclasses, those of commands from the parser. `make docs` runs this,
and a test fails when a page is not current.
"""

from __future__ import annotations

import argparse
import inspect
import math
import re
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any

import flow.align
import recordings
import stages
from flow.cli.main import parser
from flow.runtime.graph import ports_of
from flow.units import as_written
from stages.stage import Stage

DOCS = Path(__file__).parent.parent.parent / "docs"
STEPS = {
    "rectification": "Rectification",
    "matching": "Matching",
    "refinement": "Refinement",
    "cloud": "Cloud",
    "terrain": "Terrain",
    "localisation": "Localisation",
}
STAGES_INTRO = """# Stages and their parameters

This page is generated from the code by `make docs`.

Inputs and outputs name the types of `stages.data`. In a pipeline file, write times, lengths and angles with a unit:
`5 ms`, `20 cm`, `20 deg`. [pipelines.md](pipelines.md) shows how to use a stage.
"""
COMMANDS_INTRO = """# Command line

This page is generated from the code by `make docs`. `roverflow COMMAND --help` prints the same.

`python -m flow` is another name of `roverflow`. Every command accepts `--debug`, which shows tracebacks.
[results.md](results.md#exit-codes) lists the exit codes.
"""


def main() -> None:
    """Write the pages."""
    for name, text in pages().items():
        (DOCS / name).write_text(text)


def pages() -> dict[str, str]:
    """The generated pages, by file name."""
    return {"stages.md": _stages(), "command-line.md": _commands()}


def _stages() -> str:
    parts = [STAGES_INTRO]
    kinds = [getattr(stages, name) for name in stages.__all__]
    found = [kind for kind in kinds if inspect.isclass(kind) and issubclass(kind, Stage)]
    for folder, title in STEPS.items():
        parts.append(f"## {title}\n")
        for kind in sorted(found, key=lambda kind: kind.__name__):
            if kind.__module__.split(".")[1] == folder:
                parts += _section(kind, f"stages.{kind.__name__}")
    parts += ["## The vehicle\n", *_section(stages.Rover, "stages.Rover")]
    parts.append("## Alignment\n\nAligners join streams of different clocks before any stage runs.\n")
    for name in ("pair", "interpolate", "nearest", "latest"):
        parts += _section(getattr(flow.align, name), f"flow.align.{name}")
    parts.append(
        "## Source and sinks\n\n[logs.md](logs.md#settings-of-the-source) describes the settings of the source.\n"
    )
    for name in recordings.__all__:
        parts += _section(getattr(recordings, name), f"recordings.{name}")
    return "\n".join(parts)


def _section(kind: type, use: str) -> Iterator[str]:
    """A class with its first sentence, its ports and its parameters."""
    yield f"### {kind.__name__}\n"
    yield f"`{use}`: {_first_sentence(kind)}\n"
    if issubclass(kind, Stage):
        ports, optional = ports_of(kind)
        inputs = [f"`{name}` {_type(hint)}{' (optional)' if name in optional else ''}" for name, hint in ports.items()]
        returned = inspect.signature(kind.__call__).return_annotation
        yield f"Inputs: {', '.join(inputs)}. Output: {returned}.\n"
    documented = _numpydoc(kind)
    rows = (
        [_row(item, documented.get(item.name, "")) for item in fields(kind) if item.init] if is_dataclass(kind) else []
    )
    if rows:
        yield "| parameter | meaning | unit | range | default |\n|---|---|---|---|---|"
        yield "\n".join(rows) + "\n"


def _first_sentence(kind: type) -> str:
    text = " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())
    end = text.find(". ")
    return (text if end < 0 else text[: end + 1]).replace("<", "&lt;")


def _type(hint: Any) -> str:
    if isinstance(hint, type):
        return hint.__name__
    return " or ".join(_type(part) for part in hint.__args__ if part is not type(None))


def _numpydoc(kind: type) -> dict[str, str]:
    """Parameter -> its text in the sections "Parameters" of a class and its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        section = re.search(
            r"^Parameters\n-+\n(.*?)(?:\n\n\w+\n-+\n|\Z)", inspect.cleandoc(base.__doc__ or ""), re.S | re.M
        )
        for names, text in re.findall(r"^(\S.*)\n((?:[ ]+.*\n?)+)", section[1] if section else "", re.M):
            found |= dict.fromkeys(re.split(r",\s*", names.partition(" : ")[0]), " ".join(text.split()))
    return found


def _row(item: Field[Any], about: str) -> str:
    meta = item.metadata
    unit = meta.get("unit", "")
    shown = {"ns": "s, ms", "rad": "rad, deg"}.get(unit, unit)
    return _table_row(f"`{item.name}`", meta.get("help") or about, shown, _range(item), _value(_default(item), unit))


def _table_row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("<", "&lt;") for cell in cells) + " |"


def _default(item: Field[Any]) -> Any:
    return item.default_factory() if item.default_factory is not MISSING else item.default


def _range(item: Field[Any]) -> str:
    meta = item.metadata
    if meta.get("choices"):
        return ", ".join(_value(choice, "") for choice in meta["choices"])
    low, high = (None if meta.get(key) is None else _value(meta[key], meta.get("unit", "")) for key in ("low", "high"))
    if low is None:
        return "" if high is None else f"at most {high}"
    return f"at least {low}" if high is None else f"{low} to {high}"


def _value(value: Any, unit: str) -> str:
    """A value as a pipeline file writes it."""
    if value is MISSING:
        return "required"
    if value is None or value == "":
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if is_dataclass(value):
        return f"{type(value).__name__}()"
    if isinstance(value, tuple):
        return ", ".join(_value(part, unit) for part in value) or "none"
    if isinstance(value, int | float):
        return f"{math.degrees(value):.3g} deg" if unit == "rad" and value else as_written(value, unit)
    return str(value)


def _commands() -> str:
    parts = [COMMANDS_INTRO]
    for name, command, about in _leaves(parser(), ()):
        parts.append(f"## roverflow {' '.join(name)}\n\n{about[0].upper()}{about[1:].rstrip('.')}.\n")
        rows = [_option(action) for action in command._actions if action.dest not in ("help", "debug")]
        if rows:
            parts.append("| argument | meaning |\n|---|---|\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def _leaves(
    among: argparse.ArgumentParser, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser, str]]:
    """(name, parser, description) of every command, those of a group one by one."""
    groups = [action for action in among._actions if isinstance(action, argparse._SubParsersAction)]
    if not groups:
        yield path, among, among.description or ""
    for group in groups:
        for name, command in group.choices.items():
            yield from _leaves(command, (*path, name))


def _option(action: argparse.Action) -> str:
    names = ", ".join(f"`{name}`" for name in action.option_strings)
    choices = ", ".join(map(str, action.choices)) if action.choices else ""
    value = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    shown = f"`{value}`" if not names else names if action.nargs == 0 else f"{names} `{value}`"
    return _table_row(shown, "; ".join(text for text in (action.help, choices) if text))


if __name__ == "__main__":
    main()
