"""The look of the simulator's ground: patches of sand, gravel, dust and rock as periodic tiles, and samples of them.

The texture is a function of position, so both cameras see the same surface. A tile is an image pyramid, sampled at the
scale of the pixel's footprint, with several taps along the footprint's long side (anisotropic filtering): distant
ground keeps its detail across the view and loses it along the view, as in a real image. Sand has the same contrast in
every octave, so it has detail at every distance.
"""

from __future__ import annotations

from enum import IntEnum
from math import ceil, floor, inf, log2
from typing import Any, NamedTuple

import cv2
import numpy as np

from recordings.simulator.raycast import pyramid_of
from stages.compiled.jit import borrowing_kernel
from stages.data import Array

TILE = 1024
# Periods of the tiles, m. Their ratios are not round, so the sum does not visibly repeat.
FINE, MIDDLE, BROAD = 2.56, 13.7, 97.0
GRAINS, RIPPLES, PATCHES, SLABS = 0.61, 11.3, 37.7, 5.3
MAX_TAPS = 6
GAMMA = 1 / 1.5
GRAY_LEVEL = 1 / (127.5 * GAMMA)  # of light, as a share, that changes mid-gray by one gray level
# The bands of grains and mottle have this deviation in the image at the scale of a few pixels, of 1 in the tile.
DETAIL = 0.55
GRIT_CONTRAST = 18.0  # gray levels at mid-gray, of the tile `grit`
DUST_CONTRAST = 0.5  # of the sand's
SOFT_BORDER = 2.5  # share of cover gained per deviation of the pattern of patches
SLABS_IN_TILE = 160
CRACK = 0.012  # m, half the width


class TerrainClass(IntEnum):
    """What a pixel of the left image shows; rocks and bedrock are ROCK."""

    SKY = 0
    SAND = 1
    GRAVEL = 2
    DUST = 3
    ROCK = 4


_SAND, _GRAVEL, _DUST, _ROCK = (
    int(kind) for kind in (TerrainClass.SAND, TerrainClass.GRAVEL, TerrainClass.DUST, TerrainClass.ROCK)
)  # fmt: skip


class Texture(NamedTuple):
    """Pyramids of periodic tiles, all with the same `levels`, and the patterns' thresholds.

    grit: micro-relief lit by the sun (mean 1); noise (mean 0, deviation 1); grains, ripples: light of sand, as a share
    of its mean; patches: pattern of the patches (deviation 1); slabs: light of bedrock (mean 1).

    soft: the pattern above which sand or dust lies, not gravel or rock; sandy: above which soft ground is sand; rocky:
    above which firm ground is rock; inf nowhere, -inf everywhere. drifts: 1 if thin sand lies on the gravel, else 0;
    gravel: factor of its contrast.
    """

    grit: Array
    noise: Array
    grains: Array
    ripples: Array
    patches: Array
    slabs: Array
    levels: Array
    soft: float
    sandy: float
    rocky: float
    drifts: float
    gravel: float


class Cover(NamedTuple):
    """Shares of the ground (the rest is gravel) and contrasts, gray levels at mid-gray (RMS)."""

    sand: float
    dust: float
    rock: float
    sand_contrast: float
    gravel_contrast: float
    ripples: float


def make_texture(rng: np.random.Generator, sun: Array, cover: Cover, others: np.random.Generator) -> Texture:
    """Tiles for a sun in direction `sun` (3,). rng: of the gravel; others: of the other classes."""
    flat, levels = _grit(rng, sun)
    noise, _ = pyramid_of(_band(rng, 1.2, 3, TILE).astype(np.float32), np.mean)
    pattern = _band(others, 1.3, 12, 220)
    soft, firm = cover.sand + cover.dust, 1 - cover.sand - cover.dust
    blank = np.zeros(1, np.float32)
    grains, ripples = _sand(others, sun, cover) if soft > 0 else (blank, blank)
    return Texture(
        flat, noise, grains, ripples, _pyramid(pattern), _slabs(others) if cover.rock > 0 else blank, levels,
        _threshold(pattern, soft), _threshold(pattern, cover.sand / soft if soft > 0 else 0.0),
        _threshold(pattern, cover.rock / firm if firm > 1e-9 else 0.0), float(soft == 0),
        cover.gravel_contrast / GRIT_CONTRAST,
    )  # fmt: skip


def _grit(rng: np.random.Generator, sun: Array) -> tuple[Array, Array]:
    """Pebbles of three sizes on grainy soil."""
    pixel = FINE / TILE
    relief = 0.0016 * _band(rng, 1.0, 3, 60)
    for size, share, depth in ((0.014, 0.9, 0.0035), (0.035, 1.25, 0.008), (0.09, 1.8, 0.016)):
        blobs = _band(rng, 0.0, size / pixel * 0.9, size / pixel * 1.6)
        relief = relief + depth * np.sqrt(np.maximum(blobs - share, 0))
    east, north = _rises(relief, pixel)
    light = (sun[2] - sun[0] * east - sun[1] * north) / np.sqrt(1 + east**2 + north**2) / sun[2]
    grit = np.clip(light, 0.15, 1.9) * (1 + 0.10 * _band(rng, 0.4, 2, 200))
    return pyramid_of(np.asarray(grit / grit.mean(), dtype=np.float32), np.mean)


def _sand(rng: np.random.Generator, sun: Array, cover: Cover) -> tuple[Array, Array]:
    """Grains, with the same deviation in each octave up to 4 cm, and mottle of larger octaves with ripples."""
    deviation = cover.sand_contrast * GRAY_LEVEL / DETAIL
    grains = deviation * _band(rng, 1.0, 3, 64)
    mottle = deviation * _band(rng, 1.0, 3, 55)
    heights = _band(rng, 0.0, 9, 17, turn=0.6)
    # Crests are sharper than troughs.
    east, north = _rises(heights + 0.25 * heights**2, 1.0)
    lit = -(sun[0] * east + sun[1] * north)
    mottle = mottle + cover.ripples * GRAY_LEVEL * lit / max(float(lit.std()), 1e-9)
    return _pyramid(grains), _pyramid(mottle)


def _slabs(rng: np.random.Generator) -> Array:
    """Slabs of bedrock, each with its own tilt and so its own light, and dark cracks between them."""
    margin = TILE // 4
    places = rng.integers(0, TILE, (SLABS_IN_TILE, 2))
    mask = np.full((TILE, TILE), 255, np.uint8)
    mask[places[:, 0], places[:, 1]] = 0
    number = np.zeros((TILE, TILE), np.int64)
    number[places[:, 0], places[:, 1]] = np.arange(SLABS_IN_TILE)
    padded = np.pad(mask, margin, mode="wrap")
    _, label = cv2.distanceTransformWithLabels(padded, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    seed_of = np.zeros(int(np.max(label)) + 1, np.int64)
    seed_of[label[padded == 0]] = np.pad(number, margin, mode="wrap")[padded == 0]
    ragged = (4 * _band(rng, 1.6, 6, 160), 4 * _band(rng, 1.6, 6, 160))
    row, column = np.indices((TILE, TILE)) + np.rint(ragged).astype(int)
    slab = seed_of[label][margin + row, margin + column]
    edge = np.zeros((TILE, TILE), bool)
    for axis in (0, 1):
        edge |= slab != np.roll(slab, 1, axis=axis)
    away = cv2.distanceTransform(np.pad(np.uint8(255) * ~edge, margin, mode="wrap"), cv2.DIST_L2, 5)
    away = away[margin:-margin, margin:-margin] * (SLABS / TILE)
    light = rng.normal(1.0, 0.11, SLABS_IN_TILE)[slab] * (1 + 0.06 * _band(rng, 1.0, 3, 200))
    light = light * (1 - 0.6 * np.exp(-((away / CRACK) ** 2)))
    return _pyramid(light / light.mean())


def _rises(heights: Array, pixel: float) -> tuple[Array, Array]:
    """Slopes of a periodic tile along x and y."""
    east = (np.roll(heights, -1, axis=1) - np.roll(heights, 1, axis=1)) / (2 * pixel)
    north = (np.roll(heights, -1, axis=0) - np.roll(heights, 1, axis=0)) / (2 * pixel)
    return east, north


def _threshold(pattern: Array, share: float) -> float:
    """The value that the given share of the pattern exceeds."""
    if share <= 0:
        return inf
    return -inf if share >= 1 - 1e-9 else float(np.quantile(pattern, 1 - share))


def _pyramid(tile: Array) -> Array:
    return pyramid_of(tile.astype(np.float32), np.mean)[0]


def _band(rng: np.random.Generator, fall: float, shortest: float, longest: float, turn: float | None = None) -> Array:
    """Periodic noise, (TILE, TILE), deviation 1, wavelengths shortest to longest px, amplitude ~ wavelength**fall.

    turn: rad from the rows, direction that its waves keep to within some 15 degrees.
    """
    y, x = np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None, :]
    frequency = np.hypot(y, x)
    frequency[0, 0] = np.inf
    gain = frequency**-fall * np.exp(-((frequency * shortest) ** 4) * 0.7) * (1 - np.exp(-((frequency * longest) ** 4)))
    gain[0, 0] = 0
    if turn is not None:
        gain *= np.exp(-((np.sin(np.arctan2(y, x) - turn) / 0.25) ** 2))
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
def _covered(texture: Any, threshold: float, x: float, y: float, length: float) -> float:
    """Share of a footprint where the pattern of patches, shifted to (x, y), exceeds the threshold."""
    if threshold == inf:
        return 0.0
    if threshold == -inf:
        return 1.0
    pattern = _sample(texture.patches, texture.levels, PATCHES, x, y, length, 1, 0.0, 0.0)
    return min(max(0.5 + SOFT_BORDER * (pattern - threshold), 0.0), 1.0)


@borrowing_kernel
def ground_look(
    texture: Any, x: float, y: float, width: float, length: float, ux: float, uy: float
) -> tuple[float, float, float, int]:
    """The ground under a footprint of width x length, m, whose long side runs along (ux, uy).

    Returns its grit (light of the micro-relief), its albedo, the share of bare rock and its `TerrainClass`.
    """
    taps = min(max(ceil(length / width), 1), MAX_TAPS)
    apart = length / taps
    sharp, vx, vy = max(width, apart), apart * ux, apart * uy
    soft = _covered(texture, texture.soft, x, y, length)
    sand = soft * _covered(texture, texture.sandy, x + 11.9, y - 17.3, length) if soft > 0 else 0.0
    rock = (1 - soft) * _covered(texture, texture.rocky, x - 14.7, y + 5.1, length) if soft < 1 else 0.0
    dust, gravel = soft - sand, 1 - soft - rock
    cloud = _sample(texture.noise, texture.levels, MIDDLE, x, y, length, 1, 0.0, 0.0)
    broad = _sample(texture.noise, texture.levels, BROAD, x + 31.0, y + 7.0, length, 1, 0.0, 0.0)
    # Thin drifts, smooth and bright, where the broad pattern is high.
    drift = texture.drifts * min(max(0.5 + 1.4 * (broad + 0.35 * cloud - 0.55), 0.0), 1.0)
    grit, fresh = 0.0, 0.0
    if soft < 1:
        grit = _sample(texture.grit, texture.levels, FINE, x, y, sharp, taps, vx, vy) - 1
        grit *= gravel * (1.0 - 0.72 * drift) * texture.gravel + 0.4 * rock
    if soft > 0:
        fresh = _sample(texture.grains, texture.levels, GRAINS, x, y, sharp, taps, vx, vy)
        fresh += _sample(texture.ripples, texture.levels, RIPPLES, x, y, sharp, taps, vx, vy)
        fresh = (1 + fresh) * (1.10 * sand) + (1 + DUST_CONTRAST * fresh) * (1.24 * dust) - soft
    if rock > 0:
        slab = _sample(texture.slabs, texture.levels, SLABS, x, y, sharp, taps, vx, vy)
        slab *= 1 + 0.10 * _sample(texture.noise, texture.levels, 0.9, x, y, sharp, taps, vx, vy)
        fresh += rock * (0.92 * slab - 1)
    kind = _GRAVEL
    if rock > max(gravel, soft):
        kind = _ROCK
    elif max(sand, drift) > max(gravel * (1 - drift), dust):
        kind = _SAND
    elif dust > gravel:
        kind = _DUST
    cloud *= 1 - 0.7 * soft  # sand is evener than gravel
    return 1 + grit, (1 + 0.07 * cloud - 0.04 * broad) * (0.92 + 0.16 * drift) * (1 + fresh), rock, kind


@borrowing_kernel
def rock_albedo(
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
