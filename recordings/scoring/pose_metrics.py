"""How far poses stray from the true ones, as a share of the way driven.

Poses of one frame of reference are compared among themselves: place and heading are taken from the first of them, which
is where the frame has them from, and gravity gives the rest. What is in another frame (`visual_odom/2`, after tracking
was lost) begins anew, and adds its own error and its own way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages.data import Array


@dataclass
class _Part:
    """The poses of one frame of reference. turn, shift: from the given frame to the true one; last: the last true
    place, m; way: m driven; error: m, at the last pose."""

    turn: Rotation
    shift: Array
    last: Array
    way: float = 0.0
    error: float = 0.0


class PoseTally:
    """Sums up the poses of a run, frame by frame in order; messages are nav_msgs/Odometry."""

    def __init__(self) -> None:
        self.parts: dict[str, _Part] = {}
        self.frames = self.missing = self.strange = 0
        self.largest = self.heading = 0.0

    def add(self, true: Any, given: Any | None) -> dict[str, float]:
        """One frame's true pose, and the one that the run gives, None where it lacks one; the frame's own figures."""
        if given is None or given.child_frame_id != true.child_frame_id:
            self.missing += given is None
            self.strange += given is not None
            return {}
        (place, turn), (true_place, true_turn) = _placed(given), _placed(true)
        part = self.parts.get(given.header.frame_id)
        if part is None:
            onto = Rotation.from_euler("z", _heading(true_turn) - _heading(turn))
            part = _Part(onto, true_place - onto.apply(place), true_place)
            self.parts[given.header.frame_id] = part
        part.way += float(np.linalg.norm(true_place - part.last))
        part.last = true_place
        part.error = float(np.linalg.norm(part.turn.apply(place) + part.shift - true_place))
        off = math.remainder(_heading(part.turn * turn) - _heading(true_turn), 2 * math.pi)
        self.frames += 1
        self.largest, self.heading = max(self.largest, part.error), max(self.heading, abs(off))
        return {"pose_error": part.error, "pose_heading": off}

    def measures(self) -> dict[str, float] | None:
        """frames scored, missing ones and those whose pose is not of the body that the truth tells of; parts, frames of
        reference; way, m; drift: the parts' errors at their ends over their ways; largest, m; heading, rad, largest
        error. None where no pose was given."""
        if not self.frames + self.strange:
            return None
        way = sum(part.way for part in self.parts.values())
        error = sum(part.error for part in self.parts.values())
        return {
            "frames": self.frames, "missing": self.missing, "of_another_body": self.strange, "parts": len(self.parts),
            "way": way, "drift": error / way if way > 0 else math.nan,
            "largest": self.largest if self.frames else math.nan,
            "heading": self.heading if self.frames else math.nan,
        }  # fmt: skip


def _placed(message: Any) -> tuple[Array, Rotation]:
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    return np.array([place.x, place.y, place.z]), Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])


def _heading(turn: Rotation) -> float:
    forward = turn.apply([1.0, 0.0, 0.0])
    return math.atan2(forward[1], forward[0])
