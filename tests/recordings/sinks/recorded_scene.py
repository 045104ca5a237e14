"""One small frame of everything as a rerun recording, and ways to read such a recording back."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr

from recordings.sinks.blueprint import CLOCK, FRAME, FRAMES, LAYOUT, QUEUES, SECONDS, SUMMARY
from recordings.sinks.rerun_sink import RerunSink
from stages.data import (
    LEVEL_FRAME,
    Array,
    CameraMotion,
    Cell,
    CellReason,
    Disparity,
    ElevationMap,
    NavigationMap,
    PixelOrigin,
    PointCloud,
    Pose,
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
    unchanged: frozenset[str] = frozenset()


def scene(stamp: int = START) -> dict[str, Any]:
    """One small frame of everything: a textured pair, a ramp of disparities, bumpy terrain with a hole."""
    random = np.random.default_rng(stamp % 2**32)
    camera = StereoCamera(80.0, 80.0, 31.5, 23.5, 0.25, WIDTH, HEIGHT)
    left, right = (cv2.GaussianBlur(random.integers(0, 256, (HEIGHT, WIDTH), np.uint8), (5, 5), 0) for _ in "lr")
    pixels = np.tile(np.linspace(2.0, 30.0, HEIGHT, dtype=np.float32)[:, None], (1, WIDTH))
    pixels[:4] = np.nan
    source = np.where(np.isnan(pixels), PixelOrigin.UNKNOWN, PixelOrigin.MEASURED).astype(np.uint8)
    source[40:] = PixelOrigin.PLANE
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
    reason = np.where(cells == Cell.HAZARD, CellReason.STEP, CellReason.CLEAR).astype(np.uint8)
    frame = StereoFrame(stamp, left, right, camera)
    return {
        "stereo": frame, "tilt": Tilt(stamp, [np.sin(0.1), 0.0, np.cos(0.1)]),
        "pose": Pose(stamp, [1.0, 2.0, 3.0], [0.0, 0.0, 1.0, 0.0], "odom", "base_link"),
        "rectified": frame, "matched": matched, "disparity": replace(matched, segments=segments), "cloud": cloud,
        "points": replace(cloud, frame_id=LEVEL_FRAME, sensor=sensor), "elevation_map": terrain,
        "navigation_map": NavigationMap(stamp, cells, reason, 0.1, (0.0, -1.5), LEVEL_FRAME),
        "motion": CameraMotion(stamp, 1, Transform("start", "camera", np.eye(3), np.zeros(3)), np.eye(6), 321),
        "health": TiltHealth(stamp, 0.01, 0.05, 50, "the sign of pitch is flipped", "turn it round"),
    }  # fmt: skip


def resized(cloud: PointCloud, count: int) -> PointCloud:
    """The points of a cloud, repeated up to a number."""
    sigma, pixel = (np.resize(values, count) for values in (cloud.sigma, cloud.pixel))
    points, colors = (np.resize(values, (count, 3)) for values in (cloud.points, cloud.colors))
    return replace(cloud, points=points, colors=colors, sigma=sigma, pixel=pixel)


def record_of(
    path: Path,
    records: Iterable[Record],
    summary: Mapping[str, Any] | None = None,
    streams: Mapping[str, Any] = STREAMS,
    **settings: Any,
) -> Path:
    sink = RerunSink(**settings)
    assert all(sink.wants(name, kind) for name, kind in streams.items())
    sink.open(path, streams, {"log": "traverse.mcap"})
    for record in records:
        sink.write(record)
    sink.close(summary or {"verdict": "COMPLETE"})
    return path


TIMED = (SECONDS, QUEUES, FRAMES, SUMMARY, LAYOUT, "__properties")  # what depends on the speed and time of a run


def rows(path: Path, entity: str, component: str) -> list[tuple[int | None, int | None, Any]]:
    """(log clock ns, frame, value) of every row with an entity's component, in time order; [] where it is cleared."""
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
    found = [row for row in found if row[2] is not None]
    return sorted(found, key=lambda row: (row[0] or 0, row[1] or 0))


def pictures(path: Path) -> dict[tuple[str, str], list[Any]]:
    """(Entity, component) -> its rows as in `rows`, without those of `TIMED`."""
    found: dict[tuple[str, str], list[Any]] = {}
    for chunk in rr.chunk.RrdReader(str(path)).stream():
        if chunk.entity_path.strip("/").partition("/")[0] not in TIMED:
            batch = chunk.to_record_batch()
            names = [name for name in batch.schema.names if ":" in name]
            for name in names:
                times = batch.column(CLOCK).to_pylist() if CLOCK in batch.schema.names else [None] * len(batch)
                values = [row for row in zip(times, batch.column(name), strict=True) if row[1].is_valid]
                found.setdefault((chunk.entity_path, name), []).extend(values)
    return {key: sorted(rows, key=lambda row: (row[0] is not None, row[0])) for key, rows in found.items()}


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in rr.chunk.RrdReader(str(path)).stream()}


def decoded(blob: list[int] | bytes, flags: int) -> Array:
    image = cv2.imdecode(np.frombuffer(bytes(blob), np.uint8), flags)
    assert image is not None
    return np.asarray(image)
