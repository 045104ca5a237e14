"""Draws a graph: as text, as a mermaid flowchart, or as SVG with the streams' types on the arrows."""

from __future__ import annotations

from collections import defaultdict
from html import escape

from flow.graph import Graph

_BOX_WIDTH, _BOX_HEIGHT, _GAP_X, _GAP_Y, _MARGIN = 168, 44, 76, 22, 16


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
        inputs = ", ".join(dict.fromkeys(node.inputs.values()))
        lines.append(f"  {node.name:{width}}  {node.output.__name__:13} = {node.use}({inputs}){mark}")
    return "\n".join([*lines, *(f"  sink    {use}" for use, _ in graph.sinks)])


def _mermaid(graph: Graph) -> str:
    lines = ["flowchart LR", f"  source[({graph.source_use})]"]
    lines += [f"  {node.name}[{node.name}<br/>{node.use}]" for node in graph.nodes]
    lines += [f"  {start} -- {stream}: {kind} --> {end}" for start, end, stream, kind in _edges(graph)]
    return "\n".join([*lines, *(f"  frames{i}[/{use}/]" for i, (use, _) in enumerate(graph.sinks))])


def _svg(graph: Graph) -> str:
    column = {"source": 0}
    for node in graph.nodes:
        column[node.name] = 1 + max(column.get(stream, 0) for stream in node.inputs.values())
    boxes = {"source": ("source", graph.source_use), **{n.name: (n.name, n.use) for n in graph.nodes}}
    for use, _ in graph.sinks:
        column[use], boxes[use] = max(column.values()) + (use == graph.sinks[0][0]), ("sink", use)
    rows: dict[int, int] = defaultdict(int)
    place = {}
    for name in boxes:
        x = _MARGIN + column[name] * (_BOX_WIDTH + _GAP_X)
        y = _MARGIN + rows[column[name]] * (_BOX_HEIGHT + _GAP_Y)
        place[name] = (x, y)
        rows[column[name]] += 1
    width = _MARGIN + (max(column.values()) + 1) * (_BOX_WIDTH + _GAP_X)
    height = 2 * _MARGIN + max(rows.values()) * (_BOX_HEIGHT + _GAP_Y)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for start, end, stream, kind in _edges(graph):
        (x0, y0), (x1, y1) = place[start], place[end]
        points = [(x0 + _BOX_WIDTH, y0 + _BOX_HEIGHT / 2), (x1, y1 + _BOX_HEIGHT / 2)]
        bends = [(x + dx, y) for (x, y), dx in zip(points, (_GAP_X / 2, -_GAP_X / 2), strict=True)]
        path = " ".join(f"{x:g},{y:g}" for x, y in (points[0], *bends, points[1]))
        parts.append(
            f'<path d="M{path.replace(" ", " C", 1)}" fill="none" stroke="#888"><title>{escape(stream)}: {kind}</title></path>'
        )
    for name, (title, use) in boxes.items():
        x, y = place[name]
        parts.append(
            f'<rect x="{x}" y="{y}" width="{_BOX_WIDTH}" height="{_BOX_HEIGHT}" rx="6" fill="#f4efe6" stroke="#a0522d"/>'
            f'<text x="{x + 8}" y="{y + 18}" font-size="13" font-weight="bold">{escape(title)}</text>'
            f'<text x="{x + 8}" y="{y + 34}" font-size="11" fill="#555">{escape(use)}</text>'
        )
    return "\n".join([*parts, "</svg>"])
