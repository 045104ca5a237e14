"""A camera on a mast or a pan-tilt head: its mount is that of the time of each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Severity, counted
from recordings import McapSource
from recordings.ros2.cdr import make
from recordings.ros2.to_msg import header, imu, odometry, transform_message
from stages.data import CameraImage, Mount, Pose, Transform
from tests.conftest import mcap_rows, write_mcap, write_messages
from tests.recordings.sample_log import START, TRANSFORMS, missing_in, refused_in, stereo_rows

MS = 1_000_000
FRAMES, PERIOD, JOINT = 6, 500 * MS, 40 * MS
ON_MAST = Transform("mast", "left_optical", TRANSFORMS[0].rotation, [0.1, 0.0, 0.0])
IMU = TRANSFORMS[1]
HELD = Transform("base_link", "mast", np.eye(3), [0.0, 0.0, 1.0])


def pan(stamp: int) -> Transform:
    """base_link <- mast: it turns by 20 degrees a second, and rises."""
    seconds = (stamp - START) / 1e9
    turn = Rotation.from_euler("z", 20 * seconds, degrees=True).as_matrix()
    return Transform("base_link", "mast", turn, [0.3, 0.0, 1.0 + 0.01 * seconds])


Messages = Callable[[int], dict[str, Any] | None]


def joints(stamp: int) -> dict[str, Any] | None:
    """The transforms at a time: of the mast and of the rover, as tf has them."""
    rover = Transform("odom", "base_link", np.eye(3), np.zeros(3))
    return {"/tf": transform_message([(rover, stamp), (pan(stamp), stamp)])}


def written(
    path: Path, messages: Messages = joints, static: tuple[Transform, ...] = (ON_MAST, IMU), *,
    late: int = 30 * MS, base: str = "base_link",
) -> Path:  # fmt: skip
    """A log with frames between the messages of the mast, which are logged late, ns. base: frame of the poses."""
    logged = [(START, "/tf_static", transform_message([(transform, START) for transform in static]))]
    end = START + FRAMES * PERIOD
    for stamp in range(START, end, JOINT):
        found = messages(stamp) or {}
        for topic, made in found.items():
            logged += [(stamp + late, topic, message) for message in (made if isinstance(made, list) else [made])]
    for number in range(FRAMES):
        stamp = START + number * PERIOD + 61 * MS
        logged.append((stamp, "/imu/data", imu(stamp, "imu_link", np.array([0, 0, 0, 1.0]))))
        logged.append((stamp, "/odom", odometry(Pose(stamp, [0, 0, 0], [0, 0, 0, 1], "odom", base))))
        logged += stereo_rows(stamp, number)
    return write_messages(path, logged)


Read = tuple[list[Mount], list[str], dict[str, str]]


def read(path: Path, source: McapSource | None = None, **bounds: float) -> Read:
    """The mounts before the left images, the losses, and the notes."""
    with (source or McapSource()).open(path, **bounds) as log:
        assert log.missing == log.refused == {}
        events = list(log.events())
        notes = log.notes()
    mounts, last = [], None
    for _, stream, item in events:
        last = item if stream == "mount" else last
        if stream == "left" and isinstance(item, CameraImage):
            assert isinstance(last, Mount)
            mounts.append(last)
            assert last.stamp in (item.stamp, 0)
    return mounts, [str(item) for _, _, item in events if isinstance(item, Exception)], notes


def test_the_mount_is_interpolated_at_the_time_of_each_frame(tmp_path):
    mounts, lost, notes = read(written(tmp_path / "log.mcap"))
    assert (len(mounts), lost) == (FRAMES, [])
    for mount in mounts:
        exact = pan(mount.stamp).after(ON_MAST)
        np.testing.assert_allclose(mount.base_from_camera.rotation, exact.rotation, atol=1e-9)
        np.testing.assert_allclose(mount.base_from_camera.translation, exact.translation, atol=1e-9)
        np.testing.assert_allclose(mount.camera_from_inclinometer, exact.rotation.T @ IMU.rotation, atol=1e-9)
    assert notes["mount"] == (
        "the camera moves on the rover: 'base_link' <- 'mast' on /tf is interpolated for each frame"
    )
    later = read(tmp_path / "log.mcap", start=1.5)[0]
    assert [mount.stamp for mount in later] == [mount.stamp for mount in mounts[3:]]
    np.testing.assert_array_equal(later[0].camera_from_inclinometer, mounts[3].camera_from_inclinometer)


def test_the_topic_of_the_mast_may_be_that_of_the_pose(tmp_path):
    path = written(tmp_path / "log.mcap")
    mounts, lost, _ = read(path, McapSource(odometry="/tf"))
    assert (len(mounts), lost) == (FRAMES, [])
    with McapSource(odometry="/tf").open(path) as log:
        poses = [item for _, stream, item in log.events() if stream == "odometry"]
    assert [pose.stamp for pose in poses] == [*range(START, START + FRAMES * PERIOD, JOINT)]


def test_a_frame_without_the_transform_of_its_time_is_lost(tmp_path):
    def broken(stamp):
        return None if START + 900 * MS < stamp < START + 2300 * MS else joints(stamp)

    mounts, lost, _ = read(path := written(tmp_path / "log.mcap", broken))
    assert len(mounts) == FRAMES - 3
    assert len(lost) == 3
    assert all("the transform 'base_link' <- 'mast' moves, and" in sentence for sentence in lost)
    with McapSource().open(path) as log:
        assert not log.faults()
        assert len(list(log.events())) > FRAMES
        found = log.faults()["mount"]
    assert found.severity is Severity.WARNING
    assert found.sentence.endswith(
        "; 'base_link' <- 'mast' has a gap: 3 frames from +1.1 s to +2.1 s lack it, and their images are lost"
    )


def test_a_mast_that_stands_still_may_be_logged_rarely(tmp_path):
    def rarely(stamp):
        return {"/tf": transform_message([(pan(START), stamp)])} if (stamp - START) % (10 * JOINT) == 0 else None

    mounts, lost, _ = read(written(tmp_path / "log.mcap", rarely))
    assert lost == []
    assert len({mount.camera_from_inclinometer.tobytes() for mount in mounts}) == 1


def test_static_transforms_are_preferred_and_the_pose_of_the_rover_is_no_mount(tmp_path):
    fixed = written(tmp_path / "fixed.mcap", static=(ON_MAST, IMU, HELD))
    mounts, lost, notes = read(fixed)
    assert ({mount.stamp for mount in mounts}, "mount" in notes) == ({0}, False)
    (sentence,) = lost
    assert sentence.startswith("/tf: the transform 'base_link' <- 'mast' contradicts an earlier one by 30 cm and ")

    def by_a_world(stamp):
        camera = Transform("odom", "left_optical", ON_MAST.rotation, np.zeros(3))
        rover = Transform("odom", "base_link", np.eye(3), np.zeros(3))
        return {"/tf": transform_message([(rover, stamp), (camera, stamp)])}

    world = missing_in(written(tmp_path / "world.mcap", by_a_world, (IMU,)))["mount"]
    assert "record /tf_static (and /tf if the camera moves on the rover" in world


def test_a_fixed_rotation_of_a_camera_that_moves_is_refused(tmp_path):
    fixed = refused_in(written(tmp_path / "log.mcap"), camera_from_inclinometer=(0.0, 0.0, 0.0, 1.0))
    assert "is a fixed rotation, but the camera moves on the rover" in fixed["camera_from_inclinometer"]


def test_the_mast_may_be_found_late(tmp_path):
    """Behind hundreds of messages of the rover's pose, as of a driver that starts later."""

    def late(stamp):
        rover = Transform("odom", "base_link", np.eye(3), np.zeros(3))
        poses = [transform_message([(rover, stamp)])] * 20
        return {"/tf": poses if stamp < START + PERIOD else [*poses, transform_message([(pan(stamp), stamp)])]}

    mounts, lost, _ = read(written(tmp_path / "log.mcap", late))
    assert (len(mounts), len(lost)) == (FRAMES - 1, 1)


def test_a_mast_may_be_logged_once_a_second_and_half_a_second_late(tmp_path):
    def seldom(stamp):
        return joints(stamp) if (stamp - START) % (25 * JOINT) == 0 else None

    mounts, lost, _ = read(written(tmp_path / "log.mcap", seldom, late=470 * MS))
    assert (len(mounts), len(lost)) == (FRAMES - 2, 2)  # none follows the last two
    assert mounts[1].base_from_camera.translation[2] == pytest.approx(1.00561)


@pytest.mark.parametrize(("late", "ahead", "why"), [
    (1800 * MS, 0, "is logged too late: "), (30 * MS, 0, "has a gap: "),
    (30 * MS, -10**15, "has stamps of another clock, 999997.1 s off those of the images; record both with one clock: "),
])  # fmt: skip
def test_the_cause_of_lost_frames_of_a_moving_camera_is_named(tmp_path, late, ahead, why):
    def shown(stamp):
        cut = not ahead and late < PERIOD and stamp > START + 2 * PERIOD
        return {} if cut else {"/tf": transform_message([(pan(stamp), stamp + ahead)])}

    with McapSource().open(written(tmp_path / "log.mcap", shown, late=late)) as log:
        lost = [str(item) for _, _, item in log.events() if isinstance(item, Exception)]
        assert lost
        assert f"'base_link' <- 'mast' {why}{counted(len(lost), 'frame')} from " in log.faults()["mount"].sentence


def test_the_suggested_base_frame_is_that_of_the_poses(tmp_path):
    """The frames between the camera and the joint that moves are none of the rover's."""

    def renamed(stamp):
        mast = pan(stamp)
        return {"/tf": transform_message([(Transform("body", "mast", mast.rotation, mast.translation), stamp)])}

    imu_on_mast = Transform("mast", "imu_link", np.eye(3), np.zeros(3))
    log = written(tmp_path / "log.mcap", renamed, (ON_MAST, imu_on_mast), base="body")
    with McapSource().open(log) as opened:
        assert "set 'base_frame' of the source to the rover's frame ('body')" in opened.notes()["mount"]
    assert len(read(log, McapSource(base_frame="body"))[0]) == FRAMES
    assert refused_in(log, base_frame="mast")["base_frame"] == (
        "the source's 'base_frame' is set to 'mast', but this frame moves on 'body', whose poses /odom contains; set "
        "it to 'body'"
    )
    assert "transforms join the camera to 'body' only" in refused_in(log, base_frame="bodi")["base_frame"]


def test_a_frame_of_the_rover_that_moves_may_be_the_base_if_it_is_not_on_the_mast(tmp_path):
    """A footprint above the frame of the poses; a body beside it in a fixed frame."""

    def with_footprint(stamp):
        rolled = Transform("base_footprint", "base_link", pan(stamp).rotation, [0.0, 0.0, 0.1])
        rover = Transform("odom", "base_footprint", np.eye(3), np.zeros(3))
        return {"/tf": transform_message([(rover, stamp), (rolled, stamp)])}

    def of_two_bodies(stamp):
        bodies = [Transform("odom", name, pan(stamp).rotation, np.ones(3)) for name in ("base_link", "chassis")]
        return {"/tf": transform_message([(body, stamp) for body in bodies])}

    on_chassis = tuple(replace(each, parent="chassis") for each in TRANSFORMS)
    for messages, static, base in (
        (with_footprint, TRANSFORMS, "base_footprint"), (of_two_bodies, on_chassis, "chassis"),
    ):  # fmt: skip
        log = written(tmp_path / f"{base}.mcap", messages, static)
        assert refused_in(log, base_frame=base) == {}


def test_a_long_log_has_no_other_clock(tmp_path, monkeypatch):
    """Although the first samples are forgotten by its end."""
    monkeypatch.setattr("recordings.source.moving_mount.MAX_SAMPLES", 45)
    monkeypatch.setattr("recordings.source.moving_mount.MAX_CLOCK_NS", PERIOD)
    late = written(tmp_path / "log.mcap", lambda stamp: {} if stamp < START + 100 * MS else joints(stamp))
    with McapSource().open(late) as log:
        assert sum(isinstance(item, Exception) for _, _, item in log.events()) == 1
        assert (
            "'base_link' <- 'mast' has a gap: 1 frame at +0.1 s lacks it, and its images are lost"
            in log.faults()["mount"].sentence
        )


def test_a_topic_with_the_name_of_transforms_alone_is_ignored(tmp_path):
    text = make("std_msgs/msg/String", data="no transform")
    log = written(tmp_path / "log.mcap", lambda stamp: {"/tf": text}, TRANSFORMS)
    rows = [
        (topic, encoding, ("tf2_msgs/msg/TFMessage", *kind[1:]) if topic == "/tf" else kind, time, data)
        for topic, encoding, kind, time, data in mcap_rows(log)
    ]
    assert missing_in(write_mcap(tmp_path / "renamed.mcap", rows)) == {}


MAST = """
pan: {parent: base_link, child: mast, xyz: [0.3, 0, 1.0], axis: [0, 0, 1]}
other: {parent: base_link, child: arm}
"""


def angles(stamp: int) -> dict[str, Any]:
    turn = np.radians(20) * (stamp - START) / 1e9
    fields = {"velocity": np.zeros(0), "effort": np.zeros(0)}
    names, positions = ["wheel", "pan"], np.array([7.0, turn])
    state = make("sensor_msgs/msg/JointState", header=header(stamp, ""), name=names, position=positions, **fields)
    return {"/joints": state}


def test_the_angles_of_joints_move_the_camera(tmp_path):
    path, file = written(tmp_path / "log.mcap", angles), tmp_path / "mast.yaml"
    file.write_text(MAST)
    mounts, lost, notes = read(path, McapSource(joints=str(file)))
    assert (len(mounts), lost) == (FRAMES, [])
    for mount in mounts:
        exact = pan(mount.stamp).after(ON_MAST)
        np.testing.assert_allclose(mount.base_from_camera.rotation, exact.rotation, atol=1e-9)
        np.testing.assert_allclose(mount.base_from_camera.translation[:2], exact.translation[:2], atol=1e-9)
    assert "'base_link' <- 'mast' on /joints is interpolated" in notes["mount"]
    assert "set 'joints'" in missing_in(path)["mount"]


@pytest.mark.parametrize(("content", "sentence"), [
    ("", "is not a mapping; write lines of NAME: VALUE"),
    ("{}", "has no joints; write one entry each"),
    (f"pan: {{parent: a, child: b, xyz: [1, 2, {'9' * 400}]}}", "'xyz' of"),
    ("pan: [1, 2]", "joint 'pan' is not a mapping"),
    ("pan: {parent: a, child: b, angle: 3}", "joint 'pan' has the unknown key 'angle'"),
    ("pan: {parent: a}", "joint 'pan' needs the name of its frame 'child'"),
    ("pan: {parent: a, child: b, xyz: [1, 2, x]}", "joint 'pan' is not 3 numbers"),
    ("pan: {parent: a, child: b, axis: [0, 0, 0]}", "joint 'pan' has the axis 0"),
    ("pan: {parent: a, child", "cannot be read as YAML"),
])  # fmt: skip
def test_a_wrong_file_of_joints_is_refused(tmp_path, content, sentence):
    file = tmp_path / "mast.yaml"
    file.write_text(content)
    log = written(tmp_path / "log.mcap", angles)
    assert sentence in refused_in(log, joints=str(file))["joints"]
    assert "cannot read the file of joints" in refused_in(log, joints=str(tmp_path / "none.yaml"))["joints"]


def test_a_mast_whose_messages_are_all_invalid_is_a_missing_mount(tmp_path):
    def turned(stamp):
        message = transform_message([(pan(stamp), stamp)])
        message.transforms[0].transform.rotation.w = message.transforms[0].transform.rotation.z = 0.0
        return {"/tf": message}

    def unmoved(stamp):
        (message := angles(stamp)["/joints"]).position = np.full(2, np.nan)
        return {"/joints": message}

    (file := tmp_path / "mast.yaml").write_text(MAST)
    for messages, topic, joints_file in ((turned, "/tf", None), (unmoved, "/joints", str(file))):
        path = written(tmp_path / f"{messages.__name__}.mcap", messages)
        with McapSource(joints=joints_file).open(path) as log:
            assert log.missing["mount"].startswith(f"no message of {topic} can be used for the mount of the camera; ")
            assert sum(stream == "left" for _, stream, _ in log.events()) == FRAMES
            assert log.faults() == {}


def test_joints_of_the_source_win_over_a_static_transform(tmp_path):
    (file := tmp_path / "mast.yaml").write_text(MAST)
    mounts, lost, _ = read(written(tmp_path / "log.mcap", angles, (ON_MAST, IMU, HELD)), McapSource(joints=str(file)))
    assert lost == []
    assert [mount.base_from_camera.translation[0] for mount in mounts] == pytest.approx(
        [pan(mount.stamp).after(ON_MAST).translation[0] for mount in mounts]
    )


def test_joints_win_over_the_transforms_of_their_frames(tmp_path):
    """Those on /tf, and a static one by way of a third frame. A joint without a position is none."""
    (file := tmp_path / "mast.yaml").write_text(MAST)
    around = Transform("base_link", "mount", np.eye(3), np.ones(3)), Transform("mount", "mast", np.eye(3), np.ones(3))

    def both(stamp):
        return {**angles(stamp), "/tf": transform_message([(replace(pan(stamp), translation=np.full(3, 9.0)), stamp)])}

    for messages, static in ((both, (ON_MAST, IMU)), (angles, (ON_MAST, IMU, *around))):
        mounts, lost, _ = read(written(tmp_path / "log.mcap", messages, static), McapSource(joints=str(file)))
        assert (len(mounts), lost) == (FRAMES, [])
        assert {float(mount.base_from_camera.translation[2].round(6)) for mount in mounts} == {1.0}

    def unmoved(stamp):
        (message := angles(stamp)["/joints"]).position = np.zeros(0)
        return {"/joints": message}

    still = written(tmp_path / "still.mcap", unmoved, (ON_MAST, IMU, HELD))
    assert "has no angles of joints that join the camera and the rover" in refused_in(still, joints=str(file))["joints"]


def test_joints_that_the_log_has_no_angles_of_are_refused(tmp_path):
    file = tmp_path / "mast.yaml"
    file.write_text("turret: {parent: base_link, child: mast, axis: [0, 0, 1]}")
    log, none = written(tmp_path / "log.mcap", angles), written(tmp_path / "none.mcap", lambda stamp: None)
    fixed = written(tmp_path / "fixed.mcap", angles, (ON_MAST, IMU, HELD))
    for path in (log, none, fixed):
        why = refused_in(path, joints=str(file))["joints"]
        assert why.startswith("the log has no angles of joints that join the camera and the rover by")
