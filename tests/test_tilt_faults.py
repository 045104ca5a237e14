"""Every fault of a tilt is named within 50 frames, a sound log has none, and visual poses drift by less than 1 %.

The logs are simulated traverses with an inclinometer noise of 0.3 degrees a sample. Slow: run by `make check-all`.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from flow.cli.main import main
from recordings.ros2.from_msg import stamp_of
from recordings.simulator import Simulation, write_log
from recordings.simulator.traverse import level_pose
from tests.test_command_line import messages_of
from tests.tilt_faults import FAULTS, PIPELINE

SLOPES = {21: 4.0, 22: 6.0, 23: 3.0}  # seed -> RMS slope over 1 m, degrees


@pytest.fixture(scope="module", params=SLOPES)
def simulation(request: pytest.FixtureRequest) -> Simulation:
    rocks = 0.05 if request.param % 2 else 0.15
    return Simulation(
        frames=50, width=320, height=240, seed=request.param, slope=float(np.radians(SLOPES[request.param])),
        abundance=rocks, tilt_noise=float(np.radians(0.3)), map_half_width=1.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def log(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tilt") / "log.mcap"
    write_log(simulation, path)
    return path


def finding_of(log: Path, folder: Path, code: int, *options: str) -> tuple[str, str]:
    """Severity and sentence of the finding about the tilt, of a run that exits with a code."""
    pipeline, summary = folder / "check.yaml", folder / "summary.json"
    pipeline.write_text(PIPELINE)
    arguments = ["-p", pipeline, "-o", folder / "out.mcap", "--no-rrd", "--summary", summary, *options]
    assert main(["run", *map(str, [log, *arguments])]) == code
    findings = json.loads(summary.read_text())["findings"]
    assert "warning" not in {other["severity"] for other in findings.values()}  # such as one that blames the pose
    found = findings["health"]
    return found["severity"], found["sentence"]


@pytest.mark.slow
def test_a_sound_log_has_no_fault(log, tmp_path):
    severity, found = finding_of(log, tmp_path, 0)
    assert severity == "note"
    assert found.startswith(
        ("Tilt and camera agree to 0.", "The rover moved too little in 50 frames to decide whether the mount is wrong")
    )


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(log, tmp_path, fault):
    plant, name = FAULTS[fault]
    severity, found = finding_of(plant(log, tmp_path / "faulty.mcap"), tmp_path, 3)
    assert severity == "fault"
    fault = found.split(". ")[0].lower()
    assert name in fault, found
    assert " or " not in fault, found


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["late", "early"])
def test_the_setting_that_the_check_names_corrects_late_and_early_stamps(log, tmp_path, fault):
    faulty = FAULTS[fault][0](log, tmp_path / "faulty.mcap")
    _, found = finding_of(faulty, tmp_path, 3)
    named = re.search(r"Set (source\.time_offset\.inclinometer) to (-?\d+ ms)", found)
    assert named is not None, found
    severity, _ = finding_of(faulty, tmp_path, 0, "--set", f"{named[1]}={named[2]}")
    assert severity == "note"


@pytest.mark.slow
def test_visual_poses_drift_by_less_than_a_hundredth_of_the_distance(log, simulation, tmp_path):
    finding_of(log, tmp_path, 0)
    start, way, before = level_pose(simulation.base_at(simulation.stamp(0))).inverse(), 0.0, np.zeros(3)
    for pose in messages_of(tmp_path / "out.mcap", "/nav/pose"):
        true = start.after(simulation.base_at(stamp_of(pose.header)))
        way, before = way + float(np.linalg.norm(true.translation - before)), true.translation
        place, turn = pose.pose.pose.position, pose.pose.pose.orientation
        error = np.array([place.x, place.y, place.z]) - true.translation
        x, y, z, w = turn.x, turn.y, turn.z, turn.w
        heading = np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
        off = heading - np.arctan2(true.rotation[1, 0], true.rotation[0, 0])
        assert pose.header.frame_id == "visual_odom"
        assert np.linalg.norm(error) < 0.01 * way + 0.02
        assert abs(np.degrees(np.arctan2(np.sin(off), np.cos(off)))) < 0.1 + 0.1 * way  # the images are small
    assert way > 12
    print(
        f"seed {simulation.seed}: {100 * np.linalg.norm(error) / way:.2f} % of {way:.1f} m, {np.degrees(off):+.2f} deg"
    )
