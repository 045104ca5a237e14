"""Numbers to colours: disparities, pixel origins, terrain and maps as RGB arrays, for the timeline and for PNG pages.

Every picture of a grid is a bird's-eye view: x (forward) up, y (left) to the left, as the driver sees it. Unknown has a
colour that no value has. Colour ranges are rounded, so that neighbouring frames share their colours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from stages.data import LEVEL_FRAME, Array, Cell, CellReason, ElevationMap, NavigationMap, PixelOrigin, cell_centres

Rgb = tuple[int, int, int]
Point = tuple[float, float]
Legend = Mapping[int, tuple[str, Rgb]]  # code -> name, colour

# Layer -> the upper end of its scale, twice the usual limit, and its unit
LAYER_SCALES = {
    "step": (0.4, "m"), "slope": (40.0, "deg"), "steepness": (40.0, "deg"), "roughness": (0.12, "m"),
    "variance": (0.009, "m²"), "frames": (20.0, "frames"), "contradictions": (4.0, "frames"),
}  # fmt: skip
MIN_SAMPLES = 4096  # values that a colour range is found from, where there are so many

UNKNOWN_RGB: Rgb = (46, 47, 54)
_ORIGIN_RGB: tuple[Rgb, ...] = (  # by code
    UNKNOWN_RGB, (62, 150, 104), (84, 132, 222), (232, 164, 60),
    (96, 100, 112), (150, 104, 74), (196, 70, 92), (190, 110, 190), (236, 220, 120), (226, 226, 232), (132, 186, 214),
)  # fmt: skip
SOURCE_LEGEND: Legend = {
    origin: (origin.name.lower().replace("_", " "), rgb) for origin, rgb in zip(PixelOrigin, _ORIGIN_RGB, strict=True)
}
CELL_LEGEND: Legend = {
    Cell.UNKNOWN: ("unknown", UNKNOWN_RGB),
    Cell.FREE: ("free", (196, 204, 190)),
    Cell.HAZARD: ("hazard", (216, 62, 48)),
}
REASON_LEGEND: Legend = {
    CellReason.CLEAR: ("clear", CELL_LEGEND[Cell.FREE][1]),
    CellReason.UNOBSERVED: ("unobserved", UNKNOWN_RGB),
    CellReason.ELEVATION: ("elevation", (200, 40, 90)),
    CellReason.STEP: ("step", (240, 140, 40)),
    CellReason.SLOPE: ("slope", (168, 90, 200)),
    CellReason.ROUGHNESS: ("roughness", (90, 140, 230)),
    CellReason.CLEARANCE: ("clearance", (216, 62, 48)),
    CellReason.BESIDE: ("beside", (250, 205, 130)),
    CellReason.OCCLUDED: ("occluded", (96, 84, 110)),
    CellReason.UNSURE: ("unsure", (120, 130, 128)),
    CellReason.UNMATCHED: ("unmatched", (110, 120, 170)),
}

_SUN = np.array([1.0, 1.0, np.sqrt(2.0)]) / 2.0  # from ahead on the left, 45 degrees high: the upper left of the map
_AMBIENT_LIGHT = 0.35


def apply_palette(values: Array, low: float, high: float, palette: int) -> Array:
    """values, any shape (..., ), as RGB uint8 (..., 3) of an OpenCV palette over [low, high]; NaN is UNKNOWN_RGB."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    color = np.where(np.isfinite(values), share * 255.0 + 0.5, 256.0).astype(np.uint16)
    return _table(palette).take(color, axis=0)


def legend_colors(codes: Array, legend: Legend) -> Array:
    """codes, integers of any shape (..., ), as RGB uint8 (..., 3) by a legend; a code that is not in it is white."""
    rgb = np.full((*codes.shape, 3), 255, np.uint8)
    for code, (_, colour) in legend.items():
        rgb[codes == code] = colour
    return rgb


def top_eight_bits(*images: Array) -> tuple[Array, ...]:
    """8 or 16 bit images of one exposure as 8 bit: the top bit that they use becomes bit 7, so a 12 bit camera is not
    black. The brightest thousandth does not count, so that a hot pixel does not darken the rest.

    Matching stretches its images by what each pair holds; here black stays black and most frames are shifted alike, so
    that the pictures of a traverse do not flicker.
    """
    deep = [pixels for pixels in images if pixels.dtype != np.uint8]
    top = max((np.percentile(pixels[::4, ::4], 99.9, method="nearest") for pixels in deep), default=0.0)
    shift = max(0, int(top).bit_length() - 8)
    return tuple(
        pixels if pixels.dtype == np.uint8 else np.minimum(pixels >> shift, 255).astype(np.uint8) for pixels in images
    )


def disparity_limit(disparity: Array) -> float:
    """The upper end of the colour range, px: the 99.5th percentile rounded up to a multiple of 16, at least 16."""
    known = _some_known(disparity[::4, ::4])
    if not known.size:
        return 16.0
    return max(16.0, 16.0 * math.ceil(float(np.percentile(known, 99.5, method="nearest")) / 16.0))


def disparity_colors(disparity: Array, limit: float | None = None) -> Array:
    """Disparities (H, W), px, as RGB (H, W, 3): near is red, far is blue."""
    return apply_palette(disparity, 0.0, disparity_limit(disparity) if limit is None else limit, cv2.COLORMAP_TURBO)


def stride(length: int, max_length: int) -> int:
    """The n of the n-th ones, of so many, that are at most `max_length`."""
    return max(1, -(-length // max_length))


def every_nth(pixels: Array, max_width: int) -> Array:
    """Every n-th row and column of an image (H, W), so that it is at most `max_width` px wide."""
    step = min(stride(pixels.shape[1], max_width), len(pixels))
    rows, cols = (length // step * step for length in pixels.shape)
    return pixels[step // 2 : rows : step, step // 2 : cols : step]


def shrunk(image: Array, max_width: int) -> Array:
    """An image, (H, W) or (H, W, 3), as the means of the squares around the pixels that `every_nth` takes."""
    step = min(stride(image.shape[1], max_width), len(image))
    rows, cols = (length // step for length in image.shape[:2])
    if step == 1:
        return image
    mean = image[: rows * step, : cols * step]  # whole squares: a size that OpenCV averages fast, above all by 2
    for factor in (step // 2, 1) if step > 2 and step % 2 == 0 else (1,):
        mean = cv2.resize(mean, (cols * factor, rows * factor), interpolation=cv2.INTER_AREA)
    return mean


def whole_steps(values: Array, per_unit: float) -> Array:
    """Values (H, W) in whole steps, uint16, at most 65535; NaN and negative values become 0."""
    steps: Array = cv2.multiply(np.ascontiguousarray(values), per_unit, dtype=cv2.CV_16U)  # type: ignore[call-overload]
    return steps


def gray_difference(left: Array, right: Array, disparity: Array, max_width: int) -> Array:
    """|left(x) - right(x - d)| of the pixels that `every_nth` takes, float32, in gray levels of 8 bits; NaN = unknown.

    The right image has the gain and offset with which its pixels have the mean and deviation of the left image's.
    """
    height, width = disparity.shape
    x, y = (
        every_nth(np.broadcast_to(numbers, disparity.shape), max_width)
        for numbers in (np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None])
    )
    partner = x - every_nth(disparity, max_width)
    seen = (partner >= 0) & (partner <= width - 1)
    ours = cv2.remap(left, x, y, cv2.INTER_NEAREST)
    theirs = cv2.remap(right, np.where(seen, partner, np.float32(0)), y, cv2.INTER_LINEAR)
    ours, theirs = top_eight_bits(ours, theirs)
    ours, theirs = (cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) if each.ndim == 3 else each for each in (ours, theirs))
    (mean, deviation), (their_mean, their_deviation) = (
        np.ravel(cv2.meanStdDev(image, mask=seen.astype(np.uint8))).tolist() for image in (ours, theirs)
    )
    gain = deviation / their_deviation if their_deviation else 1.0
    fitted = cv2.addWeighted(ours, 1.0, theirs, -gain, gain * their_mean - mean, dtype=cv2.CV_32F)
    return np.where(seen, np.abs(fitted), np.float32(np.nan))


def provenance(terrain: ElevationMap) -> dict[str, Array]:
    """Of a fused map: in how many frames each of its cells was seen, and contradicted. Of others: nothing."""
    layers = terrain.layers
    names = ("frames", "contradictions") if "frames" in layers else ()
    return {name: np.where(layers["frames"] > 0, layers[name], np.float32(np.nan)) for name in names}


def cell_stride(elevation: Array, max_cells: int) -> int:
    """The n of the n-th rows and columns that have about `max_cells` known elevations at most."""
    return math.ceil(math.sqrt(max(1.0, int(np.count_nonzero(np.isfinite(elevation))) / max_cells)))


def fewer_shades(rgb: Array) -> Array:
    """Colours (..., 3) in steps of 8 of each channel, which take half the room of exact ones."""
    return np.asarray(np.minimum(rgb, 251) + np.uint8(4) & np.uint8(0xF8))


def every_nth_cell(terrain: ElevationMap, step: int) -> ElevationMap:
    """The terrain at every n-th row and column."""
    if step == 1:
        return terrain
    first, pitch = step // 2, step * terrain.resolution
    shift = (first + 0.5 - 0.5 * step) * terrain.resolution  # a chosen cell is the centre of its coarse cell
    origin = (terrain.origin[0] + shift, terrain.origin[1] + shift)
    layers = {name: layer[first::step, first::step] for name, layer in terrain.layers.items()}
    return replace(terrain, layers=layers, resolution=pitch, origin=origin)


def segment_edges(labels: Array) -> Array:
    """Where a pixel's right or lower neighbour belongs to another superpixel: labels (H, W) -> bool (H, W)."""
    edges = np.zeros(labels.shape, bool)
    np.not_equal(labels[:, 1:], labels[:, :-1], out=edges[:, :-1])
    edges[:-1] |= labels[1:] != labels[:-1]
    return edges


def birds_eye(grid: Array) -> Array:
    """A grid (rows along y, columns along x, ...) as a picture: x forward is up, y left is left."""
    view: Array = cv2.flip(cv2.transpose(grid), -1)
    return view


def rover_place(grid: ElevationMap | NavigationMap) -> tuple[float, float] | None:
    """x and y of the rover in a grid, m: the origin of frame `level`; None if that is not known."""
    if grid.frame_id == LEVEL_FRAME:
        return 0.0, 0.0
    level = getattr(grid, "level", None)
    return None if level is None else (float(level.translation[0]), float(level.translation[1]))


def way_on(grid: ElevationMap | NavigationMap, shape: tuple[int, int], way: Sequence[Point]) -> list[list[Point]]:
    """The parts of a way, (x, y) in m, that lie on a grid of (rows, columns), in pixels of its bird's-eye view."""
    size = np.array(shape[::-1])
    cells = (np.array(way).reshape(-1, 2) - grid.origin) / grid.resolution
    inside = np.all((cells >= 0) & (cells <= size), axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int))).reshape(-1, 2)
    pixels = (size - cells)[:, ::-1]
    return [pixels[first:end].tolist() for first, end in edges if end > first + 1]


def elevation_limits(elevation: Array) -> tuple[float, float]:
    """The colour range of a terrain, m: the 1st and 99th percentile of some of its cells rounded outwards to 0.1 m, at
    least 0.2 m apart."""
    known = _some_known(elevation)
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (1.0, 99.0), method="nearest").tolist()
    low = math.floor(low * 10.0) / 10.0
    return low, max(math.ceil(high * 10.0) / 10.0, low + 0.2)


def value_limits(layer: Array) -> tuple[float, float]:
    """The colour range of any layer: the 1st and 99th percentile of some of its cells; (0, 1) where nothing is known,
    never empty."""
    known = _some_known(layer)
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (1.0, 99.0), method="nearest").tolist()
    return low, high if high > low else low + max(1.0, 1e-6 * abs(low))


def format_value(value: float) -> str:
    """A value of a colour scale in three digits, 0 without a sign."""
    return f"{round(value, 9) + 0.0:.3g}"


def _some_known(layer: Array) -> Array:
    """The known values of a layer, every n-th of many."""
    known = layer[np.isfinite(layer)]
    return known[:: max(1, known.size // MIN_SAMPLES)]


def hillshade(elevation: Array, resolution: float, light: Array = _SUN) -> Array:
    """Brightness of sunlit ground, (rows, cols) float in [0, 1]; slopes next to unknown cells are one-sided.

    light: unit vector (3,) towards the sun, along x, y and up.
    """
    known = np.flatnonzero(np.isfinite(elevation))
    shade = np.full(elevation.size, _brightness(np.zeros(1), np.zeros(1), light)[0])
    shade[known] = _shade(elevation, known, resolution, light)
    return shade.reshape(elevation.shape)


def _shade(elevation: Array, known: Array, resolution: float, light: Array) -> Array:
    """`hillshade` of the cells `known`, indices (n,) into the flat grid."""
    slope_x, slope_y = _slopes(elevation, known)
    return _brightness(slope_x / resolution, slope_y / resolution, light)


def _brightness(slope_x: Array, slope_y: Array, light: Array) -> Array:
    normal = np.sqrt(slope_x**2 + slope_y**2 + 1.0)
    lit: Array = np.clip((light[2] - light[0] * slope_x - light[1] * slope_y) / normal, 0.0, 1.0)
    return _AMBIENT_LIGHT + (1.0 - _AMBIENT_LIGHT) * lit


def elevation_colors(terrain: ElevationMap, limits: tuple[float, float] | None = None, exact: bool = True) -> Array:
    """Shaded relief of the layer "elevation" as RGB (rows, cols, 3), in grid order (see `birds_eye`).

    exact: False for the colours that `fewer_shades` leaves of known cells.
    """
    elevation = terrain.layers["elevation"]
    low, high = elevation_limits(elevation) if limits is None else limits
    known = np.flatnonzero(np.isfinite(elevation))
    rgb = np.frombuffer(bytearray(bytes(UNKNOWN_RGB) * elevation.size), np.uint8).reshape(-1, 3)
    colors = apply_palette(elevation.ravel()[known], low, high, cv2.COLORMAP_VIRIDIS)
    flat = _AMBIENT_LIGHT + (1.0 - _AMBIENT_LIGHT) * _SUN[2]  # level ground keeps the palette's colour
    shade = _shade(elevation, known, terrain.resolution, _SUN) / flat
    lit = np.clip(colors * shade[:, None], 0.0, 255.0).astype(np.uint8)
    np.put(rgb.view("V3"), known, (lit if exact else fewer_shades(lit)).view("V3"))  # whole pixels, many times faster
    return rgb.reshape(*elevation.shape, 3)


def surface(terrain: ElevationMap) -> tuple[Array, Array]:
    """The terrain as a mesh: vertices (n, 3) float32, one a known cell in grid order, and triangles (m, 3) uint32.

    A triangle exists only if its three cells are known, so holes stay holes.
    """
    elevation, (rows, cols) = terrain.layers["elevation"], terrain.shape
    x, y = cell_centres(terrain)
    at = np.flatnonzero(np.isfinite(elevation))
    row, col = np.divmod(at, cols)
    vertices = np.column_stack([x[col], y[row], elevation.ravel()[at]]).astype(np.float32)
    number = np.full(rows * cols, -1, np.int32)
    number[at] = np.arange(len(at), dtype=np.int32)
    corner = at[(row < rows - 1) & (col < cols - 1)]
    here, east, north, across = (number[corner + step] for step in (0, 1, cols, cols + 1))
    # In this order of the corners lz4 finds most repeats.
    triangles = np.column_stack([east, across, here, north, here, across]).reshape(-1, 3)
    known = (triangles[:, 0] | triangles[:, 1] | triangles[:, 2]) >= 0
    return vertices, triangles[known].astype(np.uint32)


def _slopes(elevation: Array, known: Array) -> tuple[Array, Array]:
    """Per known cell, along x and along y: the mean of the rises to both neighbours, or the rise to the known one."""
    row, col = np.divmod(known, elevation.shape[1])
    if not len(known):
        return np.zeros(0, elevation.dtype), np.zeros(0, elevation.dtype)
    top, left = row[0], col.min()
    part = elevation[top : row[-1] + 1, left : col.max() + 1]  # most cells of a map are outside
    framed = np.full((part.shape[0] + 2, part.shape[1] + 2), np.nan, elevation.dtype)
    framed[1:-1, 1:-1] = part
    at = (row - top) * part.shape[1] + (col - left)
    return _mean_rise(framed[1:-1]).take(at), _mean_rise(framed[:, 1:-1].T).T.take(at)


def _mean_rise(heights: Array) -> Array:
    """The mean of the rises to both neighbours in a row, without the first and the last cell of each."""
    rise = heights[:, 1:] - heights[:, :-1]
    seen = np.isfinite(rise)
    rise[~seen] = 0
    sides = seen[:, 1:].astype(np.float32) + seen[:, :-1]
    mean: Array = (rise[:, 1:] + rise[:, :-1]) / np.maximum(sides, 1.0)
    return mean


@cache
def _table(palette: int) -> Array:
    """The 256 RGB colours of an OpenCV palette and UNKNOWN_RGB, (257, 3) uint8."""
    steps = np.arange(256, dtype=np.uint8)[:, None]
    table: Array = np.vstack([cv2.applyColorMap(steps, palette)[:, 0, ::-1], np.array(UNKNOWN_RGB, np.uint8)])
    table.flags.writeable = False
    return table
