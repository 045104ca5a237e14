"""Why a cell of a navigation map has its verdict: its pixels, layers, limits and the settings that would change it.

The frame is run again from the input log, so that every intermediate is there. The verdicts are compared with those of
the result.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from flow.cli.debugging.instants import Instant, no_frame, part_of
from flow.cli.debugging.result_input import graph_of, input_of, loss_at
from flow.cli.replay import one_thread_per_call
from flow.contracts import FrameRecord
from flow.errors import UsageError
from flow.runtime.graph import Graph
from flow.runtime.run import run
from stages import Binarise, Voxelise
from stages.data import (
    Array,
    Cell,
    CellReason,
    Disparity,
    ElevationMap,
    NavigationMap,
    PixelOrigin,
    PointCloud,
    StereoFrame,
    Tilt,
)
from stages.terrain.verdict_limits import Limit, Turn, doubts_at, limits_at, turns_at

if TYPE_CHECKING:
    from recordings.source.log import McapLog

BORDER_DIGITS = 6  # of a cell, to which a place is rounded
REACH_PX = 10.0  # from a pixel to the nearest one that has a point


@dataclass(frozen=True, eq=False)
class CellExplanation:
    """The verdict of a cell, and how it follows from the map.

    Attributes
    ----------
    stream : str
        The navigation map.
    stamp : int
        Of the map, ns.
    x, y : float
        Centre of the cell, m, in the map's frame.
    verdict : Cell
        Free, hazard or unknown.
    reason : CellReason
        Why.
    layers : dict
        Layer of the elevation map -> its value in the cell; NaN is unknown.
    limits : dict
        Quantity -> `Limit`: the rule compares its value with its limit.
    doubts : list of str
        Of a cell that is UNSURE: why it is not free, though it exceeds no limit.
    turns : list of Turn
        The smallest change of each parameter that would change the verdict.
    notes : list of str
        What differs from the question: another form of the input log, another instant, a frame that the result does not
        have, a cell beyond the range of the map.
    """

    stream: str
    stamp: int
    x: float
    y: float
    verdict: Cell
    reason: CellReason
    layers: Mapping[str, float]
    limits: Mapping[str, Limit]
    doubts: list[str]
    turns: list[Turn]
    notes: list[str]


@dataclass(frozen=True, eq=False)
class Explanation(CellExplanation):
    """What made a cell of one frame's map.

    Attributes
    ----------
    recorded : Cell or None
        The verdict in the result; None where the result does not have the cell.
    pixels : (N,) ndarray
        The points' pixels, as indices into the flattened left image.
    disparities, sigmas : (N,) ndarray
        Of these pixels, px.
    costs : (2, N) ndarray
        The lowest cost of the search at these pixels, and the next lowest, as `Disparity.costs`; no columns if the
        matcher does not know them.
    sources : dict
        Origin of the disparity -> number of pixels.
    distance : float
        From the camera to the points, median, m.
    tilt : Tilt or None
        That levelled the frame.
    image : (H, W) or (H, W, 3) ndarray
        The left image.
    """

    recorded: Cell | None
    pixels: Array
    disparities: Array
    sigmas: Array
    costs: Array
    sources: Mapping[str, int]
    distance: float
    tilt: Tilt | None
    image: Array


def why(
    result: Path | str,
    at: Instant,
    *,
    cell: tuple[float, float] | None = None,
    pixel: tuple[int, int] | None = None,
    log: Path | str | Sequence[Path | str] | None = None,
    stream: str = "navigation_map",
) -> Explanation:
    """Explain a cell of one frame's navigation map.

    Parameters
    ----------
    result : Path
        The result log of a run.
    at : float, numpy.datetime64 or numpy.timedelta64
        Seconds after the first message of the input log, or a stamp, or the time of the day, UTC, of one.
    cell : (float, float), optional
        x and y in the map's frame, m.
    pixel : (int, int), optional
        Column and row in the left rectified image, instead of the cell; its ground's cell is explained.
    log : Path or sequence of Path, optional
        The input log, or its files; by default the one that the result names, beside it.
    stream : str
        The navigation map.

    Returns
    -------
    Explanation
        What made the cell.

    Raises
    ------
    UsageError
        If the input log is not there or is another one, the pipeline has no such map, or the cell or pixel is outside
        of it.

    Examples
    --------
    >>> from pathlib import Path
    >>> why(Path("out.mcap"), 12.0, cell=(3.4, -0.6)).reason  # doctest: +SKIP
    <CellReason.STEP: 3>
    """
    from stages.kernel_loading import loading_kernels

    result, cell, pixel = Path(result), two_numbers("cell", cell), two_numbers("pixel", pixel)
    graph = graph_of(result)
    rules = {node.name: node for node in graph.nodes if isinstance(node.actor, Binarise)}
    if stream not in rules:
        others = f"no navigation map '{stream}', only {', '.join(rules)}" if rules else "no navigation map"
        raise UsageError(f"the pipeline has {others}")
    graph = graph.upstream_of([stream])
    with loading_kernels(), input_of(graph, result, log) as (opened, notes):
        items = instant(graph, opened, at, stream, result)
    node, navigation = rules[stream], items[stream]
    terrain = items[node.inputs["elevation"]]
    cloud = _last(items, PointCloud, navigation.frame_id)
    if cloud is None:
        raise _without_pixels(result, navigation.frame_id, f"/nav/{stream}")
    x, y = cell if cell is not None else _place(cloud, pixel)
    place = index_of(navigation, x, y)
    if place is None:
        raise UsageError(f"({x:.5g}, {y:.5g}) is outside the map, which has {_extent(navigation)}")
    x, y = centre_of(navigation, place)
    recorded, lacking = _recorded(result, stream, navigation.stamp, x, y)
    cells = np.floor((cloud.points[:, :2] - np.array(navigation.origin)) / navigation.resolution)
    inside = (cells == place[::-1]).all(axis=1)
    frame, origin = _last(items, StereoFrame), np.zeros(3) if cloud.sensor is None else cloud.sensor.translation
    return Explanation(
        **verdict_at(node.actor, navigation, terrain, place),
        stream=stream,
        notes=[*notes, *lacking, *_beyond(graph, cloud, inside)],
        recorded=recorded,
        distance=float(np.median(np.linalg.norm(cloud.points[inside] - origin, axis=1))) if inside.any() else math.nan,
        tilt=_last(items, Tilt),
        image=np.zeros((0, 0), np.uint8) if frame is None else frame.left,
        costs=_costs(items, cloud.pixel[inside]),
        **_pixels(_last(items, Disparity), cloud.pixel[inside]),
    )


def _without_pixels(result: Path, frame_id: str, topic: str) -> Exception:
    """The error for a map in a frame without points, such as a regional map, which a result log explains if it can."""
    from recordings.mcap.file import iter_decoded
    from recordings.scoring.result_log import without_results

    if next(iter_decoded(result, [topic], Counter()), None) is None:
        return without_results(result, [topic])
    return UsageError(f"the frame has no points in frame '{frame_id}'; why_regional explains a regional map")


def verdict_at(
    rule: Binarise, navigation: NavigationMap, terrain: ElevationMap, place: tuple[int, int]
) -> dict[str, Any]:
    """The fields of `CellExplanation` of a cell, by row and column."""
    x, y = centre_of(navigation, place)
    reason = CellReason(int(navigation.reason[place]))
    return {
        "stamp": navigation.stamp, "x": round(x, 6), "y": round(y, 6),
        "verdict": Cell(int(navigation.cells[place])), "reason": reason,
        "layers": {name: float(layer[place]) for name, layer in terrain.layers.items()},
        "limits": limits_at(rule, terrain, *place), "turns": turns_at(rule, terrain, *place),
        "doubts": doubts_at(rule, terrain, *place) if reason == CellReason.UNSURE else [],
    }  # fmt: skip


def centre_of(navigation: NavigationMap, place: tuple[int, int]) -> tuple[float, float]:
    """x and y, m, of a cell by row and column."""
    x, y = (navigation.origin[axis] + (place[1 - axis] + 0.5) * navigation.resolution for axis in (0, 1))
    return x, y


def _pixels(disparity: Disparity | None, pixels: Array) -> dict[str, Any]:
    """What the disparity image has at some pixels."""
    nothing, counts = np.zeros(0, np.float32), Counter[int]()
    found = {"pixels": pixels, "disparities": nothing, "sigmas": nothing}
    if disparity is not None:
        found["disparities"] = disparity.pixels.ravel()[pixels]
        found["sigmas"] = nothing if disparity.sigma is None else disparity.sigma.ravel()[pixels]
        counts = Counter(disparity.source.ravel()[pixels].tolist())
    return found | {"sources": {PixelOrigin(code).name: number for code, number in counts.items()}}


def _costs(items: Mapping[str, Any], pixels: Array) -> Array:
    """The costs of the last search at the size of the last disparity, at some pixels, (2, N); or (2, 0)."""
    disparities = [item for item in items.values() if isinstance(item, Disparity)]
    for item in reversed(disparities):
        if item.costs is not None and item.pixels.size == disparities[-1].pixels.size:
            return item.costs.reshape(2, -1)[:, pixels]
    return np.zeros((2, 0), np.uint8)


def instant(graph: Graph, log: McapLog, at: Instant, stream: str, result: Path) -> Mapping[str, Any]:
    """Every stream of a graph at the frame of a log nearest to `at`.

    Raises UsageError with the loss if the frame has no `stream`. result: log of the whole run.
    """
    kept = _Keep()
    with one_thread_per_call():
        part = part_of(log, at, frames=1, before=0)
        log.narrow(part.start, part.end)
        summary = run(replace(graph, sinks=(("keep", kept),)), log, {"keep": Path("memory")})
    items = kept.records[0].items if kept.records else {}
    if stream in items:
        return items
    loss = loss_at(part.stamp, summary["ledger"], result)
    if not items:
        raise no_frame(part, loss, log)
    why = "the pipeline returned none" if loss is None else loss.words
    raise UsageError(f"the frame at {part.at:.3f} s has no navigation map '{stream}': {why}")


@dataclass
class _Keep:
    """A sink that keeps the frames in memory."""

    records: list[FrameRecord] = field(default_factory=list)
    suffix = ""
    asks: ClassVar = {"keep_costs": True}  # of matchers

    def wants(self, stream: str, kind: type) -> bool:
        return True

    def open(self, path: Any, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Nothing to begin."""

    def write(self, record: FrameRecord) -> None:
        self.records.append(record)

    def close(self, summary: Mapping[str, Any]) -> None:
        """Nothing to finish."""


def _last(items: Mapping[str, Any], kind: Any, frame_id: str | None = None) -> Any:
    """The last item of a type (in a frame); for images the last of the camera's full size."""
    found = [item for item in items.values() if isinstance(item, kind)]
    found = [item for item in found if frame_id is None or item.frame_id == frame_id]
    if kind is StereoFrame:
        width = max((item.camera.width for item in found), default=0)
        found = [item for item in found if item.camera.width == width]
    return found[-1] if found else None


def _place(cloud: PointCloud, pixel: tuple[int, int] | None) -> tuple[float, float]:
    """x and y of the point of a pixel, or of the nearest pixel that has one."""
    if pixel is None or cloud.shape is None:
        raise UsageError("give a cell or a pixel")
    (height, width), (x, y) = cloud.shape, pixel
    if not (0 <= x < width and 0 <= y < height):
        raise UsageError(f"the pixel {x},{y} is outside the image of {width}x{height}")
    rows, cols = np.divmod(cloud.pixel, width)
    distances = np.hypot(rows - y, cols - x)
    if not (distances <= REACH_PX).any():
        raise UsageError(
            f"no point of the map is within {REACH_PX:g} px of the pixel {x},{y}: it is unknown or too far"
        )
    nearest = np.argmin(distances)
    return float(cloud.points[nearest, 0]), float(cloud.points[nearest, 1])


def index_of(navigation: NavigationMap, x: float, y: float) -> tuple[int, int] | None:
    """Row and column of the cell at (x, y); None outside the map."""
    offsets = (float(y - navigation.origin[1]), float(x - navigation.origin[0]))
    # A border belongs to the cell above it, whatever the error of the origin. The quotients may be infinite.
    row, col = (float(np.floor(round(offset / navigation.resolution, BORDER_DIGITS))) for offset in offsets)
    rows, cols = navigation.cells.shape
    return (int(row), int(col)) if 0 <= row < rows and 0 <= col < cols else None


def two_numbers(what: str, given: Any) -> Any:
    """Two finite numbers as they are given, or None. Raises UsageError for anything else."""
    with suppress(TypeError, ValueError):
        if given is None or np.isfinite(np.array(given, float)).tolist() == [True, True]:
            return given
    raise UsageError(f"the {what} must be two finite numbers, not {given!r}")


def _extent(navigation: NavigationMap) -> str:
    rows, cols = navigation.cells.shape
    (x, y), step = navigation.origin, navigation.resolution
    return f"x {x:.2f} to {x + cols * step:.2f} m, y {y:.2f} to {y + rows * step:.2f} m in '{navigation.frame_id}'"


def _recorded(result: Path, stream: str, stamp: int, x: float, y: float) -> tuple[Cell | None, list[str]]:
    """The verdict of the result at a place, None without one; and a note if the result has no map of the stamp."""
    from recordings.comparison.text import moment
    from recordings.mcap.file import McapFile, iter_decoded
    from recordings.ros2.from_msg import read_occupancy_grid

    topic = f"/nav/{stream}"
    for _, _, message in iter_decoded(result, [topic], Counter(), part=(stamp, stamp + 1)):
        navigation = read_occupancy_grid(message)
        place = index_of(navigation, x, y)
        return None if place is None else Cell(int(navigation.cells[place])), []
    with McapFile(result) as log:
        stamps = log.times(log.channels_of([topic])).tolist()
    if stamp in stamps:  # another profile's message, which is not compared
        return None, []
    those = f"; its maps are from {moment(stamps[0])} to {moment(stamps[-1])}" if stamps else ", nor at any other"
    return None, [f"note: the result has no '{stream}' at {moment(stamp)}{those}"]


def _beyond(graph: Graph, cloud: PointCloud, inside: Array) -> list[str]:
    """A note if the measured points of a cell are all beyond the range of the map. inside: mask of its points."""
    ranges = [(node.name, node.actor.max_range) for node in graph.nodes if isinstance(node.actor, Voxelise)]
    distances = np.linalg.norm(cloud.points[inside & cloud.measured, :2], axis=1)
    name, max_range = ranges[-1] if ranges else ("", math.inf)
    if not distances.size or distances.min() <= max_range:
        return []
    return [f"note: the measured points of the cell lie beyond {name}.max_range, {max_range:g} m from base_link"]
