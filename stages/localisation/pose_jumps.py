"""Finds single steps of the logged pose that sound visual odometry contradicts.

A step of visual odometry that is itself wrong differs from the steps before and after it. If it is like one of them,
the logged step is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stages.data import Array, CameraMotion, Pose, Transform

MIN_JUMP = 0.2  # m, and
MIN_RATIO = 6.0  # over the median difference of all steps: noise of the odometry reaches 5, and
MIN_SIGMAS = 10.0  # of the visual step, and
MIN_SHARE = 0.3  # of the visual step: slip
MAX_UNSTEADY = 0.5  # of the difference, by which the visual step may differ from the one before or after it
MIN_INLIERS = 80


class _Frame(NamedTuple):
    track: tuple[int, str]  # segment of visual odometry and frame of the pose
    stamp: int
    visual: Transform  # the camera
    logged: Transform  # the camera
    pose: Transform
    covariance: Array  # of visual


class Move(NamedTuple):
    """The motion from one frame to the next. The camera's is in its own axes before."""

    start: int  # ns
    end: int  # ns
    visual: Array | None  # (3,) m; None without a track
    logged: Array  # (3,) m
    sigma: float  # m, of visual
    inliers: int
    shift: Array  # (3,) m, of the pose in its own axes before
    arrival: Array  # (3,) m, the same in its own axes after
    place: Array  # (3,) m, after

    @property
    def seconds(self) -> float:
        """Its time, s."""
        return (self.end - self.start) / 1e9

    @property
    def speed(self) -> float:
        """Of the pose, m/s."""
        return float(np.linalg.norm(self.shift)) / self.seconds

    @property
    def difference(self) -> float:
        """Between the log and the images, m; 0 without a track."""
        return 0.0 if self.visual is None else float(np.linalg.norm(self.visual - self.logged))

    @property
    def velocity(self) -> Array:
        """Of the camera by the images, (3,) m/s; NaN without a track."""
        return np.full(3, np.nan) if self.visual is None else self.visual / self.seconds


@dataclass
class PoseJumps:
    """The moves so far, in one frame of the pose."""

    last: _Frame | None = None
    moves: list[Move] = field(default_factory=list)
    first: tuple[int, Array] = (0, np.zeros(3))  # stamp and place of the first frame

    def add(self, motion: CameraMotion, pose: Pose, logged: Transform) -> None:
        """Add a frame that has a visual pose. logged: the camera by the log's pose."""
        assert motion.camera is not None
        track = motion.segment, pose.frame_id
        now = _Frame(track, motion.stamp, motion.camera, logged, pose.transform, motion.covariance)
        last, self.last = self.last, now
        if last is None or last.track[1] != pose.frame_id:
            self.first, self.moves = (now.stamp, pose.position), []
        elif now.stamp > last.stamp:
            self.moves.append(_move(last, now, motion.inliers))

    def contradicted(self) -> list[Move]:
        """The moves that sound visual odometry contradicts by far more than both explain."""
        tracked = [move for move in self.moves if move.visual is not None]
        usual = float(np.median([move.difference for move in tracked])) if tracked else 0.0
        found = []
        for number, move in enumerate(self.moves):
            near = [other for other in self.moves[max(number - 1, 0) : number + 2] if other.visual is not None]
            if move.visual is not None and move.difference > MIN_RATIO * usual and _contradicted(move, near):
                found.append(move)
        return found

    def seconds(self, stamp: int) -> float:
        """The time of a frame after the first frame, s."""
        return (stamp - self.first[0]) / 1e9


def _move(before: _Frame, after: _Frame, inliers: int) -> Move:
    """The motion between two frames."""
    visual, logged, shift = (
        one.rotation.T @ (other.translation - one.translation)
        for one, other in zip(before[2:5], after[2:5], strict=True)
    )
    arrival = after.pose.rotation.T @ (after.pose.translation - before.pose.translation)
    gained = np.trace((after.covariance - before.covariance)[:3, :3])
    tracked = before.track == after.track
    return Move(
        before.stamp, after.stamp, visual if tracked else None, logged, float(np.sqrt(max(gained, 0.0))), inliers,
        shift, arrival, after.pose.translation,
    )  # fmt: skip


def _contradicted(move: Move, near: list[Move]) -> bool:
    """Whether the images contradict a move. near: the moves with a track before and after it, with itself."""
    assert move.visual is not None
    least = max(MIN_JUMP, MIN_SIGMAS * move.sigma, MIN_SHARE * float(np.linalg.norm(move.visual)))
    if move.inliers < MIN_INLIERS or move.difference < least:
        return False
    changes = [float(np.linalg.norm(other.velocity - move.velocity)) for other in near if other is not move]
    return min(changes, default=np.inf) * move.seconds < MAX_UNSTEADY * move.difference
