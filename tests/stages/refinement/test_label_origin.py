"""Source and confidence of each pixel equal the plain reference."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stages.data import PixelOrigin
from stages.refinement.kernels.holes import BRIDGE, KEPT, MISMATCH, OCCLUSION, OPEN
from stages.refinement.kernels.label_origin import Trust, label_origin, label_origin_reference

TRUST = Trust((0.88, 0.98, 0.99), (0.62, 0.86, 0.97), 0.85, 0.83, 0.84, 0.58, 0.56)


@given(st.integers(1, 20), st.integers(1, 30), st.integers(0, 2**31))
def test_origin_and_confidence_equal_the_reference(height, width, seed):
    rng = np.random.default_rng(seed)
    shape = height, width
    matches = np.where(rng.random(shape) < 0.4, np.nan, rng.uniform(2, 9, shape)).astype(np.float32)
    refined = np.where(np.isnan(matches), 5, matches + rng.choice([0, 0.4, 0.5, 0.6, -3], shape)).astype(np.float32)
    refined[rng.random(shape) < 0.2] = np.nan
    kinds = np.where(np.isnan(matches), rng.integers(0, BRIDGE + 1, shape), KEPT).astype(np.uint8)
    confidence = rng.uniform(-0.1, 1.1, shape).astype(np.float32)
    reasons = rng.choice(np.array([0, 4, 6, 10], np.uint8), shape)
    sigma = rng.choice([0, 0.1, 0.3, 2, 1e6], shape).astype(np.float32)
    agreed, correlated = (rng.random(shape) < share for share in (0.5, 0.8))
    given = matches, confidence, agreed, kinds, refined, correlated, reasons, sigma, TRUST
    source, worth = label_origin(*given)
    expected, expected_worth = label_origin_reference(*given)
    assert np.array_equal(source, expected)
    assert np.allclose(worth, expected_worth, rtol=1e-6)


def test_every_origin_has_its_own_confidence():
    nan = np.nan
    matches = np.array([[8, 8, 8, 8, nan, nan, nan, nan]], np.float32)
    refined = np.array([[8.5, 8, 8, 8.6, 8, 8, 8, nan]], np.float32)
    kinds = np.array([[KEPT, KEPT, KEPT, KEPT, KEPT, MISMATCH, OCCLUSION, OPEN]], np.uint8)
    agreed = np.array([[True, False, False, True, True, False, False, False]])
    correlated = np.array([[True, True, False, True, False, False, True, True]])
    reasons = np.full((1, 8), PixelOrigin.LEFT_RIGHT, np.uint8)
    own = np.full((1, 8), 0.75, np.float32)
    source, worth = label_origin(
        matches, own, agreed, kinds, refined, correlated, reasons, np.zeros((1, 8), np.float32), TRUST
    )
    names = [PixelOrigin(code).name for code in source[0]]
    assert names == ["MEASURED", "MEASURED", "FILLED", "PLANE", "PLANE", "FILLED", "FILLED", "LEFT_RIGHT"]
    assert np.allclose(worth[0], [0.98, 0.86, 0.58, 0.83, 0.84, 0.58, 0.56, 0], atol=1e-3)


def test_a_hole_that_the_images_support_is_measured_unless_it_is_hidden_or_bridged():
    hole, own = np.full((1, 4), np.nan, np.float32), np.ones((1, 4), np.float32)
    kinds = np.array([[KEPT, MISMATCH, OCCLUSION, BRIDGE]], np.uint8)
    supported, nothing = np.ones((1, 4), bool), np.zeros((1, 4), np.uint8)
    sigma = np.full((1, 4), 0.2, np.float32)
    source, _ = label_origin(hole, own, supported, kinds, own, supported, nothing, sigma, TRUST)
    assert [PixelOrigin(code).name for code in source[0]] == ["MEASURED", "MEASURED", "FILLED", "FILLED"]


def test_confidence_falls_with_sigma():
    one, nothing = np.ones((1, 3), np.float32), np.zeros((1, 3), np.uint8)
    yes = np.ones((1, 3), bool)
    sigma = np.array([[0.1, 0.5, 1.0]], np.float32)
    _, worth = label_origin(one, one, yes, nothing, one, yes, nothing, sigma, TRUST)
    assert np.allclose(worth[0] / worth[0, 0], [1, 0.954, 0.683], atol=2e-3)
