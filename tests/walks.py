"""Plants six faults in a simulated log, one a copy, for the walks of docs/debugging.md: `python -m tests.walks DIR`.

A fault of a setting needs no copy. The commands of the walks then run on the copies.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from recordings.simulator import Simulation, write_log
from tests.conftest import edit_of, rewrite
from tests.tilt_faults import changed_ups, flipped, late_tilts

SIMULATION = Simulation(frames=40, width=640, height=480)
BLOTCH, RADIUS = (430, 330), 24  # column and row of the dirt on the left lens, and its size, px
EVERY = 10


def wrong_baseline(log: Path, out: Path) -> Path:
    """The right camera's P states a baseline that is 10 % too long."""

    def edit(index: int, message: Any) -> None:
        message.p = message.p * np.where(np.arange(12) == 3, 1.1, 1.0)

    return rewrite(log, out, edit_of("right/camera_info", "sensor_msgs/msg/CameraInfo", edit))


def dirty_lens(log: Path, out: Path) -> Path:
    """A dark, blurred blotch at a fixed place of the left image."""
    rows, cols = np.ogrid[: SIMULATION.height, : SIMULATION.width]
    dirty = np.hypot(cols - BLOTCH[0], rows - BLOTCH[1]) < RADIUS

    def edit(index: int, message: Any) -> None:
        pixels = message.data.reshape(SIMULATION.height, SIMULATION.width, 3).copy()
        pixels[dirty] = 60
        message.data = pixels.ravel()

    return rewrite(log, out, edit_of("left/image_rect_color", "sensor_msgs/msg/Image", edit))


def lost_images(log: Path, out: Path) -> Path:
    """Every tenth right image is missing."""
    return rewrite(log, out, lambda topic, index, data: None if is_lost(topic, index) else data)


def is_lost(topic: str, index: int) -> bool:
    return topic.endswith("right/image_rect_color") and index % EVERY == EVERY - 1


FAULTS: dict[str, Callable[[Path, Path], Path]] = {
    "baseline": wrong_baseline,
    "sign": lambda log, out: changed_ups(log, out, flipped(0)),
    "late": lambda log, out: late_tilts(log, out, 0.2),
    "blotch": dirty_lens,
    "lost": lost_images,
}


def main() -> None:
    """Write the sound log and its copies."""
    top = argparse.ArgumentParser(prog="python -m tests.walks", description=__doc__)
    top.add_argument("folder", type=Path)
    folder = top.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    sound = folder / "sound.mcap"
    write_log(SIMULATION, sound)
    for name, plant in FAULTS.items():
        print(plant(sound, folder / f"{name}.mcap"))


if __name__ == "__main__":
    main()
