"""The effect of each step of refinement: `make study` prints the errors after every step, and of variants.

On real scenes with truth where ROVERFLOW_DATA names the data, and on simulated rover frames, where errors within 3 px
of a depth edge count separately. Pictures of image, disparity, source and confidence go to the folder named on the
command line.
"""

import argparse
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from recordings.simulator import Simulation
from recordings.sinks import colormaps
from stages import Disparity, Match, PixelOrigin, Rectify, Refine, StereoFrame
from stages.data import Array
from stages.refinement.refine import TRUST
from tests.bench.refining import COLUMNS, RELEASED, row, scenes, stage, stereo_part
from tests.bench.stereo_scores import devon, errors, rows_filled

PLAIN: dict[str, Any] = {
    "median_size": 0, "plane_weight": 0, "plane_fill": False, "surface_size": 0, "bilateral_radius": 0,
    "edge_radius": 0, "min_confidence": 0, "subpixel_radius": 0, "support": False,
}  # fmt: skip
LAST: dict[str, Any] = {"bilateral_radius": 0, "edge_radius": 0, "support": False}
ABUNDANCES = {1: 0.05, 2: 0.15, 3: 0.10}  # of rocks, by seed
PLANE, STEP, CONTRASTS = 25, 8, (0, 2, 4, 8)  # px, side and spacing of planes; gray levels from which classes begin
EDGE_STEP, EDGE_REACH = 2.0, 3  # px of disparity that make an edge of depth, px from it that count as near


class Case(NamedTuple):
    """A frame, rectified, with its truth: (H, W) float32 disparity, NaN = unknown, and mask, 255 = seen by both; and
    the frame as it was given, for pipelines that rectify it in their own way."""

    name: str
    frame: StereoFrame
    truth: Array
    mask: Array
    disparities: int
    given: StereoFrame


Chain = Callable[[dict[str, Any], Case], Disparity]


def simulated(
    width: int = 640, height: int = 480, seeds: Iterable[int] = ABUNDANCES, scene: str = "mixed"
) -> Iterator[Case]:
    """Frames of simulated traverses, of the ground within the search range."""
    for seed in seeds:
        rocks = ABUNDANCES[seed]
        simulation = Simulation(scene=scene, frames=4, width=width, height=height, seed=seed, abundance=rocks)
        camera, found = simulation.camera, simulation.frame(1)
        truth = (camera.fx * camera.baseline / found.depth).astype(np.float32)
        disparities = 192 * width // 1280
        truth[(truth <= 0) | (truth > disparities - 2)] = np.nan
        frame = StereoFrame(seed, *found.images, camera)
        yield Case(f"seed {seed}", frame, truth, found.seen, disparities, frame)


def real(folder: Path) -> Iterator[Case]:
    """The scenes of a folder, rectified as a pipeline does."""
    rectify = Rectify()
    for name, frame, truth, mask, disparities in scenes(folder):
        yield Case(name, rectify(frame), truth, mask, disparities, frame)


def refined(stream: str, **parameters: Any) -> Chain:
    """What the last refinement of `accurate`, with these parameters, makes of one of its streams."""
    refine: Refine = replace(stage("accurate", "disparity"), **parameters)
    return lambda streams, case: refine(case.frame, streams[stream])


def remade(streams: dict[str, Callable[[dict[str, Any], Case], Disparity]]) -> Chain:
    """`accurate` with these streams made otherwise, and with what follows from them."""
    return lambda found, case: stereo_part(
        "accurate", case.frame, case.disparities, entry="rectified",
        **{"disparity/right": found["disparity/right"], **{name: make(found, case) for name, make in streams.items()}},
    )["disparity"]  # fmt: skip


def alone(streams: dict[str, Any], case: Case) -> Disparity:
    """Matching as `Match` does it alone, its holes filled."""
    return Refine(**PLAIN)(case.frame, Match(disparities=case.disparities)(case.frame))


def blind(streams: dict[str, Any], case: Case) -> Disparity:
    """A view from the right that shows nothing."""
    shape = case.truth.shape
    return Disparity(
        case.frame.stamp, np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.float32)
    )


def matched(prior: str = "", **parameters: Any) -> Chain:
    """A match of the whole range at full size, near a stream of `accurate` if one is named."""
    return lambda streams, case: Match(disparities=case.disparities, **parameters)(
        case.frame, *([streams[prior]] if prior else [])
    )


def full(**parameters: Any) -> Chain:
    """The match at full size near the coarse one, with these parameters."""
    return lambda streams, case: replace(
        stage("accurate", "disparity/full"), disparities=case.disparities, **parameters
    )(case.frame, streams["disparity/prior"])


def part_of_range(part: int) -> Chain:
    """`accurate` with one `part` of the search range; what is nearer is found in smaller images first."""
    return lambda _, case: stereo_part("accurate", case.frame, case.disparities // part, entry="rectified")["disparity"]


def by_rows(streams: dict[str, Any], case: Case) -> Disparity:
    """`accurate` with holes filled along their rows, from the farther end, without asking the image."""
    found = refined("disparity/second_checked", fill=False)(streams, case)
    return replace(found, pixels=rows_filled(found.pixels))


def whole(pipeline: str) -> Chain:
    """A pipeline as it ships, on the frame as given."""
    return lambda _, case: stereo_part(pipeline, case.given, case.disparities)["disparity"]


STEPS: dict[str, Chain] = {
    "matching alone, filled": alone,
    "coarse to fine, filled": refined("disparity/full", **PLAIN),
    "+ view from the right": refined("disparity/full_checked", **PLAIN),
    "+ matched again about that": refined("disparity/second_checked", **PLAIN),
    "+ doubtful matches dropped": refined("disparity/second_checked", **{**PLAIN, "min_confidence": 0.5}),
    "+ fractions from brightness": refined(
        "disparity/second_checked", **{**PLAIN, "min_confidence": 0.5, "subpixel_radius": 2}
    ),
    "+ median": refined(
        "disparity/second_checked", **{**PLAIN, "min_confidence": 0.5, "subpixel_radius": 2, "median_size": 3}
    ),
    "+ planes of superpixels": refined("disparity/second_checked", surface_size=0, plane_fill=False, **LAST),
    "+ they fill holes": refined("disparity/second_checked", surface_size=0, **LAST),
    "+ planes of surfaces": refined("disparity/second_checked", **LAST),
    "+ bilateral filter": refined("disparity/second_checked", edge_radius=0, support=False),
    "+ edges as in the image": refined("disparity/second_checked", support=False),
    "+ support of texture: accurate": lambda streams, _: streams["disparity"],
}
VARIANTS: dict[str, Chain] = {
    "accurate without the coarse match": remade({"disparity/full": matched()}),
    "accurate, coarse match not refined": remade(
        {"disparity/half_refined": lambda streams, _: streams["disparity/half"]}
    ),
    "accurate without the right view": remade({"disparity/right": blind}),
    "accurate, right of whole range": remade(
        {
            "disparity/right": lambda streams, case: Match(disparities=case.disparities, paths=4)(
                streams["disparity/right/swapped"]
            )
        }
    ),
    "accurate, not matched again": refined("disparity/full_checked"),
    "accurate, all rows the whole range": remade({"disparity/full": full(band_height=0)}),
    "accurate, again the whole range": remade({"disparity/second": matched("disparity/full_filled", paths=4)}),
    "accurate, matched a third time": remade(
        {
            "disparity/second": lambda streams, case: stage("accurate", "disparity/second")(
                case.frame, streams["disparity"]
            )
        }
    ),
    "accurate with half the range": part_of_range(2),
    "accurate with a third of the range": part_of_range(3),
    "accurate, fractions from matching": refined("disparity/second_checked", subpixel_radius=0),
    "accurate without planes": refined("disparity/second_checked", plane_weight=0, plane_fill=False, surface_size=0),
    "accurate without surfaces": refined("disparity/second_checked", surface_size=0),
    "accurate, planes draw more: 0.7": refined("disparity/second_checked", plane_weight=0.7),
    "accurate, planes draw less: 0.3": refined("disparity/second_checked", plane_weight=0.3),
    "accurate, holes filled along rows": by_rows,
    "accurate, bilateral radius 6": refined("disparity/second_checked", bilateral_radius=6),
    "accurate, edges of radius 5": refined("disparity/second_checked", edge_radius=5),
    "accurate, 64 planes tried": refined("disparity/second_checked", hypotheses=64),
    "accurate, weak texture as strong": remade({"disparity/full": full(weak_texture_gain=1.0)}),
    "accurate with 8 paths": remade({"disparity/full": full(paths=8)}),
    "rover": whole("rover"),
    "fast": whole("fast"),
    "paper": whole("paper"),
}


def edges_of(pixels: Array) -> Array:
    """Where the disparity has a step, (H, W) uint8; unknown pixels count as infinitely far."""
    window, known = np.ones((3, 3)), np.nan_to_num(pixels)
    return np.uint8(cv2.dilate(known, window) - cv2.erode(known, window) > EDGE_STEP)


def near_edges(truth: Array) -> Array:
    """Where a step of the true disparity is near, (H, W) bool."""
    return np.asarray(cv2.dilate(edges_of(truth), np.ones((2 * EDGE_REACH + 1,) * 2, np.uint8)) > 0)


def measure(cases: list[Case]) -> dict[str, Array]:
    """Mean errors of every step and variant, and bad-1 near edges and away from them, of what both cameras see."""
    rows: dict[str, list[Array]] = {}
    for case in cases:
        streams = stereo_part("accurate", case.frame, case.disparities, entry="rectified")
        edges = near_edges(case.truth)
        for name, chain in {**STEPS, **VARIANTS}.items():
            pixels = chain(streams, case).pixels
            parts = []
            for area in (edges, ~edges):
                truth = np.where(area & (case.mask == 255), case.truth, np.float32(np.nan))
                parts.append(errors(pixels, truth, case.mask, case.disparities)[1])
            rows.setdefault(name, []).append(np.append(errors(pixels, case.truth, case.mask, case.disparities), parts))
    return {name: np.mean(values, axis=0) for name, values in rows.items()}


def print_fills(cases: list[Case]) -> None:
    """Print how often filled pixels of `accurate` are off by over 1 px, of what both cameras see, and of the rest."""
    shares = []
    for case in cases:
        disparity = stereo_part("accurate", case.frame, case.disparities, entry="rectified")["disparity"]
        filled = (disparity.source == PixelOrigin.FILLED) & np.isfinite(case.truth)
        filled[:, : case.disparities] = False
        wrong, seen = np.abs(disparity.pixels - case.truth) > 1, case.mask == 255
        shares.append([100 * wrong[filled & area].mean() for area in (seen, ~seen)])
    both, one = np.nanmean(shares, axis=0)
    print(f"\nfilled by accurate, off by over 1 px: {both:.0f} % of what both cameras see, {one:.0f} % of the rest")


def print_skies(cases: list[Case]) -> None:
    """Print the shares of the sky and of the ground seen by both cameras that `accurate` calls measured, and the same
    without the limits of correlation and sigma."""
    shares: dict[str, list[tuple[float, float]]] = {}
    for case in cases:
        streams = stereo_part("accurate", case.frame, case.disparities, entry="rectified")
        for name, chain in (
            ("with", refined("disparity/second_checked")),
            ("without", refined("disparity/second_checked", min_correlation=0.0, max_sigma=1e3)),
        ):
            measured = chain(streams, case).source == PixelOrigin.MEASURED
            known = np.isfinite(case.truth) & (case.mask == 255)
            shares.setdefault(name, []).append((measured[case.mask == 0].mean(), measured[known].mean()))
    (sky, ground), (sky_else, ground_else) = (100 * np.mean(values, axis=0) for values in shares.values())
    print(f"measured: {sky:.1f} % of the sky, {ground:.1f} % of the ground; without the limits of correlation and")
    print(f"sigma {sky_else:.1f} % and {ground_else:.1f} %")


def print_worth(cases: list[Case]) -> None:
    """Print what share of the pixels of an origin is right within 1 px, beside the confidence stated."""
    origins: dict[str, Callable[[Disparity], Array]] = {
        f"measured, {low} to {high}": lambda found, low=low, high=high: (
            (found.source == PixelOrigin.MEASURED) & (found.confidence >= low) & (found.confidence < high)
        )
        for low, high in pairwise((0.6, 0.8, 0.9, 0.95, 1.01))
    }
    for name in ("replaced", "plane", "mismatch", "occlusion"):
        value = np.float32(getattr(TRUST, name))
        origins[name] = lambda found, value=value: found.confidence == value
    assert len({*TRUST[3:]}) == 4, "origins of equal confidence cannot be distinguished"
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for case in cases:
        found = stereo_part("accurate", case.frame, case.disparities, entry="rectified")["disparity"]
        scored = np.isfinite(case.truth) & np.isfinite(found.pixels)
        scored[:, : case.disparities] = False
        right = np.abs(found.pixels - case.truth) <= 1
        for name, origin in origins.items():
            here = scored & origin(found)
            rows.setdefault(name, []).append(
                (here.sum() / scored.sum(), found.confidence[here].mean(), right[here].mean())
            )
    print(f"\n{'origin, and confidence stated':32} share %  stated  right within 1 px")
    for name, values in rows.items():
        share, stated, true = np.nanmean(values, axis=0)
        print(f"{name:32} {100 * share:7.1f} {stated:7.2f} {true:18.2f}")


def print_sigmas(cases: list[Case]) -> None:
    """Print the shares of the measured disparities of what both cameras see within one and two stated sigmas."""
    for pipeline in ("rover", "fast", "accurate"):
        shares = []
        for case in cases:
            found = stereo_part(pipeline, case.frame, case.disparities, entry="rectified")["disparity"]
            assert found.sigma is not None
            scored = (found.source == PixelOrigin.MEASURED) & np.isfinite(case.truth) & (case.mask == 255)
            off = np.abs(found.pixels - case.truth)[scored] / found.sigma[scored]
            shares.append([100 * np.mean(off <= sigmas) for sigmas in (1, 2)])
        one, two = np.mean(shares, axis=0)
        print(f"measured by {pipeline}: {one:.0f} % within one stated sigma, {two:.0f} % within two")


def print_table(title: str, means: dict[str, Array], released: Array | None) -> None:
    """Print the errors in percent (RMS in px); with `released` also their ratios to the released code's."""
    print(f"\n{title:34} {COLUMNS}  known %  bad-1 at edges  elsewhere")
    for name, mean in means.items():
        print(f"{name:34}{row('', mean[:8])[12:]} {mean[8]:15.2f} {mean[9]:10.2f}")
    if released is not None:
        print(f"\n{'over the released code':34} {COLUMNS}")
        for name, mean in means.items():
            print(f"{name:34}{row('', mean[:7] / released, 3)[12:]}")


def pictures(folder: Path, name: str, frame: StereoFrame, disparity: Disparity) -> None:
    """Write image, disparity, source and confidence side by side, and disparity edges on the image, as JPEG."""
    folder.mkdir(parents=True, exist_ok=True)
    image = frame.left if frame.left.ndim == 3 else np.dstack([frame.left] * 3)
    known = np.isfinite(disparity.pixels)
    coloured = colormaps.disparity_colors(disparity.pixels)
    origin = colormaps.legend_colors(np.where(known, disparity.source, PixelOrigin.UNKNOWN), colormaps.SOURCE_LEGEND)
    trust = np.dstack([(disparity.confidence * 255).astype(np.uint8)] * 3)
    overlay = image.copy()
    overlay[known & (edges_of(disparity.pixels) > 0)] = (255, 40, 40)
    rows = [np.hstack([image, coloured]), np.hstack([origin, trust])]
    for suffix, picture in (("", np.vstack(rows)), ("-edges", overlay)):
        file = folder / f"{name}{suffix}.jpg"
        cv2.imwrite(str(file), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


def print_scatter(name: str, frame: StereoFrame, found: dict[str, Disparity]) -> None:
    """Print how far measured disparities are off robust planes over 25x25 px (1.48 MAD, px), by contrast."""
    gray = cv2.cvtColor(frame.left, cv2.COLOR_RGB2GRAY).astype(np.float32)
    detail = np.square(gray - cv2.GaussianBlur(gray, (0, 0), 3))
    contrast = np.sqrt(cv2.GaussianBlur(detail, (0, 0), 8))
    rows, cols = (places.ravel() for places in np.mgrid[:PLANE, :PLANE])
    terms = np.stack([cols, rows, np.ones_like(cols)], axis=1).astype(np.float64)
    for way, disparity in found.items():
        measured = np.where(disparity.source == PixelOrigin.MEASURED, disparity.pixels, np.nan)
        scatter: list[list[float]] = [[] for _ in CONTRASTS]
        for y, x in np.ndindex(*((extent - PLANE) // STEP for extent in measured.shape)):
            window = measured[y * STEP : y * STEP + PLANE, x * STEP : x * STEP + PLANE].ravel()
            used = np.isfinite(window)
            for _ in range(3):
                if used.sum() < 0.5 * window.size:
                    break
                off = np.abs(window - terms @ np.linalg.lstsq(terms[used], window[used])[0])
                deviation = 1.4826 * np.median(off[used])
                used = off <= 2.5 * deviation
            else:
                level = contrast[y * STEP + PLANE // 2, x * STEP + PLANE // 2]
                scatter[int(np.searchsorted(CONTRASTS, level, side="right")) - 1].append(float(deviation))
        figures = ", ".join(f"{np.median(values):.3f}" for values in scatter)
        print(f"{name}, {way}: scatter about planes, px, at a contrast from {CONTRASTS} gray levels: {figures}")


def main(folder: Path) -> None:
    """Print the tables and write the pictures."""
    cv2.setNumThreads(1)
    data = Path(os.environ["ROVERFLOW_DATA"]) if "ROVERFLOW_DATA" in os.environ else None
    if data is not None:
        cases = list(real(data / "middlebury-q"))
        released = np.mean([RELEASED[case.name] for case in cases], axis=0)
        print_table("Middlebury scenes", measure(cases), released)
        print_fills(cases)
        print_worth(cases)
        print_sigmas(cases)
        for name, frame in devon(data):
            ways = {
                "without support": stereo_part("accurate", frame, 192, changes={"support": False})["disparity"],
                "accurate": stereo_part("accurate", frame, 192)["disparity"],
            }
            print_scatter(name, frame, ways)
            pictures(folder, name, frame, ways["accurate"])
    cases = list(simulated())
    print_table("simulated frames", measure(cases), None)
    print_fills(cases)
    print_skies(cases)
    print_worth(cases)
    print_sigmas(cases)
    for case in cases:
        streams = stereo_part("accurate", case.frame, case.disparities, entry="rectified")
        pictures(folder, case.name.replace(" ", "-"), case.frame, streams["disparity"])
    legend = "unknown dark, measured green, plane blue, filled orange"
    print(f"\npictures in {folder}: image, disparity; {legend}; confidence; edges of disparity on the image")


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m tests.study", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("demo/study"), help="of the pictures (demo/study)")
    main(parser.parse_args().folder)
