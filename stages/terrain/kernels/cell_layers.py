"""The layers of an elevation map from the figures of its cells, in one pass.

docs/terrain.md describes the model of variance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array, Transform
from stages.terrain.kernels.cell_gradient import gradient_and_curvature_reference, gradient_at
from stages.terrain.kernels.grid import Grid

LAYERS = ("elevation", "minimum", "maximum", "count", "variance", "common_variance", "interpolated")
MIN_STAYING_POINTS = 6  # with fewer after a move of one sigma, a cell may rest on the pixels of its neighbours
NOISE_IN_SCATTER = 0.5  # share of the points' noise that their scatter shows, because neighbours err alike


class VarianceModel(NamedTuple):
    """What the variance of a cell depends on, fitted to simulated ground."""

    correlated_points: float = 4.0  # neighbouring points that share one matching error
    systematic_share: float = 0.7  # of the points' variance, which no averaging removes
    scatter_share: float = 0.2  # of the scatter beyond slope and noise
    curvature_share: float = 0.34  # of the squared curvature
    rim_share: float = 0.15  # of the squared rise, in a cell beside a hole
    sight_share: float = 1.0  # of the squared fall of the line of sight in an interpolated cell beside a hole


VARIANCE = VarianceModel()


def cell_layers(
    figures: Array, staying: Array | None, sensor: Transform | None, tilt_sigma: float, model: VarianceModel, grid: Grid
) -> dict[str, Array]:
    """The layers by name, (rows, cols) float32, NaN in empty cells; `interpolated` only if the camera is known.

    figures: (rows, cols, 6) float64 of `cell_statistics`; staying: (rows, cols) int32 of `staying_points`, and sensor:
    the camera in the points' frame, both None if it is not known; tilt_sigma: rad, of the points' frame.
    """
    x, y = (np.ascontiguousarray(middles.ravel()) for middles in grid.middles)
    camera, counts = (0.0,) * 6, np.zeros((0, 0), np.int32)
    if sensor is not None and staying is not None:
        camera, counts = (*sensor.translation.tolist(), *sensor.rotation[:, 2].tolist()), staying
    layers = np.full((len(LAYERS), *grid.shape), np.nan, np.float32)
    shares, tilt_variance = tuple(map(float, model)), float(tilt_sigma) ** 2
    _cell_layers(figures, counts, camera, tilt_variance, shares, x, y, float(grid.resolution), tuple(layers))
    return dict(zip(LAYERS if counts.size else LAYERS[:-1], layers, strict=False))


@part
def _beside_hole(heights, row, col):
    """Whether a cell has an empty neighbour; those outside the grid are empty."""
    rows, cols = heights.shape
    if row == 0 or col == 0 or row == rows - 1 or col == cols - 1:
        return True
    for r in range(row - 1, row + 2):
        for c in range(col - 1, col + 2):
            if np.isnan(heights[r, c]):
                return True
    return False


@kernel
def _cell_layers(figures, staying, camera, tilt_variance, shares, x, y, resolution, layers):
    eye_x, eye_y, eye_z, axis_x, axis_y, axis_z = camera
    correlated_points, systematic_share, scatter_share, curvature_share, rim_share, sight_share = shares
    elevation, minimum, maximum, count, variance, common_variance, interpolated = layers
    known, heights = staying.size > 0, figures[:, :, 1] / figures[:, :, 0]
    for row in range(heights.shape[0]):
        for col in range(heights.shape[1]):
            count[row, col] = n = figures[row, col, 0]
            if n == 0:
                continue
            mean = heights[row, col]
            east, north, curvature = gradient_at(heights, row, col)
            rise, scatter = east * east + north * north, max(figures[row, col, 2] / n - mean * mean, 0.0)
            dx, dy, dz = x[col] - eye_x, y[row] - eye_y, mean - eye_z
            depth = dx * axis_x + dy * axis_y + dz * axis_z
            lever = 1.0  # height error per metre of depth error
            if depth > 0.0:
                lever = (dz - east / resolution * dx - north / resolution * dy) / depth
            noise = figures[row, col, 5] / n * (lever * lever)
            total = (
                noise * (systematic_share + min(1.0, correlated_points / n))
                + scatter_share * max(scatter - rise / 12 - NOISE_IN_SCATTER * noise, 0.0)
                + curvature_share * curvature * curvature
            )
            beside_hole = _beside_hole(heights, row, col)
            if beside_hole:
                total += rim_share * rise
            if known:
                unsure = staying[row, col] < MIN_STAYING_POINTS
                interpolated[row, col] = unsure
                if unsure and beside_hole:  # the line of sight falls that far within the cell
                    fall = resolution * (-dz / np.hypot(dx, dy))
                    total += sight_share * fall * fall
            elevation[row, col], variance[row, col] = mean, total
            minimum[row, col], maximum[row, col] = figures[row, col, 3], figures[row, col, 4]
            common_variance[row, col] = tilt_variance * (x[col] * x[col] + y[row] * y[row])


def cell_layers_reference(
    figures: Array, staying: Array | None, sensor: Transform | None, tilt_sigma: float, model: VarianceModel, grid: Grid
) -> dict[str, Array]:
    """The same as `cell_layers`, in plain numpy."""
    count, total, squares, minimum, maximum, noise = np.moveaxis(figures, 2, 0)
    n = np.where(count == 0, np.nan, count)
    mean, x, y = total / n, *grid.middles
    east, north, curvature = gradient_and_curvature_reference(mean)
    rise, scatter, noise = east * east + north * north, np.maximum(squares / n - mean * mean, 0), noise / n
    holes = np.pad(np.isnan(mean), 1, constant_values=True)
    beside_hole = np.lib.stride_tricks.sliding_window_view(holes, (3, 3)).any(axis=(2, 3))
    fall = np.zeros_like(mean)
    if sensor is not None:
        axis, (eye_x, eye_y, eye_z) = sensor.rotation[:, 2], sensor.translation
        dx, dy, dz = x - eye_x, y - eye_y, mean - eye_z
        depth = dx * axis[0] + dy * axis[1] + dz * axis[2]
        lever = (dz - east / grid.resolution * dx - north / grid.resolution * dy) / depth
        noise = noise * np.where(depth > 0, lever, 1) ** 2
        fall = grid.resolution * -dz / np.hypot(dx, dy)
    interpolated = np.where(count == 0, np.nan, 0 if staying is None else staying < MIN_STAYING_POINTS)
    variance = (
        noise * (model.systematic_share + np.minimum(1, model.correlated_points / n))
        + model.scatter_share * np.maximum(scatter - rise / 12 - NOISE_IN_SCATTER * noise, 0)
        + model.curvature_share * curvature**2
        + np.where(beside_hole, model.rim_share * rise, 0)
        + np.where(beside_hole & (interpolated == 1), model.sight_share * fall**2, 0)
    )
    layers = {
        "elevation": mean, "minimum": np.where(count == 0, np.nan, minimum),
        "maximum": np.where(count == 0, np.nan, maximum), "count": count, "variance": variance,
        "common_variance": np.where(count == 0, np.nan, tilt_sigma**2 * (x * x + y * y)),
    }  # fmt: skip
    layers |= {} if sensor is None else {"interpolated": interpolated}
    return {name: layer.astype(np.float32) for name, layer in layers.items()}
