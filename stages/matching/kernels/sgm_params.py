"""What the matcher's searches are told."""

from __future__ import annotations

from typing import NamedTuple

from stages.data import Array


class SgmParams(NamedTuple):
    """How to match: see `stages.Match` for the meaning of each."""

    gradient: bool  # census and gradient, or census alone
    diagonals: bool  # 8 paths, or 4
    p1: int
    table: Array  # (256,) uint8, p2 for each step of brightness
    unseen: int  # cost of a partner outside the right image
    disparities: int
    minimum: int
    uniqueness: int
    consistency: int
    speckle_range: float
    speckle_size: int
    calibration: Array  # (256,) float32, confidence for each amount of evidence
