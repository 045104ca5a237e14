"""A difference of two results as text and as Markdown."""

from __future__ import annotations

from flow.contracts import counted
from recordings.comparison.diff import Diff, TopicDiff

_MAX_MEASURES = 6  # of a topic, in a line


def format_diff(found: Diff) -> str:
    """The difference for a terminal, with the facts of the runs that differ."""
    return "\n".join([*(f"{name}: {_shown(*values)}" for name, values in found.facts.items()), comparison(found)])


def comparison(found: Diff) -> str:
    """The topics that differ, for a terminal."""
    if found.first is None:
        messages = sum(topic.messages for topic in found.topics.values())
        return f"equal: all {counted(messages, 'message')} of {counted(len(found.topics), 'topic')}"
    topic, stamp = found.first
    seconds = (stamp - found.begin) / 1e9
    lines = [f"the results part at {topic}, {seconds:.3f} s after the first result ({stamp} ns)"]
    lines += [f"  {name}: {_line(item)}" for name, item in found.topics.items() if item.first is not None]
    same = [name for name, item in found.topics.items() if item.first is None]
    return "\n".join([*lines, *([f"equal: {', '.join(same)}"] if same else [])])


def markdown(found: Diff) -> str:
    """The difference as Markdown tables."""
    rows = [f"| {name} | {_line(item)} |" for name, item in found.topics.items() if item.first is not None]
    facts = [f"| {name} | {a or '-'} | {b or '-'} |".replace("\n", "<br>") for name, (a, b) in found.facts.items()]
    return "\n".join(
        [
            "| topic | difference |", "|---|---|", *rows, "",
            *(["| fact | A | B |", "|---|---|---|", *facts] if facts else []),
        ]
    )  # fmt: skip


def _line(item: TopicDiff) -> str:
    parts = [f"{item.differing} of {item.messages} messages differ"]
    parts += [f"{number} only in {name}" for name, number in (("A", item.only_one), ("B", item.only_other)) if number]
    worst = list(item.worst.items())
    shown = [f"{value:.0f} {name}" if value >= 100 else f"{value:.3g} {name}" for name, value in worst[:_MAX_MEASURES]]
    more = [f"and {len(worst) - _MAX_MEASURES} more"] if len(worst) > _MAX_MEASURES else []
    return "; ".join([", ".join(parts), *([f"at most {', '.join([*shown, *more])}"] if shown else [])])


def _shown(one: str, other: str) -> str:
    parts = (" ".join(text.split()) or "-" for text in (one, other))
    return " | ".join(parts)
