"""Semi-global matching (Hirschmüller, 2008; section 3.1 of the paper), compiled, in bytes, on any number of cores.

The cost is the census transform, by default with the truncated gradient difference, smoothed over 3x3. The sums of 8
paths decide the disparity, its fraction of a pixel, and whether left and right agree, in one go
(stages.matching.kernels.semiglobal).
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flow.contracts import StageError
from stages.data import Array, Disparity, PixelOrigin, StereoCamera, StereoFrame
from stages.matching.intensity import eight_bit, gray
from stages.matching.kernels.prior_cost import prior_costs
from stages.matching.kernels.row_ranges import Range, lanes_for, ranges_of, whole_range
from stages.matching.kernels.semiglobal import match
from stages.matching.kernels.sgm_local import SearchWindows, windows
from stages.matching.kernels.sgm_params import SgmParams
from stages.stage import Stage, check_rectified, parameter

SMALLEST_SIDE = 16
BEYOND = 2.0  # px; a prior so far outside the range says that the match is not in it
LARGEST_BYTE = 255


class Cost(NamedTuple):
    """A matching cost, and what suits it: found on the eight quarter-size Middlebury scenes."""

    largest: int
    unseen: int  # where the partner lies outside the right image
    p1: int
    p2: int
    # Share of matches within 1 px of the truth (among those kept, occluded pixels included, every scene counting the
    # same) by their lead: by how much the best sum of paths beat all but its neighbours. Least squares, monotone.
    right: tuple[float, ...]


LEADS = (0, 20, 40, 60, 80, 100, 120, 140, 160, 180, 200, 220, 240, 254, 255)
COSTS = {
    "census": Cost(24, 12, 12, 70, (
        .50, .595, .703, .806, .876, .925, .956, .973, .983, .989, .993, .996, .997, .998, .998,
    )),
    "census+gradient": Cost(59, 40, 16, 100, (
        .45, .492, .553, .632, .703, .767, .821, .866, .894, .923, .958, .975, .980, .987, .994,
    )),
}  # fmt: skip


@dataclass(frozen=True)
class Match(Stage):
    """Disparities of a rectified frame; unknown where no unique and consistent match was found.

    Penalties count in units of the matching cost: census bits that differ, or with the gradient 1.5 units for each.
    Colour is converted to gray. `prior`, an earlier or coarser result of the same size, draws the search towards it; it
    is no evidence, and where it is unknown it says nothing. What it measured nearer than the search range stays
    unknown, or with `out_of_range` prior as the prior has it: a coarse search reaches nearer, and so near that is no
    loss. With `max_depth`, what it measured beyond stays unknown, too. Without a prior some of both is taken for
    something within the range.

    With `search_radius` only what is near to the prior is searched: in a fraction of the time, beyond the range, too,
    and not at all where the prior is unknown or beyond `max_depth`. Of each pixel `2 search_radius + 7` disparities,
    rounded up to 16, are searched, which take 2 bytes each, whatever `max_memory` is.

    With a `band_height` each band of rows is searched for what the prior has in it, but for a thousandth at either end,
    and for 8 px more to either side, in all for 64 or 128 disparities or, where that is not enough or the prior knows
    less than half of the band, the whole range. Rows of ground need little of it, and so less time: the prior should
    have few holes, for what is in them is found in the band's range only, and what it has outside that is unknown.

    The confidence is the probability that the disparity is right within 1 px, as far as the lead of the best sum of
    paths over the others tells, with the penalties that suit the cost and 8 paths.
    """

    disparities: int = parameter(
        192, "size of the search range, of which the first and the last only bound the others and are not found",
        unit="px", low=1, high=1024,
    )  # fmt: skip
    min_disparity: int = parameter(0, "smallest disparity searched", unit="px", low=-1024, high=1024)
    max_depth: float = parameter(
        0.0, "depth beyond which nothing is of interest and disparities are not searched; 0: no limit", unit="m", low=0
    )
    cost: str = parameter("census+gradient", "what is compared", choices=tuple(COSTS))
    paths: int = parameter(8, "directions of aggregation", choices=(4, 8))
    p1: int = parameter(0, "penalty of a step of 1 px; 0: the one that suits the cost", low=0, high=100)
    p2: int = parameter(0, "penalty of a larger step where the image is even; 0: the one that suits", low=0, high=230)
    p2_edge_scale: float = parameter(10.0, "step of brightness that halves p2", unit="gray levels", low=0.1)
    uniqueness: int = parameter(0, "by how much the best sum of paths must beat the next", low=0, high=254)
    lr_tolerance: int = parameter(2, "largest left-right difference", unit="px", low=0, high=64)
    max_speckle_size: int = parameter(40, "largest isolated patch that is dropped, in pixels", low=0)
    speckle_range: float = parameter(1.0, "disparity step that separates patches", unit="px", low=0)
    prior_weight: float = parameter(0.5, "cost of each pixel of distance from the prior", low=0, high=16)
    max_prior_distance: float = parameter(
        4.0, "distance from which the prior's cost grows no more", unit="px", low=0, high=64
    )
    search_radius: int = parameter(
        0, "how far about the prior, at least, and nowhere else is searched; 0: the whole range",
        unit="px", low=0, high=64,
    )  # fmt: skip
    band_height: int = parameter(
        0, "of bands of rows, each of which is searched only for what the prior has in it; 0: the whole range",
        unit="px", low=0,
    )  # fmt: skip
    out_of_range: str = parameter(
        "unknown", "what becomes of matches that the prior has nearer than the range", choices=("unknown", "prior")
    )
    threads: int = parameter(1, "most cores for one frame (two are used); never changes the result", low=1)
    max_memory: int = parameter(
        400, "for the sums of paths; larger frames are swept in parts, to the same result", unit="MB", low=1
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.search_radius and self.band_height:
            raise ValueError(
                "Match.band_height means nothing with Match.search_radius, which searches less; let one of them be 0"
            )
        largest, (p1, p2) = COSTS[self.cost].largest, self._penalties()
        if not p2 > p1:
            raise ValueError(f"Match.p2 must be above Match.p1 = {p1}, not {p2}")
        if largest + p2 > LARGEST_BYTE:
            raise ValueError(f"Match.p2 must be at most {LARGEST_BYTE - largest} with cost {self.cost}, not {p2}")

    def check_inputs(self, inputs: Collection[str]) -> None:
        """Refuse to search about a prior where none is among the `inputs`, names of ports."""
        for name, value in (("search_radius", self.search_radius), ("band_height", self.band_height)):
            if value and "prior" not in inputs:
                raise ValueError(f"Match.{name} = {value} px needs a `prior` to search about; name one, or let it be 0")

    def __call__(self, frame: StereoFrame, prior: Disparity | None = None) -> Disparity:
        self._check(frame, prior)
        search = self._search(frame.camera)
        left, right = (gray(image) for image in eight_bit(frame.left, frame.right))
        where = self._where(prior, search, len(left))
        guide = None if prior is None else self._guide(prior, search, where)
        excluded = None if prior is None else self._excluded(prior, search, where)
        found = match(left, right, self._rule(search), guide, where, excluded, self.threads, self.max_memory << 20)
        layers = found.pixels, found.source, found.confidence
        if prior is not None and self.out_of_range == "prior" and not self.search_radius:
            # The search loses what lies within a pixel or two of its end, too.
            taken = np.isnan(found.pixels) & (prior.source == PixelOrigin.MEASURED)
            taken &= (prior.pixels > search.stop - BEYOND) & (prior.pixels < frame.camera.width)
            for layer, known in zip(layers, (prior.pixels, prior.source, prior.confidence), strict=True):
                np.copyto(layer, known, where=taken)
        if self.max_depth:  # what bounds the range reaches a little beyond
            beyond = found.pixels < self._reach(frame.camera)
            for layer, unknown in zip(layers, (np.nan, PixelOrigin.OUT_OF_RANGE, 0), strict=True):
                layer[beyond] = unknown
        return Disparity(frame.stamp, *layers, camera=frame.camera)

    def _where(self, prior: Disparity | None, search: range, rows: int) -> SearchWindows | list[Range]:
        """Where to search, and what for."""
        if prior is not None and self.search_radius:
            return windows(prior.pixels, self.search_radius, search.start, self.threads)
        if prior is not None and self.band_height:
            return ranges_of(prior.pixels, self.band_height, search.start, len(search), self.threads)
        return whole_range(rows, len(search))

    def _excluded(self, prior: Disparity, search: range, where: SearchWindows | list[Range]) -> Array:
        """Why pixels are excluded from the search, (H, W) uint8: codes of `PixelOrigin`, 0 where they are searched.

        The prior shows that their match is not in the range. With `search_radius`, pixels without a prior are excluded
        too, for the prior's own reason where it has one.
        """
        if isinstance(where, SearchWindows):
            guided = (prior.pixels >= search.start - BEYOND) & (prior.pixels < prior.pixels.shape[1])
            reason = np.where(prior.source > PixelOrigin.FILLED, prior.source, np.uint8(PixelOrigin.OUT_OF_RANGE))
            return np.where(guided, np.uint8(0), reason)
        excluded = np.empty(prior.pixels.shape, bool)
        for each in where:
            rows, first = slice(each.top, each.end), search.start + each.first
            excluded[rows] = prior.pixels[rows] > first + min(each.width.lanes, len(search)) + BEYOND
            if first > self.min_disparity:
                excluded[rows] |= prior.pixels[rows] < first - BEYOND
        excluded &= prior.source == PixelOrigin.MEASURED
        return excluded * np.uint8(PixelOrigin.OUT_OF_RANGE)

    def _check(self, frame: StereoFrame, prior: Disparity | None) -> None:
        height, width = frame.left.shape[:2]
        check_rectified(self, frame)
        if min(height, width) < SMALLEST_SIDE:
            raise StageError(f"Match: images are {width}x{height}, each side must be at least {SMALLEST_SIDE} px")
        if not -width < self.min_disparity < width:
            raise StageError(
                f"Match.min_disparity = {self.min_disparity} px leaves nothing to compare in images {width} px wide"
            )
        self.check_inputs({"frame"} if prior is None else {"frame", "prior"})
        if prior is not None and not isinstance(prior, Disparity):
            raise StageError(f"Match: the prior must be a stages.Disparity, not a {type(prior).__name__}")
        if prior is not None and prior.pixels.shape != (height, width):
            raise StageError(
                f"Match: the prior has shape {prior.pixels.shape}, the images {(height, width)}; "
                "stages.Upsample makes a coarser one fit"
            )

    def _penalties(self) -> tuple[int, int]:
        cost = COSTS[self.cost]
        return self.p1 or cost.p1, self.p2 or cost.p2

    def _search(self, camera: StereoCamera) -> range:
        """The disparities that are searched; with `search_radius` the first of them counts."""
        search = range(self.min_disparity, self.min_disparity + self.disparities)
        if not self.max_depth:
            return search
        largest = camera.width if self.search_radius else search.stop - 1
        reach = self._reach(camera)
        if reach >= largest:
            raise StageError(
                f"Match.max_depth = {self.max_depth} m leaves nothing to search: a depth of {self.max_depth} m is a "
                f"disparity of {reach:.0f} px, and {largest} px is the largest searched"
            )
        limit = math.floor(reach) - 1  # the first that is searched is not found
        return range(max(search.start, limit), max(search.stop, limit + 1))

    def _reach(self, camera: StereoCamera) -> float:
        """The disparity of `max_depth`, px."""
        return camera.fx * camera.baseline / self.max_depth - (camera.cx_right - camera.cx)

    def _rule(self, search: range) -> SgmParams:
        cost, (p1, p2) = COSTS[self.cost], self._penalties()
        falling = np.maximum(p1 + 2, np.round(p2 / (1 + np.arange(256) / self.p2_edge_scale)))
        confidence = np.interp(np.arange(256), LEADS, cost.right).astype(np.float32)
        confidence[0] = 0  # unknown
        return SgmParams(
            self.cost == "census+gradient", self.paths == 8, p1, np.minimum(falling, p2).astype(np.uint8), cost.unseen,
            len(search), search.start, self.uniqueness, self.lr_tolerance, self.speckle_range, self.max_speckle_size,
            confidence,
        )  # fmt: skip

    def _guide(self, prior: Disparity, search: range, where: SearchWindows | list[Range]) -> tuple[Array, Array]:
        if isinstance(where, SearchWindows):
            first, lanes = where.first, where.width.lanes
        else:
            firsts = [np.full((each.end - each.top, 1), search.start + each.first, np.int32) for each in where]
            first, lanes = np.concatenate(firsts), lanes_for(len(search))
        return prior_costs(prior.pixels, first, lanes, self.prior_weight, self.max_prior_distance, self.threads)
