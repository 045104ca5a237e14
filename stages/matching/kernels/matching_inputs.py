"""The planes of bytes that semi-global matching reads, computed once for a frame."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from stages.compiled.parallel import Fork, in_turn
from stages.compiled.simd import Width
from stages.data import Array
from stages.matching.kernels.aggregation import brightness_steps
from stages.matching.kernels.census import census
from stages.matching.kernels.gradient import PLANES, gradients
from stages.matching.kernels.sgm_params import SgmParams

NO_PRIOR = np.zeros((1, 0), np.int32), np.zeros(1, np.uint8)
NO_SLOPE = np.zeros((1, 0), np.int8)


class MatchingInputs(NamedTuple):
    """Planes of the images for a search with n lanes."""

    left: Array  # (H, 5, >= W) uint8: bits of census, gradients
    right: Array  # (H, 5, >= W + n) uint8: the same of the right image, backwards from the smallest disparity on
    steps: Array  # of `brightness_steps`
    outside: Array  # (W + n,) uint8: 255 where an element of `right` is outside the image
    in_view_from: int  # elements of `right` from which n and more, of the whole range, are inside
    in_view_to: int
    prior: Array  # (H, W) int32: where in `prior_costs` the costs of a pixel begin; or none
    prior_costs: Array  # (m,) uint8
    slope: Array = NO_SLOPE  # of `gradient.steep_slope`, or none


def matching_inputs(
    left: Array,
    right: Array,
    params: SgmParams,
    width: Width,
    prior: tuple[Array, ...] | None = None,
    run_both: Fork = in_turn,
) -> MatchingInputs:
    """The planes of gray images, (H, W) uint8. prior: as in `semiglobal.match`."""
    columns = left.shape[1]
    (left_planes, steps), right_planes = run_both(
        lambda: (_planes(left, params), brightness_steps(left)), lambda: _planes(right, params, width)
    )
    place = np.arange(columns + width.lanes) + params.min_disparity
    outside = np.where((place < 0) | (place > columns - 1), np.uint8(255), np.uint8(0))
    in_view_from, in_view_to = max(0, -params.min_disparity), columns + 1 - params.min_disparity - width.lanes
    return MatchingInputs(left_planes, right_planes, steps, outside, in_view_from, in_view_to, *(prior or NO_PRIOR))


def _planes(image: Array, params: SgmParams, width: Width | None = None) -> Array:
    """The planes of an image; with `width` those of the right image, mirrored and shifted by the smallest disparity."""
    backwards, after = width is not None, 0
    if width is not None:
        before, after = max(0, -params.min_disparity), max(0, params.min_disparity)
        image = cv2.copyMakeBorder(cv2.flip(image, 1), 0, 0, before, after + width.lanes, cv2.BORDER_REPLICATE)
    planes = np.empty((image.shape[0], PLANES, -(-image.shape[1] // 64) * 64), np.uint8)
    census(image, planes, backwards)
    gradients(image, planes, backwards)
    return planes if after == 0 else np.ascontiguousarray(planes[:, :, after:])
