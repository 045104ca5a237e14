"""Compares the steps of the logged pose with those of visual odometry.

Neither is exact: wheels slip, and visual odometry drifts. But a pose that stands still while the images move, that has
a wrong heading, or that jumps, differs by as much as the steps themselves. If most steps are longer by the images, the
scale of the stereo camera or of the odometry is wrong. Slip does the opposite: then the logged steps are longer.

A part of the drive may be wrong alone, such as the turns of a pose without a heading. So stretches of a metre, or of a
turn of 20 degrees, are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from flow.contracts import counted
from stages.data import Array, CameraMotion, Mount, Pose, Transform
from stages.localisation.pose_jumps import PoseJumps

MIN_STEPS = 5
MIN_STEP = 0.02  # m; shorter steps are mostly noise
MAX_DIFFERENCE_SHARE = 0.3  # of a step
MAX_SCALE_ERROR = 0.05  # share by which three of four steps may be longer by the images than in the log
MAX_SCALE = 3.0  # of the images' steps over logged ones; beyond it the logged pose stands still
MIN_SCALED_STEPS = 10  # for a comparison of the scales
STRETCH = 1.0  # m
STRETCH_TURN = float(np.radians(20))
MAX_STRETCH_SHARE = 0.5  # of the distance or turn of a stretch, by which the other may differ
MIN_WRONG_STRETCHES = 2
MIN_JUMP = 0.5  # m, and
MIN_JUMP_RATIO = 10.0  # over the median difference


class _Cameras(NamedTuple):
    """The camera of a frame, by visual odometry and by the logged pose."""

    segment: int
    frame_id: str  # of the pose
    visual: Transform
    logged: Transform


@dataclass
class PoseCheck:
    """The steps so far."""

    last: _Cameras | None = None
    begin: _Cameras | None = None  # of the stretch
    steps: list[Array] = field(default_factory=list)  # (3,) each, m: by the images, by the pose, their difference
    stretches: list[Array] = field(default_factory=list)  # (5,) each: the same, then turns by the images, by the pose
    jumps: PoseJumps = field(default_factory=PoseJumps)

    def add(self, motion: CameraMotion, pose: Pose, mount: Mount, up: Array) -> None:
        """Add a frame. up: (3,) in the camera."""
        camera = None if motion.camera is None else mount.camera_in(pose.child_frame_id, motion.camera.child)
        if motion.camera is None or camera is None:
            self.last = self.begin = None
            return
        now = _Cameras(motion.segment, pose.frame_id, motion.camera, pose.transform.after(camera))
        self.jumps.add(motion, pose, now.logged)
        if self.last is not None and self.last[:2] == now[:2]:
            self.steps.append(_lengths(self.last, now))
        if self.begin is None or self.begin[:2] != now[:2]:
            self.begin = now
        lengths = _lengths(self.begin, now)
        turns = [_turn(before, after, up) for before, after in zip(self.begin[2:], now[2:], strict=True)]
        if max(lengths[:2]) >= STRETCH or max(map(abs, turns)) >= STRETCH_TURN:
            self.stretches.append(np.array([*lengths, *turns]))
            self.begin = now
        self.last = now

    def problem(self) -> str:
        """What is wrong with the poses, in a sentence; empty if nothing is or too little is known."""
        if len(self.steps) < MIN_STEPS:
            return ""
        visual, logged, difference = np.array(self.steps).T
        if scale := _scale_problem(visual, logged):
            return scale
        usual = float(np.median(difference))
        step = max(float(np.median(visual)), float(np.median(logged)))
        if step > MIN_STEP and usual > MAX_DIFFERENCE_SHARE * step:
            return (
                f"Logged odometry disagrees with visual odometry: median step {np.median(logged):.2f} m vs "
                f"{np.median(visual):.2f} m, difference {usual:.2f} m ({len(difference)} steps). Check its frame, its "
                "heading and its unit, or set source.odometry to visual: visual odometry then supplies the pose."
            )
        large = difference[(difference > MIN_JUMP) & (difference > MIN_JUMP_RATIO * usual)]
        if len(large):
            return self._jump_problem(large)
        return self._wrong_stretches() or self._jump_problem(large)

    def _jump_problem(self, large: Array) -> str:
        """The steps that jump, in a sentence; empty if none does. large: m, those that do whatever the others are."""
        sizes = [move.difference for move in self.jumps.contradicted()]
        sizes = [*large, *(size for size in sizes if not np.isclose(size, large).any())]
        if not sizes:
            return ""
        at = next((move.end for move in self.jumps.moves if np.isclose(move.difference, sizes).any()), None)
        first = "" if at is None else f", first at the frame {self.jumps.seconds(at):.1f} s after the first one"
        size = f"{max(sizes):.{1 if max(sizes) >= 1 else 2}f} m"
        return (
            f"Logged odometry jumps {counted(len(sizes), 'time')} relative to visual odometry, by up to {size}{first}."
        )

    def _wrong_stretches(self) -> str:
        """What is wrong with parts of the drive."""
        found = np.array(self.stretches).reshape(-1, 5)
        (visual, logged, difference), turns = found.T[:3], found[:, 3:]
        moved = difference > MAX_STRETCH_SHARE * np.maximum(STRETCH, np.maximum(visual, logged))
        larger = np.maximum(STRETCH_TURN, np.abs(turns).max(axis=1))
        wrong = moved | (np.abs(turns[:, 0] - turns[:, 1]) > MAX_STRETCH_SHARE * larger)
        if (count := np.count_nonzero(wrong)) < MIN_WRONG_STRETCHES:
            return ""
        first = found[np.argmax(wrong)]
        ours, theirs = (f"{first[at]:.1f} m and {np.degrees(first[at + 3]):.0f}" for at in (0, 1))
        return (
            f"Logged odometry disagrees with visual odometry in {count} of {len(found)} stretches of the drive, first "
            f"with {theirs} degrees against {ours} by the images. Check its heading and whether wheels slipped, or set "
            "source.odometry to visual: visual odometry then supplies the pose."
        )


def _scale_problem(visual: Array, logged: Array) -> str:
    """What makes most steps of the images, m, longer than the logged ones; empty if they are not."""
    shares = visual[logged > MIN_STEP] / logged[logged > MIN_STEP]
    if len(shares) < MIN_SCALED_STEPS or not 1 + MAX_SCALE_ERROR <= np.quantile(shares, 0.25) <= MAX_SCALE:
        return ""
    return (
        f"Steps of visual odometry are {100 * (np.median(shares) - 1):.0f} % longer than those of the logged odometry "
        f"({len(shares)} steps), which slip does not explain. The baseline or the focal length is too large, and all "
        "distances with it, or the odometry's scale is too small."
    )


def _lengths(before: _Cameras, after: _Cameras) -> Array:
    """Of the camera's motion in its own axes before: by the images, by the pose, and of their difference, (3,) m."""
    visual, logged = (
        one.rotation.T @ (other.translation - one.translation) for one, other in zip(before[2:], after[2:], strict=True)
    )
    return np.asarray(np.linalg.norm([visual, logged, visual - logged], axis=1))


def _turn(before: Transform, after: Transform, up: Array) -> float:
    """The camera's turn about a vertical axis, rad. up: (3,) in the camera."""
    turn = cv2.Rodrigues(before.rotation.T @ after.rotation)[0].ravel()
    return float(turn @ up)
