"""Triangulation of a rectified disparity image (paper section 4, "Depth Estimation").

Z = fx * baseline / (d + cx_right - cx). One pass counts the points, a second one writes them in raster order, so the
arrays are allocated at their final size.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array, Disparity, PixelOrigin, StereoCamera

_FILLED = int(PixelOrigin.FILLED)
_PLANE = int(PixelOrigin.PLANE)
_UNKNOWN = int(PixelOrigin.UNKNOWN)
COLUMN_SPACING = 2  # of columns over that of rows: ground ahead is foreshortened along the columns, not along the rows
# Standard deviations of disparities, px. Of a match without its own it rises geometrically from confidence 1 to 0.
SIGMA_BEST, SIGMA_WORST = 0.086, 42.0
SIGMA_PLANE, SIGMA_FILLED = 0.75, 3.0  # of the origins PLANE and FILLED
SIGMA_UNSTATED = 0.6  # of a match without confidence, as in a result log: Refine calls none measured that is less sure
_LOG_BEST, _LOG_WORST = float(np.log(SIGMA_BEST)), float(np.log(SIGMA_WORST))


def triangulate(
    disparity: Disparity,
    colors: Array,
    camera: StereoCamera,
    max_depth: float,
    filled: bool,
    max_spacing: float = 0.0,
) -> tuple[Array, Array, Array, Array]:
    """The points of a disparity image, in the left optical frame, in raster order.

    colors: (H, W) or (H, W, 3) uint8; max_depth: m; filled: whether pixels of origin FILLED become points; max_spacing:
    m, only every 2nd or 4th row is used where these are no farther apart, across the ray, and every 2nd or 4th column
    where these are no farther apart than COLUMN_SPACING times that; 0: all.

    Returns points (N, 3) float32 m, colors (N, 3) uint8, depth standard deviation (N,) float32 m, pixel (N,) int32.
    """
    return _triangulate(  # type: ignore[no-any-return]
        np.ascontiguousarray(disparity.pixels),
        np.ascontiguousarray(disparity.source),
        np.ascontiguousarray(disparity.confidence),
        np.ascontiguousarray(colors).reshape(*disparity.pixels.shape, -1),
        (camera.fx, camera.fy, camera.cx, camera.cy, camera.fx * camera.baseline, camera.cx_right - camera.cx),
        float(max_depth),
        bool(filled),
        _dense_limits(camera, max_spacing),
        np.empty((0, 0), np.float32) if disparity.sigma is None else np.ascontiguousarray(disparity.sigma),
    )


def _dense_limits(camera: StereoCamera, max_spacing: float) -> Array:
    """The disparity, px, from which a pixel is left out, (4, 4) by the last two bits of its row and of its column."""
    every_2nd = 2 * camera.baseline / max_spacing if max_spacing > 0 else np.inf  # of square pixels
    lines = np.array([np.inf, every_2nd, 2 * every_2nd, every_2nd])
    return np.asarray(np.minimum(lines[:, None] * (camera.fx / camera.fy), lines / COLUMN_SPACING))


@part
def _has_point(effective, source, max_depth, focal_baseline, filled):
    """Whether a pixel becomes a point, but for the spacing."""
    if source == _UNKNOWN or (source == _FILLED and not filled):
        return False
    # NaN, a point behind the camera and a point beyond max_depth all fail this one comparison.
    return effective * max_depth >= focal_baseline and np.isfinite(effective)


@kernel
def _triangulate(disparity, source, confidence, colors, camera, max_depth, filled, dense, own):
    fx, fy, cx, cy, focal_baseline, shift = camera
    height, width = disparity.shape
    count = 0
    for row in range(height):
        for col in range(width):
            effective = np.float64(disparity[row, col]) + shift
            if effective < dense[row & 3, col & 3]:
                count += _has_point(effective, source[row, col], max_depth, focal_baseline, filled)
    points = np.empty((count, 3), np.float32)
    rgb = np.empty((count, 3), np.uint8)
    sigma = np.empty(count, np.float32)
    pixel = np.empty(count, np.int32)
    green, blue = (1, 2) if colors.shape[2] == 3 else (0, 0)
    n = 0
    for row in range(height):
        for col in range(width):
            effective, origin = np.float64(disparity[row, col]) + shift, source[row, col]
            if not effective < dense[row & 3, col & 3]:
                continue
            if not _has_point(effective, origin, max_depth, focal_baseline, filled):
                continue
            z = focal_baseline / effective
            points[n, 0] = (col - cx) * z / fx
            points[n, 1] = (row - cy) * z / fy
            points[n, 2] = z
            rgb[n, 0], rgb[n, 1] = colors[row, col, 0], colors[row, col, green]
            rgb[n, 2] = colors[row, col, blue]
            if origin == _FILLED:
                sigma_d = SIGMA_FILLED
            elif origin == _PLANE:
                sigma_d = SIGMA_PLANE
            elif own.size and not np.isnan(own[row, col]):
                sigma_d = np.float64(own[row, col])
            elif np.isnan(confidence[row, col]):
                sigma_d = SIGMA_UNSTATED
            else:
                trust = min(max(np.float64(confidence[row, col]), 0.0), 1.0)
                sigma_d = np.exp(_LOG_WORST + (_LOG_BEST - _LOG_WORST) * trust)
            sigma[n] = z * z / focal_baseline * sigma_d
            pixel[n] = row * width + col
            n += 1
    return points, rgb, sigma, pixel


def triangulate_reference(
    disparity: Disparity,
    colors: Array,
    camera: StereoCamera,
    max_depth: float,
    filled: bool,
    max_spacing: float = 0.0,
) -> tuple[Array, Array, Array, Array]:
    """The same as `triangulate`, in plain numpy."""
    source, confidence = disparity.source, disparity.confidence
    effective = disparity.pixels.astype(np.float64) + camera.cx_right - camera.cx
    wanted = np.isfinite(effective) & (source != PixelOrigin.UNKNOWN) & (filled | (source != PixelOrigin.FILLED))
    wanted &= np.where(wanted, effective, 0) * max_depth >= camera.fx * camera.baseline
    rows, columns = np.indices(wanted.shape)
    wanted &= effective < _dense_limits(camera, max_spacing)[rows & 3, columns & 3]
    v, u = np.nonzero(wanted)
    z = camera.fx * camera.baseline / effective[v, u]
    points = np.column_stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z])
    rgb = colors[v, u] if colors.ndim == 3 else np.repeat(colors[v, u][:, None], 3, axis=1)
    trust = np.clip(confidence[v, u].astype(np.float64), 0, 1)
    sigma_d = np.where(np.isnan(trust), SIGMA_UNSTATED, SIGMA_WORST * (SIGMA_BEST / SIGMA_WORST) ** trust)
    if disparity.sigma is not None:
        own = disparity.sigma[v, u].astype(np.float64)
        sigma_d = np.where(np.isnan(own), sigma_d, own)
    sigma_d = np.where(source[v, u] == PixelOrigin.PLANE, SIGMA_PLANE, sigma_d)
    sigma_d = np.where(source[v, u] == PixelOrigin.FILLED, SIGMA_FILLED, sigma_d)
    sigma_z = z * z / (camera.fx * camera.baseline) * sigma_d
    pixel = v * disparity.pixels.shape[1] + u
    return points.astype(np.float32), rgb, sigma_z.astype(np.float32), pixel.astype(np.int32)
