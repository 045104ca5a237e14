"""VisualOdometry follows the true camera and reports lost tracking; it never invents a motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.simulator import Simulation
from recordings.simulator.ground_truth import true_disparity
from stages import Halve, PixelOrigin, StereoCamera, StereoFrame, Transform, VisualOdometry
from stages.localisation.visual_odometry import OdometryMemory, _Keyframe, _plausible, _tracked
from stages.localisation.vo_tracking import MAX_DEPTH, MIN_FEATURES, Step, VoFrame, _fitted, vo_frame
from tests.stages.builders import disparity_of
from tests.stages.running import Running

SIMULATION = Simulation(scene="gravel", frames=5, width=320, height=240, relief_cells=512, seed=5)


@pytest.fixture(scope="module")
def drive():
    return frames_of(SIMULATION)


def frames_of(simulation):
    """Frames of a drive, each with its true disparity."""
    truths = [(simulation.stamp(index), simulation.frame(index)) for index in range(simulation.frames)]
    return [
        (StereoFrame(stamp, *truth.images, simulation.camera),
         replace(true_disparity(simulation, stamp, truth), camera=simulation.camera))
        for stamp, truth in truths
    ]  # fmt: skip


def true_motion(start, end) -> Transform:
    """Motion of the camera from one frame to another."""
    first, last = (SIMULATION.base_at(SIMULATION.stamp(frame)).after(SIMULATION.mounts[0]) for frame in (start, end))
    return first.inverse().after(last)


def tracked(*given):
    """The stage after these frames, and the motion at each."""
    odometry = Running(VisualOdometry())
    return odometry, [odometry(*each) for each in given]


def blank(given):
    """The frame as a lens cap shows it."""
    frame, disparity = given
    return replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.right)), disparity


def flipped(given, axes):
    """The frame with images mirrored along these axes, and the disparity likewise."""
    frame, disparity = given
    images = {name: np.flip(getattr(frame, name), axes).copy() for name in ("left", "right")}
    layers = {name: np.flip(getattr(disparity, name), axes).copy() for name in ("pixels", "source")}
    return replace(frame, **images), replace(disparity, **layers)


def test_the_drift_is_below_a_hundredth_of_the_distance(drive):
    odometry, motions = tracked(*drive)
    true, found = true_motion(0, 4), motions[-1].camera
    way = np.linalg.norm(true.translation)
    assert way > 0.85
    assert np.degrees(Rotation.from_matrix(found.rotation.T @ true.rotation).magnitude()) < 0.15
    assert np.linalg.norm(found.translation - true.translation) < 0.01 * way + 0.005
    assert {motion.segment for motion in motions} == {1}
    assert found.child == SIMULATION.camera.frame_id
    assert odometry.finding() is None


def test_the_covariance_grows_and_covers_the_error(drive):
    _, motions = tracked(*drive)
    spreads = np.array([np.sqrt(np.diag(motion.covariance)) for motion in motions])
    for frame, motion in enumerate(motions):
        error = motion.camera.translation - true_motion(0, frame).translation
        assert np.all(np.abs(error) <= 4 * spreads[frame, :3] + 1e-9)
    assert np.all(np.diff(spreads, axis=0) > 0)


def test_a_rover_that_stands_still_does_not_drift(drive):
    frame, disparity = drive[0]
    lefts = np.clip(frame.left + np.random.default_rng(0).integers(-3, 4, (8, *frame.left.shape)), 0, 255)
    seen = [replace(frame, stamp=frame.stamp + count, left=left.astype(np.uint8)) for count, left in enumerate(lefts)]
    _, (*_, last) = tracked(*((each, replace(disparity, stamp=each.stamp)) for each in seen))
    assert np.linalg.norm(last.camera.translation) < 0.004
    assert np.degrees(Rotation.from_matrix(last.camera.rotation).magnitude()) < 0.05


def test_lost_tracking_begins_a_segment(drive):
    odometry, (_, motion) = tracked(drive[0], flipped(drive[1], axes=1))
    assert motion.segment == 2
    assert "segment 2 begins" in motion.lost
    np.testing.assert_array_equal(motion.camera.translation, 0)
    assert odometry.finding() is None  # PoseFilter reports it, once


def test_images_of_another_size_begin_a_segment(drive):
    frame, disparity = drive[1]
    smaller = Halve()(frame)
    halved = disparity_of(disparity.pixels[::2, ::2] / 2, stamp=frame.stamp, camera=smaller.camera)
    _, (_, motion) = tracked(drive[0], (smaller, halved))
    assert motion.segment == 2
    assert motion.lost == "the image size changed from 320x240 to 160x120; segment 2 begins"
    np.testing.assert_array_equal(motion.camera.rotation, np.eye(3))


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (20, 20)])
def test_an_image_smaller_than_a_patch_has_no_features(shape):
    image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    camera = StereoCamera(50.0, 50.0, shape[1] / 2, shape[0] / 2, 0.2, *shape[::-1])
    _, (motion,) = tracked((StereoFrame(0, image, image, camera), disparity_of(np.ones(shape))))
    assert motion.lost == "only 0 features have a disparity (minimum 40)"


def test_features_that_agree_only_roughly_are_not_tracked(drive):
    """An image rotated by 180 degrees looks like a roll of the camera, except for its principal point."""
    turned, _ = flipped(drive[1], axes=(0, 1))
    _, (_, motion) = tracked(drive[0], (turned, drive[1][1]))
    assert "segment 2 begins" in motion.lost


@pytest.mark.parametrize("pitch_down", [15, 35])
def test_flat_ground_is_tracked(pitch_down):
    """All points lie on a plane, where a fit by EPnP is ambiguous."""
    flat = replace(SIMULATION, slope=0.0, abundance=0.0, seed=1, frames=6, pitch_down=float(np.radians(pitch_down)))
    _, motions = tracked(*frames_of(flat))
    assert [motion.segment for motion in motions] == [1] * flat.frames
    assert all(motion.lost == "" for motion in motions)


@pytest.mark.parametrize("gain", [0.5, 1.5])
def test_a_step_of_the_exposure_is_tracked(drive, gain):
    def exposed(given):
        frame, disparity = given
        images = {name: np.clip(gain * getattr(frame, name), 0, 255).astype(np.uint8) for name in ("left", "right")}
        return replace(frame, **images), disparity

    _, motions = tracked(*(exposed(given) if number % 2 else given for number, given in enumerate(drive)))
    _, right = tracked(*drive)
    assert [motion.segment for motion in motions] == [1] * len(drive)
    assert math.dist(motions[-1].camera.translation, right[-1].camera.translation) < 0.02


def test_tracking_continues_after_a_dark_frame(drive):
    odometry, (_, blind, after) = tracked(drive[0], blank(drive[1]), drive[2])
    assert blind.camera is None
    assert "features have a disparity" in blind.lost
    assert after.segment == 1
    assert np.linalg.norm(after.camera.translation - true_motion(0, 2).translation) < 0.02
    assert odometry.finding().sentence == "Too few features to track in 1 frame."


def test_the_first_segment_begins_at_the_first_usable_frame(drive):
    _, (blind, first, second) = tracked(blank(drive[0]), drive[1], drive[2])
    assert blind.camera is None
    assert (first.segment, first.lost, second.segment) == (1, "", 1)
    np.testing.assert_array_equal(first.camera.rotation, np.eye(3))
    assert np.linalg.norm(second.camera.translation - true_motion(1, 2).translation) < 0.02


def test_the_first_frame_needs_only_few_features(drive):
    frame, disparity = drive[0]
    patch = np.zeros_like(disparity.source)
    patch[180:210, 150:190] = disparity.source[180:210, 150:190]
    few = replace(disparity, source=patch)
    assert 0 < vo_frame(frame, few).known < MIN_FEATURES
    _, (motion,) = tracked((frame, few))
    np.testing.assert_array_equal(motion.camera.rotation, np.eye(3))


def test_features_with_a_filled_disparity_do_not_count(drive):
    frame, disparity = drive[0]
    _, (motion,) = tracked((frame, disparity_of(disparity.pixels, PixelOrigin.FILLED, stamp=frame.stamp)))
    assert motion.lost == "only 0 features have a disparity (minimum 40)"


def test_points_are_by_the_offset_of_the_principal_points_and_near(drive):
    frame, disparity = drive[0]
    shifted = replace(frame, camera=replace(frame.camera, cx_right=frame.camera.cx + 2.0))
    less = replace(disparity, pixels=disparity.pixels - 2)
    plainly = replace(frame, camera=replace(frame.camera, cx_right=frame.camera.cx))
    plain, moved = vo_frame(plainly, disparity).points, vo_frame(shifted, less).points
    np.testing.assert_allclose(plain, moved, rtol=1e-4)
    assert np.nanmax(vo_frame(plainly, replace(disparity, pixels=disparity.pixels / 8)).points[:, 2]) <= MAX_DEPTH


def test_a_resumed_run_continues_with_the_number_of_the_segment(drive):
    odometry = VisualOdometry()
    assert odometry(*drive[0], state=odometry.resumed(3)).segment == 3


@pytest.mark.parametrize(("rms", "metres", "plausible"), [
    (1.9, 4.9, True), (2.1, 1.0, False), (1.0, 5.1, False),
])  # fmt: skip
def test_a_motion_that_is_long_or_rough_is_not_plausible(rms, metres, plausible):
    step = Step(np.eye(3), np.array([0.0, 0.0, metres]), 100, rms, 1.0, np.eye(6))
    assert _plausible(step) == plausible


def test_a_motion_that_is_not_plausible_is_stated(drive, monkeypatch):
    far = Step(np.eye(3), np.array([0.0, 0.0, 7.5]), 100, 1.2, 1.0, np.eye(6))
    monkeypatch.setattr("stages.localisation.visual_odometry.step_between", lambda before, now: far)
    _, (_, motion) = tracked(*drive[:2])
    assert motion.lost == "the motion found, 7.5 m with errors of 1.2 px, is not plausible; segment 2 begins"


@pytest.mark.parametrize(("flow", "shared", "features", "replaced"), [
    (2.9, 51, 40, False), (3.1, 51, 40, True), (2.9, 49, 40, True), (3.1, 49, 39, False),
])  # fmt: skip
def test_a_frame_far_from_the_keyframe_or_with_few_of_its_features_replaces_it(flow, shared, features, replaced):
    """Its image has a width of 100 px and the keyframe 100 features. A frame with few features does not replace it."""
    camera, gray = StereoCamera(90.0, 90.0, 50.0, 40.0, 0.2, 100, 80), np.zeros((80, 100), np.uint8)
    before, now = (VoFrame(gray, None, None, np.ones((count, 3)), camera) for count in (100, features))
    keyframe = _Keyframe(before, Transform("start", "camera", np.eye(3), np.zeros(3)), np.zeros((6, 6)))
    state = OdometryMemory(keyframe)
    _tracked(7, keyframe, Step(np.eye(3), np.zeros(3), shared, 1.0, flow, np.eye(6)), now, state)
    assert (state.keyframe.frame is now) == replaced


@pytest.mark.parametrize(("same", "found"), [([], True), ([2], True), ([1, 2], False)], ids=["room", "plane", "line"])
def test_points_on_a_line_determine_no_motion(same, found):
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (60, 3))
    points[:, same] = 4.0  # m
    matrix = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    pixels = (points @ matrix.T)[:, :2] / points[:, 2:]
    step = _fitted(points, pixels, pixels, matrix, np.zeros(3), np.zeros(3))
    assert (step is not None) == found
