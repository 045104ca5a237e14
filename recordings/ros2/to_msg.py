"""Builds ROS 2 messages from our data; `from_msg` reads them.

Our grids grow with y (rows) and x (columns) from the lower-left corner, as `nav_msgs/OccupancyGrid` does.
`grid_map_msgs/GridMap` starts at the corner of largest x and y, runs its first index along -x, and is column-major.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from recordings.ros2.cdr import make
from recordings.ros2.rounding import rounded_layer, to_multiples, to_relative
from stages.data import (
    Array,
    CameraModel,
    Disparity,
    ElevationMap,
    NavigationMap,
    PixelOrigin,
    PointCloud,
    Pose,
    StereoCamera,
    Transform,
)
from stages.data.rotations import canonical, quaternion_of

FLOAT32 = 7  # sensor_msgs/PointField.FLOAT32

IMAGE_ENCODINGS: dict[tuple[np.dtype[Any], int], str] = {  # dtype and dimensions -> encoding
    (np.dtype(np.uint8), 2): "mono8",
    (np.dtype(np.uint8), 3): "rgb8",
    (np.dtype(np.uint16), 2): "mono16",
    (np.dtype(np.uint16), 3): "rgb16",
    (np.dtype(np.float32), 2): "32FC1",
    (np.dtype(np.int8), 2): "8SC1",
    (np.dtype(np.int16), 2): "16SC1",
    (np.dtype(np.int32), 2): "32SC1",
    (np.dtype(np.float64), 2): "64FC1",
}


def header(stamp: int, frame_id: str) -> Any:
    """std_msgs/Header; `stamp` in ns."""
    return make("std_msgs/msg/Header", stamp=_time(stamp), frame_id=frame_id)


def has_encoding(pixels: Array) -> bool:
    """Whether `image` takes these pixels."""
    return (pixels.dtype, pixels.ndim) in IMAGE_ENCODINGS and (pixels.ndim == 2 or pixels.shape[2] == 3)


def image(stamp: int, frame_id: str, pixels: Array) -> Any:
    """sensor_msgs/Image of (H, W) integers or floats (NaN = unknown), or (H, W, 3) RGB uint8 or uint16."""
    if not has_encoding(pixels):
        raise ValueError(f"no ROS image encoding for {pixels.dtype} {pixels.shape}")
    encoding = IMAGE_ENCODINGS[pixels.dtype, pixels.ndim]
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False)).view(np.uint8).reshape(-1)
    return make(
        "sensor_msgs/msg/Image", header=header(stamp, frame_id), height=height, width=width, encoding=encoding,
        is_bigendian=0, step=data.size // height if height else 0, data=data,
    )  # fmt: skip


def compressed_image(stamp: int, frame_id: str, content: Array, format: str) -> Any:
    """sensor_msgs/CompressedImage of the bytes of an image file, (N,) uint8, of the format "jpeg" or "png"."""
    return make("sensor_msgs/msg/CompressedImage", header=header(stamp, frame_id), format=format, data=content)


def camera_info(stamp: int, frame_id: str, model: CameraModel) -> Any:
    """sensor_msgs/CameraInfo."""
    return make(
        "sensor_msgs/msg/CameraInfo", header=header(stamp, frame_id), height=model.height, width=model.width,
        distortion_model=model.model, d=np.array(model.d), k=_flat(model.k), r=_flat(model.r), p=_flat(model.p),
        binning_x=0, binning_y=0, roi=_region(0, 0),
    )  # fmt: skip


def pinhole(width: int, height: int, k: Array) -> CameraModel:
    """The calibration of a rectified camera without distortion. k: (3, 3) intrinsics, px."""
    return CameraModel(width, height, k, np.zeros(5), np.eye(3), np.column_stack([k, np.zeros(3)]))


def disparity_camera(disparity: Disparity) -> dict[str, Any]:
    """The sensor_msgs/CameraInfo of the rectified left camera, by the end of its topic; empty where it is unknown."""
    camera = disparity.camera
    if camera is None:
        return {}
    k = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return {"/camera_info": camera_info(disparity.stamp, camera.frame_id, pinhole(camera.width, camera.height, k))}


def disparity_image(disparity: Disparity, step: float = 0.0) -> Any:
    """stereo_msgs/DisparityImage, 32FC1, NaN = unknown.

    As in stereo_image_proc the pixels are d + cx_right - cx, so Z = f * t / d holds. f and t are NaN for an unknown
    camera; min_disparity and max_disparity are the image's own range, NaN if empty. step: px, to multiples of which
    the pixels are rounded, and delta_d; 0: exact.
    """
    camera = disparity.camera
    pixels, frame_id = disparity.pixels, _frame_of(disparity)
    if camera is not None and camera.cx_right != camera.cx:
        pixels = pixels + np.float32(camera.cx_right - camera.cx)
    pixels = to_multiples(pixels, step)
    extremes: tuple[Any, ...] = np.fmin, np.fmax  # without NaN
    low, high = (extreme.reduce(pixels, axis=None) for extreme in extremes)
    height, width = pixels.shape
    return make(
        "stereo_msgs/msg/DisparityImage", header=header(disparity.stamp, frame_id),
        image=image(disparity.stamp, frame_id, pixels),
        f=camera.fx if camera is not None else np.nan, t=camera.baseline if camera is not None else np.nan,
        valid_window=_region(width, height),
        min_disparity=float(low), max_disparity=float(high), delta_d=step,
    )  # fmt: skip


def exact_disparity(stamp: int, pixels: Array, camera: StereoCamera) -> Disparity:
    """True disparities, (H, W) float32 px, NaN = unknown, for `disparity_image`."""
    known = np.isfinite(pixels)
    source = np.where(known, np.uint8(PixelOrigin.MEASURED), np.uint8(PixelOrigin.UNKNOWN))
    return Disparity(stamp, pixels, source, known.astype(np.float32), camera=camera)


def source_image(disparity: Disparity) -> Any:
    """sensor_msgs/Image, mono8, of where each pixel of a disparity image comes from: the codes of `PixelOrigin`, 0
    unknown, 1 measured, 2 plane, 3 filled."""
    return image(disparity.stamp, _frame_of(disparity), disparity.source)


def _frame_of(disparity: Disparity) -> str:
    return disparity.camera.frame_id if disparity.camera is not None else "camera"


def point_cloud(cloud: PointCloud, step: float = 0.0, precision: float = 0.0) -> Any:
    """sensor_msgs/PointCloud2 with the fields x, y, z, rgb (0x00RRGGBB in the bits of a float32, as in PCL) and sigma.

    With points that are not measured also source (the codes of `PixelOrigin`). step: m, to multiples of which
    coordinates are rounded; precision: relative error by which sigmas are rounded; 0: exact.
    """
    names = ("x", "y", "z", "rgb", "sigma") + (() if cloud.source is None else ("source",))
    packed = np.zeros((len(cloud.points), len(names)), np.dtype("<f4"))
    for axis in range(3):  # numpy is faster by columns
        packed[:, axis] = to_multiples(cloud.points[:, axis], step)
        packed.view(np.uint8)[:, 4 * 3 + 2 - axis] = cloud.colors[:, axis]  # blue in the lowest byte
    packed[:, 4] = to_relative(cloud.sigma, precision)
    if cloud.source is not None:
        packed[:, 5] = cloud.source
    return float_cloud(cloud.stamp, cloud.frame_id, names, packed)


def float_cloud(stamp: int, frame_id: str, names: Sequence[str], points: Array) -> Any:
    """sensor_msgs/PointCloud2 of (N, len(names)) float32, x, y and z first."""
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * place, datatype=FLOAT32, count=1)
        for place, name in enumerate(names)
    ]
    return make(
        "sensor_msgs/msg/PointCloud2", header=header(stamp, frame_id), height=1, width=len(points), fields=fields,
        is_bigendian=False, point_step=4 * len(names), row_step=points.nbytes, data=points.view(np.uint8).reshape(-1),
        is_dense=bool(np.isfinite(points[:, :3]).all()),
    )  # fmt: skip


def grid_map(terrain: ElevationMap, step: float = 0.0, precision: float = 0.0) -> Any:
    """grid_map_msgs/GridMap: cell (0, 0) at the corner of largest x and y, first index along -x, column-major.

    Lengths are rounded to multiples of `step`, m; variances, slopes and roughness within the relative error
    `precision`; 0: exact.
    """
    layers = {name: rounded_layer(name, _turned(layer), step, precision) for name, layer in terrain.layers.items()}
    return _grid_map(terrain, layers, ["elevation"])


def reason_map(navigation: NavigationMap) -> Any:
    """grid_map_msgs/GridMap with one layer, "reason": the reason for each cell of the OccupancyGrid."""
    return _grid_map(navigation, {"reason": _turned(navigation.reason.astype(np.float32))}, [])


def _turned(layer: Array) -> Array:
    """A copy of layer[::-1, ::-1] with one form of NaN, as two compress badly; numpy takes three times as long."""
    import cv2  # which readers of logs do not wait for

    return cv2.patchNaNs(cv2.flip(layer, -1), np.nan) if layer.size else layer


def _grid_map(grid: ElevationMap | NavigationMap, layers: Mapping[str, Array], basic: list[str]) -> Any:
    """A GridMap of layers (rows, cols) on the cells of `grid`, each contiguous and turned.

    The grid map's matrix is the transpose of a turned layer; its column-major order is the layer's row-major order.
    """
    rows, cols = next(iter(layers.values())).shape
    length_x, length_y = cols * grid.resolution, rows * grid.resolution
    dimension = "std_msgs/msg/MultiArrayDimension"
    layout = make(
        "std_msgs/msg/MultiArrayLayout",
        dim=[
            make(dimension, label="column_index", size=rows, stride=rows * cols),
            make(dimension, label="row_index", size=cols, stride=cols),
        ],
        data_offset=0,
    )
    data = [make("std_msgs/msg/Float32MultiArray", layout=layout, data=layer.reshape(-1)) for layer in layers.values()]
    centre = (grid.origin[0] + length_x / 2, grid.origin[1] + length_y / 2, 0.0)
    info = make(
        "grid_map_msgs/msg/GridMapInfo", resolution=float(grid.resolution), length_x=length_x, length_y=length_y,
        pose=_pose(centre, (0.0, 0.0, 0.0, 1.0)),
    )  # fmt: skip
    return make(
        "grid_map_msgs/msg/GridMap", header=header(grid.stamp, grid.frame_id), info=info, layers=list(layers),
        basic_layers=basic, data=data, outer_start_index=0, inner_start_index=0,
    )  # fmt: skip


def occupancy_grid(navigation: NavigationMap) -> Any:
    """nav_msgs/OccupancyGrid: row-major from the lower-left cell, 0 free, 100 hazard, -1 unknown."""
    rows, cols = navigation.cells.shape
    info = make(
        "nav_msgs/msg/MapMetaData", map_load_time=_time(navigation.stamp), resolution=float(navigation.resolution),
        width=cols, height=rows, origin=_pose((*navigation.origin, 0.0), (0.0, 0.0, 0.0, 1.0)),
    )  # fmt: skip
    data = np.ascontiguousarray(navigation.cells).reshape(-1)
    stamped = header(navigation.stamp, navigation.frame_id)
    return make("nav_msgs/msg/OccupancyGrid", header=stamped, info=info, data=data)


def transform_message(transforms: Iterable[tuple[Transform, int]]) -> Any:
    """tf2_msgs/TFMessage of (transform, stamp in ns) pairs."""
    stamped = [transform_stamped(transform, stamp) for transform, stamp in transforms]
    return make("tf2_msgs/msg/TFMessage", transforms=stamped)


def imu(stamp: int, frame_id: str, attitude: Array, covariance: Array | None = None) -> Any:
    """sensor_msgs/Imu with an orientation only: `attitude`, xyzw, turns its frame into a world with z up.

    covariance: (3, 3) of the orientation, rad^2; None (unknown) is written as zeros (REP 145). Rates and accelerations
    are marked absent by a first covariance element of -1.
    """
    absent = np.array([-1.0, *[0.0] * 8])
    return make(
        "sensor_msgs/msg/Imu", header=header(stamp, frame_id), orientation=quaternion(attitude),
        orientation_covariance=np.zeros(9) if covariance is None else _flat(covariance),
        angular_velocity=_vector((0.0, 0.0, 0.0)), angular_velocity_covariance=absent,
        linear_acceleration=_vector((0.0, 0.0, 0.0)), linear_acceleration_covariance=absent,
    )  # fmt: skip


def raw_imu(stamp: int, frame_id: str, rate: Array, acceleration: Array) -> Any:
    """sensor_msgs/Imu with a rate (3,), rad/s, and an acceleration (3,), m/s^2, of unknown covariance; its orientation
    is marked absent."""
    return make(
        "sensor_msgs/msg/Imu", header=header(stamp, frame_id), orientation=quaternion(np.array([0.0, 0.0, 0.0, 0.0])),
        orientation_covariance=np.array([-1.0, *[0.0] * 8]),
        angular_velocity=_vector(rate), angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(acceleration), linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def odometry(pose: Pose) -> Any:
    """nav_msgs/Odometry of a pose; its twist is marked unknown by a first covariance element of -1."""
    covariance = np.zeros(36) if pose.covariance is None else _flat(pose.covariance)
    placed = make(
        "geometry_msgs/msg/PoseWithCovariance", pose=_pose(pose.position, pose.quaternion), covariance=covariance
    )  # fmt: skip
    still = make("geometry_msgs/msg/Twist", linear=_vector((0.0, 0.0, 0.0)), angular=_vector((0.0, 0.0, 0.0)))
    twist = make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.array([-1.0, *[0.0] * 35]))
    return make(
        "nav_msgs/msg/Odometry", header=header(pose.stamp, pose.frame_id), child_frame_id=pose.child_frame_id,
        pose=placed, twist=twist,
    )  # fmt: skip


def exact_odometry(place: Transform, stamp: int) -> Any:
    """nav_msgs/Odometry of a pose without errors: world <- body."""
    return odometry(Pose(stamp, place.translation, _turn(place.rotation), place.parent, place.child))


def quaternion_stamped(rotation: Array, stamp: int, frame_id: str) -> Any:
    """geometry_msgs/QuaternionStamped of a rotation (3, 3)."""
    turn = quaternion(_turn(rotation))
    return make("geometry_msgs/msg/QuaternionStamped", header=header(stamp, frame_id), quaternion=turn)


def diagnostics(stamp: int, statuses: Iterable[tuple[int, str, str, dict[str, str]]]) -> Any:
    """diagnostic_msgs/DiagnosticArray of (level 0 ok / 1 warn / 2 error, name, message, values)."""
    return make(
        "diagnostic_msgs/msg/DiagnosticArray",
        header=header(stamp, ""),
        status=[
            make(
                "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=text, hardware_id="",
                values=[make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()],
            )
            for level, name, text, values in statuses
        ],
    )  # fmt: skip


def _time(stamp: int) -> Any:
    seconds, nanoseconds = divmod(int(stamp), 1_000_000_000)
    return make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _region(width: int, height: int) -> Any:
    return make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=height, width=width, do_rectify=False
    )  # fmt: skip


def transform_stamped(transform: Transform, stamp: int) -> Any:
    """geometry_msgs/TransformStamped."""
    turn = quaternion(_turn(transform.rotation))
    return make(
        "geometry_msgs/msg/TransformStamped", header=header(stamp, transform.parent), child_frame_id=transform.child,
        transform=make("geometry_msgs/msg/Transform", translation=_vector(transform.translation), rotation=turn),
    )  # fmt: skip


def _pose(position: Any, turn: Any) -> Any:
    x, y, z = (float(value) for value in position)
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z), orientation=quaternion(turn),
    )  # fmt: skip


def _vector(values: Any) -> Any:
    x, y, z = (float(value) for value in values)
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def quaternion(xyzw: Any) -> Any:
    """geometry_msgs/Quaternion."""
    x, y, z, w = (float(value) for value in xyzw)
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _turn(rotation: Array) -> Array:
    """The quaternion xyzw of a rotation (3, 3)."""
    return canonical(quaternion_of(rotation))


def _flat(matrix: Array) -> Array:
    return np.array(matrix, dtype=np.float64).reshape(-1)
