"""Error of the disparity against its price: `make study` prints a table of pipelines and variants, and draws it.

Each variant is a pipeline with settings as of `--set`. The errors are those of three simulated frames, 1280x960, on
ground within the search range: unknown counts as bad. The price is the CPU time from rectified images to disparity on
one thread, over that of OpenCV's MODE_HH with the same range. A mark stands where another variant is cheaper and has
fewer errors of each kind. Where ROVERFLOW_DATA names the data, the last column is bad-1 on the Middlebury scenes over
that of the code that the paper's authors released.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np

from flow.config.loader import load
from flow.malloc import keep_freed_memory
from flow.runtime.evaluate import evaluate
from flow.runtime.graph import Graph
from recordings.simulator.scenes import SCENES
from stages.data import Array
from stages.matching.intensity import gray
from tests.bench.refining import RELEASED
from tests.bench.stereo_scores import errors, rows_filled
from tests.study import Case, real, simulated

ROUNDS = 3
OPENCV = {"OpenCV 3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY, "OpenCV MODE_HH": cv2.STEREO_SGBM_MODE_HH}
PIPELINES = ("paper", "fast", "rover", "accurate")
VARIANTS = (
    "fast disparity.max_step=0",
    "fast disparity.max_step=10cm",
    "fast disparity/full.paths=8",
    "fast disparity.support=false disparity/half_refined.support=false",
    "fast disparity.plane_weight=0 disparity/half_refined.plane_weight=0",
    "fast disparity/half_refined.subpixel_radius=0",
    "rover disparity/full.paths=8",
    "rover disparity/full.search_radius=4 disparity/full.band_height=0",
    "rover disparity/full.follow_slopes=true",
    "rover disparity/half_refined.support=false",
    "rover disparity.support=false",
    "rover disparity.subpixel_radius=0",
    "rover disparity.bilateral_radius=0",
    "rover disparity.plane_weight=0",
    "rover disparity.edge_radius=0",
    "rover disparity.hypotheses=64",
    "accurate disparity.surface_size=0",
    "accurate disparity.support=false",
    "accurate disparity.bilateral_radius=0",
    "accurate disparity/full.paths=8 disparity/second.paths=8",
)
PLOT, FRAME = (900, 520), (70, 30, 20, 50)  # px: size of the drawing; its margins left, right, top, bottom
PRICES, SHARES = (0.05, 10.0), (2.0, 30.0)  # ends of the axes: over MODE_HH; percent


class Point(NamedTuple):
    """A variant: its CPU time over MODE_HH's, and its errors, percent beyond 0.5 and 1 px, and RMS in px."""

    name: str
    price: float
    bad_half: float
    bad_one: float
    rms: float


def opencv(mode: int) -> Callable[[Case], Array]:
    """OpenCV's matcher, whose holes are filled along the rows."""

    def match(case: Case) -> Array:
        matcher = cv2.StereoSGBM.create(0, case.disparities, 5, 200, 800, 1, 0, 0, 0, 0, mode)
        pixels = matcher.compute(gray(case.frame.left), gray(case.frame.right)) / np.float32(16)
        return rows_filled(np.where(pixels > 0, pixels, np.float32(np.nan)))

    return match


def pipeline(name: str, *settings: str) -> Callable[[Case], Array]:
    """The disparity of a pipeline with these settings."""

    @cache
    def graph(disparities: int) -> Graph:
        return load(name, [*settings, f"disparities={disparities}"], with_sinks=False)

    def match(case: Case) -> Array:
        given = {"rectified": case.frame} if case.given is case.frame else {"stereo": case.given}
        return evaluate(graph(case.disparities), given, "disparity")["disparity"].pixels

    return match


WAYS = {name: opencv(mode) for name, mode in OPENCV.items()}
WAYS |= {name: pipeline(*name.split()) for name in (*PIPELINES, *VARIANTS)}


def measure(cases: Iterable[Case]) -> list[Point]:
    """Every variant, the cheapest first."""
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    found: dict[str, list[Array]] = {name: [] for name in WAYS}
    for case in cases:
        for attempt in range(ROUNDS + 1):  # the first one fills caches, and is scored
            for name, way in WAYS.items():
                if name == "paper" and attempt > 1:
                    continue
                begun = time.process_time()
                pixels = way(case)
                if attempt:
                    seconds[name].append(time.process_time() - begun)
                else:
                    found[name].append(errors(pixels, case.truth, case.mask, case.disparities))
    reference = median(seconds["OpenCV MODE_HH"])
    means = {name: np.mean(values, axis=0) for name, values in found.items()}
    points = [Point(name, median(seconds[name]) / reference, *means[name][[0, 1, 6]]) for name in WAYS]
    return sorted(points, key=lambda point: point.price)


def beaten(point: Point, points: Iterable[Point]) -> bool:
    """Whether another variant is cheaper and has fewer errors of each kind."""
    return any(all(other < own for other, own in zip(rival[1:], point[1:], strict=True)) for rival in points)


def drawing(points: list[Point]) -> str:
    """SVG: percent off by over 0.5 px against the price, both logarithmic; the pipelines by name, the others small."""
    (width, height), (left, right, top, bottom) = PLOT, FRAME

    def place(value: float, ends: tuple[float, float], begin: float, end: float) -> float:
        return begin + (end - begin) * math.log(value / ends[0]) / math.log(ends[1] / ends[0])

    def across(price: float) -> float:
        return place(price, PRICES, left, width - right)

    def up(share: float) -> float:
        return place(share, SHARES, height - bottom, top)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for price in (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10):
        parts.append(f'<path d="M{across(price):.0f} {top}V{height - bottom}" stroke="#ddd"/>')
        parts.append(f'<text x="{across(price):.0f}" y="{height - bottom + 18}" text-anchor="middle">{price:g}</text>')
    for share in (2, 3, 5, 10, 20, 30):
        parts.append(f'<path d="M{left} {up(share):.0f}H{width - right}" stroke="#ddd"/>')
        parts.append(f'<text x="{left - 8}" y="{up(share) + 5:.0f}" text-anchor="end">{share} %</text>')
    parts.append(
        f'<text x="{width / 2:.0f}" y="{height - 10}" text-anchor="middle">CPU time from images to disparity, '
        "over OpenCV MODE_HH</text>"
    )
    parts.append(f'<text x="{left + 8}" y="{top + 18}">pixels off by over 0.5 px</text>')
    for point in points:
        x, y, known = across(point.price), up(point.bad_half), point.name in (*PIPELINES, *OPENCV)
        size, colour = (7, "#c33") if known else (4, "#999" if beaten(point, points) else "#36c")
        name = f"<title>{point.name}</title>"
        parts.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="{size}" fill="{colour}">{name}</circle>')
        if known:
            parts.append(f'<text x="{x + 11:.0f}" y="{y - 6:.0f}">{point.name}</text>')
    return "\n".join([*parts, "</svg>\n"])


def on_real_scenes(data: Path) -> dict[str, float]:
    """Of every variant, bad-1 on the Middlebury scenes over that of the released code."""
    cases = list(real(data / "middlebury-q"))
    released = sum(RELEASED[case.name][1] for case in cases)
    return {
        name: sum(errors(way(case), case.truth, case.mask, case.disparities)[1] for case in cases) / released
        for name, way in WAYS.items()
    }


def main(folder: Path, scene: str) -> None:
    """Print the table and write the drawing."""
    cv2.setNumThreads(1)
    keep_freed_memory()
    points = measure(simulated(1280, 960, scene=scene))
    others = on_real_scenes(Path(os.environ["ROVERFLOW_DATA"])) if "ROVERFLOW_DATA" in os.environ else {}
    print(f"{f'1280x960, scene {scene}':68} over HH  bad-0.5  bad-1   RMS" + "  real bad-1" * bool(others))
    for point in points:
        name, price, *found = point
        other = f"  {others[name]:10.3f}" if others else ""
        mark = "  beaten" if beaten(point, points) else ""
        print(f"{name:68} {price:7.3f} {found[0]:8.2f} {found[1]:6.2f} {found[2]:5.2f}{other}{mark}")
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "error-against-time.svg"
    file.write_text(drawing(points))
    print(f"drawn in {file}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m tests.error_against_time", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("demo/study"), help="of the drawing (demo/study)")
    parser.add_argument("--scene", choices=SCENES, default="mixed", help="of the simulated frames (mixed)")
    options = parser.parse_args()
    main(options.folder, options.scene)
