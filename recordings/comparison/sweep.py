"""Figures over the values of a swept setting, as bar charts of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from recordings.comparison.diff import Diff

A_RGB, VARIANT_RGB = (150, 154, 164), (255, 210, 60)
ROOT = "sweep"


@dataclass(frozen=True)
class Sweep:
    """Figures of the variants of a setting.

    setting: its name, with its unit; values: of the variants B, C, ...; figures: name with unit -> of A, B, C, ...
    """

    setting: str
    values: Sequence[float]
    figures: Mapping[str, Sequence[float]]

    def log(self, stream: rr.RecordingStream) -> None:
        """Log a chart for each figure: at each value a bar, and left of it a gray one with the figure of A."""
        gaps, values = np.diff(np.unique(self.values)), np.array(self.values)
        width = 0.4 * float(gaps.min()) if gaps.size else 1.0
        for number, figures in enumerate(self.figures.values()):
            for side, heights, left, color in (
                ("a", [figures[0]] * len(values), values - width, A_RGB), ("variants", figures[1:], values, VARIANT_RGB)
            ):  # fmt: skip
                bars = rr.BarChart(list(heights), abscissa=left, widths=[width] * len(values), color=color)
                stream.log(f"{ROOT}/{number}/{side}", bars, static=True)

    def views(self) -> rrb.Container:
        """The charts beside each other."""
        views = [
            rrb.BarChartView(origin=f"{ROOT}/{number}", name=name, plot_legend=rrb.PlotLegend(visible=False))
            for number, name in enumerate(self.figures)
        ]
        return rrb.Grid(*views, grid_columns=min(4, len(views)), name=f"over {self.setting}; gray: A")


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
