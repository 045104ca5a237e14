"""A tiny simulated traverse, and what its own log and an imported one contain at each frame."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest

from recordings import McapSource
from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import read_grid_map
from recordings.simulator import Simulation, write_log
from recordings.simulator.simulation import FrameTruth
from stages.data import Mount, StereoCamera, Transform
from tests.conftest import roverflow

# Frames at the time of a tilt sample, and sensors without errors: what a layout does not round is equal bit by bit.
EXACT = Simulation(
    scene="gravel", frames=3, width=160, height=120, relief_cells=512, slope=0.12, frame_offset=0.0, tilt_noise=0.0,
    odometry_scale=0.0, odometry_turn=0.0, map_resolution=0.2,
)  # fmt: skip
# Own tilts come more often than those of frames, so they must not be smoothed.
EXACT_TILT = ("--set", "disparities=64", "--set", "tilt.smooth=0 s")
# The mount of the simulator's camera on base_link.
RIG = "height: 0.9 m\npitch_down: 15 deg\nforward: 0.35 m\nleft: 12 cm\n"


@dataclass(frozen=True)
class Seen:
    """What a log contains of one frame. up: (3,) in the left camera; mount: base_link <- left camera, if known."""

    stamp: int
    left: np.ndarray
    right: np.ndarray
    camera: StereoCamera
    up: np.ndarray
    mount: Transform | None


def own_log(simulation: Simulation, out: Path) -> Path:
    """The simulator's own log."""
    out.write_bytes(_content(simulation))
    return out


@lru_cache(maxsize=16)
def _content(simulation: Simulation) -> bytes:
    with TemporaryDirectory() as folder:
        write_log(simulation, Path(folder) / "own.mcap")
        return (Path(folder) / "own.mcap").read_bytes()


@lru_cache(maxsize=16)
def frames_of(simulation: Simulation) -> list[FrameTruth]:
    """The frames of a traverse."""
    return [simulation.frame(number) for number in range(simulation.frames)]


def seen_in(log: Path) -> list[Seen]:
    """The frames of a log, their tilts interpolated."""
    images: dict[str, list[Any]] = {"left": [], "right": []}
    tilts, mounts = [], list[Mount]()
    with McapSource().open(log) as opened:
        assert not set(opened.missing) - {"odometry"}, opened.missing
        for _, stream, item in opened.events():
            if stream in images:
                images[stream].append(item)
            elif stream == "inclinometer":
                tilts.append(item)
            elif stream == "mount":
                mounts.append(item)
    assert [image.stamp for image in images["left"]] == [image.stamp for image in images["right"]]
    found = []
    for left, right in zip(*images.values(), strict=True):
        before = max((tilt for tilt in tilts if tilt.stamp <= left.stamp), key=lambda tilt: tilt.stamp)
        after = min((tilt for tilt in tilts if tilt.stamp >= left.stamp), key=lambda tilt: tilt.stamp)
        tilt = before if before.stamp == left.stamp else before.interpolated(after, left.stamp)
        camera = left.pair_with(right).camera
        mount = max((mount for mount in mounts if mount.stamp <= left.stamp), key=lambda mount: mount.stamp)
        up = mount.camera_from_inclinometer @ tilt.up
        found.append(Seen(left.stamp, left.pixels, right.pixels, camera, up, mount.base_from_camera))
    return found


def assert_same(log: Path, own: Path, *, tolerance: float = 1e-9, stamps: bool = True, mount: bool = True) -> None:
    """Both logs contain the same images bit by bit, and the same calibration, tilts and mount within the tolerance."""
    found, expected = seen_in(log), seen_in(own)
    assert len(found) == len(expected) > 1
    for one, other in zip(found, expected, strict=True):
        assert not stamps or one.stamp == other.stamp
        np.testing.assert_array_equal(one.left, other.left)
        np.testing.assert_array_equal(one.right, other.right)
        for name in ("fx", "fy", "cx", "cy", "cx_right", "baseline", "width", "height"):
            given = getattr(one.camera, name), getattr(other.camera, name)
            assert given[0] == pytest.approx(given[1], rel=tolerance), name
        assert one.camera.raw is None
        np.testing.assert_allclose(one.up, other.up, atol=tolerance)
        if mount:
            np.testing.assert_allclose(one.mount.rotation, other.mount.rotation, atol=tolerance)
            np.testing.assert_allclose(one.mount.translation, other.mount.translation, atol=tolerance)


def assert_same_maps(log: Path, own: Path, folder: Path, tolerance: float = 1e-5) -> None:
    """Both logs give the same elevation maps, within the tolerance, m, in the same cells."""
    maps: list[list[Any]] = []
    for name, given in (("own", own), ("imported", log)):
        out = folder / f"{name}-out.mcap"
        assert roverflow("run", given, "-p", "fast", *EXACT_TILT, "-o", out, "--no-rrd") == 0
        maps.append([read_grid_map(item) for _, _, item in iter_decoded(out, ["/nav/elevation_map"])])
    for one, other in zip(*maps, strict=True):
        np.testing.assert_allclose(one.origin, other.origin, atol=1e-9)
        np.testing.assert_allclose(one.layers["elevation"], other.layers["elevation"], atol=tolerance)
        assert np.isfinite(one.layers["elevation"]).any()


def true_poses(log: Path) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Stamp -> position and quaternion xyzw of the true poses of base_link in a log."""
    found = {}
    for _, _, item in iter_decoded(log, ["/truth/pose"]):
        assert item.child_frame_id == "base_link"
        pose = item.pose.pose
        place = np.array([getattr(pose.position, axis) for axis in "xyz"])
        stamp = item.header.stamp.sec * 10**9 + item.header.stamp.nanosec
        found[stamp] = place, np.array([getattr(pose.orientation, axis) for axis in "xyzw"])
    return found


def assert_same_truth(log: Path, own: Path, tolerance: float = 1e-9) -> None:
    """Both logs contain the same true poses, in worlds that may begin at another place."""
    found, expected = true_poses(log), true_poses(own)
    assert len(found) == len(expected) > 1
    starts = [next(iter(poses.values()))[0] for poses in (found, expected)]
    for (place, turn), (true_place, true_turn) in zip(found.values(), expected.values(), strict=True):
        np.testing.assert_allclose(place - starts[0], true_place - starts[1], atol=tolerance)
        np.testing.assert_allclose(turn, true_turn, atol=tolerance)


def write_images(simulation: Simulation, name: Callable[[int, str], Path]) -> None:
    """Write the images of all frames; name: (frame, "left" or "right") -> the file."""
    for number, frame in enumerate(frames_of(simulation)):
        for side, pixels in zip(("left", "right"), frame.images, strict=True):
            path = name(number, side)
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)


def gray(simulation: Simulation) -> Simulation:
    """The same with gray images."""
    return replace(simulation, color=False)


def numbers(*values: Any) -> str:
    """Numbers as text without rounding, parted by blanks."""
    return " ".join(repr(float(value)) for value in np.concatenate([np.ravel(value) for value in values]))


def write_lines(path: Path, lines: Iterable[str], ending: str = "\n") -> None:
    """Write a text file, and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(line + ending for line in lines), newline="")
