"""The images of the simulator: texture, sunlight, cast shadows, haze, and the noise of the sensor.

The texture is a function of position, so both cameras see the same surface. It is sampled from an image pyramid at the
scale of the pixel's footprint, with several taps along the footprint's long side (anisotropic filtering): distant
ground keeps its detail across the view and loses it along the view, as in a real image.
"""

from __future__ import annotations

from math import ceil, exp, floor, inf, log2, sqrt
from typing import Any, NamedTuple

import cv2
import numpy as np

from recordings.simulator.raycast import GROUND, ROUNDED, SKY, first_hit, pyramid_of
from stages.compiled.jit import borrowing_kernel
from stages.data import Array

TILE = 1024
# Periods of the tile at three scales, m. Their ratios are not round, so the sum does not visibly repeat.
FINE, MIDDLE, BROAD = 2.56, 13.7, 97.0
MAX_TAPS = 6
VISIBILITY = 300.0  # m, at which haze leaves 1/e of the contrast
SUNLIGHT, SKYLIGHT = 0.86, 0.24
EXPOSURE, GAMMA = 0.80, 1 / 1.5
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
BLUR = 0.55  # px, standard deviation of the optics' point spread
STRIP_ROWS = 32  # exposed at a time, to stay in the processor's cache


class Texture(NamedTuple):
    """Pyramids of two periodic tiles: grit, micro-relief lit by the sun (mean 1), and noise (mean 0, deviation 1)."""

    grit: Array
    noise: Array
    levels: Array


def make_texture(rng: np.random.Generator, sun: Array) -> Texture:
    """Tiles for a sun in direction `sun` (3,): pebbles of three sizes on grainy soil, and cloudy albedo."""
    pixel = FINE / TILE
    relief = 0.0016 * _band(rng, 1.0, 3, 60)
    for size, share, depth in ((0.014, 0.9, 0.0035), (0.035, 1.25, 0.008), (0.09, 1.8, 0.016)):
        blobs = _band(rng, 0.0, size / pixel * 0.9, size / pixel * 1.6)
        relief = relief + depth * np.sqrt(np.maximum(blobs - share, 0))
    east = (np.roll(relief, -1, axis=1) - np.roll(relief, 1, axis=1)) / (2 * pixel)
    north = (np.roll(relief, -1, axis=0) - np.roll(relief, 1, axis=0)) / (2 * pixel)
    light = (sun[2] - sun[0] * east - sun[1] * north) / np.sqrt(1 + east**2 + north**2) / sun[2]
    grit = np.clip(light, 0.15, 1.9) * (1 + 0.10 * _band(rng, 0.4, 2, 200))
    flat, levels = pyramid_of(np.asarray(grit / grit.mean(), dtype=np.float32), np.mean)
    noise, _ = pyramid_of(_band(rng, 1.2, 3, TILE).astype(np.float32), np.mean)
    return Texture(flat, noise, levels)


def _band(rng: np.random.Generator, fall: float, shortest: float, longest: float) -> Array:
    """Periodic noise, (TILE, TILE), deviation 1, wavelengths shortest to longest px, amplitude ~ wavelength**fall."""
    frequency = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None, :])
    frequency[0, 0] = np.inf
    gain = frequency**-fall * np.exp(-((frequency * shortest) ** 4) * 0.7) * (1 - np.exp(-((frequency * longest) ** 4)))
    gain[0, 0] = 0
    picture = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TILE, TILE))) * gain, (TILE, TILE))
    return np.asarray(picture / picture.std())


@borrowing_kernel
def _bilinear(tiles: Any, start: int, size: int, x: float, y: float) -> float:
    """Periodic bilinear sample at (x, y) px of the square tile of `size` that begins at `start`."""
    ix, iy = floor(x), floor(y)
    u, v = x - ix, y - iy
    i, j = start + (iy & (size - 1)) * size, ix & (size - 1)
    i1, j1 = start + ((iy + 1) & (size - 1)) * size, (ix + 1) & (size - 1)
    low = tiles[i + j] * (1 - u) + tiles[i + j1] * u
    return float(low * (1 - v) + (tiles[i1 + j] * (1 - u) + tiles[i1 + j1] * u) * v)


@borrowing_kernel
def _sample(
    tiles: Any, levels: Any, period: float, x: float, y: float, width: float, taps: int, ux: float, uy: float
) -> float:
    """The tile repeated with `period`, m, averaged over about `width`, m: linear between pyramid levels.

    It is the mean of `taps` samples, (ux, uy) m apart, the middle one at (x, y), m.
    """
    cell = period / TILE
    level = min(max(log2(max(width, 1e-9) / cell), 0.0), levels.shape[0] - 2.001)
    lower = int(level)
    share, size = level - lower, TILE >> lower
    fine, coarse = levels[lower], levels[lower + 1]
    per_metre, middle = size / period, 0.5 * (taps - 1)
    px, py = (x - middle * ux) * per_metre - 0.5, (y - middle * uy) * per_metre - 0.5
    total = 0.0
    for k in range(taps):
        qx, qy = px + k * ux * per_metre, py + k * uy * per_metre
        value = _bilinear(tiles, fine, size, qx, qy)
        if share > 0:
            value += share * (_bilinear(tiles, coarse, size >> 1, qx / 2 - 0.25, qy / 2 - 0.25) - value)
        total += value
    return total / taps


@borrowing_kernel
def _ground_albedo(
    texture: Any, x: float, y: float, width: float, length: float, ux: float, uy: float
) -> tuple[float, float]:
    """Grit and albedo of the ground under a footprint of width x length, m, whose long side runs along (ux, uy)."""
    taps = min(max(ceil(length / width), 1), MAX_TAPS)
    apart = length / taps
    grit = _sample(texture.grit, texture.levels, FINE, x, y, max(width, apart), taps, apart * ux, apart * uy)
    cloud = _sample(texture.noise, texture.levels, MIDDLE, x, y, length, 1, 0.0, 0.0)
    broad = _sample(texture.noise, texture.levels, BROAD, x + 31.0, y + 7.0, length, 1, 0.0, 0.0)
    # Drifted sand, smooth and bright, where the broad pattern is high; gravel elsewhere.
    sand = min(max(0.5 + 1.4 * (broad + 0.35 * cloud - 0.55), 0.0), 1.0)
    contrast = 1.0 - 0.72 * sand
    return 1 + contrast * (grit - 1), (1 + 0.07 * cloud - 0.04 * broad) * (0.92 + 0.16 * sand)


@borrowing_kernel
def _rock_albedo(
    texture: Any, rock: int, x: float, y: float, z: float, nx: float, ny: float, nz: float, width: float
) -> float:
    """Grain of a rock, projected along the axis closest to its normal."""
    a, b = x, y
    if abs(nx) > abs(ny) and abs(nx) > abs(nz):
        a, b = y, z
    elif abs(ny) > abs(nz):
        a, b = x, z
    shift = 0.377 * (rock % 97)
    grain = _sample(texture.noise, texture.levels, 0.9, a + shift, b - shift, width, 1, 0.0, 0.0)
    pits = _sample(texture.grit, texture.levels, 1.1, a - shift, b + shift, width, 1, 0.0, 0.0)
    return max(0.3, (1 + 0.16 * grain + 0.45 * (pits - 1)) * (0.72 + 0.5 * ((rock * 61) % 89) / 89))


@borrowing_kernel
def _upward(ground: Any, resolution: float, x: float, y: float) -> tuple[float, float, float]:
    """Normal, not of unit length, of the ground smoothed over two cells."""
    mask = ground.shape[0] - 1
    gx, gy = x / resolution, y / resolution
    ix, iy = floor(gx), floor(gy)
    u, v = gx - ix, gy - iy
    i0, i1, i2, i3 = (iy - 1) & mask, iy & mask, (iy + 1) & mask, (iy + 2) & mask
    j0, j1, j2, j3 = (ix - 1) & mask, ix & mask, (ix + 1) & mask, (ix + 2) & mask
    h11, h12, h21, h22 = ground[i1, j1], ground[i1, j2], ground[i2, j1], ground[i2, j2]
    west = ((h12 - ground[i1, j0]) * (1 - v) + (h22 - ground[i2, j0]) * v) * (1 - u)
    east = ((ground[i1, j3] - h11) * (1 - v) + (ground[i2, j3] - h21) * v) * u
    south = ((h21 - ground[i0, j1]) * (1 - u) + (h22 - ground[i0, j2]) * u) * (1 - v)
    north = ((ground[i3, j1] - h11) * (1 - u) + (ground[i3, j2] - h12) * u) * v
    return -(west + east), -(south + north), 2 * resolution


@borrowing_kernel
def _nearest_repetition(value: float, near: float, extent: float) -> float:
    """The value + k * extent nearest to `near`."""
    return value + extent * floor((near - value) / extent + 0.5)


@borrowing_kernel
def _normal_at(scn: Any, surface: int, facet: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit normal, towards the outside, of the surface at a point that a ray has hit.

    The ground is smoothed over neighbouring patches, so bilinear seams are invisible.
    """
    if surface == GROUND:
        nx, ny, nz = _upward(scn.ground, scn.resolution, x, y)
    else:
        solid = scn.rocks[surface]
        c, s = solid[6], solid[7]
        if facet == ROUNDED:
            extent = scn.ground.shape[0] * scn.resolution
            ox = x - _nearest_repetition(solid[0], x, extent)
            oy = y - _nearest_repetition(solid[1], y, extent)
            qx, qy, qz = (c * ox + s * oy) * solid[3], (c * oy - s * ox) * solid[4], (z - solid[2]) * solid[5]
        else:
            plane = scn.facets[scn.shapes[surface], facet]
            qx, qy, qz = plane[0], plane[1], plane[2]
        ex, ey = qx * solid[3], qy * solid[4]
        nx, ny, nz = c * ex - s * ey, s * ex + c * ey, qz * solid[5]
    length = sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@borrowing_kernel
def shade_rows(
    scn: Any, texture: Any, clear: Any, sun: Any, origin: Any, rotation: Any, fx: float, fy: float, cx: float,
    cy: float, first: int, depth: Any, surface: Any, facet: Any, radiance: Any,
) -> None:  # fmt: skip
    """Light at the pixels of `cast_rows` (same arguments): radiance (rows, W, 3) float32, about 0 to 1.

    sun: (3,) towards it; clear: its `sunlight.lit_above`.
    """
    mask = clear.shape[0] - 1
    for row in range(depth.shape[0]):
        b = (first + row - cy) / fy
        for column in range(depth.shape[1]):
            a = (column - cx) / fx
            dx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2]
            dy = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2]
            dz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2]
            speed = sqrt(dx * dx + dy * dy + dz * dz)
            t, what = depth[row, column], surface[row, column]
            up = min(max(dz / speed, 0.0) * 2.5, 1.0)
            sky0, sky1, sky2 = 0.86 - 0.12 * up, 0.76 - 0.12 * up, 0.65 - 0.07 * up
            if t == inf:
                radiance[row, column, 0], radiance[row, column, 1], radiance[row, column, 2] = sky0, sky1, sky2
                continue
            x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
            nx, ny, nz = _normal_at(scn, what, facet[row, column], x, y, z)
            facing = max(-(nx * dx + ny * dy + nz * dz) / speed, 0.03)
            width = t / fx
            if what == GROUND:
                flat = sqrt(dx * dx + dy * dy) + 1e-12
                grit, albedo = _ground_albedo(texture, x, y, width, width / facing, dx / flat, dy / flat)
                red, green, blue = 0.66 * albedo, 0.47 * albedo, 0.34 * albedo
            else:
                grit = 1.0
                albedo = _rock_albedo(texture, what, x, y, z, nx, ny, nz, width / sqrt(facing))
                red, green, blue = 0.60 * albedo, 0.46 * albedo, 0.37 * albedo
            toward = nx * sun[0] + ny * sun[1] + nz * sun[2]
            light = 0.0
            if toward > 0:
                lift = 0.001 + 1e-4 * t
                x, y, z = x + lift * nx, y + lift * ny, z + lift * nz
                sure = z > clear[floor(y / scn.resolution) & mask, floor(x / scn.resolution) & mask]
                if sure or first_hit(scn, x, y, z, sun[0], sun[1], sun[2], 0.0, 80.0)[1] == SKY:
                    # Half Lambert, half Lommel-Seeliger, as dusty surfaces scatter (McEwen 1991).
                    light = SUNLIGHT * grit * (0.5 * toward + toward / (toward + facing))
            light += SKYLIGHT * (0.5 + 0.5 * nz) * (1 + 0.4 * (grit - 1))
            through = exp(-t * speed / VISIBILITY)
            radiance[row, column, 0] = red * light * through + sky0 * (1 - through)
            radiance[row, column, 1] = green * light * through + sky1 * (1 - through)
            radiance[row, column, 2] = blue * light * through + sky2 * (1 - through)


def expose(radiance: Array, gain: float, noise: float, rng: np.random.Generator, color: bool) -> Array:
    """The 8-bit image of `radiance` (H, W, 3) float32: blur, vignetting, gain, shot and read noise.

    noise: standard deviation at half the full scale, as a share of the full scale.
    """
    light = np.asarray(cv2.GaussianBlur(radiance if color else radiance @ LUMA, (0, 0), BLUR))
    height, width = light.shape[:2]
    y, x = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    falloff = (gain * EXPOSURE * (1 - 0.07 * (x**2 + y**2))).astype(np.float32)
    picture = np.empty(light.shape, np.uint8)
    for first in range(0, height, STRIP_ROWS):
        rows = slice(first, first + STRIP_ROWS)
        strip = light[rows] * (falloff[rows, :, None] if color else falloff[rows])
        np.power(np.clip(strip, 0, 1, out=strip), np.float32(GAMMA), out=strip)
        grain = rng.standard_normal(strip.shape, dtype=np.float32)
        grain *= np.sqrt(np.float32(0.2 * (255 * noise) ** 2) + np.float32(1.6 * (255 * noise) ** 2) * strip)
        strip *= np.float32(255)
        strip += grain
        strip += np.float32(0.5)
        picture[rows] = np.clip(strip, 0, 255, out=strip)
    return picture
