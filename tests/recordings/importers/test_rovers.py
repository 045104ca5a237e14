"""Traverses of rovers become logs: Katwijk beach and Devon Island."""

import os
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import yaml
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from recordings.importers.katwijk import CAMERA_ON_IMU
from recordings.mcap.file import iter_decoded
from tests.conftest import data_folder, roverflow
from tests.recordings.importers.simulated import (
    EXACT,
    assert_same,
    numbers,
    own_log,
    seen_in,
    write_images,
    write_lines,
)

# The camera of Katwijk looks down by about 18 degrees.
PITCH = float(np.arcsin(-CAMERA_ON_IMU.rotation[2, 2]))
BEACH = replace(EXACT, pitch_down=PITCH)
DEVON_RIG = """height: 90 cm
pitch_down: 15 deg
forward: 0.35 m
left: 0.12 m
pitch_column: 3
roll_column: 2
angle_unit: deg
pitch_sign: -1
roll_sign: 1
tilt_model: axis
"""


def date(stamp, form):
    """A time of whole milliseconds."""
    return f"{datetime.fromtimestamp(stamp // 10**9, UTC):{form}}" + f"{stamp % 10**9 // 10**6:03d}"


def write_katwijk(simulation, folder, outward=False):
    """The traverse as a part: the sensors in the frame of the Imu, and MATLAB's calibration of the cameras.

    outward: whether the calibration has the place of the right camera, instead of the shift of its points.
    """
    form = "%Y_%m_%d_%H_%M_%S_"
    sides = {"left": 0, "right": 1}

    def name(number, side):
        return folder / "LocCam" / f"LocCam_{date(simulation.stamp(number), form)}_{sides[side]}.png"

    write_images(simulation, name)
    name(0, "left").with_name("LocCam_2015_11_26_12_53_35_149_0.png").write_bytes(b"")
    rows = ["time ax ay az gx gy gz iax iay iaz"]
    for stamp in simulation.sensor_stamps(20):
        camera = simulation.base_at(stamp).after(simulation.mounts[0])
        up = CAMERA_ON_IMU.rotation @ camera.rotation[2]
        rows.append(f"{date(stamp, form)} {numbers(9.81 * up, [0, 0, 0.1], 9.7 * up)}")
    write_lines(folder / "imu.txt", rows, "\r\n")
    write_lines(folder / "gps-utm31.txt", [f"{row.split()[0]} 52.2 4.4 3.1 0.1 0.1 0.1" for row in rows[1:]])
    camera, shift = simulation.camera, simulation.baseline * 1000
    k = np.array([[camera.fx, 0, camera.cx + 1], [0, camera.fy, camera.cy + 1], [0, 0, 1]])
    lens = {"IntrinsicMatrixInternal": k, "RadialDistortion": [0.0, 0.0], "TangentialDistortion": [0.0, 0.0]}
    both = {"CameraParameters1": lens, "CameraParameters2": lens, "RotationOfCamera2": np.eye(3),
            "TranslationOfCamera2": [shift if outward else -shift, 0.0, 0.0]}  # fmt: skip
    savemat(folder / "LocCam_calibstruct.mat", {"stereoParams": both})
    (folder / "rig.yaml").write_text("height: 0.9 m\n")
    return folder


def write_devon(simulation, home, sampled=True):
    """The traverse as a section from image 101 on, with the inclinometer's roll before a pitch that is nose down."""
    folder, logs = home / "color-rectified-1280x960-s01", home / "logs"
    write_images(simulation, lambda number, side: folder / f"color-rectified-{side}-{number + 101:06d}.ppm")
    for side in ("left", "right"):
        first = folder / f"color-rectified-{side}-000101.ppm"
        first.with_name(f"color-rectified-{side}-000999.ppm").write_bytes(first.read_bytes())
    hours = 5 * 3600 * 10**9
    stamps = {number + 101: simulation.stamp(number) for number in range(simulation.frames)}
    lines = [f"{number:06d} {date(stamp - hours, '%Y-%m-%dT%H:%M:%S.')}-05:00" for number, stamp in stamps.items()]
    write_lines(logs / "image-times.txt", lines)
    keys = [f"{number:06d}" for number in stamps] if sampled else [line.split()[1] for line in lines]
    rows = []
    for key, stamp in zip(keys, stamps.values(), strict=True):
        forward, left, _ = simulation.base_at(stamp).rotation[2]
        rows.append(f"{key} {numbers(np.degrees([np.arcsin(left), -np.arcsin(forward)]))}")
    write_lines(logs / ("inclinometer-sampled.txt" if sampled else "inclinometer.txt"), rows)
    camera = simulation.camera
    lens = f"fx: {camera.fx!r}\ncx: {camera.cx!r}\ncy: {camera.cy!r}\nbaseline: 0.24 m\n"
    (home / "rig.yaml").write_text(DEVON_RIG + lens)
    return folder


@pytest.mark.parametrize("outward", [False, True], ids=["shift of points", "place of the camera"])
def test_a_part_of_katwijk_is_the_simulators_log(tmp_path, said, refused, outward):
    folder, own = write_katwijk(BEACH, tmp_path / "Part1", outward), own_log(BEACH, tmp_path / "own.mcap")
    log = tmp_path / "log.mcap"
    given = "--calibration", folder / "LocCam_calibstruct.mat", "--rig", folder / "rig.yaml"
    text = said(0, "import", "katwijk", folder, log, *given).out
    assert "1 image without a partner of the same time" in text
    assert_same(log, own, mount=False)
    rotations = [seen_in(one)[0].mount.rotation for one in (log, own)]
    np.testing.assert_allclose(*rotations, atol=1e-9)
    assert seen_in(log)[0].mount.translation[2] == 0.9
    assert {item.latitude for _, _, item in iter_decoded(log, ["/gps/fix"])} == {52.2}
    assert "with 'height'" in refused("import", "katwijk", folder, log, *given[:2])
    assert roverflow("import", "katwijk", folder, log, "--calibration", folder / "rig.yaml", *given[2:]) == 2


def test_a_pipe_in_place_of_an_image_is_left_out(tmp_path, said):
    folder = write_katwijk(BEACH, tmp_path / "Part1")
    (path := sorted((folder / "LocCam").glob("*_1.png"))[1]).unlink()
    os.mkfifo(path)
    (folder / "LocCam" / f"._{path.name}").write_bytes(b"of macOS")
    given = "--calibration", folder / "LocCam_calibstruct.mat", "--rig", folder / "rig.yaml"
    text = said(0, "import", "katwijk", folder, tmp_path / "log.mcap", *given).out
    assert f"1 pair left out, first: {path} is a pipe, not an image" in text
    assert "1 image without a partner" in text


def test_a_part_of_katwijk_takes_a_calibration_of_opencv(tmp_path):
    folder, own = write_katwijk(BEACH, tmp_path / "Part1"), own_log(BEACH, tmp_path / "own.mcap")
    camera = BEACH.camera
    k = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    lenses = {"M1": k, "M2": k, "D1": [0.0] * 5, "D2": [0.0] * 5}  # without a size of the images
    stereo = {**lenses, "R": np.eye(3).tolist(), "T": [-camera.baseline, 0, 0]}
    (tmp_path / "stereo.yaml").write_text(yaml.safe_dump(stereo))
    given = "--calibration", tmp_path / "stereo.yaml", "--rig", folder / "rig.yaml"
    assert roverflow("import", "katwijk", folder, tmp_path / "log.mcap", *given) == 0
    assert_same(tmp_path / "log.mcap", own, mount=False)


def test_the_rig_file_places_the_camera_of_katwijk(tmp_path):
    folder, own = write_katwijk(BEACH, tmp_path / "Part1"), own_log(BEACH, tmp_path / "own.mcap")
    rig = f"height: 0.9 m\npitch_down: {PITCH!r} rad\nforward: 0.35 m\nleft: 0.12 m\n"
    (folder / "rig.yaml").write_text(rig)
    given = "--calibration", folder / "LocCam_calibstruct.mat", "--rig", folder / "rig.yaml"
    assert roverflow("import", "katwijk", folder, tmp_path / "log.mcap", *given) == 0
    assert_same(tmp_path / "log.mcap", own)


@pytest.mark.parametrize("sampled", [True, False], ids=["sampled", "by time"])
def test_a_section_of_devon_is_the_simulators_log(tmp_path, said, refused, sampled):
    folder, own = write_devon(EXACT, tmp_path, sampled), own_log(EXACT, tmp_path / "own.mcap")
    log = tmp_path / "log.mcap"
    text = said(0, "import", "devon", folder, log, "--rig", tmp_path / "rig.yaml").out
    assert "1 pair left out, as image-times.txt has no time for its number" in text
    assert_same(log, own)
    (tmp_path / "rig.yaml").write_text((tmp_path / "rig.yaml").read_text().replace("pitch_sign: -1\n", ""))
    text = refused("import", "devon", folder, log, "--rig", tmp_path / "rig.yaml")
    assert "lacks 'pitch_sign' (1: positive is nose up: 1 or -1); the Devon Island data set does not" in text


def test_missing_and_repeated_rows_of_devon_are_noted(tmp_path, said, refused):
    folder = write_devon(EXACT, tmp_path)
    times, tilts = tmp_path / "logs" / "image-times.txt", tmp_path / "logs" / "inclinometer-sampled.txt"
    times.write_text(times.read_text() + "000101 2010-01-01T00:00:00.000-05:00\n")
    tilts.write_text("".join(tilts.read_text().splitlines(True)[:2]))
    given = "import", "devon", folder, tmp_path / "log.mcap", "--rig", tmp_path / "rig.yaml"
    text = said(0, *given).out
    assert "image-times.txt has 1 row whose number is in a row before, first: 101; left out" in text
    assert "inclinometer-sampled.txt has no reading for 1 pair" in text
    _, at, _ = next(iter_decoded(tmp_path / "log.mcap", ["/stereo/left/camera_info"]))
    assert at == EXACT.stamp(0)
    tilts.write_text("")
    assert "inclinometer-sampled.txt contains no reading" in refused(*given)


def test_pairs_of_devon_without_times_are_for_import_images(tmp_path, refused):
    why = refused("import", "devon", data_folder("devon"), tmp_path / "log.mcap")
    assert "use import images for pairs without times" in why


def test_the_camera_of_katwijk_looks_ahead_and_down():
    ahead = np.diag([-1, -1, 1]) @ CAMERA_ON_IMU.rotation @ [0, 0, 1]
    np.testing.assert_allclose(ahead, [np.cos(PITCH), 0, -np.sin(PITCH)], atol=1e-3)
    assert np.degrees(PITCH) == pytest.approx(18.0, abs=0.5)
    right = np.diag([-1, -1, 1]) @ CAMERA_ON_IMU.rotation @ [1, 0, 0]
    np.testing.assert_allclose(right, [0, -1, 0], atol=1e-3)
    assert Rotation.from_matrix(CAMERA_ON_IMU.rotation).magnitude() > 1
