"""Parameters of semi-global matching, as the kernels read them."""

from __future__ import annotations

from typing import NamedTuple

from stages.data import Array


class SgmParams(NamedTuple):
    """The parameters of one search; `stages.Match` documents their meaning."""

    diagonals: bool  # 8 paths, or 4
    p1: int
    p2_table: Array  # (256,) uint8, p2 for each step of brightness
    unseen_cost: int  # cost of a partner outside the right image
    disparities: int
    min_disparity: int
    uniqueness: int
    lr_tolerance: int
    max_speckle_size: int
    confidence_of: Array  # (256,) float32, confidence for each value of the evidence
    keep_costs: bool
