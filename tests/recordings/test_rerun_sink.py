"""The rerun recording holds every intermediate at its own time, and shows nothing that a frame did not have."""

from __future__ import annotations

import resource
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr

from recordings.desk import CLOCK, FRAME, Panel, Place, desk
from recordings.errors import LogError
from recordings.rerun_sink import RerunSink
from stages.data import (
    LEVEL_FRAME,
    Array,
    CameraMotion,
    Cell,
    Disparity,
    ElevationMap,
    Mount,
    NavigationMap,
    PointCloud,
    Pose,
    Reason,
    Source,
    StereoCamera,
    StereoFrame,
    Tilt,
    TiltHealth,
    Transform,
)

START = 1_215_874_621_123_456_789  # ns; float seconds could not hold it
STEP = 500_000_000
WIDTH, HEIGHT = 64, 48
STREAMS: dict[str, type] = {
    "stereo": StereoFrame, "tilt": Tilt, "pose": Pose, "rectified": StereoFrame, "matched": Disparity,
    "disparity": Disparity, "cloud": PointCloud, "points": PointCloud, "elevation_map": ElevationMap,
    "navigation_map": NavigationMap, "motion": CameraMotion, "health": TiltHealth,
}  # fmt: skip


@dataclass
class Loss:
    stream: str
    stamp: int
    stage: str
    reason: str
    detail: str


@dataclass
class Record:
    stamp: int
    items: Mapping[str, Any]
    entries: tuple[Loss, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=lambda: {"matched": 0.25, "disparity": 0.5})
    queues: Mapping[str, int] = field(default_factory=lambda: {"matched": 3, "disparity": 1})


def scene(stamp: int = START) -> dict[str, Any]:
    """One small frame of everything: a textured pair, a ramp of disparities, bumpy terrain with a hole."""
    random = np.random.default_rng(stamp % 2**32)
    camera = StereoCamera(80.0, 80.0, 31.5, 23.5, 0.25, WIDTH, HEIGHT)
    left, right = (cv2.GaussianBlur(random.integers(0, 256, (HEIGHT, WIDTH), np.uint8), (5, 5), 0) for _ in "lr")
    pixels = np.tile(np.linspace(2.0, 30.0, HEIGHT, dtype=np.float32)[:, None], (1, WIDTH))
    pixels[:4] = np.nan
    source = np.where(np.isnan(pixels), Source.UNKNOWN, Source.MEASURED).astype(np.uint8)
    source[40:] = Source.PLANE
    segments = (np.arange(HEIGHT)[:, None] // 8 * 8 + np.arange(WIDTH) // 8).astype(np.int32)
    matched = Disparity(stamp, pixels, source, np.ones_like(pixels), camera=camera)
    sensor = Transform(LEVEL_FRAME, "camera", [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.0, 0.0, 0.9])
    points = random.normal(size=(1000, 3)).astype(np.float32)
    colors = random.integers(0, 256, (1000, 3), np.uint8)
    cloud = PointCloud(stamp, points, colors, np.ones(1000, np.float32), np.arange(1000, dtype=np.int32), "camera")
    x, y = np.meshgrid(np.arange(40), np.arange(30))
    elevation = (0.1 * np.sin(x / 5.0) * np.cos(y / 4.0)).astype(np.float32)
    elevation[10:14, 20:25] = np.nan
    terrain = ElevationMap(stamp, {"elevation": elevation, "slope": elevation * 2}, 0.1, (0.0, -1.5), LEVEL_FRAME)
    cells = np.where(np.isnan(elevation), Cell.UNKNOWN, Cell.FREE).astype(np.int8)
    cells[2, 3] = Cell.HAZARD
    reason = np.where(cells == Cell.HAZARD, Reason.STEP, Reason.CLEAR).astype(np.uint8)
    frame = StereoFrame(stamp, left, right, camera)
    return {
        "stereo": frame, "tilt": Tilt(stamp, [np.sin(0.1), 0.0, np.cos(0.1)]),
        "pose": Pose(stamp, [1.0, 2.0, 3.0], [0.0, 0.0, 1.0, 0.0], "odom", "base_link"),
        "rectified": frame, "matched": matched, "disparity": replace(matched, segments=segments), "cloud": cloud,
        "points": replace(cloud, frame_id=LEVEL_FRAME, sensor=sensor), "elevation_map": terrain,
        "navigation_map": NavigationMap(stamp, cells, reason, 0.1, (0.0, -1.5), LEVEL_FRAME),
        "motion": CameraMotion(stamp, 1, Transform("start", "camera", np.eye(3), np.zeros(3)), np.eye(6), 321, 0.4),
        "health": TiltHealth(stamp, 0.01, 0.05, 50, "the sign of pitch is flipped", "turn it round"),
    }  # fmt: skip


def record_of(path: Path, records: Iterable[Record], summary: Mapping[str, Any] | None = None, **settings: Any) -> Path:
    sink = RerunSink(**settings)
    sink.open(path, STREAMS, {"log": "traverse.mcap"})
    for record in records:
        sink.write(record)
    sink.close(summary or {"verdict": "COMPLETE"})
    return path


def rows(path: Path, entity: str, component: str) -> list[tuple[int | None, int | None, Any]]:
    """(log clock ns, frame, value) of every row of an entity's component, in time order; a cleared row is None."""
    found = []
    for chunk in rr.chunk.RrdReader(str(path)).stream():
        if chunk.entity_path != entity:
            continue
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        static = [None] * len(batch)
        clocks = [
            np.asarray(batch.column(name)).astype(np.int64).tolist() if name in batch.schema.names else static
            for name in (CLOCK, FRAME)
        ]
        found += list(zip(*clocks, batch.column(component).to_pylist(), strict=True))
    return sorted(found, key=lambda row: (row[0] or 0, row[1] or 0))


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in rr.chunk.RrdReader(str(path)).stream()}


def decoded(blob: list[int] | bytes, flags: int) -> Array:
    image = cv2.imdecode(np.frombuffer(bytes(blob), np.uint8), flags)
    assert image is not None
    return np.asarray(image)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of three whole frames."""
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    return record_of(path, [Record(START + n * STEP, scene(START + n * STEP)) for n in range(3)])


def test_every_intermediate_is_there(whole: Path) -> None:
    assert entities(whole) >= {
        "/rectified/left", "/rectified/right", "/matched/pixels", "/matched/source/labels", "/disparity/pixels",
        "/disparity/source/labels", "/disparity/superpixels", "/points/points", "/elevation_map/relief",
        "/elevation_map/layers/slope", "/elevation_map/surface", "/navigation_map/cells/labels",
        "/navigation_map/reason/labels", "/navigation_map/hazards", "/rectified/camera", "/pose/trajectory",
        "/seconds/matched", "/queues/disparity", "/tilt/x\\ axis\\ up", "/ledger", "/summary",
    }  # fmt: skip


def test_pictures_stand_at_the_nanosecond_of_their_frame(whole: Path) -> None:
    times = [(clock, frame) for clock, frame, _ in rows(whole, "/disparity/pixels", "EncodedDepthImage:blob")]
    assert times == [(START + n * STEP, n) for n in range(3)]


def test_only_the_logs_clock_and_the_frame_count_are_timelines(whole: Path) -> None:
    """The wall clock in a recording would make two equal runs differ."""
    names = {
        column.name for chunk in rr.chunk.RrdReader(str(whole)).stream() for column in chunk.to_record_batch().schema
    }
    assert {CLOCK, FRAME} <= names
    assert not names & {"log_time", "log_tick"}


def test_disparities_survive_to_an_eighth_of_a_pixel_and_unknown_is_zero(whole: Path) -> None:
    blob = rows(whole, "/disparity/pixels", "EncodedDepthImage:blob")[0][2][0]
    stored = decoded(blob, cv2.IMREAD_UNCHANGED) / 8.0
    truth = scene()["disparity"].pixels
    known = np.isfinite(truth)
    assert np.abs(stored[known] - truth[known]).max() <= 1 / 16
    assert (stored[~known] == 0).all()


def test_what_frames_have_in_common_is_stored_once(whole: Path) -> None:
    for legend in ("/disparity/source/legend", "/disparity/pixels/scale/text", "/elevation_map/relief/lines/distances"):
        assert [frame for _, frame, _ in rows(whole, legend, "Points2D:positions")] == [0], legend
    assert len(rows(whole, "/disparity/source", "AnnotationContext:context")) == 1


def test_superpixel_edges_lie_between_different_labels(whole: Path) -> None:
    edges = decoded(rows(whole, "/disparity/superpixels", "EncodedImage:blob")[0][2][0], cv2.IMREAD_GRAYSCALE)
    assert edges.shape == (HEIGHT, WIDTH)
    column, row = np.arange(WIDTH) % 8 == 7, np.arange(HEIGHT) % 8 == 7
    column[-1] = row[-1] = False  # beyond the image there is no other superpixel
    np.testing.assert_array_equal(edges > 0, row[:, None] | column)


def test_images_are_recognisable(whole: Path) -> None:
    left = decoded(rows(whole, "/rectified/left", "EncodedImage:blob")[0][2][0], cv2.IMREAD_GRAYSCALE)
    assert np.abs(left.astype(int) - scene()["rectified"].left).mean() < 8


def test_the_same_pixels_are_stored_once(whole: Path, tmp_path: Path) -> None:
    assert "/stereo/left" not in entities(whole)
    items = scene()
    raw = items["stereo"]
    items["stereo"] = StereoFrame(raw.stamp, raw.left.copy(), raw.right, raw.camera)
    assert {"/stereo/left", "/rectified/left"} <= entities(record_of(tmp_path / "raw.rrd", [Record(START, items)]))


def test_clouds_are_thinned_by_a_fixed_stride(tmp_path: Path) -> None:
    path = record_of(tmp_path / "few.rrd", [Record(START, scene())], max_points=300)
    positions = rows(path, "/points/points", "Points3D:positions")[0][2]
    np.testing.assert_array_equal(positions, scene()["points"].points[::4])


def test_a_cloud_in_the_cameras_frame_is_not_put_into_level_space(whole: Path) -> None:
    assert not any(path.startswith("/cloud") for path in entities(whole))


def test_the_surface_has_no_triangle_across_a_hole(whole: Path) -> None:
    vertices = np.array(rows(whole, "/elevation_map/surface", "Mesh3D:vertex_positions")[0][2])
    triangles = np.array(rows(whole, "/elevation_map/surface", "Mesh3D:triangle_indices")[0][2])
    terrain = scene()["elevation_map"]
    assert len(vertices) == np.isfinite(terrain.layers["elevation"]).sum()
    assert np.isfinite(vertices).all()
    corners = vertices[triangles][..., :2]
    assert np.ptp(corners, axis=1).max() == pytest.approx(terrain.resolution, abs=1e-5)
    # 29 x 39 squares, of which the 5 x 6 that touch the 4 x 5 hole are gone, but for the halves at two of its corners.
    assert len(triangles) == 2 * (29 * 39 - 5 * 6) + 2


def test_maps_are_seen_from_above_with_forward_up_and_left_left(whole: Path) -> None:
    """The one hazard is at row 2 (right, y small) and column 3 (near, x small): lower right in the picture."""
    blob = bytes(rows(whole, "/navigation_map/cells/labels", "SegmentationImage:buffer")[0][2][0])
    picture = np.frombuffer(blob, np.uint8).reshape(40, 30)
    assert np.argwhere(picture == Cell.HAZARD).tolist() == [[40 - 1 - 3, 30 - 1 - 2]]


def test_hazards_stand_on_the_ground_where_they_are(whole: Path) -> None:
    position = rows(whole, "/navigation_map/hazards", "Points3D:positions")[0][2]
    ground = scene()["elevation_map"].layers["elevation"][2, 3]
    np.testing.assert_allclose(position, [[0.35, -1.25, ground + 0.03]], atol=1e-6)


def test_a_regional_map_is_drawn_beside_the_frame_s_own(tmp_path: Path) -> None:
    items = scene()
    near, cells = items["elevation_map"], items["navigation_map"]
    level = Transform("odom", LEVEL_FRAME, np.eye(3), [6.0, 0.0, 2.0])
    layers = {name: layer + np.float32(2.0) for name, layer in near.layers.items()}
    items["regional_map"] = replace(near, layers=layers, origin=(5.0, -1.5), frame_id="odom", level=level)
    items["regional_navigation_map"] = replace(cells, origin=(5.0, -1.5), frame_id="odom")
    sink = RerunSink()
    sink.open(tmp_path / "run.rrd", dict.fromkeys(items, object), {})
    sink.write(Record(START, items))
    sink.close({"verdict": "COMPLETE"})
    ground = near.layers["elevation"][2, 3]
    for stream, place in (("navigation_map", (0.35, -1.25, 0)), ("regional_navigation_map", (5.35, -1.25, 2))):
        position = rows(tmp_path / "run.rrd", f"/{stream}/hazards", "Points3D:positions")[0][2]
        np.testing.assert_allclose(position, [np.add(place, (0, 0, ground + 0.03))], atol=1e-6)
    assert len(rows(tmp_path / "run.rrd", "/regional_map/surface", "Mesh3D:vertex_positions")) == 1
    names, spots = (
        rows(tmp_path / "run.rrd", "/regional_map/relief/lines/distances", f"Points2D:{part}")[0][2]
        for part in ("labels", "positions")
    )
    # 40 columns from x = 5: the rover, at x = 6, is 10 columns from the lower edge, and in the middle of 30 rows.
    assert spots[names.index("rover")] == [15.0, 30.0]


def test_the_camera_stands_where_the_cloud_was_seen_from(whole: Path) -> None:
    assert rows(whole, "/rectified/camera", "Transform3D:translation")[0][2] == [pytest.approx([0.0, 0.0, 0.9])]


def test_scalars_are_those_of_the_frame(whole: Path) -> None:
    assert [value for *_, value in rows(whole, "/seconds/disparity", "Scalars:scalars")] == [[0.5]] * 3
    assert [value for *_, value in rows(whole, "/queues/matched", "Scalars:scalars")] == [[3.0]] * 3
    tilt = rows(whole, "/tilt/x\\ axis\\ up", "Scalars:scalars")[0][2]
    assert tilt == [pytest.approx(np.degrees(0.1))]


def test_what_a_frame_lacks_is_cleared_at_that_frame(tmp_path: Path) -> None:
    """Else the viewer would show the picture before it as this frame's."""
    lost = ("stereo", "rectified", "disparity", "points", "elevation_map")
    second = {name: item for name, item in scene(START + STEP).items() if name not in lost}
    frames = [scene(), second, scene(START + 2 * STEP)]
    path = record_of(tmp_path / "lost.rrd", [Record(START + n * STEP, items) for n, items in enumerate(frames)])
    for entity in ("/points/points", "/elevation_map/surface", "/elevation_map/relief", "/navigation_map/hazards"):
        cleared = [clock for clock, _, value in rows(path, entity, "Clear:is_recursive") if value is not None]
        assert cleared == [START + STEP], entity
    assert not rows(path, "/matched/source/labels", "Clear:is_recursive")
    for legend in ("/disparity/source/legend", "/elevation_map/relief/lines/distances"):
        shown = [(frame, bool(value)) for _, frame, value in rows(path, legend, "Points2D:positions")]
        assert shown == [(0, True), (2, True)], legend  # and once more when it hangs again
        assert [frame for _, frame, value in rows(path, legend, "Clear:is_recursive") if value is not None] == [1]
    # An encoded image is emptied instead, for the viewer ignores its clearing.
    for entity, kind in (
        ("/rectified/left", "EncodedImage"), ("/rectified/camera/image", "EncodedImage"),
        ("/disparity/superpixels", "EncodedImage"), ("/disparity/pixels", "EncodedDepthImage"),
    ):  # fmt: skip
        blobs = [value for *_, value in rows(path, entity, f"{kind}:blob")]
        assert [bool(blob) for blob in blobs] == [True, False, True], entity


def test_losses_are_told_at_their_own_stamps(tmp_path: Path) -> None:
    lost = Loss("tilt", START - 7, "tilt", "unaligned", "no message within 200 ms")
    late = Loss("right", START + 9, "left", "unmatched", "no partner within 5 ms")
    summary = {"verdict": "INCOMPLETE", "drops": {"unaligned": 1, "unmatched": 1}, "entries": (late,)}
    path = record_of(tmp_path / "ledger.rrd", [Record(START, scene(), (lost,))], summary)
    texts = {clock: value[0] for clock, _, value in rows(path, "/ledger", "TextLog:text")}
    assert texts[START - 7] == "tilt lost tilt: unaligned. no message within 200 ms"
    assert texts[START].startswith("0.75 s of work; matched 92 % known")
    last = [value[0] for *_, value in rows(path, "/ledger", "TextLog:text")][-2:]
    assert set(last) == {
        "left lost right: unmatched. no partner within 5 ms", "INCOMPLETE: 1 frame, 1 unaligned, 1 unmatched",
    }  # fmt: skip
    documents = [value[0] for *_, value in rows(path, "/summary", "TextDocument:text")]
    assert documents[-1].startswith("# INCOMPLETE")
    assert "traverse.mcap" in documents[-1]


def test_frames_may_come_from_different_threads(tmp_path: Path) -> None:
    """rerun's clocks are a thread's own: a thread that did not set them would log for all times."""
    sink = RerunSink()
    sink.open(tmp_path / "threads.rrd", STREAMS, {})
    for n in range(4):
        record = Record(START + n * STEP, scene(START + n * STEP))
        thread = threading.Thread(target=sink.write, args=(record,))
        thread.start()
        thread.join()
    sink.close({"verdict": "COMPLETE"})
    found = rows(tmp_path / "threads.rrd", "/points/points", "Points3D:positions")
    times = [(clock, frame) for clock, frame, _ in found]
    assert times == [(START + n * STEP, n) for n in range(4)]


def test_a_recording_passes_reruns_own_check(whole: Path) -> None:
    check = subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(whole)], capture_output=True, text=True)
    assert check.returncode == 0, check.stderr


def test_a_recording_has_its_name_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    sink = RerunSink()
    sink.open(path, STREAMS, {})
    sink.write(Record(START, scene()))
    assert not path.exists()
    sink.close({"verdict": "COMPLETE"})
    sink.close({"verdict": "COMPLETE"})
    assert [file.name for file in tmp_path.iterdir()] == ["run.rrd"]


def test_a_run_without_frames_leaves_a_recording_that_says_so(tmp_path: Path) -> None:
    path = record_of(tmp_path / "empty.rrd", [], {"verdict": "INCOMPLETE", "drops": {"unreadable": 2}})
    assert rows(path, "/ledger", "TextLog:text")[-1][2] == ["INCOMPLETE: 0 frames, 2 unreadable"]


def test_a_picture_that_fails_is_an_error_and_not_a_warning(tmp_path: Path) -> None:
    sink = RerunSink()
    sink.open(tmp_path / "run.rrd", STREAMS, {})
    with pytest.raises((ValueError, TypeError)):
        sink.write(Record(START, {}, seconds={"matched": "soon"}))  # type: ignore[dict-item]
    sink.close({})


def test_an_unwritable_place_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="nowhere"):
        RerunSink().open(tmp_path / "nowhere" / "run.rrd", STREAMS, {})


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    """Told by rerun only to its log: the sink has to find out."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    sink = RerunSink()
    sink.open(tmp_path / "run.rrd", STREAMS, {})
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        for n in range(3):
            sink.write(Record(START + n, scene(START + n)))
        with pytest.raises(LogError, match="cannot write"):
            sink.close({"verdict": "COMPLETE"})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_it_wants_what_it_has_a_picture_for() -> None:
    wanted = {kind for kind in (*STREAMS.values(), Mount) if RerunSink().wants("any", kind)}
    assert wanted == set(STREAMS.values())


@pytest.mark.parametrize("settings", [{"max_points": 0}, {"jpeg_quality": 0}, {"jpeg_quality": 101}])
def test_senseless_settings_are_refused(settings: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        RerunSink(**settings)  # type: ignore[arg-type]


def views(part: Any) -> list[Any]:
    """All views of a blueprint part."""
    return [view for inner in part.contents for view in views(inner)] if hasattr(part, "grid_columns") else [part]


def test_the_desk_has_a_view_for_each_picture_and_none_without() -> None:
    places = [Place(Panel.LEFT, "rectified/left", "left"), Place(Panel.DISPARITY, "matched/pixels", "matched")]
    names = [view.name for view in views(desk(places).root_container)]
    assert sorted(names) == ["ledger", "left", "matched", "run"]


def test_two_streams_of_one_type_have_tabs_of_two_names() -> None:
    def names(*streams: str) -> list[str]:
        panels = ((Panel.RELIEF, "relief"), (Panel.LAYER, "elevation"), (Panel.LAYER, "slope"))
        places = [Place(panel, f"{stream}/{title}", title) for stream in streams for panel, title in panels]
        places.append(Place(Panel.RELIEF, "regional/relief", "relief (odom)"))
        return [view.name for view in views(desk(places).root_container)][:-2]

    assert names("sparse") == ["relief", "relief (odom)", "elevation", "slope"]
    assert names("sparse", "dense") == [
        "sparse: relief", "dense: relief", "relief (odom)",
        "sparse: elevation", "sparse: slope", "dense: elevation", "dense: slope",
    ]  # fmt: skip


def test_a_legend_that_would_hide_its_plot_is_not_shown() -> None:
    for stages in (2, 25):
        places = [Place(Panel.STAGE, f"{root}/{n}", str(n)) for root in ("seconds", "queues") for n in range(stages)]
        plots = views(desk(places).root_container)[:2]
        shown = [plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist() for plot in plots]
        assert shown == [[stages == 2]] * 2
        assert [plot.name.endswith("hover for names") for plot in plots] == [stages == 25] * 2


def test_a_sink_that_is_not_open_writes_nothing_and_closes(tmp_path: Path) -> None:
    sink = RerunSink()
    sink.close({"verdict": "COMPLETE"})
    with pytest.raises(LogError, match="is a folder"):
        sink.open(tmp_path, STREAMS, {})
    sink.close({"verdict": "COMPLETE"})
    with pytest.raises(LogError, match="RerunSink is not open"):
        sink.write(Record(START, {}))
    assert list(tmp_path.iterdir()) == []


def test_two_sinks_on_one_path_do_not_mix(tmp_path: Path) -> None:
    path, sinks = tmp_path / "run.rrd", [RerunSink(), RerunSink()]
    for sink in sinks:
        sink.open(path, STREAMS, {})
    assert len(list(tmp_path.iterdir())) == 2
    for sink in sinks:
        sink.close({"verdict": "COMPLETE"})
        assert b"RRF2FOOT" in path.read_bytes()[-20:]
    assert list(tmp_path.iterdir()) == [path]


def test_the_tilt_check_is_a_plot_and_says_once_what_is_wrong(whole: Path, tmp_path: Path) -> None:
    (_, _, turn), *_ = rows(whole, "/health/" + rr.escape_entity_path_part("tilt off turn"), "Scalars:scalars")
    assert turn[0] == pytest.approx(np.degrees(0.01))
    assert rows(whole, "/motion/features", "Scalars:scalars")[0][2] == [321.0]
    path = record_of(
        tmp_path / "run.rrd", [Record(START, scene()), Record(START + STEP, scene(START + STEP))],
        {
            "verdict": "COMPLETE",
            "findings": {"health": {"severity": "warning", "sentence": "the sign of pitch is flipped"}},
        },
    )  # fmt: skip
    assert [value for *_, value in rows(path, "/ledger/health", "TextLog:text")] == [["turn it round"]]
    assert rows(path, "/ledger", "TextLog:text")[-1][2] == ["health: the sign of pitch is flipped"]
    assert rows(path, "/ledger", "TextLog:level")[-1][2] == ["WARN"]


def test_the_logs_own_pose_is_drawn_once(tmp_path: Path) -> None:
    sink, items = RerunSink(), scene()
    sink.open(tmp_path / "run.rrd", {"logged": Pose, "pose": Pose}, {})
    sink.write(Record(START, {"logged": items["pose"], "pose": items["pose"]}))
    sink.close({"verdict": "COMPLETE"})
    assert [path for path in entities(tmp_path / "run.rrd") if "trajectory" in path] == ["/pose/trajectory"]
