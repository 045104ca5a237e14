"""Figures over the values of a swept setting, as charts of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from recordings.comparison.diff import Diff
from recordings.export.page_layout import INK, PAPER, round_step
from recordings.png import png
from stages.data import Array

A_RGB, VARIANT_RGB = (110, 114, 126), (226, 150, 40)
ROOT = "sweep"
WIDTH, HEIGHT, LEFT, TOP, BOTTOM = 900, 480, 150, 40, 100  # px of a chart, and of its margins
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
    """A bar for each value of a setting and a line for A, as an RGB picture; figures: of A, B, ...; NaN = unknown."""
    page = np.full((HEIGHT, WIDTH, 3), PAPER, np.uint8)
    largest = float(np.nanmax(figures))
    step = round_step(largest / 2)
    top, bottom, wide = step * max(1, np.ceil(largest / step)), HEIGHT - BOTTOM, (WIDTH - LEFT - 70) / len(values)

    def row(figure: float) -> int:
        return int(bottom - figure / top * (bottom - TOP) + 0.5)

    for figure in np.arange(0.0, top + step / 2, step):
        cv2.line(page, (LEFT, row(figure)), (WIDTH - 70, row(figure)), (214, 214, 210), 2)
        _text(page, f"{round(figure, 9):,.6g}", (LEFT - 14, row(figure) + 12), 1.0)
    widest = max(_width(value) for value in values)
    for number, (value, figure) in enumerate(zip(values, figures[1:], strict=True)):
        left, right = (round(LEFT + (number + share) * wide) for share in (0.2, 0.8))
        if np.isnan(figure):
            _text(page, "unknown" if _width("unknown") < wide else "?", ((left + right) // 2, bottom - 14), 0.5)
        else:
            cv2.rectangle(page, (left, row(figure)), (right, bottom), VARIANT_RGB, cv2.FILLED)
        if number % int(np.ceil((widest + 24) / wide)) == 0:
            _text(page, value, ((left + right) // 2, bottom + 42), 0.5)
    if not np.isnan(figures[0]):
        cv2.line(page, (LEFT, row(figures[0])), (WIDTH - 70, row(figures[0])), A_RGB, 5)
        _text(page, "A", (WIDTH - 58, row(figures[0]) + 12), 0.0)
    _text(page, setting, (LEFT + (WIDTH - LEFT - 70) // 2, HEIGHT - 14), 0.5)
    return page


def _width(text: str) -> int:
    return int(cv2.getTextSize(text, _FONT, _SIZE, 2)[0][0])


def _text(page: Array, text: str, at: tuple[int, int], before: float) -> None:
    """A line of text at a point; before: the share of the text at the left of the point."""
    cv2.putText(page, text, (round(at[0] - before * _width(text)), at[1]), _FONT, _SIZE, INK, 2, cv2.LINE_AA)


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
