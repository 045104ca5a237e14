"""Why a cell of a regional map has its verdict: the frames that saw it, its layers and limits.

Everything is in the result log, so nothing runs again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flow.cli.debugging.explanation import CellExplanation, centre_of, index_of, two_numbers, verdict_at
from flow.cli.debugging.instants import Instant, ns_of
from flow.cli.debugging.result_input import graph_of, input_of
from flow.errors import UsageError
from flow.runtime.graph import Graph
from recordings.comparison.text import moment
from recordings.mcap.file import by_stamp
from recordings.results import read_result
from recordings.ros2.from_msg import level_in, read_point_cloud
from recordings.scoring.result_log import stamps_of
from stages import Binarise, FuseRegion
from stages.data import Array, ElevationMap, NavigationMap, PixelOrigin, Transform


class Contribution(NamedTuple):
    """Measured points of one frame in a cell: its stamp, ns, their number and their mean height, m."""

    stamp: int
    points: int
    height: float


@dataclass(frozen=True, eq=False)
class RegionalExplanation(CellExplanation):
    """What made a cell of a regional map.

    Attributes
    ----------
    frame_id : str
        The map's frame.
    frames : list of Contribution
        The frames of the map with measured points in the cell, within the range that a frame adds to the map. The
        points are those that the log keeps.
    spacing : float
        To which the log's points are thinned, m; 0: they are not.
    """

    frame_id: str
    frames: list[Contribution]
    spacing: float


def why_regional(
    result: Path | str,
    at: Instant,
    cell: tuple[float, float],
    *,
    log: Path | str | Sequence[Path | str] | None = None,
    stream: str = "regional_navigation_map",
) -> RegionalExplanation:
    """Explain a cell of the first regional map from an instant on, or of the last one.

    Parameters
    ----------
    result : Path
        The result log of a run.
    at : float, numpy.datetime64 or numpy.timedelta64
        Seconds after the first message of the input log, or a stamp, or the time of the day, UTC, of one.
    cell : (float, float)
        x and y in the map's frame, m.
    log : Path or sequence of Path, optional
        The input log, or its files; by default the one that the result names, beside it. Only seconds after its start
        need it.
    stream : str
        The navigation map.

    Returns
    -------
    RegionalExplanation
        What made the cell.

    Raises
    ------
    UsageError
        If the input log is not there or is another one, the result has no such map, or the cell is outside of it.
    """
    result, cell = Path(result), two_numbers("cell", cell)
    graph = graph_of(result, with_sinks=True)
    node = next((node for node in graph.nodes if node.name == stream and isinstance(node.actor, Binarise)), None)
    if node is None:
        raise UsageError(f"the pipeline of {result} has no navigation map '{stream}'")
    rule: Any = node.actor
    begin, notes = 0, list[str]()
    if log is None and not isinstance(at, float | int):
        stamp = ns_of(at, int(stamps_of(result)[0]))
    else:
        with input_of(graph, result, log) as (opened, notes):
            stamp, begin = ns_of(at, opened.first_stamp), opened.first_stamp
    navigation, terrain, written = _maps(result, stamp, stream, node.inputs["elevation"])
    if navigation.stamp < stamp:
        end = f"{(navigation.stamp - begin) / 1e9:.3f} s" if isinstance(at, float | int) else moment(navigation.stamp)
        last = f"--at is after the last '{stream}', which is explained; it is at {end}"
        notes.append(f"note: {last if written < stamp else f'the {stream!r} from --at on has only frames up to {end}'}")
    place = index_of(navigation, *cell)
    if place is None:
        raise UsageError(f"({cell[0]:g}, {cell[1]:g}) is outside the regional map in '{navigation.frame_id}'")
    return RegionalExplanation(
        **verdict_at(rule, navigation, terrain, place),
        stream=stream,
        notes=notes,
        frame_id=navigation.frame_id,
        frames=_contributions(result, terrain, centre_of(navigation, place), _max_range(graph, stream)),
        spacing=next((getattr(sink, "point_spacing", 0.0) for _, sink in graph.sinks if sink.suffix == ".mcap"), 0.0),
    )


def _maps(result: Path, at: int, stream: str, elevation: str) -> tuple[NavigationMap, ElevationMap, int]:
    """The maps of the first frame from `at` on that has both, else of the last one; and the frame's stamp.

    The maps' own stamps are earlier where frames were left out, or the map began again with that frame.
    """
    found = None
    for frame in read_result(result, [stream, elevation]):
        if stream in frame.items and elevation in frame.items:
            found = frame.items[stream], frame.items[elevation], frame.stamp
            if frame.stamp >= at:
                break
    if found is None:
        raise UsageError(f"{result} has no message with both {stream} and {elevation}")
    return found


def _max_range(graph: Graph, stream: str) -> float:
    """The horizontal range, m, that a frame adds to a regional map; inf if no `FuseRegion` makes it."""
    actors = [node.actor for node in graph.upstream_of([stream]).nodes]
    return next((actor.max_range for actor in actors if isinstance(actor, FuseRegion)), math.inf)


def _contributions(
    result: Path, terrain: ElevationMap, centre: tuple[float, float], max_range: float
) -> list[Contribution]:
    """The points of each frame of a map that lie in a cell. max_range: m, that a frame adds to the map."""
    found, part = list[Contribution](), (terrain.epoch, terrain.stamp + 1)
    for stamp, messages in by_stamp(result, ["/nav/points", "/tf"], part=part):
        level = level_in(messages.get("/tf", ()), terrain.frame_id)
        if level is None or "/nav/points" not in messages:
            continue
        fields = read_point_cloud(messages["/nav/points"][-1])
        heights = _heights(fields, level, centre, terrain.resolution, max_range)
        if heights.size:
            found.append(Contribution(stamp, len(heights), float(heights.mean())))
    return found


def _heights(
    fields: Mapping[str, Array], level: Transform, centre: tuple[float, float], resolution: float, max_range: float
) -> Array:
    """The heights, m, of those points (in frame `level`) that the map takes into a cell, as `frame_grid` does."""
    points = level(np.column_stack([fields[axis] for axis in "xyz"]).astype(np.float64))
    corner = np.floor(level.translation[:2] / resolution) * resolution  # of the rover's cell
    taken = np.all(np.abs(points[:, :2] - centre) <= resolution / 2, axis=1)
    taken &= np.linalg.norm(points[:, :2] - corner, axis=1) <= max_range
    if "source" in fields:
        taken &= fields["source"] == PixelOrigin.MEASURED
    return np.asarray(points[taken, 2])
