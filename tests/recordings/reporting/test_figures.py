"""The plots of a report."""

import re

import pytest

from recordings.reporting.figures import line_plot


def test_the_axes_have_round_numbers_and_counts_are_not_negative():
    counts = {"a": [(0.0, 12.0), (7.0, 10160.0), (19.5, 4.0)]}
    labels = re.findall(r'class="(left|middle)">([^<]+)<', line_plot("hazard cells", counts))
    assert [text for kind, text in labels if kind == "left"] == ["0", "5,000", "10,000"]
    assert [text for kind, text in labels if kind == "middle"] == ["0 s", "5 s", "10 s", "15 s"]


@pytest.mark.parametrize("values", [(3.0, 3.0), (-0.0857, 2.31), (83.0, 98.0), (0.0, 0.0)])
def test_the_ticks_are_at_their_values(values):
    svg = line_plot("a", {"a": [(0.0, values[0]), (1.0, values[1])]})
    ticks = [
        (float(y), float(text.replace(",", ""))) for y, text in re.findall(r'y="([^"]+)" class="left">([^<]+)<', svg)
    ]
    drawn = re.findall(r"[\d.]+,([\d.]+)", re.findall(r'points="([^"]+)"', svg)[0])
    assert 2 <= len(ticks) <= 6
    (low_y, low), *_, (high_y, high) = ticks
    for value, y in zip(values, drawn, strict=True):
        expected = low_y - 4 + (value - low) / (high - low) * (high_y - low_y)
        assert float(y) == pytest.approx(expected, abs=0.3)
