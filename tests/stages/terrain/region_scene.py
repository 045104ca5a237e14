"""A drive over ground of known height, as clouds and poses for the regional map."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stages import ElevationMap, Fuse, FuseRegion, MapRegion, Mount, Pose, Region, Transform
from tests.stages.builders import cloud_of
from tests.stages.running import Running

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
LOOKING = Rotation.from_euler("y", 20, degrees=True).as_matrix() @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
MOUNT = Mount(START, np.eye(3), Transform("base_link", "camera", LOOKING, np.array([0.4, 0.1, 1.0])))


class Fusing(Running):
    """`FuseRegion` as the engine calls it, with the map of every frame; region: of the last frame."""

    region: Region

    def __init__(self, window: float = 20.0, **parameters: float) -> None:
        super().__init__(FuseRegion(**parameters))
        self._maps = Running(MapRegion(window=window))

    def __call__(self, *inputs: object, **named: object) -> ElevationMap:
        self.region = super().__call__(*inputs, **named)
        return self._maps(self.region)


def rolling(x, y):
    """Ground without any symmetry."""
    return 0.2 * np.sin(0.9 * x + 0.3) * np.cos(0.5 * y) + 0.03 * x - 0.02 * y


def flat(x, y):
    return np.zeros_like(x)


def drive(frame, ground=rolling, sigma=0.02, tilt=(0.0, 0.0), at=None, noise=0.0, points=100_000):
    """Cloud and pose of one frame: 2 to 7 m ahead, 100 degrees wide; 100,000 points are 6 a cell.

    tilt: slopes by a wrong tilt.
    """
    rng = np.random.default_rng(frame)
    x, y, yaw = at or (0.4 * frame - 3.03, 0.1 * frame + 0.521, 0.4 + 0.1 * frame)
    base = np.array([x, y, float(ground(np.array(x), np.array(y)))])
    reach, bearing = np.sqrt(rng.uniform(4, 49, points)), rng.uniform(-0.87, 0.87, points)
    ahead = np.column_stack([reach * np.cos(bearing), reach * np.sin(bearing)])
    world = ahead @ Rotation.from_euler("z", yaw).as_matrix()[:2, :2].T + base[:2]
    heights = ground(world[:, 0], world[:, 1]) - base[2] + ahead @ tilt + noise * rng.normal(size=len(ahead))
    wrong = Rotation.from_rotvec([tilt[1], -tilt[0], 0.0]).as_matrix()
    sensor = replace(MOUNT.base_from_camera, parent="level", rotation=wrong @ LOOKING)
    cloud = cloud_of(np.column_stack([ahead, heights]), sigma, stamp=START + frame * SECOND, sensor=sensor)
    return cloud, Pose(cloud.stamp, base, Rotation.from_euler("z", yaw).as_quat(), "odom", "base_link")


def fused(frames, **parameters):
    """`Fuse` after these frames, and its last map."""
    fuse = Running(Fuse(**parameters))
    *_, terrain = (fuse(cloud, pose, MOUNT) for cloud, pose in frames)
    return fuse, terrain


def cell(terrain, x, y, layer="elevation"):
    col, row = (
        int(np.floor((place - start) / terrain.resolution)) for place, start in zip((x, y), terrain.origin, strict=True)
    )
    return float(terrain.layers[layer][row, col])


def centres(terrain):
    rows, cols = terrain.shape
    x, y = ((np.arange(n) + 0.5) * terrain.resolution + at for n, at in zip((cols, rows), terrain.origin, strict=True))
    return np.meshgrid(x, y)


def part(cloud, of):
    """Some points of a cloud, by a slice."""
    return replace(cloud, **{name: getattr(cloud, name)[of] for name in ("points", "colors", "sigma", "pixel")})
