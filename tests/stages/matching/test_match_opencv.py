"""MatchOpenCV: disparities in range and in view, the same bits in every thread; test_match has what all matchers do."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.data import PixelOrigin
from stages.matching.match_opencv import MatchOpenCV
from tests.stages.matching.pairs import REASONS, SLOPE, SPOILED, TRUTH, check_view, frame_of, same, textured


@settings(max_examples=12, deadline=None)
@given(
    st.integers(32, 90), st.integers(32, 90), st.sampled_from([3, 5, 8]), st.integers(16, 130), st.integers(-20, 20),
    st.integers(0, 99),
)  # fmt: skip
def test_any_size_gives_disparities_in_range_and_in_the_right_image(h, w, paths, disparities, minimum, seed):
    left = textured(h, w, seed).astype(np.uint8)
    match = MatchOpenCV(disparities=disparities, min_disparity=minimum, paths=paths)
    result = match(frame_of(left, np.roll(left, -5, axis=1)))
    check_view(result, minimum, minimum + -(-disparities // 16) * 16, (PixelOrigin.UNKNOWN, *REASONS))
    assert ((result.confidence >= 0) & (result.confidence <= 1)).all()


@pytest.mark.parametrize("paths", [3, 5, 8])
def test_the_bits_depend_neither_on_company_nor_on_the_pool(paths):
    match, pool = MatchOpenCV(disparities=48, paths=paths), cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        alone = match(SLOPE)
        cv2.setNumThreads(4)
        with ThreadPoolExecutor(3) as workers:
            assert all(same(other, alone) for other in workers.map(match, [SLOPE] * 4))
    finally:
        cv2.setNumThreads(pool)


def test_confident_matches_are_right_more_often():
    result = MatchOpenCV(disparities=48, p1=0.5, p2=1, max_speckle_size=0)(SPOILED)
    known = np.isfinite(result.pixels)
    wrong = (np.abs(result.pixels - TRUTH) > 1)[known]
    sure = result.confidence[known] > np.median(result.confidence[known])
    assert wrong.mean() > 0.01
    assert wrong[sure].mean() < 0.2 * wrong.mean()
