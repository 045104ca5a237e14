"""Poses as a TUM file, read back by evo."""

import json

import numpy as np
import pytest
from evo.core.lie_algebra import se3
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.sync import associate_trajectories
from evo.tools.file_interface import read_bag_trajectory, read_tum_trajectory_file
from rosbags.rosbag2 import Reader
from scipy.spatial.transform import Rotation

from recordings.export.bundle import export
from recordings.mcap.file import iter_decoded
from recordings.mcap.writer import Ros2Writer
from recordings.reporting.page import write_report
from recordings.ros2 import to_msg as ros2
from stages.data import ElevationMap, Pose
from tests.conftest import roverflow, write_messages


def test_evo_reads_the_poses_of_a_result(result, tmp_path):
    assert roverflow("export", result, tmp_path / "maps") == 0
    trajectory = read_tum_trajectory_file(str(tmp_path / "maps" / "poses.tum"))
    poses = [(stamp, message.pose.pose) for _, stamp, message in iter_decoded(result, ["/nav/pose"])]
    np.testing.assert_allclose(trajectory.timestamps, [stamp / 1e9 for stamp, _ in poses], atol=1e-6)
    places = [(pose.position.x, pose.position.y, pose.position.z) for _, pose in poses]
    np.testing.assert_allclose(trajectory.positions_xyz, places, atol=1e-6)
    turns = [(pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z) for _, pose in poses]
    np.testing.assert_allclose(trajectory.orientations_quat_wxyz, turns, atol=1e-6)


def test_evo_agrees_with_score_on_the_pose_error(both, tmp_path):
    assert roverflow("score", both, "--json", tmp_path / "score.json") == 0
    with Reader(both) as log:
        true, given = (read_bag_trajectory(log, topic) for topic in ("/truth/pose", "/nav/pose"))
    true, given = associate_trajectories(true, given)
    # `align_origin` would also turn the first pose's roll and pitch onto the true ones; score turns only its heading.
    headings = [heading(trajectory) for trajectory in (true, given)]
    turn = Rotation.from_euler("z", headings[0] - headings[1]).as_matrix()
    given.transform(se3(turn, true.positions_xyz[0] - turn @ given.positions_xyz[0]))
    ape = APE(PoseRelation.translation_part)
    ape.process_data((true, given))
    scored = json.loads((tmp_path / "score.json").read_text())["pose"]
    assert ape.get_statistic(StatisticsType.max) == pytest.approx(scored["max_error"], rel=1e-6)
    assert scored["max_error"] > 1e-3


def test_poses_in_another_frame_of_reference_are_no_motion(tmp_path):
    path, frames = tmp_path / "out.mcap", ("visual_odom", "visual_odom/2")
    with Ros2Writer(path) as writer:
        writer.metadata("roverflow", {"pipeline": ""})
        for stamp in range(6):
            frame_id, place = frames[stamp // 3], np.array([100.0 * (stamp // 3) + 0.1 * stamp, 0.0, 0.0])
            pose = Pose(stamp, place, np.array([0.0, 0, 0, 1]), frame_id, "base_link", None)
            writer.write("/nav/pose", ros2.odometry(pose), stamp)
            terrain = ElevationMap(stamp, {"elevation": np.zeros((3, 3), np.float32)}, 0.1, (0.0, 0.0), frame_id)
            writer.write("/nav/regional_map", ros2.grid_map(terrain), stamp)
    export(path, tmp_path)
    for folder, stamps in (("visual_odom", [0, 1, 2]), ("visual_odom-2", [3, 4, 5])):
        trajectory = read_tum_trajectory_file(str(tmp_path / folder / "poses.tum"))
        np.testing.assert_allclose(trajectory.timestamps, 1e-9 * np.array(stamps))
        assert trajectory.path_length == pytest.approx(0.2)
    write_report(tmp_path / "out.html", [path])
    page = (tmp_path / "out.html").read_text()
    assert [page.count(f"trajectory in {frame_id}, ") for frame_id in frames] == [1, 1]


def test_poses_keep_their_stamps_and_a_tenth_of_a_millimetre_in_utm(tmp_path):
    """In a result that was recorded again while it was played, log times are later."""
    place, turn = np.array([691_234.56789, 9_333_333.12345, -12.34567]), np.array([1.23456789e-3, 0, 0, 1.0])
    turn /= np.linalg.norm(turn)
    stamp = 1_700_000_000_123_456_789
    terrain = ElevationMap(stamp, {"elevation": np.zeros((3, 3), np.float32)}, 0.1, (0.0, 0.0), "utm")
    messages = {
        "/nav/pose": ros2.odometry(Pose(stamp, place, turn, "utm", "base_link", None)),
        "/nav/regional_map": ros2.grid_map(terrain),
    }
    export(write_messages(tmp_path / "out.mcap", [(stamp + 10**9, *each) for each in messages.items()]), tmp_path)
    seconds, *numbers = (tmp_path / "poses.tum").read_text().split()
    assert seconds == "1700000000.123456789"
    np.testing.assert_allclose([float(number) for number in numbers[:3]], place, rtol=0, atol=5e-5)
    np.testing.assert_allclose([float(number) for number in numbers[3:]], turn, rtol=1e-9)


def heading(trajectory):
    """Of the first pose, rad."""
    ahead = trajectory.poses_se3[0][:2, 0]
    return np.arctan2(ahead[1], ahead[0])
