from __future__ import annotations
from numba import njit
from stages.kernels.vectors import byte, lanes_in, lesser, load, minus, plus_capped, shifted, smallest, spread, store

FAR = 255

@njit(nogil=True, error_model="numpy", cache=True, inline="never")
def _continued(path, cost, p1, p2, width):
    near = plus_capped(lesser(shifted(path, FAR, 1), shifted(path, FAR, -1)), p1)
    return plus_capped(cost, lesser(lesser(near, path), spread(p2, width)))

@njit(nogil=True, error_model="numpy", cache=True)
def aggregate_row(costs, penalties, state, y, step, p1, diagonals, sums, place, total, final, width):
    """One row"""
    n = lanes_in(width)
    columns = costs.size // n
    stride = columns + 2
    plane = penalties.size // 4
    below = y + (1 if step < 0 else 0)
    first = 0 if step > 0 else columns - 1
    first_p = first + 1
    level = y * stride + first_p + (1 if step < 0 else 0)
    falling = plane + below * stride + first_p + (1 if step < 0 else 0)
    upright = 2 * plane + below * stride + first_p
    rising = 3 * plane + below * stride + first_p - (1 if step < 0 else 0)
    p1s = spread(p1, width)
    nothing = spread(0, width)
    path = nothing
    a = (first - y) % columns
    b = (first + y) % columns
    if diagonals:
        edge = (0 if step > 0 else columns - 1)
        store(state, ((edge - y) % columns) * n, nothing)
        store(state, (2 * columns + ((columns - 1 - edge + y) % columns)) * n, nothing)
    x = first
    for _ in range(columns):
        cost = load(costs, x * n, width)
        v = _continued(path, cost, p1s, byte(penalties, level), width)
        path = minus(v, spread(smallest(v), width))
        s = path
        at = (columns + x) * n
        v = _continued(load(state, at, width), cost, p1s, byte(penalties, upright), width)
        v = minus(v, spread(smallest(v), width))
        store(state, at, v)
        s = plus_capped(s, v)
        if diagonals:
            at = a * n
            v = _continued(load(state, at, width), cost, p1s, byte(penalties, falling), width)
            v = minus(v, spread(smallest(v), width))
            store(state, at, v)
            s = plus_capped(s, v)
            at = (2 * columns + b) * n
            v = _continued(load(state, at, width), cost, p1s, byte(penalties, rising), width)
            v = minus(v, spread(smallest(v), width))
            store(state, at, v)
            s = plus_capped(s, v)
        if final:
            store(total, x * n, plus_capped(s, load(sums, place + x * n, width)))
        else:
            store(sums, place + x * n, s)
        level += step
        falling += step
        upright += step
        rising += step
        x += step
        a += step
        b += step
        if a == columns:
            a = 0
        if a < 0:
            a = columns - 1
        if b == columns:
            b = 0
        if b < 0:
            b = columns - 1
# x
# y
