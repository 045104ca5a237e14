"""The PNG pictures show what was published, the right way round."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.errors import LogError
from recordings.export.page_layout import Page
from recordings.export.png_pages import disparity_page, draw, elevation_page, navigation_page
from recordings.ros2.to_msg import disparity_image, grid_map, occupancy_grid
from recordings.sinks import colormaps
from stages.data import LEVEL_FRAME, Array, Cell, Disparity, ElevationMap, NavigationMap
from tests.conftest import write_messages

START, STEP = 1_000_000_000, 500_000_000
FREE, HAZARD, UNKNOWN = (colormaps.CELL_LEGEND[cell][1] for cell in (Cell.FREE, Cell.HAZARD, Cell.UNKNOWN))
ROWS, COLS = 6, 9


def navigation(stamp: int = START) -> NavigationMap:
    """Free, but for a hazard at the far left corner and unknown cells along the right edge."""
    cells = np.zeros((ROWS, COLS), np.int8)
    cells[-1, -1] = Cell.HAZARD  # largest y: left; largest x: ahead
    cells[0, :] = Cell.UNKNOWN
    return NavigationMap(stamp, cells, np.zeros(cells.shape, np.uint8), 0.5, (0.0, -1.5), LEVEL_FRAME)


def terrain(stamp: int = START) -> ElevationMap:
    """Rises ahead, with a hole in its middle."""
    elevation = np.tile(np.linspace(0.0, 2.0, COLS, dtype=np.float32), (ROWS, 1))
    elevation[3, 4] = np.nan
    return ElevationMap(stamp, {"elevation": elevation}, 0.5, (0.0, -1.5), LEVEL_FRAME)


def disparity(stamp: int = START) -> Disparity:
    """Far at the top, near at the bottom, unknown at the left."""
    pixels = np.tile(np.linspace(2.0, 60.0, 48, dtype=np.float32)[:, None], (1, 64))
    pixels[:, :8] = np.nan
    return Disparity(stamp, pixels, np.isfinite(pixels).astype(np.uint8), np.ones_like(pixels))


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A result log of five frames; the second has no maps."""
    stamps = [START + number * STEP for number in range(5)]
    rows = [(stamp, "/nav/disparity", disparity_image(disparity(stamp))) for stamp in stamps]
    for stamp in stamps[:1] + stamps[2:]:
        rows.append((stamp, "/nav/elevation_map", grid_map(terrain(stamp))))
        rows.append((stamp, "/nav/navigation_map", occupancy_grid(navigation(stamp))))
    return write_messages(tmp_path / "result.mcap", rows)


def cells_of(page: Page) -> Array:
    """The colours at the middles of the cells of a painted map, (COLS, ROWS, 3): x downwards, y to the left."""
    pixels, margin = page
    zoom = (pixels.shape[0] - 2 * margin) // COLS
    return pixels[margin + zoom // 2 :: zoom, margin + zoom // 2 :: zoom][:COLS, :ROWS]


def test_ahead_is_up_and_left_is_left():
    picture = cells_of(navigation_page(navigation()))
    expected = np.full((COLS, ROWS, 3), FREE)
    expected[0, 0] = HAZARD
    expected[:, -1] = UNKNOWN
    expected[-1, 3] = picture[-1, 3]  # the rover's marker reaches into its cell
    expected[-1, 2] = picture[-1, 2]
    np.testing.assert_array_equal(picture, expected)


def test_a_cropped_map_is_drawn_at_its_place_beside_the_rover():
    cells = np.full((2, COLS - 3), Cell.HAZARD, np.int8)
    corner = (1.5 + 1e-9, 1.0 + 1e-9)  # as sums of floats are
    cropped = NavigationMap(START, cells, np.zeros(cells.shape, np.uint8), 0.5, corner, LEVEL_FRAME)
    whole = np.full((4, COLS), Cell.UNKNOWN, np.int8)  # from the rover's place on
    whole[2:, 3:] = Cell.HAZARD
    expected = NavigationMap(START, whole, np.zeros(whole.shape, np.uint8), 0.5, (0.0, 0.0), LEVEL_FRAME)
    np.testing.assert_array_equal(navigation_page(cropped).pixels, navigation_page(expected).pixels)


def test_terrain_brightens_with_height_and_holes_stay_holes():
    picture = cells_of(elevation_page(terrain())).astype(int)
    assert tuple(picture[COLS - 1 - 4, ROWS - 1 - 3]) == colormaps.UNKNOWN_RGB
    green = picture[1:-1, 0, 1]  # viridis is greener the higher; the ramp rises ahead, which is up
    assert (np.diff(green) < 0).all()


def test_near_is_red_far_is_blue_unknown_is_neither():
    page, margin = disparity_page(disparity().pixels)
    picture = page[margin:, margin:]
    near, far = picture[46, 40].astype(int), picture[8, 40].astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert tuple(picture[20, 4]) == colormaps.UNKNOWN_RGB


def test_the_first_middle_and_last_frame_are_drawn_as_their_data(result, tmp_path):
    """GridMap and OccupancyGrid order their cells differently; both keep the orientation."""
    files = {path.name: cv2.imread(str(path)) for path in draw(result, tmp_path / "pictures")}
    pictures = {
        "disparity": disparity_page(disparity().pixels), "elevation": elevation_page(terrain()),
        "navigation": navigation_page(navigation()),
    }  # fmt: skip
    assert list(files) == [f"frame-{number:04d}-{name}.png" for number in (0, 2, 4) for name in pictures]
    for name, picture in pictures.items():
        file = files[f"frame-0000-{name}.png"]
        assert file is not None
        np.testing.assert_array_equal(file[..., ::-1], picture.pixels)


def test_a_log_without_results_is_named(tmp_path):
    path = write_messages(tmp_path / "raw.mcap", [(START, "/elsewhere", grid_map(terrain()))])
    with pytest.raises(LogError, match=r"raw\.mcap contains none of /nav/disparity"):
        draw(path, tmp_path)


def test_a_map_without_known_cells_is_drawn():
    nothing = np.full((ROWS, COLS), np.nan, np.float32)
    drawn = elevation_page(ElevationMap(START, {"elevation": nothing}, 0.5, (0.0, -1.5), LEVEL_FRAME))
    assert (cells_of(drawn)[:-1] == colormaps.UNKNOWN_RGB).all()
    page, margin = disparity_page(nothing)
    assert (page[margin : margin + ROWS, margin : margin + COLS] == colormaps.UNKNOWN_RGB).all()


def test_light_comes_from_ahead_on_the_left():
    x, y = np.meshgrid(np.arange(20), np.arange(20))
    towards, level, away = (
        colormaps.hillshade((share * (x + y)).astype(np.float32), 1.0)[10, 10] for share in (-0.3, 0.0, 0.3)
    )
    assert towards > level > away


@given(rise_x=st.floats(-2, 2), rise_y=st.floats(-2, 2), hole=st.tuples(st.integers(2, 5), st.integers(2, 5)))
def test_a_hole_does_not_change_the_shade_of_a_plane(rise_x, rise_y, hole):
    x, y = np.meshgrid(np.arange(8), np.arange(8))
    plane = rise_x * x + rise_y * y
    shade = colormaps.hillshade(plane, 1.0)
    np.testing.assert_allclose(shade, shade[0, 0], atol=1e-9)
    plane[hole] = np.nan
    known = np.isfinite(plane)
    np.testing.assert_allclose(colormaps.hillshade(plane, 1.0)[known], shade[0, 0], atol=1e-9)


@given(st.integers(2, 9), st.integers(2, 9), st.integers(0, 2**32 - 1))
def test_every_triangle_of_a_surface_joins_three_known_neighbours(rows, cols, seed):
    random = np.random.default_rng(seed)
    elevation = random.normal(size=(rows, cols)).astype(np.float32)
    elevation[random.random((rows, cols)) < 0.3] = np.nan
    grid = ElevationMap(START, {"elevation": elevation}, 1.0, (0.0, 0.0), LEVEL_FRAME)
    vertices, triangles = colormaps.surface(grid)
    np.testing.assert_array_equal(vertices[:, 2], elevation[np.isfinite(elevation)])
    corners = vertices[triangles]
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
    np.testing.assert_allclose(area, 1.0)  # half a cell, seen from above anticlockwise


def test_sixteen_bit_images_keep_their_contrast():
    """A 12 bit camera fills a quarter of a 16 bit range's bits, and must not come out black."""
    twelve = np.linspace(0, 4095, 256).astype(np.uint16).reshape(16, 16)
    bright, dark = np.tile(twelve, (16, 16)), np.tile(twelve // 2, (16, 16))
    dark[0, 0] = 65535  # a hot pixel
    eight, other = colormaps.top_eight_bits(bright, dark)
    assert (eight.min(), eight.max()) == (0, 255)
    assert other[-1, -1] == eight[-1, -1] // 2  # of one exposure
    assert colormaps.top_eight_bits(eight, bright)[0] is eight


@pytest.mark.parametrize(("value", "text"), [(-0.0, "0"), (-5.55e-17, "0"), (-0.25, "-0.25"), (112.0, "112")])
def test_scale_values_have_few_digits_and_no_minus_zero(value, text):
    assert colormaps.format_value(value) == text


def test_a_sampled_colour_range_covers_the_whole_layer():
    layer = np.linspace(-1.0, 1.0, 20 * colormaps.MIN_SAMPLES, dtype=np.float32).reshape(-1, 64)
    assert colormaps.value_limits(layer) == pytest.approx((-0.98, 0.98), abs=1e-3)
    assert colormaps.elevation_limits(layer) == pytest.approx((-1.0, 1.0))
    assert colormaps.disparity_limit(100.0 * layer) == 112.0
