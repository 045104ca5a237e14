"""The pages of a difference have one extent and one scale."""

import cv2
import numpy as np
import pytest

from recordings.comparison.pages import FLIPS, ONLY_ONE, pages
from recordings.export.page_layout import page_of
from recordings.export.png_pages import elevation_page, navigation_page
from recordings.ros2.to_msg import disparity_image, grid_map, occupancy_grid
from recordings.sinks import colormaps
from stages.data import Cell, Disparity, ElevationMap, NavigationMap

STAMP = 1_000_000_000
MAP, GRID, DISPARITY = "grid_map_msgs/msg/GridMap", "nav_msgs/msg/OccupancyGrid", "stereo_msgs/msg/DisparityImage"


def terrain(rows, cols, step=0.5, origin=(2.0, -1.0), height=0.0):
    ramp = np.tile(np.linspace(height, height + 1.0, cols, dtype=np.float32), (rows, 1))
    return ElevationMap(STAMP, {"elevation": ramp}, step, origin, "odom")


def navigation(cells, step=0.5, origin=(0.0, 0.0)):
    codes = np.array(cells, np.int8)
    return NavigationMap(STAMP, codes, np.zeros(codes.shape, np.uint8), step, origin, "odom")


def test_maps_of_other_extent_and_height_are_drawn_on_one_grid_with_one_scale():
    one, other = terrain(4, 6), terrain(8, 10, origin=(1.0, -2.0), height=3.0)
    drawn = pages(MAP, grid_map(one), grid_map(other))
    assert drawn is not None
    whole = {"elevation": np.full((8, 10), np.nan, np.float32)}
    whole["elevation"][2:6, 2:8] = one.layers["elevation"]
    limits = colormaps.elevation_limits(
        np.concatenate([whole["elevation"].ravel(), np.ravel(other.layers["elevation"])])
    )
    expected = elevation_page(ElevationMap(STAMP, whole, 0.5, (1.0, -2.0), "odom"), limits)
    np.testing.assert_array_equal(drawn[0].pixels, expected.pixels)
    np.testing.assert_array_equal(drawn[1].pixels, elevation_page(other, limits).pixels)
    np.testing.assert_array_equal(*(pixels[:, -3 * margin :] for pixels, margin in drawn[:2]))  # the scales
    assert drawn[2].pixels.shape == expected.pixels.shape
    assert (drawn[2].pixels == ONLY_ONE[2][1]).all(2).mean() > 0.2


def test_maps_of_other_cells_lie_on_each_other():
    coarse, fine = navigation([[0, 100], [0, 0]], step=1.0), navigation(np.zeros((4, 4)))
    drawn = pages(GRID, occupancy_grid(coarse), occupancy_grid(fine))
    assert drawn is not None
    np.testing.assert_array_equal(
        drawn[0].pixels, navigation_page(navigation(np.kron(coarse.cells, np.ones((2, 2), np.int8)))).pixels
    )
    freed, same = ((drawn[2].pixels == FLIPS[code][1]).all(2).sum() for code in (1, 0))
    assert freed == pytest.approx(same / 3, rel=0.05)


def test_disparities_have_one_scale_and_those_of_other_size_no_page():
    def message(rows, largest):
        pixels = np.linspace(1.0, largest, rows * 64, dtype=np.float32).reshape(rows, 64)
        return disparity_image(Disparity(STAMP, pixels, np.ones(pixels.shape, np.uint8), np.ones_like(pixels)))

    drawn = pages(DISPARITY, message(48, 30.0), message(48, 120.0))
    assert drawn is not None
    bars = [pixels[:, -3 * margin :] for pixels, margin in drawn[:2]]
    np.testing.assert_array_equal(*bars)
    assert pages(DISPARITY, message(48, 30.0), message(40, 30.0)) is None


def test_a_cell_that_turned_unknown_is_marked():
    drawn = pages(GRID, occupancy_grid(navigation([[0, Cell.HAZARD]])), occupancy_grid(navigation([[0, -1]])))
    assert drawn is not None
    assert (drawn[2].pixels == FLIPS[3][1]).all(2).sum() > 100


@pytest.mark.parametrize("width", [160, 320, 641, 900, 1280, 2560])
def test_letters_are_legible_where_three_pages_share_a_window(width):
    page, margin = page_of(np.full((60, width, 3), 128, np.uint8), "N")
    assert page.shape[1] == width + 4 * margin
    rows = np.flatnonzero((page[:margin] < 100).all(2).any(1))
    height = np.ptp(rows) * min(1.0, 1600 / 3 / page.shape[1])
    assert 9 <= height <= 20
    assert cv2.countNonZero(page[:margin, :, 0]) > 0


def test_maps_far_apart_are_not_drawn():
    assert pages(MAP, grid_map(terrain(4, 6)), grid_map(terrain(4, 6, origin=(2e4, 2e4)))) is None
    assert pages(GRID, occupancy_grid(navigation([[0]])), occupancy_grid(navigation([[0]], origin=(2e4, 2e4)))) is None
