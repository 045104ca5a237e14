"""Tiles behave like one large array, and only written cells take memory."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stages.data.tiles import TILE_SIDE, Tiles, copied, put, taken
from stages.terrain.fused_map import CELL

DTYPE = np.dtype([("value", "f4"), ("mark", "u1")])
places = st.integers(-3 * TILE_SIDE, 2 * TILE_SIDE)
sizes = st.integers(1, 2 * TILE_SIDE)


@given(st.lists(st.tuples(places, places, sizes, sizes, st.integers(0, 2**32 - 1)), max_size=4), places, places)
def test_reads_equal_those_of_one_large_array(writes, row, col):
    model = np.zeros((12 * TILE_SIDE, 12 * TILE_SIDE), DTYPE)
    tiles, half = Tiles(DTYPE), 6 * TILE_SIDE
    for first_row, first_col, rows, cols, seed in writes:
        rng = np.random.default_rng(seed)
        block = np.zeros((rows, cols), DTYPE)
        block["value"], block["mark"] = rng.normal(size=(rows, cols)), 1
        changed = rng.random((rows, cols)) < 0.7
        tiles.write(first_row, first_col, block, changed)
        part = np.s_[first_row + half : first_row + half + rows, first_col + half : first_col + half + cols]
        np.copyto(model[part], block, where=changed)
    expected = model[row + half : row + half + 70, col + half : col + half + 90]
    np.testing.assert_array_equal(tiles.read(row, col, 70, 90), expected)


def test_a_read_block_is_a_copy():
    tiles = Tiles(DTYPE)
    tiles.write(0, 0, np.ones((2, 2), DTYPE), np.ones((2, 2), bool))
    tiles.read(0, 0, 2, 2)["value"] = 7
    assert tiles.read(0, 0, 2, 2)["value"].max() == 1


def test_unchanged_tiles_take_no_memory():
    tiles = Tiles(DTYPE)
    changed = np.zeros((1, 100 * TILE_SIDE), bool)
    changed[0, [0, -1]] = True
    tiles.write(0, 0, np.ones(changed.shape, DTYPE), changed)
    assert len(tiles.tiles) == 2


def test_cells_with_fields_are_taken_put_and_copied_as_by_a_mask():
    random = np.random.default_rng(3)
    cells = random.integers(0, 256, (9, 7, CELL.itemsize), np.uint8).view(CELL)[..., 0]
    where, other = random.random(cells.shape) < 0.4, random.permutation(cells.ravel()).reshape(cells.shape)
    assert taken(cells, where).tobytes() == cells[where].tobytes()
    expected, found = cells.copy(), copied(cells)
    assert found.tobytes() == cells.tobytes()
    expected[where] = other[where]
    put(found, where, taken(other, where))
    assert found.tobytes() == expected.tobytes()
    assert found.tobytes() != cells.tobytes()
