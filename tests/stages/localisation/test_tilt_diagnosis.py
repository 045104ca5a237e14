"""Each fault of a tilt is named at any noise; a sound tilt has no fault, and too little motion is reported."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.data import Array
from stages.localisation.tilt.causes import Cause, Evidence
from stages.localisation.tilt.diagnosis import _same, diagnose
from tests.conftest import slow
from tests.stages.localisation.drive import Drive, misread
from tests.tilt_faults import degrees_as_radians, exchanged, flipped, radians_as_degrees

DRIVES = [
    Drive(1, 4.0, 0.3),
    *slow(Drive(2, 8.0, 0.1), Drive(1, 4.0, 0.1), Drive(2, 8.0, 0.3), Drive(3, 5.0, 0.3), Drive(3, 5.0, 0.1)),
]  # fmt: skip


def about(axis: str, degrees: float) -> Array:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize(
    ("change", "name"),
    [
        (flipped(0), "the sign of pitch is flipped"),
        (flipped(1), "the sign of roll is flipped"),
        (lambda up: up * [-1, -1, 1], "the signs of pitch and roll are flipped"),
        (flipped(2), "the sign of up is flipped"),
        (exchanged, "pitch and roll are exchanged"),
        (lambda up: np.array([up[1], -up[0], up[2]]), "pitch and roll are exchanged and the sign of"),
        (degrees_as_radians, "degrees are taken for radians"),
        (radians_as_degrees, "radians are taken for degrees"),
    ],
)
def test_wrong_signs_axes_and_units_are_named(drive, change, name):
    found = diagnose(drive.evidence(change=change))
    assert found.fault.startswith(name), found.sentence
    assert " or " not in found.fault, "a rotation of the mount that is the same fault is not named too"


def test_a_wrong_unit_is_named_on_nearly_level_ground_not_always_seen():
    evidence = Drive(7, slope=0.3, noise=0.1).evidence(change=degrees_as_radians)
    assert diagnose(evidence).fault == "degrees are taken for radians"
    evidence.ground[::5] = np.nan
    assert diagnose(evidence).fault == "degrees are taken for radians"


@pytest.mark.parametrize(("slope", "yaw"), [(8, 30), (12, 20), (15, 17), (19, 15), (0, 40)])
def test_a_rover_that_turns_on_a_slope_has_no_fault(slope, yaw):
    """Up rotates around the normal of the ground."""
    frames, lean = 20, Rotation.from_euler("x", slope, degrees=True)
    cameras = [lean * Rotation.from_euler("z", yaw * i, degrees=True) for i in range(frames)]  # z off the ground
    turns = np.array([(cameras[0].inv() * camera).as_matrix() for camera in cameras])
    ups = np.array([camera.as_matrix()[2] for camera in cameras])
    ground = np.tile([0.0, 0.0, 1.0], (frames, 1))
    stamps, drift = np.arange(frames) * 500_000_000, np.full(frames, 1e-12)
    found = diagnose(Evidence(stamps, np.ones(frames, int), turns, drift, ups, np.eye(3), ground))
    assert found.fault == "", found.sentence


@pytest.mark.parametrize(
    ("signs", "fault", "remedy"),
    [
        ([-1, -1, -1], "up and down are exchanged", "at rest an accelerometer reads +9.8"),
        ([1, -1, -1], "the signs of roll and up are flipped", "Rotate the inclinometer's frame by 180 degrees about x"),
        ([-1, 1, -1], "the signs of pitch and up are flipped", "by 180 degrees about y in /tf_static"),
    ],
)
def test_a_tilt_that_is_upside_down_is_named_with_the_frame_to_correct(signs, fault, remedy):
    found = diagnose(DRIVES[0].evidence(change=lambda up: up * signs))
    assert found.fault == f"{fault}: by the tilt the rover is upside down", found.sentence
    assert remedy in found.sentence
    assert "source." not in found.sentence


INVERSE, W_FIRST = ([0, 1, 2, 3], [-1, -1, -1, 1]), ([3, 0, 1, 2], [1, 1, 1, 1])


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("heading", [0.0, 0.7, 2.0])
@pytest.mark.parametrize(("read", "fault"), [
    (INVERSE, "the quaternions are inverse, from the world to the inclinometer's frame"),
    (W_FIRST, "the quaternions have w first"),
])  # fmt: skip
def test_quaternions_of_another_convention_are_named_at_any_heading(drive, heading, read, fault):
    found = diagnose(misread(drive, *read, heading))
    assert found.fault == fault, found.sentence
    assert "source." not in found.sentence


@pytest.mark.parametrize("order", [[0, 2, 1, 3], [1, 0, 2, 3]])
def test_a_large_rotation_that_leaves_more_than_noise_is_no_wrong_mount(order):
    found = diagnose(misread(DRIVES[0], order, [1, 1, 1, 1], 0.7))
    assert found.fault == "inconsistent", found.sentence
    assert "no remedy is known" in found.sentence
    assert "source." not in found.sentence


@pytest.mark.parametrize("change", [flipped(0), exchanged, radians_as_degrees])
def test_the_remedy_of_an_estimated_tilt_is_its_gyroscope(change):
    found = diagnose(replace(DRIVES[0].evidence(change=change), estimated=True))
    assert "Check the axes, the signs and the unit (rad/s) of the gyroscope" in found.sentence
    assert "source." not in found.sentence


@pytest.mark.parametrize(("signs", "remedy"), [
    ([-1, -1, -1], "'accelerations' of the source, with their field and sign -1, negates them"),
    ([1, -1, -1], "Rotate the inclinometer's frame by 180 degrees about x"),
    ([1, 1, -1], "z of its frame must point up"),
])  # fmt: skip
def test_the_remedy_of_an_estimated_tilt_that_is_upside_down_is_not_its_gyroscope(signs, remedy):
    found = diagnose(replace(DRIVES[0].evidence(change=lambda up: up * signs), estimated=True))
    assert "by the tilt the rover is upside down" in found.fault
    assert remedy in found.sentence
    assert "gyroscope" not in found.sentence


def test_the_ground_separates_up_from_down_and_the_sentence_names_it():
    found = diagnose(DRIVES[0].evidence(change=lambda up: -up))
    ground = r"Without this fault the ground in view is \d\.\d+ degrees off level on average, with it overhead \("
    assert re.search(ground, found.sentence), found.sentence
    assert "agree to" not in found.sentence


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("turned", [about("x", 5), about("y", -5), about("z", 5), about("z", -5), about("x", 90)])
def test_a_wrong_mount_is_named_with_its_correction(drive, turned):
    found = diagnose(drive.evidence(turned=turned))
    assert found.fault.startswith("the mount of the inclinometer is wrong by"), found.sentence
    numbers = re.search(r"camera_from_inclinometer to \[(.*)\]", found.sentence)
    assert numbers is not None
    mended = Rotation.from_quat([float(number) for number in numbers[1].split(",")])
    assert np.degrees((mended.inv() * Rotation.from_matrix(drive.mount)).magnitude()) < 2.5


@pytest.mark.parametrize("drive", DRIVES)
def test_a_camera_that_hangs_upside_down_is_a_wrong_mount(drive):
    found = diagnose(drive.evidence(turned=drive.mount.T @ about("z", 180) @ drive.mount))
    assert re.match(r"the mount of the inclinometer is wrong by 1(79\..|80\.0) degrees", found.fault), found.sentence


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("late", [0.2, -0.2, 1.7, -2.5])
def test_a_time_offset_is_named_with_its_size(drive, late):
    found = diagnose(drive.evidence(late=late))
    size = re.fullmatch(r"the tilt's stamps are (\d+) ms (late|early)", found.fault)
    assert size is not None, found.sentence
    assert size[2] == ("late" if late > 0 else "early")
    assert abs(int(size[1]) - 1000 * abs(late)) < 50
    assert f"Set source.time_offset.inclinometer to {'-' if late > 0 else ''}{size[1]} ms" in found.sentence


@pytest.mark.parametrize(("seed", "slope", "frames"), [(1, 2.0, 20), (2, 2.0, 50), (3, 4.0, 20)])
def test_a_tilt_that_does_not_follow_the_rover_is_not_early_or_late(seed, slope, frames):
    """A delay of seconds leaves half of the difference to a tilt that is level whatever the rover does."""
    found = diagnose(Drive(seed, slope).evidence(frames, change=lambda up: np.array([0.0, 0.0, 1.0])))
    assert found.fault == "inconsistent", found.sentence
    assert "source.time_offset" not in found.sentence


@pytest.mark.parametrize("late", [0.2, 0.1, -0.2])
def test_few_frames_name_a_time_offset_beside_a_wrong_mount(late):
    found = diagnose(Drive(3, 5.0, 0.1).evidence(frames=8, late=late))
    assert re.match(r"the mount .* is wrong by .* degrees or its stamps are late or early$", found.fault)
    assert "Check the clocks first" in found.sentence


@settings(max_examples=15, deadline=None)
@example(seed=31, slope=2.0, noise=0.03, frames=22, odometry=0.05)  # more drift than noise
@given(
    seed=st.integers(10, 49), slope=st.sampled_from([2.0, 4.0, 8.0]), noise=st.sampled_from([0.03, 0.1, 0.3, 0.6]),
    frames=st.integers(3, 50), odometry=st.sampled_from([0.0, 0.01, 0.05]),
)  # fmt: skip
def test_a_sound_tilt_has_no_fault(seed, slope, noise, frames, odometry):
    assert diagnose(Drive(seed, slope, noise, odometry).evidence(frames)).fault == ""


def test_a_sound_tilt_on_rolling_ground_is_reported_as_sound():
    found = diagnose(Drive(2, 8.0).evidence())
    assert found.clear
    assert found.sentence.startswith("Tilt and camera agree to 0.")


@pytest.mark.parametrize(("gap", "clear"), [(1.4, True), (1.6, False)])
def test_frames_far_apart_in_time_do_not_rule_out_a_time_offset(gap, clear):
    evidence = Drive(2, 8.0, 0.1).evidence()
    found = diagnose(replace(evidence, stamps=np.arange(len(evidence.stamps)) * round(gap * 1e9)))
    assert found.clear == clear
    assert ("whether the tilt's stamps are early or late" in found.sentence) != clear


@pytest.mark.parametrize(("apart", "same"), [(11, True), (13, False), (180, False)])
def test_rotations_within_12_degrees_are_one_fault(apart, same):
    one, other = (Cause("", "", 0.0, 0.0, undone=about("x", angle)) for angle in (20, 20 + apart))
    assert _same(one, other) == same
    assert not _same(one, replace(other, undone=None))


def still(drive: Drive, frames: int) -> Evidence:
    """The first frame repeated, with noise."""
    moving = drive.evidence(frames)
    noise = np.random.default_rng(0).normal(0, 0.003, (frames, 3))
    ups = moving.ups[0] + noise
    return replace(
        moving, cameras=np.repeat(np.eye(3)[None], frames, axis=0), ground=np.repeat(moving.ground[:1], frames, axis=0),
        ups=ups / np.linalg.norm(ups, axis=1)[:, None],
    )  # fmt: skip


def test_without_motion_the_diagnosis_is_not_clear():
    found = diagnose(still(Drive(1), 50))
    assert (found.fault, found.clear) == ("", False)
    little = "The rover moved too little in 50 frames to decide whether axes are exchanged or flipped"
    assert found.sentence.startswith(little)
    assert not diagnose(Drive(1).evidence(4)).clear


def test_without_motion_the_ground_shows_the_sign_of_up():
    evidence = still(Drive(1), 20)
    upside_down = diagnose(replace(evidence, ups=-evidence.ups))
    assert "up" in upside_down.fault, upside_down
    aside = diagnose(replace(evidence, ups=evidence.ups @ about("x", 90).T))
    assert aside.fault == "up is off the ground" or "mount" in aside.fault, aside


def test_a_fault_is_found_across_lost_tracking():
    drive = Drive(2, 8.0)
    for change, fault in ((None, ""), (flipped(0), "the sign of pitch is flipped")):
        whole = drive.evidence(change=change)
        cameras = whole.cameras.copy()
        cameras[25:] = cameras[25].T @ cameras[25:]
        drift = np.concatenate([whole.drift[:25], whole.drift[25:] - whole.drift[25]])
        found = diagnose(replace(whole, cameras=cameras, drift=drift, segments=np.repeat([1, 2], 25)))
        assert found.fault == fault, found.sentence


def test_a_random_walk_of_the_tilt_is_inconsistent():
    drive = Drive(2, 4.0)
    walk = np.cumsum(np.random.default_rng(1).normal(0, 0.03, (50, 3)), axis=0)
    ups = drive.ups() + walk
    found = diagnose(replace(drive.evidence(), ups=ups / np.linalg.norm(ups, axis=1)[:, None]))
    assert found.fault == "inconsistent"
    assert "no single fault of the inclinometer explains it" in found.sentence
    assert "the convention of its quaternions, if it has any" in found.sentence
