"""GeoTIFF: layers of a map as bands of float32, first row northmost (largest y), NaN where nothing is known.

The frame of reference is a local one, in metres: the citation names it. A georeference turns and shifts it into a zone
of UTM, without resampling. Cells are areas, so the tie point is the upper left corner of the first cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import tifffile

from recordings.export.georeference import Georeference
from recordings.export.mosaic import Mosaic
from stages.data import Array

TILE_CELLS = 256  # the unit that a reader decompresses
# TIFF tags and GeoTIFF keys (OGC 19-008r4), and GDAL's own tags for what bands contain and for no data
PIXEL_SCALE, TIE_POINT, TRANSFORMATION, GEO_KEYS, GEO_TEXT, BANDS, NO_DATA = (
    33550, 33922, 34264, 34735, 34737, 42112, 42113
)  # fmt: skip
MODEL_TYPE, RASTER_TYPE, CITATION, PROJECTED_CRS, LINEAR_UNITS = 1024, 1025, 1026, 3072, 3076
USER_DEFINED, PROJECTED, PIXEL_IS_AREA, METRE = 32767, 1, 1, 9001
DOUBLE, SHORT, ASCII = 12, 3, 2
LAYERS = {  # unit (UDUNITS) and meaning
    "elevation": ("m", "mean height"),
    "minimum": ("m", "least height"),
    "maximum": ("m", "greatest height"),
    "count": ("", "measured points"),
    "interpolated": ("", "1: may rest on pixels of neighbouring cells only"),
    "variance": ("m^2", "variance of the elevation (of a frame's map: without common_variance)"),
    "common_variance": ("m^2", "variance of the elevation from the tilt"),
    "occluded": ("", "1: hidden from the cameras"),
    "ceiling": ("m", "lowest line of sight over an occluded cell"),
    "filled": ("m", "mean height of points that are not measured"),
    "unmatched": ("", "why no pixel was matched: 1 dark, 2 burnt out, 3 bare (textureless), 4 other"),
    "ground": ("m", "height of the ground below obstacles"),
    "step": ("m", "height of an obstacle or depth of a pit"),
    "slope": ("rad", "slope of the ground below the footprint"),
    "steepness": ("rad", "slope below a wheel"),
    "roughness": ("m", "RMS of heights off their plane"),
    "support": ("", "share of known cells within a wheel's diameter"),
    "drop": ("m", "minimum depth of an occluded cell below the ground"),
    "first": ("s", "first time the cell was seen, after the map's epoch"),
    "last": ("s", "last time the cell was seen, after the map's epoch"),
    "frames": ("", "frames that saw the cell"),
    "logs": ("", "logs that saw the cell"),
    "best_log": ("", "number of the log with the smallest variance, as in merge.json"),
    "disagreement": ("m", "largest difference of two logs' heights"),
    "conflicts": ("", "pairs of logs whose heights differ by more than 3 sigma"),
    "contradictions": ("", "frames that contradicted the height"),
}  # fmt: skip


def write_geotiff(
    path: Path, mosaic: Mosaic, layers: Sequence[str], citation: str, place: Georeference | None = None
) -> None:
    """Write layers of a map, a band each, with their units; citation: frame of reference and time, ASCII."""
    rows, cols = mosaic.shape
    text = citation.encode("ascii", "replace").decode() + "|"
    keys = [
        1, 1, 0, 4 if place is None else 5,
        MODEL_TYPE, 0, 1, USER_DEFINED if place is None else PROJECTED,
        RASTER_TYPE, 0, 1, PIXEL_IS_AREA,
        CITATION, GEO_TEXT, len(text), 0,
        *([] if place is None else [PROJECTED_CRS, 0, 1, place.epsg]),
        LINEAR_UNITS, 0, 1, METRE,
    ]  # fmt: skip
    bands = _bands(layers)
    tiles = (tile for layer in layers for tile in _tiles(mosaic, layer))
    several = len(layers) > 1
    tifffile.imwrite(
        path, tiles, shape=(len(layers), rows, cols) if several else (rows, cols), dtype=np.float32,
        tile=(TILE_CELLS, TILE_CELLS),
        photometric="minisblack", compression="zlib", description=", ".join(layers).encode("ascii", "replace"),
        metadata=None, software="roverflow",
        planarconfig="separate" if several else None,
        extratags=[
            *_placement(mosaic, place),
            (GEO_KEYS, SHORT, len(keys), keys, True), (GEO_TEXT, ASCII, len(text) + 1, text, True),
            (BANDS, ASCII, len(bands) + 1, bands, True), (NO_DATA, ASCII, 4, "nan", True),
        ],
    )  # fmt: skip


def _placement(mosaic: Mosaic, place: Georeference | None) -> list[tuple[Any, ...]]:
    """The tags that lead from a pixel to its place."""
    left, top = mosaic.origin[0], mosaic.origin[1] + mosaic.shape[0] * mosaic.resolution
    if place is not None:
        return [(TRANSFORMATION, DOUBLE, 16, place.matrix(mosaic.resolution, left, top), True)]
    scale = (mosaic.resolution, mosaic.resolution, 0.0)
    return [(PIXEL_SCALE, DOUBLE, 3, scale, True), (TIE_POINT, DOUBLE, 6, (0.0, 0.0, 0.0, left, top, 0.0), True)]


def _bands(layers: Sequence[str]) -> bytes:
    """GDAL's description of the bands: the layer's name, its unit and its meaning."""
    items = []
    for number, layer in enumerate(layers):
        unit, meaning = LAYERS.get(layer, ("", ""))
        described = {"DESCRIPTION": (layer, "description"), "UNITTYPE": (unit, "unittype"), "MEANING": (meaning, "")}
        for name, (text, role) in described.items():
            roles = f' role="{role}"' if role else ""
            items += [f'<Item name="{name}" sample="{number}"{roles}>{escape(text)}</Item>'] if text else []
    return f"<GDALMetadata>{''.join(items)}</GDALMetadata>".encode()


def _tiles(mosaic: Mosaic, layer: str) -> Iterator[Array]:
    """The tiles of the image, from the upper left; cells outside the map are NaN."""
    rows, cols = mosaic.shape
    for top in range(0, rows, TILE_CELLS):
        for left in range(0, cols, TILE_CELLS):
            # Row r of the image is row rows - 1 - r of the map.
            block = mosaic.block(layer, rows - top - TILE_CELLS, left, TILE_CELLS, TILE_CELLS)
            yield np.ascontiguousarray(block[::-1])
