"""The rotation spline of the tilt's diagnosis is that of scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.spatial.transform import RotationSpline as ScipySpline

from stages.localisation.tilt.rotation_spline import RotationSpline


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 50), spread=st.sampled_from((0.0, 1e-6, 1e-3, 0.05, 0.3)))
def test_rotations_are_those_of_scipy_at_any_time(seed: int, count: int, spread: float) -> None:
    random = np.random.default_rng(seed)
    times = 1e3 + np.cumsum(random.uniform(0.1, 1.5, count))
    turns = [Rotation.random(random_state=random)]
    for vector in random.normal(0, spread, (count - 1, 3)):
        turns.append(turns[-1] * Rotation.from_rotvec(vector))
    rotations = Rotation.concatenate(turns)
    asked = random.uniform(times[0] - 0.2, times[-1] + 0.2, 40)
    found = RotationSpline(times, rotations.as_matrix())(asked)
    np.testing.assert_allclose(found, ScipySpline(times, rotations)(asked).as_matrix(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [3, 10])
def test_the_rotations_given_are_met(count: int) -> None:
    rotations = Rotation.from_euler("xyz", np.random.default_rng(1).normal(0, 0.3, (count, 3))).as_matrix()
    times = np.arange(float(count))
    np.testing.assert_allclose(RotationSpline(times, rotations)(times), rotations, atol=1e-12)
