"""A simulated traverse: one set of parameters determines terrain, drive, images and truth.

Images and truth come from the same rays. Each frame is made on demand, so memory does not grow with the traverse. Every
random stream has its own seed, so equal parameters give equal bytes for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from recordings.simulator import raycast, shading, sunlight, traverse
from recordings.simulator.odometry import dead_reckoning
from recordings.simulator.terrain import Terrain, make_terrain
from stages.data import Array, Pose, StereoCamera, Transform

SECOND = 1_000_000_000
EPOCH = 1_700_000_000 * SECOND
DAY = 86_400 * SECOND
MAX_DAYS = 4000  # from the epoch on; limited by the 32-bit seconds of a ROS time
SENSOR_MARGIN = SECOND // 2  # that the slow sensors run before the first frame and after the last
ROW_BLOCK = 32  # rows of one task of a thread
# The Devon Island rover's rectified camera (1280 pixels wide).
DEVON_WIDTH, DEVON_F, DEVON_CX, DEVON_CY, DEVON_HEIGHT = 1280, 968.999694824, 635.139038086, 463.537109375, 960

UNITS = {"degrees": 180 / np.pi, "%": 100}  # of a limit, per unit of the field
LIMITS: dict[str, tuple[float, float, str]] = {  # field -> minimum, maximum, unit
    "frames": (1, 100_000, ""), "rate": (0.001, 100, "Hz"), "speed": (0, 10, "m/s"), "seed": (0, 10**15, ""),
    "width": (16, 8192, "px"), "height": (16, 8192, "px"), "baseline": (0.001, 10, "m"),
    "camera_height": (0.1, 100, "m"), "pitch_down": (-90, 90, "degrees"), "slope": (0, 45, "degrees"),
    "relief_resolution": (0.001, 10, "m"), "abundance": (0, 0.5, ""), "smallest_rock": (0.01, 10, "m"),
    "sun_elevation": (0.1, 90, "degrees"), "noise": (0, 1, ""), "tilt_noise": (0, 45, "degrees"),
    "tilt_rate": (1, 1000, "Hz"), "odometry_rate": (1, 1000, "Hz"), "odometry_scale": (-50, 100, "%"),
    "odometry_turn": (0, 90, "degrees"), "map_half_width": (0.5, 100, "m"), "map_resolution": (0.001, 10, "m"),
    "threads": (1, 1024, ""),
}  # fmt: skip


@dataclass(frozen=True)
class FrameTruth:
    """The exact geometry of one frame.

    depth: (H, W) float64 m, inf = sky; surface: (H, W) int32 codes of the ray caster; seen: (H, W) uint8, 255 by both
    cameras, 128 hidden from the right one, 0 no surface; images: left and right.
    """

    base: Transform
    level: Transform
    depth: Array
    surface: Array
    seen: Array
    images: tuple[Array, Array]


@dataclass(frozen=True)
class Simulation:
    """A synthetic traverse; equal simulations write equal bytes. Lengths in m, angles in rad, times in s.

    Parameters
    ----------
    frames, rate, speed
        The drive: number of frames, Hz, m/s.
    width, height, baseline
        The camera: px (Devon's camera, scaled), m.
    camera_height, pitch_down
        The mast: height above base_link, angle below the horizon.
    slope, relief_cells, relief_resolution
        The ground: RMS slope over 1 m; cells of the repeating tile and their size.
    abundance, smallest_rock, largest_rock
        The rocks: k of Golombek's law (0.05 sparse, 0.15 dense), diameters.
    sun_elevation, sun_azimuth, color, noise
        The images: sunlight; rgb8 or mono8; noise at half scale, share of full scale.
    tilt_noise, tilt_rate, frame_offset
        The inclinometer: one sigma of a sample, Hz, time from a sample to a frame.
    odometry_rate, odometry_scale, odometry_turn
        The odometry: Hz, share by which distances are overstated, heading error after 1 m (one sigma, grows with the
        square root of the distance). It is exact for 0 and 0.
    map_half_width, map_resolution, region, horizon
        The truth: size and cells of the maps, largest distance of a visible cell, distance from which on is sky.
    seed, threads
        Of the random numbers; of the computation (the result does not depend on it).

    Examples
    --------
    >>> from recordings.simulator import Simulation
    >>> simulation = Simulation(frames=2, width=320, height=240, relief_cells=256)
    >>> simulation.frame(0).depth.shape
    (240, 320)
    """

    frames: int = 12
    rate: float = 2.0
    speed: float = 0.5
    width: int = 1280
    height: int = 960
    baseline: float = 0.24
    camera_height: float = 0.9
    pitch_down: float = float(np.radians(15))
    slope: float = float(np.radians(4))
    relief_cells: int = 2048
    relief_resolution: float = 0.04
    abundance: float = 0.10
    smallest_rock: float = 0.06
    largest_rock: float = 1.5
    sun_elevation: float = float(np.radians(38))
    sun_azimuth: float = float(np.radians(140))
    color: bool = True
    noise: float = 0.008
    tilt_noise: float = float(np.radians(0.1))
    tilt_rate: float = 20.0
    odometry_rate: float = 10.0
    odometry_scale: float = 0.01
    odometry_turn: float = float(np.radians(0.2))
    frame_offset: float = 0.013
    map_half_width: float = 8.0
    map_resolution: float = 0.05
    region: float = 8.0
    horizon: float = 300.0
    seed: int = 1
    threads: int = 2

    def __post_init__(self) -> None:
        for name, (low, high, unit) in LIMITS.items():
            value = getattr(self, name) * UNITS.get(unit, 1)
            value = min(value, 1e300) if value > high else value  # an int may exceed every float
            if not low <= value <= high:
                shown = f"{low:.9g} to {high:.9g} {unit}".rstrip()
                raise ValueError(f"Simulation.{name} must be {shown}, not {value:.9g}{f' {unit}' if unit else ''}")
        if self.relief_cells < 64 or self.relief_cells & (self.relief_cells - 1):
            raise ValueError(f"Simulation.relief_cells must be a power of two of at least 64, not {self.relief_cells}")

    @cached_property
    def camera(self) -> StereoCamera:
        """The rectified stereo camera."""
        scale = self.width / DEVON_WIDTH
        cy = (DEVON_CY - (DEVON_HEIGHT - 1) / 2) * scale + (self.height - 1) / 2
        return StereoCamera(
            fx=DEVON_F * scale, fy=DEVON_F * scale, cx=(DEVON_CX + 0.5) * scale - 0.5, cy=cy, baseline=self.baseline,
            width=self.width, height=self.height, frame_id=traverse.LEFT_FRAME,
        )  # fmt: skip

    @cached_property
    def route(self) -> traverse.Route:
        """The path of the rover, through the middle of the tile."""
        middle = self.relief_cells * self.relief_resolution / 2
        length = self.speed * (self.frames / self.rate + 2)
        return traverse.Route((middle, middle), 0.4, 0.35, 9.0, behind=self.speed + 1, ahead=length + 1)

    @cached_property
    def terrain(self) -> Terrain:
        """The ground and its rocks, without those in the path of the rover."""
        terrain = make_terrain(
            self._rng(0), self.relief_cells, self.relief_resolution, self.slope, self.abundance, self.smallest_rock,
            self.largest_rock,
        )  # fmt: skip
        path = self.route.place_at(np.arange(-self.speed, self.speed * (self.frames / self.rate + 1) + 1, 0.1))
        return terrain.cleared(path, half_width=traverse.BODY_WIDTH / 2 + 0.1, height=0.12)

    @cached_property
    def sun(self) -> Array:
        """Unit vector (3,) towards the sun, world frame."""
        flat = np.cos(self.sun_elevation)
        return np.array([flat * np.cos(self.sun_azimuth), flat * np.sin(self.sun_azimuth), np.sin(self.sun_elevation)])

    @cached_property
    def lit_above(self) -> Array:
        """The elevation, m, above which each ground cell is certainly lit."""
        return sunlight.lit_above(self.terrain.scene, self.sun)

    @cached_property
    def texture(self) -> shading.Texture:
        """The look of the ground under this sun."""
        return shading.make_texture(self._rng(1), self.sun)

    @cached_property
    def mounts(self) -> tuple[Transform, Transform, Transform]:
        """base_link <- left camera, <- right camera, <- inclinometer."""
        return traverse.mounts(self.baseline, self.camera_height, self.pitch_down)

    @property
    def start(self) -> int:
        """Nominal start of the drive, ns; each seed has its own day, so logs of two seeds share no stamps."""
        return EPOCH + self.seed % MAX_DAYS * DAY

    def stamp(self, frame: int) -> int:
        """Stamp of a frame, ns."""
        return self.start + round((self.frame_offset + frame / self.rate) * SECOND)

    @property
    def begin(self) -> int:
        """Time of the first sensor sample, ns."""
        return self.start - SENSOR_MARGIN

    def sensor_stamps(self, rate: float) -> list[int]:
        """Stamps, ns, of a sensor of `rate` Hz, from before the first frame until after the last."""
        length = (self.stamp(self.frames - 1) + SENSOR_MARGIN - self.begin) / SECOND
        return [self.begin + round(number / rate * SECOND) for number in range(int(np.ceil(length * rate)) + 1)]

    def distance(self, stamp: int) -> float:
        """Metres driven since the nominal start, at a time, ns."""
        return (stamp - self.start) / SECOND * self.speed

    def base_at(self, stamp: int) -> Transform:
        """world <- base_link at a time, ns."""
        return traverse.base_pose(self.terrain, self.route, self.distance(stamp))

    @cached_property
    def odometry(self) -> tuple[Pose, ...]:
        """The odometry of the whole drive, as logged."""
        stamps = self.sensor_stamps(self.odometry_rate)
        distances = np.array([self.distance(stamp) for stamp in stamps])
        bases = [self.base_at(stamp) for stamp in stamps]
        return tuple(dead_reckoning(stamps, bases, distances, self.odometry_scale, self.odometry_turn, self._rng(5)))

    def frame(self, index: int) -> FrameTruth:
        """Images and exact geometry of one frame."""
        base = self.base_at(self.stamp(index))
        left, right = (base.after(mount) for mount in self.mounts[:2])
        gain = 1 + 0.01 * float(self._rng(2).uniform(0.5, 1.0))
        with ThreadPoolExecutor(self.threads) as pool:
            depth, surface, radiance = self._render(left, pool)
            seen = np.empty(depth.shape, np.uint8)
            self._by_rows(
                pool,
                lambda rows: raycast.seen_rows(
                    self.terrain.scene, left.translation, right.translation, left.rotation, *self._intrinsics(),
                    rows.start, depth[rows], seen[rows],
                ),
            )  # fmt: skip
            _, _, other = self._render(right, pool)
            pictures = pool.map(
                lambda side, light, factor: shading.expose(
                    light, factor, self.noise, self._rng(3, index, side), self.color
                ),
                (0, 1), (radiance, other), (1.0, gain),
            )  # fmt: skip
            images = next(pictures), next(pictures)
        return FrameTruth(base, traverse.level_pose(base), depth, surface, seen, images)

    def _intrinsics(self) -> tuple[float, float, float, float]:
        return self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy

    def _render(self, pose: Transform, pool: ThreadPoolExecutor) -> tuple[Array, Array, Array]:
        """Depth, surface and radiance of one camera's image."""
        shape = self.height, self.width
        depth, surface, facet = np.empty(shape), np.empty(shape, np.int32), np.empty(shape, np.int8)
        radiance = np.empty((*shape, 3), np.float32)

        def render(rows: slice) -> None:
            view = pose.translation, pose.rotation, *self._intrinsics()
            hits = depth[rows], surface[rows], facet[rows]
            raycast.cast_rows(self.terrain.scene, *view, self.horizon, rows.start, *hits)
            shading.shade_rows(
                self.terrain.scene, self.texture, self.lit_above, self.sun, *view, rows.start, *hits, radiance[rows]
            )  # fmt: skip

        self._by_rows(pool, render)
        return depth, surface, radiance

    def _by_rows(self, pool: ThreadPoolExecutor, work: Callable[[slice], None]) -> None:
        starts = range(0, self.height, ROW_BLOCK)
        for _ in pool.map(work, (slice(start, min(start + ROW_BLOCK, self.height)) for start in starts)):
            pass

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *stream])
