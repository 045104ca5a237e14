"""Partners of binary descriptors are those of an exhaustive search."""

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stages.compiled.hamming import MAX_OTHERS, clear_partners, nearest_two, nearest_two_reference
from stages.data import Array


def descriptors(count: int, seed: int, flips: int = 128) -> Array:
    """Random descriptors that differ from a common one by about `flips` bits; fewer give more ties."""
    random = np.random.default_rng(seed)
    bits = random.random((count, 256)) < flips / 256
    return np.packbits(bits, axis=1)


@given(st.integers(1, 70), st.integers(2, 200), st.integers(0, 99), st.sampled_from([0, 1, 3, 128, 256]))
def test_the_two_nearest_are_those_of_the_reference(count, others, seed, flips):
    codes, partners = descriptors(count, seed, flips), descriptors(others, seed + 1, 128 if flips == 256 else flips)
    found, known = nearest_two(codes, partners), nearest_two_reference(codes, partners)
    for mine, reference in zip(found, known, strict=True):
        np.testing.assert_array_equal(mine, reference)


def test_opposite_descriptors_differ_in_all_bits():
    zeros, all_ones = np.zeros((1, 32), np.uint8), np.full((2, 32), 255, np.uint8)
    assert [int(part[0]) for part in nearest_two(zeros, all_ones)] == [0, 255, 255]


def test_partners_are_those_that_opencv_finds():
    here, there = descriptors(700, 1), descriptors(900, 2)
    there[:500] = here[100:600] ^ np.packbits(np.random.default_rng(3).random((500, 256)) < 0.1, axis=1)
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(here, there, 2)
        if best.distance <= 64 and best.distance < 0.8 * second.distance
    ]
    found, partners = clear_partners(here, there, 64, 0.8)
    assert list(zip(found.tolist(), partners.tolist(), strict=True)) == pairs
    assert len(pairs) > 450


def test_too_few_have_no_clear_partner_and_of_too_many_the_first_are_compared():
    assert [len(part) for part in clear_partners(descriptors(3, 1), descriptors(1, 1), 64, 0.8)] == [0, 0]
    assert [len(part) for part in clear_partners(descriptors(0, 1), descriptors(3, 1), 64, 0.8)] == [0, 0]
    codes = descriptors(50, 1)
    many = np.concatenate([codes, descriptors(MAX_OTHERS, 2)])  # as in a pattern of dots
    np.testing.assert_array_equal(clear_partners(codes, many, 64, 0.8)[1], np.arange(50))
