"""Recordings in EuRoC's layout become logs."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.mcap.file import iter_decoded
from stages import Rectify, StereoFrame
from stages.rectification.row_offset import measure, offset_field
from tests.conftest import data_folder, roverflow
from tests.recordings.calibration.euroc_bag import kalibr_camchain
from tests.recordings.importers.simulated import (
    EXACT,
    RIG,
    assert_same,
    assert_same_maps,
    assert_same_truth,
    gray,
    own_log,
    seen_in,
    write_images,
    write_lines,
)

SIMULATION = replace(gray(EXACT), imu="raw", imu_rate=50.0, rest=2.0)
SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: {pose}
rate_hz: 2
resolution: [{width}, {height}]
camera_model: pinhole
intrinsics: [{fx!r}, {fy!r}, {cx!r}, {cy!r}] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""


def write_euroc(simulation, folder):
    """The traverse as mav0, with a listed image that is missing, one without partner, and CRLF."""
    mav0, camera, (*mounts, imu) = folder / "mav0", simulation.camera, simulation.mounts
    stamps = [simulation.stamp(number) for number in range(simulation.frames)]
    cams = {"left": "cam0", "right": "cam1"}
    write_images(simulation, lambda number, side: mav0 / cams[side] / "data" / f"{stamps[number]}.png")
    for cam, mount in zip(cams.values(), mounts, strict=True):
        pose = np.eye(4)
        pose[:3] = np.column_stack([(at := imu.inverse().after(mount)).rotation, at.translation])
        words = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        (mav0 / cam / "sensor.yaml").write_text(SENSOR.format(pose=pose.ravel().tolist(), **words))
        listed = [*stamps, stamps[-1] + 50_000_000]
        rows = [f"{stamp},{stamp}.png" for stamp in listed]
        write_lines(mav0 / cam / "data.csv", ["#timestamp [ns],filename", *rows], "\r\n")
    alone = mav0 / "cam1" / "data" / f"{stamps[-1] + 50_000_000}.png"
    alone.write_bytes((mav0 / "cam1" / "data" / f"{stamps[-1]}.png").read_bytes())
    measured = zip(simulation.sensor_stamps(simulation.imu_rate), simulation.inertial.rates,
                   simulation.inertial.accelerations, strict=True)  # fmt: skip
    rows = [",".join([str(stamp), *map(repr, map(float, (*rate, *force)))]) for stamp, rate, force in measured]
    write_lines(mav0 / "imu0" / "data.csv", ["#timestamp [ns],w_RS_S_x [rad s^-1]", *rows])
    rows = []
    for stamp in sorted({*stamps, *simulation.sensor_stamps(10)}):
        body = simulation.base_at(stamp).after(imu)
        w_first = np.roll(Rotation.from_matrix(body.rotation).as_quat(), 1)
        rows.append(",".join([str(stamp), *map(repr, map(float, (*body.translation, *w_first, *np.zeros(9))))]))
    write_lines(mav0 / "state_groundtruth_estimate0" / "data.csv", ["#timestamp, p_RS_R_x [m]", *rows])
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    home = tmp_path_factory.mktemp("euroc")
    (home / "rig.yaml").write_text(RIG)
    return write_euroc(SIMULATION, home / "room"), home / "rig.yaml", own_log(SIMULATION, home / "own.mcap")


def test_a_recording_in_eurocs_layout_is_the_simulators_log(recording, tmp_path, said):
    folder, rig, own = recording
    log = tmp_path / "log.mcap"
    text = said(0, "import", "euroc", folder, log, "--rig", rig).out
    assert "cam0/data.csv lists 1 image that cam0/data lacks" in text
    assert "1 image without a partner of the same stamp" in text
    assert "sensor.yaml of cam0 begins with %YAML:1.0" in text
    assert text.splitlines()[-1].startswith(f"{log}: 3 stereo frames")
    assert_same(log, own)
    assert_same_truth(log, own)
    files = {path.read_bytes() for path in folder.glob("mav0/cam?/data/*.png")}
    topics = [f"/stereo/{side}/image_raw/compressed" for side in ("left", "right")]
    assert all(item.data.tobytes() in files for _, _, item in iter_decoded(log, topics))  # nothing is encoded again


def test_a_recording_in_eurocs_layout_gives_the_simulators_maps(recording, tmp_path):
    folder, rig, own = recording
    assert roverflow("import", "euroc", folder / "mav0", tmp_path / "log.mcap", "--rig", rig) == 0
    assert_same_maps(tmp_path / "log.mcap", own, tmp_path)
    scored = tmp_path / "imported-out.mcap", "--truth", tmp_path / "log.mcap"
    assert roverflow("score", *scored) == 0


def test_a_recording_in_tum_vis_layout_has_16_bits_and_kalibrs_calibration(tmp_path):
    mav0 = write_euroc(SIMULATION, tmp_path / "room") / "mav0"
    calibration, log = kalibr_camchain(mav0, tmp_path / "camchain.yaml"), tmp_path / "log.mcap"
    for cam in ("cam0", "cam1"):
        (mav0 / cam / "sensor.yaml").unlink()
        for path in (mav0 / cam / "data").iterdir():
            assert cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint16) * 257)
    (mav0 / "state_groundtruth_estimate0").rename(mav0 / "mocap0")
    assert roverflow("import", "euroc", mav0.parent, log, "--calibration", calibration) == 0
    seen = seen_in(log)
    assert [frame.left.dtype for frame in seen] == [np.uint16] * 3
    np.testing.assert_array_equal(seen[0].left // 257, SIMULATION.frame(0).images[0])
    assert seen[0].camera.baseline == pytest.approx(SIMULATION.baseline)
    assert seen[0].mount is None
    bodies = [item.child_frame_id for _, _, item in iter_decoded(log, ["/truth/pose"])]
    assert bodies == ["left_camera_optical"] * 3  # as base_link is unknown


def test_cameras_in_the_wrong_order_are_refused(recording, tmp_path, refused):
    folder, rig, _ = recording
    turned = shutil.copytree(folder / "mav0", tmp_path / "mav0")
    for name, other in (("cam0", "cam1"), ("cam1", "cam0")):
        shutil.rmtree(turned / name)
        shutil.copytree(folder / "mav0" / other, turned / name)
    why = refused("import", "euroc", turned, tmp_path / "log.mcap", "--rig", rig)
    assert "cam1 is the left camera by the calibration; exchange the names of cam0 and cam1" in why


def test_a_recording_without_readings_or_whole_images_is_refused(recording, tmp_path, refused):
    folder = shutil.copytree(recording[0], tmp_path / "room") / "mav0"
    shutil.rmtree(folder / "state_groundtruth_estimate0")
    readings = (folder / "imu0" / "data.csv").read_text()
    (folder / "imu0" / "data.csv").write_text("#timestamp [ns],w_RS_S_x [rad s^-1]\n")
    assert "imu0/data.csv contains no reading" in refused("import", "euroc", tmp_path / "room", tmp_path / "log.mcap")
    assert not list(tmp_path.glob("log*"))
    (folder / "imu0" / "data.csv").write_text(readings)
    for path in (folder / "cam1" / "data").iterdir():
        path.write_bytes(path.read_bytes()[:-100])
    why = refused("import", "euroc", tmp_path / "room", tmp_path / "log.mcap")
    assert "none of 3 pairs can be used, first: " in why


def test_an_image_that_is_none_is_left_out_with_a_note(recording, tmp_path, said):
    folder = shutil.copytree(recording[0], tmp_path / "room")
    (path := sorted((folder / "mav0" / "cam1" / "data").iterdir())[1]).write_bytes(b"")
    text = said(0, "import", "euroc", folder, tmp_path / "log.mcap").out
    assert f"1 pair left out, first: {path} is not a readable image" in text
    assert "2 stereo frames" in text


def test_repeated_stamps_and_images_that_no_list_has_are_noted(recording, tmp_path, said):
    mav0 = shutil.copytree(recording[0], tmp_path / "room") / "mav0"
    table = mav0 / "cam0" / "data.csv"
    first, second, *_ = [line.split(",") for line in table.read_text().splitlines()[1:]]
    table.write_text(table.read_text() + f"{first[0]},{second[1]}\n")
    for name in ("1.png", ".hidden.png"):
        shutil.copy(mav0 / "cam0" / "data" / first[1], mav0 / "cam0" / "data" / name)
    text = said(0, "import", "euroc", mav0, tmp_path / "log.mcap").out
    assert f"cam0/data.csv has 1 row whose stamp is in a row before, first: {first[0]}; left out" in text
    assert "cam0/data.csv lacks 1 image of cam0/data: 1.png\n" in text
    np.testing.assert_array_equal(seen_in(tmp_path / "log.mcap")[0].left, SIMULATION.frame(0).images[0])


def test_a_camera_without_its_listed_images_is_named(recording, tmp_path, refused):
    mav0 = shutil.copytree(recording[0], tmp_path / "room") / "mav0"
    shutil.rmtree(mav0 / "cam1" / "data")
    why = refused("import", "euroc", mav0, tmp_path / "log.mcap")
    assert f"{mav0}/cam1/data contains none of the 4 images that {mav0}/cam1/data.csv lists" in why


def test_a_real_sequence_has_its_baseline_and_up(tmp_path, said):
    folder = data_folder("euroc")
    log = tmp_path / "log.mcap"
    assert "data.csv lists 75 images that cam0/data lacks" in said(0, "import", "euroc", folder, log).out
    seen = seen_in(log)
    assert len(seen) == 20
    assert seen[0].camera.baseline == pytest.approx(0.110, abs=5e-4)
    rectified = seen[0].camera.raw[0].r @ [0.036, -0.927, -0.372]
    assert np.degrees(np.arccos(seen[0].up @ rectified / np.linalg.norm(rectified))) < 1


def test_rows_of_a_real_sequence_differ_by_less_than_a_tenth_of_a_pixel_as_by_opencv(tmp_path):
    assert roverflow("import", "euroc", data_folder("euroc"), tmp_path / "log.mcap") == 0
    frames = [StereoFrame(each.stamp, each.left, each.right, each.camera) for each in seen_in(tmp_path / "log.mcap")]
    size = frames[0].left.shape[::-1]
    models = frames[0].camera.raw
    turn = models[1].r.T @ models[0].r
    place = models[1].r.T @ [[-frames[0].camera.baseline], [0.0], [0.0]]
    first, second = ((model.k, model.d[:4]) for model in models)
    solved = cv2.stereoRectify(*first, *second, size, turn, place, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
    lenses = zip((first, second), solved[:2], solved[2:4], strict=True)
    maps = [cv2.initUndistortRectifyMap(*model, r, p, size, cv2.CV_32FC1) for model, r, p in lenses]
    rectify = Rectify(row_offset=0.0, columns=0)
    ours = [(frame.left, frame.right) for frame in map(rectify, frames)]
    pairs = [((frame.left, maps[0]), (frame.right, maps[1])) for frame in frames]
    theirs = [[cv2.remap(image, *tables, cv2.INTER_LINEAR) for image, tables in pair] for pair in pairs]
    fields = [offset_field(measure(pairs).terms, *size) for pairs in (ours, theirs)]
    assert np.sqrt(np.mean(fields[0] ** 2)) < 0.1
    assert np.sqrt(np.mean((fields[0] - fields[1]) ** 2)) < 0.03
