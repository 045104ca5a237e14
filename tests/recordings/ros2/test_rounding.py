"""Rounded values are off by no more than is stated, and unknown ones stay unknown."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from recordings.ros2.rounding import rounded_layer, to_multiples, to_relative

VALUES = arrays(
    np.float32, 50, elements=st.floats(-1000, 1000, width=32, allow_subnormal=False) | st.just(np.nan) | st.just(np.inf)
)


@given(VALUES, st.sampled_from([0.1, 0.01, 1 / 256, 1e-9]))
def test_relative_rounding_keeps_its_error_and_clears_bits(values, precision):
    found = to_relative(values, precision)
    np.testing.assert_allclose(found, values, rtol=precision, atol=0)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(values))
    spare = {0.1: 20, 0.01: 17, 1 / 256: 16, 1e-9: 0}[precision]
    known = found[np.isfinite(found)]
    assert not (known.view(np.uint32) & np.uint32((1 << spare) - 1)).any()


@given(VALUES, st.sampled_from([1 / 1024, 1 / 32]))
def test_lengths_become_the_nearest_multiples_of_the_step(values, step):
    found = to_multiples(values, step)
    np.testing.assert_allclose(found, values, rtol=1e-7, atol=step / 2)
    known = found[np.isfinite(found)].astype(np.float64) / step
    np.testing.assert_array_equal(known, np.rint(known))


@pytest.mark.parametrize(("name", "expected"), [
    ("elevation", 581 / 1024), ("slope", 73 / 128), ("last", 0.5678), ("count", 0.5678), ("my_cost", 0.5678),
])  # fmt: skip
def test_layers_are_rounded_by_what_they_contain(name, expected):
    values = np.float32([0.5678, np.nan])
    found = rounded_layer(name, values, 1 / 1024, 0.01)
    np.testing.assert_allclose(found, [expected, np.nan], rtol=1e-6)
    assert rounded_layer(name, values, 0.0, 0.0) is values
