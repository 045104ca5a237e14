"""Rivals of matches: as plain numpy finds them, a period away."""

import numpy as np
import pytest

from stages.matching.image_noise import frame_noise
from stages.matching.intensity import gray_pair
from stages.matching.kernels.rivals import HALF_ROWS, NONE, find_rivals, find_rivals_reference
from tests.stages.matching.ground_patterns import pattern_pair, stripes


@pytest.mark.parametrize(("pattern", "shift"), [(stripes(0.12), 0.0), (lambda x, y: np.sin(40 * x + 9 * y), 1.7)])
def test_rivals_equal_those_of_plain_numpy(pattern, shift):
    frame, truth = pattern_pair(pattern, 10, grains=4)
    pixels = (truth + shift).astype(np.float32)
    rows, columns = np.meshgrid(np.arange(HALF_ROWS, 239, 17), np.arange(12, 309, 23), indexing="ij")
    samples = np.stack([rows.ravel(), columns.ravel()], axis=1)
    given = gray_pair(frame), pixels, samples, frame_noise(frame), 12, 0.0, 60
    found, wanted = find_rivals(*given), find_rivals_reference(*given)
    inside = wanted.texture > 0
    assert 0.5 < inside.mean() < 1
    assert (wanted.rival[inside] < NONE).any()
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=0.1)


def test_only_a_pattern_has_rivals_as_good_as_the_match():
    samples = np.stack(np.meshgrid(np.arange(60, 230, 20), np.arange(120, 300, 20), indexing="ij"), axis=-1)
    for pattern, contrast, grains, least, most in ((stripes(0.12), 20, 0, 0.9, 1), (stripes(1), 0, 10, 0, 0.05)):
        frame, truth = pattern_pair(pattern, contrast, grains=grains)
        texture, found, rival = find_rivals(
            gray_pair(frame), truth.astype(np.float32), samples.reshape(-1, 2), frame_noise(frame), 12, 0.0, 80
        )
        assert least <= np.mean(rival - found < 0.05 * texture) <= most
