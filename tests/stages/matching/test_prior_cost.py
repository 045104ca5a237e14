"""The prior's cost: what each disparity costs is what the plain reference says, wherever the prior lies."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stages.matching.kernels.prior_cost import prior_costs, prior_costs_reference


@given(st.integers(1, 6), st.integers(1, 9), st.sampled_from([-40, 0, 7]), st.sampled_from([16, 32, 96]),
       st.sampled_from([0.0, 0.5, 2.3, 16.0]), st.sampled_from([0.0, 4.0, 9.5, 64.0]),
       st.integers(0, 2**31))  # fmt: skip
def test_costs_are_those_of_the_reference(height, width, minimum, lanes, weight, reach, seed):
    rng = np.random.default_rng(seed)
    prior = rng.uniform(minimum - 150, minimum + lanes + 150, (height, width)).astype(np.float32)
    prior[rng.random(prior.shape) < 0.3] = rng.choice([np.nan, np.inf, -np.inf, 1e30, -1e30])
    begin, table = prior_costs(prior, minimum, lanes, weight, reach)
    costs = table[begin[..., np.newaxis] + np.arange(lanes)]
    assert np.array_equal(costs, prior_costs_reference(prior, minimum, lanes, weight, reach))


def test_a_disparity_costs_its_distance_from_the_prior_up_to_the_reach():
    begin, table = prior_costs(np.array([[10.25, np.nan]], np.float32), 0, 16, 4.0, 3.0)
    assert table[begin[0, 0] + np.arange(16)].tolist() == [12] * 8 + [9, 5, 1, 3, 7, 11, 12, 12]
    assert not table[begin[0, 1] + np.arange(16)].any()


def test_each_block_of_pixels_has_a_factor_of_its_own():
    prior, gain = np.full((8, 12), 9.25, np.float32), np.array([[1, 2.5, 8], [8, 1, 4]], np.float32)
    begin, table = prior_costs(prior, 0, 16, 0.5, 4.0, gain)
    costs = table[begin[..., np.newaxis] + np.arange(16)]
    for (j, i), factor in np.ndenumerate(gain):
        block = np.s_[4 * j : 4 * j + 4, 4 * i : 4 * i + 4]
        np.testing.assert_array_equal(costs[block], prior_costs_reference(prior[block], 0, 16, 0.5 * factor, 4.0))
