"""The relief of a recording has the colours of the plain reference, in steps, and unknown cells keep theirs."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recordings.relief import relief
from recordings.sinks.colormaps import UNKNOWN_RGB, elevation_colors, fewer_shades
from stages.data import ElevationMap


@given(st.integers(1, 12), st.integers(1, 12), st.sampled_from([0.0, 0.3, 1.0]), st.sampled_from([0.01, 0.1, 2.0]))
def test_the_relief_in_one_pass_equals_the_reference(rows, cols, holes, height):
    rng = np.random.default_rng(rows * 100 + cols)
    heights = (height * rng.normal(size=(rows, 2 * cols))).astype(np.float32)[:, ::2]  # no contiguous rows
    heights[rng.random((rows, cols)) < holes] = np.nan
    terrain, limits = ElevationMap(0, {"elevation": heights}, 0.05, (0.0, 0.0), "level"), (-0.1, 0.2)
    found, known = relief(terrain, limits), np.isfinite(heights)
    np.testing.assert_array_equal(found[known], fewer_shades(elevation_colors(terrain, limits)[known]))
    assert (found[~known] == UNKNOWN_RGB).all()
