"""VisualOdometry follows the true camera and reports lost tracking; it never invents a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.simulator import Simulation
from recordings.simulator.ground_truth import true_disparity
from stages import CameraMotion, Disparity, StereoCamera, StereoFrame, Transform, VisualOdometry
from stages.localisation.visual_odometry import MIN_FEATURES
from stages.localisation.vo_tracking import vo_frame
from tests.stages.running import Running

FRAMES = 5
Input = tuple[StereoFrame, Disparity]


@pytest.fixture(scope="module")
def drive() -> tuple[list[Input], list[Transform]]:
    """Frames of a drive with their true disparities, and where the camera truly was (world <- camera)."""
    simulation = Simulation(scene="gravel", frames=FRAMES, width=320, height=240, relief_cells=512, seed=5)
    inputs, cameras = [], []
    for index in range(FRAMES):
        truth, stamp = simulation.frame(index), simulation.stamp(index)
        disparity = replace(true_disparity(simulation, stamp, truth), camera=simulation.camera)
        inputs.append((StereoFrame(stamp, *truth.images, simulation.camera), disparity))
        cameras.append(truth.base.after(simulation.mounts[0]))
    return inputs, cameras


def camera_of(motion: CameraMotion) -> Transform:
    assert motion.camera is not None
    return motion.camera


def blank(given: Input) -> Input:
    """The frame as a lens cap shows it."""
    frame, disparity = given
    return replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.right)), disparity


def test_the_drift_is_below_a_hundredth_of_the_distance(drive):
    inputs, cameras = drive
    odometry = Running(VisualOdometry())
    motions = [odometry(*given) for given in inputs]
    true = cameras[0].inverse().after(cameras[-1])
    found = camera_of(motions[-1])
    way = np.linalg.norm(true.translation)
    assert way > 0.85
    assert np.degrees(Rotation.from_matrix(found.rotation.T @ true.rotation).magnitude()) < 0.15
    assert np.linalg.norm(found.translation - true.translation) < 0.01 * way + 0.005
    assert {motion.segment for motion in motions} == {1}
    assert found.child == inputs[0][0].camera.frame_id
    assert odometry.finding() is None


def test_the_covariance_grows_and_covers_the_error(drive):
    inputs, cameras = drive
    odometry = Running(VisualOdometry())
    spreads = []
    for given, camera in zip(inputs, cameras, strict=True):
        motion = odometry(*given)
        spreads.append(np.sqrt(np.diag(motion.covariance)))
        true = cameras[0].inverse().after(camera)
        error = camera_of(motion).translation - true.translation
        assert np.all(np.abs(error) <= 4 * spreads[-1][:3] + 1e-9)
    assert np.all(np.diff(spreads, axis=0) > 0)


def test_a_rover_that_stands_still_does_not_drift(drive):
    inputs, _ = drive
    frame, disparity = inputs[0]
    odometry, rng = Running(VisualOdometry()), np.random.default_rng(0)
    for count in range(8):
        noise = rng.integers(-3, 4, frame.left.shape)
        seen = replace(frame, stamp=frame.stamp + count, left=np.clip(frame.left + noise, 0, 255).astype(np.uint8))
        motion = odometry(seen, disparity)
    assert np.linalg.norm(camera_of(motion).translation) < 0.004
    assert np.degrees(Rotation.from_matrix(camera_of(motion).rotation).magnitude()) < 0.05


def test_lost_tracking_begins_a_segment(drive):
    inputs, _ = drive
    odometry = Running(VisualOdometry())
    odometry(*inputs[0])
    frame, disparity = inputs[1]
    elsewhere = replace(frame, left=frame.left[:, ::-1].copy(), right=frame.right[:, ::-1].copy())
    mirrored = replace(disparity, pixels=disparity.pixels[:, ::-1].copy(), source=disparity.source[:, ::-1].copy())
    motion = odometry(elsewhere, mirrored)
    assert motion.segment == 2
    assert "segment 2 begins" in motion.lost
    np.testing.assert_array_equal(camera_of(motion).translation, 0)
    assert odometry.finding() is None  # PoseFilter reports it, once


def test_images_of_another_size_begin_a_segment(drive):
    inputs, _ = drive
    frame, disparity = inputs[1]
    camera, layers = frame.camera, (disparity.pixels / 2, disparity.source, disparity.confidence)
    half = replace(camera, fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2 - 0.25, cy=camera.cy / 2 - 0.25,
                   cx_right=camera.cx_right / 2 - 0.25, width=camera.width // 2, height=camera.height // 2)  # fmt: skip
    smaller = StereoFrame(frame.stamp, frame.left[::2, ::2], frame.right[::2, ::2], half)
    odometry = Running(VisualOdometry())
    odometry(*inputs[0])
    motion = odometry(smaller, Disparity(frame.stamp, *(layer[::2, ::2].copy() for layer in layers), camera=half))
    size = f"{camera.width}x{camera.height}"
    assert motion.segment == 2
    assert motion.lost == f"the image size changed from {size} to {half.width}x{half.height}; segment 2 begins"
    np.testing.assert_array_equal(camera_of(motion).rotation, np.eye(3))


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (20, 20)])
def test_an_image_smaller_than_a_patch_has_no_features(shape):
    height, width = shape
    image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    camera = StereoCamera(50.0, 50.0, width / 2, height / 2, 0.2, width, height)
    known = [np.ones(shape, kind) for kind in (np.float32, np.uint8, np.float32)]
    motion = Running(VisualOdometry())(StereoFrame(0, image, image, camera), Disparity(0, *known))
    assert motion.lost == "only 0 features have a disparity (minimum 40)"


def test_features_that_agree_only_roughly_are_not_tracked(drive):
    """An image rotated by 180 degrees looks like a roll of the camera, except for its principal point."""
    inputs, _ = drive
    odometry = Running(VisualOdometry())
    odometry(*inputs[0])
    frame, disparity = inputs[1]
    turned = replace(frame, left=frame.left[::-1, ::-1].copy(), right=frame.right[::-1, ::-1].copy())
    assert "segment 2 begins" in odometry(turned, disparity).lost


def test_tracking_continues_after_a_dark_frame(drive):
    inputs, cameras = drive
    odometry = Running(VisualOdometry())
    odometry(*inputs[0])
    blind = odometry(*blank(inputs[1]))
    assert blind.camera is None
    assert "features have a disparity" in blind.lost
    after = odometry(*inputs[2])
    assert after.segment == 1
    true = cameras[0].inverse().after(cameras[2])
    assert np.linalg.norm(camera_of(after).translation - true.translation) < 0.02
    assert odometry.finding().sentence == "Too few features to track in 1 frame."


def test_the_first_segment_begins_at_the_first_usable_frame(drive):
    inputs, cameras = drive
    odometry = Running(VisualOdometry())
    assert odometry(*blank(inputs[0])).camera is None
    first, second = odometry(*inputs[1]), odometry(*inputs[2])
    assert (first.segment, first.lost, second.segment) == (1, "", 1)
    np.testing.assert_array_equal(camera_of(first).rotation, np.eye(3))
    true = cameras[1].inverse().after(cameras[2])
    assert np.linalg.norm(camera_of(second).translation - true.translation) < 0.02


def test_the_first_frame_needs_only_few_features(drive):
    frame, disparity = drive[0][0]
    patch = np.zeros_like(disparity.source)
    patch[180:210, 150:190] = disparity.source[180:210, 150:190]
    few = replace(disparity, source=patch)
    assert 0 < vo_frame(frame, few).known < MIN_FEATURES
    np.testing.assert_array_equal(camera_of(Running(VisualOdometry())(frame, few)).rotation, np.eye(3))


def test_features_with_a_filled_disparity_do_not_count(drive):
    frame, disparity = drive[0][0]
    filled = replace(disparity, source=np.full_like(disparity.source, 3))
    assert Running(VisualOdometry())(frame, filled).lost == "only 0 features have a disparity (minimum 40)"
