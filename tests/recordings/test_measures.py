"""Error measures, on cases small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings import measures

NAN = float("nan")


def test_disparity_errors_of_four_counted_pixels():
    truth = np.array([[10.0, 20.0, 30.0, 40.0, 50.0, NAN]], np.float32)
    estimate = np.array([[10.25, 20.75, NAN, 43.0, 99.0, 1.0]], np.float32)
    counted = np.array([[True, True, True, True, False, True]])
    found = measures.disparity_measures(estimate, truth, counted)
    assert found["pixels"] == 4
    assert found["density"] == 0.75
    assert (found["bad_0.5"], found["bad_1"], found["bad_2"]) == (0.75, 0.5, 0.5)  # the unknown one is always bad
    assert found["bad_0.5_known"] == pytest.approx(2 / 3)
    assert found["bad_1_known"] == found["bad_2_known"] == pytest.approx(1 / 3)
    assert found["mae"] == pytest.approx(4 / 3)
    assert found["rmse"] == pytest.approx(np.sqrt((0.0625 + 0.5625 + 9) / 3))


def test_an_error_of_exactly_the_threshold_is_not_bad():
    found = measures.disparity_measures(np.array([[11.0]]), np.array([[10.0]]), np.array([[True]]))
    assert found["bad_1"] == 0
    assert found["bad_0.5"] == 1


def test_an_estimate_that_knows_nothing_is_all_bad_and_has_no_error():
    found = measures.disparity_measures(np.full((2, 2), NAN), np.ones((2, 2)), np.ones((2, 2), bool))
    assert found["bad_2"] == 1
    assert found["density"] == 0
    assert np.isnan(found["rmse"])
    assert np.isnan(found["bad_2_known"])


@given(st.integers(0, 2**32 - 1), st.integers(1, 29))
def test_pooling_frames_gives_what_one_large_frame_would(seed, cut):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(1, 100, (30, 4))
    estimate = np.where(rng.random((30, 4)) < 0.3, NAN, truth + rng.normal(0, 1.5, (30, 4)))
    counted = rng.random((30, 4)) < 0.7
    whole = measures.disparity_measures(estimate, truth, counted)
    parts = [measures.disparity_measures(*(a[rows] for a in (estimate, truth, counted)))
             for rows in (slice(0, cut), slice(cut, 30))]  # fmt: skip
    pooled = measures.pooled_disparity(parts)
    assert pooled.keys() == whole.keys()
    assert [pooled[name] for name in whole] == pytest.approx(list(whole.values()), nan_ok=True)


def test_height_errors_by_hand():
    found = measures.height_measures([0.01, -0.03, 0.05, 0.09, NAN])
    assert found["cells"] == 4
    assert found["bias"] == pytest.approx(0.03)
    assert found["mae"] == pytest.approx(0.045)
    assert found["rmse"] == pytest.approx(np.sqrt((1 + 9 + 25 + 81) / 4) / 100)
    assert found["nmad"] == pytest.approx(1.4826 * 0.04)  # median 0.03, deviations .02 .06 .02 .06
    assert found["within_5cm"] == 0.75


def test_no_heights_have_no_error():
    assert np.isnan(measures.height_measures([NAN])["rmse"])


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-2, 2))
def test_a_tilted_and_shifted_map_is_perfect_once_its_plane_is_removed(east, north, up):
    x, y = np.linspace(-8, 8, 9), np.linspace(-4, 4, 7)
    error = east * x[None, :] + north * y[:, None] + up
    error[2, 3] = NAN
    left = measures.without_plane(x, y, error)
    assert np.isnan(left[2, 3])
    assert np.nanmax(np.abs(left)) < 1e-9


def test_a_plane_through_three_cells_proves_nothing():
    error = np.full((3, 3), NAN)
    error[0, 0] = error[1, 1] = error[0, 2] = 1.0
    assert np.isnan(measures.without_plane(np.arange(3.0), np.arange(3.0), error)).all()


def test_hazard_shares_by_hand():
    truth = np.array([100, 100, 100, 100, 0, 0, 0, 0, 0, 100], np.int8)
    cells = np.array([100, 0, 0, -1, 100, 0, 0, -1, 0, 100], np.int8)
    counted = np.array([True] * 9 + [False])
    found = measures.hazard_measures(cells, truth, counted)
    assert found == {"cells": 9, "unknown": 2 / 9, "recall": 0.25, "false_safe": 0.5, "false_alarm": 0.2}


def test_a_rock_counts_only_if_it_can_be_seen_and_is_found_within_a_cell_of_its_rim():
    x = y = (np.arange(40) + 0.5) * 0.1
    visible = np.ones((40, 40), bool)
    visible[:, 20:] = False
    cells = np.zeros((40, 40), np.int8)
    cells[10, 13] = 100  # centre (1.35, 1.05)
    cells[35, 35] = 100
    rocks = np.array([[1.05, 1.05, 0.42], [0.5, 3.0, 0.4], [3.55, 3.55, 0.4], [1.05, 1.05, 0.36]])
    seen, found = measures.rocks_found(rocks, cells, visible, x, y, 0.1)
    assert seen.tolist() == [True, True, False, True]
    assert found.tolist() == [True, False, False, False]  # reaches 0.31, 0.30, -, 0.28 for a hazard 0.30 away


def test_the_angle_between_nearly_equal_directions_keeps_its_digits():
    assert measures.angle_between([0, 0, 1], [np.sin(1e-9), 0, np.cos(1e-9)]) == pytest.approx(1e-9, rel=1e-6)
    assert measures.angle_between([0, 0, 2], [3, 0, 0]) == pytest.approx(np.pi / 2)


def test_a_grid_lands_on_another_by_its_place_not_by_its_index():
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    out = measures.aligned(values, (0.5, -0.5), (3, 3), (0.0, 0.0), 0.5, NAN)
    expected = np.full((3, 3), NAN, np.float32)
    expected[0, 1:] = [3, 4]
    np.testing.assert_array_equal(out, expected)


def test_grids_half_a_cell_apart_do_not_compare():
    with pytest.raises(ValueError, match=r"fraction of a 0\.5 m cell"):
        measures.aligned(np.zeros((2, 2)), (0.25, 0.0), (2, 2), (0.0, 0.0), 0.5, NAN)


def test_grids_that_do_not_overlap_have_nothing_in_common():
    assert np.isnan(measures.aligned(np.zeros((2, 2)), (9.0, 9.0), (2, 2), (0.0, 0.0), 0.5, NAN)).all()
