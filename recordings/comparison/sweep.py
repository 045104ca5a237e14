"""Figures over the values of a swept setting, as charts of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from recordings.comparison.diff import Diff
from recordings.export.page_layout import INK, PAPER
from recordings.png import png
from stages.data import Array

A_RGB, VARIANT_RGB = (110, 114, 126), (226, 150, 40)
ROOT = "sweep"
WIDTH, HEIGHT, TOP, BOTTOM = 900, 480, 60, 100  # px of a chart, and of its margins
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 1.1


@dataclass(frozen=True)
class Sweep:
    """Figures of the variants of a setting.

    setting: its name; values: of the variants B, C, ..., as text; figures: name with unit -> of A, B, C, ...
    """

    setting: str
    values: Sequence[str]
    figures: Mapping[str, Sequence[float]]

    def log(self, stream: rr.RecordingStream) -> None:
        """Log a chart for each figure."""
        for number, figures in enumerate(self._drawn().values()):
            picture = png(chart(self.setting, self.values, figures))
            stream.log(f"{ROOT}/{number}", rr.EncodedImage(contents=picture, media_type="image/png"), static=True)

    def views(self) -> rrb.Container:
        """The charts beside each other."""
        views = [rrb.Spatial2DView(origin=f"{ROOT}/{number}", name=name) for number, name in enumerate(self._drawn())]
        return rrb.Grid(*views, grid_columns=min(4, len(views)), name=f"over {self.setting}")

    def _drawn(self) -> dict[str, Sequence[float]]:
        """The figures that have a height."""
        return {name: figures for name, figures in self.figures.items() if any(np.nan_to_num(figures))}


def chart(setting: str, values: Sequence[str], figures: Sequence[float]) -> Array:
    """A bar for A and for each value of a setting, with its figure, as an RGB picture; figures: of A, B, ...; NaN =
    unknown."""
    page = np.full((HEIGHT, WIDTH, 3), PAPER, np.uint8)
    largest, wide, bottom = float(np.nanmax(figures)), WIDTH / len(figures), HEIGHT - BOTTOM
    for number, (value, figure) in enumerate(zip(("A", *values), figures, strict=True)):
        left, right = (round((number + share) * wide) for share in (0.15, 0.85))
        top, text = bottom, "unknown"
        if not np.isnan(figure):
            top = round(bottom - figure / largest * (bottom - TOP))
            text = f"{figure:,.0f}" if figure >= 999.5 else f"{figure:.3g}"
            cv2.rectangle(page, (left, top), (right, bottom), VARIANT_RGB if number else A_RGB, cv2.FILLED)
        _text(page, text, (left + right, top - 14), wide)
        _text(page, value, (left + right, bottom + 42), wide)
    _text(page, setting, (WIDTH, HEIGHT - 14), WIDTH)
    return page


def _text(page: Array, text: str, at: tuple[int, int], room: float) -> None:
    """A line of text around half of `at[0]`, smaller where `room` is narrower, px."""
    width = cv2.getTextSize(text, _FONT, _SIZE, 2)[0][0]
    scale = min(1.0, 0.95 * room / max(1, width))
    start, thickness = (round((at[0] - scale * width) / 2), at[1]), max(1, round(2 * scale))
    cv2.putText(page, text, start, _FONT, _SIZE * scale, INK, thickness, cv2.LINE_AA)


def changed(found: Diff) -> dict[str, float]:
    """Topic -> the most pixels or cells of a message that differ; without topics below another."""
    counts = {
        topic: [value for name, value in item.worst.items() if _counts(name)]
        for topic, item in found.topics.items()
        if topic.count("/") == 2
    }
    return {topic: sum(values) for topic, values in counts.items() if values}


def _counts(measure: str) -> bool:
    """Whether a measure is a number of pixels or cells, but not those of a single layer or of another size."""
    return measure.startswith(("pixels", "cells")) and " of " not in measure
