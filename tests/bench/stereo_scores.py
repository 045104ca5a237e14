"""Scores of the stereo stages on Middlebury v3 scenes, for tests and benchmarks.

A bad pixel deviates by more than the threshold or is unknown; columns left of the disparity range are not scored; RMS
is over known pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from recordings.importers.middlebury import read_scene
from recordings.scoring.stereo_metrics import StereoErrors
from stages.data import Array, StereoCamera, StereoFrame


def load_scene(folder: Path) -> tuple[StereoFrame, Array, Array, int]:
    """A scene's frame, true disparities (H, W) float32 with NaN = unknown, occlusion mask and range (16s)."""
    scene = read_scene(folder, stamp=1)
    assert scene.truth is not None
    assert scene.occlusion is not None
    return scene.frame, scene.truth, scene.occlusion, scene.disparities


def errors(pixels: Array, truth: Array, mask: Array, margin: int) -> Array:
    """Percent of non-occluded pixels that are bad at 0.5, 1 and 2 px, the same of all, RMS (px), percent known."""
    found = StereoErrors.of(pixels, truth, mask, margin).metrics()["cropped_image"]
    bad = [found[region][f"bad_{limit}"] for region in ("nonocc", "all") for limit in ("0.5", "1", "2")]
    return np.array([*(100 * np.array(bad)), found["all"]["rmse"], 100 * found["all"]["density"]])


def rows_filled(disparity: Array) -> Array:
    """A disparity image without holes: each takes the farther of the two disparities at its ends in the row."""
    known = np.isfinite(disparity)
    column = np.arange(disparity.shape[1])
    left = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    right = np.flip(np.minimum.accumulate(np.flip(np.where(known, column, len(column)), axis=1), axis=1), axis=1)
    padded = np.pad(disparity, ((0, 0), (1, 1)), constant_values=np.nan)
    ends = np.take_along_axis(padded, left + 1, axis=1), np.take_along_axis(padded, right + 1, axis=1)
    return np.where(known, disparity, np.fmin(*ends)).astype(np.float32)


def devon(folder: Path) -> Iterator[tuple[str, StereoFrame]]:
    """The Devon Island pairs of a folder of real data, with the camera of its FORMAT.md."""
    camera = StereoCamera(
        fx=968.999694824, fy=968.999694824, cx=635.139038086, cy=463.537109375, baseline=0.239977,
        width=1280, height=960,
    )  # fmt: skip
    for left in sorted((folder / "devon").glob("*left*.png")):
        right = left.with_name(left.name.replace("left", "right"))
        pair = [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in (left, right)]
        yield left.stem.replace("left", "").strip("_-"), StereoFrame(1, *pair, camera)
