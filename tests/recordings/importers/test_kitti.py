"""Drives and odometry sequences in KITTI's layout become logs."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.importers.kitti import CALIBRATIONS, IMU_HEIGHT, _calibration, _raw, _rectified, _rigid, read_kitti
from recordings.importers.rig import Rig
from recordings.mcap.file import iter_decoded
from tests.conftest import data_folder, roverflow
from tests.recordings.importers.simulated import (
    EXACT,
    RIG,
    assert_same,
    assert_same_truth,
    gray,
    numbers,
    own_log,
    write_images,
    write_lines,
)

# Any rotations and places do, if the chain of transforms is right.
TURNS = [Rotation.from_euler("xyz", angles, degrees=True).as_matrix() for angles in ([1, 2, -1], [88, -3, 91])]
SHIFT = np.array([0.06, 0.0, 0.0])  # m, of the left colour camera
EARTH_RADIUS = 6_378_137.0


def date(stamp):
    """As KITTI writes a time."""
    return f"{datetime.fromtimestamp(stamp // 10**9, UTC):%Y-%m-%d %H:%M:%S}.{stamp % 10**9:09d}"


def write_drive(simulation, home, cameras=("00", "01"), rectified=True):
    """The traverse as a drive: the Imu is 0.93 m above base_link, and right images come 2 ms later."""
    folder, camera = home / "2011_09_26_drive_0001_sync", simulation.camera
    shift = SHIFT if cameras[0] == "02" else np.zeros(3)
    names = dict(zip(("left", "right"), cameras, strict=True))
    write_images(simulation, lambda number, side: folder / f"image_{names[side]}" / "data" / f"{number:010d}.png")
    stamps = [simulation.stamp(number) for number in range(simulation.frames)]
    for name, delay in zip(cameras, (0, 2_000_000), strict=True):
        lines = [date(stamp + delay) for stamp in [*stamps, stamps[-1] + 10**9]]  # the last image is missing
        write_lines(folder / f"image_{name}" / "timestamps.txt", [*lines, ""])
    write_oxts(simulation, folder / "oxts", stamps)
    write_calibration(simulation, home, cameras, shift, rectified)
    assert camera.fx == camera.fy
    return folder


def write_calibration(simulation, home, cameras, shift, rectified):
    camera, (left, *_) = simulation.camera, simulation.mounts
    k, entries = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]), []
    for name, place in zip(cameras, (shift, shift - [camera.baseline, 0, 0]), strict=True):
        size, other = f"{camera.width:e} {camera.height:e}", "1.392000e+03 5.120000e+02"
        entries += [f"S_{name}: {other if rectified else size}", f"S_rect_{name}: {size if rectified else other}"]
        entries += [f"P_rect_{name}: {numbers(np.column_stack([k, k @ place]))}", f"R_{name}: {numbers(np.eye(3))}"]
        entries += [f"K_{name}: {numbers(k)}", f"D_{name}: {numbers(np.zeros(5))}", f"T_{name}: {numbers(place)}"]
    head = "calib_time: 09-Jan-2012 13:57:47"
    write_lines(home / CALIBRATIONS[0], [head, *entries, f"R_rect_00: {numbers(TURNS[0])}"])
    whole, imu_to_velo, rectify = np.eye(4), np.eye(4), np.eye(4)
    imu = replace(left, rotation=np.eye(3), translation=np.array([0, 0, 0.93]))
    from_imu = left.inverse().after(imu)
    whole[:3, :3], whole[:3, 3] = from_imu.rotation, from_imu.translation - shift
    imu_to_velo[:3, :3], imu_to_velo[:3, 3] = TURNS[1], [-0.8, 0.3, -0.8]
    rectify[:3, :3] = TURNS[0] if rectified else np.eye(3)
    velo_to_cam = np.linalg.inv(rectify) @ whole @ np.linalg.inv(imu_to_velo)
    for name, matrix in ((CALIBRATIONS[1], velo_to_cam), (CALIBRATIONS[2], imu_to_velo)):
        write_lines(home / name, [head, f"R: {numbers(matrix[:3, :3])}", f"T: {numbers(matrix[:3, 3])}"])


def write_oxts(simulation, oxts, stamps):
    write_lines(oxts / "timestamps.txt", map(date, stamps))
    first = simulation.base_at(stamps[0])(np.array([[0, 0, 0.93]]))[0, 1]
    for number, stamp in enumerate(stamps):
        base = simulation.base_at(stamp)
        yaw, pitch, roll = Rotation.from_matrix(base.rotation).as_euler("ZYX")
        east, north, up = base(np.array([[0, 0, 0.93]]))[0]
        scale = EARTH_RADIUS * np.cos(np.radians(49))
        latitude = 2 * np.arctan(np.exp((north - first) / scale) * np.tan(np.radians(139 / 2))) - np.pi / 2
        place = np.degrees([latitude, east / scale])
        write_lines(oxts / "data" / f"{number:010d}.txt", [numbers(place, [up, roll, pitch, yaw], np.zeros(24))])


def write_sequence(simulation, home, keys=True):
    """The traverse as sequence 05 of the odometry benchmark, with its poses; returns it and the rig file."""
    folder, camera = home / "sequences" / "05", simulation.camera
    names = {"left": "image_0", "right": "image_1"}
    write_images(simulation, lambda number, side: folder / names[side] / f"{number:06d}.png")
    write_lines(folder / "times.txt", [f"{number / simulation.rate:e}" for number in range(simulation.frames)])
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    places = [[0, 0, 0], [-camera.baseline, 0, 0], [0, 0, 0], [-camera.baseline, 0, 0]]
    lines = [numbers(np.column_stack([k, k @ place])) for place in places]
    write_lines(folder / "calib.txt", [f"P{number}: {line}" for number, line in enumerate(lines)] if keys else lines)
    cameras = [simulation.base_at(simulation.stamp(number)).after(simulation.mounts[0]) for number in range(3)]
    poses = [cameras[0].inverse().after(pose) for pose in cameras]
    rows = [numbers(np.column_stack([pose.rotation, pose.translation])) for pose in poses]
    write_lines(home / "poses" / "05.txt", rows)
    (home / "rig.yaml").write_text(RIG)
    return folder, home / "rig.yaml"


@pytest.mark.parametrize("cameras", [("00", "01"), ("02", "03")], ids=["gray", "colour"])
def test_a_drive_is_the_simulators_log(tmp_path, said, refused, cameras):
    simulation = gray(EXACT) if cameras[0] == "00" else EXACT
    folder, own = write_drive(simulation, tmp_path, cameras), own_log(simulation, tmp_path / "own.mcap")
    log, option = tmp_path / "log.mcap", ["--color"] if cameras[0] == "02" else []
    text = said(0, "import", "kitti", folder, log, *option).out
    assert "timestamps.txt lists 1 pair without one of the images" in text
    assert "base_link is 0.93 m below the Imu" in text
    assert_same(log, own)
    assert_same_truth(log, own, 1e-6)
    _, _, place = next(iter_decoded(log, ["/gps/fix"]))
    assert place.latitude == pytest.approx(49, abs=1e-9)
    assert place.header.frame_id == "imu_link"
    (reading := folder / "oxts" / "data" / "0000000001.txt").unlink()
    assert "oxts/timestamps.txt lists 1 reading without a file" in said(0, "import", "kitti", folder, log, *option).out
    reading.write_text("49 8 \n")
    assert "fewer than 6 numbers" in refused("import", "kitti", folder, log, *option)
    (tmp_path / CALIBRATIONS[0]).write_text("")
    assert f"lacks 'S_rect_{cameras[0]}' with 2 numbers" in refused("import", "kitti", folder, log, *option)


def test_a_drive_before_rectification_is_the_simulators_log(tmp_path):
    folder, own = write_drive(gray(EXACT), tmp_path, rectified=False), own_log(gray(EXACT), tmp_path / "own.mcap")
    assert roverflow("import", "kitti", folder, tmp_path / "log.mcap") == 0
    topics = {topic for topic, _, _ in iter_decoded(tmp_path / "log.mcap")}
    assert "/stereo/left/image_raw/compressed" in topics
    assert_same(tmp_path / "log.mcap", own)


def test_kittis_own_calibration_has_its_baselines_and_the_cameras_height():
    home = data_folder("kitti")
    values, *others = (_calibration(home / name) for name in CALIBRATIONS)
    velo_to_cam, imu_to_velo = (_rigid(other, "R", "T") for other in others)
    (left, _), moved, _ = _raw(values, "00", "01")
    assert (left.width, left.height) == (1392, 512)
    assert left.d[0] == -0.3728755
    assert np.linalg.norm(moved.translation) == pytest.approx(0.5372, abs=1e-3)
    for cameras in (("00", "01"), ("02", "03")):
        models, beside, turned = _rectified(values, *cameras)
        imu_from_left = np.linalg.inv(turned @ velo_to_cam @ imu_to_velo)
        assert imu_from_left[2, 3] + IMU_HEIGHT == pytest.approx(1.65, abs=0.02)  # as KITTI describes its car
        assert beside.translation[0] == pytest.approx(0.537 if cameras[0] == "00" else 0.5327, abs=2e-4)
        assert models[0].width == 1242


@pytest.mark.parametrize("keys", [True, False], ids=["with keys", "without keys"])
def test_an_odometry_sequence_is_the_simulators_log(tmp_path, said, refused, keys):
    simulation = gray(replace(EXACT, slope=0.0))  # the rover stands level, as the rig file says
    (folder, rig), own = write_sequence(simulation, tmp_path, keys), own_log(simulation, tmp_path / "own.mcap")
    log = tmp_path / "log.mcap"
    assert "rotated by the true poses in 05.txt" in said(0, "import", "kitti", folder, log, "--rig", rig).out
    assert_same(log, own, stamps=False, tolerance=1e-7)
    (tmp_path / "poses" / "05.txt").unlink()
    assert "the car is assumed level" in said(0, "import", "kitti", folder, log, "--rig", rig).out
    assert_same(log, own, stamps=False, tolerance=1e-7)
    text = refused("import", "kitti", folder, log)
    assert (
        "give a rig file (--rig FILE) with 'height' (height of the left camera above base_link, in m); KITTI's" in text
    )


def test_a_pair_with_the_time_of_another_is_left_out_with_a_note(tmp_path, said):
    folder, rig = write_sequence(gray(EXACT), tmp_path)
    (folder / "times.txt").write_text("0.0\n0.1\n0.1\n")
    text = said(0, "import", "kitti", folder, tmp_path / "log.mcap", "--rig", rig).out
    assert "1 pair left out, first:" in text
    assert "000002.png has the same time as the image before it, 1100000000 ns" in text
    assert "2 stereo frames" in text


def test_images_and_poses_that_do_not_fit_the_times_are_noted(tmp_path, said):
    folder, rig = write_sequence(gray(EXACT), tmp_path)
    times, poses = folder / "times.txt", tmp_path / "poses" / "05.txt"
    lines, rows = times.read_text().splitlines(True), poses.read_text().splitlines(True)
    given = "import", "kitti", folder, tmp_path / "log.mcap", "--rig", rig
    times.write_text("".join(lines[:2]))
    text = said(0, *given).out
    assert "times.txt has no line for 1 image, first: 000002.png" in text
    assert "05.txt has 3 poses for 2 times; the last are left out" in text
    times.write_text("".join(lines))
    poses.write_text("".join(rows[:2]))
    assert "05.txt has no pose for 1 pair, without tilt in the log" in said(0, *given).out


def test_times_of_a_sequence_in_another_unit_are_refused(tmp_path, refused):
    folder, rig = write_sequence(gray(EXACT), tmp_path)
    (folder / "times.txt").write_text("0\n100\n200\n")  # ms
    why = refused("import", "kitti", folder, tmp_path / "log.mcap", "--rig", rig)
    assert f"{folder}/times.txt has frames 100 s apart (median); write times in seconds" in why


def test_the_poses_of_a_sequence_tilt_its_frames(tmp_path):
    folder, _ = write_sequence(EXACT, tmp_path)
    first = EXACT.base_at(EXACT.stamp(0)).after(EXACT.mounts[0])
    up = first.rotation[2]
    recording = read_kitti(
        folder, Rig(height=0.9, pitch_down=float(-np.arcsin(up[2])), roll=-np.arctan2(up[0], -up[1]))
    )
    for number, pair in enumerate(recording.pairs):
        true = EXACT.base_at(EXACT.stamp(number)).after(EXACT.mounts[0]).rotation[2]
        np.testing.assert_allclose(recording.truth.at(pair.stamp).rotation[2], true, atol=1e-9)
