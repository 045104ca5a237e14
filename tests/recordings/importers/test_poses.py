"""Data sets whose tilt is that of true poses become logs: TartanAir and LuSNAR."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import read_disparity
from recordings.source.transforms import BODY_FROM_OPTICAL
from tests.conftest import roverflow
from tests.recordings.importers.simulated import (
    EXACT,
    RIG,
    assert_same,
    assert_same_truth,
    frames_of,
    numbers,
    own_log,
    true_poses,
    write_images,
    write_lines,
)

LENS = f"fx: {EXACT.camera.fx!r}\ncx: {EXACT.camera.cx!r}\ncy: {EXACT.camera.cy!r}\nbaseline: 24 cm\n"
DOWN = np.diag([1.0, -1.0, -1.0])


def write_tartanair(simulation, folder, cameras=("lcam_front", "rcam_front")):
    """The traverse as a trajectory: one image without partner, poses in NED, depth in the bytes of a PNG."""
    names, rows = dict(zip(("left", "right"), cameras, strict=True)), []
    write_images(simulation, lambda number, side: folder / f"image_{names[side]}" / f"{number:06d}_{names[side]}.png")
    (folder / f"image_{cameras[0]}" / f"000003_{cameras[0]}.png").write_bytes(b"cut off")
    (folder / f"depth_{cameras[0]}").mkdir()
    for number in range(simulation.frames):
        pose = simulation.base_at(simulation.stamp(number)).after(simulation.mounts[0])
        turn = Rotation.from_matrix(DOWN @ pose.rotation @ BODY_FROM_OPTICAL.T @ DOWN).as_quat()
        rows.append(numbers(DOWN @ pose.translation, turn))
        depth = np.where(np.isfinite(truth := frames_of(simulation)[number].depth), truth, 1e10).astype("<f4")
        path = folder / f"depth_{cameras[0]}" / f"{number:06d}_{cameras[0]}_depth"
        if cameras[0] == "left":
            np.save(f"{path}.npy", depth)
        else:
            assert cv2.imwrite(f"{path}.png", depth.view(np.uint8).reshape(*depth.shape, 4))
    write_lines(folder / f"pose_{cameras[0]}.txt", rows)
    (folder / "rig.yaml").write_text(RIG + LENS)
    return folder


def write_lusnar(simulation, folder):
    """The traverse as a scene: the body has x right, y forward, z up, the world y up."""
    names = {"left": "image1", "right": "image2"}
    write_images(simulation, lambda number, side: folder / names[side] / "RGB" / f"{simulation.stamp(number)}.png")
    rows = []
    for stamp in simulation.sensor_stamps(20):
        base = simulation.base_at(stamp)
        upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        body = Rotation.from_matrix(upright.T @ base.rotation @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
        w_first = np.roll(body.as_quat(), 1)
        rows.append(f"{stamp} {numbers(upright.T @ base.translation, w_first, np.zeros(9))}")
    write_lines(folder / "Rover_pose.txt", rows, "\r\n")
    (folder / "rig.yaml").write_text(RIG + LENS + "body_axes: rfu\nworld_up: y\n")
    return folder


@pytest.mark.parametrize("cameras", [("lcam_front", "rcam_front"), ("left", "right")], ids=["second", "first"])
def test_a_trajectory_of_tartanair_is_the_simulators_log(tmp_path, said, cameras):
    folder, own = write_tartanair(EXACT, tmp_path / "P000", cameras), own_log(EXACT, tmp_path / "own.mcap")
    log = tmp_path / "log.mcap"
    text = said(0, "import", "tartanair", folder, log, "--rig", folder / "rig.yaml").out
    assert "1 image without a partner of the same number" in text
    assert_same(log, own, stamps=False)
    assert_same_truth(log, own)
    assert list(true_poses(log)) == [1_000_000_000 + number * 100_000_000 for number in range(3)]
    found, expected = ([read_disparity(item) for _, _, item in iter_decoded(one, ["/truth/disparity"])]
                       for one in (log, own))  # fmt: skip
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_a_number_of_tartanair_beyond_all_times_is_refused(tmp_path, refused):
    folder = write_tartanair(EXACT, tmp_path / "P000")
    for side in ("lcam_front", "rcam_front"):
        (folder / f"image_{side}" / f"000001_{side}.png").rename(folder / f"image_{side}" / f"{10**12}_{side}.png")
    assert f"{10**12}_lcam_front.png has the time '{10**12}', which is not between 1970 and 2038" in refused(
        "import", "tartanair", folder, tmp_path / "log.mcap"
    )


def test_images_of_tartanair_without_a_pose_are_noted(tmp_path, said):
    folder = write_tartanair(EXACT, tmp_path / "P000")
    (path := folder / "pose_lcam_front.txt").write_text("".join(path.read_text().splitlines(True)[:2]))
    text = said(0, "import", "tartanair", folder, tmp_path / "log.mcap").out
    assert "pose_lcam_front.txt has no pose for 1 pair, without tilt in the log" in text


def test_the_camera_of_tartanair_looks_90_degrees_wide(tmp_path, refused):
    folder = write_tartanair(EXACT, tmp_path / "P000")
    assert roverflow("import", "tartanair", folder, tmp_path / "log.mcap") == 0
    _, _, info = next(iter_decoded(tmp_path / "log.mcap", ["/stereo/right/camera_info"]))
    np.testing.assert_allclose(info.p.reshape(3, 4)[:2], [[80, 0, 80, -80 * 0.25], [0, 80, 60, 0]])
    assert "give the folder of one trajectory" in refused("import", "tartanair", tmp_path, tmp_path / "log.mcap")


def test_a_scene_of_lusnar_is_the_simulators_log(tmp_path):
    folder, own = write_lusnar(EXACT, tmp_path / "Moon_1"), own_log(EXACT, tmp_path / "own.mcap")
    assert roverflow("import", "lusnar", folder, tmp_path / "log.mcap", "--rig", folder / "rig.yaml") == 0
    assert_same(tmp_path / "log.mcap", own)


@pytest.mark.parametrize(("rig", "words"), [
    (RIG, "lacks 'body_axes' (axes of the data set's body"),
    ("height: 0.9\n", "'height': 0.9 needs a unit; write 0.9 cm or 0.9 m"),
    ("height: 0.9 m\n", "lacks 'pitch_down'"),
    ("hight: 0.9 m\n", "has the entry 'hight', which is not used; it may have height, pitch_down"),
    ("pitch_sign: 1\n", "has the entry 'pitch_sign', which is not used"),
    (RIG + "body_axes: lfu\nworld_up: z\n", "are not three right-handed axes"),
    (RIG + "body_axes: flu\nworld_up: up\n", "'world_up': must be one of z, -z, y, -y, not up"),
], ids=range(7))  # fmt: skip
def test_a_rig_file_that_says_too_little_is_refused(tmp_path, refused, rig, words):
    folder = write_lusnar(replace(EXACT, frames=1), tmp_path / "Moon_1")
    (tmp_path / "rig.yaml").write_text(rig)
    given = "import", "lusnar", folder, tmp_path / "log.mcap", "--rig", tmp_path / "rig.yaml"
    assert words in refused(*given)
