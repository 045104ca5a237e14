"""The pictures of docs/terrain.md, and those of real images in other pages: `make pictures` draws them.

terrain.jpg: for three frames the left image, the elevation, the reasons of the navigation map, and the truth in the
visible cells. region.jpg: the regional map of a traverse and its navigation map. Both are of simulated traverses.
devon.jpg and euroc.jpg, if ROVERFLOW_DATA is set: disparity, source and shaded disparities of each Devon Island pair,
and the depth of a frame of EuRoC. The images themselves may not be reprinted.
"""

import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import tifffile
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from flow.cli.main import main as roverflow
from flow.errors import COMPLETE, INCOMPLETE
from recordings.simulator import Simulation
from recordings.sinks import colormaps
from stages.data import Array, Cell, CellReason, ElevationMap
from tests.bench.refining import DISPARITIES, stage, stereo_part
from tests.bench.stereo_scores import devon
from tests.bench.terrain import frames, measured_tilt, through

VIEWS = ((11, 0.05, 15), (12, 0.15, 0), (13, 0.15, 15))  # seed, rocks k, frame of 30: the first or the middle one
SHOWN = (
    CellReason.CLEAR,
    CellReason.STEP,
    CellReason.BESIDE,
    CellReason.SLOPE,
    CellReason.OCCLUDED,
    CellReason.UNMATCHED,
    CellReason.UNSURE,
    CellReason.UNOBSERVED,
)
WIDTH, HEIGHT = 440, 330  # px of each panel
TRAVERSE = ("--frames", "40", "--seed", "12", "--rocks", "0.1")
ZOOM = 2
NEAREST = 1.0  # m
INK = (225, 225, 225)


def main(folder: Path) -> None:
    """Draw them into a folder."""
    cv2.setNumThreads(1)
    _write(folder / "terrain.jpg", terrain_picture())
    _write(folder / "region.jpg", region_picture())
    if "ROVERFLOW_DATA" in os.environ:
        data = Path(os.environ["ROVERFLOW_DATA"])
        _write(folder / "devon.jpg", devon_picture(data))
        _write(folder / "euroc.jpg", euroc_picture(data))


def terrain_picture() -> Array:
    """A row of panels for each of `VIEWS`, and the legend of the reasons, RGB."""
    rows = []
    for seed, abundance, number in VIEWS:
        simulation = Simulation(
            frames=30, seed=seed, abundance=abundance, slope=np.radians(5), tilt_noise=np.radians(0.3)
        )
        *_, (given, _, ground) = frames(simulation, number or simulation.frames)
        stamp = given["stereo"].stamp
        streams, _ = through("rover", given | {"tilt": measured_tilt("rover", simulation, stamp)})
        terrain, navigation = streams["elevation_map"], streams["navigation_map"]
        detected = colormaps.legend_colors(navigation.reason, colormaps.REASON_LEGEND)
        true = colormaps.legend_colors(
            np.select([~ground.seen, ground.rock >= 0.2, ground.hazard],
                      [CellReason.UNOBSERVED, CellReason.STEP, CellReason.SLOPE], CellReason.CLEAR),
            colormaps.REASON_LEGEND,
        )  # fmt: skip
        maps = [_ahead(grid, terrain) for grid in (colormaps.elevation_colors(terrain), detected, true)]
        rows.append(np.hstack([cv2.resize(given["stereo"].left, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), *maps]))
    return np.vstack([*rows, _legend(rows[0].shape[1])])


def region_picture() -> Array:
    """The exported regional map and navigation map of a traverse, side by side, RGB."""
    with tempfile.TemporaryDirectory() as place:
        traverse, result, maps = (Path(place) / name for name in ("log.mcap", "out.mcap", "maps"))
        for command in (("simulate", traverse, *TRAVERSE), ("run", traverse, "-o", result, "--no-rrd"),
                        ("export", result, maps)):  # fmt: skip
            _run(*command)
        elevation = tifffile.imread(maps / "elevation.tif")
        gray = cv2.imread(str(maps / "navigation_map.pgm"), cv2.IMREAD_UNCHANGED)
    terrain = ElevationMap(0, {"elevation": elevation[::-1].copy()}, 0.05, (0.0, 0.0), "odom")
    cells = np.select([gray == 254, gray == 0], [Cell.FREE, Cell.HAZARD], Cell.UNKNOWN).astype(np.int8)
    painted = np.hstack(
        [colormaps.elevation_colors(terrain)[::-1], colormaps.legend_colors(cells, colormaps.CELL_LEGEND)]
    )
    framed = cv2.copyMakeBorder(painted, 8, 8, 8, 8, cv2.BORDER_CONSTANT, value=colormaps.UNKNOWN_RGB)
    return framed.repeat(ZOOM, 0).repeat(ZOOM, 1)


def devon_picture(data: Path) -> Array:
    """Disparity and source of the Devon Island pairs, and shaded disparities without and with support, RGB.

    Two rows for each pair in a folder of real data.
    """
    rows = []
    for _, frame in devon(data):
        streams = stereo_part("rover", frame, DISPARITIES, threads=2, entry="rectified")
        disparity = streams["disparity"]
        plain = replace(stage("rover", "disparity"), support=False)(frame, streams["disparity/full"])
        known = np.where(np.isfinite(disparity.pixels)[..., None], colormaps.disparity_colors(disparity.pixels), 0)
        origin = colormaps.legend_colors(disparity.source, colormaps.SOURCE_LEGEND)
        for pictures in ((known.astype(np.uint8), origin), (_shaded(plain.pixels), _shaded(disparity.pixels))):
            rows.append(
                np.hstack(
                    [cv2.resize(picture, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA) for picture in pictures]
                )
            )
    return np.vstack(rows)


def euroc_picture(data: Path) -> Array:
    """Depth of the first frame of the EuRoC sequence, read from the result log as viewers do, RGB.

    Colours are by inverse depth, from `NEAREST`, red, to infinity, blue. Unknown pixels are gray.
    """
    with tempfile.TemporaryDirectory() as place:
        log, result = (Path(place) / name for name in ("log.mcap", "out.mcap"))
        _run("import", "euroc", data / "euroc", log)
        _run("run", log, "-o", result, "--every", 20, "--no-rrd", "--set", "McapSink.viewers=true")
        with result.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            *_, message = next(reader.iter_decoded_messages(["/nav/disparity/depth/image_rect"]))
    depth = np.frombuffer(message.data, np.float32).reshape(message.height, message.width)
    return colormaps.apply_palette(NEAREST / depth, 0, 1, cv2.COLORMAP_TURBO)


def _run(*command: object) -> None:
    """Run roverflow; a fault of the log is no reason to stop."""
    if roverflow([str(word) for word in command]) not in (COMPLETE, INCOMPLETE):
        raise RuntimeError(f"roverflow {command[0]} failed")


def _shaded(pixels: Array) -> Array:
    """A disparity image lit from the left: mid-gray where it is constant along the row, black where it is unknown."""
    slope = cv2.Sobel(pixels, cv2.CV_32F, 1, 0, scale=1 / 8)
    gray = np.where(np.isfinite(slope), np.clip(128 + 400 * slope, 1, 255), 0).astype(np.uint8)
    return np.dstack([gray] * 3)


def _ahead(painted: Array, terrain: ElevationMap) -> Array:
    """A coloured grid ahead of the rover, from above, in a panel."""
    behind = round(-terrain.origin[0] / terrain.resolution)
    view = colormaps.birds_eye(painted[:, behind:])
    scale = HEIGHT / view.shape[0]
    view = cv2.resize(view, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    left = (view.shape[1] - WIDTH) // 2
    return np.ascontiguousarray(view[:, left : left + WIDTH])


def _legend(width: int) -> Array:
    line = np.full((40, width, 3), colormaps.UNKNOWN_RGB, np.uint8)
    for place, reason in enumerate(SHOWN):
        name, rgb = colormaps.REASON_LEGEND[reason]
        x = 16 + place * (width // len(SHOWN))
        cv2.rectangle(line, (x, 10), (x + 20, 30), rgb, cv2.FILLED)
        cv2.rectangle(line, (x, 10), (x + 20, 30), INK, 1)
        cv2.putText(line, name, (x + 30, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.55, INK, 1, cv2.LINE_AA)
    return line


def _write(file: Path, picture: Array) -> None:
    cv2.imwrite(str(file), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs"))
