"""Merged regions equal the plain reference and do not cross image edges."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stages.refinement.kernels.region_merging import merge_regions, merge_regions_reference
from stages.refinement.kernels.slic import superpixels


@given(st.integers(4, 60), st.integers(4, 60), st.integers(1, 40), st.integers(1, 12), st.integers(0, 2**31))
def test_regions_equal_the_reference(height, width, aimed, groups, seed):
    rng = np.random.default_rng(seed)
    shape = (height, width, 3) if seed % 2 else (height, width)
    image = rng.integers(0, 256, shape, dtype=np.uint8)
    labels, count = superpixels(image, aimed)
    region, total = merge_regions(image, labels, count, groups)
    expected, expected_total = merge_regions_reference(image, labels, count, groups)
    assert np.array_equal(region, expected)
    assert total == expected_total


def test_neither_superpixels_nor_regions_cross_an_edge_of_the_image():
    image = np.full((120, 160), 60, np.uint8)
    image[:, 83:] = 180
    labels, count = superpixels(image, 120)
    region, total = merge_regions(image, labels, count, 8)
    regions = region[labels]
    assert set(regions[:, :83].ravel()) & set(regions[:, 83:].ravel()) == set()
    assert 4 <= total <= 12
