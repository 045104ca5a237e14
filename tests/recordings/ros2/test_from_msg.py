"""ROS 2 messages to data: colour order, byte order, angles as directions."""

import struct
import zlib
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.ros2.cdr import make
from recordings.ros2.from_msg import camera_model, pose_of
from recordings.ros2.image_from_msg import pixels_of, unpacked_pixels
from recordings.ros2.tilt_from_msg import up_of
from recordings.ros2.to_msg import camera_info, header, image
from stages.data import CameraModel
from tests.recordings.sample_log import HEIGHT, WIDTH, picture


@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(-180, 180))
def test_up_agrees_with_a_rotated_rover(pitch, roll, yaw):
    # Euler: nose up is a negative turn about y (left), left side up a positive one about x (forward).
    attitude = Rotation.from_euler("ZYX", [yaw, -pitch, roll], degrees=True)
    up = attitude.inv().apply([0, 0, 1])
    np.testing.assert_allclose(up_of(np.deg2rad(pitch), np.deg2rad(roll), "euler"), up, atol=1e-12)
    # Axis: the angles that the x and y axes themselves make with the horizon.
    forward, left = (float(np.arcsin(attitude.apply(axis)[2])) for axis in np.eye(3)[:2])
    np.testing.assert_allclose(up_of(forward, left, "axis"), up, atol=1e-7)
    if pitch > 1:
        assert attitude.apply([1, 0, 0])[2] > 0  # the nose is up
    if roll > 1:
        assert attitude.apply([0, 1, 0])[2] > 0  # the left side is up


def test_impossible_angles_are_refused():
    with pytest.raises(LogError, match="check unit and tilt_model"):
        up_of(1.2, 1.2, "axis")


def test_a_calibration_respects_region_of_interest_and_binning():
    k = np.array([[500.0, 0, 330], [0, 510, 250], [0, 0, 1]])
    p = np.array([[490.0, 0, 320, -120], [0, 490, 240, 0], [0, 0, 1, 0]])
    message = camera_info(1, "cam", CameraModel(640, 480, k, np.zeros(5), np.eye(3), p))
    message.binning_x, message.binning_y = 2, 4
    message.roi.x_offset, message.roi.y_offset, message.roi.width, message.roi.height = 100, 40, 400, 320
    taken, points = camera_model(message), np.array([[0.1, 0.2, 1], [-0.3, 0.05, 1]]).T
    assert (taken.width, taken.height) == (200, 80)
    np.testing.assert_allclose((taken.k @ points)[:2].T, ((k @ points)[:2].T - [100, 40]) / [2, 4])
    np.testing.assert_allclose(taken.p[0, 3] / taken.p[0, 0], -120 / 490)  # the baseline stays
    np.testing.assert_allclose((taken.p[:, :3] @ points)[:2].T, ((p[:, :3] @ points)[:2].T - [100, 40]) / [2, 4])


def raw_image(encoding: str, rows: np.ndarray, width: int, big: bool = False) -> Any:
    message = image(1, "cam", np.zeros((1, 1), np.uint8))
    message.encoding, message.height, message.width, message.step = encoding, rows.shape[0], width, rows.shape[1]
    message.data, message.is_bigendian = rows.reshape(-1).copy(), int(big)
    return message


def test_a_chunk_that_states_more_than_the_file_has_is_refused_before_decoding(monkeypatch):
    png = bytearray(cv2.imencode(".png", picture(3))[1].tobytes())
    png[33:37] = b"\x60\0\0\0"  # the length of the first chunk after the header: 1.6 GB
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(LogError, match="cannot be decoded"):
        pixels_of(compressed(bytes(png), "png"))


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(("encoding", "order"), [
    ("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("8UC3", [2, 1, 0]), ("rgba8", [0, 1, 2, 0]), ("bgra8", [2, 1, 0, 0]),
])  # fmt: skip
def test_every_colour_order_is_read_as_rgb(encoding, order, padding):
    rgb = picture(7)
    rows = np.pad(rgb[:, :, order].reshape(HEIGHT, -1), ((0, 0), (0, padding)), constant_values=99)
    np.testing.assert_array_equal(pixels_of(raw_image(encoding, rows, WIDTH)), rgb)


@pytest.mark.parametrize("big", [False, True])
def test_gray_of_16_bit_is_read_in_its_byte_order(big):
    gray = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 257 + 3
    rows = gray.astype(">u2" if big else "<u2").view(np.uint8)
    out = pixels_of(raw_image("mono16", rows, WIDTH, big))
    np.testing.assert_array_equal(out, gray)
    assert out.dtype == np.uint16
    np.testing.assert_array_equal(pixels_of(raw_image("mono8", picture(1)[:, :, 0], WIDTH)), picture(1)[:, :, 0])


def compressed(data: bytes, kind: str) -> Any:
    content = np.frombuffer(data, np.uint8)
    return make("sensor_msgs/msg/CompressedImage", header=header(1, "cam"), format=kind, data=content)


def test_compressed_images_are_decoded_and_cut_ones_refused():
    rgb = picture(3)
    png = cv2.imencode(".png", rgb[:, :, ::-1])[1].tobytes()
    np.testing.assert_array_equal(pixels_of(compressed(png, "rgb8; png compressed bgr8")), rgb)
    flat = np.full((16, 24, 3), (200, 90, 30), np.uint8)
    jpeg = cv2.imencode(".jpg", flat[:, :, ::-1])[1].tobytes()
    np.testing.assert_allclose(pixels_of(compressed(jpeg, "jpeg")).astype(int), flat, atol=3)
    for data, kind in ((png, "png"), (jpeg, "jpeg")):
        with pytest.raises(LogError, match="the compressed image is truncated"):
            pixels_of(compressed(data[:-20], kind))
    with pytest.raises(LogError, match="cannot be decoded"):
        pixels_of(compressed(b"nonsense", "jpeg"))


@pytest.mark.parametrize("padding", [b"\0" * 16, b"\0" * 9999, b"\xff" * 16, b"\n", b"\xff\xd9" + b" " * 500])
def test_padding_after_a_compressed_image_is_harmless(padding):
    pixels = np.full((16, 24, 3), (200, 90, 30), np.uint8)
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    assert pixels_of(compressed(jpeg + padding, "jpeg"), (24, 16)).shape == (16, 24, 3)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("optimize", [0, 1])
def test_an_image_of_another_size_is_refused_before_decoding(suffix, optimize, monkeypatch):
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, optimize] if suffix == ".jpg" else []
    data = cv2.imencode(suffix, picture(1), flags)[1].tobytes()
    assert pixels_of(compressed(data, suffix), (WIDTH, HEIGHT)).shape == (HEIGHT, WIDTH, 3)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(LogError, match=f"the image is {WIDTH}x{HEIGHT}, but its calibration is for 10x{HEIGHT}"):
        pixels_of(compressed(data, suffix), (10, HEIGHT))
    with pytest.raises(LogError, match=f"the image is {WIDTH}x{HEIGHT}, but its calibration is for 10x{HEIGHT}"):
        pixels_of(raw_image("mono8", picture(1)[:, :, 0], WIDTH), (10, HEIGHT))


@pytest.mark.parametrize(("first", "known"), [(0.25, True), (0.0, False), (-1.0, False)])
def test_a_zero_or_negative_covariance_is_none(first, known):
    point = make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
    turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    known_to = {"pose": make("geometry_msgs/msg/Pose", position=point, orientation=turn)}
    known_to["covariance"] = np.diag([first] * 6).reshape(-1)
    pose = make("geometry_msgs/msg/PoseWithCovariance", **known_to)
    stamped = make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header(5, "odom"), pose=pose)
    found = pose_of(stamped, 5, "base_link")
    assert found is not None
    assert (found.covariance is not None) == known


def test_a_picture_of_a_size_that_opencv_refuses_is_none():
    _, blob = cv2.imencode(".png", np.zeros((4, 4), np.uint8))
    content = bytearray(blob.tobytes())
    content[16:24] = struct.pack(">II", 1 << 20, 1 << 20)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    assert unpacked_pixels(np.frombuffer(content, np.uint8)) is None
