"""Least-squares planes over a square window around every cell of a grid.

A fit needs ten sums over the window. They are running sums, first down the columns and then along the row, so the cost
of a cell does not depend on the window's size. The sums of a row are stored first and then solved without a branch, so
that the loop is vectorised.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array

# Smallest determinant / trace of the covariance of the cells' positions, close to its smaller eigenvalue: 1/3 for 3x3
# cells, at most 1/4 for a band two cells wide. No ratio of small integers equals it, so rounding does not decide.
_MIN_WINDOW_WIDTH = 0.2929


def window_planes(heights: Array, use: Array, radius: int, max_variance: float, where: Array | None = None) -> Array:
    """The plane fitted to the window of (2 * radius + 1)^2 cells around each cell.

    heights: (rows, cols) float64, finite where `use`; use: (rows, cols) bool, the cells that count; max_variance: of
    the plane's height at the cell, in multiples of one cell's (1 / n in the middle of n cells, more at their edge);
    where: (rows, cols) bool, the cells whose planes are asked for, all by default. Others may be NaN.

    Returns (4, rows, cols) float64: the plane's height at the cell, its slopes per cell along columns (x) and rows (y),
    and the RMS of the window's residuals; NaN if the cells are too few or nearly collinear.
    """
    planes = np.empty((4, *heights.shape))
    where = np.ones(use.shape, np.bool_) if where is None else np.ascontiguousarray(where)
    heights, use = np.ascontiguousarray(heights), np.ascontiguousarray(use)
    _window_planes(heights, use, where, int(radius), float(max_variance), planes)
    return planes


@part
def _add_row(sums, heights, use, row, sign, first, stop):
    """Add (sign 1) or subtract (sign -1) one row from the six sums of the columns from `first` to `stop`."""
    for col in range(first, stop):
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
def _window_planes(heights, use, where, radius, max_variance, planes):
    rows, cols = heights.shape
    sums = np.zeros((cols, 6))
    windows = np.empty((10, cols))
    first, stop = cols, 0  # the columns with cells that count; the sums of others stay 0
    for row in range(rows):
        begin, end = span(use[row])
        if begin < end:
            first, stop = min(first, begin), max(stop, end)
    for row in range(min(radius, rows)):
        _add_row(sums, heights, use, row, 1.0, first, stop)
    for row in range(rows):
        if row + radius < rows:
            _add_row(sums, heights, use, row + radius, 1.0, first, stop)
        if row - radius - 1 >= 0:
            _add_row(sums, heights, use, row - radius - 1, -1.0, first, stop)
        begin, end = span(where[row])
        if begin < end:
            _sum_up(sums, radius, windows, first, stop, begin, end)
            _solve(windows, row, begin, max_variance, planes[0, row][begin:end], planes[1, row][begin:end],
                   planes[2, row][begin:end], planes[3, row][begin:end])  # fmt: skip
        planes[:, row, :begin] = np.nan
        planes[:, row, end:] = np.nan


@part
def span(cells):
    """The first cell of a row that is True and the one after the last; (0, 0) if there is none."""
    cols = cells.size
    for begin in range(cols):
        if cells[begin]:
            for end in range(cols, begin, -1):
                if cells[end - 1]:
                    return begin, end
    return 0, 0


@part
def _sum_up(sums, radius, windows, first, stop, begin, end):
    """The ten sums of a row's windows from `begin` to `end`: windows (10, n), of 1, x, y, z, xx, xy, yy, xz, yz and zz.

    The columns from `first` to `stop` have cells that count.
    """
    n = sx = sxx = sy = syy = sxy = sz = sxz = syz = szz = 0.0
    for ahead in range(min(first - radius, 0), end):
        for side in range(2):
            # The column that enters on the right, then the one that leaves on the left.
            col = ahead + radius if side == 0 else ahead - radius - 1
            if col < first or col >= stop:
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
        if ahead >= begin:
            for i, total in enumerate((n, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz)):
                windows[i, ahead - begin] = total


@part
def _solve(windows, row, begin, max_variance, height, along, across, rough):
    """The planes of a row's windows from column `begin` on, four numbers each; NaN if a plane is not determined."""
    for col in range(height.size):
        n, sx, sy, sz = windows[0, col], windows[1, col], windows[2, col], windows[3, col]
        sxx, sxy, syy = windows[4, col], windows[5, col], windows[6, col]
        sxz, syz, szz = windows[7, col], windows[8, col], windows[9, col]
        mx, my, mz = sx / n, sy / n, sz / n
        vxx, vxy, vyy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
        vxz, vyz, vzz = sxz / n - mx * mz, syz / n - my * mz, szz / n - mz * mz
        determinant = vxx * vyy - vxy * vxy
        dx, dy = begin + col - mx, row - my
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
