"""Plane per superpixel: exact on planes, blind to outliers, the same for the same seed, equal to its reference."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.refinement.kernels.plane_fit import fit_planes, fit_planes_reference, known_points

SHAPE = (48, 60)
ALIKE = np.ones(SHAPE, np.float32)  # weights


def render_planes(coefficients, labels):
    """The disparity image that the planes describe; NaN in segments without one."""
    y, x = np.mgrid[: labels.shape[0], : labels.shape[1]]
    a, b, c = coefficients[labels].transpose(2, 0, 1)
    return a * x + b * y + c


def tiles():
    """Six segments of 24x20 px, each its own plane, with noise, a fifth of outliers and a tenth of holes."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    labels = (y // 24 * 3 + x // 20).astype(np.int32)
    truth = rng.uniform([-0.3, -0.3, 20], [0.3, 0.3, 60], (6, 3))
    a, b, c = truth[labels].transpose(2, 0, 1)
    disparity = a * x + b * y + c + rng.normal(0, 0.05, SHAPE)
    outlier = rng.random(SHAPE) < 0.2
    disparity[outlier] += rng.uniform(3, 30, outlier.sum())
    disparity[rng.random(SHAPE) < 0.1] = np.nan
    return disparity.astype(np.float32), labels, truth


DISPARITY, LABELS, TRUTH = tiles()


def test_outliers_and_holes_do_not_move_the_planes():
    planes = fit_planes(DISPARITY, LABELS, 6, ALIKE, 64)
    assert np.abs(render_planes(planes.coefficients, LABELS) - render_planes(TRUTH, LABELS)).max() < 0.05
    assert planes.inlier_share == pytest.approx(0.8, abs=0.06)
    assert planes.valid_share == pytest.approx(0.9, abs=0.05)


def test_equals_the_plain_reference_with_the_same_draws_and_weights():
    weights = np.random.default_rng(8).uniform(0.05, 1, SHAPE).astype(np.float32)
    for some in (ALIKE, weights):
        ours, plain = (fit(DISPARITY, LABELS, 6, some, 16, seed=11) for fit in (fit_planes, fit_planes_reference))
        assert ours.coefficients[:, :2] == pytest.approx(plain.coefficients[:, :2], abs=2e-5)
        images = [render_planes(planes.coefficients, LABELS) for planes in (ours, plain)]
        assert images[0] == pytest.approx(images[1], abs=1e-4)
        assert np.array_equal(ours.inlier_share, plain.inlier_share)
        assert np.array_equal(ours.valid_share, plain.valid_share)
    unweighted = render_planes(fit_planes(DISPARITY, LABELS, 6, ALIKE, 16, seed=11).coefficients, LABELS)
    assert np.abs(images[0] - unweighted).max() > 1e-3


def test_a_segment_is_fitted_alike_whatever_the_others_hold():
    alone = np.where(LABELS == 4, DISPARITY, np.float32(np.nan))
    among, single = (fit_planes(given, LABELS, 6, ALIKE, 64, seed=9).coefficients for given in (DISPARITY, alone))
    assert np.array_equal(among[4], single[4])


def test_too_few_or_collinear_pixels_give_no_plane():
    labels = np.zeros((10, 30), np.int32)
    labels[:, 15:] = 1
    disparity = np.full((10, 30), np.nan, np.float32)
    disparity[0, :5] = 7
    disparity[3, 15:] = 7
    planes = fit_planes(disparity, labels, 2, np.ones_like(disparity), 64)
    assert np.isnan(planes.coefficients).all()
    assert (planes.inlier_share == 0).all()
    assert np.isnan(render_planes(planes.coefficients, labels)).all()


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 9), st.integers(0, 2**31))
def test_known_points_are_listed_once_each_under_their_label(height, width, count, seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, count, (height, width), dtype=np.int32)
    disparity, weights = rng.random((2, height, width)).astype(np.float32)
    disparity[rng.random(labels.shape) < 0.3] = np.nan
    points, start, sizes = known_points(disparity, labels, count, weights)
    assert np.array_equal(sizes, np.bincount(labels.ravel(), minlength=count))
    for segment in range(count):
        y, x = np.nonzero((labels == segment) & np.isfinite(disparity))
        own = points[:, start[segment] : start[segment + 1]]
        assert np.array_equal(own, np.stack([x, y, disparity[y, x], weights[y, x]]).astype(np.float32))
