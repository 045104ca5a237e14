"""The static transforms of a log, as a graph of frames."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recordings.errors import LogError
from recordings.ros2.from_msg import transform_of
from stages.data import Transform

# A camera's axes (x right, y down, z forward) in the rover's (x forward, y left, z up), when it looks straight ahead.
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_SAME = 1e-6  # m and matrix elements; two transforms of the same frames that differ by more contradict each other


@dataclass
class TransformTree:
    """The static transforms of a log, as a graph in which any two connected frames have a transform."""

    edges: dict[str, dict[str, Transform]] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)

    def add(self, message: Any) -> None:
        """Add a geometry_msgs/TransformStamped. Raises LogError, and keeps what is there, where it contradicts that."""
        transform = transform_of(message)
        parent, child = transform.parent, transform.child
        known = self.between(parent, child)
        if known is None:
            if child in self.parents:
                raise LogError(f"'{child}' has two parents, '{self.parents[child]}' and '{parent}'; the first is used")
            self.edges.setdefault(parent, {})[child] = transform
            self.edges.setdefault(child, {})[parent] = transform.inverse()
            self.parents[child] = parent
        elif not _same(known, transform):
            raise LogError(f"the transform '{parent}' <- '{child}' contradicts an earlier one; the earlier one is used")

    def between(self, parent: str, child: str) -> Transform | None:
        """The transform from `child` to `parent`, along the fewest steps; None where nothing connects them, or one has
        no name."""
        if not parent or not child:
            return None
        before, queue = {child: child}, deque([child] if parent in self.edges else [])
        while queue and parent not in before:
            frame = queue.popleft()
            for name in self.edges.get(frame, {}):
                if name not in before:
                    before[name] = frame
                    queue.append(name)
        if parent not in before:
            return None
        whole, frame = Transform(parent, parent, np.eye(3), np.zeros(3)), parent
        while frame != child:
            whole, frame = whole.after(self.edges[frame][before[frame]]), before[frame]
        return whole

    def listed(self) -> list[str]:
        """Each transform of the log as "parent <- child", sorted."""
        return sorted(f"{parent} <- {child}" for child, parent in self.parents.items())


def _same(one: Transform, other: Transform) -> bool:
    off = max(np.abs(one.rotation - other.rotation).max(), np.abs(one.translation - other.translation).max())
    return bool(off <= _SAME)
