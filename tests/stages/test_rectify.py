"""Rectification: an image distorted by a camera model comes back straight, for every model; rows end up aligned."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.data import CameraModel, StereoCamera, StereoFrame
from stages.rectify import Rectify, _rectifying_maps

SIZE = WIDTH, HEIGHT = 320, 240
K = np.array([[260.0, 0, 158], [0, 262.0, 121], [0, 0, 1]])
P_LEFT = np.array([[240.0, 0, 160, 0], [0, 240.0, 120, 0], [0, 0, 1, 0]])
P_RIGHT = P_LEFT + np.array([[0, 0, 0, -24.0], [0] * 4, [0] * 4])
DISTORTIONS = {
    "plumb_bob": [-0.2, 0.05, 0.001, -0.002, 0.0],
    "rational_polynomial": [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0],
    "equidistant": [-0.03, 0.01, -0.002, 0.001],
}


def scene(x, y):
    """A smooth pattern over the rectified image plane, gray levels."""
    return 128 + 60 * np.sin(x / 9) * np.cos(y / 11) + 40 * np.sin((x + 2 * y) / 23)


def model_with(name, turn, projection):
    rotation = cv2.Rodrigues(np.array(turn))[0]
    return CameraModel(WIDTH, HEIGHT, K, np.array(DISTORTIONS[name]), rotation, projection, name)


def raw_image(model, rows_up=0.0):
    """What the camera sees of the scene: every raw pixel undistorted by OpenCV's iterative solver, then looked up."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=2).reshape(-1, 1, 2).astype(np.float64)
    undistort = cv2.fisheye.undistortPoints if model.model == "equidistant" else cv2.undistortPoints
    x, y = undistort(pixels, model.k, model.d, R=model.r, P=model.p).reshape(HEIGHT, WIDTH, 2).transpose(2, 0, 1)
    return np.round(scene(x, y + rows_up)).astype(np.uint8)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_a_distorted_scene_comes_back_straight(name):
    models = model_with(name, [0.01, -0.02, 0.015], P_LEFT), model_with(name, [-0.01, 0.02, -0.01], P_RIGHT)
    camera = StereoCamera.from_models(*models, "cam", rectified=False)
    rectified = Rectify()(StereoFrame(7, raw_image(models[0]), raw_image(models[1]), camera))
    inside = np.s_[40:-40, 50:-50]
    expected = scene(*np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)))
    assert np.abs(rectified.left - expected)[inside].max() < 2.5
    assert np.abs(rectified.right - expected)[inside].max() < 2.5
    assert rectified.camera.raw is None
    assert (rectified.camera.fx, rectified.camera.baseline, rectified.stamp) == (240, pytest.approx(0.1), 7)


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_row_offset_moves_the_right_image_down(rectified, dtype):
    left = CameraModel(WIDTH, HEIGHT, P_LEFT[:, :3], np.zeros(5), np.eye(3), P_LEFT)
    right = CameraModel(WIDTH, HEIGHT, P_LEFT[:, :3], np.zeros(5), np.eye(3), P_RIGHT)
    camera = StereoCamera.from_models(left, right, "cam", rectified)
    expected = scene(*np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)))
    frame = StereoFrame(1, np.round(expected).astype(dtype), raw_image(right, rows_up=0.6).astype(dtype), camera)
    moved = Rectify(row_offset=0.6)(frame)
    assert moved.right.dtype == dtype
    assert np.abs(moved.right[5:-5, 5:-5].astype(float) - expected[5:-5, 5:-5]).max() < 2
    assert np.abs(frame.right.astype(float) - expected).max() > 4
    assert np.array_equal(moved.left, frame.left)


def test_a_rectified_frame_passes_through_untouched():
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    frame = StereoFrame(1, image, image + 1, StereoCamera(240, 240, 160, 120, 0.1, WIDTH, HEIGHT))
    out = Rectify()(frame)
    assert np.shares_memory(out.left, image)
    assert np.array_equal(out.right, frame.right)


def test_maps_are_made_once_for_equal_calibrations():
    frames = []
    for _ in range(2):
        models = model_with("plumb_bob", [0.03, 0, 0], P_LEFT), model_with("plumb_bob", [0, 0.03, 0], P_RIGHT)
        image = np.zeros((HEIGHT, WIDTH), np.uint8)
        frames.append(StereoFrame(1, image, image, StereoCamera.from_models(*models, "cam", rectified=False)))
    before = _rectifying_maps.cache_info().misses
    for frame in frames:
        Rectify()(frame)
    assert _rectifying_maps.cache_info().misses - before == 2


@pytest.mark.parametrize(
    ("model", "count", "message"), [("pinhole", 5, "unknown distortion model 'pinhole'"), ("equidistant", 5, "has 4")]
)
def test_a_calibration_that_cannot_be_used_is_named(model, count, message):
    bad = CameraModel(WIDTH, HEIGHT, K, np.zeros(count), np.eye(3), P_RIGHT, model)
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    left = CameraModel(WIDTH, HEIGHT, K, np.zeros(count), np.eye(3), P_LEFT, model)
    camera = StereoCamera.from_models(left, bad, "cam", rectified=False)
    with pytest.raises(ValueError, match=message):
        Rectify()(StereoFrame(1, image, image, camera))


def test_a_real_raw_pair_ends_up_row_aligned():
    folder = Path(os.environ.get("ROVERFLOW_DATA", "")) / "polar"
    if not (folder / "calib").is_dir():
        pytest.skip("ROVERFLOW_DATA names no folder with polar/calib")
    left, right = (cv2.imread(str(folder / f"img_9m_cam{i}_25ms.png"), cv2.IMREAD_GRAYSCALE) for i in (0, 1))
    frame = StereoFrame(1, left, right, polar_camera(folder / "calib", left.shape[::-1]))
    offset = row_offset(frame)
    aligned = row_offset(Rectify()(frame))
    assert abs(aligned) < 2.0 < abs(offset)  # its calibration leaves about 1.6 px
    assert abs(row_offset(Rectify(row_offset=aligned)(frame))) < 0.25


def polar_camera(folder, size):
    def read(name, *keys):
        file = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_READ)
        return [file.getNode(key).mat() for key in keys]

    (k1, d1), (k2, d2) = (
        read(f"{side}_intrinsics", "camera_matrix", "distortion_coefficients") for side in ("left", "right")
    )
    turn, shift = read("extrinsics", "rotation_matrix", "translation_vector")
    r1, r2, p1, p2 = cv2.stereoRectify(k1, d1, k2, d2, size, turn, shift, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)[:4]
    models = CameraModel(*size, k1, d1.ravel(), r1, p1), CameraModel(*size, k2, d2.ravel(), r2, p2)
    return StereoCamera.from_models(*models, "cam", rectified=False)


def row_offset(frame):
    """Median of v_left - v_right over mutual feature matches, px."""
    features = cv2.ORB_create(4000, nlevels=4)
    (points1, codes1), (points2, codes2) = (
        features.detectAndCompute(np.ascontiguousarray(image), None) for image in (frame.left, frame.right)
    )
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(codes1, codes2)
    moves = np.array([np.subtract(points1[p.queryIdx].pt, points2[p.trainIdx].pt) for p in pairs if p.distance < 40])
    likely = moves[(np.abs(moves[:, 1]) < 30) & (moves[:, 0] > 0)]
    return np.median(likely[:, 1])
