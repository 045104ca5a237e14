"""MatchOpenCV: disparities in range and in view, the same bits in every thread; test_match has what all matchers do."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.matching.match_opencv import MatchOpenCV
from tests.stages.matching.pairs import check_in_view, frame_of, slanted_pair, textured


@settings(max_examples=12, deadline=None)
@given(
    st.integers(32, 90), st.integers(32, 90), st.sampled_from([3, 5, 8]), st.integers(16, 130), st.integers(-20, 20),
    st.integers(0, 99),
)  # fmt: skip
def test_any_size_gives_disparities_in_range_and_in_the_right_image(h, w, paths, disparities, minimum, seed):
    left = textured(h, w, seed).astype(np.uint8)
    right = np.roll(left, -5, axis=1)
    result = MatchOpenCV(disparities=disparities, min_disparity=minimum, paths=paths)(frame_of(left, right))
    check_in_view(result, minimum, minimum + -(-disparities // 16) * 16)
    assert ((result.confidence >= 0) & (result.confidence <= 1)).all()


@pytest.mark.parametrize("paths", [3, 5, 8])
def test_the_bits_depend_neither_on_company_nor_on_the_pool(paths):
    frame, _ = slanted_pair()
    pool = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        alone = MatchOpenCV(disparities=48, paths=paths)(frame)
        cv2.setNumThreads(4)
        with ThreadPoolExecutor(3) as workers:
            others = list(workers.map(MatchOpenCV(disparities=48, paths=paths), [frame] * 4))
    finally:
        cv2.setNumThreads(pool)
    for other in others:
        assert other.pixels.tobytes() == alone.pixels.tobytes()
        assert other.confidence.tobytes() == alone.confidence.tobytes()


def test_confident_matches_are_right_more_often():
    frame, truth = slanted_pair()
    spoiled = frame.right.copy()
    spoiled[60:120, 100:200] = textured(60, 100, seed=5).astype(np.uint8)
    result = MatchOpenCV(disparities=48, p1=0.5, p2=1, max_speckle_size=0)(frame_of(frame.left, spoiled))
    known = np.isfinite(result.pixels)
    wrong = (np.abs(result.pixels - truth) > 1)[known]
    sure = result.confidence[known] > np.median(result.confidence[known])
    assert wrong.mean() > 0.01
    assert wrong[sure].mean() < 0.2 * wrong.mean()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"block_size": 4}, "block_size must be odd"),
        ({"p1": 30.0}, "p2 must be above"),
        ({"paths": 4}, "must be one of 3, 5, 8"),
        ({"block_size": 9, "color": True}, "16 bits"),
    ],
)
def test_parameters_that_cannot_work_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        MatchOpenCV(**parameters)


def test_a_tiny_image_is_refused():
    image = np.zeros((20, 64), np.uint8)
    with pytest.raises(ValueError, match="64x20"):
        MatchOpenCV()(frame_of(image, image))
