"""A simulated traverse: one set of parameters determines terrain, drive, images and truth.

Images and truth come from the same rays. Each frame is made on demand, so memory does not grow with the traverse. Every
random stream has its own seed, so equal parameters give equal bytes for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from flow.parameters import check_parameters, parameter
from recordings.simulator import camera as cameras
from recordings.simulator import inertial, raycast, shading, texture, traverse
from recordings.simulator.odometry import dead_reckoning
from recordings.simulator.scenes import DEFAULT_SCENE, SCENES, defaults_of
from recordings.simulator.terrain import Terrain, make_terrain
from stages.data import Array, Pose, StereoCamera, Transform

SECOND = 1_000_000_000
EPOCH = 1_700_000_000 * SECOND
DAY = 86_400 * SECOND
MAX_DAYS = 4000  # from the epoch on; limited by the 32-bit seconds of a ROS time
SENSOR_MARGIN = SECOND // 2  # that the slow sensors run before the first frame and after the last
MIN_TILE = 2.0  # m, of the repeating ground
GROUND = ("sand", "dust", "bedrock")  # fields whose shares are at most 1 together
TILT_RATE, ODOMETRY_RATE, MAST_RATE = 20.0, 10.0, 20.0  # Hz, of an inclinometer, of poses, of a mast that turns
ROCK_DIAMETERS = 0.06, 1.5  # m, of the smallest and the largest rock
HORIZON = 300.0  # m, beyond which is sky
ROW_BLOCK = 32  # rows of one task of a thread
# The Devon Island rover's rectified camera (1280 pixels wide).
DEVON_WIDTH, DEVON_F, DEVON_CX, DEVON_CY, DEVON_HEIGHT = 1280, 968.999694824, 635.139038086, 463.537109375, 960


def _rad(degrees: float) -> float:
    return float(np.radians(degrees))


@dataclass(frozen=True)
class FrameTruth:
    """The exact geometry of one frame.

    base: world <- base_link; mounts: base_link <- left camera, <- right; level: world <- frame `level`; depth: (H, W)
    float64 m, inf = sky; surface: (H, W) int32 codes of the ray caster; seen: (H, W) uint8, 255 by both cameras, 128
    hidden from the right one, 0 no surface; images: left and right; terrain_class: (H, W) uint8, the `TerrainClass` of
    each pixel; jpegs: the bytes of both images' files, if they are compressed.
    """

    base: Transform
    mounts: tuple[Transform, Transform]
    level: Transform
    depth: Array
    surface: Array
    seen: Array
    images: tuple[Array, Array]
    terrain_class: Array
    jpegs: tuple[Array, Array] | None = None


def _by_scene(help: str, **limits: Any) -> Any:
    """A parameter whose default depends on the scene."""
    return parameter(None, f"{help}; the default depends on the scene", **limits)


@dataclass(frozen=True)
class Simulation:
    """A synthetic traverse; equal simulations write equal bytes. Lengths in m, angles in rad, times in s.

    The scene gives the parameters that are not set; `dataclasses.replace` keeps those of the first scene.

    Examples
    --------
    >>> from recordings.simulator import Simulation
    >>> from stages import StereoFrame, Tilt
    >>> simulation = Simulation(frames=2, width=320, height=240, relief_cells=256)
    >>> truth, camera = simulation.frame(0), simulation.camera
    >>> frame = StereoFrame(0, *truth.images, camera)
    >>> disparity = camera.fx * camera.baseline / truth.depth
    >>> tilt = Tilt(0, (truth.base.rotation @ truth.mounts[0].rotation)[2], camera.frame_id)
    >>> disparity.shape, float(tilt.up[1]) < -0.9
    ((240, 320), True)
    """

    scene: str = parameter(DEFAULT_SCENE, "named defaults of ground, light and noise", choices=SCENES)
    frames: int = parameter(12, "number of stereo frames", low=1, high=100_000)
    rate: float = parameter(2.0, "frames per second", unit="Hz", low=0.001, high=100)
    speed: float = parameter(0.5, "speed of the rover", unit="m/s", low=0, high=10)
    width: int = parameter(1280, "width of an image of the Devon camera, scaled", unit="px", low=16, high=8192)
    height: int = parameter(960, "height of an image", unit="px", low=16, high=8192)
    baseline: float = parameter(0.24, "distance between the cameras", unit="m", low=0.001, high=10)
    camera_height: float = parameter(0.9, "height of the cameras above base_link", unit="m", low=0.1, high=100)
    pitch_down: float = parameter(_rad(15), "camera below the horizon", unit="rad", low=_rad(-90), high=_rad(90))
    slope: float = parameter(_rad(4), "RMS slope of the ground over 1 m", unit="rad", low=0, high=_rad(45))
    relief_cells: int = parameter(2048, "cells along a side of the repeating ground tile")
    relief_resolution: float = parameter(0.04, "size of a cell of the ground tile", unit="m", low=0.001, high=10)
    abundance: float = _by_scene("k of Golombek's law of rocks (0.05 sparse, 0.15 dense)", low=0, high=0.5)
    sand: float = _by_scene("share of the ground that is sand", unit="share", low=0, high=1)
    dust: float = _by_scene("share of the ground that is dust", unit="share", low=0, high=1)
    bedrock: float = _by_scene("share of the ground that is bedrock; the rest is gravel", unit="share", low=0, high=1)
    sand_contrast: float = _by_scene(
        "contrast of sand without noise at the scale of a few pixels, RMS, gray levels at mid-gray", low=0, high=30
    )  # fmt: skip
    gravel_contrast: float = _by_scene("the same of gravel, for a sun at 38 degrees", low=0, high=60)
    ripples: float = _by_scene("contrast of the ripples of sand, RMS, gray levels at mid-gray", low=0, high=30)
    sun_elevation: float = _by_scene("sun above the horizon", unit="rad", low=_rad(0.1), high=_rad(90))
    sun_azimuth: float = parameter(_rad(140), "direction of the sun", unit="rad")
    skylight: float = _by_scene("light of the sky, which fills shadows; the sun's is 0.86", low=0, high=1)
    brightness: float = _by_scene("exposure, as a factor", low=0.01, high=10)
    color: bool = parameter(True, "images in rgb8, or else in mono8")
    noise: float = _by_scene(
        "shot and read noise of the gray image (mono8, or the luma of rgb8), one sigma at mid-gray, gray levels",
        low=0, high=100,
    )  # fmt: skip
    blur: float = parameter(0.55, "lens blur, one sigma", unit="px", low=0, high=20)
    vignetting: float = parameter(0.14, "share of the light that the corners lose", unit="share", low=0, high=1)
    exposure_difference: float = parameter(
        0.0, "share by which the right image gets more light, besides the 0.5 to 1 % of every camera", unit="share",
        low=-0.9, high=9,
    )  # fmt: skip
    row_offset: float = parameter(0.0, "rows that the right image is too low", unit="px", low=-20, high=20)
    exposure_time: float = parameter(0.0, "time of an exposure, for motion blur", unit="s", low=0, high=1)
    jpeg: int | None = parameter(None, "quality of compressed images; None: not compressed", low=1, high=100)
    tilt_noise: float = parameter(_rad(0.1), "one sigma of a tilt sample", unit="rad", low=0, high=_rad(45))
    imu: str = parameter(
        "orientation", "what the inclinometer logs: its orientation; raw: accelerations and rates of a MEMS sensor",
        choices=("orientation", "raw"),
    )  # fmt: skip
    imu_rate: float = parameter(100.0, "samples of a raw Imu per second", unit="Hz", low=10, high=1000)
    vibration: float = parameter(
        0.5, "vibration of a raw Imu while the rover drives, RMS of each axis", unit="m/s^2", low=0, high=50
    )
    rest: float = parameter(0.0, "time that the rover stands still before it drives", unit="s", low=0, high=3600)
    odometry_scale: float = parameter(
        0.01, "share by which odometry overstates distances; exact for 0, with odometry_turn 0", unit="share",
        low=-0.5, high=1,
    )  # fmt: skip
    odometry_turn: float = parameter(
        _rad(0.2), "heading error of odometry after 1 m, one sigma; grows with the square root of the distance",
        unit="rad", low=0, high=_rad(90),
    )  # fmt: skip
    frame_offset: float = parameter(0.013, "time from a tilt sample to a frame", unit="s", low=-10, high=10)
    map_half_width: float = parameter(8.0, "half the width of the truth maps", unit="m", low=0.5, high=100)
    map_resolution: float = parameter(0.05, "cells of the truth maps", unit="m", low=0.001, high=10)
    pan: float = parameter(
        0.0, "largest turn of the mast with the cameras, to the left and to the right", unit="rad", low=0, high=_rad(90)
    )
    pan_time: float = parameter(8.0, "time in which the mast turns to both sides and back", unit="s", low=0.1, high=1e4)
    region: float = parameter(
        8.0, "largest distance of a visible cell from base_link or the left camera", unit="m", low=0.1, high=100
    )
    seed: int = parameter(1, "seed of the random numbers", low=0, high=10**15)
    threads: int = parameter(2, "threads of the computation; the result does not depend on it", low=1, high=1024)

    def __post_init__(self) -> None:
        if self.scene in SCENES:
            for name, value in defaults_of(self.scene).items():
                if getattr(self, name) is None:
                    object.__setattr__(self, name, min(value, self._ground_left()) if name in GROUND else value)
        check_parameters(self)
        if (ground := 100 * (self.sand + self.dust + self.bedrock)) > 100 + 1e-7:
            raise ValueError(f"Simulation.sand must be at most 100 % with dust and bedrock, not {ground:g} %")
        if self.relief_cells < 64 or self.relief_cells & (self.relief_cells - 1):
            raise ValueError(f"Simulation.relief_cells must be a power of two of at least 64, not {self.relief_cells}")
        if (tile := self.relief_cells * self.relief_resolution) <= MIN_TILE:
            raise ValueError(
                f"Simulation.relief_cells x relief_resolution must be above {MIN_TILE:g} m, not {tile:g} m"
            )

    def _ground_left(self) -> float:
        """Share of the ground that the set shares leave."""
        return max(1.0 - sum(getattr(self, name) or 0.0 for name in GROUND), 0.0)

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
            self._rng(0), self.relief_cells, self.relief_resolution, self.slope, self.abundance, *ROCK_DIAMETERS
        )
        path = self.route.place_at(np.arange(-self.speed, self.speed * (self.frames / self.rate + 1) + 1, 0.1))
        return terrain.cleared(path, half_width=traverse.BODY_WIDTH / 2 + 0.1, height=0.12)

    @cached_property
    def sun(self) -> Array:
        """Unit vector (3,) towards the sun, world frame."""
        flat = np.cos(self.sun_elevation)
        return np.array([flat * np.cos(self.sun_azimuth), flat * np.sin(self.sun_azimuth), np.sin(self.sun_elevation)])

    @cached_property
    def texture(self) -> texture.Texture:
        """The look of the ground under this sun."""
        cover = texture.Cover(
            self.sand, self.dust, self.bedrock, self.sand_contrast, self.gravel_contrast, self.ripples
        )  # fmt: skip
        return _texture(self.seed, tuple(self.sun.tolist()), cover)

    @cached_property
    def mounts(self) -> tuple[Transform, Transform, Transform]:
        """base_link <- left camera, <- right camera, <- inclinometer; of a mast that looks straight ahead."""
        return traverse.mounts(self.baseline, self.camera_height, self.pitch_down)

    def pan_at(self, stamp: int) -> float:
        """The turn of the mast to the left, rad, at a time, ns."""
        return self.pan * float(np.sin(2 * np.pi * (stamp - self.start) / SECOND / self.pan_time))

    def cameras_at(self, stamp: int) -> tuple[Transform, Transform]:
        """base_link <- left camera, <- right camera at a time, ns."""
        left, right, _ = traverse.mounts(self.baseline, self.camera_height, self.pitch_down, self.pan_at(stamp))
        return left, right

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
        return self.start - SENSOR_MARGIN - round(self.rest * SECOND)

    def sensor_stamps(self, rate: float) -> list[int]:
        """Stamps, ns, of a sensor of `rate` Hz, from before the first frame until after the last."""
        length = (self.stamp(self.frames - 1) + SENSOR_MARGIN - self.begin) / SECOND
        return [self.begin + round(number / rate * SECOND) for number in range(int(np.ceil(length * rate)) + 1)]

    def distance(self, stamp: int) -> float:
        """Metres driven since the nominal start, at a time, ns. After a rest the rover speeds up before the start."""
        since, ramp = (stamp - self.start) / SECOND, SENSOR_MARGIN / SECOND
        if self.rest and since < 0:
            since = max(since, -ramp)
            since += since**2 / (2 * ramp)
        return since * self.speed

    def base_at(self, stamp: int) -> Transform:
        """world <- base_link at a time, ns."""
        return traverse.base_pose(self.terrain, self.route, self.distance(stamp))

    @cached_property
    def odometry(self) -> tuple[Pose, ...]:
        """The odometry of the whole drive, as logged."""
        stamps = self.sensor_stamps(ODOMETRY_RATE)
        distances = np.array([self.distance(stamp) for stamp in stamps])
        bases = [self.base_at(stamp) for stamp in stamps]
        return tuple(dead_reckoning(stamps, bases, distances, self.odometry_scale, self.odometry_turn, self._rng(5)))

    @cached_property
    def inertial(self) -> inertial.InertialDrive:
        """What a raw Imu measures on the whole drive."""
        stamps = np.array(self.sensor_stamps(self.imu_rate))
        half = SECOND / self.imu_rate / 2
        times = self.begin + np.round(np.arange(-inertial.STEPS, 2 * len(stamps) - 1 + inertial.STEPS) * half)
        speeds = np.diff([self.distance(stamp) for stamp in (stamps[0], *stamps)]) * self.imu_rate
        bodies = [self.base_at(int(time)) for time in times]
        return inertial.measured(bodies, self.mounts[2], self.imu_rate, self.vibration, speeds, self._rng(7))

    def frame(self, index: int) -> FrameTruth:
        """Images and exact geometry of one frame."""
        base, mounts = self.base_at(self.stamp(index)), self.cameras_at(self.stamp(index))
        left, right = (base.after(mount) for mount in mounts)
        gain = self.exposure_difference + 1 + 0.01 * float(self._rng(2).uniform(0.5, 1.0))
        with ThreadPoolExecutor(self.threads) as pool:
            depth, surface, kind, radiance = self._render(left, pool)
            seen = np.empty(depth.shape, np.uint8)
            self._by_rows(
                pool,
                lambda rows: raycast.seen_rows(
                    self.terrain.scene, left.translation, right.translation, left.rotation, *self._intrinsics(),
                    rows.start, depth[rows], self.height, self.row_offset, seen[rows],
                ),
            )  # fmt: skip
            other_depth, _, _, other = self._render(right, pool, self.row_offset)
            views = (0, radiance, depth, 1.0), (1, other, other_depth, gain)
            images, jpegs = zip(*pool.map(lambda view: self._picture(index, *view), views), strict=True)
        compressed = jpegs if self.jpeg is not None else None
        return FrameTruth(base, mounts, traverse.level_pose(base), depth, surface, seen, images, kind, compressed)

    def _picture(self, index: int, side: int, light: Array, depth: Array, gain: float) -> tuple[Array, Array]:
        """The image of one camera and, if it is compressed, the bytes of its file."""
        if self.exposure_time > 0:
            half, stamp = round(self.exposure_time / 2 * SECOND), self.stamp(index)
            begin, middle, end = (
                self.base_at(time).after(self.cameras_at(time)[side]) for time in (stamp - half, stamp, stamp + half)
            )  # fmt: skip
            light = cameras.moved(light, depth, self.camera, (begin, middle, end))
        rng = self._rng(3, index, side)
        picture = cameras.expose(
            light, self.brightness * gain, self.blur, self.vignetting, self.noise, rng, self.color
        )  # fmt: skip
        if self.jpeg is None:
            return picture, np.zeros(0, np.uint8)
        content, decoded = cameras.jpeg(picture, self.jpeg)
        return decoded, content

    def _intrinsics(self, row_offset: float = 0.0) -> tuple[float, float, float, float]:
        return self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy + row_offset

    def _render(
        self, pose: Transform, pool: ThreadPoolExecutor, row_offset: float = 0.0
    ) -> tuple[Array, Array, Array, Array]:
        """Depth, surface, terrain class and radiance of one camera's image."""
        shape = self.height, self.width
        depth, surface, facet = np.empty(shape), np.empty(shape, np.int32), np.empty(shape, np.int8)
        kind, radiance = np.empty(shape, np.uint8), np.empty((*shape, 3), np.float32)

        def render(rows: slice) -> None:
            view = pose.translation, pose.rotation, *self._intrinsics(row_offset)
            hits = depth[rows], surface[rows], facet[rows]
            raycast.cast_rows(self.terrain.scene, *view, HORIZON, rows.start, *hits)
            shading.shade_rows(
                self.terrain.scene, self.texture, self.sun, self.skylight, *view, rows.start, *hits,
                radiance[rows], kind[rows],
            )  # fmt: skip

        self._by_rows(pool, render)
        return depth, surface, kind, radiance

    def _by_rows(self, pool: ThreadPoolExecutor, work: Callable[[slice], None]) -> None:
        starts = range(0, self.height, ROW_BLOCK)
        for _ in pool.map(work, (slice(start, min(start + ROW_BLOCK, self.height)) for start in starts)):
            pass

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *stream])


@lru_cache(maxsize=1)  # variants of a simulation mostly have its texture, which takes seconds to make
def _texture(seed: int, sun: tuple[float, float, float], cover: texture.Cover) -> texture.Texture:
    gravel, others = (np.random.default_rng([seed, stream]) for stream in (1, 6))
    return texture.make_texture(gravel, np.array(sun), cover, others)
