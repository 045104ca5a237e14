"""The data types check their fields, and their arrays are read-only afterwards."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import pytest

from recordings import McapSink, McapSource
from stages import CameraModel, ElevationMap, Mount, NavigationMap, Pose, StereoFrame, Tilt, Transform
from stages.data import VoxelMap
from stages.data.arrays import rows_of
from stages.matching.match import Match
from stages.stage import Stage, parameter
from tests.stages.builders import cloud_of, disparity_of
from tests.stages.terrain.terrain_scene import CAMERA, FRAME

F32, U8 = np.float32, np.uint8
QUATERNION = np.array([0, 0, 0, 1.0])
FLAT = np.zeros((2, 3), F32)
MAKERS: list[Callable[[], Any]] = [
    lambda: FRAME,
    lambda: disparity_of(np.zeros((2, 3)), segments=np.zeros((2, 3), np.int32)),
    lambda: cloud_of(np.zeros((4, 3))),
    lambda: NavigationMap(0, np.zeros((2, 3), np.int8), np.zeros((2, 3), U8), 0.1, (0.0, 0.0), "level"),
    lambda: Tilt(0, np.array([0, 0, 1.0])),
    lambda: Pose(0, np.zeros(3), QUATERNION, "odom", "base", np.eye(6)),
    lambda: Mount(0, np.eye(3)),
    lambda: Transform("a", "b", np.eye(3), np.zeros(3)),
    lambda: CameraModel(4, 3, np.eye(3), np.zeros(5), np.eye(3), np.eye(3, 4)),
]


@pytest.mark.parametrize("make", MAKERS)
def test_arrays_are_read_only_once_published(make):
    item = make()
    arrays = [value for f in fields(item) if isinstance(value := getattr(item, f.name), np.ndarray)]
    assert arrays
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_the_maker_of_an_array_cannot_change_it_once_published():
    pixels, layer = np.full((2, 3), 7, F32), np.zeros((2, 3), F32)
    disparity_of(pixels)
    terrain = ElevationMap(0, {"elevation": layer}, 0.1, (0.0, 0.0), "level")
    for array in (pixels, layer, terrain.layers["elevation"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(TypeError, match=r"read-only; make another map with dataclasses\.replace"):
        terrain.layers["other"] = FLAT  # type: ignore[index]


def test_publishing_a_view_leaves_the_rest_of_its_base_writable():
    whole = np.zeros((4, 3), F32)
    part = disparity_of(whole[:2])
    with pytest.raises(ValueError, match="read-only"):
        part.pixels[0, 0] = 1
    whole[3] = 1


@pytest.mark.parametrize("copied", [lambda item: pickle.loads(pickle.dumps(item)), copy.deepcopy])
def test_an_elevation_map_is_pickled_and_copied(copied):
    layers = {"elevation": np.eye(2, 3, dtype=F32), "count": np.ones((2, 3), F32)}
    given = ElevationMap(7, layers, 0.1, (1.0, 2.0), "odom", Transform("odom", "level", np.eye(3), np.ones(3)), 5)
    found = copied(given)
    for name in ("stamp", "resolution", "origin", "frame_id", "epoch", "shape"):
        assert getattr(found, name) == getattr(given, name)
    assert found.level.translation.tolist() == [1, 1, 1]
    assert found.layers.keys() == layers.keys()
    for name, layer in found.layers.items():
        np.testing.assert_array_equal(layer, layers[name])
        assert not layer.flags.writeable


def test_the_fields_of_an_elevation_map_are_a_dict_by_asdict():
    given = ElevationMap(7, {"elevation": FLAT}, 0.1, (1.0, 2.0), "odom")
    found = asdict(replace(given, stamp=8))
    assert (found["stamp"], found["shape"], found["layers"].keys()) == (8, FLAT.shape, {"elevation"})


def test_small_arrays_are_copied():
    up = np.array([0, 0, 1.0])
    tilt = Tilt(0, up)
    up[2] = 5
    assert tilt.up.tolist() == [0, 0, 1]


@dataclass(frozen=True)
class Free(Stage):
    """A stage whose parameters have no range, with annotations that are no texts."""

    length: float = parameter(1.0, "any length", unit="m")
    count: int | None = parameter(1, "any number")
    names: tuple[str, ...] = parameter((), "any names")
    text: str = parameter("", "any text")


TERRAIN = ElevationMap(0, {"elevation": FLAT}, F32(0.1), np.zeros(2), "odom")  # type: ignore[arg-type]
WILD = np.nan, np.inf, -np.inf, F32("nan")
SIZES = 0.0, -0.05, np.nan, np.inf
NO_ROTATIONS = 2 * np.eye(3), np.diag([1.0, 1, -1]), np.ones((3, 3)), np.zeros((3, 3))
REFUSALS = [
    ("Pose.position must be finite", WILD, lambda bad: Pose(0, np.array([0, bad, 0]), QUATERNION, "odom", "base")),
    ("Pose.quaternion must be finite", WILD, lambda bad: Pose(0, np.zeros(3), [0, 0, bad, 1], "odom", "base")),
    ("Transform.translation must be finite", WILD, lambda bad: Transform("a", "b", np.eye(3), np.array([bad, 0, 0]))),
    ("Tilt.up must be finite", WILD, lambda bad: Tilt(0, np.array([0, 0, bad]))),
    ("Mount.camera_from_inclinometer must be finite", WILD, lambda bad: Mount(0, np.diag([1, 1, bad]))),
    ("Mount.camera_from_inclinometer is not a rotation matrix", NO_ROTATIONS, lambda matrix: Mount(0, matrix)),
    ("ElevationMap.resolution must be positive and finite", SIZES,
     lambda size: ElevationMap(0, {"elevation": FLAT}, size, (0.0, 0.0), "level")),
    ("NavigationMap.resolution must be positive and finite", SIZES,
     lambda size: NavigationMap(0, np.zeros((2, 3), np.int8), np.zeros((2, 3), U8), size, (0.0, 0.0), "level")),
    ("VoxelMap.resolution must be positive and finite", SIZES,
     lambda size: VoxelMap(0, np.zeros((1, 3), np.int32), np.zeros((1, 3), U8), np.ones(1, np.int32), size, "level")),
    ("images are 10x10, the calibration is for 640x480", [10],
     lambda side: StereoFrame(0, *np.zeros((2, side, side), U8), CAMERA)),
    ("StereoFrame.camera must be a stages.StereoCamera", [None, {}],
     lambda bad: replace(FRAME, camera=bad)),
    ("ElevationMap.resolution must be a float, not a str", ["5"], lambda bad: replace(TERRAIN, resolution=bad)),
    ("ElevationMap.origin must be a tuple, not a int", [0], lambda bad: replace(TERRAIN, origin=bad)),
    ("Mount.base_from_camera must be a stages.Transform, not a ndarray", [np.eye(4)],
     lambda bad: Mount(0, np.eye(3), bad)),
    ("Tilt.frame_id must be a str, not a int", [5], lambda bad: Tilt(0, np.array([0, 0, 1.0]), bad)),
    ("StereoCamera.fx must be a number, not", ["500", None], lambda bad: replace(CAMERA, fx=bad)),
    (r"ElevationMap layer 'elevation' must be \(rows, cols\)", [3, (2, 3, 1)],
     lambda shape: ElevationMap(0, {"elevation": np.zeros(shape, F32)}, 0.05, (0.0, 0.0), "level")),
    ("left is uint8, right is uint16", [np.uint16],
     lambda kind: StereoFrame(0, FRAME.left, FRAME.right.astype(kind), CAMERA)),
    ("McapSink.also must be a tuple of texts, not", ["pose", 5, None], lambda bad: McapSink(also=bad)),
    ("McapSink.viewers must be true or false, not", ["no", 1], lambda bad: McapSink(viewers=bad)),
    ("McapSource.left must be a text, not 5", [5], lambda bad: McapSource(left=bad)),
    ("Free.length must be a finite number in m, not", WILD, lambda value: Free(length=value)),
    ("Free.names must be a tuple of texts, not", ["pose", 5, None], lambda bad: Free(names=bad)),
    ("Free.text must be a text, not", [5, True], lambda bad: Free(text=bad)),
    ("Free.count must be a whole number, not", [2.5], lambda bad: Free(count=bad)),
    ("Match.p2 must be a finite number, not", WILD, lambda value: Match(p2=value)),
]  # fmt: skip


@pytest.mark.parametrize(("bad", "make", "message"), [
    (bad, make, message) for message, values, make in REFUSALS for bad in values
])  # fmt: skip
def test_values_that_cannot_be_used_are_refused_by_name(bad, make, message):
    with pytest.raises(ValueError, match=message):
        make(bad)


@pytest.mark.parametrize("stamp", [1.5e9, "0", None, np.float64(7)])
@pytest.mark.parametrize("make", [make for make in MAKERS if hasattr(make(), "stamp")])
def test_a_stamp_that_is_not_whole_nanoseconds_is_refused(make, stamp):
    item = make()
    assert type(replace(item, stamp=np.int64(7)).stamp) is int
    with pytest.raises(ValueError, match=rf"{type(item).__name__}\.stamp must be whole nanoseconds"):
        replace(item, stamp=stamp)


def test_a_covariance_may_be_infinite():
    Pose(0, np.zeros(3), QUATERNION, "odom", "base", np.full((6, 6), np.inf))


def test_what_stages_derive_from_a_frame_is_made_once():
    frame, rows = replace(FRAME), []

    def derive(frame, row):
        rows.append(row)
        return row + len(frame.left)

    assert [frame.once(derive, row) for row in (3, 4, 3)] == [483, 484, 483]
    assert rows == [3, 4]


@pytest.mark.parametrize("frames", [("map", "base"), ("odom", "mast")])
def test_poses_of_different_frames_are_not_interpolated(frames):
    first = Pose(0, np.zeros(3), QUATERNION, "odom", "base")
    assert first.interpolated(Pose(4, np.array([8.0, 0, 0]), QUATERNION, "odom", "base"), 1).position[0] == 2.0
    with pytest.raises(ValueError, match=f"of 'base' in 'odom' to the pose of '{frames[1]}' in '{frames[0]}'"):
        first.interpolated(Pose(4, np.array([8.0, 0, 0]), QUATERNION, *frames), 1)


def test_tilts_are_not_smoothed_beyond_the_samples_of_a_filter():
    samples = [Tilt(stamp, [0, 0, 1.0], filtered=True) for stamp in range(3)]
    for given, message in ((samples, "no two samples lie around 10 ns"), ([], "there are no samples")):
        with pytest.raises(ValueError, match=message):
            Tilt.smoothed(given, 10)


@pytest.mark.parametrize("shape", [(0,), (0, 3), (9,), (9, 3), (9, 1)])
@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_rows_are_those_that_numpy_indexes(shape, dtype):
    values = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    mask = np.arange(shape[0]) % 4 < 2
    for which in (mask, ~mask, np.zeros_like(mask), np.flatnonzero(mask)[::-1]):
        for array in (values, np.asfortranarray(values), values[::-1]):
            np.testing.assert_array_equal(rows_of(array, which), array[which], strict=True)
