"""Projected points and their derivatives are those of OpenCV."""

from __future__ import annotations

import numpy as np
import pytest

from stages.localisation.kernels.projection import projected, projected_reference

MATRIX = np.array([[410.0, 0, 321.5], [0, 405.0, 238.0], [0, 0, 1]])


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (1e-9, 0.0, -2e-9), (0.02, -0.1, 0.03), (2.0, 1.5, -1.0)])
def test_points_project_as_opencv_projects_them(turn: tuple[float, float, float]) -> None:
    points = np.random.default_rng(1).normal((0, 0, 3), 2, (500, 3))  # some are behind the camera
    given = points, np.array(turn), np.array([0.3, -0.1, 0.2]), MATRIX
    for mine, reference in zip(projected(*given), projected_reference(*given), strict=True):
        np.testing.assert_allclose(mine, reference, rtol=1e-11, atol=1e-12 * np.abs(reference).max())


def test_a_point_in_the_plane_of_the_camera_projects_as_with_opencv() -> None:
    given = np.array([[0.5, -0.25, 0.0]]), np.zeros(3), np.zeros(3), MATRIX
    for mine, reference in zip(projected(*given), projected_reference(*given), strict=True):
        np.testing.assert_array_equal(mine, reference)
