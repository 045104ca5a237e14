"""Scores of the stereo stages on Middlebury v3 quarter-size scenes: matching alone, rover's and the paper's refinement.

Run as `ROVERFLOW_DATA=... python -m tests.bench.stereo_scores`. A bad pixel deviates by more than the threshold or is
unknown; columns left of the disparity range are not scored; RMS is over known pixels.
"""

from __future__ import annotations

import os
import re
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from flow.pipeline import load
from stages.data import Array, Disparity, StereoCamera, StereoFrame
from stages.kernels.background import fill_background
from stages.match import Match
from stages.match_opencv import MatchOpenCV
from stages.refine import Refine


def paper_stages() -> tuple[MatchOpenCV, Refine]:
    """Matching and refinement as the pipeline `paper` sets them."""
    actors = {node.name: node.actor for node in load("paper").nodes}
    return actors["matched"], actors["disparity"]


def load_scene(folder: Path) -> tuple[StereoFrame, Array, Array, int]:
    """A scene's frame, true disparities (H, W) float32 with inf = unknown, non-occlusion mask and range (16s)."""
    calibration = dict(re.findall(r"(\w+)=(.+)", (folder / "calib.txt").read_text()))
    fx, _, cx, _, fy, cy = (float(number) for number in re.findall(r"[\d.]+", calibration["cam0"])[:6])
    left, right = (cv2.cvtColor(cv2.imread(str(folder / f"im{i}.png")), cv2.COLOR_BGR2RGB) for i in (0, 1))
    height, width = left.shape[:2]
    camera = StereoCamera(
        fx, fy, cx, cy, float(calibration["baseline"]) / 1000, width, height, cx + float(calibration["doffs"])
    )
    with (folder / "disp0GT.pfm").open("rb") as file:
        scale = [file.readline() for _ in range(3)][2]
        order = "<f4" if float(scale) < 0 else ">f4"
        truth = np.flipud(np.frombuffer(file.read(), order).reshape(height, width)).astype(np.float32)
    mask = cv2.imread(str(folder / "mask0nocc.png"), cv2.IMREAD_GRAYSCALE)
    return StereoFrame(1, left, right, camera), truth, mask, -(-int(calibration["ndisp"]) // 16) * 16


def errors(pixels: Array, truth: Array, mask: Array, margin: int) -> Array:
    """Percent of non-occluded pixels that are bad at 0.5, 1 and 2 px, the same of all, RMS (px), percent known."""
    scored = np.isfinite(truth) & (np.arange(truth.shape[1]) >= margin)
    error = np.where(np.isfinite(pixels) & scored, np.abs(pixels - np.where(scored, truth, 0)), np.inf)
    bad = [100 * np.mean(error[area] > limit) for area in (scored & (mask == 255), scored) for limit in (0.5, 1, 2)]
    known = scored & np.isfinite(pixels)
    rms = np.sqrt(np.mean(error[known] ** 2))
    return np.array([*bad, rms, 100 * known.sum() / scored.sum()])


def chains(frame: StereoFrame, levels: int) -> dict[str, Array]:
    """Disparity pixels of each way to compute them."""
    paper_match, paper = paper_stages()
    rover = Refine()
    matched = Match(disparities=levels)(frame)
    as_paper = replace(paper_match, disparities=levels)(frame)
    results: dict[str, Disparity | Array] = {
        "rover match, filled": fill_background(matched.pixels, np.inf),
        "rover match + rover refine": rover(frame, matched),
        "rover match + paper refine": paper(frame, matched),
        "paper match, filled": fill_background(as_paper.pixels, np.inf),
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
