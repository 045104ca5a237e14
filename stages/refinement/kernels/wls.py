"""Confidence-weighted least squares by the fast global smoother (Min et al., IEEE TIP 2014; section 3.3 of the paper).

Alternating one-dimensional problems replace the two-dimensional one. Each is a tridiagonal system, solved exactly in
linear time. All columns are solved together, so that the recursion down a column runs in vector lanes. Rows are solved
as columns of the transposed image.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import fast_kernel, kernel
from stages.data import Array

F32 = np.float32
PASSES = 3
MIN_WEIGHT = F32(1e-6)  # smoothed weight; with less a pixel stays unknown


def smooth(values: Array, weights: Array, guide: Array, strength: float, sigma: float) -> Array:
    """Smooth values within the edges of the guide.

    values: (H, W) float32, finite where weights > 0; weights: (H, W) float32 >= 0, 0 = unknown; guide: (H, W) uint8;
    strength: the lambda of the first pass (each later one has a quarter); sigma: gray levels of the guide over which
    the coupling of two pixels falls to 1/e. Returns the smoothed values, (H, W) float32, NaN where the smoothed weight
    is below `MIN_WEIGHT`.
    """
    coupling = np.exp(-np.arange(256) / sigma).astype(np.float32)
    height, width = values.shape
    down, across = np.empty((height, width), np.float32), np.empty((width, height), np.float32)
    _couple(guide, coupling, down)
    _couple(cv2.transpose(guide), coupling, across)
    mass: Array = np.ascontiguousarray(weights, np.float32)
    moment: Array = np.where(mass > 0, values, F32(0)) * mass
    for index in range(PASSES):
        step = F32(strength * 0.25**index)
        for coupled in (across, down):
            moment, mass = cv2.transpose(moment), cv2.transpose(mass)
            _solve(moment, mass, coupled, step, np.empty(mass.shape, np.float32))
    return np.where(mass > MIN_WEIGHT, moment / np.maximum(mass, MIN_WEIGHT), F32(np.nan))


@kernel
def _couple(guide, coupling, out):
    """out[y, x]: the coupling of pixel (y, x) with the one above it; 0 in row 0."""
    out[0, :] = F32(0)
    for y in range(1, guide.shape[0]):
        for x in range(guide.shape[1]):
            out[y, x] = coupling[abs(np.int32(guide[y, x]) - np.int32(guide[y - 1, x]))]


@fast_kernel
def _solve(moment, mass, coupling, strength, upper):
    """Solve (I + strength * A) u = f down every column of two right-hand sides, in place, by the Thomas algorithm.

    upper: scratch of the same shape.
    """
    height, n = moment.shape
    for y in range(height):
        f, g, c, above = moment[y, :n], mass[y, :n], upper[y, :n], coupling[y, :n]
        below = coupling[min(y + 1, height - 1), :n]
        onward = strength if y + 1 < height else F32(0)
        before = max(y - 1, 0)
        f_before, g_before, c_before = moment[before, :n], mass[before, :n], upper[before, :n]
        if y == 0:
            for i in range(n):
                b = onward * below[i]
                scale = F32(1) / (F32(1) + b)
                c[i] = b * scale
                f[i] *= scale
                g[i] *= scale
        else:
            for i in range(n):
                a, b = strength * above[i], onward * below[i]
                scale = F32(1) / (F32(1) + a + b - a * c_before[i])
                c[i] = b * scale
                f[i] = (f[i] + a * f_before[i]) * scale
                g[i] = (g[i] + a * g_before[i]) * scale
    for y in range(height - 2, -1, -1):
        f, g, c = moment[y, :n], mass[y, :n], upper[y, :n]
        f_after, g_after = moment[y + 1, :n], mass[y + 1, :n]
        for i in range(n):
            f[i] += c[i] * f_after[i]
            g[i] += c[i] * g_after[i]


def smooth_reference(values: Array, weights: Array, guide: Array, strength: float, sigma: float) -> tuple[Array, Array]:
    """`smooth` in float64 by scipy's sparse solver, and the smoothed weights."""
    mass = weights.astype(np.float64)
    moment = np.where(mass > 0, values, 0.0) * mass
    for index in range(PASSES):
        for turn in (np.transpose, np.asarray):
            lines = turn(guide).astype(np.float64)
            for array in (moment, mass):
                turn(array)[:] = _solve_reference(turn(array), lines, strength * 0.25**index, sigma)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(mass > MIN_WEIGHT, moment / mass, np.nan), mass


def _solve_reference(right_side: Array, guide: Array, strength: float, sigma: float) -> Array:
    from scipy.sparse import diags
    from scipy.sparse.linalg import spsolve

    solved = np.empty_like(right_side)
    for x in range(right_side.shape[1]):
        link = strength * np.exp(-np.abs(np.diff(guide[:, x])) / sigma)
        diagonal = 1 + np.append(link, 0) + np.append(0, link)
        solved[:, x] = spsolve(diags([-link, diagonal, -link], (-1, 0, 1), format="csc"), right_side[:, x])
    return solved
