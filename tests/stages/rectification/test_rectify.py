"""Rectification: an image distorted by a camera model comes back straight, for every model; rows end up aligned."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.data import CameraModel, StereoCamera, StereoFrame
from stages.rectification.rectify import Rectify, _columns_implied, _rectifying_maps
from stages.rectification.row_offset import _as_bright, measure, offset_field
from tests.conftest import slow

SIZE = WIDTH, HEIGHT = 320, 240
K = np.array([[260.0, 0, 158], [0, 262.0, 121], [0, 0, 1]])
P_LEFT = np.array([[240.0, 0, 160, 0], [0, 240.0, 120, 0], [0, 0, 1, 0]])
P_RIGHT = P_LEFT + np.array([[0, 0, 0, -24.0], [0] * 4, [0] * 4])
DISTORTIONS = {
    "plumb_bob": [-0.2, 0.05, 0.001, -0.002, 0.0],
    "rational_polynomial": [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0],
    "equidistant": [-0.03, 0.01, -0.002, 0.001],
}


def scene(x, y):
    """A smooth pattern over the rectified image plane, gray levels."""
    return 128 + 60 * np.sin(x / 9) * np.cos(y / 11) + 40 * np.sin((x + 2 * y) / 23)


SCENE = scene(*np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)))
BLACK = np.zeros((HEIGHT, WIDTH), np.uint8)
SMALL = StereoCamera(240, 240, 160, 120, 0.1, WIDTH, HEIGHT)


def model_with(name, turn, projection):
    rotation = cv2.Rodrigues(np.array(turn))[0]
    return CameraModel(WIDTH, HEIGHT, K, np.array(DISTORTIONS[name]), rotation, projection, name)


def models(k=K):
    """Models of a pair without distortion."""
    return [CameraModel(WIDTH, HEIGHT, k, np.zeros(5), np.eye(3), projection) for projection in (P_LEFT, P_RIGHT)]


def camera_of(left, right, rectified=False):
    return StereoCamera.from_models(left, right, "cam", rectified)


def raw_image(model, rows_up=0.0):
    """What the camera sees of the scene: every raw pixel undistorted by OpenCV's iterative solver, then looked up."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=2).reshape(-1, 1, 2).astype(np.float64)
    undistort = cv2.fisheye.undistortPoints if model.model == "equidistant" else cv2.undistortPoints
    x, y = undistort(pixels, model.k, model.d, R=model.r, P=model.p).reshape(HEIGHT, WIDTH, 2).transpose(2, 0, 1)
    return np.round(scene(x, y + rows_up)).astype(np.uint8)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_a_distorted_scene_comes_back_straight(name):
    pair = model_with(name, [0.01, -0.02, 0.015], P_LEFT), model_with(name, [-0.01, 0.02, -0.01], P_RIGHT)
    rectified = Rectify()(StereoFrame(7, *map(raw_image, pair), camera_of(*pair)))
    inside = np.s_[40:-40, 50:-50]
    assert np.abs(rectified.left - SCENE)[inside].max() < 2.5
    assert np.abs(rectified.right - SCENE)[inside].max() < 2.5
    assert rectified.camera.raw is None
    assert (rectified.camera.fx, rectified.camera.baseline, rectified.stamp) == (240, pytest.approx(0.1), 7)


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_row_offset_moves_the_right_image_down(rectified, dtype):
    left, right = models(k=P_LEFT[:, :3])
    camera = camera_of(left, right, rectified)
    frame = StereoFrame(1, np.round(SCENE).astype(dtype), raw_image(right, rows_up=0.6).astype(dtype), camera)
    moved = Rectify(row_offset=0.6)(frame)
    assert moved.right.dtype == dtype
    assert np.abs(moved.right.astype(float) - SCENE)[5:-5, 5:-5].max() < 2
    assert np.abs(frame.right.astype(float) - SCENE).max() > 4
    assert np.array_equal(moved.left, frame.left)


@pytest.mark.parametrize("row_offset", [0.0, None])
def test_a_rectified_frame_passes_through_untouched(row_offset):
    left, right = a_pair(size=SIZE)
    frame = StereoFrame(1, left, right, SMALL)
    out = Rectify(row_offset=row_offset)(frame)
    assert np.shares_memory(out.left, left)
    assert np.array_equal(out.right, right)


def test_maps_are_made_once_for_equal_calibrations():
    before = _rectifying_maps.cache_info().misses
    for _ in range(2):
        left, right = model_with("plumb_bob", [0.03, 0, 0], P_LEFT), model_with("plumb_bob", [0, 0.03, 0], P_RIGHT)
        Rectify(row_offset=0)(StereoFrame(1, BLACK, BLACK, camera_of(left, right)))
    assert _rectifying_maps.cache_info().misses - before == 2


@pytest.mark.parametrize(("entry", "message"), [
    ({"model": "pinhole"}, "unknown distortion model 'pinhole'"),
    ({"model": "equidistant"}, "has 4 distortion"),
    ({"d": np.zeros(6)}, "has 0 or 4 or 5 or 8 or 12 or 14"),
    ({"k": np.zeros((3, 3))}, "no focal length in K"),
    ({"r": np.zeros((3, 3))}, "R of the calibration is not a rotation"),
    ({"r": np.diag([1.0, 1, 0.5])}, "R of the calibration is not a rotation"),
])  # fmt: skip
def test_a_calibration_that_cannot_be_used_is_named(entry, message):
    left, right = models()
    with pytest.raises(ValueError, match=message):
        Rectify()(StereoFrame(1, BLACK, BLACK, camera_of(left, replace(right, **entry))))


@pytest.mark.parametrize(("place", "name"), [((0, 0), "fx"), ((1, 1), "fy"), ((1, 2), "cy")])
def test_projections_of_no_rectified_pair_make_no_camera(place, name):
    (left, right), other = models(), P_RIGHT.copy()
    other[place] *= 1.05
    with pytest.raises(ValueError, match=f"not those of a rectified pair: {name} is"):
        camera_of(left, replace(right, p=other))


LARGE = (640, 480)


def a_pair(terms=(), seed=0, size=LARGE):
    """A textured plane at varying distance, its right image displaced downwards by the offset with these terms."""
    width, height = size
    noise = np.random.default_rng(seed).uniform(0, 255, (height + 80, width + 80)).astype(np.float32)
    texture = np.clip((cv2.GaussianBlur(noise, (0, 0), 1.5) - 127) * 4 + 127, 0, 255)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    left = texture[40:-40, 40:-40]
    right = cv2.remap(texture, x + 40 + 5 + 20 * y / height, y + 40 + offset_field(terms, *size), cv2.INTER_CUBIC)
    return left.astype(np.uint8), np.round(right).astype(np.uint8)


TURNED = (0.8, -0.3, 0.6, 0.9, -1.1)
CAMERA = StereoCamera(500, 500, 320, 240, 0.1, *LARGE)


def off(terms, truth=TURNED):
    """Error of a measured offset (H, W), px."""
    return offset_field(terms, *LARGE) - offset_field(truth, *LARGE)


def large_models(cx_right=320.0):
    k = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    projections = np.c_[k, [0, 0, 0]], np.c_[k, [-100.0, 0, 0]]
    projections[1][0, 2] = cx_right
    return [CameraModel(*LARGE, k, np.zeros(5), np.eye(3), projection) for projection in projections]


@pytest.mark.parametrize("terms", [(1.3,), (-0.7, 0.5, 0.8), TURNED])
def test_the_row_offset_is_within_0_1_px_everywhere_in_the_image(terms):
    measured = measure([a_pair(terms)])
    assert measured.clear
    assert np.abs(off(measured.terms, terms)).max() < min(0.1, 3 * measured.error)
    assert np.sqrt(np.mean(np.square(off(measured.terms, terms)))) < 0.04
    assert measured.features > 500


@pytest.mark.parametrize("rows", [20.4, -45.0])
def test_a_large_offset_is_measured_as_well(rows):
    measured = measure([a_pair((rows,))])
    assert np.abs(off(measured.terms, (rows,))).max() < 0.15
    assert measured.features > 500
    assert measured.clear


@pytest.mark.parametrize(("gain", "bias"), [(0.6, 0), (1.0, -40), (0.5, 60)])
def test_the_cameras_may_differ_in_exposure(gain, bias):
    left, right = a_pair(TURNED)
    measured = measure([(left, cv2.convertScaleAbs(right, alpha=gain, beta=bias))])
    assert np.abs(off(measured.terms)).max() < 0.2


def test_what_is_too_dark_for_the_exposure_of_the_other_camera_is_black():
    flat, model = np.array([[40, 50, 60, 150, 160]], np.uint8), np.array([[10, 20, 30, 40, 250]], np.uint8)
    assert np.diff(_as_bright(flat, model).astype(int)).min() >= 0


@pytest.mark.parametrize("pairs", [5, *slow(20)])
def test_aligned_images_with_little_texture_are_left_alone(pairs):
    corrected = 0
    for seed in range(pairs):
        shown, noise = np.full((2, 480, 640), 90.0), np.random.default_rng(seed).normal(0, 2, (2, 480, 640))
        part = np.s_[:, 100:280, 80 + 10 * seed : 260 + 10 * seed]
        shown[part] = np.stack(a_pair(seed=seed))[part]
        offset = measure([tuple((shown + noise).clip(0, 255).astype(np.uint8))])
        corrected += offset is not None and offset.clear
    assert corrected <= pairs // 20


def test_features_in_a_corner_give_an_honest_error_that_repeated_views_do_not_reduce():
    pair = a_pair((1.0,))
    for image in pair:
        image[150:], image[:, 200:] = 90, 90
    once, often = measure([pair]), measure([pair] * 9)
    assert len(once.terms) < 5
    assert np.abs(off(once.terms, (1.0,))).max() < 2 * once.error
    assert often.error == pytest.approx(once.error, rel=0.1)
    assert len(often.terms) == len(once.terms)


def test_the_measured_offset_is_the_same_on_any_number_of_threads():
    pair, threads = a_pair(TURNED), cv2.getNumThreads()
    try:
        found = [cv2.setNumThreads(number) or measure([pair]) for number in (1, 2, 4)]
    finally:
        cv2.setNumThreads(threads)
    assert found[0] == found[1] == found[2]


def test_the_measured_offset_does_not_follow_outliers():
    left, right = a_pair(TURNED)
    right[300:420, 200:500] = np.roll(right, 4, axis=0)[300:420, 200:500]  # something that moved between the exposures
    assert np.abs(off(measure([(left, right)]).terms)).max() < 0.1


OTHERS = a_pair(seed=1, size=SIZE)[0], a_pair(seed=2, size=SIZE)[1]


@pytest.mark.parametrize("pair", [(BLACK, BLACK), OTHERS], ids=["blank images", "images of different scenes"])
def test_without_evidence_there_is_no_offset(pair):
    assert measure([pair]) is None
    frame = StereoFrame(1, *pair, SMALL)
    assert np.array_equal(Rectify()(frame).right, pair[1])
    stage, found = Rectify().survey([frame])
    assert (stage.row_offset, "not clear" in found.sentence, found.severity) == (0.0, True, "note")


@pytest.mark.parametrize("rectified", [True, False])
def test_a_survey_measures_what_its_frames_have_in_common(rectified):
    camera = camera_of(*large_models(), rectified=rectified)
    frames = [StereoFrame(stamp, *a_pair(TURNED, stamp), camera) for stamp in range(3)]
    stage, found = Rectify().survey(frames)
    assert np.abs(off(stage.row_offset)).max() < 0.1
    assert "of 3 frames" in found.sentence
    assert found.severity == "note"
    assert (Rectify().surveys, stage.surveys) == (True, False)
    aligned = stage(frames[0])
    assert measure([(aligned.left, aligned.right)]).largest < 0.1
    # A frame on its own gets its own estimate, which differs only by its error.
    alone = Rectify()(frames[0])
    assert np.abs(alone.right[9:-9, 9:-9].astype(int) - aligned.right[9:-9, 9:-9]).max() <= 12


SWAPPED = "100% of the features that both images show look farther than infinity: left and right are swapped"


@pytest.mark.parametrize(("terms", "columns"), [
    ((3.0,), 0.0), ((0.0, 2.0), 0.75), ((0.0, 0.0, -4.8), 3.2), ((0.0, 0.0, 0.0, 4.0), 500**2 / (640 * 120)),
    ((0.0, 0.0, 0.0, 1.0), 500**2 / (640 * 480)), ((0.0, 0.0, 0.0, 0.0, 2.0), 0.0),
])  # fmt: skip
def test_rows_of_a_turned_camera_or_another_focal_length_come_with_columns(terms, columns):
    """A focal length that is wrong by 1 % moves the first row by 2.4 px and the first column by 3.2 px."""
    assert _columns_implied(CAMERA, terms) == pytest.approx(columns)
    _, found = Rectify().survey([StereoFrame(1, *a_pair(terms), CAMERA)])
    assert (found.severity == "warning") == ("also moves columns by up to 3" in found.sentence) == (columns > 3)


@pytest.mark.parametrize("rows", [0.0, 20.0])
def test_a_survey_finds_swapped_images(rows):
    left, right = a_pair((rows,))
    _, found = Rectify().survey([StereoFrame(1, right, left, CAMERA)])
    assert SWAPPED in found.sentence
    assert "at the centre" not in found.sentence
    assert "set 'left_info' and 'right_info' to the topics that they have now" in found.sentence
    assert (found.severity, found.about) == ("fault", "cameras")
    _, shifted = Rectify().survey([StereoFrame(1, right, left, replace(CAMERA, cx_right=380))])
    assert "swapped" not in shifted.sentence


def test_a_survey_finds_unrectified_images():
    _, found = Rectify().survey([StereoFrame(1, *a_pair((20.0,)), CAMERA)])
    assert "so much is unusual: are the images rectified" in found.sentence
    assert "at the centre" in found.sentence
    assert not re.search("swapped|left_info", found.sentence)
    assert (found.severity, found.about) == ("warning", "")


@pytest.mark.parametrize("row_offset", [None, 0.0])
def test_a_pair_with_negative_disparities_is_shifted_above_zero(row_offset):
    left, right = a_pair((0.0,))
    moved = np.roll(right, 60, axis=1)
    shifted = StereoFrame(1, left, moved, replace(CAMERA, cx_right=380.0))
    alone = Rectify(row_offset=row_offset)(shifted)
    stage, found = Rectify(row_offset=row_offset).survey([shifted])
    assert (stage.columns, found.severity) == (60, "note")
    assert "the right image is moved to the left by 60 px" in found.sentence
    for frame in (alone, stage(shifted)):
        assert frame.camera.cx_right == frame.camera.cx == CAMERA.cx
        assert np.array_equal(frame.right[:, :-60], right[:, :-60])
        assert not frame.right[:, -60:].any()
    # Near scenes may be taken by such a camera as well, and lose nothing.
    near, _ = Rectify(row_offset=row_offset).survey([StereoFrame(1, left, right, shifted.camera)])
    assert near.columns == 0


@pytest.mark.parametrize(("changes", "words"), [
    ({"cx": 120.0, "cx_right": 320.0}, "cx of 120 px lies in the outer fifth of 640x480 images: check that"),
    ({"cy": 400.0}, "cy of 400 px lies in the outer fifth of 640x480 images: check that"),
    ({"baseline": 12.0}, "the baseline is 12 m: check that it is given in metres; "),
    ({"baseline": 0.0008}, "the baseline is 0.0008 m: check that it is given in metres; "),
])  # fmt: skip
def test_an_implausible_calibration_is_a_warning(changes, words):
    frame = StereoFrame(1, *a_pair((1.0,)), CAMERA)
    plain, sound = Rectify().survey([frame])
    stage, found = Rectify().survey([replace(frame, camera=replace(CAMERA, **changes))])
    assert found.sentence.startswith(words)
    assert (sound.severity, found.severity) == ("note", "warning")
    assert stage == plain


def test_shifted_columns_of_a_raw_image_keep_all_its_pixels():
    image = np.random.default_rng(0).integers(0, 256, (LARGE[1], LARGE[0], 3), np.uint8)
    # The rectified image begins 60 columns before the raw one.
    raw = StereoFrame(1, image, image, camera_of(*large_models(cx_right=380.0)))
    moved = Rectify(row_offset=0.0, columns=60)(raw)
    assert moved.camera.cx_right == 320
    assert np.array_equal(moved.right, image)


def test_frames_that_cannot_be_rectified_are_no_part_of_the_survey():
    frame = StereoFrame(1, *a_pair((1.0,)), CAMERA)
    bad = CameraModel(*LARGE, K, np.zeros(5), np.eye(3), P_LEFT, "pinhole")
    broken = StereoFrame(2, frame.left, frame.right, replace(frame.camera, raw=(bad, bad)))
    stage, found = Rectify().survey([broken, frame])
    assert stage.row_offset[0] == pytest.approx(1.0, abs=0.1)
    assert "of 1 frame)" in found.sentence


def test_the_terms_that_a_survey_prints_are_a_valid_setting():
    assert Rectify(row_offset=[0.5, 0.1]) == Rectify(row_offset=(0.5, 0.1))


@pytest.mark.parametrize("row_offset", [(), (1, 2, 3, 4, 5, 6), 65.0, (0.5, float("nan")), "0.5", True])
def test_an_invalid_row_offset_is_refused(row_offset):
    with pytest.raises(ValueError, match=r"Rectify\.row_offset must be"):
        Rectify(row_offset=row_offset)
