"""A difference of two results as text and as Markdown."""

from __future__ import annotations

import numpy as np

from flow.contracts import counted
from recordings.comparison.diff import Diff, TopicDiff

_LAYER = "cells of layer "
_MAX_LINES = 10  # of a pipeline, in a terminal


def format_diff(found: Diff) -> str:
    """The difference for a terminal, with the facts of the runs that differ."""
    return "\n".join([*(f"{name}:{_shown(*values)}" for name, values in found.facts.items()), comparison(found)])


def moment(stamp: int) -> str:
    """A stamp as the viewer's time of day, UTC, and in ns; `--at` takes both.

    Examples
    --------
    >>> moment(1700086400513000000)
    '22:13:20.513 (1700086400513000000 ns)'
    """
    return f"{str(np.datetime64(stamp // 1_000_000, 'ms'))[11:]} ({stamp} ns)"


def comparison(found: Diff) -> str:
    """The topics that differ, for a terminal."""
    if found.first is None:
        messages = sum(topic.messages for topic in found.topics.values())
        return f"equal: all {counted(messages, 'message')} of {counted(len(found.topics), 'topic')}"
    topic, stamp = found.first
    lines = [f"the results first differ at {topic}, {moment(stamp)}"]
    lines += [f"  {name}: {_line(item)}" for name, item in found.topics.items() if item.first is not None]
    same = [name for name, item in found.topics.items() if item.first is None]
    return "\n".join([*lines, *([f"equal: {', '.join(same)}"] if same else [])])


def markdown(found: Diff) -> str:
    """The difference as Markdown: a paragraph for each topic, as the viewer wraps no cells of a table."""
    lines = [f"**{name}**: {_line(item)}\n" for name, item in found.topics.items() if item.first is not None]
    facts = [f"| {name} | {a or '-'} | {b or '-'} |".replace("\n", "<br>") for name, (a, b) in found.facts.items()]
    return "\n".join([*lines, *(["| fact | A | B |", "|---|---|---|", *facts] if facts else [])])


def _line(item: TopicDiff) -> str:
    alone = [f"{number} only in {name}" for name, number in (("A", item.only_one), ("B", item.only_other)) if number]
    both = [f"{item.differing} of {item.messages} messages differ"] if item.messages else []
    parts = [", ".join([*both, *alone])]
    layers = [name for name in item.worst if name.startswith(_LAYER)]
    sizes = [name for name in item.worst if name.startswith(("median ", "largest "))]
    counts = [name for name in item.worst if name not in (*layers[1:], *sizes)]
    number = {name: f"{value:.0f}" if value >= 100 else f"{value:.2g}" for name, value in item.worst.items()}
    named = {name: name.replace("s", "", 1) if item.worst[name] == 1 else name for name in counts}  # 1 pixel
    first, *rest = [f"{number[name]} {text}" for name, text in named.items()] or [""]
    largest = [f"{what} {number[name]} {unit}" for name in sizes for what, _, unit in [name.rpartition(" ")]]
    parts += [", ".join([f"up to {first} a message", *rest])] if first else []
    parts += [", ".join(largest)] if largest else []
    parts += [f"{counted(len(layers) - 1, 'more layer differs', 'more layers differ')}"] if layers[1:] else []
    return "; ".join(parts)


def _shown(one: str, other: str) -> str:
    """A fact of both results: in one line, or the lines of A and B below it."""
    both = {"A": one.splitlines() or ["-"], "B": other.splitlines() or ["-"]}
    if all(len(lines) == 1 for lines in both.values()):
        return " " + " | ".join(f"{name} {lines[0]}" for name, lines in both.items())
    text = ""
    for name, lines in both.items():
        more = [f"and {len(lines) - _MAX_LINES} more lines"] if len(lines) > _MAX_LINES else []
        text += "".join(f"\n  {name} {line}" for line in [*lines[:_MAX_LINES], *more])
    return text
