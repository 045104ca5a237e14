"""The static transforms of a log: the tf tree."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from recordings.errors import LogError
from recordings.ros2.from_msg import transform_of
from stages.data import Array, Transform
from stages.data.rotations import angle_of, nearest_rotation

# The axes of a camera (x right, y down, z forward) that looks straight ahead, in the rover's (x forward, y left, z up).
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MAX_ROUNDING = 0.01  # of the products of a rotation's axes; some files have two digits
TRANSFORM_ATOL = 1e-6  # m and matrix elements; two transforms that differ by more are not the same
# Two publishers of one mount round its numbers differently. What is less than any mount is measured to is no
# contradiction.
MAX_SAME_SHIFT = 1e-3  # m
MAX_SAME_TURN = float(np.deg2rad(0.05))  # rad


def orthonormal(matrix: Array, where: str) -> Array:
    """The rotation (3, 3) nearest to a matrix of rounded numbers. Raises LogError if its axes are not orthonormal."""
    if not np.abs(matrix @ matrix.T - np.eye(3)).max() <= MAX_ROUNDING or np.linalg.det(matrix) < 0:
        raise LogError(f"{where} contains no rotation: its axes are not orthonormal; correct it")
    return nearest_rotation(matrix)


def rigid(parent: str, child: str, matrix: Any) -> Transform:
    """The transform of a (4, 4) matrix of a file, its rotation made orthonormal. Raises LogError."""
    whole = np.asarray(matrix)
    return Transform(parent, child, orthonormal(whole[:3, :3], f"the matrix from {child} to {parent}"), whole[:3, 3])


@dataclass
class TransformTree:
    """Static transforms, by which any two connected frames have a transform.

    calibrated: frames of calibration files, whose transforms win over those of the log.

    Examples
    --------
    >>> from recordings.ros2.to_msg import transform_message
    >>> to_mast = Transform("base_link", "mast", np.eye(3), np.array([0.0, 0.0, 1.5]))
    >>> to_camera = Transform("mast", "camera", np.eye(3), np.array([0.1, 0.0, 0.0]))
    >>> tree = TransformTree()
    >>> for message in transform_message([(to_mast, 0), (to_camera, 0)]).transforms:
    ...     tree.add(message)
    >>> tree.between("base_link", "camera").translation.tolist()
    [0.1, 0.0, 1.5]
    """

    edges: dict[str, dict[str, Transform]] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)
    calibrated: set[str] = field(default_factory=set)

    def add(self, message: Any) -> None:
        """Add a geometry_msgs/TransformStamped. Raises LogError if it contradicts those so far, which are kept."""
        self.join(transform_of(message))

    def join(self, transform: Transform) -> None:
        """Add a transform. Raises LogError if it contradicts those so far, which are kept."""
        parent, child = transform.parent, transform.child
        known = self.between(parent, child)
        if known is None:
            if child in self.parents:
                raise LogError(f"'{child}' has two parents, '{self.parents[child]}' and '{parent}'; the first is used")
            self.edges.setdefault(parent, {})[child] = transform
            self.edges.setdefault(child, {})[parent] = transform.inverse()
            self.parents[child] = parent
        elif (off := _contradiction(known, transform)) and (
            child not in self.calibrated or self.parents.get(child) == parent
        ):
            raise LogError(
                f"the transform '{parent}' <- '{child}' contradicts an earlier one by {off}; the earlier one is used"
            )

    def between(self, parent: str, child: str) -> Transform | None:
        """The transform from frame `child` to `parent` by the shortest path; None if nothing connects them."""
        path = self.path(parent, child)
        if not path:
            return None
        whole = Transform(parent, parent, np.eye(3), np.zeros(3))
        for above, below in pairwise(path):
            whole = whole.after(self.edges[above][below])
        return whole

    def coincide(self, one: str, other: str) -> bool:
        """Whether two frames are one, or at one place with the same axes."""
        between = self.between(one, other)
        return one == other or (
            between is not None and are_same(between, Transform(one, other, np.eye(3), np.zeros(3)))
        )

    def path(self, parent: str, child: str) -> list[str]:
        """The frames of the shortest path from `parent` to `child`; empty if nothing connects them."""
        if not parent or not child:
            return []
        before, queue = {child: child}, deque([child] if parent in self.edges else [])
        while queue and parent not in before:
            frame = queue.popleft()
            for name in self.edges.get(frame, {}):
                if name not in before:
                    before[name] = frame
                    queue.append(name)
        if parent not in before:
            return []
        path = [parent]
        while path[-1] != child:
            path.append(before[path[-1]])
        return path

    def joined(self, transforms: Iterable[Transform]) -> TransformTree:
        """This tree with further transforms, which win where they differ."""
        edges = {frame: dict(edges) for frame, edges in self.edges.items()}
        tree = TransformTree(edges, dict(self.parents), set(self.calibrated))
        for transform in transforms:
            tree.edges.setdefault(transform.parent, {})[transform.child] = transform
            tree.edges.setdefault(transform.child, {})[transform.parent] = transform.inverse()
        return tree

    def without(self, links: Iterable[tuple[str, str]]) -> TransformTree:
        """This tree without what joins these parents and children directly, or these children to another parent."""
        tree = self.joined(())
        for parent, child in links:
            for one, other in ((parent, child), (child, parent), (tree.parents.get(child, ""), child)):
                if tree.parents.get(other) == one:
                    del tree.parents[other], tree.edges[one][other], tree.edges[other][one]
        return tree

    def listed(self) -> list[str]:
        """Each transform of the log as "parent <- child", sorted."""
        return sorted(f"{parent} <- {child}" for child, parent in self.parents.items())


def are_same(one: Transform, other: Transform) -> bool:
    """Whether two transforms differ by rounding only."""
    off = max(np.abs(one.rotation - other.rotation).max(), np.abs(one.translation - other.translation).max())
    return bool(off <= TRANSFORM_ATOL)


def _contradiction(one: Transform, other: Transform) -> str:
    """By how much two transforms of the same frames contradict each other; empty if they do not."""
    shift = float(np.linalg.norm(one.translation - other.translation))
    turn = angle_of(one.rotation.T @ other.rotation)
    if shift <= MAX_SAME_SHIFT and turn <= MAX_SAME_TURN:
        return ""
    length = f"{shift * 100:.1f} cm" if shift < 0.0995 else f"{shift * 100:.0f} cm" if shift < 1 else f"{shift:.3g} m"
    angle = float(np.rad2deg(turn))
    return f"{length} and {angle:{'.2f' if 0.005 <= angle < 1 else '.1f'}} degrees"
