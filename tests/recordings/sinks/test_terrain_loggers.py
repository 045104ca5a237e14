"""Terrain in a recording: a map with more layers replaces the earlier one, and voxels are boxes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from recordings.sinks.colormaps import REASON_LEGEND, SOURCE_LEGEND
from recordings.sinks.rerun_sink import RerunSink
from stages.data import LEVEL_FRAME, CellReason, PixelOrigin, VoxelMap
from tests.recordings.sinks.recorded_scene import START, Record, entities, rows, scene


def test_a_map_that_a_later_map_contains_is_not_drawn_twice(tmp_path: Path) -> None:
    items = scene()
    assessed = items.pop("elevation_map")
    cells = replace(assessed, layers={"elevation": assessed.layers["elevation"]})
    other = replace(assessed, layers={"elevation": assessed.layers["elevation"] + np.float32(1)})
    sink = RerunSink()
    sink.open(tmp_path / "a.rrd", ("cells", "other", "elevation_map"), {})
    sink.write(Record(START, {"cells": cells, "other": other, "elevation_map": assessed}))
    sink.close({"verdict": "COMPLETE"})
    drawn = entities(tmp_path / "a.rrd")
    assert {"/other/relief", "/elevation_map/relief", "/elevation_map/layers/slope"} <= drawn
    assert not any(entity.startswith("/cells") for entity in drawn)


def test_voxels_are_boxes_at_the_centres_of_their_cubes(tmp_path: Path) -> None:
    voxels = VoxelMap(
        START, np.array([[0, 0, 0], [20, -3, 2]], np.int32), np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        np.array([5, 9], np.int32), 0.1, LEVEL_FRAME,
    )  # fmt: skip
    sink = RerunSink()
    sink.open(tmp_path / "v.rrd", ("voxels",), {})
    sink.write(Record(START, {"voxels": voxels}))
    sink.close({"verdict": "COMPLETE"})
    (_, _, centres), *_ = rows(tmp_path / "v.rrd", "/voxels/voxels", "Boxes3D:centers")
    np.testing.assert_allclose(centres, [[0.05, 0.05, 0.05], [2.05, -0.25, 0.25]], atol=1e-6)
    (_, _, halves), *_ = rows(tmp_path / "v.rrd", "/voxels/voxels", "Boxes3D:half_sizes")
    np.testing.assert_allclose(halves, 0.05)


def test_every_reason_has_a_colour_of_its_own() -> None:
    assert set(REASON_LEGEND) == set(CellReason)
    assert len({colour for _, colour in REASON_LEGEND.values()}) == len(REASON_LEGEND)


def test_every_pixel_origin_has_a_colour_of_its_own() -> None:
    assert set(SOURCE_LEGEND) == set(PixelOrigin)
    assert len({colour for _, colour in SOURCE_LEGEND.values()}) == len(SOURCE_LEGEND)
