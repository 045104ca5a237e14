"""Every picture of a recording shows the frame's data at their places, with their values."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import rerun as rr

from recordings.sinks.canvas import MAX_POINTS, Canvas
from recordings.sinks.loggers import DEPTH_STEPS, POINT_STEPS, same_view
from recordings.sinks.rerun_sink import RerunSink
from stages.data import LEVEL_FRAME, Cell, ElevationMap, PixelOrigin, Pose, StereoCamera, StereoFrame, Transform
from tests.recordings.sinks.recorded_scene import (
    HEIGHT,
    START,
    STEP,
    WIDTH,
    Record,
    decoded,
    entities,
    record_of,
    resized,
    rows,
    scene,
)


def test_disparities_are_stored_to_a_quarter_px_unknown_as_0(rrd):
    blob = rows(rrd, "/disparity/pixels", "EncodedDepthImage:blob")[0][2][0]
    stored = decoded(blob, cv2.IMREAD_UNCHANGED) / 4.0
    truth = scene()["disparity"].pixels
    known = np.isfinite(truth)
    assert np.abs(stored[known] - truth[known]).max() <= 1 / 8
    assert (stored[~known] == 0).all()


@pytest.mark.parametrize("color", [False, True])
@pytest.mark.parametrize("deep", [False, True])
def test_the_difference_shows_wrong_disparities_and_no_exposure(deep, color, tmp_path):
    items = scene()
    wide = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH + 8), np.uint8), (5, 5), 0)
    wide = cv2.normalize(wide, None, 20, 220, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    images = [wide[:, :WIDTH], cv2.convertScaleAbs(wide[:, 8:], alpha=0.8, beta=15)]  # the right one has less contrast
    if color:
        images = [cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) for image in images]
    if deep:
        images = [image.astype(np.uint16) << 4 for image in images]
    pixels = np.full((HEIGHT, WIDTH), 8, np.float32)
    pixels[20:30, 30:40] = 13  # wrong
    pixels[:4] = np.nan
    items["rectified"] = StereoFrame(START, *images, items["rectified"].camera)
    items["disparity"] = replace(items["disparity"], pixels=pixels)
    path = record_of(tmp_path / "run.rrd", [Record(START, items)])
    blob = rows(path, "/disparity/difference", "EncodedDepthImage:blob")[0][2][0]
    levels = decoded(blob, cv2.IMREAD_UNCHANGED) * 4
    right = np.ones_like(pixels, bool)
    right[20:30, 30:40] = False
    assert (levels[right] <= 8).mean() > 0.98
    assert levels[~right].mean() > 16
    assert levels.max() == 32
    assert not levels[:4].any()
    assert not levels[:, :8].any()  # out of view


def test_the_confidence_of_the_match_is_drawn_beside_that_of_the_result(tmp_path):
    items, shares = scene(), {"matched": 40, "disparity": 90}
    for stream, percent in shares.items():
        confidence = np.full_like(items[stream].confidence, percent / 100)
        items[stream] = replace(items[stream], confidence=confidence)
    path = record_of(tmp_path / "run.rrd", [Record(START, items)])
    for stream, percent in shares.items():
        shown = np.frombuffer(bytes(rows(path, f"/{stream}/confidence", "DepthImage:buffer")[0][2][0]), np.uint8)
        assert set(shown) == {0, percent}  # 0 is unknown


def test_the_costs_of_the_search_are_drawn_and_filled_disparities_are_faint(tmp_path):
    items = scene()
    lowest = np.random.default_rng(0).integers(0, 200, (HEIGHT, WIDTH)).astype(np.uint8)
    items["matched"] = replace(items["matched"], costs=np.stack([lowest, lowest + np.uint8(30)]))
    source = items["disparity"].source.copy()
    source[4:9] = PixelOrigin.FILLED
    items["disparity"] = replace(items["disparity"], source=source)
    path = record_of(tmp_path / "run.rrd", [Record(START, items)], max_width=3 * WIDTH)

    def shown(entity, kind):
        return np.frombuffer(bytes(rows(path, entity, f"{kind}:buffer")[0][2][0]), np.uint8).reshape(HEIGHT, WIDTH)

    np.testing.assert_array_equal(shown("/matched/cost", "DepthImage"), lowest)
    assert (shown("/matched/lead", "DepthImage") == 30).all()
    np.testing.assert_array_equal(shown("/disparity/pixels/filled", "SegmentationImage"), source == PixelOrigin.FILLED)
    assert not {"/disparity/cost", "/disparity/lead", "/matched/pixels/filled"} & entities(path)


def test_superpixel_edges_lie_between_different_labels(rrd):
    edges = decoded(rows(rrd, "/disparity/superpixels", "EncodedImage:blob")[0][2][0], cv2.IMREAD_GRAYSCALE)
    assert edges.shape == (HEIGHT, WIDTH)
    column, row = np.arange(WIDTH) % 8 == 7, np.arange(HEIGHT) % 8 == 7
    column[-1] = row[-1] = False  # beyond the image there is no other superpixel
    np.testing.assert_array_equal(edges > 0, row[:, None] | column)


def test_images_are_recognisable(rrd):
    left = decoded(rows(rrd, "/rectified/left", "EncodedImage:blob")[0][2][0], cv2.IMREAD_GRAYSCALE)
    assert np.abs(left.astype(int) - scene()["rectified"].left).mean() < 8


def test_what_a_later_stream_shows_too_is_drawn_once(tmp_path):
    items = scene()
    frame, pose, terrain = (items[name] for name in ("rectified", "pose", "elevation_map"))
    heights = terrain.layers["elevation"]
    shown = {
        "raw": StereoFrame(START, frame.left.copy(), frame.right, frame.camera), "stereo": frame, "rectified": frame,
        "logged": pose, "pose": pose, "cells": replace(terrain, layers={"elevation": heights}),
        "other": replace(terrain, layers={"elevation": heights + np.float32(1)}), "elevation_map": terrain,
        "heights": replace(terrain, layers={"elevation": heights}),  # without a layer of the one before
    }  # fmt: skip
    streams = {name: type(item) for name, item in shown.items()}
    drawn = entities(record_of(tmp_path / "run.rrd", [Record(START, shown)], streams=streams))
    assert {entity.split("/")[1] for entity in drawn} & shown.keys() == {
        "raw", "rectified", "pose", "other", "elevation_map", "heights"
    }  # fmt: skip


@pytest.mark.parametrize(("camera_width", "max_width", "widths"), [
    (1280, 0, (640, 240)), (640, 0, (320, 120)), (64, 0, (320, 120)), (1280, 1280, (1280, 480)),
])  # fmt: skip
def test_pictures_follow_the_size_of_the_images_unless_a_width_is_set(camera_width, max_width, widths):
    camera = StereoCamera(80, 80, 31.5, 23.5, 0.2, camera_width, 48)
    canvas = Canvas(None, jpeg_quality=75, max_width=max_width, camera=camera)
    assert (canvas.whole_width, canvas.small_width) == widths


def test_clouds_are_thinned_by_a_fixed_stride(tmp_path):
    items = scene() | {"points": resized(scene()["points"], 4 * MAX_POINTS)}
    path = record_of(tmp_path / "few.rrd", [Record(START, items)])
    positions = rows(path, "/points/points", "Points3D:positions")[0][2]
    np.testing.assert_allclose(positions, items["points"].points[::4], rtol=0, atol=0.5 / POINT_STEPS)


def test_a_cloud_in_the_camera_frame_is_not_drawn(rrd):
    assert not any(path.startswith("/cloud") for path in entities(rrd))


def test_the_surface_has_no_triangle_across_a_hole(rrd):
    vertices = np.array(rows(rrd, "/elevation_map/surface", "Mesh3D:vertex_positions")[0][2])
    triangles = np.array(rows(rrd, "/elevation_map/surface", "Mesh3D:triangle_indices")[0][2])
    terrain = scene()["elevation_map"]
    assert len(vertices) == np.isfinite(terrain.layers["elevation"]).sum()
    assert np.isfinite(vertices).all()
    corners = vertices[triangles][..., :2]
    assert np.ptp(corners, axis=1).max() == pytest.approx(terrain.resolution, abs=1e-5)
    # 29 x 39 squares less the 5 x 6 that touch the 4 x 5 hole, plus the halves at two of its corners.
    assert len(triangles) == 2 * (29 * 39 - 5 * 6) + 2


def test_maps_are_seen_from_above_with_forward_up_and_left_left(rrd):
    """The one hazard is at row 2 (right, y small) and column 3 (near, x small): lower right in the picture."""
    blob = bytes(rows(rrd, "/navigation_map/cells/labels", "SegmentationImage:buffer")[0][2][0])
    picture = np.frombuffer(blob, np.uint8).reshape(40, 30)
    assert np.argwhere(picture == Cell.HAZARD).tolist() == [[40 - 1 - 3, 30 - 1 - 2]]


def test_hazards_are_drawn_on_the_ground_at_their_cells(rrd):
    position = rows(rrd, "/navigation_map/hazards", "Points3D:positions")[0][2]
    ground = scene()["elevation_map"].layers["elevation"][2, 3]
    np.testing.assert_allclose(position, [[0.35, -1.25, ground + 0.03]], atol=1e-6)


def test_hazards_in_view_are_drawn_over_the_left_image(tmp_path):
    items = scene()
    cells = items["navigation_map"].cells.copy()
    cells[16, 30] = Cell.HAZARD  # 3.05 m ahead and 0.15 m to the left; the other one is out of view
    items["navigation_map"] = replace(items["navigation_map"], cells=cells)
    path = record_of(tmp_path / "run.rrd", [Record(START, items)])
    ((_, _, found),) = rows(path, "/rectified/left/hazards", "Points2D:positions")
    down = 0.9 - items["elevation_map"].layers["elevation"][16, 30]
    u, v = 32.0 - 80 * 0.15 / 3.05, 24.0 + 80 * down / 3.05
    np.testing.assert_allclose(found, [[u, v]], rtol=1e-5)


def test_a_regional_map_is_drawn_in_its_own_frame_of_reference(tmp_path):
    items = scene()
    near, cells = items["elevation_map"], items["navigation_map"]
    level = Transform("odom", LEVEL_FRAME, np.eye(3), [6.0, 0.0, 2.0])
    layers = {name: layer + np.float32(2.0) for name, layer in near.layers.items()}
    items["regional_map"] = replace(near, layers=layers, origin=(5.0, -1.5), frame_id="odom", level=level)
    items["regional_navigation_map"] = replace(cells, origin=(5.0, -1.5), frame_id="odom")
    path = record_of(tmp_path / "run.rrd", [Record(START, items)], streams={n: type(item) for n, item in items.items()})
    ground = near.layers["elevation"][2, 3]
    for stream, place in (("navigation_map", (0.35, -1.25, 0)), ("regional_navigation_map", (5.35, -1.25, 2))):
        position = rows(path, f"/{stream}/hazards", "Points3D:positions")[0][2]
        np.testing.assert_allclose(position, [np.add(place, (0, 0, ground + 0.03))], atol=1e-6)
    assert len(rows(path, "/regional_map/surface", "Mesh3D:vertex_positions")) == 1
    names, spots = (
        rows(path, "/regional_map/relief/lines/distances", f"Points2D:{part}")[0][2] for part in ("labels", "positions")
    )
    # 40 columns from x = 5: the rover, at x = 6, is 10 columns from the lower edge, and in the middle of 30 rows.
    assert spots[names.index("rover")] == [15.0, 30.0]


def test_the_way_driven_is_drawn_on_a_regional_map(tmp_path):
    def frame(number, position):
        items = scene(START + number)
        near = items["elevation_map"]
        layers = {name: layer.copy() for name, layer in near.layers.items()}
        region = replace(near, layers=layers, origin=(5.0, -1.5), frame_id="odom")  # 40 columns by 30 rows of 0.1 m
        pose = replace(items["pose"], position=np.array(position))
        return Record(START + number, {"pose": pose, "regional_map": region, "elevation_map": near})

    way = ((1.0, 0.0, 0.0), (5.0, 0.0, 0.0), (6.0, 1.0, 0.0), (7.0, -1.0, 0.0))
    streams = {"pose": Pose, "regional_map": ElevationMap, "elevation_map": ElevationMap}
    path = record_of(tmp_path / "run.rrd", [frame(*item) for item in enumerate(way)], streams=streams)
    drawn = [strips for *_, strips in rows(path, "/regional_map/relief/lines/way", "LineStrips2D:strips")]
    np.testing.assert_allclose(drawn[-1], [[[15.0, 40.0], [5.0, 30.0], [25.0, 20.0]]])  # the first place is off the map
    assert [len(strips[0]) for strips in drawn] == [2, 3]
    assert "/elevation_map/relief/lines/way" not in entities(path)


def test_the_depth_of_the_last_disparity_is_under_the_cursor(tmp_path):
    items = scene()
    pixels = np.full((48, 64), 4.0, np.float32)
    pixels[:8], pixels[8:16] = np.nan, 0.0
    camera = StereoCamera(80, 80, 31.5, 23.5, 0.2, 64, 48, cx_right=33.5)
    items["disparity"] = replace(items["disparity"], pixels=pixels, camera=camera, sigma=None)
    path = record_of(tmp_path / "run.rrd", [Record(START, items)], max_width=180)
    depth = decoded(rows(path, "/disparity/depth", "EncodedDepthImage:blob")[0][2][0], cv2.IMREAD_UNCHANGED)
    assert rows(path, "/disparity/depth", "EncodedDepthImage:meter")[0][2][0] == DEPTH_STEPS
    assert not depth[:8].any()  # unknown
    depth = depth / DEPTH_STEPS
    np.testing.assert_allclose(depth[8:16], 80 * 0.2 / 2.0, rtol=1e-3)
    np.testing.assert_allclose(depth[16:], 80 * 0.2 / 6.0, rtol=1e-3)
    assert not [entity for entity in entities(path) if entity.startswith("/matched/depth")]


def test_what_is_unchanged_in_a_frame_stays_drawn(tmp_path):
    def frame(number):
        items = scene(START + number)
        terrain = items.pop("elevation_map")
        if number in (0, 3):
            return Record(START + number, items | {"elevation_map": terrain})
        return Record(START + number, items, unchanged=frozenset({"elevation_map"} if number < 3 else ()))

    path = record_of(tmp_path / "run.rrd", [frame(number) for number in range(5)])
    reliefs = rows(path, "/elevation_map/relief", "EncodedImage:blob")
    assert [number for _, number, _ in reliefs] == [0, 3, 4]  # emptied in the last frame, which lacks it


def test_a_number_that_is_unchanged_in_a_frame_leaves_no_gap_in_its_curve(tmp_path):
    path, sink = tmp_path / "run.rrd", RerunSink()
    sink.open(path, {"level": float}, {})
    for number, items in enumerate([{"level": 1.0}, {}, {"level": 3.0}, {}]):
        unchanged = frozenset({"level"}) if number == 1 else frozenset()
        sink.write(Record(START + number, items, unchanged=unchanged))
    sink.close({"verdict": "COMPLETE"})
    found = {number: value for _, number, (value,) in rows(path, "/level", "Scalars:scalars")}
    assert (found.keys(), found[0], found[2]) == ({0, 2, 3}, 1.0, 3.0)
    assert np.isnan(found[3])  # lost


def test_the_camera_is_drawn_at_the_sensor_of_the_cloud(rrd):
    assert rows(rrd, "/rectified/camera", "Transform3D:translation")[0][2] == [pytest.approx([0.0, 0.0, 0.9])]
    assert rows(rrd, "/rectified/camera", "Pinhole:camera_xyz") == [(START, 0, [[3, 2, 5]])]  # right, down, forward


def test_scalars_are_those_of_the_frame(rrd):
    assert [value for *_, value in rows(rrd, "/seconds/disparity", "Scalars:scalars")] == [[0.5]] * 3
    assert [value for *_, value in rows(rrd, "/queues/matched", "Scalars:scalars")] == [[3.0]] * 3
    steps = rows(rrd, "/queues/matched", "SeriesLines:interpolation_mode")
    assert [value for *_, value in steps] == [[rr.components.InterpolationMode.StepAfter.value]]  # for all frames
    tilt = rows(rrd, "/tilt/" + rr.escape_entity_path_part("inclinometer x up"), "Scalars:scalars")[0][2]
    assert tilt == [pytest.approx(np.degrees(0.1))]


def test_the_tilt_check_is_plotted_and_its_fault_logged_once(rrd, tmp_path):
    (_, _, turn), *_ = rows(rrd, "/health/" + rr.escape_entity_path_part("tilt off turn"), "Scalars:scalars")
    assert turn[0] == pytest.approx(np.degrees(0.01))
    assert rows(rrd, "/motion/features", "Scalars:scalars")[0][2] == [321.0]
    path = record_of(
        tmp_path / "run.rrd", [Record(START, scene()), Record(START + STEP, scene(START + STEP))],
        {
            "verdict": "COMPLETE",
            "findings": {"health": {"severity": "fault", "sentence": "the sign of pitch is flipped"}},
        },
    )  # fmt: skip
    assert [value for *_, value in rows(path, "/ledger/health", "TextLog:text")] == [["turn it round"]]
    assert rows(path, "/ledger", "TextLog:text")[-1][2] == ["health: the sign of pitch is flipped"]
    assert rows(path, "/ledger", "TextLog:level")[-1][2] == ["ERROR"]


def test_a_pair_is_drawn_alike_with_a_moved_right_image():
    camera = StereoCamera(500, 500, 320, 240, 0.1, 640, 480)
    assert same_view(camera, replace(camera, cx_right=260.0))
    assert not same_view(camera, replace(camera, width=320, height=240, cx=160.0, cx_right=160.0))
    assert not same_view(camera, replace(camera, cx=300.0))


@pytest.mark.parametrize("width", [WIDTH, WIDTH - 3])
def test_the_image_in_the_frustum_is_a_quarter_as_wide_and_fits_its_lens(width, tmp_path):
    items, left = scene(), np.full((HEIGHT, width), 40, np.uint8)
    left[20:24, 32:36] = 240  # one pixel of the picture
    camera = replace(items["rectified"].camera, width=width)
    items["rectified"] = StereoFrame(START, left, left, camera)
    path = record_of(tmp_path / "a.rrd", [Record(START, {name: items[name] for name in ("rectified", "points")})])
    picture = decoded(rows(path, "/rectified/camera/image", "EncodedImage:blob")[0][2][0], cv2.IMREAD_UNCHANGED)
    lens = np.reshape(rows(path, "/rectified/camera", "Pinhole:image_from_camera")[0][2][0], (3, 3)).T
    assert picture.shape == (HEIGHT // 4, width // 4)
    assert rows(path, "/rectified/camera", "Pinhole:resolution")[0][2][0] == [width // 4, HEIGHT // 4]
    np.testing.assert_allclose(lens, [[20, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])  # a pixel's place refers to its centre
    assert np.unravel_index(picture.argmax(), picture.shape) == (5, 8)
