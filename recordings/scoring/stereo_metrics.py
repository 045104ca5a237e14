"""Disparity errors as Middlebury counts them (Scharstein et al., GCPR 2014). Pure functions over arrays, no files.

A pixel is scored where its true disparity is known: `nonocc` where both cameras see it, `occluded` where only one does,
`all` of them; over the whole image, and without the leftmost columns, which have no partner in the right image. Unlike
Middlebury's own code it does not clip disparities to the search range first, so a value far outside costs all of its
error. The one trick: every pixel is in one of six disjoint classes, whose sums add up over frames, so that every pixel
and not every frame counts the same, and any region is a sum of classes.
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
CROP_STEP = 16  # columns; the code that the paper released crops by its number of disparities, a multiple of 16
REGIONS = {"nonocc": (0,), "all": (0, 1, 2), "occluded": (1,)}  # of the classes both, one, neither or not told
_KINDS, _SIDES = 3, 2  # classes: how many cameras see it, times left or right of the crop
_SUMS = ("pixels", "known", "absolute", "squares", *(f"over_{limit:g}" for limit in THRESHOLDS))


def cropped_columns(disparities: float) -> int:
    """How many columns a range of `disparities` px takes at the left: rounded up to 16, none of NaN."""
    return CROP_STEP * math.ceil(max(disparities, 0.0) / CROP_STEP) if math.isfinite(disparities) else 0


@dataclass(frozen=True, eq=False)
class StereoErrors:
    """Sums of disparity errors over any number of frames; the sum of two is that of all their frames.

    sums: name -> (3, 2) float64, over the classes `seen by both, by one, neither or not told` and `left of the crop,
    right of it`; values, without_truth: estimated disparities, and those of them that have no true one; columns: the
    widths of the crop that occurred.
    """

    sums: dict[str, Array] = field(default_factory=lambda: {name: np.zeros((_KINDS, _SIDES)) for name in _SUMS})
    values: int = 0
    without_truth: int = 0
    columns: frozenset[int] = frozenset()

    @classmethod
    def of(cls, estimate: Array, truth: Array, occlusion: Array | None, columns: int) -> StereoErrors:
        """The errors of one frame.

        estimate, truth: (H, W) px, not finite = unknown; occlusion: (H, W) uint8, 255 seen by both cameras, 0 by none,
        any other code by one, None where it is not known; columns: how many to crop.
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

    def __add__(self, other: StereoErrors) -> StereoErrors:
        return StereoErrors(
            {name: self.sums[name] + other.sums[name] for name in _SUMS},
            self.values + other.values, self.without_truth + other.without_truth, self.columns | other.columns,
        )  # fmt: skip

    def measures(self) -> dict[str, Any]:
        """Every measure, by name.

        whole_image, cropped_image: nonocc, all and occluded, `measures_of` each; the latter also
        leftmost_columns_cropped (every width that occurred). The measures of nonocc in the whole image stand at the top
        as well, with values (how many disparities were given), given_occluded (those at pixels that only one camera
        sees: pixels, share of all values, bad_2 the share of them off by more than 2 px) and given_without_truth (those
        where no true disparity is known, such as the sky: pixels, share of all values).
        """
        whole = {name: self._region(kinds, slice(None)) for name, kinds in REGIONS.items()}
        cropped = {name: self._region(kinds, slice(1, None)) for name, kinds in REGIONS.items()}
        hidden, columns = float(self.sums["known"][1].sum()), sorted(self.columns)
        told = float(self.sums["pixels"][1].sum())  # whether anything is known to be occluded
        return {
            **whole["nonocc"],
            "values": float(self.values),
            "given_occluded": {
                "pixels": hidden,
                "share": share(hidden, self.values if told else 0),
                "bad_2": whole["occluded"]["bad_2_known"],
            },
            "given_without_truth": {
                "pixels": float(self.without_truth), "share": share(self.without_truth, self.values),
            },
            "whole_image": whole,
            "cropped_image": {"leftmost_columns_cropped": columns, **cropped},
        }  # fmt: skip

    def _region(self, kinds: tuple[int, ...], sides: slice) -> dict[str, float]:
        return measures_of({name: float(sums[list(kinds), sides].sum()) for name, sums in self.sums.items()})


def measures_of(sums: dict[str, float]) -> dict[str, float]:
    """The measures of summed errors.

    pixels (how many have a true value), density (share of them known), bad_T (share in error by more than T px, an
    unknown pixel being bad), bad_T_known (of the known ones), mae and rmse (px, of the known ones). NaN of nothing.
    """
    pixels, known = sums["pixels"], sums["known"]
    measures = {"pixels": pixels, "density": share(known, pixels)}
    for limit in THRESHOLDS:
        over = sums[f"over_{limit:g}"]
        measures[f"bad_{limit:g}"] = share(over + pixels - known, pixels)
        measures[f"bad_{limit:g}_known"] = share(over, known)
    return measures | {"mae": share(sums["absolute"], known), "rmse": share(sums["squares"], known) ** 0.5}


def _by_class(classes: Array, weights: Array | None = None) -> Array:
    """Sums (3, 2) of `weights`, or counts, by class."""
    return np.bincount(classes, weights, _KINDS * _SIDES).astype(np.float64).reshape(_KINDS, _SIDES)
