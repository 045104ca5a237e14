"""GeoTIFF: one layer of a map as float32, first row northmost (largest y), NaN where nothing is known.

The frame of reference is a local one, in metres: the citation names it, and there is no projection. Cells are areas, so
the tie point is the upper left corner of the first cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tifffile

from recordings.export.mosaic import Mosaic
from stages.data import Array

TILE_CELLS = 256  # the unit that a reader decompresses
# TIFF tags and GeoTIFF keys (OGC 19-008r4), and GDAL's own tag for a value that means no data
PIXEL_SCALE, TIE_POINT, GEO_KEYS, GEO_TEXT, NO_DATA = 33550, 33922, 34735, 34737, 42113
MODEL_TYPE, RASTER_TYPE, CITATION, LINEAR_UNITS = 1024, 1025, 1026, 3076
USER_DEFINED, PIXEL_IS_AREA, METRE = 32767, 1, 9001
DOUBLE, SHORT, ASCII = 12, 3, 2


def write_geotiff(path: Path, mosaic: Mosaic, layer: str, citation: str) -> None:
    """Write a layer of a map; citation: its frame of reference and time, ASCII."""
    rows, cols = mosaic.shape
    left, bottom = mosaic.origin
    text = citation.encode("ascii", "replace").decode() + "|"
    keys = [
        1, 1, 0, 4,
        MODEL_TYPE, 0, 1, USER_DEFINED,
        RASTER_TYPE, 0, 1, PIXEL_IS_AREA,
        CITATION, GEO_TEXT, len(text), 0,
        LINEAR_UNITS, 0, 1, METRE,
    ]  # fmt: skip
    scale = (mosaic.resolution, mosaic.resolution, 0.0)
    corner = (0.0, 0.0, 0.0, left, bottom + rows * mosaic.resolution, 0.0)
    tifffile.imwrite(
        path, _tiles(mosaic, layer), shape=(rows, cols), dtype=np.float32, tile=(TILE_CELLS, TILE_CELLS),
        photometric="minisblack", compression="zlib", description=layer, metadata=None, software="roverflow",
        extratags=[
            (PIXEL_SCALE, DOUBLE, 3, scale, True), (TIE_POINT, DOUBLE, 6, corner, True),
            (GEO_KEYS, SHORT, len(keys), keys, True), (GEO_TEXT, ASCII, len(text) + 1, text, True),
            (NO_DATA, ASCII, 4, "nan", True),
        ],
    )  # fmt: skip


def _tiles(mosaic: Mosaic, layer: str) -> Iterator[Array]:
    """The tiles of the image, from the upper left; cells outside the map are NaN."""
    rows, cols = mosaic.shape
    for top in range(0, rows, TILE_CELLS):
        for left in range(0, cols, TILE_CELLS):
            # Row r of the image is row rows - 1 - r of the map.
            block = mosaic.block(layer, rows - top - TILE_CELLS, left, TILE_CELLS, TILE_CELLS)
            yield np.ascontiguousarray(block[::-1])
