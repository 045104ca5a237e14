"""Exported files, read by the programs they are for: GDAL, the rules of map_server, a PLY reader, PIL."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
import rasterio
import yaml
from PIL import Image

from recordings.errors import LogError
from recordings.export.bundle import export
from recordings.export.map_files import file_names
from recordings.export.mosaic import Mosaic
from recordings.mcap.writer import Ros2Writer
from recordings.ros2 import to_msg as ros2
from recordings.ros2.from_msg import stamp_of
from stages.data import Array, Cell, ElevationMap, NavigationMap, PointCloud, Transform
from tests.conftest import write_messages

START = 1_700_000_000_000_000_000
STEP = 0.1
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # level's x is the region's y
LEVEL = Transform("odom", "level", TURN, np.array([2.0, -1.0, 0.5]))
CORNERS = (-1.0, 1.0), (0.0, 1.0)


def ground(x: Array, y: Array) -> Array:
    """Heights that change with any flip, turn or transposition."""
    return np.float32(0.2 * x - 0.05 * y + 0.01 * x * y)


def window(
    frame: int, corner: tuple[float, float], shape: tuple[int, int], rim: float = 0.0
) -> tuple[ElevationMap, NavigationMap]:
    """A window of the region: free west of x = 2, hazard east of it, unknown in a hole at (1.05, 3.05)."""
    rows, cols = shape
    x, y = np.meshgrid(corner[0] + (np.arange(cols) + 0.5) * STEP, corner[1] + (np.arange(rows) + 0.5) * STEP)
    hole = (np.abs(x - 1.05) < 0.01) & (np.abs(y - 3.05) < 0.01)
    elevation = np.where(hole, np.nan, ground(x, y) + rim).astype(np.float32)
    layers = {
        "elevation": elevation, "variance": np.where(hole, np.nan, 4e-4).astype(np.float32),
        "last": np.full(shape, frame, np.float32),
    }  # fmt: skip
    cells = np.where(hole, Cell.UNKNOWN, np.where(x < 2, Cell.FREE, Cell.HAZARD)).astype(np.int8)
    stamp = START + frame
    return (
        ElevationMap(stamp, layers, STEP, corner, "odom", level=LEVEL),
        NavigationMap(stamp, cells, np.zeros(shape, np.uint8), STEP, corner, "odom"),
    )


def cloud(frame: int) -> PointCloud:
    """Two points in the region's cell of (1.05, 2.05), the surer one green, and one in that of (0.45, 2.05)."""
    places = np.array([[1.05, 2.05, 0.6], [1.06, 2.04, 0.6], [0.45, 2.05, 0.7]])
    level = LEVEL.inverse()(places).astype(np.float32)
    colors = np.array([[200, 10, 20], [10, 220, 30], [7, 8, 250]], np.uint8)
    sigma = np.array([0.3, 0.1, 0.2], np.float32) + 0.01 * frame
    return PointCloud(START + frame, level, colors, sigma, np.arange(3, dtype=np.int32), "level")


def written(path: Path, *messages: tuple[str, Any]) -> Path:
    """A log of messages, each at its own stamp."""
    stamped = [message.transforms[0] if topic == "/tf" else message for topic, message in messages]
    return write_messages(path, [(stamp_of(at.header), *each) for at, each in zip(stamped, messages, strict=True)])


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A result log of two frames: windows of 30 x 40 cells, the second 1 m farther along x; and their own maps."""
    messages = list[tuple[str, Any]]()
    for frame, corner in enumerate(CORNERS):
        terrain, navigation = window(frame, corner, (30, 40))
        own = ElevationMap(terrain.stamp, terrain.layers, STEP, corner, "level")
        grid, placed = ros2.occupancy_grid(navigation), ros2.transform_message([(LEVEL, terrain.stamp)])
        own_grid = ros2.occupancy_grid(replace(navigation, frame_id="level"))
        messages += [
            ("/nav/points", ros2.point_cloud(cloud(frame))), ("/nav/elevation_map", ros2.grid_map(own)),
            ("/nav/navigation_map", own_grid), ("/nav/regional_map", ros2.grid_map(terrain)),
            ("/nav/regional_navigation_map", grid), ("/tf", placed),
        ]  # fmt: skip
    return written(tmp_path / "out.mcap", *messages)


def regional_log(path: Path, *maps: ElevationMap) -> Path:
    """A result log of regional maps."""
    return written(path, *(("/nav/regional_map", ros2.grid_map(terrain)) for terrain in maps))


def points_in(folder: Path) -> Any:
    """The points of an exported file."""
    return plyfile.PlyData.read(str(folder / "points.ply"))["vertex"].data


def test_gdal_reads_every_height_at_its_place_and_no_data_in_the_hole(result, tmp_path):
    export(result, tmp_path / "out")
    with rasterio.open(tmp_path / "out" / "elevation.tif") as file:
        assert file.bounds == pytest.approx((-1.0, 1.0, 4.0, 4.0))
        assert (file.width, file.height, file.count, file.dtypes) == (50, 30, 1, ("float32",))
        assert np.isnan(file.nodata)
        assert file.crs.to_wkt().startswith("LOCAL_CS[\"roverflow: local frame 'odom', metres, z up")
        assert file.tags()["AREA_OR_POINT"] == "Area"
        heights = file.read(1)
        for x, y in [(-0.95, 1.05), (3.95, 1.05), (-0.95, 3.95), (3.95, 3.95), (1.35, 2.85)]:
            row, col = file.index(x, y)
            assert heights[row, col] == pytest.approx(float(ground(x, y)), abs=1e-6)
        assert heights[0, 0] == pytest.approx(float(ground(-0.95, 3.95)), abs=1e-6)  # north-west
        assert [file.xy(row, col) for row, col in np.argwhere(np.isnan(heights))] == [pytest.approx((1.05, 3.05))]


def test_every_layer_is_a_file_and_a_band_and_newer_windows_replace_older_ones(result, tmp_path):
    files = export(result, tmp_path / "out")
    names = {"elevation.tif", "variance.tif", "last.tif", "all-layers.tif", "hillshade.png", "hillshade.pgw",
             "points.ply", "navigation_map.pgm", "navigation_map.yaml"}  # fmt: skip
    assert {file.name for file in files} == names == {file.name for file in (tmp_path / "out").iterdir()}
    with rasterio.open(tmp_path / "out" / "last.tif") as file:
        last = file.read(1)
    np.testing.assert_array_equal(last, np.where(np.arange(50) < 10, 0, 1) * np.ones((30, 1)))
    with rasterio.open(tmp_path / "out" / "all-layers.tif") as file:
        assert (file.descriptions, file.units) == (("elevation", "variance", "last"), ("m", "m^2", "s"))
        meanings = "mean height", "variance of the elevation (of a frame's map: without common_variance)"
        assert (file.tags(1)["MEANING"], file.tags(2)["MEANING"]) == meanings
        for band, name in enumerate(file.descriptions, 1):
            with rasterio.open(tmp_path / "out" / f"{name}.tif") as alone:
                np.testing.assert_array_equal(file.read(band), alone.read(1))
                assert (file.transform, file.crs, alone.units) == (alone.transform, alone.crs, (file.units[band - 1],))


def test_the_rim_of_a_window_does_not_replace_the_middle_of_another(tmp_path):
    windows = [window(frame, (3.0 * frame, 0.0), (60, 60), 9.0 * frame)[0] for frame in range(2)]
    export(regional_log(tmp_path / "out.mcap", *windows), tmp_path)
    with rasterio.open(tmp_path / "elevation.tif") as file:
        heights = file.read(1)
        x = np.array([file.xy(30, col)[0] for col in range(file.width)])
    off = heights[30] - ground(x, file.xy(30, 0)[1])
    np.testing.assert_allclose(off, np.where(x < 4.5, 0.0, 9.0), atol=1e-5)


def as_map_server_reads(yaml_file: Path) -> tuple[Array, float, list[float]]:
    """Trinary mode of nav2_map_server and map_server: row-major from the lower left cell, -1, 0 or 100."""
    about = yaml.safe_load(yaml_file.read_text())
    assert about["mode"] == "trinary"
    gray = np.asarray(Image.open(yaml_file.parent / about["image"])).astype(float)
    occupancy = gray / 255 if about["negate"] else (255 - gray) / 255
    cells = np.full(gray.shape, -1)
    cells[occupancy > about["occupied_thresh"]] = 100
    cells[occupancy < about["free_thresh"]] = 0
    return cells[::-1], about["resolution"], about["origin"]


def test_map_server_reads_free_hazard_and_unknown_at_their_places(result, tmp_path):
    export(result, tmp_path / "out")
    cells, resolution, origin = as_map_server_reads(tmp_path / "out" / "navigation_map.yaml")
    assert (resolution, origin) == (STEP, pytest.approx([-1.0, 1.0, 0.0]))
    x = origin[0] + (np.arange(cells.shape[1]) + 0.5) * resolution
    expected = np.where(x < 2, 0, 100) * np.ones((30, 1), int)
    expected[round((3.05 - origin[1]) / STEP - 0.5), round((1.05 - origin[0]) / STEP - 0.5)] = -1
    np.testing.assert_array_equal(cells, expected)


def test_each_cell_in_the_ply_has_the_colour_of_its_best_point(result, tmp_path):
    export(result, tmp_path / "out")
    assert "local frame 'odom'" in plyfile.PlyData.read(str(tmp_path / "out" / "points.ply")).comments[0]
    points = points_in(tmp_path / "out")
    assert len(points) == 30 * 50 - 1
    np.testing.assert_allclose(points["z"], ground(points["x"], points["y"]), atol=1e-6)
    np.testing.assert_allclose(points["sigma"], 0.02, rtol=1e-5)
    rows = zip(*(points[name].tolist() for name in ("x", "y", "red", "green", "blue")), strict=True)
    for x, y, *colour in rows:  # that of the nearest cell with a point
        near, far = np.hypot(x - 1.05, y - 2.05), np.hypot(x - 0.45, y - 2.05)
        assert abs(near - far) < 1e-5 or colour == ([10, 220, 30] if near < far else [7, 8, 250])


def test_the_parts_of_a_map_that_was_reset_have_a_folder_and_an_epoch_each(tmp_path):
    messages = list[tuple[int, str, Any]]()
    for frame, epoch in enumerate((START, START, START + 2, START + 2)):
        terrain, navigation = window(frame, CORNERS[frame % 2], (30, 40), rim=0.6 * (frame > 1))
        about = 0, "regional_map", "", {"epoch": str(epoch)}
        for topic, message in (
            ("/nav/regional_map", ros2.grid_map(terrain)),
            ("/nav/regional_navigation_map", ros2.occupancy_grid(navigation)),
            ("/nav/diagnostics", ros2.diagnostics(terrain.stamp, [about])),
            ("/nav/diagnostics", ros2.diagnostics(terrain.stamp, [])),  # as at the end of a run
        ):
            messages.append((terrain.stamp, topic, message))
    path = write_messages(tmp_path / "out.mcap", messages)
    export(path, tmp_path / "out")
    for folder, raised, epoch in (("odom", 0.0, START), ("odom-part-2", 0.6, START + 2)):
        with rasterio.open(tmp_path / "out" / folder / "elevation.tif") as file:
            row, col = file.index(1.35, 2.85)
            assert file.read(1)[row, col] == pytest.approx(float(ground(1.35, 2.85)) + raised, abs=1e-6)
            assert f"first and last count from {epoch} ns" in file.crs.to_wkt()
    export(path, tmp_path / "navigation", maps=["regional_navigation_map"])
    assert {folder.name for folder in (tmp_path / "navigation").iterdir()} == {"odom", "odom-part-2"}


def test_a_map_without_its_epoch_belongs_to_the_part_before_it(tmp_path):
    """Its diagnostics are in a damaged chunk."""
    messages = list[tuple[int, str, Any]]()
    for frame in range(3):
        terrain, _ = window(frame, CORNERS[frame % 2], (30, 40))
        messages.append((terrain.stamp, "/nav/regional_map", ros2.grid_map(terrain)))
        about = [(0, "regional_map", "", {"epoch": str(START)})] if frame == 1 else []
        messages.append((terrain.stamp, "/nav/diagnostics", ros2.diagnostics(terrain.stamp, about)))
    files = export(write_messages(tmp_path / "out.mcap", messages), tmp_path / "out")
    assert {file.parent for file in files} == {tmp_path / "out"}


def test_points_of_the_frame_that_resets_a_map_colour_no_part_of_it(tmp_path):
    """The last map of a part comes with that frame, and `level` is that of the next part."""
    terrain, _ = window(0, CORNERS[0], (30, 40))
    messages = [(START, "/nav/regional_map", ros2.grid_map(terrain))]
    messages.append((START + 1, "/nav/regional_map", ros2.grid_map(terrain)))
    for frame in range(2):
        sent = replace(cloud(frame), colors=np.full((3, 3), 200 - 100 * frame, np.uint8))
        sent = replace(sent, sigma=sent.sigma / (1 + frame))
        messages.append((sent.stamp, "/nav/points", ros2.point_cloud(sent)))
        messages.append((sent.stamp, "/tf", ros2.transform_message([(LEVEL, sent.stamp)])))
    export(write_messages(tmp_path / "out.mcap", messages), tmp_path / "out")
    assert set(points_in(tmp_path / "out")["red"].tolist()) == {200}
    with rasterio.open(tmp_path / "out" / "elevation.tif") as file:
        assert f"up to {START} ns" in file.crs.to_wkt()


def test_maps_of_two_frames_of_reference_are_not_laid_over_each_other(result, tmp_path):
    with pytest.raises(LogError, match=r"in 'level' with cells of 0\.1 m and in 'odom' .*; export one at a time"):
        export(result, tmp_path / "out", maps=["regional_map", "navigation_map"])


def test_a_regional_navigation_map_alone_is_exported(tmp_path):
    _, navigation = window(0, CORNERS[0], (30, 40))
    path = written(tmp_path / "out.mcap", ("/nav/regional_navigation_map", ros2.occupancy_grid(navigation)))
    names = {file.name for file in export(path, tmp_path / "out")}
    assert names == {"navigation_map.pgm", "navigation_map.yaml"}


def test_frames_without_a_regional_map_give_colours_too(tmp_path):
    messages = []
    for frame in range(3):
        sent = cloud(frame).only(np.array([frame]))  # each frame has another point
        if frame != 1:
            messages.append(("/nav/regional_map", ros2.grid_map(window(frame, CORNERS[0], (30, 40))[0])))
        messages.append(("/nav/points", ros2.point_cloud(sent)))
        messages.append(("/tf", ros2.transform_message([(LEVEL, sent.stamp)])))
    export(written(tmp_path / "out.mcap", *messages), tmp_path / "out")
    points = points_in(tmp_path / "out")
    assert (10, 220, 30) in set(zip(points["red"], points["green"], points["blue"], strict=True))


def test_the_hillshade_has_light_from_the_north_west_and_a_world_file(tmp_path):
    x, y = np.meshgrid((np.arange(60) + 0.5) * STEP, (np.arange(40) + 0.5) * STEP)
    mound = np.exp(-((x - 4) ** 2 + (y - 1) ** 2)).astype(np.float32)
    mound[0, 0] = np.nan
    terrain = ElevationMap(START, {"elevation": mound}, STEP, (0.0, 0.0), "odom")
    export(regional_log(tmp_path / "out.mcap", terrain), tmp_path)
    shade = np.asarray(Image.open(tmp_path / "hillshade.png"))
    step_x, _, _, step_y, west, north = (float(line) for line in (tmp_path / "hillshade.pgw").read_text().split())

    def at(px, py):
        return int(shade[round((py - north) / step_y), round((px - west) / step_x)])

    assert at(3.55, 1.45) > at(0.55, 3.55) > at(4.45, 0.55)
    assert shade[-1, 0] == 0  # unknown
    assert shade.min(where=np.isfinite(mound[::-1]), initial=255) >= 1


def test_frames_exports_the_maps_and_points_of_every_frame(result, tmp_path):
    files = export(result, tmp_path / "out", frames=True)
    folders = sorted({file.parent.name for file in files})
    assert folders == [f"frame-{number:04d}-{START + number}" for number in (0, 1)]
    with rasterio.open(tmp_path / "out" / folders[1] / "elevation.tif") as file:
        assert file.bounds == pytest.approx((0.0, 1.0, 4.0, 4.0))
        assert "local frame 'level'" in file.crs.to_wkt()
    points = points_in(tmp_path / "out" / folders[1])
    sent = cloud(1)
    np.testing.assert_array_equal(np.column_stack([points[name] for name in "xyz"]), sent.points)
    np.testing.assert_array_equal(np.column_stack([points[name] for name in ("red", "green", "blue")]), sent.colors)
    np.testing.assert_array_equal(points["sigma"], sent.sigma)
    cells, _, _ = as_map_server_reads(tmp_path / "out" / folders[1] / "navigation_map.yaml")
    assert (np.count_nonzero(cells == 0), np.count_nonzero(cells == 100)) == (30 * 20 - 1, 30 * 20)


def test_a_map_far_from_its_frame_s_origin_keeps_its_place(tmp_path):
    """In a UTM frame float32 would be off by half a metre."""
    corner = (500_000.3, 5_400_000.7)
    layers = {"elevation": np.array([[1, 2], [3, np.nan]], np.float32)}
    export(regional_log(tmp_path / "out.mcap", ElevationMap(START, layers, STEP, corner, "map")), tmp_path)
    points = points_in(tmp_path)
    centres = np.add(corner, [(0.05, 0.05), (0.15, 0.05), (0.05, 0.15)])
    np.testing.assert_allclose(np.column_stack([points["x"], points["y"]]), centres, atol=1e-6)
    assert points["z"].tolist() == [1, 2, 3]
    with rasterio.open(tmp_path / "elevation.tif") as file:
        assert file.bounds == pytest.approx((*corner, corner[0] + 0.2, corner[1] + 0.2), abs=1e-6, rel=0)


@pytest.mark.parametrize("maps", [(), ("regional_navigation_map",)])
def test_cells_whose_size_float32_rounds_keep_their_places(tmp_path, maps):
    """An OccupancyGrid states 0.0333333333 m as 0.033333335 m, 30 cm off at 5000 km."""
    size, first = 0.0333333333, (20_000_000, 150_000_000)
    corner = (first[0] * size, first[1] * size)
    elevation, navigation = (replace(item, resolution=size, origin=corner) for item in window(0, corner, (60, 60)))
    messages = [
        ("/nav/regional_map", ros2.grid_map(elevation)),
        ("/nav/regional_navigation_map", ros2.occupancy_grid(navigation)),
        ("/nav/regional_navigation_map/reason", ros2.reason_map(navigation)),
    ]
    export(written(tmp_path / "out.mcap", *messages), tmp_path / "out", maps=maps)
    _, resolution, origin = as_map_server_reads(tmp_path / "out" / "navigation_map.yaml")
    assert (resolution, origin) == (size, pytest.approx([*corner, 0.0], abs=1e-6, rel=0))


def test_a_log_without_a_regional_map_names_the_remedy(tmp_path):
    path = written(tmp_path / "out.mcap", ("/nav/points", ros2.point_cloud(cloud(0))))
    with pytest.raises(LogError, match=r"no /nav/regional_map, only /nav/points: .* 'results' .* add --frames"):
        export(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (points,) = export(path, tmp_path / "out", frames=True)
    assert points.name == "points.ply"


def test_the_readable_part_of_a_cut_log_is_exported(tmp_path):
    path = tmp_path / "out.mcap"
    with Ros2Writer(path) as writer:
        for frame, corner in enumerate(CORNERS):
            terrain, _ = window(frame, corner, (30, 40))
            writer.write("/nav/regional_map", ros2.grid_map(terrain), terrain.stamp)
            writer.metadata("between", {})  # ends the chunk
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"between") + 60])
    with pytest.raises(LogError, match="truncated or damaged"):
        export(path, tmp_path / "none")
    lost = Counter[str]()
    export(path, tmp_path / "out", lost=lost)
    assert [why.partition(" at byte")[0] for why in lost] == ["the log is truncated or damaged"]
    with rasterio.open(tmp_path / "out" / "elevation.tif") as file:
        assert (file.width, file.height) == (40, 30)
    with pytest.raises(LogError, match=r"truncated or damaged .*; the rest cannot be exported"):
        export(path, tmp_path / "nothing", frames=True, lost=Counter())


@pytest.mark.parametrize("frames", [False, True])
def test_a_log_without_nav_topics_is_refused(tmp_path, frames):
    path = written(tmp_path / "raw.mcap", ("/lidar/points", ros2.point_cloud(cloud(0))))
    with pytest.raises(LogError, match=r"raw\.mcap is not a result log: it has no /nav topics; give the log that "):
        export(path, tmp_path / "out", frames)


def flat(number: int, frame_id: str = "odom", size: float = STEP, place: float = 0.0) -> ElevationMap:
    """A map of 3 x 3 cells, all of the height `number`."""
    layers = {"elevation": np.full((3, 3), number, np.float32)}
    return ElevationMap(START + number, layers, size, (place, place), frame_id)


@pytest.mark.parametrize(("second", "why"), [
    (flat(1, size=2 * STEP), r"the maps of the log differ: elevation at 0\.2 m in 'odom' after"),
    (flat(1, place=50_000.0), r"'odom' is 50000\.3 x 50000\.3 m, .* pose of .*out\.mcap jump\? add --frames"),
])  # fmt: skip
def test_maps_that_fit_no_picture_are_refused_before_they_fill_the_disk(tmp_path, second, why):
    with pytest.raises(LogError, match=why):
        export(regional_log(tmp_path / "out.mcap", flat(0), second), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_regional_map_that_was_reset_has_a_folder_per_frame_id(tmp_path):
    maps = flat(0, "visual_odom"), flat(1, "visual_odom/2")
    export(regional_log(tmp_path / "out.mcap", *maps), tmp_path / "out")
    for number, folder in enumerate(("visual_odom", "visual_odom-2")):
        with rasterio.open(tmp_path / "out" / folder / "elevation.tif") as file:
            assert np.unique(file.read(1)[np.isfinite(file.read(1))]) == [number]


def test_an_unwritable_file_is_named_and_no_partial_file_is_left(result, tmp_path):
    (tmp_path / "out" / "variance.tif").mkdir(parents=True)
    with pytest.raises(LogError, match=r"cannot write .*variance\.tif: it is a folder"):
        export(result, tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.partial"))


def test_an_overview_keeps_the_largest_value_of_each_square_of_cells():
    mosaic = Mosaic(STEP, "odom", {"cells": np.int8(Cell.UNKNOWN)}, rim=0.0)
    cells = np.full((5, 7), Cell.FREE, np.int8)
    cells[3, 5], cells[0, :2], cells[1, :2] = Cell.HAZARD, Cell.UNKNOWN, Cell.UNKNOWN
    grid = NavigationMap(0, cells, np.zeros(cells.shape, np.uint8), STEP, (0.3, -0.2), "odom")
    mosaic.add({"cells": cells}, np.ones(cells.shape, bool), grid)
    assert mosaic.close()
    overview, size = mosaic.overview("cells", 4)
    assert (overview.tolist(), size) == ([[-1, 0, 0, 0], [0, 0, 100, 0], [0, 0, 0, 0]], 2 * STEP)
    assert mosaic.overview("cells", 7)[0].tolist() == cells.tolist()


def test_file_names_stay_in_the_folder_and_are_unique():
    named = file_names(
        ["elevation", "../../etc", "/abs", "..", "", ".", "a/b", "a-b", "A-B", "x" * 300, "nul\0", "höhe", "漢" * 120]
    )
    assert named["elevation"] == "elevation"
    assert named["höhe"] == "höhe"
    assert len({name.casefold() for name in named.values()}) == len(named)
    for name in named.values():
        assert (Path("out") / name).resolve().parent == Path("out").resolve()
        assert 0 < len(name.encode()) < 120
        assert not name.startswith(".")


def test_maps_are_exported_by_the_names_of_their_streams(tmp_path):
    elevation, navigation = window(0, (0.0, 2.0), (20, 30))
    path = written(
        tmp_path / "out.mcap", ("/nav/sparse/map", ros2.grid_map(elevation)),
        ("/nav/sparse/cells", ros2.occupancy_grid(navigation)),
        ("/nav/sparse/cells/reason", ros2.reason_map(navigation)),
        ("/nav/frame_cells", ros2.occupancy_grid(replace(navigation, frame_id="level"))),
    )  # fmt: skip
    both = export(path, tmp_path / "both", maps=["sparse/map", "sparse/cells"])
    assert {"elevation.tif", "hillshade.png", "navigation_map.pgm", "points.ply"} <= {file.name for file in both}
    for name, folder in (("sparse/cells", "cells"), ("frame_cells", f"frames/frame-0000-{START}")):
        files = export(path, tmp_path / folder.partition("/")[0], maps=[name])
        assert files == [tmp_path / folder / f"navigation_map.{suffix}" for suffix in ("pgm", "yaml")]
    assert files[0].read_bytes() == (tmp_path / "both" / "navigation_map.pgm").read_bytes()
    meant = r"no map 'sparse_map'; its maps: frame_cells, sparse/cells, sparse/map; did you mean 'sparse/map'\?"
    with pytest.raises(LogError, match=meant):
        export(path, tmp_path / "none", maps=["sparse_map"])
    with pytest.raises(LogError, match="sparse/cells and frame_cells are both navigation maps"):
        export(path, tmp_path / "none", maps=["sparse/cells", "frame_cells"])
