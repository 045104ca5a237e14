"""Rotations: what scipy's `Rotation` returns."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from stages.data import rotations

NUMBER = st.floats(-1.0, 1.0)
QUATERNION = arrays(np.float64, 4, elements=NUMBER).filter(lambda q: np.linalg.norm(q) > 1e-3)
VECTOR = arrays(np.float64, 3, elements=st.floats(-4.0, 4.0) | st.floats(-1e-3, 1e-3))


def same(one, other):
    """Equal but for the rounding of another compiler."""
    return np.allclose(one, other, rtol=0, atol=1e-15)


@given(QUATERNION, QUATERNION)
def test_quaternions_turn_as_those_of_scipy(one, other):
    first, second = Rotation.from_quat(one), Rotation.from_quat(other)
    assert same(rotations.unit(one), first.as_quat())
    assert same(rotations.matrix_of(one), first.as_matrix())
    assert same(rotations.product(first.as_quat(), second.as_quat()), (first * second).as_quat())


@given(QUATERNION, st.sampled_from([0.0, 1e-4]))
def test_matrices_turn_as_those_of_scipy_also_rounded_ones(quaternion, rounding):
    matrix = Rotation.from_quat(quaternion).as_matrix()
    matrix = np.round(matrix / rounding) * rounding if rounding else matrix
    turn = Rotation.from_matrix(matrix)
    assert same(rotations.quaternion_of(matrix), turn.as_quat())
    assert same(rotations.canonical(rotations.quaternion_of(matrix)), turn.as_quat(canonical=True))
    assert same(rotations.nearest_rotation(matrix), turn.as_matrix())
    assert same(rotations.angle_of(matrix), turn.magnitude())


@given(VECTOR)
def test_rotation_vectors_turn_as_those_of_scipy(vector):
    assert same(rotations.turn_by(vector), Rotation.from_rotvec(vector).as_matrix())
    assert same(rotations.turn_about_z(vector[0]), Rotation.from_euler("z", vector[0]).as_matrix())


def test_a_mirror_is_no_rotation():
    with pytest.raises(ValueError, match="determinant is not positive"):
        rotations.quaternion_of(np.diag([1.0, 1.0, -1.0]))
