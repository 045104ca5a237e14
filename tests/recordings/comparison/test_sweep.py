"""The charts of a sweep."""

import numpy as np
import pytest

from recordings.comparison.sweep import A_RGB, BOTTOM, LEFT, TOP, VARIANT_RGB, chart


def spans(mask):
    """(First, end) of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return edges.reshape(-1, 2).tolist()


@pytest.mark.parametrize("scale", [0.003, 1.0, 70_000.0])
def test_the_bars_are_as_high_as_the_figures_and_a_is_a_line(scale):
    figures = np.array([2.0, 1.0, 4.0, 0.0, 3.0])
    picture = chart("disparities", ["48", "64", "96", "128"], list(scale * figures))
    bars = (picture == VARIANT_RGB).all(2)
    columns = spans(bars.any(0))
    assert len(columns) == 4
    heights = np.array([bars[:, first + 1 : end - 1].sum(0).max() for first, end in columns])
    np.testing.assert_allclose(heights[[0, 3]] / heights[1], [0.25, 0.75], atol=0.03)
    assert heights[2] < 0.02 * heights[1]
    line = np.flatnonzero((picture == A_RGB).all(2).sum(1) > 100)
    floor = np.flatnonzero(bars.any(1)).max()
    assert floor - line.mean() == pytest.approx(heights[1] / 2, abs=4)
    assert TOP - 1 <= np.flatnonzero(bars.any(1)).min() < 150


def test_an_unknown_figure_has_no_bar_but_says_so():
    unknown, zero = (chart("disparities", ["1", "2"], [np.nan, figure, 4.0]) for figure in (np.nan, 0.0))
    assert len(spans((unknown == VARIANT_RGB).all(2).any(0))) == 1
    assert not (unknown == A_RGB).all(2).any()
    assert (unknown[:-BOTTOM, LEFT:] < 100).all(2).sum() > (zero[:-BOTTOM, LEFT:] < 100).all(2).sum() + 100


def test_values_that_would_overlap_are_left_out():
    crowd, few = (chart("p", [f"{number} m/s" for number in range(n)], [1.0] * (n + 1)) for n in (25, 2))
    labels = [spans((picture[-95:-55] < 100).all(2).any(0)) for picture in (crowd, few)]
    gaps = np.diff(np.ravel(labels[0]))[1::2]
    assert gaps.max() > 20
    assert len(labels[0]) < 25 * len("24 m/s")
