"""Pose drift: the error of the estimated poses as a share of the distance driven.

Poses of one frame of reference are aligned to the truth by position and heading of the first one. A new frame of
reference (`visual_odom/2`, after tracking was lost) is aligned again; its error and distance are added.
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
    """The poses of one frame of reference; rotation and shift lead from it to the true one."""

    rotation: Rotation
    shift: Array  # m
    last: Array  # m, the last true position
    distance: float = 0.0  # m driven
    error: float = 0.0  # m, of the last pose


class PoseTally:
    """Sums up the poses of a run, frame by frame in order, from nav_msgs/Odometry messages."""

    def __init__(self) -> None:
        self.parts: dict[str, _Part] = {}
        self.frames = self.missing = 0
        self.max_error = self.max_heading_error = 0.0

    def add(self, true: Any, given: Any | None) -> dict[str, float]:
        """Add a frame's true pose and its estimate, None if it has none; returns the frame's own metrics."""
        if given is None:
            self.missing += 1
            return {}
        (position, rotation), (true_position, true_rotation) = _pose(given), _pose(true)
        part = self.parts.get(given.header.frame_id)
        if part is None:
            onto = Rotation.from_euler("z", _heading(true_rotation) - _heading(rotation))
            part = _Part(onto, true_position - onto.apply(position), true_position)
            self.parts[given.header.frame_id] = part
        part.distance += float(np.linalg.norm(true_position - part.last))
        part.last = true_position
        part.error = float(np.linalg.norm(part.rotation.apply(position) + part.shift - true_position))
        heading = math.remainder(_heading(part.rotation * rotation) - _heading(true_rotation), 2 * math.pi)
        self.frames += 1
        self.max_error = max(self.max_error, part.error)
        self.max_heading_error = max(self.max_heading_error, abs(heading))
        return {"pose_error": part.error, "pose_heading": heading}

    def metrics(self) -> dict[str, float] | None:
        """The metrics of all poses; None if there was no estimate.

        frames: scored; missing: frames without an estimate; parts: frames of reference; distance: m driven; drift: the
        parts' last errors over their distances; max_error: m; max_heading_error: rad.
        """
        if not self.frames:
            return None
        distance = sum(part.distance for part in self.parts.values())
        error = sum(part.error for part in self.parts.values())
        return {
            "frames": self.frames, "missing": self.missing, "parts": len(self.parts),
            "distance": distance, "drift": error / distance if distance > 0 else math.nan,
            "max_error": self.max_error, "max_heading_error": self.max_heading_error,
        }  # fmt: skip


def _pose(message: Any) -> tuple[Array, Rotation]:
    position, quaternion = message.pose.pose.position, message.pose.pose.orientation
    rotation = Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    return np.array([position.x, position.y, position.z]), rotation


def _heading(rotation: Rotation) -> float:
    forward = rotation.apply([1.0, 0.0, 0.0])
    return math.atan2(forward[1], forward[0])
