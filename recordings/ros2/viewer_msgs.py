"""Messages that RViz, Foxglove and rerun draw without plugins: depth, the left image, coloured terrain and codes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from recordings.ros2.to_msg import camera_info, compressed_image, float_cloud, image, pinhole, transform_message
from stages.data import (
    Array,
    CameraModel,
    Disparity,
    ElevationMap,
    NavigationMap,
    StereoCamera,
    StereoFrame,
    Transform,
)  # fmt: skip

MAX_WIDTH = 640  # px of depth and left image
JPEG_QUALITY = 85
CAMERA_HEIGHT = 10.0  # m above the map's frame, of the camera that sees a map from above

Messages = dict[str, Any]  # topic below that of the stream -> message


def depth_messages(disparity: Disparity) -> Messages:
    """Depth (REP 118: 32FC1, m, NaN = unknown) of every n-th pixel, with the CameraInfo of these pixels.

    Empty where the camera is unknown.
    """
    camera = disparity.camera
    if camera is None:
        return {}
    thinned, some = _every_nth(disparity.pixels, camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(camera.fx * camera.baseline) / (thinned + np.float32(camera.cx_right - camera.cx))
    depth[~(depth > 0) | np.isinf(depth)] = np.nan
    return {
        "/depth/image_rect": image(disparity.stamp, camera.frame_id, depth.astype(np.float32)),
        "/depth/camera_info": camera_info(disparity.stamp, camera.frame_id, some),
    }


def left_messages(frame: StereoFrame, eight_bits: Array, with_calibration: bool) -> Messages:
    """Every n-th pixel of the left image as JPEG, with the CameraInfo of these pixels where it is wanted.

    eight_bits: the left image, (H, W) gray or (H, W, 3) RGB uint8.
    """
    thinned, some = _every_nth(eight_bits, frame.camera)
    stored = thinned if thinned.ndim == 2 else cv2.cvtColor(thinned, cv2.COLOR_RGB2BGR)
    _, blob = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    frame_id = frame.camera.frame_id
    messages = {"/left/image_rect/compressed": compressed_image(frame.stamp, frame_id, blob.reshape(-1), "jpeg")}
    if with_calibration:
        messages["/left/camera_info"] = camera_info(frame.stamp, frame_id, some)
    return messages


def code_image(stamp: int, frame_id: str, codes: Array, legend: Mapping[int, tuple[str, tuple[int, int, int]]]) -> Any:
    """Codes (H, W) as a coloured PNG image. legend: code -> name and RGB."""
    table = np.full((256, 3), 255, np.uint8)
    for code, (_, rgb) in legend.items():
        table[code & 0xFF] = rgb[::-1]
    _, blob = cv2.imencode(".png", table[codes.astype(np.uint8)], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return compressed_image(stamp, frame_id, blob.reshape(-1), "png")


def camera_above(navigation: NavigationMap, frame_id: str) -> tuple[Any, Any]:
    """CameraInfo and TFMessage of a camera whose image is the map at height 0, as `birds_eye` draws it.

    It is above the centre of the map and looks down; its frame is `frame_id`.
    """
    rows, cols = navigation.cells.shape
    left, right = navigation.origin[1] + rows * navigation.resolution, navigation.origin[1]
    near, far = navigation.origin[0], navigation.origin[0] + cols * navigation.resolution
    focal = CAMERA_HEIGHT / navigation.resolution
    k = np.array([[focal, 0.0, (rows - 1) / 2], [0.0, focal, (cols - 1) / 2], [0.0, 0.0, 1.0]])
    down = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    place = np.array([(near + far) / 2, (left + right) / 2, CAMERA_HEIGHT])
    pose = Transform(navigation.frame_id, frame_id, down, place)
    stamp = navigation.stamp
    return camera_info(stamp, frame_id, pinhole(rows, cols, k)), transform_message([(pose, stamp)])


def terrain_points(terrain: ElevationMap, colors: Array) -> Any:
    """The known cells of a map as sensor_msgs/PointCloud2 with colours. colors: (rows, cols, 3) RGB uint8."""
    elevation = terrain.layers["elevation"]
    row, col = np.nonzero(np.isfinite(elevation))
    points = np.empty((len(row), 4), np.float32)
    points[:, 0] = terrain.origin[0] + (col + 0.5) * terrain.resolution
    points[:, 1] = terrain.origin[1] + (row + 0.5) * terrain.resolution
    points[:, 2] = elevation[row, col]
    red, green, blue = (colors[row, col, channel].astype(np.uint32) for channel in range(3))
    points[:, 3] = (red << 16 | green << 8 | blue).view(np.float32)
    return float_cloud(terrain.stamp, terrain.frame_id, ("x", "y", "z", "rgb"), points)


def _every_nth(pixels: Array, camera: StereoCamera) -> tuple[Array, CameraModel]:
    """Every n-th pixel of an image of at most MAX_WIDTH columns, and the calibration of these."""
    step = -(-pixels.shape[1] // MAX_WIDTH)
    thinned = np.ascontiguousarray(pixels[step // 2 :: step, step // 2 :: step])
    height, width = thinned.shape[:2]
    k = np.diag([camera.fx / step, camera.fy / step, 1.0])
    k[:2, 2] = (camera.cx - step // 2) / step, (camera.cy - step // 2) / step
    return thinned, pinhole(width, height, k)
