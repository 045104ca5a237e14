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

from recordings.mcap.file import iter_decoded
from tests.conftest import SMALL, roverflow


def test_evo_reads_the_poses_of_a_result(result, tmp_path):
    assert roverflow("export", result, tmp_path / "maps") == 0
    trajectory = read_tum_trajectory_file(str(tmp_path / "maps" / "poses.tum"))
    poses = [(stamp, message.pose.pose) for _, stamp, message in iter_decoded(result, ["/nav/pose"])]
    np.testing.assert_allclose(trajectory.timestamps, [stamp / 1e9 for stamp, _ in poses], atol=1e-6)
    places = [(pose.position.x, pose.position.y, pose.position.z) for _, pose in poses]
    np.testing.assert_allclose(trajectory.positions_xyz, places, atol=1e-6)
    turns = [(pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z) for _, pose in poses]
    np.testing.assert_allclose(trajectory.orientations_quat_wxyz, turns, atol=1e-6)


def test_evo_agrees_with_score_on_the_pose_error(traverse, tmp_path):
    out = tmp_path / "out.mcap"
    assert roverflow("run", traverse, *SMALL, "-o", out, "--no-rrd", "--with-inputs") == 0
    assert roverflow("score", out, "--json", tmp_path / "score.json") == 0
    with Reader(out) as log:
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


def heading(trajectory):
    """Of the first pose, rad."""
    ahead = trajectory.poses_se3[0][:2, 0]
    return np.arctan2(ahead[1], ahead[0])
