"""The cameras of the simulator: motion blur, lens, exposure, noise, 8 bits and JPEG."""

from __future__ import annotations

from math import ceil

import cv2
import numpy as np

from recordings.simulator.texture import GAMMA
from stages.data import Array, StereoCamera, Transform

EXPOSURE = 0.80
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
# Noise of a luma, as a share of the noise of its independent red, green and blue.
LUMA_NOISE = float(np.sqrt(0.299**2 + 0.587**2 + 0.114**2))
STRIP_ROWS = 32  # exposed at a time, to stay in the processor's cache
MAX_MOVES = 32  # images that are averaged to one with motion blur


def expose(
    radiance: Array, gain: float, blur: float, vignetting: float, noise: float, rng: np.random.Generator, color: bool
) -> Array:
    """The 8-bit image of `radiance` (H, W, 3) float32: lens blur, vignetting, gain, shot and read noise.

    blur: px, standard deviation of the point spread; vignetting: share of the light that the corners lose; noise: gray
    levels, standard deviation at mid-gray of the gray image, which is the luma of a color image.
    """
    light = radiance if color else radiance @ LUMA
    if blur > 0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), blur))
    height, width = light.shape[:2]
    y, x = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    falloff = (gain * EXPOSURE * (1 - vignetting / 2 * (x**2 + y**2))).astype(np.float32)
    deviation = noise / LUMA_NOISE if color else noise
    read, shot = np.float32(0.2 * deviation**2), np.float32(1.6 * deviation**2)
    picture = np.empty(light.shape, np.uint8)
    for first in range(0, height, STRIP_ROWS):
        rows = slice(first, first + STRIP_ROWS)
        strip = light[rows] * (falloff[rows, :, None] if color else falloff[rows])
        np.power(np.clip(strip, 0, 1, out=strip), np.float32(GAMMA), out=strip)
        grain = rng.standard_normal(strip.shape, dtype=np.float32)
        grain *= np.sqrt(read + shot * strip)
        strip *= np.float32(255)
        strip += grain
        strip += np.float32(0.5)
        picture[rows] = np.clip(strip, 0, 255, out=strip)
    return picture


def moved(radiance: Array, depth: Array, camera: StereoCamera, ends: tuple[Transform, Transform, Transform]) -> Array:
    """`radiance` (H, W, 3) averaged along the image motion between the first and the last of three poses.

    ends: world <- camera at the begin, the middle and the end of the exposure; depth: (H, W) m at the middle.
    """
    v, u = np.indices(depth.shape, dtype=np.float32)
    z = np.minimum(depth, 1e4)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    begin, middle, end = ends
    sides = []
    for side in (begin, end):
        placed = side.inverse().after(middle)(points.reshape(-1, 3)).reshape(points.shape)
        ahead = np.maximum(placed[..., 2], 1e-3)
        sides.append((placed[..., 0] / ahead * camera.fx + camera.cx, placed[..., 1] / ahead * camera.fy + camera.cy))
    du, dv = (np.float32(last - first) for first, last in zip(*sides, strict=True))
    count = min(ceil(float(np.hypot(du, dv).max())) + 1, MAX_MOVES)
    total = np.zeros_like(radiance)
    for time in (np.arange(count) + 0.5) / count - 0.5:
        share = np.float32(time)
        x, y = (np.asarray(place, np.float32) for place in (u - share * du, v - share * dv))
        total += cv2.remap(radiance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(total / np.float32(count))


def jpeg(picture: Array, quality: int) -> tuple[Array, Array]:
    """The bytes of a JPEG file of a gray or RGB image, (N,) uint8, and its pixels."""
    color = picture.ndim == 3
    written = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if color else picture
    _, content = cv2.imencode(".jpg", written, [cv2.IMWRITE_JPEG_QUALITY, quality])
    read = np.asarray(cv2.imdecode(content, cv2.IMREAD_UNCHANGED))
    return content.reshape(-1), np.asarray(cv2.cvtColor(read, cv2.COLOR_BGR2RGB) if color else read)
