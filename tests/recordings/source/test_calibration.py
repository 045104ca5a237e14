"""Calibration and transforms come from the log; contradictions and gaps are reported."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Finding, Severity
from recordings import McapSource
from recordings.errors import LogError
from recordings.ros2.to_msg import odometry, transform_message
from recordings.source.calibration import calibrated_pair
from recordings.source.transforms import BODY_FROM_OPTICAL, TransformTree
from stages.data import CameraModel, Pose, Transform
from tests.conftest import write_messages
from tests.recordings.sample_log import (
    BASELINE,
    FRAMES,
    INFOS,
    LEFT,
    START,
    TRANSFORMS,
    changed,
    dropped,
    essences,
    items_of,
    losses_in,
    missing_in,
    model,
    mounted,
    refused_in,
    replaced,
    tilt_quaternion,
    write_sample,
)

RAW = ("/left/image_raw", "/right/image_raw")
RECTIFIED = ("/left/image_rect", "/right/image_rect")


def single_calibrations(path: Path, names: tuple[str, str], beside: Transform, fx: float = 20.0) -> Path:
    """Two single calibrations without distortion; `beside` places the right one in the left's frame."""

    wide = {"k": lambda k: np.where(np.isin(np.arange(9), (0, 4)), fx, k)}
    edits = changed("camera_info", {"p": np.zeros(12)}), changed("right/camera_info", wide)
    return write_sample(path, mounted(*TRANSFORMS, beside), *edits, names=names)


def turned(axis: str, degrees: float) -> np.ndarray:
    return np.asarray(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())


@pytest.mark.parametrize("names", [RAW, RECTIFIED])
def test_parallel_cameras_need_no_rectification(tmp_path, names):
    beside = Transform("left_optical", "right_optical", np.eye(3), [0.25, 0.001, 0])
    with McapSource().open(single_calibrations(tmp_path / "log.mcap", names, beside)) as log:
        assert [camera.rectified for camera in log.resolution.cameras] == [True, True]
        assert log.resolution.cameras[1].model.p[0, 3] == pytest.approx(-20 * 0.25)


@pytest.mark.parametrize(("rotation", "place", "fx"), [
    (turned("y", -3), [0.25, 0, 0], 20.0), (turned("z", 5), [0.25, 0, 0], 20.0), (np.eye(3), [0.25, 0.01, 0], 20.0),
    (np.eye(3), [0.25, 0, 0.1], 20.0), (np.eye(3), [0.25, 0, 0], 22.0),
])  # fmt: skip
def test_cameras_that_are_not_parallel_need_rectification(tmp_path, rotation, place, fx):
    beside = Transform("left_optical", "right_optical", rotation, place)
    with McapSource().open(single_calibrations(tmp_path / "raw.mcap", RAW, beside, fx)) as log:
        assert log.resolution.cameras is not None
        left, right = log.resolution.cameras
    assert not left.rectified
    assert -right.model.p[0, 3] / right.model.p[0, 0] == pytest.approx(np.linalg.norm(place))
    point = np.array([0.3, -0.2, 4.0])
    places = []
    for camera, seen in ((left, point), (right, beside.inverse()(point))):
        projected = camera.model.p[:, :3] @ camera.model.r @ seen
        places.append(projected[:2] / projected[2])
    assert places[0][1] == pytest.approx(places[1][1], abs=1e-9)
    disparity = places[0][0] - places[1][0] + right.model.p[0, 2] - left.model.p[0, 2]
    assert -right.model.p[0, 3] / disparity == pytest.approx((left.model.r @ point)[2], rel=1e-9)  # the depth
    rectified = single_calibrations(tmp_path / "rect.mcap", RECTIFIED, beside, fx)
    assert "are rectified by their names, but the cameras are not parallel by" in missing_in(rectified)["left"]


@pytest.mark.parametrize("place", [[0, -0.25, 0], [0, 0.25, 0], [0.15, 0, 0.2], [0, 0, -0.25], [-0.25, 0, 0]])
@pytest.mark.parametrize("names", [RAW, RECTIFIED])
def test_a_right_camera_not_beside_the_left_or_exchanged_with_it_is_refused(tmp_path, names, place):
    beside = Transform("left_optical", "right_optical", np.eye(3), place)
    why = f"so {names[0]} is the right camera" if place[0] < 0 else "these are not optical frames"
    refused = missing_in(single_calibrations(tmp_path / "log.mcap", names, beside))["left"]
    assert why in refused
    assert ("one camera is above the other, but stereo needs both side by side; rotate" in refused) == (place[1] != 0)


@pytest.mark.parametrize(("values", "sentence"), [
    ({"k": np.full(9, np.nan)}, "must be finite"),
    ({"d": np.full(5, np.nan)}, "must be finite"),
    ({"p": np.full(12, np.nan)}, "must be finite"),
    ({"p": np.hstack([np.diag([0.0, 20, 1]), np.zeros((3, 1))]).reshape(-1)}, "focal lengths in P .* not positive"),
    ({"r": np.diag([1.0, 1.0, 0.5]).reshape(-1)}, "R of the CameraInfo of .* is not a rotation"),
    ({"width": 11}, r"principal point \(11.5, 7.5\) in P of the CameraInfo of .* lies outside its 11x16 images"),
    ({"height": 7}, "lies outside its 24x7 images"),
    ({"width": 0}, "is for images of 0x16"),
    ({"p": np.hstack([np.diag([1e-300, 20, 1]), [[-1e300], [0], [0]]]).reshape(-1)}, "are impossible for a camera"),
])  # fmt: skip
def test_an_impossible_calibration_is_refused(tmp_path, values, sentence):
    log = write_sample(tmp_path / "log.mcap", changed("left/camera_info", values))
    assert re.search(sentence, missing_in(log)["left"])


@pytest.mark.parametrize(("values", "sentence"), [
    ({"distortion_model": "fisheye"}, "cannot be rectified with their CameraInfo: unknown distortion model 'fisheye'"),
    ({"d": np.full(3, 1e-3)}, "a plumb_bob camera has 0 or 4 or 5 or .* coefficients, the calibration has 3"),
    ({"d": np.full(8, 1e-3)}, "^$"),  # the name of many drivers for a rational polynomial
    ({"k": np.zeros(9), "d": np.full(5, 0.1)}, "no focal length in K"),
])  # fmt: skip
def test_a_distortion_that_cannot_be_removed_is_reported_before_the_run(tmp_path, values, sentence):
    edit = changed("camera_info", {"d": np.full(4, 1e-3), **values})
    assert re.search(sentence, missing_in(write_sample(tmp_path / "log.mcap", edit, names=RAW)).get("left", ""))


def test_a_calibration_with_only_p_means_rectified_images(tmp_path):
    edit = changed("camera_info", {"k": np.zeros(9), "d": np.zeros(5)})
    with McapSource().open(write_sample(tmp_path / "log.mcap", edit, names=RAW)) as log:
        assert [camera.rectified for camera in log.resolution.cameras] == [True, True]


@pytest.mark.parametrize("names", [RAW, RECTIFIED])
@pytest.mark.parametrize(("place", "value", "sentence"), [(0, 18.6, "fx is 20 and 18.6"), (6, 8.5, "cy is 7.5")])
def test_projections_of_no_rectified_pair_are_refused(tmp_path, names, place, value, sentence):
    edit = changed("/right/camera_info", {"p": lambda p: np.where(np.arange(12) == place, value, p)})
    log = write_sample(tmp_path / "log.mcap", edit, names=names)
    assert f"does not belong to a rectified pair: {sentence}" in missing_in(log)["left"]


def test_lenses_without_a_rectified_image_are_refused():
    k = np.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]])
    folding = np.array([0.0005, -0.0118, -0.0077, -0.0217])  # has no inverse at the corners
    lens = CameraModel(640, 480, k, folding, np.eye(3), np.hstack([k, np.zeros((3, 1))]), "equidistant")
    frames = TransformTree()
    for item in transform_message([(Transform("l", "r", np.eye(3), [0.25, 0.003, 0]), START)]).transforms:
        frames.add(item)
    with pytest.raises(LogError, match="no image of 640x480 px can be rectified with these lenses"):
        calibrated_pair((lens, lens), ("l", "r"), RAW, frames)


def test_a_rectified_image_has_its_own_frame_if_r_rotates_it(tmp_path):
    """Transforms and poses of the camera's own frame are rotated by R."""
    by = turned("y", 2.0) @ turned("x", -1.0)
    edits = changed("camera_info", {"r": by.ravel()}), changed("/odom", {"child_frame_id": "left_optical"})
    with McapSource().open(write_sample(tmp_path / "log.mcap", *edits, names=RECTIFIED)) as log:
        found = {stream: item for _, stream, item in log.events() if stream in ("left", "mount", "odometry")}
        camera, mount, pose = found["left"], found["mount"].base_from_camera, found["odometry"]
    assert camera.frame_id == mount.child == pose.child_frame_id == "left_optical_rectified"
    own = TRANSFORMS[0].rotation  # of the camera on the rover
    np.testing.assert_allclose(mount.rotation @ by, own, atol=1e-12)
    np.testing.assert_allclose(mount.translation, TRANSFORMS[0].translation)
    given = Rotation.from_quat(tilt_quaternion(FRAMES - 1)).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(pose.quaternion).as_matrix() @ by, given, atol=1e-9)


@pytest.mark.parametrize("with_base", [True, False])
def test_a_pose_is_transformed_to_the_rover_or_its_camera(tmp_path, with_base):
    camera, inclinometer = TRANSFORMS
    on_camera = camera.inverse().after(inclinometer)
    edits = changed("/odom", {"child_frame_id": "imu_link"}), mounted(*(TRANSFORMS if with_base else [on_camera]))
    with McapSource().open(write_sample(tmp_path / "log.mcap", *edits)) as log:
        assert log.missing == {}
        assert ("mount" in log.notes()) == (not with_base)
        poses = [item for _, _, item in log.events(["odometry"])]
    sits = inclinometer if with_base else on_camera  # the inclinometer, whose pose is logged
    assert [pose.child_frame_id for pose in poses] == [sits.parent] * FRAMES
    for number, pose in enumerate(poses):
        right_in_left = Transform("odom", sits.parent, Rotation.from_quat(pose.quaternion).as_matrix(), pose.position)
        logged = right_in_left.after(sits)
        np.testing.assert_allclose(logged.translation, [number, 2.0, 3.0], atol=1e-9)
        given = Rotation.from_quat(tilt_quaternion(number)).as_matrix()
        np.testing.assert_allclose(logged.rotation, given, atol=1e-9)
        # The lever arm turns the rotation error into a position error.
        lever = float(np.linalg.norm(sits.translation))
        assert np.trace(pose.covariance[:3, :3]) == pytest.approx(0.01 * (3 + 2 * lever**2))


def test_the_set_base_frame_must_be_joined_to_the_camera(tmp_path):
    log = write_sample(tmp_path / "log.mcap")
    why = refused_in(log, base_frame="rover")["base_frame"]
    assert why.startswith("the source's 'base_frame' is set to 'rover', but transforms")
    assert "transforms join the camera to 'base_link' only; set it to one of these" in why
    assert refused_in(log, base_frame="imu_link") == {}
    of_rover = mounted(*(replace(each, parent="rover") for each in TRANSFORMS))
    with McapSource().open(write_sample(tmp_path / "rover.mcap", of_rover)) as opened:
        assert opened.notes()["mount"].endswith("; set 'base_frame' of the source to the rover's frame ('rover')")
    bare = mounted(TRANSFORMS[0].inverse().after(TRANSFORMS[1]))
    with McapSource(base_frame="rover").open(write_sample(tmp_path / "bare.mcap", bare)) as opened:
        assert opened.refused == {}  # the log has no better one
        assert "no transform joins 'rover' and the camera" in opened.notes()["mount"]


@pytest.mark.parametrize(("problems", "resting"), [("base_link", "imu_link"), ("left_optical", "base_link")])
def test_a_pose_in_a_frame_of_the_rover_is_refused(tmp_path, problems, resting):
    edit = changed("/odom", {"header.frame_id": resting, "child_frame_id": problems})
    log = write_sample(tmp_path / "log.mcap", edit)
    assert f"a pose in the frame '{resting}', which moves with the rover" in missing_in(log)["odometry"]


def test_poses_in_a_frame_without_a_name_are_in_odom_and_noted(sample, tmp_path):
    log = write_sample(tmp_path / "log.mcap", changed("/odom", {"header.frame_id": ""}))
    with McapSource().open(log) as opened:
        assert {item.frame_id for _, _, item in opened.events(["odometry"])} == {"odom"}
        assert opened.notes()["odometry"] == "the frame_id of /odom is empty; its poses are read as in 'odom'"
    with McapSource().open(sample) as opened:
        assert "odometry" not in opened.notes()


@pytest.mark.parametrize(("apart", "sigma", "noted"), [(0.5, 0.0, True), (0.0, 0.3, False), (0.05, 0.0, False)])
def test_two_publishers_of_the_pose_that_contradict_each_other_are_noted(tmp_path, apart, sigma, noted):
    images = write_sample(tmp_path / "images.mcap", dropped("/odom"))
    shifts = np.random.default_rng(0).normal(0, sigma, (60, 3)) + [[0, apart * (at % 2), 0] for at in range(60)]
    stamps = [START + at * 7_000_000 for at in range(60)]
    poses = [
        Pose(stamp, shift + np.array([0.005 * at, 0, 0]), [0, 0, 0, 1], "odom", "base_link")
        for at, (stamp, shift) in enumerate(zip(stamps, shifts, strict=True))
    ]
    rows = [(pose.stamp, "/odom", odometry(pose)) for pose in poses]
    with McapSource().open([images, write_messages(tmp_path / "poses.mcap", rows)]) as log:
        note = log.notes().get("odometry", "")
    assert ("alternate between places 0.50 m apart, as of two publishers" in note) == noted
    assert bool(note) == noted


def test_frames_without_names_are_not_connected(tmp_path):
    edits = dropped("/tf_static"), changed("", {"header.frame_id": ""})
    assert TransformTree().between("", "") is None
    with McapSource().open(write_sample(tmp_path / "log.mcap", *edits)) as log:
        assert log.resolution.mount is None
        assert "joins the camera (whose frame_id is empty) and the inclinometer (whose frame_id" in log.missing["mount"]


NAMED = f"the frame_id of {INFOS[0]} is '{{}}', that of its images is '{{}}'"


@pytest.mark.parametrize("by_images", [True, False])
def test_of_two_frames_of_a_camera_the_one_in_the_tree_is_used(sample, tmp_path, by_images):
    info, images = ("unlinked", "left_optical") if by_images else ("left_optical", "unlinked")
    frames = [changed(INFOS[0], {"header.frame_id": info}), changed(LEFT, {"header.frame_id": images})]
    path = write_sample(tmp_path / "log.mcap", *frames)
    assert essences(items_of(path)) == essences(items_of(sample))
    used = "which is used, because no static transform has 'unlinked'"
    with McapSource().open(path) as log:
        assert log.notes() == ({"left": f"{NAMED.format(info, images)}, {used}"} if by_images else {})


@pytest.mark.parametrize("turn", [0, 90])
def test_two_frames_of_a_camera_at_different_places_are_a_warning(sample, tmp_path, turn):
    body = Transform("left_optical", "left_body", Rotation.from_euler("x", turn, degrees=True).as_matrix(), np.zeros(3))
    edits = mounted(*TRANSFORMS, body), changed(LEFT, {"header.frame_id": "left_body"})
    path = write_sample(tmp_path / "log.mcap", *edits)
    assert essences(items_of(path)) == essences(items_of(sample))
    used = "the transforms of 'left_optical' are used; record one frame in both"
    finding = Finding(f"{NAMED.format('left_optical', 'left_body')}; {used}", Severity.WARNING)
    with McapSource().open(path) as log:
        assert log.faults() == ({"left": finding} if turn else {})


def test_a_right_calibration_in_the_left_frame_is_no_conflict(tmp_path):
    right = Transform("left_optical", "right_optical", np.eye(3), [BASELINE, 0, 0])
    edits = mounted(*TRANSFORMS, right), changed(INFOS[1], {"header.frame_id": "left_optical"})
    with McapSource().open(write_sample(tmp_path / "log.mcap", *edits)) as log:
        assert (log.missing, log.notes(), log.faults()) == ({}, {}, {})


@pytest.mark.parametrize(("baseline", "base", "sound"), [
    (BASELINE, True, True), (BASELINE / 1000, True, False), (BASELINE * 1000, True, False), (0.0017, True, False),
    (0.0019, True, True), (BASELINE / 1000, False, False), (BASELINE, False, True),
])  # fmt: skip
def test_a_baseline_out_of_proportion_to_the_height_is_a_fault(tmp_path, baseline, base, sound):
    by_p = changed("right/camera_info", {"p": lambda p: np.where(np.arange(12) == 3, -20 * baseline, p)})
    unmounted = mounted(Transform("left_optical", "imu_link", np.eye(3), np.zeros(3)))
    path = write_sample(tmp_path / "log.mcap", by_p, *([] if base else [unmounted]))
    with McapSource().open(path) as log:
        found = log.faults().get("right")
        noted = log.notes().get("right", "")
    assert (found is None, noted == "") == (sound, sound)
    if found is not None:
        assert (found.severity, found.about, found.sentence) == (Severity.FAULT, "cameras", noted)
        height = "0.9 m, so" if base else "1 m, as assumed, so"
        assert f"the baseline of {baseline:.3g} m is out of proportion to the camera's height of {height} all " in noted


def test_a_calibration_without_a_frame_has_that_of_its_images(tmp_path):
    edit = changed("camera_info", {"header.frame_id": ""})
    with McapSource().open(write_sample(tmp_path / "log.mcap", edit)) as log:
        assert log.missing == {}
        assert [camera.frame_id for camera in log.resolution.cameras or ()] == ["left_optical", "right_optical"]


@pytest.mark.parametrize(("more", "sentence"), [
    (Transform("mast", "imu_link", np.eye(3), [0, 0, 1]), "'imu_link' has two parents, 'base_link' and 'mast'"),
    (Transform("base_link", "imu_link", turned("z", 90), [0, 0, 0.4011]), "one by 0.1 cm and 0.0 degrees; the"),
    (Transform("base_link", "imu_link", turned("z", 90), [0, 0, 0.7]), "an earlier one by 30 cm and 0.0 degrees; the"),
    (Transform("base_link", "imu_link", turned("z", 90.06), [0, 0, 0.4]), "one by 0.0 cm and 0.06 degrees; the"),
    (Transform("imu_link", "base_link", np.eye(3), [0, 0, 0]), "contradicts an earlier one"),
    (Transform("left_optical", "imu_link", np.eye(3), [0, 0, 0]), "contradicts an earlier one"),
    (Transform("imu_link", "imu_link", np.eye(3), [0, 0, 1]), "contradicts an earlier one"),
    (Transform("", "imu_link", np.eye(3), [0, 0, 1]), "lacks the name of a frame"),
])  # fmt: skip
def test_an_invalid_transform_is_reported_and_left_out(tmp_path, more, sentence):
    with McapSource().open(write_sample(tmp_path / "log.mcap", mounted(*TRANSFORMS, more))) as log:
        assert log.missing == {}
        assert log.resolution.mount is not None
        np.testing.assert_allclose(
            log.resolution.mount.camera_from_inclinometer, TRANSFORMS[0].rotation.T @ TRANSFORMS[1].rotation, atol=1e-12
        )
        ((_, stream, problem),) = losses_in(log.events())
    assert stream == "log"
    assert sentence in problem


def test_an_infinite_translation_is_reported_and_left_out(tmp_path):
    def broken(message):
        message.transforms[0].transform.translation.x = np.nan
        return message

    with McapSource().open(write_sample(tmp_path / "log.mcap", replaced("/tf_static", broken))) as log:
        assert "no static transform joins the camera" in log.missing["mount"]
        ((_, _, problem),) = losses_in(log.events())
    what = "the translation of the transform 'base_link' <- 'left_optical'"
    assert problem == f"/tf_static: {what} is [nan, 0.1, 0.9], which is not a position"


def test_the_mount_that_is_offered_is_that_of_a_camera_that_looks_ahead(tmp_path):
    with McapSource().open(write_sample(tmp_path / "log.mcap", dropped("/tf_static"))) as log:
        (remedy,) = log.resolution.remedies["mount"]
    offered = Rotation.from_quat(remedy.settings["camera_from_inclinometer"])
    np.testing.assert_allclose(offered.apply(np.eye(3)), BODY_FROM_OPTICAL, atol=1e-12)


def test_a_long_chain_of_transforms_is_followed():
    frames = TransformTree()
    links = [Transform(f"link{i}", f"link{i + 1}", np.eye(3), np.array([0.1, 0.0, 0.0])) for i in range(1200)]
    for _ in range(3):
        for link in links:
            frames.add(transform_message([(link, 0)]).transforms[0])
    whole = frames.between("link0", "link1200")
    assert (whole.parent, whole.child) == ("link0", "link1200")
    np.testing.assert_allclose(whole.translation, [120.0, 0.0, 0.0], atol=1e-6)
    assert frames.between("link1200", "link0").translation[0] == pytest.approx(-120.0)
    for unjoined in (("link0", "elsewhere"), ("elsewhere", "link0"), ("base_link", "link0")):
        assert frames.between(*unjoined) is None


@pytest.mark.parametrize("again", [
    (*TRANSFORMS, TRANSFORMS[0].inverse()),
    (Transform("base_link", "imu_link", turned("z", 90), [0, 0, 0.4009]),),
    (Transform("base_link", "imu_link", turned("z", 90.04), [0, 0, 0.4]),),
], ids=["the same", "0.9 mm", "0.04 degrees"])  # fmt: skip
def test_a_repeated_transform_is_no_contradiction(tmp_path, again):
    edit = mounted(*TRANSFORMS, *again)
    with McapSource().open(write_sample(tmp_path / "log.mcap", edit)) as log:
        assert not [item for _, _, item in log.events() if isinstance(item, Exception)]
        assert log.resolution.static.listed() == ["base_link <- imu_link", "base_link <- left_optical"]


def test_cameras_at_the_same_place_are_named(tmp_path):
    single = changed("right/camera_info", {"p": model().p.ravel()})
    edit = mounted(*TRANSFORMS, replace(TRANSFORMS[0], child="right_optical"))
    why = missing_in(write_sample(tmp_path / "log.mcap", edit, single))["left"]
    assert why.startswith("the baseline is 0 m: P[0,3] of the right CameraInfo is 0, and 'left")
