"""Middlebury scenes become logs with the ground truth of the scene."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from recordings.errors import LogError
from recordings.importers.middlebury import read_middlebury, read_pfm, read_scene
from recordings.importers.recording import FIRST_STAMP, write_recording
from recordings.importers.rig import Rig
from recordings.mcap.file import iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.ros2.to_msg import disparity_image
from recordings.scoring import score as scoring
from stages.data import Disparity, StereoFrame
from tests.conftest import data_folder, write_messages
from tests.recordings.importers import middlebury_scene as scenes
from tests.recordings.importers.middlebury_scene import write_pfm, write_scene
from tests.recordings.sample_log import frame_of


def imported(folder: Path) -> tuple[Path, str]:
    log = folder.with_suffix(".mcap")
    _, (note,) = write_recording(read_middlebury(folder, Rig()), log)
    return log, note


def truth_of(log: Path) -> dict[str, Any]:
    return {topic: message for topic, _, message in iter_decoded(log) if topic.startswith("/truth")}


def result(log: Path, frame: StereoFrame, pixels: np.ndarray) -> Path:
    """A result log with only these disparities."""
    nothing = np.zeros(pixels.shape, np.uint8)
    disparity = Disparity(frame.stamp, pixels, nothing, nothing.astype(np.float32), camera=frame.camera)
    rows = [(frame.stamp, "/nav/disparity", disparity_image(disparity))]
    return write_messages(log.with_name(f"{log.stem}-nav.mcap"), rows)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_pfm_is_read_from_the_bottom_in_either_byte_order(tmp_path, order):
    pixels = np.arange(6, dtype=np.float32).reshape(2, 3) + np.float32(0.25)
    pixels[0, 2], pixels[1, 0] = np.inf, -np.inf
    path = write_pfm(tmp_path / "d.pfm", pixels, order)
    rows = np.frombuffer(path.read_bytes()[-24:], f"{order}f4")
    assert rows[1] == 4.25  # the file begins with the lower row
    expected = np.array([[0.25, 1.25, np.nan], [np.nan, 4.25, 5.25]], np.float32)
    np.testing.assert_array_equal(read_pfm(path), expected)


def test_images_and_camera_of_a_scene_are_in_its_log(tmp_path):
    log, words = imported(write_scene(tmp_path / "Box"))
    assert words.endswith("run it with --set disparities=32")
    frame = frame_of(log)
    for pixels, expected in zip((frame.left, frame.right), scenes.images(), strict=True):
        np.testing.assert_array_equal(pixels, expected)
    camera = frame.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.cx_right) == (100, 100, 40.25, 30, 52.75)
    assert (camera.baseline, camera.width, camera.height, camera.raw) == (0.25, 96, 64, None)


def test_the_truth_is_that_of_the_scene(tmp_path):
    log, words = imported(write_scene(tmp_path / "Box"))
    assert "with true disparities and occlusions" in words
    truth = truth_of(log)
    true = scenes.true_disparity()
    expected = np.where(np.isfinite(true), true + np.float32(scenes.DOFFS), np.nan)
    disparity, mask = truth["/truth/disparity"], truth["/truth/occlusion"]
    np.testing.assert_array_equal(ros2.read_disparity(disparity), expected)
    assert (disparity.min_disparity, disparity.max_disparity) == (0, scenes.NDISP)
    np.testing.assert_array_equal(np.asarray(mask.data).reshape(scenes.HEIGHT, scenes.WIDTH), scenes.occlusion())
    assert set(np.unique(mask.data)) == {0, 128, 255}
    assert ros2.stamp_of(disparity.header) == ros2.stamp_of(mask.header) == frame_of(log).stamp == FIRST_STAMP
    with log.open("rb") as stream:
        about = next(record for record in make_reader(stream).iter_metadata() if record.name == "middlebury")
    assert (about.metadata["scene"], about.metadata["ndisp"]) == ("Box", "21")


def test_either_name_of_the_truth_is_read(tmp_path):
    scene = write_scene(tmp_path / "Vintage")
    (scene / "disp0GT.pfm").rename(scene / "disp0.pfm")
    np.testing.assert_array_equal(np.isfinite(read_scene(scene).truth), np.isfinite(scenes.true_disparity()))


@pytest.mark.parametrize(("without", "topics", "words"), [
    (("disp0GT.pfm",), set(), "without truth (no disp0GT.pfm or disp0.pfm)"),
    (("disp0GT.pfm", "mask0nocc.png"), set(), "without truth"),
    (("mask0nocc.png",), {"/truth/disparity"}, "without occlusions (no mask0nocc.png)"),
])  # fmt: skip
def test_a_scene_without_truth_is_reported(tmp_path, without, topics, words):
    log, sentence = imported(write_scene(tmp_path / "Box", without))
    assert set(truth_of(log)) == topics
    assert words in sentence
    frame = frame_of(log)
    run = result(log, frame, np.full(frame.left.shape[:2], 5, np.float32))
    if topics:
        found = scoring.score(run, log).disparity["whole_image"]
        assert found["all"]["bad_4"] == pytest.approx(900 / (96 * 64 - 28))
        assert found["nonocc"]["pixels"] == 0
    else:
        with pytest.raises(LogError, match="has no ground truth"):
            scoring.score(run, log)


def spoil(name: str, content: bytes):
    return lambda folder: (folder / name).write_bytes(content)


def calibrate(**changes: object):
    return lambda folder: (folder / "calib.txt").write_text(scenes.calibration(**changes))


@pytest.mark.parametrize(("damage", "words"), [
    (lambda folder: (folder / "im1.png").unlink(), r"cannot read .*im1\.png: No such file"),
    (lambda folder: (folder / "calib.txt").unlink(), r"Box has no calib\.txt; give the folder of one scene"),
    (spoil("im0.png", b"no picture"), r"im0\.png is not a readable image"),
    (spoil("calib.txt", b"\xff\xfe\x00"), r"calib\.txt is not a text file"),
    (calibrate(doffs=None), r"calib\.txt lacks 'doffs'"),
    (calibrate(ndisp="many"), r"calib\.txt has an entry that is not a number or matrix .*many"),
    (calibrate(cam0="[1 2]"), r"calib\.txt has an entry that is not a number or matrix"),
    (calibrate(cam0="[-9 0 1; 0 9 1; 0 0 1]"), r"calib\.txt: fx is -9"),
    (calibrate(ndisp="nan"), r"calib\.txt: ndisp is nan"),
    (calibrate(width=48), r"im0\.png is 96x64, but the calibration is for 48x64"),
    (spoil("disp0GT.pfm", b"P6\n3 2\n255\n" + bytes(18)), r"disp0GT\.pfm is not a PFM file of one channel"),
    (spoil("disp0GT.pfm", b"Pf\n3 2\n-1\n" + bytes(23)), r"has 23 bytes of pixels, not 24 for 3x2"),
    (spoil("disp0GT.pfm", b"Pf\n3 2\n1e\n" + bytes(24)), r"its scale 1e is not a number"),
    (spoil("disp0GT.pfm", b"Pf\n3 2\n-1\n" + bytes(24)), r"disp0GT\.pfm is 3x2, but the images are 96x64"),
    (spoil("mask0nocc.png", b""), r"mask0nocc\.png is not a readable image"),
    (lambda folder: cv2.imwrite(str(folder / "mask0nocc.png"), np.full((64, 96), 77, np.uint8)),
     r"mask0nocc\.png has a pixel of 77; an occlusion mask has only 255, 128 and 0"),
    (lambda folder: cv2.imwrite(str(folder / "mask0nocc.png"), np.zeros((32, 48), np.uint8)),
     r"mask0nocc\.png is 48x32, but the images are 96x64"),
])  # fmt: skip
def test_a_damaged_scene_is_refused_and_leaves_no_log(tmp_path, damage, words):
    folder = write_scene(tmp_path / "Box")
    damage(folder)
    with pytest.raises(LogError, match=words) as caught:
        imported(folder)
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["Box"]


def test_real_scenes_score_from_their_logs_as_from_their_files(tmp_path):
    from stages.matching.match import Match
    from tests.bench.stereo_scores import errors, load_scene

    for folder in sorted(data_folder("middlebury-q").iterdir()):
        log = tmp_path / f"{folder.name}.mcap"
        write_recording(read_middlebury(folder, Rig()), log)
        frame, truth, mask, levels = load_scene(folder)
        matched = Match(disparities=levels)(frame_of(log)).pixels
        np.testing.assert_array_equal(matched, Match(disparities=levels)(frame).pixels)
        direct = errors(matched, truth, mask, levels)
        found = scoring.score(result(log, replace(frame, stamp=FIRST_STAMP), matched), log).disparity["cropped_image"]
        bad = [100 * found[region][f"bad_{t}"] for region in ("nonocc", "all") for t in ("0.5", "1", "2")]
        # doffs is added in float32, so an error changes by 1e-5 px and rarely crosses a threshold.
        np.testing.assert_allclose(bad, direct[:6], atol=0.005)
        assert (found["all"]["rmse"], 100 * found["all"]["density"]) == pytest.approx(tuple(direct[6:]), rel=1e-5)
        assert found["leftmost_columns_cropped"] == [levels]
