"""Semi-global matching (Hirschmüller, 2008; section 3.1 of the paper), compiled, on one or two threads.

The cost is the census transform with the truncated gradient difference, smoothed over 3x3. Byte vectors hold the sums
of 8 paths. One pass over these sums gives the disparity, its fraction of a pixel and the left-right check
(stages.matching.kernels.semiglobal).
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from flow.contracts import StageError
from stages.data import Array, Disparity, PixelOrigin, StereoCamera, StereoFrame
from stages.data.rows import disparity_rows, frame_rows, with_rows
from stages.matching.denoise import denoised
from stages.matching.far_rows import far_rows
from stages.matching.image_noise import frame_noise
from stages.matching.intensity import gray_pair
from stages.matching.kernels.gradient import steep_slope
from stages.matching.kernels.prior_cost import MAX_GAIN, prior_costs
from stages.matching.kernels.row_ranges import Range, lanes_for, row_ranges, whole_range
from stages.matching.kernels.semiglobal import Matches, match
from stages.matching.kernels.sgm_local import SearchWindows, windows_around
from stages.matching.kernels.sgm_params import SgmParams
from stages.matching.kernels.texture import information, match_variance, noise_ratio, slopes
from stages.stage import Stage, check_rectified, check_types, parameter

F32 = np.float32
MIN_SIDE = 16  # px, of an image
RANGE_TOLERANCE = 2.0  # px; a prior farther outside the search range shows that the match is not in it
MAX_BYTE, MAX_COST = 255, 59  # of the sums of paths, and of the cost
P2_EDGE_SCALE = 10.0  # gray levels, the step of brightness that halves p2
MAX_PRIOR_DISTANCE = 4.0  # px, from which the prior's cost grows no more
SearchArea = SearchWindows | list[Range]


# Share of matches within 1 px of the truth, by their lead: the difference between the best sum of paths and the best of
# all but its neighbours. On the eight quarter-size Middlebury scenes: occluded pixels count, every scene counts the
# same, monotone fit.
LEADS = (0, 20, 40, 60, 80, 100, 120, 140, 160, 180, 200, 220, 240, 254, 255)
CONFIDENCES = (.45, .492, .553, .632, .703, .767, .821, .866, .894, .923, .958, .975, .980, .987, .994)  # fmt: skip


@dataclass(frozen=True)
class Match(Stage):
    """Disparities of a rectified frame by semi-global matching; `source` says why a pixel has none.

    `prior`, an earlier or coarser result of the same size, attracts the search; it is no evidence. The confidence is
    the probability that the disparity is right within 1 px, for the default penalties and 8 paths. 16-bit images are
    stretched to 8 bits, from the 0.1th to the 99.9th percentile of both. See docs/matching.md.

    References
    ----------
    H. Hirschmüller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 30(2), 2008.

    Examples
    --------
    >>> import numpy as np
    >>> from stages import Match, StereoCamera, StereoFrame
    >>> scene = np.random.default_rng(0).integers(0, 256, (48, 85), np.uint8)
    >>> camera = StereoCamera(fx=100, fy=100, cx=40, cy=24, baseline=0.1, width=80, height=48)
    >>> disparity = Match(disparities=16)(StereoFrame(0, scene[:, :80], scene[:, 5:], camera))
    >>> disparity.pixels.shape, round(float(np.nanmedian(disparity.pixels)), 1)
    ((48, 80), 5.0)
    """

    disparities: int = parameter(
        192, "number of disparities searched; the two end values are never reported", unit="px", low=1, high=1024
    )
    min_disparity: int = parameter(0, "smallest disparity searched", unit="px", low=-1024, high=1024)
    max_depth: float = parameter(0.0, "depth beyond which disparities are not searched; 0: no limit", unit="m", low=0)
    paths: int = parameter(8, "directions of aggregation", choices=(4, 8))
    p1: int = parameter(
        16,
        "penalty of a disparity step of 1 px, in units of the cost (1.5 per differing census bit)",
        low=0,
        high=100,
    )
    p2: int = parameter(
        100, "penalty of a larger step where the image has no edge; above p1", low=0, high=MAX_BYTE - MAX_COST
    )
    unseen_cost: int = parameter(
        40, "cost of a match outside the right image. Without a good prior it must be larger, or such matches win over "
        "those of near ground", low=0, high=MAX_COST,
    )  # fmt: skip
    uniqueness: int = parameter(0, "margin by which the best path sum must beat the next", low=0, high=254)
    lr_tolerance: int = parameter(2, "largest left-right difference", unit="px", low=0, high=64)
    max_speckle_size: int = parameter(40, "largest isolated patch that is dropped, in pixels", low=0, high=10**9)
    prior_weight: float = parameter(0.5, "cost of each pixel of distance from the prior", low=0, high=16)
    weak_texture_gain: float = parameter(
        4.0, "factor of `prior_weight` where noise leaves a match uncertain by 1 px", low=1, high=MAX_GAIN
    )
    follow_slopes: bool = parameter(
        False, "smooth the cost along steep slopes of the prior: fewer errors at rocks, but matches reach farther over "
        "ground that they hide",
    )  # fmt: skip
    denoise: bool = parameter(
        False, "remove noise above 1.25 gray levels before the match; image and prior determine its level"
    )  # fmt: skip
    search_radius: int = parameter(
        0, "smallest distance searched around the prior; pixels without a prior are not searched; 0: the whole range",
        unit="px", low=0, high=64,
    )  # fmt: skip
    band_height: int = parameter(
        0, "height of bands of rows, each searched for the prior's range of disparities in it; 0: the whole range",
        unit="px", low=0,
    )  # fmt: skip
    out_of_range: str = parameter(
        "unknown", "pixels whose prior is nearer than the search range: unknown, or copied from the prior",
        choices=("unknown", "prior"),
    )  # fmt: skip
    max_prior_step: float = parameter(
        0.0, "depth step of a pixel at half size up to which rows of near ground are copied from the prior; 0: none",
        unit="m", low=0,
    )  # fmt: skip
    max_prior_depth: float = parameter(
        0.0, "with `max_prior_step`, depth beyond which rows are copied from the prior as well; 0: none",
        unit="m", low=0,
    )  # fmt: skip
    keep_costs: bool = parameter(
        False, "keep the lowest path sums of each pixel in the result; a run with a recording sets it"
    )
    threads: int = parameter(1, "largest number of cores for a frame (two are used); same result", low=1)
    max_memory: int = parameter(
        400, "memory for the sums of paths; larger frames are matched in stripes, with the same result",
        unit="MB", low=1,
    )  # fmt: skip

    large = True  # the sums of all paths take hundreds of MB

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.search_radius and self.band_height:
            raise ValueError("Match.band_height has no effect with Match.search_radius; set one of them to 0")
        if not self.p2 > self.p1:
            raise ValueError(f"Match.p2 must be above Match.p1 = {self.p1}, not {self.p2}")

    def check_inputs(self, inputs: Collection[str]) -> None:
        """Raise ValueError if a setting needs a prior that is not among the `inputs`, names of ports."""
        for name, unit in (("search_radius", "px"), ("band_height", "px"), ("max_prior_step", "m")):
            value = getattr(self, name)
            if value and "prior" not in inputs:
                raise ValueError(f"Match.{name} = {value} {unit} needs a `prior`: connect one, or set {name} to 0")
        if self.follow_slopes and "prior" not in inputs:
            raise ValueError("Match.follow_slopes needs a `prior`: connect one, or set it to false")

    def __call__(self, frame: StereoFrame, prior: Disparity | None = None) -> Disparity:
        """The left disparity of the rectified `frame`."""
        self._check(frame, prior)
        if prior is None or not self.max_prior_step:
            return self._matched(frame, prior)
        first, end = far_rows(prior, frame.camera, self.max_prior_step, self.max_prior_depth)
        first = max(min(first, end - MIN_SIDE, len(frame.left) - MIN_SIDE), 0)
        end = max(end, first + MIN_SIDE)
        found = self._matched(frame.once(frame_rows, first, end), disparity_rows(prior, first, end))
        return with_rows(replace(prior, camera=frame.camera), first, found)

    def _matched(self, frame: StereoFrame, prior: Disparity | None) -> Disparity:
        left, right = frame.once(gray_pair)
        search = self._search_range(frame.camera)
        area = self._search_area(prior, search, len(left))
        guide: tuple[Array, ...] | None = None
        if prior is not None:
            gain, left, right = self._noise_measures(prior, frame)
            guide = self._prior_costs(prior, search, area, gain)
            if self.follow_slopes:
                guide = *guide, steep_slope(prior.pixels)
        excluded = None if prior is None else self._excluded(prior, search, area)
        found = match(left, right, self._params(search), guide, area, excluded, self.threads, self.max_memory << 20)
        if prior is not None and self.out_of_range == "prior" and not self.search_radius:
            _copy_nearer(prior, search, found)
        if self.max_depth:
            _drop_farther(self._max_depth_disparity(frame.camera), found)
        pixels, source, confidence, costs = found
        return Disparity(frame.stamp, pixels, source, confidence, camera=frame.camera, costs=costs)

    def _check(self, frame: StereoFrame, prior: Disparity | None) -> None:
        check_rectified(self, frame)
        height, width = frame.left.shape[:2]
        if min(height, width) < MIN_SIDE:
            raise StageError(f"Match: images are {width}x{height}, each side must be at least {MIN_SIDE} px")
        if not -width < self.min_disparity < width:
            raise StageError(
                f"Match.min_disparity = {self.min_disparity} px leaves nothing to compare in images {width} px wide"
            )
        self.check_inputs({"frame"} if prior is None else {"frame", "prior"})
        if prior is None:
            return
        check_types(self, prior=prior)
        if prior.pixels.shape != (height, width):
            raise StageError(
                f"Match: the prior has shape {prior.pixels.shape}, the images {(height, width)}; "
                "enlarge a coarser prior by stages.Upsample"
            )

    def _search_range(self, camera: StereoCamera) -> range:
        """The disparities that are searched; with `search_radius` only its start counts."""
        search = range(self.min_disparity, self.min_disparity + self.disparities)
        if not self.max_depth:
            return search
        last = camera.width if self.search_radius else search.stop - 1
        reach = self._max_depth_disparity(camera)
        if reach >= last:
            raise StageError(
                f"Match.max_depth = {self.max_depth} m leaves nothing to search: a depth of {self.max_depth} m is a "
                f"disparity of {reach:.0f} px, and {last} px is the largest searched"
            )
        first = math.floor(reach) - 1  # the first value of a range is never reported
        return range(max(search.start, first), max(search.stop, first + 1))

    def _max_depth_disparity(self, camera: StereoCamera) -> float:
        return camera.fx * camera.baseline / self.max_depth - (camera.cx_right - camera.cx)

    def _search_area(self, prior: Disparity | None, search: range, rows: int) -> SearchArea:
        """The disparities that are searched at each pixel, or in each band of rows."""
        if prior is not None and self.search_radius:
            return windows_around(prior.pixels, self.search_radius, search.start)
        if prior is not None and self.band_height:
            return row_ranges(prior.pixels, self.band_height, search.start, len(search))
        return whole_range(rows, len(search))

    def _noise_measures(self, prior: Disparity, frame: StereoFrame) -> tuple[Array | None, Array, Array]:
        """What noise asks for: the factor of `prior_weight` in each block of pixels, or None, and the images to match.

        Noise is what the left image shows as such and what the two images do not share at the prior's disparities.
        """
        left, right = frame.once(gray_pair)
        weighted = self.prior_weight > 0 and self.weak_texture_gain > 1
        if not weighted and not self.denoise:
            return None, left, right
        both, noise = frame.once(slopes), frame.once(frame_noise)
        ratio = noise_ratio(prior.pixels, left, both, noise, self.threads)
        gain = None
        if weighted:
            seen = information(left, both[0], noise * F32(math.sqrt(max(ratio, 1))), self.threads)
            gain = 1 + F32(self.weak_texture_gain - 1) * np.minimum(match_variance(seen), 1)
        if self.denoise:
            left, right = denoised((left, right), noise * F32(math.sqrt(min(ratio, 1))), self.threads)
        return gain, left, right

    def _prior_costs(
        self, prior: Disparity, search: range, area: SearchArea, gain: Array | None
    ) -> tuple[Array, Array]:
        if isinstance(area, SearchWindows):
            first, lanes = area.first, area.width.lanes
        else:
            firsts = [np.full((each.end - each.top, 1), search.start + each.first, np.int32) for each in area]
            first, lanes = np.concatenate(firsts), lanes_for(len(search))
        return prior_costs(prior.pixels, first, lanes, self.prior_weight, MAX_PRIOR_DISTANCE, gain)

    def _excluded(self, prior: Disparity, search: range, area: SearchArea) -> Array:
        """Why pixels are excluded from the search, (H, W) uint8: codes of `PixelOrigin`, 0 where they are searched.

        The prior shows that their match is not in the range. With `search_radius`, pixels without a prior are excluded
        as well, for the prior's own reason where it has one.
        """
        if isinstance(area, SearchWindows):
            guided = (prior.pixels >= search.start - RANGE_TOLERANCE) & (prior.pixels < prior.pixels.shape[1])
            reason = np.where(prior.source > PixelOrigin.FILLED, prior.source, np.uint8(PixelOrigin.OUT_OF_RANGE))
            return np.where(guided, np.uint8(0), reason)
        excluded = np.empty(prior.pixels.shape, bool)
        for each in area:
            rows, first = slice(each.top, each.end), search.start + each.first
            excluded[rows] = prior.pixels[rows] > first + min(each.width.lanes, len(search)) + RANGE_TOLERANCE
            if first > self.min_disparity:
                excluded[rows] |= prior.pixels[rows] < first - RANGE_TOLERANCE
        excluded &= prior.source == PixelOrigin.MEASURED
        return excluded * np.uint8(PixelOrigin.OUT_OF_RANGE)

    def _params(self, search: range) -> SgmParams:
        falling = np.maximum(self.p1 + 2, np.round(self.p2 / (1 + np.arange(256) / P2_EDGE_SCALE)))
        confidence = np.interp(np.arange(256), LEADS, CONFIDENCES).astype(np.float32)
        confidence[0] = 0  # unknown
        return SgmParams(
            diagonals=self.paths == 8, p1=self.p1, p2_table=np.minimum(falling, self.p2).astype(np.uint8),
            unseen_cost=self.unseen_cost, disparities=len(search), min_disparity=search.start,
            uniqueness=self.uniqueness, lr_tolerance=self.lr_tolerance, max_speckle_size=self.max_speckle_size,
            confidence_of=confidence, keep_costs=self.keep_costs,
        )  # fmt: skip


def _copy_nearer(prior: Disparity, search: range, found: Matches) -> None:
    """Copy into `found` the pixels that the prior measures at or beyond the near end of the search range."""
    copied = prior.pixels > search.stop - RANGE_TOLERANCE
    if not copied.any():
        return
    copied &= np.isnan(found.pixels) & (prior.source == PixelOrigin.MEASURED) & (prior.pixels < prior.pixels.shape[1])
    for layer, known in zip(found[:3], (prior.pixels, prior.source, prior.confidence), strict=True):
        np.copyto(layer, known, where=copied)


def _drop_farther(reach: float, found: Matches) -> None:
    """Drop disparities below `reach`, px: the search range extends a little farther."""
    farther = found.pixels < reach
    found.pixels[farther], found.source[farther], found.confidence[farther] = np.nan, PixelOrigin.OUT_OF_RANGE, 0
