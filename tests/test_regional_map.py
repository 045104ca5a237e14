"""The regional map from the command line: computed with any pose, and exported as a whole."""

import cv2
import numpy as np
import pytest
import rasterio

from recordings.mcap.file import iter_decoded
from recordings.ros2 import from_msg as ros2
from stages.data import Cell, CellReason
from tests.bench.regional import RUNS, region, shares_within, traverse_of
from tests.conftest import FRAMES
from tests.test_command_line import messages_of

REGIONAL = {"/nav/regional_map", "/nav/regional_navigation_map"}


def test_the_log_has_the_first_and_the_last_regional_map_around_the_rover(result):
    maps = {topic: messages_of(result, topic) for topic in REGIONAL}
    stamps = {topic: [stamp for _, stamp, _ in iter_decoded(result, [topic])] for topic in (*REGIONAL, "/nav/pose")}
    written = stamps["/nav/regional_map"]
    assert (written[0], written[-1]) == (stamps["/nav/pose"][0], stamps["/nav/pose"][-1])
    assert stamps["/nav/regional_navigation_map"] == written
    assert len(written) < FRAMES
    assert {message.header.frame_id for messages in maps.values() for message in messages} == {"odom"}
    terrain = ros2.read_grid_map(maps["/nav/regional_map"][-1])
    assert terrain.layers["frames"].max() == FRAMES
    cells = ros2.read_occupancy_grid(maps["/nav/regional_navigation_map"][-1])
    assert (cells.cells.shape, cells.origin) == (terrain.shape, pytest.approx(terrain.origin))
    assert np.count_nonzero(cells.cells == 0) > 2000


@pytest.mark.parametrize("stream", ["navigation_map", "regional_navigation_map"])
def test_a_result_log_contains_the_reason_of_every_cell(result, stream):
    grids, reasons = (messages_of(result, topic) for topic in (f"/nav/{stream}", f"/nav/{stream}/reason"))
    assert 2 <= len(grids) == len(reasons) <= FRAMES
    expected = {
        Cell.FREE: {CellReason.CLEAR},
        Cell.UNKNOWN: {CellReason.UNOBSERVED, CellReason.OCCLUDED, CellReason.UNSURE, CellReason.UNMATCHED},
    }
    expected[Cell.HAZARD] = set(CellReason) - expected[Cell.FREE] - expected[Cell.UNKNOWN] - {CellReason.ELEVATION}
    for grid, reason in zip(grids, reasons, strict=True):
        navigation = ros2.read_occupancy_grid(grid, reason)
        assert reason.info.pose.position.x == pytest.approx(navigation.origin[0] + reason.info.length_x / 2)
        for state, reasons_of_state in expected.items():
            assert set(np.unique(navigation.reason[navigation.cells == state]).tolist()) <= {*reasons_of_state}
        assert CellReason.STEP in navigation.reason


def test_the_regional_map_of_a_traverse_is_exported(result, tmp_path, said):
    printed = said(0, "export", result, tmp_path / "maps").out
    files = sorted(path.name for path in (tmp_path / "maps").iterdir())
    assert f"{tmp_path / 'maps'}: {len(files)} files" in printed
    assert {"elevation.tif", "hillshade.png", "navigation_map.pgm", "navigation_map.yaml", "points.ply"} <= set(files)
    with rasterio.open(tmp_path / "maps" / "frames.tif") as file:
        assert file.read(1).max() == FRAMES
    with rasterio.open(tmp_path / "maps" / "elevation.tif") as file:
        known = np.isfinite(file.read(1)).sum()
        assert file.shape == cv2.imread(str(tmp_path / "maps" / "navigation_map.pgm"), cv2.IMREAD_UNCHANGED).shape
    grids = map(ros2.read_grid_map, messages_of(result, "/nav/elevation_map"))
    own = [np.isfinite(grid.layers["elevation"]).sum() for grid in grids]
    assert max(own) < known < sum(own)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_neighbouring_frames_join_within_their_stated_sigmas(tmp_path):
    regions = []
    for seed, abundance in RUNS:
        (tmp_path / str(seed)).mkdir()
        regions.append(region(traverse_of(seed, abundance), tmp_path / str(seed)))
    for found in regions:
        placed, fused = found.seams.T
        assert fused.max() <= 0.02
        assert np.median(fused) < 0.6 * np.median(placed)
    one, two = shares_within(regions)
    assert 0.61 <= one <= 0.75
    assert 0.91 <= two <= 0.99


@pytest.mark.parametrize(
    ("where", "words"),
    [("file", "is a file; give the name of a folder"), ("gone", "cannot read"), ("", "is not empty")],
)
def test_an_impossible_export_is_refused_in_one_sentence(result, tmp_path, where, words, refused):
    (tmp_path / "file").write_text("mine")
    log = tmp_path / "gone.mcap" if where == "gone" else result
    assert words in refused("export", log, tmp_path / where if where != "gone" else tmp_path / "maps")
    assert (tmp_path / "file").read_text() == "mine"
