"""The rig file: what a data set does not say about its rover, in YAML with units, as pipeline files have them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from scipy.spatial.transform import Rotation

from flow.parameters import Checked, coerced, parameter
from recordings.calibration.yaml_files import read_yaml
from recordings.errors import LogError
from recordings.importers.recording import BASE, LEFT
from recordings.source.transforms import BODY_FROM_OPTICAL
from stages.data import Array, StereoCamera, Transform

# Entries that kinds of data sets share.
MOUNT = ("height", "pitch_down", "roll", "yaw", "forward", "left")
LENS = ("fx", "cx", "cy", "baseline")
AXES = ("body_axes", "world_up")
INCLINOMETER = ("pitch_column", "roll_column", "angle_unit", "pitch_sign", "roll_sign", "tilt_model")
_PLACE: dict[str, Any] = {"unit": "m", "low": -100.0, "high": 100.0}
_LENS: dict[str, Any] = {"unit": "px", "low": 0.0, "high": 1e6}
_TURN: dict[str, Any] = {"unit": "rad", "low": -np.pi, "high": np.pi}
_COLUMN: dict[str, Any] = {"low": 2, "high": 1000}


@dataclass(frozen=True, kw_only=True)
class Rig(Checked):
    """The entries of a rig file. A camera without turns looks straight ahead; base_link is on the ground below it."""

    height: float | None = parameter(None, "height of the left camera above base_link", unit="m", low=0.0, high=1e9)
    pitch_down: float | None = parameter(None, "angle of the camera below base_link's x axis", **_TURN)
    roll: float = parameter(0.0, "rotation of the camera about its line of sight, right side down positive", **_TURN)
    yaw: float = parameter(0.0, "heading of the camera to the left of base_link's x axis", **_TURN)
    forward: float = parameter(0.0, "place of the left camera ahead of base_link", **_PLACE)
    left: float = parameter(0.0, "place of the left camera to the left of base_link", **_PLACE)
    fx: float | None = parameter(None, "focal length", unit="px", low=1.0, high=1e6)
    cx: float | None = parameter(None, "principal point", **_LENS)
    cy: float | None = parameter(None, "principal point", **_LENS)
    baseline: float | None = parameter(None, "distance of the cameras", unit="m", low=0.001, high=10.0)
    body_axes: str | None = parameter(
        None, "axes of the data set's body, each f, b, l, r, u or d, such as flu for x forward, y left, z up"
    )
    world_up: str | None = parameter(
        None, "axis of the data set's world that points up", choices=("z", "-z", "y", "-y")
    )
    pitch_column: int | None = parameter(None, "column of the inclinometer's pitch, the first is 1", **_COLUMN)
    roll_column: int | None = parameter(None, "column of the inclinometer's roll", **_COLUMN)
    angle_unit: str | None = parameter(None, "unit of the inclinometer", choices=("deg", "rad"))
    pitch_sign: int | None = parameter(None, "1: positive is nose up", choices=(1, -1))
    roll_sign: int | None = parameter(None, "1: positive is left side up", choices=(1, -1))
    tilt_model: str | None = parameter(
        None, "axis: the angles are those of the sensor's axes to the horizon; euler: Euler angles",
        choices=("axis", "euler"),
    )  # fmt: skip
    where: str = field(default="", init=False)

    def need(self, kind: str, *names: str) -> None:
        """Raise LogError if an entry is missing that the data set does not contain either."""
        for known in fields(self):
            if known.name in names and getattr(self, known.name) is None:
                unit = {"rad": ", in deg", "m": ", in m"}.get(known.metadata.get("unit", ""), "")
                choices = known.metadata.get("choices")
                of = f": {' or '.join(map(str, choices))}" if choices else unit
                wanted = f"{self.where} lacks" if self.where else "give a rig file (--rig FILE) with"
                raise LogError(f"{wanted} '{known.name}' ({known.metadata['help']}{of}); {kind} does not contain it")

    @property
    def mount(self) -> Transform | None:
        """base_link <- left camera; None if nothing is known. Raises LogError without a height or an angle."""
        if self.height is None and self.pitch_down is None and not any((self.roll, self.yaw, self.forward, self.left)):
            return None
        self.need("the data set", "height", "pitch_down")
        turn = Rotation.from_euler("ZYX", [self.yaw, self.pitch_down, self.roll]).as_matrix()
        return Transform(BASE, LEFT, turn @ BODY_FROM_OPTICAL, np.array([self.forward, self.left, self.height]))

    @property
    def poses(self) -> tuple[Array, Array]:
        """The rotations (3, 3) from the data set's world to one with z up, and from x forward, y left, z up to the axes
        of its body. Raises LogError if the axes are invalid."""
        axes = [_AXES.get(letter) for letter in self.body_axes or ""]
        turn = np.array([axis for axis in axes if axis is not None], np.float64)
        if len(axes) != 3 or turn.shape != (3, 3) or not np.isclose(np.linalg.det(turn), 1):
            raise LogError(
                f"{self.where}: the body_axes '{self.body_axes}' are not three right-handed axes, such as flu"
            )
        return np.array(_UPRIGHT[self.world_up or "z"], np.float64), turn

    def camera(
        self, size: tuple[int, int], focal: float, baseline: float, centre: tuple[float, float] | None = None
    ) -> StereoCamera:
        """The rectified camera by the entries of the file, else by these of the data set.

        centre: the principal point, px; None: the middle of the image.
        """
        width, height = size
        cx, cy = centre or (width / 2, height / 2)
        lens: dict[str, Any] = {"fx": focal, "cx": cx, "cy": cy, "baseline": baseline}
        lens |= {name: value for name in LENS if (value := getattr(self, name)) is not None}
        return StereoCamera(**lens, fy=lens["fx"], width=width, height=height, frame_id=LEFT)


_AXES = {"f": (1, 0, 0), "b": (-1, 0, 0), "l": (0, 1, 0), "r": (0, -1, 0), "u": (0, 0, 1), "d": (0, 0, -1)}
_UPRIGHT = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)), "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)), "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}  # fmt: skip


def read_rig(path: Path | None, entries: Collection[str]) -> Rig:
    """The rig of a file with some of these entries; an empty one without a file.

    Raises LogError for an unknown entry or an invalid value.
    """
    if path is None:
        return Rig()
    content, hints = read_yaml(path, "rig file"), get_type_hints(Rig)
    known = {entry.name: entry for entry in fields(Rig) if entry.name in entries}
    values: dict[str, Any] = {}
    for name, value in content.items():
        if name not in known:
            raise LogError(f"{path} has the entry '{name}', which is not used; it may have {', '.join(known)}")
        try:
            values[name] = coerced(value, hints[name], known[name])
        except (ValueError, OverflowError) as error:
            raise LogError(f"{path}: '{name}': {error}") from error
    rig = Rig(**values)
    object.__setattr__(rig, "where", str(path))
    return rig
