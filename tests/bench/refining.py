"""Matching and refinement beside their alternatives: time of the whole chain, accuracy of the pipelines.

Run as `python -m tests.bench.refining`. Times are medians of interleaved rounds in one process, on two threads, of a
1280x960 colour frame with 192 disparities. Accuracy is that of the pipelines as they ship, over what the code that
the paper's authors released gives on the same scenes, where ROVERFLOW_DATA names the data.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np

from flow.config.loader import load
from flow.malloc import keep_freed_memory
from flow.runtime.evaluate import evaluate
from flow.runtime.graph import Graph
from stages import Disparity, StereoFrame
from stages.data import Array
from tests.bench.matching import colour_pair, in_gray, medians, opencv
from tests.bench.stereo_scores import errors, load_scene

DISPARITIES = 192
ROUNDS = 5
# Errors of the released code, measured with it: bad-0.5, 1, 2 of pixels that both cameras see, of all; RMS of all.
RELEASED = {
    "Adirondack": (17.85, 9.07, 5.53, 21.69, 13.15, 9.52, 5.32),
    "Motorcycle": (15.31, 7.83, 5.11, 21.34, 14.03, 10.86, 6.11),
    "Piano": (29.45, 22.69, 18.00, 32.25, 25.51, 20.72, 3.62),
    "Pipes": (18.45, 13.01, 10.93, 28.04, 22.85, 20.57, 9.16),
    "PlaytableP": (22.52, 12.58, 7.86, 27.77, 18.27, 13.37, 4.38),
    "Recycle": (19.13, 9.39, 4.80, 22.75, 13.11, 8.24, 3.01),
    "Teddy": (17.40, 11.44, 8.51, 20.22, 14.32, 11.19, 3.87),
    "Vintage": (34.14, 22.64, 16.31, 36.33, 25.02, 18.60, 7.39),
}
COLUMNS = "bad-0.5  bad-1  bad-2 | all -0.5     -1     -2 |   RMS"


def stereo_part(
    pipeline: str, frame: StereoFrame, disparities: int, threads: int = 1, entry: str = "stereo",
    changes: Mapping[str, Any] = MappingProxyType({}), **given: Disparity,
) -> dict[str, Any]:  # fmt: skip
    """The streams that a pipeline's disparity of one frame depends on, by name; the frame enters as stream `entry`.

    disparities: the range at full size; a coarser one keeps its share of it; changes: parameters of every stage that
    has them; given: streams that are not made but taken as they are.
    """
    graph, nodes = graph_of(pipeline), []
    for node in graph.nodes:
        actor, names = node.actor, {field.name for field in fields(node.actor)}
        if "disparities" in names:
            actor = replace(actor, disparities=round(actor.disparities * disparities / DISPARITIES))
        changed = {"threads": threads, **changes}
        actor = replace(actor, **{name: value for name, value in changed.items() if name in names})
        nodes.append(replace(node, actor=actor))
    return evaluate(replace(graph, nodes=tuple(nodes)), {entry: frame, **given}, "disparity")


@functools.cache
def graph_of(pipeline: str) -> Graph:
    """A pipeline, loaded once."""
    return load(pipeline)


@functools.cache
def stage(pipeline: str, name: str) -> Any:
    """The stage that makes a stream of a pipeline."""
    return next(node.actor for node in graph_of(pipeline).nodes if node.name == name)


def scenes(folder: Path) -> Iterator[tuple[str, StereoFrame, Array, Array, int]]:
    """Name, frame, truth, occlusion mask and range of each scene."""
    for scene in sorted(path for path in folder.iterdir() if path.is_dir()):
        yield scene.name, *load_scene(scene)


def speed() -> None:
    """Print times and ratios, in a process that keeps its memory as a run does."""
    keep_freed_memory()
    frame = colour_pair()
    contestants = {"OpenCV MODE_HH, gray": opencv(cv2.STEREO_SGBM_MODE_HH, DISPARITIES, in_gray(frame))}
    for pipeline in ("accurate", "rover", "fast"):
        for threads in (1, 2):
            contestants[f"{pipeline}, match and refine, {threads} threads"] = (
                lambda pipeline=pipeline, threads=threads: stereo_part(
                    pipeline, frame, DISPARITIES, threads, "rectified"
                )
            )
    contestants["rover without support, 1 threads"] = lambda: stereo_part(
        "rover", frame, DISPARITIES, 1, "rectified", changes={"support": False}
    )
    seconds = medians(contestants, ROUNDS)
    print(f"{'1280x960, 192 disparities, median of ' + str(ROUNDS):48} {'ms':>8}")
    for name, value in seconds.items():
        print(f"{name:48} {1e3 * value:8.1f}")
    alone = seconds["OpenCV MODE_HH, gray"]
    support = seconds["rover, match and refine, 1 threads"] - seconds["rover without support, 1 threads"]
    print(f"support over MODE_HH, on one core               {support / alone:8.3f}")
    for pipeline in ("accurate", "rover", "fast"):
        whole = seconds[f"{pipeline}, match and refine, 2 threads"]
        print(f"{pipeline} over MODE_HH alone                         {whole / alone:8.3f}")


def accuracy(folder: Path) -> None:
    """Print the errors of the pipelines, scene by scene, and their means over those of the released code."""
    released = np.array([RELEASED[name] for name, *_ in scenes(folder)])
    for pipeline in ("accurate", "rover", "fast", "paper"):
        rows = []
        print(f"\n{pipeline:12} {COLUMNS}  known %")
        for name, frame, truth, mask, levels in scenes(folder):
            rows.append(errors(stereo_part(pipeline, frame, levels)["disparity"].pixels, truth, mask, levels))
            print(row(name, rows[-1]))
        found = np.array(rows)
        print(row("mean", found.mean(axis=0)))
        print(row("released", released.mean(axis=0)))
        print(row("ratio", found[:, :7].mean(axis=0) / released.mean(axis=0), 3))
        print(f"largest ratio of a scene in a column: {np.max(found[:, :7] / released):.2f}")


def row(name: str, numbers: Array, digits: int = 2) -> str:
    """One line of a table with the columns `COLUMNS`."""
    texts = [f"{number:.{digits}f}" for number in numbers]
    bars = [f"{text:>6}" for text in texts]
    return f"{name:12} {bars[0]:>7} {bars[1]} {bars[2]} | {bars[3]:>8} {bars[4]} {bars[5]} | {bars[6]:>5}" + (
        f" {bars[7]:>8}" if len(bars) > 7 else ""
    )


def main() -> None:
    """Print both."""
    cv2.setNumThreads(2)
    speed()
    data = os.environ.get("ROVERFLOW_DATA")
    if data:
        start = time.perf_counter()
        accuracy(Path(data) / "middlebury-q")
        print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
