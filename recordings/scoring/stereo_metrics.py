"""Disparity errors as Middlebury counts them (Scharstein et al., GCPR 2014). Pure functions over arrays, no files.

A pixel is scored if its true disparity is known: `nonocc` if both cameras see it, `occluded` if only one does, `all` of
them; over the whole image, and without the leftmost columns, which have no partner in the right image. Unlike
Middlebury's own code, disparities are not clipped to the search range, so an outlier counts with its full error. The
one trick: every pixel belongs to one of six disjoint classes. Their sums add up over frames, so every pixel, not every
frame, counts the same, and any region is a sum of classes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recordings.scoring.metrics import share
from stages.data import Array

THRESHOLDS = (0.5, 1.0, 2.0, 4.0)  # px
SEEN_BY_BOTH, SEEN_BY_ONE, SEEN_BY_NONE = 255, 128, 0  # the codes of an occlusion mask
CROP_STEP = 16  # columns; the paper's code crops by its number of disparities, a multiple of 16
REGIONS = {"nonocc": (0,), "all": (0, 1, 2), "occluded": (1,)}  # of the classes both, one, neither or unknown
SURFACES = {"sand": 1, "gravel": 2, "dust": 3, "rock": 4}  # codes of /truth/terrain_class
_KINDS, _SIDES = 3, 2  # classes: how many cameras see it, times left or right of the crop
_SUMS = ("pixels", "known", "absolute", "squares", *(f"over_{limit:g}" for limit in THRESHOLDS))


def cropped_columns(disparities: float) -> int:
    """The columns to crop for a range of `disparities` px: rounded up to 16; none for NaN."""
    return CROP_STEP * math.ceil(max(disparities, 0.0) / CROP_STEP) if math.isfinite(disparities) else 0


@dataclass(frozen=True, eq=False)
class StereoErrors:
    """Sums of disparity errors; two of them can be added.

    sums: name -> (3, 2) float64, over the classes (seen by both, by one, by neither or unknown) and (left of the crop,
    right of it). values: number of estimated disparities; without_truth: those at pixels without a true one. columns:
    the widths of the crop that occurred.
    """

    sums: dict[str, Array] = field(default_factory=lambda: {name: np.zeros((_KINDS, _SIDES)) for name in _SUMS})
    values: int = 0
    without_truth: int = 0
    columns: frozenset[int] = frozenset()

    @classmethod
    def of(cls, estimate: Array, truth: Array, occlusion: Array | None, columns: int) -> StereoErrors:
        """The errors of one frame.

        estimate, truth: (H, W) px, not finite = unknown; occlusion: (H, W) uint8, 255 seen by both cameras, 0 by none,
        any other code by one, None if unknown; columns: to crop.
        """
        scored, given = np.isfinite(truth), np.isfinite(estimate)
        kinds = np.full(truth.shape, 2)
        if occlusion is not None:
            kinds[occlusion == SEEN_BY_BOTH] = 0
            kinds[(occlusion != SEEN_BY_BOTH) & (occlusion != SEEN_BY_NONE)] = 1
        classes = _SIDES * kinds + (np.arange(truth.shape[1]) >= columns)
        of_scored, of_known = classes[scored], classes[scored & given]
        error = np.abs(estimate[scored & given].astype(np.float64) - truth[scored & given])
        sums = {
            "pixels": _by_class(of_scored),
            "known": _by_class(of_known),
            "absolute": _by_class(of_known, error),
            "squares": _by_class(of_known, np.square(error)),
        } | {f"over_{limit:g}": _by_class(of_known[error > limit]) for limit in THRESHOLDS}
        values = int(np.count_nonzero(given))
        return cls(sums, values, values - int(sums["known"].sum()), frozenset({columns}))

    @classmethod
    def by_surface(
        cls, estimate: Array, truth: Array, occlusion: Array | None, codes: Array
    ) -> dict[str, StereoErrors]:
        """The same for each of `SURFACES`, by the codes (H, W) of its pixels, without a crop."""
        return {
            name: cls.of(estimate, np.where(codes == code, truth, np.nan), occlusion, 0)
            for name, code in SURFACES.items()
        }

    def __add__(self, other: StereoErrors) -> StereoErrors:
        return StereoErrors(
            {name: self.sums[name] + other.sums[name] for name in _SUMS},
            self.values + other.values, self.without_truth + other.without_truth, self.columns | other.columns,
        )  # fmt: skip

    def metrics(self) -> dict[str, Any]:
        """All metrics by name.

        whole_image, cropped_image: `metrics_of` of nonocc, all and occluded each; cropped_image also has
        leftmost_columns_cropped. The metrics of nonocc in the whole image are repeated at the top, with values (number
        of estimates), given_occluded (estimates where only one camera sees: pixels, share of all estimates, bad_2) and
        given_without_truth (estimates without a true disparity, such as in the sky: pixels, share of all estimates).
        """
        whole = {name: self._region(kinds, slice(None)) for name, kinds in REGIONS.items()}
        cropped = {name: self._region(kinds, slice(1, None)) for name, kinds in REGIONS.items()}
        hidden, columns = float(self.sums["known"][1].sum()), sorted(self.columns)
        occluded = float(self.sums["pixels"][1].sum())
        return {
            **whole["nonocc"],
            "values": float(self.values),
            "given_occluded": {
                "pixels": hidden,
                "share": share(hidden, self.values if occluded else 0),
                "bad_2": whole["occluded"]["bad_2_known"],
            },
            "given_without_truth": {
                "pixels": float(self.without_truth), "share": share(self.without_truth, self.values),
            },
            "whole_image": whole,
            "cropped_image": {"leftmost_columns_cropped": columns, **cropped},
        }  # fmt: skip

    def _region(self, kinds: tuple[int, ...], sides: slice) -> dict[str, float]:
        return metrics_of({name: float(sums[list(kinds), sides].sum()) for name, sums in self.sums.items()})


def metrics_of(sums: dict[str, float]) -> dict[str, float]:
    """The metrics of summed errors.

    pixels: with a true value; density: share of them with an estimate; bad_T: share with an error above T px or without
    an estimate; bad_T_known: share of the estimates with such an error; mae, rmse: px, of the estimates.
    """
    pixels, known = sums["pixels"], sums["known"]
    metrics = {"pixels": pixels, "density": share(known, pixels)}
    for limit in THRESHOLDS:
        over = sums[f"over_{limit:g}"]
        metrics[f"bad_{limit:g}"] = share(over + pixels - known, pixels)
        metrics[f"bad_{limit:g}_known"] = share(over, known)
    return metrics | {"mae": share(sums["absolute"], known), "rmse": share(sums["squares"], known) ** 0.5}


def _by_class(classes: Array, weights: Array | None = None) -> Array:
    """Sums (3, 2) of `weights`, or counts, by class."""
    return np.bincount(classes, weights, _KINDS * _SIDES).astype(np.float64).reshape(_KINDS, _SIDES)
