"""The pixels of ROS 2 images in any common encoding, as gray or RGB, 8 or 16 bit."""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import Any

import cv2
import numpy as np

from recordings.errors import LogError
from stages.data import Array

# Encoding -> (dtype, channels in the message, conversion to gray or RGB)
_PLAIN: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),  # OpenCV's channel order
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "rgb16": ("u2", 3, None),
    "bgr16": ("u2", 3, cv2.COLOR_BGR2RGB),
}
# OpenCV's short names begin at pixel (1, 1), ROS names at (0, 0), as do OpenCV's long names.
_BAYER = {
    "bayer_rggb": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg": cv2.COLOR_BayerGRBG2RGB,
}
_MAX_PADDING_BYTES = 1024  # after the end of a compressed image
MAX_PIXELS = 21_000_000  # of an image, by default; navigation cameras have at most 20 million
_MAX_SCANS = 64  # of a progressive JPEG, each of which takes the time of a picture; encoders make at most 12
# Of these only the brightness is read. Encoding -> (bytes of a pixel in a row, place of the first brightness)
_LUMA = {
    "uyvy": (2, 1), "yuv422": (2, 1), "UYVY": (2, 1),
    "yuyv": (2, 0), "yuv422_yuy2": (2, 0), "YUYV": (2, 0),
    "nv12": (1, 0), "NV12": (1, 0), "nv21": (1, 0), "NV21": (1, 0),
}  # fmt: skip
_ENCODINGS = _PLAIN | {f"{name}{bits}": (f"u{bits // 8}", 1, code) for name, code in _BAYER.items() for bits in (8, 16)}
_ALL_ENCODINGS = (*_ENCODINGS, *_LUMA)


def pixels_of(message: Any, size: tuple[int, int] | None = None, max_pixels: int = MAX_PIXELS) -> Array:
    """The pixels of a sensor_msgs Image or CompressedImage, gray (H, W) or RGB (H, W, 3), uint8 or uint16.

    size: width and height of the calibration; an image of another size is refused before it is decoded, as is one of
    more than `max_pixels`. Raises LogError if the image is damaged, cut, or in an unsupported encoding.
    """
    read = _raw_pixels if hasattr(message, "encoding") else _compressed_pixels
    return read(message, size, max_pixels)


def check_size(width: int, height: int, size: tuple[int, int] | None, max_pixels: int) -> None:
    """Raise LogError for an image that is empty, too large, or of another size than `size`."""
    if width == 0 or height == 0:
        raise LogError(f"the image is empty ({width}x{height})")
    if width * height > max_pixels:
        raise LogError(f"the image is {width}x{height}, more than 'max_pixels' of the source ({max_pixels}) allows")
    if size is not None and size != (width, height):
        raise LogError(f"the image is {width}x{height}, but its calibration is for {size[0]}x{size[1]}")


def _raw_pixels(message: Any, size: tuple[int, int] | None, max_pixels: int) -> Array:
    if message.encoding not in _ALL_ENCODINGS:
        known = ", ".join(_ALL_ENCODINGS)
        raise LogError(f"the image encoding '{message.encoding}' is not supported; record it in one of {known}")
    luma = _LUMA.get(message.encoding)
    kind, channels, conversion = ("u1", luma[0], None) if luma else _ENCODINGS[message.encoding]
    height, width, data = int(message.height), int(message.width), np.asarray(message.data, np.uint8)
    row = width * channels * int(kind[1])
    step = int(message.step) or row
    check_size(width, height, size, max_pixels)
    if step < row:
        raise LogError(f"the image's step of {step} bytes is shorter than a row of {width} {message.encoding} pixels")
    needed = (height - 1) * step + row  # the last row may lack its padding
    if data.size < needed:
        raise LogError(f"the image is truncated: it has {data.size} of {needed} bytes")
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    if luma is not None:
        return np.ascontiguousarray(rows[:, luma[1] :: luma[0]])
    order = ">" if message.is_bigendian else "<"
    pixels = np.ascontiguousarray(rows).view(f"{order}{kind}").astype(kind, copy=False)
    pixels = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    return _converted(pixels, conversion)


def _compressed_pixels(message: Any, size: tuple[int, int] | None, max_pixels: int) -> Array:
    data = np.ascontiguousarray(message.data, np.uint8)
    content = data.tobytes()
    if is_cut(content):
        raise LogError(f"the compressed image is truncated after {data.size} bytes")
    if content.startswith(b"\xff\xd8") and (scans := content.count(b"\xff\xda")) > _MAX_SCANS:
        raise LogError(f"the compressed image has {scans} scans; the limit is {_MAX_SCANS}")
    stated = stated_size(content)
    if stated is not None:
        check_size(*stated, size, max_pixels)
    encoding = message.format.split(";")[0].strip()
    pixels = unpacked_pixels(data, _BAYER.get(encoding.rstrip("0123456789"))) if stated else None
    if pixels is None:
        raise LogError(f"the compressed image (format '{message.format}') cannot be decoded; it should be JPEG or PNG")
    return pixels


def unpacked_pixels(data: Array, mosaic: int | None = None) -> Array | None:
    """Gray (H, W) or RGB (H, W, 3) pixels, uint8 or uint16, of an image file's bytes; None if they cannot be decoded.

    mosaic: OpenCV's conversion of a Bayer pattern in a single channel.
    """
    pixels = None
    if data.size and _has_whole_chunks(data):
        with suppress(cv2.error):  # of a size that OpenCV refuses
            pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        return None
    if pixels.ndim == 2:
        return _converted(pixels, mosaic)
    return _converted(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGB)


def stated_size(content: bytes) -> tuple[int, int] | None:
    """(width, height) in the head of a PNG or JPEG file, else None."""
    if content.startswith(b"\x89PNG") and len(content) >= 24:
        width, height = struct.unpack_from(">II", content, 16)
        return width, height
    position = 2
    while content.startswith(b"\xff\xd8") and position + 9 <= len(content) and content[position] == 0xFF:
        kind, length = content[position + 1], struct.unpack_from(">H", content, position + 2)[0]
        if kind == 0xFF:  # padding before a marker
            position += 1
        elif 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):  # a start of frame; the excluded codes are tables
            height, width = struct.unpack_from(">HH", content, position + 5)
            return width, height
        else:
            position += 2 + length
    return None


def is_cut(content: bytes) -> bool:
    """Whether the bytes of a PNG or JPEG file lack its end.

    OpenCV may silently make a wrong picture of a JPEG whose end is replaced by zeros, the rest of a camera's buffer.
    Padding after a complete picture is harmless.
    """
    end = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}.get(content[:2], b"")
    return end not in content.rstrip(b"\0")[-_MAX_PADDING_BYTES:]


def _has_whole_chunks(data: Array) -> bool:
    """Whether a file that is a PNG contains its chunks: OpenCV reserves as much memory as a chunk's head states."""
    position = 8
    while data[:4].tobytes() == b"\x89PNG" and position + 12 <= data.size:
        length, kind = struct.unpack_from(">I4s", data.data, position)
        position += 12 + length
        if kind == b"IEND":
            break
    return position <= data.size


def _converted(pixels: Array, conversion: int | None) -> Array:
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
