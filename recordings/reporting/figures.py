"""Figures of a report as SVG and embedded images."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np

from recordings.export.page_layout import Page, round_step

WIDTH, HEIGHT, MARGIN = 480, 180, 52
MAX_WIDTH = 900  # px of a picture
COLORS = ("#1f6fb2", "#c4502e")


def line_plot(title: str, curves: Mapping[str, Sequence[tuple[float, float]]]) -> str:
    """Curves over time as an SVG figure; curves: name -> (seconds, value) pairs."""
    points = [point for curve in curves.values() for point in curve]
    if not points:
        return ""
    times, values = (np.array(part) for part in zip(*points, strict=True))
    low, high = float(values.min()), float(values.max())
    margin = 0.05 * (high - low) or max(1.0, abs(high)) * 0.05
    low = low - margin if low < 0 else max(0.0, low - margin)
    return _plot(title, curves, (float(times.min()), float(times.max())), (low, high + margin), "s")


def track_plot(title: str, tracks: Mapping[str, Sequence[tuple[float, float]]]) -> str:
    """Ways driven, seen from above, with equal scales; tracks: name -> (x, y) pairs, m."""
    points = np.array([point for track in tracks.values() for point in track])
    if not len(points):
        return ""
    middle, room = (points.min(0) + points.max(0)) / 2, np.array([WIDTH - 2 * MARGIN, HEIGHT - 2 * MARGIN])
    half = 0.55 * max(float((np.ptp(points, axis=0) / room).max()), 1e-3) * room
    spans = [(float(m - h), float(m + h)) for m, h in zip(middle, half, strict=True)]
    return _plot(title, tracks, spans[0], spans[1], "m")


def picture(page: Page, alt: str) -> str:
    """A page as an embedded JPEG image."""
    pixels = page.pixels
    if pixels.shape[1] > MAX_WIDTH:
        scale = MAX_WIDTH / pixels.shape[1]
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, blob = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])
    data = base64.b64encode(blob.tobytes()).decode()
    return f'<img alt="{escape(alt)}" src="data:image/jpeg;base64,{data}">'


def _plot(
    title: str,
    curves: Mapping[str, Sequence[tuple[float, float]]],
    across: tuple[float, float],
    along: tuple[float, float],
    unit: str,
) -> str:
    """Axes, curves and their names."""
    span = (across[1] - across[0]) or 1.0

    def place(point: tuple[float, float]) -> str:
        x = MARGIN + (point[0] - across[0]) / span * (WIDTH - 2 * MARGIN)
        y = HEIGHT - MARGIN - (point[1] - along[0]) / (along[1] - along[0]) * (HEIGHT - 2 * MARGIN)
        return f"{x:.1f},{y:.1f}"

    parts = [f'<text x="{MARGIN}" y="18" class="title">{escape(title)}</text>']
    for value in _ticks(*along):
        y = float(place((across[0], value)).partition(",")[2])
        parts.append(f'<line x1="{MARGIN}" x2="{WIDTH - MARGIN}" y1="{y}" y2="{y}" class="grid"/>')
        parts.append(f'<text x="{MARGIN - 6}" y="{y + 4}" class="left">{_number(value)}</text>')
    for value in _ticks(*across):
        x, label = place((value, along[0])).partition(",")[0], f"{_number(value)} {unit}"
        parts.append(f'<text x="{x}" y="{HEIGHT - MARGIN + 18}" class="middle">{label}</text>')
    for number, (name, curve) in enumerate(curves.items()):
        color = COLORS[number % len(COLORS)]
        drawn = " ".join(map(place, curve))
        parts.append(f'<polyline points="{drawn}" fill="none" stroke="{color}" stroke-width="1.5"/>')
        if len(curve) < 60:
            places = (point.split(",") for point in drawn.split())
            parts += [f'<circle cx="{x}" cy="{y}" r="2.2" fill="{color}"/>' for x, y in places]
        if len(curves) > 1:
            where = f'x="{WIDTH - MARGIN}" y="{18 + 15 * number}"'
            parts.append(f'<text {where} class="left" fill="{color}">{escape(name)}</text>')
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join(parts)}</svg>'


def _ticks(low: float, high: float) -> list[float]:
    """Two to five round numbers from `low` to `high`."""
    step = round_step((high - low) / 2 or 1.0)
    return [number * step for number in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
