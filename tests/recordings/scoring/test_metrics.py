"""Error metrics, on cases small enough to work out by hand."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.scoring import metrics

NAN = float("nan")


def heights(*parts):
    """The metrics of errors added in parts."""
    errors = metrics.HeightErrors()
    for part in parts:
        errors.add(part)
    return errors.metrics()


def test_height_errors_by_hand():
    found = heights([0.01, -0.03], [[0.05, NAN], [NAN, 0.09]])
    assert found["cells"] == 4
    assert found["bias"] == pytest.approx(0.03)
    assert found["mae"] == pytest.approx(0.045)
    assert found["rmse"] == pytest.approx(np.sqrt((1 + 9 + 25 + 81) / 4) / 100)
    assert found["nmad"] == pytest.approx(1.4826 * 0.04)  # median 0.03, deviations .02 .06 .02 .06
    assert found["within_5cm"] == 0.75


def test_no_heights_have_no_error():
    found = heights([NAN])
    assert found.pop("cells") == 0
    assert np.isnan(list(found.values())).all()


@given(st.lists(st.floats(-0.4, 0.4), min_size=1, max_size=60))
def test_the_nmad_of_the_histogram_is_exact_to_a_hundredth_of_a_mm(errors):
    exact = 1.4826 * np.median(np.abs(np.array(errors) - np.median(errors)))
    assert heights(errors)["nmad"] == pytest.approx(exact, abs=1.5e-5)


def test_errors_beyond_the_histogram_make_the_nmad_nan():
    found = heights([0.01, 0.02, 0.03, 5.0])
    assert found["nmad"] == pytest.approx(1.4826 * 0.01)  # median 0.025, deviations .015 .005 .005 and a large one
    assert found["rmse"] == pytest.approx(np.sqrt((0.0001 + 0.0004 + 0.0009 + 25) / 4))
    assert np.isnan(heights([0.01, 3.0, 4.0])["nmad"])
    assert np.isnan(heights([0.9, 3.0])["nmad"])
    assert np.isnan(heights([0.0, 0.9, 3.0, -3.0])["nmad"])  # the median is known, the distances from it are not


def test_height_errors_take_no_more_memory_for_more_frames():
    errors = metrics.HeightErrors()
    errors.add(np.zeros(1000))
    before = len(pickle.dumps(errors))
    for _ in range(20):
        errors.add(np.full(100_000, 0.02))
    assert len(pickle.dumps(errors)) < before + 100
    assert errors.metrics()["cells"] == 2_001_000


def test_a_cell_on_the_border_of_two_rings_is_in_the_outer_one_only():
    radius = np.array([0.0, 3.999, 4.0, 7.999, 8.0])
    assert metrics.in_ring(radius, 0.0, 4.0).tolist() == [True, True, False, False, False]
    assert metrics.in_ring(radius, 4.0, 8.0).tolist() == [False, False, True, True, False]


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-2, 2))
def test_without_its_plane_a_tilted_and_shifted_map_has_no_error(east, north, up):
    x, y = np.linspace(-8, 8, 9), np.linspace(-4, 4, 7)
    error = east * x[None, :] + north * y[:, None] + up
    error[2, 3] = NAN
    left = metrics.without_plane(x, y, error)
    assert np.isnan(left[2, 3])
    assert np.nanmax(np.abs(left)) < 1e-9


def test_residuals_of_a_plane_through_three_cells_are_unknown():
    error = np.full((3, 3), NAN)
    error[0, 0] = error[1, 1] = error[0, 2] = 1.0
    assert np.isnan(metrics.without_plane(np.arange(3.0), np.arange(3.0), error)).all()


def test_the_angle_between_nearly_equal_directions_keeps_its_digits():
    assert metrics.angle_between([0, 0, 1], [np.sin(1e-9), 0, np.cos(1e-9)]) == pytest.approx(1e-9, rel=1e-6)
    assert metrics.angle_between([0, 0, 2], [3, 0, 0]) == pytest.approx(np.pi / 2)


def test_a_grid_lands_on_another_by_its_place_not_by_its_index():
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    out = metrics.aligned(values, (0.5, -0.5), (3, 3), (0.0, 0.0), 0.5, NAN)
    expected = np.full((3, 3), NAN, np.float32)
    expected[0, 1:] = [3, 4]
    np.testing.assert_array_equal(out, expected)


def test_grids_half_a_cell_apart_do_not_compare():
    with pytest.raises(ValueError, match=r"fraction of a 0\.5 m cell"):
        metrics.aligned(np.zeros((2, 2)), (0.25, 0.0), (2, 2), (0.0, 0.0), 0.5, NAN)


def test_grids_without_overlap_share_no_cell():
    assert np.isnan(metrics.aligned(np.zeros((2, 2)), (9.0, 9.0), (2, 2), (0.0, 0.0), 0.5, NAN)).all()
