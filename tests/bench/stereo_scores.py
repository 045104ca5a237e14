"""Scores of the stereo stages on Middlebury v3 quarter-size scenes: matching alone, rover's and the paper's refinement.

Run as `ROVERFLOW_DATA=... python -m tests.bench.stereo_scores`. A bad pixel deviates by more than the threshold or is
unknown; columns left of the disparity range are not scored; RMS is over known pixels.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from flow.config.loader import load
from recordings.importers.middlebury import read_scene
from recordings.scoring.stereo_metrics import StereoErrors
from stages.data import Array, Disparity, StereoFrame
from stages.matching.match import Match
from stages.matching.match_opencv import MatchOpenCV
from stages.refinement.paper import RefinePaper
from stages.refinement.refine import Refine


def paper_stages() -> tuple[MatchOpenCV, RefinePaper]:
    """Matching and refinement as the pipeline `paper` sets them."""
    actors = {node.name: node.actor for node in load("paper").nodes}
    return actors["matched"], actors["disparity"]


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


def chains(frame: StereoFrame, levels: int) -> dict[str, Array]:
    """Disparity pixels of each way to compute them."""
    paper_match, paper = paper_stages()
    rover = Refine()
    matched = Match(disparities=levels)(frame)
    as_paper = replace(paper_match, disparities=levels)(frame)
    results: dict[str, Disparity | Array] = {
        "rover match, filled": rows_filled(matched.pixels),
        "rover match + rover refine": rover(frame, matched),
        "rover match + paper refine": paper(frame, matched),
        "paper match, filled": rows_filled(as_paper.pixels),
        "paper match + paper refine": paper(frame, as_paper),
        "paper match + rover refine": rover(frame, as_paper),
    }
    return {name: getattr(result, "pixels", result) for name, result in results.items()}


def main() -> None:
    cv2.setNumThreads(1)
    table: dict[str, list[Array]] = {}
    start = time.perf_counter()
    for folder in sorted((Path(os.environ["ROVERFLOW_DATA"]) / "middlebury-q").iterdir()):
        frame, truth, mask, levels = load_scene(folder)
        for name, pixels in chains(frame, levels).items():
            table.setdefault(name, []).append(errors(pixels, truth, mask, levels))
    print(f"{'mean of the scenes':28}  bad-0.5  bad-1  bad-2 | all -0.5     -1     -2 |   RMS  known %")
    for name, scores in table.items():
        mean = np.mean(scores, axis=0)
        print(f"{name:28}  {mean[0]:7.2f} {mean[1]:6.2f} {mean[2]:6.2f} | {mean[3]:8.2f} {mean[4]:6.2f} {mean[5]:6.2f}"
              f" | {mean[6]:5.2f} {mean[7]:8.2f}")  # fmt: skip
    print(f"{time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
