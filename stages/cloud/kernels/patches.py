"""The connected patches of an organised cloud, by union-find in one scan.

Two points are linked if they are neighbours in the image, at most a few empty pixels apart, and their inverse depths
differ by no more than noise and slope explain. A large mismatch supports itself, but it is an island. A rock is
connected to the ground at its foot.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.union_find import root
from stages.data import Array

_MAX_STEP = 4  # px to the next point: a cloud may contain only every 4th pixel


@part
def _linked(inverse, tolerance, slope, row, col, up, left):
    """Flat index of the next point above or to the left if it is linked to this one, else -1."""
    width = inverse.shape[1]
    for gap in range(1, _MAX_STEP + 1):
        r, c = row - gap * up, col - gap * left
        if r < 0 or c < 0:
            return -1
        if inverse[r, c] > 0.0:
            allowed = max(tolerance[row, col], tolerance[r, c]) + slope * gap
            return r * width + c if abs(inverse[r, c] - inverse[row, col]) <= allowed else -1
    return -1


@kernel
def connected_patches(inverse, tolerance, slope):
    """Labels of the patches, (H, W) int32: numbers in the order of their first pixels, -1 without a point; and the
    number of points of each patch, (K,) int32.

    inverse: (H, W) float32, inverse depth, 1/m, NaN = no point; tolerance: (H, W) float32, difference explained by
    noise, 1/m (of two points the larger one applies); slope: float, further difference per pixel of distance, 1/m.
    """
    height, width = inverse.shape
    parent = np.empty(height * width, np.int32)
    begun = own = 0
    for row in range(height):
        for col in range(width):
            i = row * width + col
            if not inverse[row, col] > 0.0:
                parent[i] = -1
                continue
            left = _linked(inverse, tolerance, slope, row, col, 0, 1)
            above = _linked(inverse, tolerance, slope, row, col, 1, 0)
            if left < 0:
                own = i
            elif left < i - 1:  # else `own` is still the root of the pixel to the left
                own = root(parent, left)
            if above >= 0 and parent[above] != own:
                other = root(parent, above)
                low, high = min(own, other), max(own, other)
                own, parent[high] = low, low
            parent[i] = own
            begun += left < 0 and above < 0
    # Parents come before their children, so one pass in order numbers every root before its children.
    sizes = np.zeros(begun, np.int32)
    patches = 0
    for i in range(height * width):
        if parent[i] >= 0:
            if parent[i] == i:
                parent[i] = patches
                patches += 1
            else:
                parent[i] = parent[parent[i]]
            sizes[parent[i]] += 1
    return parent.reshape(height, width), sizes[:patches]


def connected_patches_reference(inverse: Array, tolerance: Array, slope: float) -> tuple[Array, Array]:
    """The same as `connected_patches`: scipy's connected components of the graph of links."""
    from scipy.sparse import coo_array  # takes long to import
    from scipy.sparse.csgraph import connected_components

    present = inverse > 0
    index = np.arange(inverse.size).reshape(inverse.shape)
    links = []
    for axis in (0, 1):
        for line, noise, number in zip(*(np.moveaxis(a, axis, 1) for a in (inverse, tolerance, index)), strict=True):
            at = np.flatnonzero(line > 0)
            near, far = at[:-1], at[1:]
            limit = np.maximum(noise[near], noise[far]) + slope * (far - near)
            linked = (far - near <= _MAX_STEP) & (np.abs(line[near] - line[far]) <= limit)
            links.append(np.stack([number[near[linked]], number[far[linked]]]))
    one, other = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(inverse.size, inverse.size))
    found = connected_components(graph, directed=False)[1].reshape(inverse.shape)[present]
    _, first, label, sizes = np.unique(found, return_index=True, return_inverse=True, return_counts=True)
    patch = np.full(inverse.shape, -1, np.int32)
    patch[present] = np.argsort(np.argsort(first))[label]
    return patch, sizes[np.argsort(first)].astype(np.int32)
