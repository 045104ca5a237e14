"""Regional maps of several logs as one: the mean, its logs, and logs that do not fit."""

import json
import os
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image

from recordings.errors import LogError
from recordings.export.bundle import export
from recordings.export.merge import merge
from recordings.mcap.writer import Ros2Writer
from recordings.ros2 import to_msg as ros2
from recordings.simulator import Simulation, write_log
from stages.data import Cell, ElevationMap, NavigationMap
from tests.conftest import chunks_of, edit_of, rewrite, roverflow, with_broken, write_messages

STEP, SHAPE = 0.1, (50, 60)
SOUTH = "s\\udcfcd_{}.mcap"  # the name of a file as results contain it, which is not Unicode


def traverse(
    path: Path, first_col: int, height: float, variance: float, hazard_col: int, frame: str = "map", stamp: int = 5,
    **about: str,
) -> Path:  # fmt: skip
    """A result log with a sloping map of SHAPE that begins at a column; one column of it is hazardous."""
    cols = first_col + np.arange(SHAPE[1])
    elevation = np.tile(np.float32(height + 0.01 * cols), (SHAPE[0], 1))
    layers = {"elevation": elevation, "variance": np.full(SHAPE, variance, np.float32)}
    cells = np.where(np.tile(cols, (SHAPE[0], 1)) == hazard_col, Cell.HAZARD, Cell.FREE).astype(np.int8)
    origin = (first_col * STEP, -2.0)
    with Ros2Writer(path) as writer:
        writer.metadata("roverflow", about)
        writer.write("/nav/diagnostics", ros2.diagnostics(stamp, []), stamp)
        writer.write("/nav/regional_map", ros2.grid_map(ElevationMap(stamp, layers, STEP, origin, frame)), stamp)
        writer.flush()  # a broken second chunk leaves the heights
        navigation = NavigationMap(stamp, cells, np.zeros(SHAPE, np.uint8), STEP, origin, frame)
        writer.write("/nav/regional_navigation_map", ros2.occupancy_grid(navigation), stamp)
    return path


def layer(folder: Path, name: str) -> np.ndarray:
    with rasterio.open(folder / f"{name}.tif") as file:
        return file.read(1)


def test_a_merged_cell_is_the_inverse_variance_mean_of_its_logs(tmp_path):
    a = traverse(tmp_path / "a.mcap", 0, 1.0, 4e-4, hazard_col=10)
    b = traverse(tmp_path / "b.mcap", 40, 1.03, 1e-4, hazard_col=45)
    c = traverse(tmp_path / "c.mcap", 200, 1.0, 1e-4, hazard_col=-1)
    merged = merge([a, b, c], tmp_path / "out")
    assert merged.cells == [3000] * 3
    assert [sentence for _, sentence in merged.sentences()] == ["c.mcap has no cell in common with another log"]
    elevation, best, logs = (layer(tmp_path / "out", name) for name in ("elevation", "best_log", "logs"))
    cols = np.arange(260)
    mean = 0.01 * cols + np.select([cols < 40, cols < 60, cols < 100], [1, (1 + 4 * 1.03) / 5, 1.03], 1)
    mean[100:200] = np.nan
    assert elevation.shape == (50, 260)
    assert np.allclose(elevation[0], mean, atol=1e-5, equal_nan=True)
    assert np.allclose(layer(tmp_path / "out", "variance")[7, [5, 50, 70]], [4e-4, 8e-5, 1e-4])
    assert logs[3, [5, 50, 70]].tolist() == [1, 2, 1]
    assert best[3, [5, 50, 70, 230]].tolist() == [1, 2, 2, 3]
    pgm = np.asarray(Image.open(tmp_path / "out/navigation_map.pgm"))
    assert pgm[9, [10, 45, 46, 150]].tolist() == [0, 0, 254, 205]  # hazard, hazard, free, unknown


def test_logs_that_differ_by_more_than_their_sigmas_are_reported(tmp_path, said):
    a = traverse(tmp_path / "a.mcap", 0, 1.0, 4e-4, hazard_col=-1)
    b = traverse(tmp_path / "b.mcap", 40, 1.2, 1e-4, hazard_col=-1)
    text = said(3, "export", a, b, tmp_path / "out", "--merge").out
    assert "WARNING: a.mcap and b.mcap conflict in 1000 of 1000 common cells: second minus first is +0.200 m" in text
    for site in ("one", "two"):
        (tmp_path / site).mkdir()
    first, second = a.rename(tmp_path / "one/sol.mcap"), b.rename(tmp_path / "two/sol.mcap")
    text = said(3, "export", first, second, tmp_path / "again", "--merge").out
    assert "WARNING: one/sol.mcap and two/sol.mcap conflict in 1000 of" in text
    (pair,) = json.loads((tmp_path / "out/merge.json").read_text())["overlaps"]
    assert (pair["logs"], pair["common_cells"], pair["conflicts"]) == ([1, 2], 1000, 1000)
    assert pair["mean_difference_m"] == pytest.approx(0.2, abs=1e-5)
    assert 4.0 < pair["largest_conflict_at_m"][0] < 6.0
    assert layer(tmp_path / "out", "variance")[0, 50] == pytest.approx(8e-5 + 0.2 * 0.8 * 0.2**2, rel=1e-3)
    assert layer(tmp_path / "out", "conflicts")[0, [30, 50]].tolist() == [0, 1]
    assert np.asarray(Image.open(tmp_path / "out/navigation_map.pgm"))[9, 50] == 205  # no longer free


def test_maps_that_cannot_be_merged_are_refused_in_a_sentence(tmp_path, refused, said):
    a = traverse(tmp_path / "a.mcap", 0, 1.0, 4e-4, hazard_col=-1)
    other = traverse(tmp_path / "other.mcap", 0, 1.0, 4e-4, hazard_col=-1, frame="odom")
    with pytest.raises(LogError, match=r"other\.mcap has its map in 'odom' with cells of 0\.1 m, .*a\.mcap in 'map'"):
        merge([a, other], tmp_path / "out")
    with pytest.raises(LogError, match=r"a\.mcap and .*a\.mcap are results of the same input, which would count twice"):
        merge([a, tmp_path / "x" / ".." / "a.mcap"], tmp_path / "out")
    far = traverse(tmp_path / "far.mcap", 50_000_000, 1.0, 4e-4, hazard_col=-1)
    with pytest.raises(LogError, match=r"too large .* are the poses of .*a\.mcap and .*far\.mcap in one frame of ref"):
        merge([a, far], tmp_path / "out")
    frame = ElevationMap(5, {"elevation": np.ones((2, 2), np.float32)}, STEP, (0.0, 0.0), "level")
    own = write_messages(tmp_path / "own.mcap", [(5, "/nav/elevation_map", ros2.grid_map(frame))])
    with pytest.raises(LogError, match=r"own\.mcap contains no /nav/regional_map, .*; leave it out$"):
        merge([a, own], tmp_path / "out")
    broken = with_broken(a, chunks_of(a)[1][0])
    assert f"WARNING: {broken}: the chunk at byte" in said(3, "export", a, broken, tmp_path / "m", "--merge").out
    assert "add --merge to merge the maps of several logs" in refused("export", a, other, tmp_path / "out")
    assert "has no catalogue.sqlite" in refused("export", tmp_path, tmp_path / "out", "--merge")


@pytest.mark.parametrize(("part", "refused"), [(("", ""), True), (("19.5", ""), True), (("20.0", ""), False)])
def test_results_with_a_common_part_of_an_input_are_refused(tmp_path, part, refused):
    first = traverse(tmp_path / "a.mcap", 0, 1.0, 4e-4, -1, log_digest="d", start="", end="20.0")
    other = traverse(tmp_path / "b.mcap", 0, 1.0, 4e-4, -1, log_digest="d", start=part[0], end=part[1])
    with pytest.raises(LogError, match="results of the same input") if refused else nullcontext():
        merge([first, other], tmp_path / "out")


@pytest.mark.parametrize(("log", "stamp", "refused"), [
    (f"{SOUTH}, {SOUTH}".format(0, 1), 5, True), ("drive", 5, True), (f"{SOUTH}, {SOUTH}".format(0, 1), 6, False),
    (f"{SOUTH}, {SOUTH}".format(1, 2), 5, False), (SOUTH.format(0), 5, False),
])  # fmt: skip
def test_results_with_a_common_file_of_their_inputs_are_refused(tmp_path, log, stamp, refused):
    folder = tmp_path / "drive"
    folder.mkdir()
    for number in range(2):
        file = folder / os.fsdecode(b"s\xfcd_%d.mcap" % number)
        write_messages(file, [(5, "/nav/diagnostics", ros2.diagnostics(5, []))])
    first = traverse(tmp_path / "a.mcap", 0, 1.0, 4e-4, -1, log=SOUTH.format(0), log_digest="a")
    other = traverse(tmp_path / "b.mcap", 0, 1.0, 4e-4, -1, stamp=stamp, log=log, log_digest="b")
    with pytest.raises(LogError, match="results of the same input") if refused else nullcontext():
        merge([first, other], tmp_path / "out")


@pytest.mark.slow
def test_two_drives_over_the_same_ground_fit_and_a_raised_pose_does_not(tmp_path):
    drives = {"a": {}, "b": {"pitch_down": 0.35, "camera_height": 1.1, "speed": 0.4}}
    for name, changes in drives.items():
        write_log(Simulation(frames=8, width=320, height=240, seed=3, **changes), tmp_path / f"{name}.mcap")

    def raised(_: int, message: Any) -> None:
        message.pose.pose.position.z += 0.2

    rewrite(tmp_path / "b.mcap", tmp_path / "c.mcap", edit_of("/odometry", "nav_msgs/msg/Odometry", raised))
    results = [tmp_path / f"{name}-nav.mcap" for name in "abc"]
    for result in results:
        log = tmp_path / result.name.replace("-nav", "")
        assert roverflow("run", log, "-p", "rover", "--no-rrd", "-o", result) == 0
    merged = merge(results, tmp_path / "out")
    fits, raises = merged.overlaps[1, 2], merged.overlaps[1, 3]
    assert fits.cells > 10_000
    assert fits.conflicts < 0.05 * fits.cells
    assert raises.conflicts > 0.8 * raises.cells
    assert raises.mean == pytest.approx(0.2, abs=0.02)
    assert [fault for fault, _ in merged.sentences()] == [False, True, True]
    merge(results[:2], tmp_path / "both")
    with rasterio.open(tmp_path / "both/logs.tif") as file:
        rows, cols = np.nonzero(file.read(1) == 2)
        places = np.column_stack(file.xy(rows, cols))
    assert len(places) == fits.cells
    parts = []
    for result in results[:2]:
        export(result, tmp_path / result.stem)
        parts.append([sampled(tmp_path / result.stem, name, places) for name in ("elevation", "variance")])
    (height, variance), (other, more) = parts
    mean = (height / variance + other / more) / (1 / variance + 1 / more)
    assert np.allclose(layer(tmp_path / "both", "elevation")[rows, cols], mean, atol=1e-5)


def sampled(folder: Path, name: str, places: np.ndarray) -> np.ndarray:
    with rasterio.open(folder / f"{name}.tif") as file:
        return np.array([value[0] for value in file.sample(places)], np.float64)
