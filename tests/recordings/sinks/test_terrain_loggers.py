"""Terrain in a recording: a map with more layers replaces the earlier one, and voxels are boxes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recordings.sinks.colormaps import (
    REASON_LEGEND,
    SOURCE_LEGEND,
    UNKNOWN_RGB,
    apply_palette,
    elevation_colors,
    fewer_shades,
)  # fmt: skip
from stages.data import LEVEL_FRAME, CellReason, ElevationMap, PixelOrigin, VoxelMap
from tests.recordings.sinks.recorded_scene import (
    HEIGHT,
    START,
    STREAMS,
    WIDTH,
    Record,
    entities,
    record_of,
    rows,
    scene,
)


def labels_of(recording, layer):
    """The labels beside the scale of a layer of the elevation map."""
    return rows(recording, f"/elevation_map/layers/{layer}/scale/text", "Points2D:labels")[0][2]


def colours_of(recording, entity):
    """The colours of the scale of a picture."""
    shown = rows(recording, f"{entity}/scale", "Points2D:colors")[0][2][:3]
    return [[rgba >> 24, rgba >> 16 & 255, rgba >> 8 & 255] for rgba in shown]


def drawn_colours(recording, entity, hazard=None, palette=cv2.COLORMAP_TURBO):
    """The colours in which the viewer draws the values of a scale: over the range of the picture."""
    ((_, _, ((first, last),)),) = rows(recording, entity, "DepthImage:depth_range")
    labels = rows(recording, f"{entity}/scale/text", "Points2D:labels")[0][2]
    low, high = (float(label.partition(" ")[0]) for label in labels[::2])
    middle = (low + high) / 2 if hazard is None else hazard
    return apply_palette(np.array([low, middle, high]), first, last, palette).tolist()


def test_fewer_shades_of_a_relief_leave_unknown_cells_their_colour():
    heights = np.random.default_rng(1).normal(size=(9, 7)).astype(np.float32)
    heights[2:5, 3] = np.nan
    terrain = ElevationMap(START, {"elevation": heights}, 0.05, (0.0, 0.0), LEVEL_FRAME)
    exact, fewer, known = elevation_colors(terrain), elevation_colors(terrain, exact=False), np.isfinite(heights)
    np.testing.assert_array_equal(fewer[known], fewer_shades(exact[known]))
    assert (fewer[~known] == UNKNOWN_RGB).all()
    assert len(np.unique(exact[known], axis=0)) > len(np.unique(fewer[known], axis=0)) > 1


def test_layers_with_a_limit_and_heights_have_scales_that_stay(tmp_path):
    def frame(number, rise):
        terrain = scene()["elevation_map"]
        elevation = terrain.layers["elevation"] + np.float32(rise)
        layers = {"elevation": elevation, "variance": np.abs(elevation) / 100, "step": np.abs(elevation)}
        return Record(START + number, {"elevation_map": replace(terrain, layers=layers)})

    path = record_of(tmp_path / "run.rrd", [frame(0, 0), frame(1, 1), frame(2, 0)])
    scales = {
        name: [texts for *_, texts in rows(path, f"/elevation_map/{name}/scale/text", "Points2D:labels")]
        for name in ("relief", "layers/elevation", "layers/variance", "layers/step")
    }
    assert scales["layers/variance"] == [["0 m²", "0.0045 m²", "0.009 m²"]]
    assert scales["layers/step"] == [["0 m", "0.2 m", "0.4 m"]]
    heights = [["-0.1 m", "0 m", "0.1 m"], ["-0.1 m", "0.5 m", "1.1 m"]]  # it grows once
    assert scales["relief"] == scales["layers/elevation"] == heights


@pytest.mark.filterwarnings("error")
def test_slopes_are_drawn_in_degrees_as_their_limits_are_given(tmp_path):
    terrain = scene()["elevation_map"]
    layers = {"elevation": terrain.layers["elevation"], "slope": np.full(terrain.shape, np.radians(20.0), np.float32)}
    layers["last"] = np.full(terrain.shape, 1e5, np.float32)  # beyond half precision
    path = record_of(tmp_path / "a.rrd", [Record(START, {"elevation_map": replace(terrain, layers=layers)})])
    assert labels_of(path, "slope") == ["0 deg", "20 deg", "40 deg"]
    buffer = np.array(rows(path, "/elevation_map/layers/slope", "DepthImage:buffer")[0][2][0], np.uint8)
    np.testing.assert_allclose(buffer.view(np.float16), 20.0, atol=0.02)
    buffer = np.array(rows(path, "/elevation_map/layers/last", "DepthImage:buffer")[0][2][0], np.uint8)
    assert (buffer.view(np.float16) == np.inf).all()


def test_the_scale_of_a_layer_shows_the_limit_of_the_hazard_rule(tmp_path):
    terrain = scene()["elevation_map"]
    layers = dict.fromkeys(("elevation", "step"), terrain.layers["elevation"])
    items = {"elevation_map": replace(terrain, layers=layers)}
    path = record_of(tmp_path / "a.rrd", [Record(START, items)], limits=("elevation_map/step=0.17", "other/step=0.3"))
    assert labels_of(path, "step") == ["0 m", "limit 0.17 m", "0.4 m"]
    assert colours_of(path, "/elevation_map/layers/step") == drawn_colours(path, "/elevation_map/layers/step", 0.17)


def test_scales_have_the_colours_of_the_pictures(tmp_path):
    random = np.random.default_rng(1)
    costs = random.integers(0, 256, (2, HEIGHT, WIDTH), np.uint8)
    items = scene() | {"own": random.integers(0, 2, (HEIGHT, WIDTH)).astype(float)}
    items["disparity"] = replace(items["disparity"], costs=(costs[0], costs[1]))
    path = record_of(tmp_path / "a.rrd", [Record(START, items)], streams=STREAMS | {"own": np.ndarray})
    for entity in ("disparity/confidence", "disparity/cost", "disparity/lead", "elevation_map/layers/slope", "own"):
        assert colours_of(path, f"/{entity}") == drawn_colours(path, f"/{entity}")
    elevation = "/elevation_map/layers/elevation"
    assert colours_of(path, elevation) == drawn_colours(path, elevation, palette=cv2.COLORMAP_VIRIDIS)


def test_a_run_gives_the_limits_of_its_hazard_rule(result):
    expected = {"step": "limit 0.17 m", "slope": "limit 20 deg", "roughness": "limit 0.06 m"}
    assert {layer: labels_of(result.with_suffix(".rrd"), layer)[1] for layer in expected} == expected


def test_voxels_are_boxes_at_the_centres_of_their_cubes(tmp_path):
    voxels = VoxelMap(
        START, np.array([[0, 0, 0], [20, -3, 2]], np.int32), np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        np.array([5, 9], np.int32), 0.1, LEVEL_FRAME,
    )  # fmt: skip
    path = record_of(tmp_path / "v.rrd", [Record(START, {"voxels": voxels})], streams={"voxels": VoxelMap})
    (_, _, centres), *_ = rows(path, "/voxels/voxels", "Boxes3D:centers")
    np.testing.assert_allclose(centres, [[0.05, 0.05, 0.05], [2.05, -0.25, 0.25]], atol=1e-6)
    (_, _, halves), *_ = rows(path, "/voxels/voxels", "Boxes3D:half_sizes")
    np.testing.assert_allclose(halves, 0.05)


@pytest.mark.parametrize(("codes", "legend"), [(CellReason, REASON_LEGEND), (PixelOrigin, SOURCE_LEGEND)])
def test_every_code_has_a_colour_of_its_own(codes, legend):
    assert set(legend) == set(codes)
    assert len({colour for _, colour in legend.values()}) == len(legend)


def test_a_regional_map_shows_which_frames_it_is_made_of(tmp_path):
    terrain = replace(scene()["elevation_map"], frame_id="odom")
    frames = np.where(np.isfinite(terrain.layers["elevation"]), np.float32(3), np.float32(0))
    layers = terrain.layers | {"frames": frames, "contradictions": frames / 3}
    path = record_of(tmp_path / "a.rrd", [Record(START, {"elevation_map": replace(terrain, layers=layers)})])
    drawn = {entity for entity in entities(path) if "/layers/" in entity and "/scale" not in entity}
    assert drawn == {"/elevation_map/layers/frames", "/elevation_map/layers/contradictions"}
    buffer = np.array(rows(path, "/elevation_map/layers/frames", "DepthImage:buffer")[0][2][0], np.uint8)
    values = buffer.view(np.float16)
    assert set(values[np.isfinite(values)]) == {3}
    assert 0 < np.isnan(values).mean() < 1
    assert labels_of(path, "frames")[2] == "20 frames"


@pytest.mark.parametrize("sequence", [list, np.array])
def test_the_origin_of_a_map_may_be_any_two_numbers(sequence, tmp_path):
    maps = {name: replace(scene()[name], origin=sequence((-1.5, -1.5))) for name in ("elevation_map", "navigation_map")}
    path = record_of(tmp_path / "a.rrd", [Record(START, maps)])
    labels = rows(path, "/navigation_map/cells/lines/distances", "Points2D:labels")
    assert labels[0][2] == ["0 m", "2 m", "rover"]
