"""The plane that aligns a frame to the map: robust to changes, and bounded by its prior."""

import numpy as np
import pytest

from stages.terrain import height_alignment
from stages.terrain.height_alignment import fit_plane

EXPECTED = np.array([0.05, 0.005, 0.005])


def differences(plane, count=4000, seed=1, noise=0.01):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(1, 8, count), rng.uniform(-4, 4, count)
    return x, y, plane[0] + plane[1] * x + plane[2] * y + noise * rng.normal(size=count)


def test_a_plane_is_found_although_a_fifth_of_the_ground_has_changed():
    plane = np.array([0.02, 0.006, -0.004])
    x, y, off = differences(plane)
    off[x > 6.5] -= 0.3
    found, _ = fit_plane(x, y, off, np.full(len(x), 1e-4), EXPECTED, 0.05)
    np.testing.assert_allclose(np.column_stack([np.ones_like(x), x, y]) @ (found - plane), 0, atol=0.012)


def test_of_many_cells_a_few_thousand_give_the_same_plane_and_covariance(monkeypatch):
    x, y, off = differences(np.array([0.02, 0.006, -0.004]), count=30_001)
    given = x, y, off, np.full(len(x), 1e-4), EXPECTED, 0.05
    found, covariance = fit_plane(*given)
    monkeypatch.setattr(height_alignment, "MAX_CELLS", len(x))
    whole, expected = fit_plane(*given)
    np.testing.assert_allclose(np.column_stack([np.ones_like(x), x, y]) @ (found - whole), 0, atol=0.001)
    np.testing.assert_allclose(covariance, expected, rtol=0.1, atol=1e-8)


def test_without_an_overlap_there_is_no_plane():
    nothing = np.empty(0)
    plane, covariance = fit_plane(nothing, nothing, nothing, nothing, EXPECTED, 0.05)
    np.testing.assert_array_equal(plane, 0)
    np.testing.assert_allclose(covariance, np.diag(EXPECTED**2))


def test_a_few_cells_do_not_tilt_a_frame():
    x, y, off = differences(np.array([0.0, 0.2, 0.0]), count=3)
    found, _ = fit_plane(x, y, off, np.full(3, 1e-2), EXPECTED, 0.05)
    assert np.abs(found[1:]).max() < 2e-4


@pytest.mark.parametrize("fixed", [0, 1, 2])
def test_a_number_with_a_zero_sigma_stays_zero(fixed):
    free = np.arange(3) != fixed
    x, y, off = differences(np.array([0.02, 0.006, -0.004]))
    found, _ = fit_plane(x, y, off, np.full(len(x), 1e-4), EXPECTED * free, 0.05)
    np.testing.assert_array_equal(found != 0, free)
