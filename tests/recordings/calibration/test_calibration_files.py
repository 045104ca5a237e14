"""Calibrations in the files of ROS, Kalibr, EuRoC and OpenCV, of a pair whose every number is known."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from recordings import McapSource
from recordings.calibration.formats import StereoCalibration, read_calibration
from recordings.calibration.yaml_files import read_yaml
from recordings.errors import LogError
from tests.conftest import data_folder, mcap_rows, write_mcap
from tests.recordings.calibration.euroc_bag import euroc_bag, euroc_rosbag2, kalibr_camchain
from tests.recordings.sample_log import (
    HEIGHT,
    INFOS,
    LEFT,
    RIGHT,
    TILT,
    TRANSFORMS,
    WIDTH,
    changed,
    dropped,
    items_of,
    mounted,
    write_sample,
)  # fmt: skip

INTRINSICS = [[458.6, 457.3, 367.2, 248.4], [457.6, 456.1, 379.9, 255.2]]
K = [np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) for fx, fy, cx, cy in INTRINSICS]
D = [np.array([-0.283, 0.074, 0.0002, 1.8e-5]), np.array([-0.284, 0.075, -0.0001, -3.6e-5])]


def rigid(angles: list[float], translation: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    matrix[:3, 3] = translation
    return matrix


RIGHT_IN_LEFT = rigid([0.8, -0.1, 0.1], [0.11, -0.0002, 0.0009])
CAMERA_FROM_IMU = rigid([10, -5, 90], [0.06, -0.02, -0.01])


def kalibr(folder: Path, key: str = "T_cam_imu", chain: bool = True) -> list[Path]:
    cams = {}
    for name, k, d, moved in zip(
        ("cam0", "cam1"), INTRINSICS, D, (np.eye(4), np.linalg.inv(RIGHT_IN_LEFT)), strict=True
    ):
        imu = moved @ CAMERA_FROM_IMU
        cams[name] = {
            "camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": d.tolist(),
            "intrinsics": k, "resolution": [752, 480],
            key: (imu if key == "T_cam_imu" else np.linalg.inv(imu)).tolist(), "rostopic": f"/{name}/image_raw",
        }  # fmt: skip
    if chain:
        cams["cam1"]["T_cn_cnm1"] = np.linalg.inv(RIGHT_IN_LEFT).tolist()
    return [written(folder / "camchain.yaml", cams)]


def euroc(folder: Path) -> list[Path]:
    paths = []
    for name, k, d, moved in zip(("cam0", "cam1"), INTRINSICS, D, (np.eye(4), RIGHT_IN_LEFT), strict=True):
        pose = np.linalg.inv(CAMERA_FROM_IMU) @ moved
        content = {
            "sensor_type": "camera", "T_BS": {"cols": 4, "rows": 4, "data": pose.ravel().tolist()}, "rate_hz": 20,
            "resolution": [752, 480], "camera_model": "pinhole", "intrinsics": k,
            "distortion_model": "radial-tangential", "distortion_coefficients": d.tolist(),
        }  # fmt: skip
        (folder / name).mkdir()
        paths.append(written(folder / name / "sensor.yaml", content, "%YAML:1.0\n"))
    return paths


def opencv(folder: Path) -> list[Path]:
    """By OpenCV's own writer, in the names of its sample stereo_calib."""
    left_to_right = np.linalg.inv(RIGHT_IN_LEFT)
    contents = {
        "intrinsics.yml": {"M1": K[0], "D1": D[0][None], "M2": K[1], "D2": D[1][None]},
        "extrinsics.yml": {"R": left_to_right[:3, :3], "T": left_to_right[:3, 3:]},
    }
    for name, matrices in contents.items():
        storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
        for key, matrix in matrices.items():
            storage.write(key, matrix)
        storage.release()
    return [folder / name for name in contents]


def written(path: Path, content: dict[str, Any], head: str = "") -> Path:
    path.write_text(head + yaml.safe_dump(content))
    return path


def check(calibration: StereoCalibration) -> None:
    for model, k, d in zip(calibration.models, K, D, strict=True):
        np.testing.assert_allclose(model.k, k)
        np.testing.assert_allclose(model.d, d)
        assert model.model == "plumb_bob"
    assert calibration.right_in_left is not None
    np.testing.assert_allclose(calibration.right_in_left, RIGHT_IN_LEFT, atol=1e-9)


@pytest.mark.parametrize("key", ["T_cam_imu", "T_imu_cam"])
@pytest.mark.parametrize("chain", [True, False])
def test_kalibr_files_say_by_the_key_which_way_a_transform_goes(tmp_path, key, chain):
    calibration = read_calibration(kalibr(tmp_path, key, chain))
    check(calibration)
    np.testing.assert_allclose(calibration.camera_from_imu, CAMERA_FROM_IMU, atol=1e-9)
    assert calibration.topics == ("/cam0/image_raw", "/cam1/image_raw")


def test_euroc_files_contain_poses_in_the_body(tmp_path):
    calibration = read_calibration(euroc(tmp_path))
    check(calibration)
    np.testing.assert_allclose(calibration.camera_from_imu, CAMERA_FROM_IMU, atol=1e-9)


def test_opencv_files_are_read_as_opencv_writes_them(tmp_path):
    calibration = read_calibration(opencv(tmp_path))
    check(calibration)
    assert (calibration.models[0].width, calibration.camera_from_imu) == (0, None)


@pytest.mark.parametrize(("of_k", "of_d", "turn", "shift"), [
    ("K{n}", "D{n}", "R", "T"),
    ("cameraMatrix{n}", "distCoeffs{n}", "rotation", "translation"),
    ("camera_matrix_{n}", "dist_coeffs_{n}", "rotation_matrix", "translation_vector"),
    ("{side}_camera_matrix", "{side}_distortion_coefficients", "R", "T"),
    ("camera_matrix_{side}", "distortion_coefficients_{side}", "R", "T"),
])  # fmt: skip
def test_opencv_files_may_have_the_names_of_other_tools(tmp_path, of_k, of_d, turn, shift):
    left_to_right = np.linalg.inv(RIGHT_IN_LEFT)
    content = {turn: left_to_right[:3, :3].tolist(), shift: left_to_right[:3, 3].tolist()}
    for n, side in enumerate(("left", "right")):
        content[of_k.format(n=n + 1, side=side)] = K[n].tolist()
        content[of_d.format(n=n + 1, side=side)] = np.asarray(D[n]).tolist()
    check(read_calibration([written(tmp_path / "stereo.yaml", content)]))


@pytest.mark.parametrize("size", [["wide", 4], [None, 4], [float("inf"), 4], [4]])
def test_a_size_of_opencv_that_is_none_is_refused(tmp_path, size):
    content = {"R": np.eye(3).tolist(), "T": [-0.2, 0.0, 0.0], "imageSize": size}
    for n in (0, 1):
        content |= {f"K{n + 1}": K[n].tolist(), f"D{n + 1}": np.asarray(D[n]).tolist()}
    with pytest.raises(LogError, match="'imageSize' of the calibration"):
        read_calibration([written(tmp_path / "stereo.yaml", content)])


def camera_info(name: str, shift: float) -> dict[str, Any]:
    matrix = {"rows": 3, "cols": 3, "data": [20.0, 0, 11.5, 0, 20.0, 7.5, 0, 0, 1]}
    return {
        "image_width": 24, "image_height": 16, "camera_name": name, "camera_matrix": matrix,
        "distortion_model": "plumb_bob", "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [20.0, 0, 11.5, shift, 0, 20.0, 7.5, 0, 0, 0, 1, 0]},
    }  # fmt: skip


def calibrated_by_ros(folder: Path, shift: float) -> tuple[Path, McapSource]:
    """A log without CameraInfo, and a source with two files instead; shift: P[0, 3] of the right camera."""
    log = write_sample(folder / "log.mcap", dropped(*INFOS))
    contents = {side: camera_info(side, to) for side, to in (("left", 0.0), ("right", shift))}
    files = [written(folder / f"{side}.yaml", content) for side, content in contents.items()]
    return log, McapSource(calibration=tuple(map(str, files)))


def test_a_log_without_camera_info_runs_with_the_files_of_ros(whole, tmp_path):
    log, source = calibrated_by_ros(tmp_path, -5.0)
    items = items_of(log, source)
    assert [(stream, item.stamp) for _, stream, item in items] == [(stream, item.stamp) for _, stream, item in whole]
    images = [item for _, stream, item in items if stream == "right"]
    assert images[0].model.p[0, 3] == -5.0


def test_files_with_the_right_camera_first_and_a_pair_without_baseline_are_named(tmp_path):
    log, source = calibrated_by_ros(tmp_path, 5.0)
    with pytest.raises(LogError, match=r"the first camera of .* is the right one .*; write the left camera first"):
        source.open(log)
    with McapSource(calibration=source.calibration[::-1]).open(log) as opened:
        assert not opened.missing.keys() & {"left", "right"}
    log, source = calibrated_by_ros(tmp_path, 0.0)
    with source.open(log) as opened:
        assert "does not contain the baseline" in opened.missing["left"]


def test_a_camchain_with_the_right_camera_first_is_read_by_its_topics(tmp_path):
    log = write_sample(tmp_path / "log.mcap", dropped(*INFOS))
    (path,) = kalibr(tmp_path)
    cams = yaml.safe_load(path.read_text())
    cams["cam1"]["T_cn_cnm1"] = rigid([0, 0, 0], [0.25, 0, 0]).tolist()
    for cam in cams.values():
        cam.update(resolution=[WIDTH, HEIGHT], intrinsics=[20.0, 20.0, 11.5, 7.5], distortion_coeffs=[0.0] * 4)
    written(path, cams)
    with pytest.raises(LogError, match=f"name {LEFT} and {RIGHT} as 'rostopic' of its cameras"):
        McapSource(calibration=str(path)).open(log)
    for cam, topic in zip(cams.values(), (RIGHT, LEFT), strict=True):
        cam["rostopic"] = topic
    written(path, cams)
    with McapSource(calibration=str(path)).open(log) as opened:
        assert opened.resolution.cameras is not None


def kalibr_of_sample(folder: Path) -> str:
    """The path of a calibration of the sample's cameras and Imu."""
    (path,) = kalibr(folder)
    cams = yaml.safe_load(path.read_text())
    for cam, topic in zip(cams.values(), (LEFT, RIGHT), strict=True):
        cam.update(resolution=[WIDTH, HEIGHT], intrinsics=[20.0, 20.0, 11.5, 7.5], rostopic=topic)
    return str(written(path, cams))


def test_a_tilt_without_a_frame_has_the_mount_of_the_calibration(tmp_path):
    raw = "/cam0/image_raw", "/cam1/image_raw"
    log = write_sample(tmp_path / "log.mcap", changed(TILT, {"header.frame_id": ""}), names=raw)
    with McapSource(calibration=kalibr_of_sample(tmp_path)).open(log) as opened:
        assert (opened.missing.get("mount"), opened.resolution.tilt_frame) == (None, "inclinometer")


@pytest.mark.parametrize(("nominal", "contradictions"), [
    (TRANSFORMS, 0), (TRANSFORMS[1:], 0), ((*TRANSFORMS, replace(TRANSFORMS[0], translation=np.zeros(3))), 1),
], ids=["camera and Imu", "Imu", "two places of the camera"])  # fmt: skip
def test_transforms_of_a_calibration_win_over_those_of_the_log(tmp_path, nominal, contradictions):
    """Also over those on /tf, which here repeats /tf_static."""
    rows = mcap_rows(write_sample(tmp_path / "log.mcap", mounted(*nominal)))
    log = write_mcap(tmp_path / "tf.mcap", rows + [("/tf", *row[1:]) for row in rows if row[0] == "/tf_static"])
    with McapSource(calibration=kalibr_of_sample(tmp_path)).open(log) as opened:
        problems = [str(problem) for _, problem in opened.resolution.problems]
        assert sum(problem.startswith("/tf_static: ") for problem in problems) == contradictions
        assert sum(problem.startswith("/tf: ") for problem in problems) <= contradictions
        camera_from_imu = opened.resolution.static.between("left_optical", "imu_link")
        assert camera_from_imu is not None
        np.testing.assert_allclose(camera_from_imu.rotation, CAMERA_FROM_IMU[:3, :3], atol=1e-9)
        assert opened.resolution.static.between("base_link", "left_optical") is not None


@pytest.mark.parametrize(("change", "sentence"), [
    (lambda cams: cams["cam1"].pop("intrinsics"), "cam1 of .* lacks 'intrinsics'"),
    (lambda cams: cams["cam0"].update(intrinsics=[1, 2, 3]), "'intrinsics' of cam0 of .* is not 4 numbers"),
    (lambda cams: cams["cam0"].update(camera_model="omni"), "camera model 'omni' of cam0"),
    (lambda cams: cams["cam0"].update(distortion_model="fov"), "lens model 'fov' of cam0"),
    (lambda cams: cams["cam1"].update(T_cn_cnm1=[[1] * 4] * 4), "'T_cn_cnm1' of cam1 .* is not a rotation"),
    (lambda cams: cams["cam1"]["T_cn_cnm1"][3].reverse(), "the last row of 'T_cn_cnm1' of cam1 .* is .*, not 0, 0, 0"),
    (lambda cams: cams["cam1"].update(T_cn_cnm1=rigid([0, 0, 0], [-110.0, 0, 0]).tolist()), "not a baseline"),
    (lambda cams: cams.pop("cam1"), "is not a calibration in a known format"),
])  # fmt: skip
def test_a_file_that_cannot_be_used_is_named_with_its_key(tmp_path, change, sentence):
    (path,) = kalibr(tmp_path)
    cams = yaml.safe_load(path.read_text())
    change(cams)
    written(path, cams)
    with pytest.raises(LogError, match=sentence):
        read_calibration([path])


ALIASES = "a0: &a0 [1, 1]\n" + "".join(f"a{n + 1}: &a{n + 1} [*a{n}, *a{n}]\n" for n in range(40))


@pytest.mark.parametrize("content", [
    "[1, 2", "- a", "", "!!python/object:os.system {}", "\x00", "!!timestamp x: 1", "a: &a [*a]", ALIASES,
    "a: " + "[" * 2000, "a: " + "9" * 5000,
], ids=["cut", "list", "empty", "object", "zero", "no time", "in itself", "aliases", "deep", "long"])  # fmt: skip
def test_a_file_that_is_no_mapping_is_refused(tmp_path, content):
    (tmp_path / "file.yaml").write_text(content)
    with pytest.raises(LogError, match=r"the calibration .*file\.yaml"):
        read_calibration([tmp_path / "file.yaml"])


def test_a_repeated_key_is_named_with_its_line(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text("%YAML:1.0\ncam0: &first {rostopic: /a}\ncam1:\n  <<: *first\n  rostopic: /b\n  intrinsics: 1\n")
    assert read_yaml(path)["cam1"] == {"rostopic": "/b", "intrinsics": 1}
    path.write_text(path.read_text() + "  rostopic: /c\n")
    with pytest.raises(LogError, match=r"the calibration .*file\.yaml, line 7 repeats the key 'rostopic'; correct it"):
        read_yaml(path)


@pytest.mark.parametrize("write", [euroc_bag, euroc_rosbag2])
def test_euroc_in_rosbags_with_kalibrs_calibration_is_rectified(tmp_path, write):
    folder = data_folder("euroc") / "mav0"
    written, chain = write(folder, tmp_path / "room.bag"), kalibr_camchain(folder, tmp_path / "camchain.yaml")
    with McapSource(calibration=str(chain)).open(written) as log:
        assert not {"left", "right", "inclinometer", "mount"} & log.missing.keys()
        items = list(log.events())
    tilts = [item for _, stream, item in items if stream == "inclinometer"]
    mount = next(item for _, stream, item in items if stream == "mount")
    left = next(item for _, stream, item in items if stream == "left")
    up = left.model.r.T @ mount.camera_from_inclinometer @ tilts[0].up
    known = np.array([0.036, -0.927, -0.372])
    assert np.degrees(np.linalg.norm(np.cross(up, known))) < 1.0
