"""The rover of the simulator: its path, its tilt on the ground, and the readings of its inclinometer.

The world frame has z up. `base_link` is on the plane that fits the ground under the body, x forward, y left; `level`
has its origin and heading, without tilt. The inclinometer is mounted at an angle, as real ones are, so nothing
downstream works without the static transforms.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.simulator.terrain import Terrain
from recordings.source.transforms import BODY_FROM_OPTICAL
from stages.data import LEVEL_FRAME, Array, Transform

BODY_LENGTH, BODY_WIDTH = 1.0, 0.8
LEFT_FRAME, RIGHT_FRAME = "left_camera_optical", "right_camera_optical"
INCLINOMETER_FRAME = "inclinometer_link"
MAST_FRAME = "mast_head"
MAST_FORWARD = 0.35  # m from the body's centre to the cameras


@dataclass(frozen=True)
class Route:
    """A meandering path: the heading swings by `swing` rad about `heading` once every `wave` metres.

    start: (x, y) m. `ahead` and `behind`: metres of path known on either side of the start.
    """

    start: tuple[float, float]
    heading: float
    swing: float
    wave: float
    behind: float
    ahead: float
    _nodes: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        way = np.arange(-np.ceil(self.behind / 0.01), np.ceil(self.ahead / 0.01) + 2) * 0.01
        heading = self.heading_at((way[1:] + way[:-1]) / 2)
        steps = np.diff(way)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        places += np.asarray(self.start) - places[int(np.argmin(np.abs(way)))]
        object.__setattr__(self, "_nodes", (way, places))

    def heading_at(self, distance: Array | float) -> Array:
        """Heading, rad from +x towards +y, after `distance` metres."""
        return np.asarray(self.heading + self.swing * np.sin(2 * np.pi * np.asarray(distance) / self.wave))

    def place_at(self, distance: Array | float) -> Array:
        """Position (..., 2), m, after `distance` metres."""
        nodes, places = self._nodes
        return np.stack([np.interp(distance, nodes, places[:, axis]) for axis in (0, 1)], axis=-1)


def resting_plane(terrain: Terrain, place: Array, heading: float) -> tuple[float, Array]:
    """Height at the centre, m, and unit normal (3,) of the plane that fits the ground under the body."""
    along, across = np.meshgrid(np.linspace(-0.5, 0.5, 5) * BODY_LENGTH, np.linspace(-0.5, 0.5, 5) * BODY_WIDTH)
    x = along.ravel() * np.cos(heading) - across.ravel() * np.sin(heading)
    y = along.ravel() * np.sin(heading) + across.ravel() * np.cos(heading)
    z = terrain.elevation(place[0] + x, place[1] + y)
    east, north, height = np.linalg.lstsq(np.column_stack([x, y, np.ones_like(x)]), z, rcond=None)[0]
    normal = np.array([-east, -north, 1.0])
    return float(height), normal / np.linalg.norm(normal)


def base_pose(terrain: Terrain, route: Route, distance: float) -> Transform:
    """world <- base_link after `distance` metres."""
    heading, place = float(route.heading_at(distance)), route.place_at(distance)
    height, up = resting_plane(terrain, place, heading)
    # In the plane, vertically above the horizontal heading.
    forward = np.array([np.cos(heading), np.sin(heading), -(up[0] * np.cos(heading) + up[1] * np.sin(heading)) / up[2]])
    forward /= np.linalg.norm(forward)
    rotation = np.column_stack([forward, np.cross(up, forward), up])
    return Transform("world", "base_link", rotation, np.array([*place, height]))


def level_pose(base: Transform) -> Transform:
    """world <- level for world <- base_link: same origin and heading, z up."""
    heading = float(np.arctan2(base.rotation[1, 0], base.rotation[0, 0]))
    return Transform("world", LEVEL_FRAME, Rotation.from_euler("z", heading).as_matrix(), base.translation)


def mast(camera_height: float, pan: float) -> Transform:
    """base_link <- the head of the mast, turned to the left by `pan`, rad."""
    head = np.array([MAST_FORWARD, 0.0, camera_height])
    return Transform("base_link", MAST_FRAME, Rotation.from_euler("z", pan).as_matrix(), head)


def mounts(
    baseline: float, camera_height: float, pitch_down: float, pan: float = 0.0
) -> tuple[Transform, Transform, Transform]:
    """base_link <- left camera, <- right camera, <- inclinometer."""
    looking, head = Rotation.from_euler("y", pitch_down).as_matrix() @ BODY_FROM_OPTICAL, mast(camera_height, pan)
    left, right = (
        head.after(Transform(MAST_FRAME, name, looking, np.array([0.0, side * baseline / 2, 0.0])))
        for name, side in ((LEFT_FRAME, 1), (RIGHT_FRAME, -1))
    )
    askew = Rotation.from_euler("xyz", [3.0, -4.0, 7.0], degrees=True).as_matrix()
    return left, right, Transform("base_link", INCLINOMETER_FRAME, askew, np.array([-0.2, 0.1, 0.35]))


def inclinometer_reading(base: Transform, mount: Transform, noise: float, rng: np.random.Generator) -> Array:
    """Quaternion xyzw that rotates the inclinometer's frame into a world with z up; the unknown heading is 0.

    noise: rad, standard deviation about each horizontal axis.
    """
    wobble = Rotation.from_rotvec([*rng.normal(0.0, noise, 2), 0.0])
    attitude = (wobble * Rotation.from_matrix(base.rotation @ mount.rotation)).as_matrix()
    heading = float(np.arctan2(attitude[1, 0], attitude[0, 0]))
    return np.asarray((Rotation.from_euler("z", -heading) * Rotation.from_matrix(attitude)).as_quat(canonical=True))
