"""Match beside OpenCV's matchers: time, memory, compilation, and accuracy on real scenes with truth.

Run as `python -m tests.bench.matching`. Times are medians of interleaved rounds, so that whatever else the machine does
slows all of them; every matcher removes speckles and checks left against right. The pair is a Middlebury scene enlarged
to 1280x960 where ROVERFLOW_DATA names the data, else a simulated view of ground with many rocks.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from flow.malloc import keep_freed_memory
from recordings.simulator import Simulation
from stages import Disparity, Match, MatchOpenCV, Rectify, Refine, StereoCamera, StereoFrame
from stages.data import Array
from tests.bench.stereo_scores import devon, load_scene, rows_filled

WIDTH, HEIGHT = 1280, 960
ROUNDS = 9


def colour_pair() -> StereoFrame:
    """The frame that is timed."""
    data = os.environ.get("ROVERFLOW_DATA")
    if not data:
        simulation = Simulation(scene="gravel", frames=2, width=WIDTH, height=HEIGHT, abundance=0.15)
        return StereoFrame(0, *simulation.frame(1).images, simulation.camera)
    scene = Path(data) / "middlebury-q" / "Motorcycle"
    images = [cv2.cvtColor(cv2.imread(str(scene / f"im{i}.png")), cv2.COLOR_BGR2RGB) for i in (0, 1)]
    left, right = (cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for image in images)
    return StereoFrame(0, left, right, StereoCamera(1000, 1000, WIDTH / 2, HEIGHT / 2, 0.2, WIDTH, HEIGHT))


def gray_pair() -> StereoFrame:
    """The same in gray."""
    return in_gray(colour_pair())


def in_gray(frame: StereoFrame) -> StereoFrame:
    """A colour frame in gray."""
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame.left, frame.right))
    return replace(frame, left=left, right=right)


def opencv(mode: int, disparities: int, frame: StereoFrame) -> Callable[[], object]:
    """OpenCV's matcher with the parameters of the paper's authors, on gray images."""
    matcher = cv2.StereoSGBM.create(0, disparities, 5, 4 * 25, 38 * 25, 1, 0, 1, 100, 2, mode)
    return lambda: matcher.compute(frame.left, frame.right)


def medians(contestants: dict[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """Median seconds of each, interleaved; the first round, which compiles and allocates, does not count."""
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for round_ in range(rounds + 1):
        for name, run in contestants.items():
            start = time.perf_counter()
            run()
            if round_:
                times[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in times.items()}


def speed() -> None:
    """Print times and ratios of the matchers, in a process that keeps its memory as a run does."""
    keep_freed_memory()
    frame = gray_pair()
    contestants: dict[str, Callable[[], object]] = {
        "OpenCV HH": opencv(cv2.STEREO_SGBM_MODE_HH, 128, frame),
        "OpenCV 3WAY": opencv(cv2.STEREO_SGBM_MODE_SGBM_3WAY, 128, frame),
    }
    for disparities in (128, 192):
        for threads in (1, 2):
            match = Match(disparities=disparities, threads=threads)
            contestants[f"Match {disparities} x{threads}"] = lambda match=match: match(frame)
        match, pool = Match(disparities=disparities), ThreadPoolExecutor(2)
        contestants[f"Match {disparities}, 2 frames on 2 cores"] = lambda match=match, pool=pool: list(
            pool.map(match, [frame, frame])
        )
    prior = Match(disparities=192)(frame)
    for threads in (1, 2):
        match = Match(search_radius=4, paths=4, threads=threads)
        contestants[f"4 px around a prior, 4 paths x{threads}"] = lambda match=match: match(frame, prior)
    seconds = medians(contestants)
    print(f"{'1280x960, median of ' + str(ROUNDS):52} {'ms':>8}  / HH   / 3WAY")
    for name, value in seconds.items():
        ratios = f"{value / seconds['OpenCV HH']:6.3f}  {value / seconds['OpenCV 3WAY']:6.3f}"
        print(f"{name:52} {1e3 * value:8.1f} {ratios}")
    wide, narrow = seconds["Match 192 x2"], seconds["Match 128 x2"]
    alone, both = seconds["Match 128 x1"], seconds["Match 128, 2 frames on 2 cores"] / 2
    print(f"192 disparities over 128 {wide / narrow:.2f}; 2 threads over 1 {narrow / alone:.2f}", end="")
    print(f" (a frame of two at once over one alone: {both / alone:.2f})")


MEASURE = """
import json, re, sys, time
start = time.perf_counter()
import numpy as np
from stages import Match, StereoCamera, StereoFrame
left, right = np.load(sys.argv[1])
frame = StereoFrame(0, left, right, StereoCamera(1000, 1000, 640, 480, 0.2, left.shape[1], left.shape[0]))
peak = lambda: int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
before = peak()
start = time.perf_counter()
Match(threads=2)(frame)
first = time.perf_counter() - start
start = time.perf_counter()
Match(threads=2)(frame)
after = peak()
print(json.dumps([first, time.perf_counter() - start, (after - before) / 1024]))
"""


def first_call(images: Path, cache: Path) -> tuple[float, float, float]:
    """Seconds of the first call in a new process, of the second, and MB that both added."""
    command = [sys.executable, "-c", MEASURE, str(images)]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    output = subprocess.check_output(command, env=environment, stderr=subprocess.DEVNULL)
    first, second, megabytes = json.loads(output)
    return first, second, megabytes


def start_up(cache: Path) -> None:
    """Print how long the first call takes without and with compiled kernels, and how much memory it needs."""
    print(f"\n{'first call in a new process':34} {'cold s':>8} {'warm s':>7} {'next s':>7} {'MB':>6}")
    frame, images = gray_pair(), cache / "pair.npy"  # not made by the process whose memory is measured
    np.save(images, np.stack([frame.left, frame.right]))
    cold, _, _ = first_call(images, cache)
    warm, following, megabytes = first_call(images, cache)
    print(f"{'Match 192 x2':34} {cold:8.2f} {warm:7.2f} {following:7.2f} {megabytes:6.0f}")


def scene_errors(folder: Path) -> dict[str, Array]:
    """Means over scenes with truth, %, of Match and of OpenCV's best mode, before refinement, not occluded.

    Of the pixels kept, those off by over 1 px; the pixels kept; pixels off by over 0.5 and 1 px, with rows filled.
    """
    found: dict[str, list[list[float]]] = {}
    for scene in sorted(folder.iterdir()):
        frame, truth, mask, levels = load_scene(scene)
        matcher = cv2.StereoSGBM.create(0, levels, 5, 300, 2850, 1, 0, 1, 100, 2, cv2.STEREO_SGBM_MODE_HH)
        sixteenths = matcher.compute(frame.left[..., ::-1], frame.right[..., ::-1])
        results: dict[str, Array] = {"OpenCV HH": np.where(sixteenths < 0, np.nan, sixteenths / 16).astype(np.float32)}
        results["Match"] = Match(disparities=levels)(frame).pixels
        results["Match, rows corrected"] = Match(disparities=levels)(Rectify()(frame)).pixels
        scored = (mask == 255) & np.isfinite(truth) & (np.arange(truth.shape[1]) >= levels)
        for name, pixels in results.items():
            kept = np.abs(pixels - truth)[scored & np.isfinite(pixels)]
            filled = np.abs(rows_filled(pixels) - truth)[scored]
            bad = [np.mean(~(filled <= limit)) for limit in (0.5, 1)]
            found.setdefault(name, []).append([np.mean(kept > 1), len(kept) / scored.sum(), *bad])
    return {name: 100 * np.mean(values, axis=0) for name, values in found.items()}


def accuracy(folder: Path) -> None:
    """Print these errors, and their ratios."""
    print(f"\n{'mean of the scenes, not occluded, %':34} kept bad-1  density  filled bad-0.5  filled bad-1")
    means = scene_errors(folder)
    for name, (kept, density, half, one) in means.items():
        print(f"{name:34} {kept:10.2f} {density:8.1f} {half:15.2f} {one:13.2f}")
        ratio = means[name] / means["OpenCV HH"]
        points = density - means["OpenCV HH"][1]
        print(f"{'  over OpenCV HH':34} {ratio[0]:10.3f} {points:+8.1f} {ratio[2]:15.3f} {ratio[3]:13.3f}")


def fractions() -> None:
    """Print by how much a surface that faces the camera is drawn to whole pixels: the median error at each fraction."""
    pair = gray_pair()
    x, y = (grid.astype(np.float32) for grid in np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)))
    noise = np.random.default_rng(0)
    ways: dict[str, Callable[[StereoFrame], Disparity]] = {
        "OpenCV HH": MatchOpenCV(disparities=64),
        "Match": Match(disparities=64),
        "Match, refined": lambda frame: Refine()(frame, Match(disparities=64)(frame)),
    }
    steps = np.arange(1, 10) / 10
    print(f"\n{'median error, px, of 20 px and':34} {' '.join(f'{step:6.1f}' for step in steps)}")
    found: dict[str, list[float]] = {name: [] for name in ways}
    for step in steps:
        shifted = cv2.remap(pair.right.astype(np.float32), x - np.float32(20 + step), y, cv2.INTER_LANCZOS4)
        images = (np.clip(np.rint(view + noise.normal(0, 1, view.shape)), 0, 255) for view in (shifted, pair.right))
        frame = StereoFrame(0, *(image.astype(np.uint8) for image in images), pair.camera)
        for name, way in ways.items():
            found[name].append(float(np.nanmedian(way(frame).pixels[20:-20, 100:-20])) - 20 - step)
    for name, errors in found.items():
        print(f"{name:34} {' '.join(f'{error:+6.2f}' for error in errors)}")


def rows(data: Path) -> None:
    """Print how the row correction changes what is matched on real rover images, right of the columns that only the
    left camera sees and below the sky."""
    title = f"{'density':>8} {'mean confidence':>16} {'density where both views agree exactly':>40}"
    print(f"\n{'Devon Island':34} {title}")
    for pair, frame in devon(data):
        for name, stage in (("as calibrated", Rectify(row_offset=0.0)), ("rows corrected", Rectify())):
            rectified = stage(frame)
            found, strict = Match()(rectified), Match(lr_tolerance=0)(rectified)
            known, agreed = (np.isfinite(each.pixels[300:, 192:]) for each in (found, strict))
            confidence = found.confidence[300:, 192:][known].mean()
            figures = f"{100 * known.mean():8.1f} {confidence:16.3f} {100 * agreed.mean():40.1f}"
            print(f"{f'{pair}, {name}':34} {figures}")


def main() -> None:
    """Print all tables."""
    speed()
    with tempfile.TemporaryDirectory() as cache:
        start_up(Path(cache))
    fractions()
    data = os.environ.get("ROVERFLOW_DATA")
    if data:
        accuracy(Path(data) / "middlebury-q")
        rows(Path(data))


if __name__ == "__main__":
    main()
