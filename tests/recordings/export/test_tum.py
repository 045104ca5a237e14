"""Poses as a TUM file, read back by evo."""

import numpy as np
from evo.tools.file_interface import read_tum_trajectory_file

from recordings.mcap.file import iter_decoded
from tests.conftest import roverflow


def test_evo_reads_the_poses_of_a_result(result, tmp_path):
    assert roverflow("export", result, tmp_path / "maps") == 0
    trajectory = read_tum_trajectory_file(str(tmp_path / "maps" / "poses.tum"))
    poses = [(stamp, message.pose.pose) for _, stamp, message in iter_decoded(result, ["/nav/pose"])]
    np.testing.assert_allclose(trajectory.timestamps, [stamp / 1e9 for stamp, _ in poses], atol=1e-6)
    places = [(pose.position.x, pose.position.y, pose.position.z) for _, pose in poses]
    np.testing.assert_allclose(trajectory.positions_xyz, places, atol=1e-6)
    turns = [(pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z) for _, pose in poses]
    np.testing.assert_allclose(trajectory.orientations_quat_wxyz, turns, atol=1e-6)
