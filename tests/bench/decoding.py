"""What a stereo frame costs until its images are decoded, beside the bare decoding of the same bytes, on one core.

Run as `python -m tests.bench.decoding`. Times are CPU times, the best of interleaved rounds. `read` is everything from
the file to the items of a pipeline: unpacking, CRCs, merging in log-time order, decoding, checks.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from zstandard import ZstdCompressor, ZstdDecompressor

from recordings.mcap.writer import Ros2Writer
from recordings.ros2.cdr import make
from recordings.ros2.to_msg import camera_info, header, image
from recordings.source.mcap_source import McapSource
from stages.data import CameraImage, CameraModel

WIDTH, HEIGHT, FRAMES, ROUNDS = 1280, 960, 24, 5
PERIOD = 100_000_000
SIDES = ("left", "right")
KINDS = (("raw, gray", 1, "none"), ("raw, RGB", 3, "none"), ("raw, RGB, zstd", 3, "zstd"), ("JPEG, gray", 1, "jpeg"))


def main() -> None:
    """Print the milliseconds of a frame, read and bare, for raw and JPEG images."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    print(f"CPU of a stereo frame of {WIDTH}x{HEIGHT}, {FRAMES} frames, best of {ROUNDS} rounds")
    with tempfile.TemporaryDirectory() as folder:
        for name, colour, compression in KINDS:
            log = Path(folder, f"{name}.mcap")
            contents = _write(log, colour, compression)
            bare = {"jpeg": _decode, "zstd": _unpack}.get(compression, _copy)
            _read(log)  # the first one imports
            rounds = [(_cpu(lambda: _read(log)), _cpu(lambda: bare(contents))) for _ in range(ROUNDS)]  # noqa: B023
            read, alone = (1000 * min(times) / FRAMES for times in zip(*rounds, strict=True))
            print(f"  {name:14} read {read:6.2f} ms, bare {alone:6.2f} ms, ratio {read / alone:5.2f}")
    cv2.setNumThreads(threads)


def _write(log: Path, colour: int, compression: str) -> list[bytes]:
    """Write a log of textured images; the bytes of each, as they are stored."""
    k, chance, contents = np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]]), np.random.default_rng(0), list[bytes]()
    noise = chance.normal(0, 1, (HEIGHT, WIDTH + FRAMES))
    texture = sum((size * cv2.GaussianBlur(noise, (0, 0), size) for size in (1, 4, 16)), start=np.zeros_like(noise))
    gray = np.clip(110 + 40 * texture + chance.normal(0, 1.5, texture.shape), 0, 255).astype(np.uint8)
    with Ros2Writer(log, compression="zstd" if compression == "zstd" else "none") as writer:
        for number in range(FRAMES):
            stamp = (number + 1) * PERIOD
            for side in SIDES:
                p = np.hstack([k, [[-900 * 0.24 if side == "right" else 0.0], [0], [0]]])
                model = CameraModel(width=WIDTH, height=HEIGHT, k=k, d=np.zeros(5), r=np.eye(3), p=p)
                pixels = np.ascontiguousarray(gray[:, number : number + WIDTH])
                if colour == 3:
                    pixels = np.repeat(pixels[..., None], 3, axis=2)
                message = image(stamp, side, pixels)
                if compression == "jpeg":
                    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].ravel()
                    kind = "sensor_msgs/msg/CompressedImage"
                    message = make(kind, header=header(stamp, side), format="jpeg", data=data)
                writer.write(f"/{side}/camera_info", camera_info(stamp, side, model), stamp)
                writer.write(f"/{side}/image_rect", message, stamp)
                stored = message.data.tobytes()
                contents.append(ZstdCompressor().compress(stored) if compression == "zstd" else stored)
    return contents


def _read(log: Path) -> None:
    with McapSource().open(log) as opened:
        found = sum(isinstance(item, CameraImage) for _, _, item in opened.events(SIDES))
    assert found == 2 * FRAMES


def _decode(contents: list[bytes]) -> None:
    for content in contents:
        cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


def _unpack(contents: list[bytes]) -> None:
    for content in contents:
        ZstdDecompressor().decompress(content)


def _copy(contents: list[bytes]) -> None:
    for content in contents:
        np.frombuffer(content, np.uint8).copy()


def _cpu(work: Callable[[], None]) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun


if __name__ == "__main__":
    main()
