"""The axes of a mast or a pan-tilt head, whose angles a log has as sensor_msgs/JointState.

A YAML file has one entry for each axis, with the keys of a URDF joint: the name of the joint, its parent and child
frame, where the axis is (xyz, m), how it is turned (rpy, rad), and its direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recordings.calibration.yaml_files import numbers, read_yaml
from recordings.errors import LogError
from recordings.ros2.from_msg import frame_name
from stages.data import Array, Transform
from stages.data.rotations import turn_by

_VECTORS = {"xyz": (0.0, 0.0, 0.0), "rpy": (0.0, 0.0, 0.0), "axis": (1.0, 0.0, 0.0)}  # as URDF has them by default


@dataclass(frozen=True, eq=False)
class Joint:
    """One axis. origin: parent <- child at the angle 0; axis: (3,) unit vector in the child's frame.

    Examples
    --------
    >>> still = Transform("base_link", "mast", np.eye(3), np.array([0.0, 0.0, 1.2]))
    >>> Joint(still, np.array([0.0, 0.0, 1.0])).at(np.pi / 2).rotation.round(9)[:, 0].tolist()
    [0.0, 1.0, 0.0]
    """

    origin: Transform
    axis: Array

    def at(self, angle: float) -> Transform:
        """parent <- child at an angle, rad."""
        turn = turn_by(angle * self.axis)
        return self.origin.after(Transform(self.origin.child, self.origin.child, turn, np.zeros(3)))


def read_joints(path: str | Path) -> dict[str, Joint]:
    """The axes in a YAML file, by the names of their joints. Raises LogError."""
    content = read_yaml(Path(path), "file of joints")
    if not content:
        raise LogError(f"{path} has no joints; write one entry each, NAME: {{parent, child, xyz, rpy, axis}}")
    return {str(name): _joint(f"{path}: joint '{name}'", entry) for name, entry in content.items()}


def _joint(where: str, entry: Any) -> Joint:
    from scipy.spatial.transform import Rotation  # takes long to import

    if not isinstance(entry, dict):
        raise LogError(f"{where} is not a mapping of parent, child, xyz, rpy and axis")
    if unknown := sorted(map(str, entry.keys() - _VECTORS.keys() - {"parent", "child"})):
        raise LogError(f"{where} has the unknown key '{unknown[0]}'; it may have parent, child, xyz, rpy and axis")
    for name in ("parent", "child"):
        if not isinstance(entry.get(name), str) or not entry[name]:
            raise LogError(f"{where} needs the name of its frame '{name}'")
    vectors = {name: numbers({**_VECTORS, **entry}, name, (3,), where) for name in _VECTORS}
    length = float(np.linalg.norm(vectors["axis"]))
    if not length > 0:
        raise LogError(f"{where} has the axis 0; write a direction such as [0, 0, 1]")
    turn = Rotation.from_euler("xyz", vectors["rpy"]).as_matrix()
    origin = Transform(frame_name(entry["parent"]), frame_name(entry["child"]), turn, vectors["xyz"])
    return Joint(origin, vectors["axis"] / length)
