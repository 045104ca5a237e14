"""winner"""
from __future__ import annotations
import numpy as np
from numba import njit
from stages.kernels.vectors import count_up, either, first_equal, lanes_in, lesser, load, outermost, shifted, smallest, spread, store, where_less, byte

@njit(nogil=True, error_model="numpy", cache=True)
def find_winners(total, beyond, guard, step, winner, evidence, right, width):
    n = lanes_in(width)
    columns = winner.size
    lanes = count_up(width, right)
    out = load(beyond, 0, width)
    best = spread(255, width)
    index = lanes
    if step > 0:
        for x in range(columns):
            t = either(load(total, x * n, width), out)
            _winner(t, total, guard, x, winner, evidence, width)
            best, index = shifted(best, 255, 1), shifted(index, 0, 1)
            index = where_less(t, best, lanes, index)
            best = lesser(t, best)
            right[columns + n - 2 - x] = outermost(index, 1)
        store(right, 0, index)
    else:
        for back in range(columns):
            x = columns - 1 - back
            t = either(load(total, x * n, width), out)
            _winner(t, total, guard, x, winner, evidence, width)
            best, index = shifted(best, 255, -1), shifted(index, 0, -1)
            index = where_less(best, t, index, lanes)
            best = lesser(t, best)
            right[columns - 1 - x] = outermost(index, -1)
        store(right, columns - 1, index)

@njit(nogil=True, error_model="numpy", cache=True)
def _winner(t, total, guard, x, winner, evidence, width):
    n = lanes_in(width)
    low = smallest(t)
    d = first_equal(t, low)
    winner[x] = d
    evidence[0, x] = low
    evidence[1, x] = byte(total, x * n + max(d - 1, 0))
    evidence[2, x] = byte(total, x * n + min(d + 1, n - 1))
    evidence[3, x] = smallest(either(t, load(guard, n - d, width)))

@njit(nogil=True, error_model="numpy", cache=True)
def fit_row(winner, evidence, right, disparities, minimum, keep, tolerance, pixels, strength):
    columns = winner.size
    for x in range(columns):
        d = np.int64(winner[x])
        low, before, after, second = np.int64(evidence[0, x]), np.int64(evidence[1, x]), np.int64(evidence[2, x]), np.int64(evidence[3, x])
        partner = x - minimum - d
        e = min(columns - 1 - x + d, right.size - 1)
        fits = (d > 0) & (d < disparities - 1) & (partner > 0) & (partner < columns - 1)
        fits &= (second * keep > low * 100) & (abs(np.int64(right[e]) - d) <= tolerance)
        bend = max(before + after - 2 * low, 1)
        pixels[x] = np.float32(minimum + d) + np.float32(before - after) / np.float32(2 * bend) if fits else np.float32(np.nan)
        strength[x] = min(255, (second - low) ) if fits else 0
