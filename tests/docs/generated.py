"""Writes the generated pages: docs/stages.md and docs/command-line.md. Run as `python -m tests.docs.generated`.

The tables of stages come from the fields of the dataclasses, those of commands from the parser. `make docs` runs this,
and a test fails when a page is not current.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import stages
from flow.cli.main import parser
from flow.config.reference import NodeReference, data_types, stage_reference

DOCS = Path(__file__).parent.parent.parent / "docs"
STEPS = ("rectification", "matching", "refinement", "cloud", "terrain", "localisation")  # folders of stages
SETTINGS = "[logs.md](logs.md#settings-of-the-source) describes the settings of the source."
OTHERS = (
    ("Alignment", "Aligners join streams of different clocks before any stage runs.", "flow.align."),
    ("Source and sinks", SETTINGS, "recordings."),
)
UNITS = {"ns": "s, ms", "rad": "rad, deg"}
STAGES_INTRO = """# Stages and their parameters

This page is generated from the code by `make docs`. `roverflow stages [NAME]` prints the same on a terminal.

Inputs and outputs name the types of `stages.data`, whose fields are [below](#data-types). In a pipeline file, write
times, lengths and angles with a unit: `5 ms`, `20 cm`, `20 deg`. [pipelines.md](pipelines.md) shows how to use a stage.
"""
COMMANDS_INTRO = """# Command line

This page is generated from the code by `make docs`. `roverflow COMMAND --help` prints the same.

`python -m flow` is another name of `roverflow`. Every command accepts `--debug`, which prints tracebacks.
Defaults are in parentheses. [results.md](results.md#exit-codes) lists the exit codes.
"""


def main() -> None:
    """Write the pages."""
    for name, text in pages().items():
        (DOCS / name).write_text(text)


def pages() -> dict[str, str]:
    """The generated pages, by file name."""
    return {"stages.md": _stages(), "command-line.md": _commands()}


def _stages() -> str:
    nodes = stage_reference()
    parts = [STAGES_INTRO]
    for folder in STEPS:
        parts.append(f"## {folder.capitalize()}\n")
        for node in sorted(nodes, key=lambda node: node.use):
            if node.use.startswith("stages.") and _folder(node) == folder:
                parts += _section(node)
    for title, about, module in OTHERS:
        parts.append(f"## {title}\n\n{about}\n")
        for node in nodes:
            if node.use.startswith(module):
                parts += _section(node)
    parts.append(
        "## Data types\n\nTypes of streams and of their fields. Arrays are read-only; `NaN` is unknown; `stamp` is in "
        "nanoseconds. [results.md](results.md#codes) explains the codes.\n"
    )
    for node in data_types():
        head = "| name | code |" if node.role == "codes" else "| field | content |"
        parts.append(f"### {node.use}\n\n{_escaped(node.summary)}\n\n{head}\n|---|---|")
        parts.append("\n".join(_row(f"`{field}`", text) for field, text in node.inputs.items()) + "\n")
    return "\n".join(parts)


def _folder(node: NodeReference) -> str:
    """The step that a stage belongs to."""
    return str(getattr(stages, node.use.rpartition(".")[2]).__module__.split(".")[1])


def _section(node: NodeReference) -> Iterator[str]:
    """A class with its summary, its ports and its parameters."""
    yield f"### {node.use.rpartition('.')[2]}\n"
    yield f"`{node.use}`: {_escaped(node.summary)}\n"
    if node.role == "stage":
        inputs = [f"`{name}` {kind.removesuffix(' | None')}" for name, kind in node.inputs.items()]
        shown = [f"{text} (optional)" if text[1:].startswith(node.optional_inputs) else text for text in inputs]
        yield f"Inputs: {', '.join(shown)}. Output: {node.output}.\n"
    if node.parameters:
        yield "| parameter | meaning | unit | range | default |\n|---|---|---|---|---|"
        rows = [
            (f"`{it.name}`", it.meaning, UNITS.get(it.unit, it.unit), it.range, it.default) for it in node.parameters
        ]
        yield "\n".join(_row(*row) for row in rows) + "\n"


def _row(*cells: str) -> str:
    return "| " + " | ".join(_escaped(cell).replace("|", "\\|") for cell in cells) + " |"


def _escaped(text: str) -> str:
    return text.replace("<", "&lt;")


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
    return _row(shown, "; ".join(text for text in ((action.help or "").replace("%%", "%"), choices) if text))


if __name__ == "__main__":
    main()
