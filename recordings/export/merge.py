"""Regional maps of several result logs as one, by inverse variance.

Cells of all maps lie on the same grid, so nothing is resampled. Each cell keeps its logs, and each pair of logs is
compared where both know the ground: a difference of heights beyond their sigmas is a conflict.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import combinations, combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np

from flow.contracts import as_text
from recordings.atomic_write import written
from recordings.containers.finding import find_files
from recordings.errors import LogError
from recordings.export.bundle import regions_of
from recordings.export.map_files import REGIONAL, MapFiles
from recordings.export.mosaic import Mosaic
from recordings.scoring.result_log import about_run, input_beside, stamps_of
from stages.data import TILE_SIDE, Array, Cell, ElevationMap

MAX_SIGMAS = 3.0  # between two heights of a cell
MAX_CONFLICT_SHARE = 0.1  # of the common cells of two logs; more is a pose that does not fit
LAYERS = ("elevation", "variance", "logs", "best_log", "disagreement", "conflicts")
_CELL = np.dtype([("elevation", "f4"), ("variance", "f4"), ("cells", "i1")])


@dataclass
class Overlap:
    """Two logs, by number, where both know the ground. differences: height of the second over the first, m."""

    logs: tuple[int, int]
    cells: int = 0
    conflicts: int = 0
    largest: float = 0.0  # difference in sign, m
    place: tuple[float, float] = (0.0, 0.0)  # of the largest, m
    _weighted: float = 0.0
    _weight: float = 0.0

    @property
    def mean(self) -> float:
        """Mean difference, by inverse variance, m."""
        return self._weighted / self._weight

    def add(self, difference: Array, variance: Array, corner: tuple[int, int], resolution: float) -> Array:
        """Add cells (rows, cols), NaN where one log lacks them; returns where they conflict."""
        known = np.isfinite(difference)
        conflict = np.asarray(known & (np.abs(difference) > MAX_SIGMAS * np.sqrt(variance)))
        self.cells += int(known.sum())
        self.conflicts += int(conflict.sum())
        weight = 1 / variance[known].astype(np.float64)
        self._weighted += float(weight @ difference[known])
        self._weight += float(weight.sum())
        if conflict.any():
            row, col = np.unravel_index(np.argmax(np.where(conflict, np.abs(difference), 0)), conflict.shape)
            if abs(difference[row, col]) > abs(self.largest):
                self.largest = float(difference[row, col])
                x, y = corner[1] + int(col) + 0.5, corner[0] + int(row) + 0.5
                self.place = x * resolution, y * resolution
        return conflict


@dataclass
class Merged:
    """What a merge found. logs: files, log number 1 first; cells: known cells of each; overlaps: of pairs of logs."""

    logs: list[Path]
    frame_id: str
    resolution: float
    cells: list[int]
    overlaps: dict[tuple[int, int], Overlap] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)

    def sentences(self) -> Iterator[tuple[bool, str]]:
        """Whether it is a fault, and a sentence, for each pair of logs with conflicts and each log on its own."""
        for (first, second), found in self.overlaps.items():
            if found.conflicts:
                names = f"{self._name_of(first)} and {self._name_of(second)}"
                x, y = found.place
                sentence = (
                    f"{names} conflict in {found.conflicts} of {found.cells} common cells: second minus first is "
                    f"{found.mean:+.3f} m on average, {found.largest:+.3f} m at ({x:.2f}, {y:.2f}) m"
                )
                yield found.conflicts > MAX_CONFLICT_SHARE * found.cells, sentence
        paired = {number for pair in self.overlaps for number in pair}
        for number in range(1, len(self.logs) + 1):
            if number not in paired and len(self.logs) > 1:
                yield False, f"{self._name_of(number)} has no cell in common with another log"

    def _name_of(self, number: int) -> str:
        """The name of a log; with its folders where several logs have the same one."""
        places = [log.absolute() for log in self.logs]
        own = places[number - 1]
        if len({place.name for place in places}) == len(places):
            return own.name
        return str(own.relative_to(os.path.commonpath([place.parent for place in places])))

    def as_json(self) -> dict[str, Any]:
        """The content of merge.json."""
        logs = [
            {"number": number, "file": str(log), "cells": cells}
            for number, (log, cells) in enumerate(zip(self.logs, self.cells, strict=True), 1)
        ]
        overlaps = [
            {
                "logs": list(pair), "common_cells": found.cells, "conflicts": found.conflicts,
                "mean_difference_m": found.mean, "largest_conflict_m": found.largest,
                "largest_conflict_at_m": list(found.place) if found.conflicts else None,
            }
            for pair, found in self.overlaps.items()
        ]  # fmt: skip
        about = {"frame_id": self.frame_id, "resolution": self.resolution, "max_sigmas": MAX_SIGMAS}
        return about | {"logs": logs, "overlaps": overlaps}


def merge(results: Sequence[Path], out: Path, lost: Counter[str] | None = None) -> Merged:
    """Write the regional maps of result logs as one map into a folder, and `merge.json` about its logs.

    A height is the mean by inverse variance. The variance of a cell in conflict contains the spread of its heights. A
    cell is a hazard if it is one in any log, and free if it is free in a log and not in conflict.

    results: logs that runs wrote, with poses in one frame of reference; lost: if given, damaged logs are merged as far
    as they are readable, and the reasons of losses are counted here, with the file. Raises LogError if a log has no
    regional map with variances, the maps differ in frame or cell size, or two results are of the same input.
    """
    _check_inputs(results)
    regions, stamp, grid = list[dict[tuple[int, int], Array]](), 0, None
    for result in results:
        own = Counter[str]() if lost is not None else None
        terrain, tiles, last = _region(result, own)
        if lost is not None and own is not None:
            lost.update({f"{result}: {why}": times for why, times in own.items()})
        grid = grid or (terrain.frame_id, terrain.resolution)
        if (terrain.frame_id, terrain.resolution) != grid:
            raise LogError(
                f"{result} has its map in '{terrain.frame_id}' with cells of {terrain.resolution:g} m, {results[0]} in "
                f"'{grid[0]}' with cells of {grid[1]:g} m; merge maps of one frame and cell size"
            )
        regions.append(tiles)
        stamp = max(stamp, last)
    if grid is None:
        raise LogError("there is no result log to merge")
    cells = [sum(int(np.isfinite(tile["elevation"]).sum()) for tile in region.values()) for region in regions]
    merged = Merged(list(results), *grid, cells)
    terrain = Mosaic(grid[1], grid[0], dict.fromkeys(LAYERS, np.float32(np.nan)), 0.0)
    navigation = Mosaic(grid[1], grid[0], {"cells": np.int8(Cell.UNKNOWN)}, 0.0)
    files = MapFiles(0.0, elevation=terrain, navigation=navigation, stamp=stamp)
    for index in sorted(set().union(*regions)):
        parts = {number: region[index] for number, region in enumerate(regions, 1) if index in region}
        _add_tile(files, index, parts, merged)
    first, last = _farthest(regions)
    files.close(f": are the poses of {results[first]} and {results[last]} in one frame of reference?")
    merged.files = files.write(out, "up to")
    with written(path := out / "merge.json") as temporary:
        temporary.write_text(json.dumps(merged.as_json(), indent=2))
    merged.files.append(path)
    return merged


def _check_inputs(results: Sequence[Path]) -> None:
    """Raise LogError for two results with a common part of the same input, which would count as independent."""
    abouts, files = [about_run(result) for result in results], [_files_of(result) for result in results]
    for first, second in combinations(range(len(results)), 2):
        inputs = [abouts[number].get("log_digest") or results[number].resolve() for number in (first, second)]
        (begin, end), (other_begin, other_end) = _seconds(abouts[first]), _seconds(abouts[second])
        same = inputs[0] == inputs[1] and begin < other_end and other_begin < end
        several = max(len(files[first]), len(files[second])) > 1 and files[first] & files[second]
        if same or (several and np.isin(stamps_of(results[first]), stamps_of(results[second])).any()):
            raise LogError(
                f"{results[first]} and {results[second]} are results of the same input, which would count twice; "
                "give one of them"
            )


def _files_of(result: Path) -> set[str]:
    """The names of the files of a run's input; those in a folder only if it is beside the result."""
    beside = input_beside(result)
    if not beside[0].is_dir():
        return set(about_run(result).get("log", "").split(", "))
    with suppress(LogError):
        return {as_text(file.name) for file in find_files(beside).files}
    return set()


def _seconds(about: Mapping[str, str]) -> tuple[float, float]:
    """The part of its input that a run read."""
    return float(about.get("start") or "-inf"), float(about.get("end") or "inf")


def _farthest(regions: Sequence[Mapping[tuple[int, int], Array]]) -> tuple[int, int]:
    """Which two regional maps, of tiles by index, are farthest apart."""
    centres = [np.mean(list(region), axis=0) for region in regions]
    pairs = combinations_with_replacement(range(len(regions)), 2)
    return max(pairs, key=lambda pair: float(np.abs(centres[pair[0]] - centres[pair[1]]).max()))


def merged_cells(elevation: Array, variance: Array) -> tuple[Array, Array]:
    """Mean and variance by inverse variance of (n, rows, cols), NaN where unknown; each (rows, cols) float64."""
    weight = np.where(np.isfinite(elevation), 1 / variance.astype(np.float64), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.sum(weight * np.nan_to_num(elevation), 0) / weight.sum(0)
        return mean, np.where(weight.sum(0) > 0, 1 / weight.sum(0), np.nan)


def _add_tile(files: MapFiles, index: tuple[int, int], parts: Mapping[int, Array], merged: Merged) -> None:
    """Merge the tiles of one place; parts: number of the log -> its tile."""
    numbers, tiles = np.array(list(parts)), np.stack(list(parts.values()))
    elevation, variance = tiles["elevation"].astype(np.float64), tiles["variance"].astype(np.float64)
    corner, conflicts = (index[0] * TILE_SIDE, index[1] * TILE_SIDE), np.zeros(tiles.shape[1:])
    for first, second in combinations(range(len(numbers)), 2):
        difference, both = elevation[second] - elevation[first], variance[second] + variance[first]
        if np.isfinite(difference).any():
            pair = int(numbers[first]), int(numbers[second])
            overlap = merged.overlaps.setdefault(pair, Overlap(pair))
            conflicts += overlap.add(difference, both, corner, merged.resolution)
    mean, spread = merged_cells(elevation, variance)
    known = np.isfinite(elevation)
    off = np.where(known, elevation - mean, 0)
    share = np.where(known, spread / variance, 0)
    best = numbers[np.argmax(share, 0)]
    highest, lowest = np.where(known, elevation, -np.inf).max(0), np.where(known, elevation, np.inf).min(0)
    several, one = known.sum(0) > 1, np.asarray(known.any(0))
    values = (
        mean, spread + np.where(conflicts > 0, (share * off**2).sum(0), 0), np.where(one, known.sum(0), np.nan),
        np.where(one, best, np.nan), np.where(several, highest - lowest, np.nan), np.where(one, conflicts, np.nan),
    )  # fmt: skip
    layers = {name: value.astype(np.float32) for name, value in zip(LAYERS, values, strict=True)}
    origin = corner[1] * merged.resolution, corner[0] * merged.resolution
    grid = ElevationMap(files.stamp, layers, merged.resolution, origin, merged.frame_id)
    assert files.elevation is not None  # `merge` makes both
    assert files.navigation is not None
    files.elevation.add(layers, one, grid)
    cells = np.full(one.shape, Cell.UNKNOWN, np.int8)
    cells[(tiles["cells"] == Cell.FREE).any(0) & (conflicts == 0)] = Cell.FREE
    cells[(tiles["cells"] == Cell.HAZARD).any(0)] = Cell.HAZARD
    files.navigation.add({"cells": cells}, cells != Cell.UNKNOWN, grid)


def _region(result: Path, lost: Counter[str] | None) -> tuple[Mosaic, dict[tuple[int, int], Array], int]:
    """The regional map of a log: its grid, its tiles of `_CELL`, and the last stamp."""
    regions = regions_of(result, lost, REGIONAL, "leave it out", colored=False)
    if len(regions) > 1:
        names = ", ".join(regions)
        raise LogError(f"the regional map of {result} was reset (parts {names}); merging needs a map in one part")
    (region,) = regions.values()
    terrain = region.elevation
    if terrain is None or "variance" not in terrain.fills:
        raise LogError(f"the regional map of {result} has no variance; run a pipeline with FuseRegion, such as rover")
    tiles = dict[tuple[int, int], Array]()
    for index, layers in terrain.tiles():
        tile = tiles[index] = np.zeros(layers["elevation"].shape, _CELL)
        known = np.isfinite(layers["elevation"]) & (layers["variance"] > 0)
        tile["elevation"] = np.where(known, layers["elevation"], np.nan)
        tile["variance"] = np.where(known, layers["variance"], np.nan)
        tile["cells"] = Cell.UNKNOWN
    for index, layers in region.navigation.tiles() if region.navigation else ():
        if index in tiles:
            tiles[index]["cells"] = layers["cells"]
    return terrain, tiles, region.stamp
