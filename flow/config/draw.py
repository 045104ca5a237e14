"""Draws a graph: as text, as a mermaid flowchart, or as SVG with the streams' types on the arrows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import fields
from html import escape
from typing import Any

from flow.runtime.graph import Graph
from flow.units import as_written

_BOX_WIDTH, _BOX_HEIGHT, _GAP_X, _GAP_Y, _MARGIN = 168, 44, 76, 22, 16

_TO_SINKS = "every stream of the frame"


def draw(graph: Graph, form: str) -> str:
    """The graph in the given form: "text", "mermaid" or "svg"."""
    return {"text": _text, "mermaid": _mermaid, "svg": _svg}[form](graph)


def _edges(graph: Graph) -> list[tuple[str, str, str, str]]:
    """(from box, to box, stream, type) for every connection; the source is one box."""
    made = {node.name for node in graph.nodes}
    edges = []
    for node in graph.nodes:
        for stream in node.inputs.values():
            start = stream if stream in made else "source"
            edges.append((start, node.name, stream, graph.kinds[stream].__name__))
    return edges


def _text(graph: Graph) -> str:
    width = max(len(node.name) for node in graph.nodes)
    lines = [f"pipeline {graph.name}", f"  source  {graph.source_use}"]
    for node in graph.nodes:
        mark = " (optional)" if node.optional else ""
        given = ", ".join([*dict.fromkeys(node.inputs.values()), *_settings(node.actor)])
        lines.append(f"  {node.name:{width}}  {node.output.__name__:13} = {node.use}({given}){mark}")
    return "\n".join([*lines, *(f"  sink    {use}" for use, _ in graph.sinks)])


def _settings(actor: Any) -> list[str]:
    """The parameters of a stage or aligner that are not as by default."""
    given = [(item, getattr(actor, item.name)) for item in fields(actor) if item.init]
    return [f"{item.name}={_shown(value, item.metadata)}" for item, value in given if value != item.default]


def _shown(value: Any, metadata: Mapping[str, Any]) -> str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return as_written(value, metadata.get("unit", "")) if is_number else str(value)


def _mermaid(graph: Graph) -> str:
    boxes = {"source": "source"} | {node.name: f"s{i}" for i, node in enumerate(graph.nodes)}  # `end` is a keyword
    lines = ["flowchart LR", f"  source[({graph.source_use})]"]
    lines += [f"  {boxes[node.name]}[{node.name}<br/>{node.use}]" for node in graph.nodes]
    lines += [f"  {boxes[start]} -- {stream}: {kind} --> {boxes[end]}" for start, end, stream, kind in _edges(graph)]
    last = boxes[graph.nodes[-1].name]
    lines += [f"  {last} -- {_TO_SINKS} --> frames{i}[/{use}/]" for i, (use, _) in enumerate(graph.sinks)]
    return "\n".join(lines)


def _svg(graph: Graph) -> str:
    """Boxes in columns by their distance from the source; arrows carry stream and type as tooltips."""
    column = {"source": 0}
    for node in graph.nodes:
        column[node.name] = 1 + max(column.get(stream, 0) for stream in node.inputs.values())
    boxes = {"source": ("source", graph.source_use), **{node.name: (node.name, node.use) for node in graph.nodes}}
    last = max(column.values()) + 1
    for use, _ in graph.sinks:
        column[use], boxes[use] = last, ("sink", use)
    rows: dict[int, int] = defaultdict(int)
    place = {}
    for name in boxes:
        place[name] = (
            _MARGIN + column[name] * (_BOX_WIDTH + _GAP_X),
            _MARGIN + rows[column[name]] * (_BOX_HEIGHT + _GAP_Y),
        )
        rows[column[name]] += 1
    width = 2 * _MARGIN + last * (_BOX_WIDTH + _GAP_X) + _BOX_WIDTH
    height = 2 * _MARGIN + max(rows.values()) * (_BOX_HEIGHT + _GAP_Y)
    arrows = [_arrow(place[start], place[end], f"{stream}: {kind}") for start, end, stream, kind in _edges(graph)]
    arrows += [_arrow(place[graph.nodes[-1].name], place[use], _TO_SINKS) for use, _ in graph.sinks]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">'
    paper = f'<rect width="{width}" height="{height}" fill="white"/>'
    return "\n".join([head, paper, *arrows, *(_box(place[name], *boxes[name]) for name in boxes), "</svg>"])


def _arrow(start: tuple[int, int], end: tuple[int, int], title: str) -> str:
    (x0, y0), (x1, y1) = start, end
    x0, y0, y1 = x0 + _BOX_WIDTH, y0 + _BOX_HEIGHT // 2, y1 + _BOX_HEIGHT // 2
    bend = _GAP_X // 2
    curve = f"M{x0},{y0} C{x0 + bend},{y0} {x1 - bend},{y1} {x1},{y1}"
    return f'<path d="{curve}" fill="none" stroke="#999"><title>{escape(title)}</title></path>'


def _box(corner: tuple[int, int], title: str, use: str) -> str:
    x, y = corner
    return (
        f'<rect x="{x}" y="{y}" width="{_BOX_WIDTH}" height="{_BOX_HEIGHT}" rx="6" fill="#f4efe6" stroke="#a0522d"/>\n'
        f'<text x="{x + 8}" y="{y + 18}" font-size="13" font-weight="bold">{escape(title)}</text>\n'
        f'<text x="{x + 8}" y="{y + 34}" font-size="11" fill="#555">{escape(use)}</text>'
    )
