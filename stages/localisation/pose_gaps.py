"""Finds where the logged pose moves as no rover that drives on, while visual odometry has no track.

Only the drive itself is known there. A rover goes on in the direction in which it drives before or after, and not much
faster. Odometry that starts again is back where the first frame was.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.data import Array
from stages.localisation.pose_jumps import Move, PoseJumps

MIN_UNSEEN = 0.5  # m, without a track
MAX_SPEEDUP = 3.0  # over the speed before, after and by the images
MIN_GAP = 5.0  # intervals of the frames
SPEED_IN_GAP = 0.5  # m/s, at which a rover may drive between stops
MIN_FORWARD = 0.5  # cosine of the angle between a motion and the direction of the drive: 60 degrees
MIN_MOVE = 0.05  # m; shorter moves have no direction
MAX_RETURN = 0.1  # m, from the first frame, of odometry that started again


def gap_problem(jumps: PoseJumps) -> str:
    """What is wrong with the poses where visual odometry has no track, in a sentence; empty if nothing is."""
    moves = jumps.moves
    seen = [float(np.linalg.norm(move.velocity)) for move in moves if move.visual is not None]
    if not seen:
        return ""
    gap = MIN_GAP * float(np.median([move.seconds for move in moves]))
    found = [
        (move, why) for at, move in enumerate(moves)
        if move.visual is None and (why := _unexplained(moves, at, jumps.first[1], max(seen), gap))
    ]  # fmt: skip
    if not found:
        return ""
    move, why = found[0]
    more = f", and {len(found) - 1} more of this kind" if len(found) > 1 else ""
    return (
        f"Without a track of visual odometry, the logged pose moves by {np.linalg.norm(move.shift):.1f} m between "
        f"{jumps.seconds(move.start):.1f} s and {jumps.seconds(move.end):.1f} s after the first frame, {why}{more}. "
        "If the odometry started again, the regional map joins two places that are not aligned: run each part of "
        "the log alone with --start and --end."
    )


def _unexplained(moves: Sequence[Move], at: int, first: Array, fastest: float, gap: float) -> str:
    """Why a move without a track is not that of a rover that drives on; empty if it may be.

    first: (3,) m, where the first frame was; fastest: by the images, m/s; gap: s, of a time without frames.
    """
    move, is_gap = moves[at], moves[at].seconds >= gap
    if np.linalg.norm(move.shift) < MIN_UNSEEN:
        return ""
    usual = max([fastest, *(other.speed for other in [*moves[max(at - 2, 0) : at], *moves[at + 1 : at + 3]])])
    if move.speed > MAX_SPEEDUP * max(usual, SPEED_IN_GAP if is_gap else 0.0):
        return f"at {move.speed:.2g} m/s, though it drives at most {usual:.2g} m/s before, after and by the images"
    if not is_gap:
        return ""
    if np.linalg.norm(move.place - first) < MAX_RETURN:
        return "back to where it began"
    before, after = (
        next((other for other in part if np.linalg.norm(other.shift) > MIN_MOVE), None)
        for part in (reversed(moves[:at]), moves[at + 1 :])
    )
    along = [_cosine(move.shift, before.shift)] if before else []
    along += [_cosine(move.arrival, after.arrival)] if after else []
    return "against the direction of the drive before and after" if along and max(along) < MIN_FORWARD else ""


def _cosine(one: Array, other: Array) -> float:
    """Of the angle between two vectors (3,)."""
    return float(one @ other / (np.linalg.norm(one) * np.linalg.norm(other)))
