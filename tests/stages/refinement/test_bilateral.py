"""The joint bilateral filter: equal to its plain reference, and true to edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.refinement.kernels.bilateral import joint_bilateral, joint_bilateral_reference


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(1, 5), st.integers(0, 2**31), st.booleans())
def test_the_filter_equals_its_reference(height, width, radius, seed, every):
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(0, 30, (height, width)).astype(np.float32)
    disparity[rng.random((height, width)) < 0.3] = np.nan
    guide = rng.integers(0, 256, (height, width), dtype=np.uint8)
    plain = joint_bilateral_reference(disparity, guide, radius, every)
    assert joint_bilateral(disparity, guide, radius, every=every) == pytest.approx(plain, abs=1e-4, nan_ok=True)
