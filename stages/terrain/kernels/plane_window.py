"""Least-squares planes over a square window around every cell of a grid.

A fit needs ten sums over the window. They are running sums, first down the columns and then along the row, so the cost
of a cell does not depend on the window's size. The sums of a row are stored first and then solved without a branch, so
that the loop is vectorised.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

# Smallest determinant / trace of the covariance of the cells' positions, close to its smaller eigenvalue: 1/3 for 3x3
# cells, at most 1/4 for a band two cells wide. No ratio of small integers equals it, so rounding does not decide.
_MIN_WINDOW_WIDTH = 0.2929


def window_planes(heights: Array, use: Array, radius: int, max_variance: float) -> Array:
    """The plane fitted to the window of (2 * radius + 1)^2 cells around each cell.

    heights: (rows, cols) float64, finite where `use`; use: (rows, cols) bool, the cells that count; max_variance: of
    the plane's height at the cell, in multiples of one cell's (1 / n in the middle of n cells, more at their edge).

    Returns (4, rows, cols) float64: the plane's height at the cell, its slopes per cell along columns (x) and rows (y),
    and the RMS of the window's residuals; NaN if the cells are too few or nearly collinear.
    """
    planes = np.empty((4, *heights.shape))
    _window_planes(np.ascontiguousarray(heights), np.ascontiguousarray(use), int(radius), float(max_variance), planes)
    return planes


@kernel
def _add_row(sums, heights, use, row, sign):
    """Add (sign 1) or subtract (sign -1) one row from the six sums of every column."""
    for col in range(heights.shape[1]):
        if use[row, col]:
            z = heights[row, col]
            column = sums[col]
            column[0] += sign
            column[1] += sign * row
            column[2] += sign * row * row
            column[3] += sign * z
            column[4] += sign * row * z
            column[5] += sign * z * z


@kernel
def _window_planes(heights, use, radius, max_variance, planes):
    rows, cols = heights.shape
    sums = np.zeros((cols, 6))
    windows = np.empty((10, cols))
    for row in range(min(radius, rows)):
        _add_row(sums, heights, use, row, 1.0)
    for row in range(rows):
        if row + radius < rows:
            _add_row(sums, heights, use, row + radius, 1.0)
        if row - radius - 1 >= 0:
            _add_row(sums, heights, use, row - radius - 1, -1.0)
        _sum_up(sums, radius, windows)
        _solve(windows, row, max_variance, planes[0, row], planes[1, row], planes[2, row], planes[3, row])


@kernel
def _sum_up(sums, radius, windows):
    """The ten sums of every window of a row: windows (10, cols), of 1, x, y, z, xx, xy, yy, xz, yz and zz."""
    cols = len(sums)
    n = sx = sxx = sy = syy = sxy = sz = sxz = syz = szz = 0.0
    for ahead in range(-radius, cols):
        for side in range(2):
            # The column that enters on the right, then the one that leaves on the left.
            col = ahead + radius if side == 0 else ahead - radius - 1
            if col < 0 or col >= cols:
                continue
            sign = 1.0 if side == 0 else -1.0
            x, s = np.float64(col), sums[col]
            n += sign * s[0]
            sx += sign * x * s[0]
            sxx += sign * x * x * s[0]
            sy += sign * s[1]
            sxy += sign * x * s[1]
            syy += sign * s[2]
            sz += sign * s[3]
            sxz += sign * x * s[3]
            syz += sign * s[4]
            szz += sign * s[5]
        if ahead >= 0:
            for i, total in enumerate((n, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz)):
                windows[i, ahead] = total


@kernel
def _solve(windows, row, max_variance, height, along, across, rough):
    """The planes of a row's windows, four numbers (cols,) each; NaN if a plane is not determined."""
    for col in range(windows.shape[1]):
        n, sx, sy, sz = windows[0, col], windows[1, col], windows[2, col], windows[3, col]
        sxx, sxy, syy = windows[4, col], windows[5, col], windows[6, col]
        sxz, syz, szz = windows[7, col], windows[8, col], windows[9, col]
        mx, my, mz = sx / n, sy / n, sz / n
        vxx, vxy, vyy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
        vxz, vyz, vzz = sxz / n - mx * mz, syz / n - my * mz, szz / n - mz * mz
        determinant = vxx * vyy - vxy * vxy
        dx, dy = col - mx, row - my
        gx = (vyy * vxz - vxy * vyz) / determinant
        gy = (vxx * vyz - vxy * vxz) / determinant
        # of the height at the cell, in n-ths of one cell's variance
        variance = 1.0 + (vyy * dx * dx - 2.0 * vxy * dx * dy + vxx * dy * dy) / determinant
        wide = determinant >= _MIN_WINDOW_WIDTH * (vxx + vyy)
        known = (n >= 3.0) & wide & (variance <= max_variance * n)
        residual = vzz - gx * vxz - gy * vyz
        height[col] = mz + gx * dx + gy * dy if known else np.nan
        along[col] = gx if known else np.nan
        across[col] = gy if known else np.nan
        rough[col] = np.sqrt(residual if residual > 0.0 else 0.0) if known else np.nan


def window_planes_reference(heights: Array, use: Array, radius: int, max_variance: float) -> Array:
    """The same as `window_planes`: numpy's least squares, one window at a time."""
    planes = np.full((4, *heights.shape), np.nan)
    for row, col in np.ndindex(*heights.shape):
        top, left = max(0, row - radius), max(0, col - radius)
        window = np.s_[top : row + radius + 1, left : col + radius + 1]
        dy, dx = np.nonzero(use[window])
        n, z = len(dx), heights[window][dy, dx]
        if n < 3:
            continue
        dx, dy = dx + left - col, dy + top - row
        covariance = np.cov(dx, dy, bias=True)
        if np.linalg.det(covariance) < _MIN_WINDOW_WIDTH * np.trace(covariance):
            continue
        design = np.column_stack([np.ones(n), dx, dy]).astype(float)
        if np.linalg.inv(design.T @ design)[0, 0] > max_variance:
            continue
        fit = np.linalg.lstsq(design, z, rcond=None)[0]
        planes[:3, row, col] = fit
        planes[3, row, col] = np.sqrt(np.mean((z - design @ fit) ** 2))
    return planes
