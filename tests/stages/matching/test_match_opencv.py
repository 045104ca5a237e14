"""Matching: right on a synthetic truth, silent where there is no evidence, the same bits in every thread."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.data import PixelOrigin, StereoCamera, StereoFrame
from stages.matching.match_opencv import MatchOpenCV


def frame_of(left, right):
    height, width = left.shape[:2]
    return StereoFrame(3, left, right, StereoCamera(300, 300, width / 2, height / 2, 0.1, width, height))


def textured(height, width, seed=0):
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return np.clip((smooth - 127) * 3 + 127, 0, 255)


def slanted_pair(height=200, width=320, near=34.0, far=6.0):
    """A pair that sees a plane, d growing downwards from `far` to `near`, and its true disparities (H, W)."""
    wide = textured(height, width + 80)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    disparity = far + (near - far) * y / (height - 1)
    right = cv2.remap(wide, x + 40, y, cv2.INTER_CUBIC)
    left = cv2.remap(wide, x + 40 - disparity, y, cv2.INTER_CUBIC)  # x_right = x_left - d
    left, right = (np.round(image).clip(0, 255).astype(np.uint8) for image in (left, right))
    return frame_of(left, right), disparity


@pytest.mark.parametrize("paths", [3, 5, 8])
@pytest.mark.parametrize("color", [False, True])
def test_a_slanted_plane_is_measured_to_a_fraction_of_a_pixel(paths, color):
    frame, truth = slanted_pair()
    if color:
        frame = replace(frame, left=np.dstack([frame.left] * 3), right=np.dstack([frame.right] * 3))
    result = MatchOpenCV(disparities=48, paths=paths, color=color)(frame)
    visible = np.arange(320) >= truth
    known = np.isfinite(result.pixels)
    assert known[visible].mean() > 0.95
    error = np.abs(result.pixels - truth)[known & visible]
    assert np.median(error) < 0.15
    assert (error > 1).mean() < 0.01
    assert (result.stamp, result.camera) == (frame.stamp, frame.camera)


def test_the_left_margin_is_matched_only_where_the_right_image_sees_it():
    frame, truth = slanted_pair()
    pixels = MatchOpenCV(disparities=48)(frame).pixels
    margin = np.s_[:, :48]
    visible = (np.arange(320) >= truth + 3)[margin]
    assert np.isfinite(pixels[margin])[visible].mean() > 0.9
    hidden = (np.arange(320) < truth - 3)[margin]
    assert np.isfinite(pixels[margin])[hidden].mean() < 0.05
    known = np.isfinite(pixels)
    assert (pixels <= np.arange(320))[known].all()


def test_a_negative_range_finds_points_beyond_infinity():
    frame, truth = slanted_pair()
    crossed = frame_of(frame.left[:, ::-1].copy(), frame.right[:, ::-1].copy())
    pixels = MatchOpenCV(disparities=48, min_disparity=-47)(crossed).pixels
    known = np.isfinite(pixels)
    assert known.mean() > 0.85
    assert np.median(np.abs(pixels + truth[:, ::-1])[known]) < 0.15


def test_sixteen_bit_images_match_like_eight_bit_ones():
    frame, truth = slanted_pair()
    deep = frame_of(frame.left.astype(np.uint16) * 9 + 700, frame.right.astype(np.uint16) * 9 + 700)
    pixels = MatchOpenCV(disparities=48)(deep).pixels
    known = np.isfinite(pixels)
    assert known[np.arange(320) >= truth].mean() > 0.95
    assert np.median(np.abs(pixels - truth)[known]) < 0.15


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("level", [0, 255])
def test_a_uniform_image_has_no_disparity(dtype, level):
    image = np.full((64, 96), level, dtype)
    result = MatchOpenCV(disparities=32)(frame_of(image, image))
    assert np.isnan(result.pixels).all()
    assert (result.source == PixelOrigin.BLANK).all()
    assert (result.confidence == 0).all()


@settings(max_examples=12, deadline=None)
@given(
    st.integers(32, 90), st.integers(32, 90), st.sampled_from([3, 5, 8]), st.integers(16, 130), st.integers(-20, 20),
    st.integers(0, 99),
)  # fmt: skip
def test_any_size_gives_disparities_in_range_and_in_the_right_image(h, w, paths, disparities, minimum, seed):
    left = textured(h, w, seed).astype(np.uint8)
    right = np.roll(left, -5, axis=1)
    result = MatchOpenCV(disparities=disparities, min_disparity=minimum, paths=paths)(frame_of(left, right))
    known = np.isfinite(result.pixels)
    partner = (np.arange(w) - result.pixels)[known]
    assert ((partner >= 0) & (partner <= w - 1)).all()
    assert (result.pixels[known] >= minimum).all()
    assert (result.pixels[known] <= minimum + -(-disparities // 16) * 16).all()
    assert np.array_equal(result.source == PixelOrigin.MEASURED, known)
    assert (result.confidence[~known] == 0).all()
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
