"""Disparity errors where texture is weak: `rover`, `rover` without support, and OpenCV on variants of simulated ground.

Run as `python -m tests.bench.weak_texture`. Every variant is scene `mixed` with one change, or another scene. Scored
are the pixels that both cameras see, within the search range and right of it; an unknown pixel is bad.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from flow.malloc import keep_freed_memory
from recordings.scoring.stereo_metrics import SURFACES, StereoErrors
from recordings.simulator import Simulation
from recordings.simulator.scenes import SCENES
from recordings.simulator.simulation import FrameTruth
from stages import StereoFrame
from stages.data import Array
from tests.bench.matching import in_gray, opencv
from tests.bench.refining import DISPARITIES, stereo_part
from tests.bench.stereo_scores import rows_filled

LENGTH, SEEDS = 8, (31, 32, 33)  # frames and seeds of the traverses of each variant
VARIANTS: dict[str, dict[str, Any]] = {
    "mixed: noise 1.5, sand of contrast 2": {},
    **{f"noise {noise}": {"noise": noise} for noise in (0.5, 3.0, 5.0)},
    **{f"sand of contrast {contrast:g}": {"sand_contrast": contrast} for contrast in (1.0, 4.0, 8.0)},
    **{f"blur of {blur} px": {"blur": blur} for blur in (0.5, 1.0, 1.5)},
    "exposure difference of 15 %": {"exposure_difference": 0.15},
    "the same and blur of 1.2 px": {"exposure_difference": 0.15, "blur": 1.2},
    "JPEG of quality 85": {"jpeg": 85},
    "640x480": {"width": 640, "height": 480},
    **{scene: {"scene": scene} for scene in SCENES if scene != "mixed"},
}


def ways(frame: StereoFrame, disparities: int) -> Iterator[tuple[str, Array]]:
    """Name and disparity, (H, W) px, of each way to compute it."""
    yield "rover", stereo_part("rover", frame, disparities)["disparity"].pixels
    yield "without support", stereo_part("rover", frame, disparities, changes={"support": False})["disparity"].pixels
    sixteenths = opencv(cv2.STEREO_SGBM_MODE_HH, disparities, in_gray(frame))()
    yield "OpenCV HH", rows_filled(np.where(sixteenths < 0, np.nan, sixteenths / 16).astype(np.float32))


def cases(variant: dict[str, Any], count: int) -> Iterator[tuple[StereoFrame, int, Array, FrameTruth]]:
    """Frame, search range, true disparity, px (NaN: not scored), and truth of `count` frames of every seed."""
    for seed in SEEDS:
        simulation = Simulation(frames=LENGTH, seed=seed, **variant)
        camera, disparities = simulation.camera, DISPARITIES * simulation.width // 1280
        for index in np.linspace(0, LENGTH - 1, count).astype(int).tolist():
            made = simulation.frame(index)
            truth = camera.fx * camera.baseline / made.depth
            truth[(truth <= 0) | (truth >= disparities) | (np.arange(camera.width) < disparities)] = np.nan
            yield StereoFrame(index, *made.images, camera), disparities, truth, made


def scores(variant: dict[str, Any], count: int) -> dict[tuple[str, str], StereoErrors]:
    """The errors on `count` frames of every seed, by (way, surface), where surface `all` is every pixel."""
    found: dict[tuple[str, str], StereoErrors] = {}
    for frame, disparities, truth, made in cases(variant, count):
        for way, pixels in ways(frame, disparities):
            surfaces = StereoErrors.by_surface(pixels, truth, made.seen, made.terrain_class)
            surfaces["all"] = StereoErrors.of(pixels, truth, made.seen, 0)
            for surface, errors in surfaces.items():
                found[way, surface] = found.get((way, surface), StereoErrors()) + errors
    return found


def main(given: Sequence[str] | None = None) -> None:
    """Print bad-0.5, bad-1 and bad-2 in percent, and RMS in px, for each variant and way."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.weak_texture", description=__doc__)
    parser.add_argument("--frames", type=int, default=3, help=f"frames of each traverse of {LENGTH} that are scored")
    count = parser.parse_args(given).frames
    keep_freed_memory()
    print(f"\n{f'seeds {SEEDS}, {count} frames each':36}" + " | bad-0.5  bad-1  bad-2   RMS" * 3)
    for name, variant in VARIANTS.items():
        found = scores(variant, count)
        surfaces = ("all", *(SURFACES if not variant else ()))
        for surface in surfaces:
            cells = [errors.metrics() for (_, of), errors in found.items() if of == surface]
            bad = [" ".join(f"{100 * cell[f'bad_{limit}']:6.2f}" for limit in ("0.5", "1", "2")) for cell in cells]
            columns = (f" | {shares:>21} {cell['rmse']:5.2f}" for shares, cell in zip(bad, cells, strict=True))
            print(f"{name if surface == 'all' else f'  its {surface}':36}" + "".join(columns), flush=True)


if __name__ == "__main__":
    main()
