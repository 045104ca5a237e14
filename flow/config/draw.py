"""Draws a graph: as text, as a mermaid flowchart, or as SVG with the streams' types on the arrows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from html import escape
from typing import Any

from flow.contracts import counted
from flow.runtime.graph import Graph
from flow.units import as_written

_BOX_WIDTH, _BOX_HEIGHT, _GAP_X, _GAP_Y, _MARGIN = 168, 44, 76, 22, 16

_TO_SINKS = "every stream of the frame"


@dataclass(frozen=True)
class _Box:
    """A stage, an aligner or a template. made: its streams, the output last; remark: on its line of text."""

    name: str
    use: str
    made: tuple[str, ...]
    inputs: tuple[str, ...]
    settings: tuple[str, ...] = ()
    remark: str = ""


def draw(graph: Graph, form: str, expand: bool = False) -> str:
    """The drawing of a graph. form: "text", "mermaid" or "svg"; expand: draw the streams inside templates."""
    return {"text": _text, "mermaid": _mermaid, "svg": _svg}[form](graph, _boxes(graph, expand))


def _boxes(graph: Graph, expand: bool) -> list[_Box]:
    """What is drawn between the source and the sinks, in the order of work."""
    boxes, folded = [], defaultdict(list)
    for node in graph.nodes:
        root = node.name.partition("/")[0]
        if root in graph.templates and not expand:
            folded[root].append(node)
        if root in graph.templates and not expand and root == node.name:
            made = tuple(inner.name for inner in folded[root])
            used = dict.fromkeys(stream for inner in folded[root] for stream in inner.inputs.values())
            inputs = tuple(stream for stream in used if stream not in made)
            use, remark = graph.templates[root], f", {counted(len(made), 'stream')}: --expand"
            settings = tuple(f"{key}={value}" for key, value in use.parameters.items())
            boxes.append(_Box(root, use.template, made, inputs, settings, remark))
        elif root not in graph.templates or expand:
            inputs, remark = tuple(dict.fromkeys(node.inputs.values())), " (optional)" if node.optional else ""
            boxes.append(_Box(node.name, node.use, (node.name,), inputs, tuple(_settings(node.actor)), remark))
    return boxes


def _edges(graph: Graph, boxes: list[_Box]) -> list[tuple[str, str, str, str]]:
    """(from box, to box, stream, type) for every connection; the source is one box."""
    maker = {stream: box.name for box in boxes for stream in box.made}
    return [
        (maker.get(stream, "source"), box.name, stream, graph.kinds[stream].__name__)
        for box in boxes
        for stream in box.inputs
    ]


def _text(graph: Graph, boxes: list[_Box]) -> str:
    width = max(len(box.name) for box in boxes)
    lines = [f"pipeline {graph.name}", f"  source  {graph.source_use}"]
    for box in boxes:
        kind, given = graph.kinds[box.name].__name__, ", ".join([*box.inputs, *box.settings])
        lines.append(f"  {box.name:{width}}  {kind:13} = {box.use}({given}){box.remark}")
    return "\n".join([*lines, *(f"  sink    {use}" for use, _ in graph.sinks)])


def _settings(item: Any, prefix: str = "") -> Iterator[str]:
    """The parameters of an object that differ from their defaults."""
    for known in (known for known in fields(item) if known.init):
        value = getattr(item, known.name)
        if value != known.default and is_dataclass(value):
            yield from _settings(value, f"{prefix}{known.name}.")
        elif value != known.default:
            yield f"{prefix}{known.name}={_shown(value, known.metadata)}"


def _shown(value: Any, metadata: Mapping[str, Any]) -> str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return as_written(value, metadata.get("unit", "")) if is_number else str(value)


def _mermaid(graph: Graph, boxes: list[_Box]) -> str:
    names = {"source": "source"} | {box.name: f"s{i}" for i, box in enumerate(boxes)}  # `end` is a keyword
    lines = ["flowchart LR", f"  source[({graph.source_use})]"]
    lines += [f"  {names[box.name]}[{box.name}<br/>{box.use}]" for box in boxes]
    for start, end, stream, kind in _edges(graph, boxes):
        lines.append(f"  {names[start]} -- {stream}: {kind} --> {names[end]}")
    last = names[boxes[-1].name]
    lines += [f"  {last} -- {_TO_SINKS} --> frames{i}[/{use}/]" for i, (use, _) in enumerate(graph.sinks)]
    return "\n".join(lines)


def _svg(graph: Graph, drawn: list[_Box]) -> str:
    """Boxes in columns by their distance from the source; arrows carry stream and type as tooltips."""
    column, edges = {"source": 0}, _edges(graph, drawn)
    for box in drawn:
        column[box.name] = 1 + max(column.get(start, 0) for start, end, *_ in edges if end == box.name)
    boxes = {"source": ("source", graph.source_use), **{box.name: (box.name, box.use) for box in drawn}}
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
    arrows = [_arrow(place[start], place[end], f"{stream}: {kind}") for start, end, stream, kind in edges]
    arrows += [_arrow(place[drawn[-1].name], place[use], _TO_SINKS) for use, _ in graph.sinks]
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
