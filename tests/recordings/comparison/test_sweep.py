"""The charts of a sweep."""

import numpy as np
import pytest

from recordings.comparison.sweep import A_RGB, BOTTOM, TOP, VARIANT_RGB, chart


def spans(mask):
    """(First, end) of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return edges.reshape(-1, 2).tolist()


@pytest.mark.parametrize("scale", [0.003, 1.0, 70_000.0])
def test_the_bars_are_as_high_as_the_figures_and_the_first_one_is_a(scale):
    figures = np.array([2.0, 1.0, 4.0, 0.0, 3.0])
    picture = chart("disparities", ["48", "64", "96", "128"], list(scale * figures))
    bars, first = ((picture == rgb).all(2) for rgb in (VARIANT_RGB, A_RGB))
    columns = spans((bars | first).any(0))
    heights = np.array([(bars | first)[:, left:right].any(1).sum() for left, right in columns])
    np.testing.assert_allclose(heights / heights[2], figures / 4, atol=0.01)
    assert spans(first.any(0)) == columns[:1]
    assert np.flatnonzero(bars.any(1)).min() == TOP


def test_an_unknown_figure_has_no_bar_but_says_so():
    picture = chart("disparities", ["1", "2"], [np.nan, np.nan, 4.0])
    assert len(spans((picture == VARIANT_RGB).all(2).any(0))) == 1
    assert not (picture == A_RGB).all(2).any()
    assert len(spans((picture[:-BOTTOM, :600] < 100).all(2).any(0))) >= 2  # two words


def test_texts_of_many_values_do_not_overlap():
    picture = chart("p", [f"{number} metres" for number in range(25)], [1.0] * 26)
    texts = [spans((lines < 100).all(2).any(0)) for lines in (picture[:TOP], picture[1 - BOTTOM : 50 - BOTTOM])]
    for letters in texts:
        gaps = np.diff(np.ravel(letters))[1::2]
        assert (gaps >= 2).sum() >= 25


def test_a_figure_that_rounds_to_a_thousand_is_written_as_one():
    np.testing.assert_array_equal(chart("p", ["b"], [1000.0, 999.7]), chart("p", ["b"], [1000.0, 1000.0]))
