"""Image files become a rover log with the given camera attitude."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from recordings import McapSource
from recordings.errors import LogError
from recordings.importers import files
from recordings.importers.images import import_images
from recordings.importers.pairing import pair_images
from recordings.source.transforms import BODY_FROM_OPTICAL
from stages.rectification.rectify import Rectify
from stages.rectification.row_offset import measure
from tests.conftest import data_folder, roverflow
from tests.recordings.importers.simulated import EXACT, assert_same, own_log, seen_in, write_images
from tests.recordings.sample_log import frame_of, picture, stamps_in

SIDES = ("left", "right")
CALIBRATION = {"fx": 20.0, "cx": 11.5, "cy": 7.5, "baseline": 0.25}


def save(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)
    return path


def make_pairs(folder: Path, count: int = 3) -> tuple[list[Path], list[Path]]:
    left = [save(folder / f"{number}-left.png", picture(2 * number)) for number in range(count)]
    right = [save(folder / f"{number}-right.png", picture(2 * number + 1)) for number in range(count)]
    return left, right


def imported(folder: Path, pairs: tuple[list[Path], list[Path]], calibration: Any = CALIBRATION, **given: Any) -> Any:
    """What an import of pairs into a log in the folder returns."""
    return import_images(*pairs, calibration, folder / "out.mcap", **{"pitch_down": 0.0, "height": 1.0, **given})


def events(path: Path) -> list[tuple[int, str, Any]]:
    with McapSource().open(path) as log:
        assert set(log.missing) == {"odometry"}
        return list(log.events())


def test_images_are_logged_bit_for_bit_at_the_rate(tmp_path):
    assert imported(tmp_path, make_pairs(tmp_path), pitch_down=15, height=0.9, rate=4) == (3, [])
    read = events(tmp_path / "out.mcap")
    images = {side: [item for _, stream, item in read if stream == side] for side in ("left", "right")}
    for number in range(3):
        np.testing.assert_array_equal(images["left"][number].pixels, picture(2 * number))
        np.testing.assert_array_equal(images["right"][number].pixels, picture(2 * number + 1))
        frame = images["left"][number].pair_with(images["right"][number])
        assert (frame.camera.baseline, frame.camera.raw) == (pytest.approx(0.25), None)
    stamps = [item.stamp for item in images["left"]]
    assert np.diff(stamps).tolist() == [250_000_000] * 2
    tilts = stamps_in(read, "inclinometer")
    for stamp in stamps:
        assert stamp in tilts
        assert min(tilts) < stamp < max(tilts)


@pytest.mark.parametrize(("pitch_down", "roll"), [(0, 0), (14.5, 0), (20, 10), (5, -30)])
def test_the_camera_has_the_given_attitude(tmp_path, pitch_down, roll):
    imported(tmp_path, make_pairs(tmp_path, 1), pitch_down=pitch_down, roll=roll, height=0.88)
    read = events(tmp_path / "out.mcap")
    mount, tilt = (next(item for _, name, item in read if name == stream) for stream in ("mount", "inclinometer"))
    up = mount.camera_from_inclinometer @ tilt.up  # in camera axes: x right, y down, z forward
    assert np.degrees(np.arcsin(up[2])) == pytest.approx(-pitch_down)  # the line of sight is below the horizon
    leaning = np.degrees(np.arctan2(up[0], -up[1]))
    assert leaning == pytest.approx(-roll, abs=1e-9)  # x, to the right, is below for roll > 0
    np.testing.assert_allclose(mount.base_from_camera.translation, [0, 0, 0.88])
    down, forward = np.radians(pitch_down), mount.base_from_camera.rotation @ [0, 0, 1]
    np.testing.assert_allclose(forward, [np.cos(down), 0, -np.sin(down)], atol=1e-12)


@pytest.mark.parametrize(("names", "left"), [
    (["a-left.png", "a-right.png", "b-left.png", "b-right.png"], ["a-left.png", "b-left.png"]),
    (["left/10.png", "left/9.png", "right/10.png", "right/9.png"], ["left/9.png", "left/10.png"]),
    (["im0.png", "im1.png", "mask0nocc.png"], ["im0.png"]),
    (["img_cam0_9m.png", "img_cam1_9m.png"], ["img_cam0_9m.png"]),
    (["L_01.png", "L_02.png", "R_01.png", "R_02.png"], ["L_01.png", "L_02.png"]),
    (["left/L_1.png", "right/R_1.png"], ["left/L_1.png"]),
    (["image_2/0_10.png", "image_2/1_10.png", "image_3/0_10.png", "image_3/1_10.png", "disp_occ_0/0_10.png"],
     ["image_2/0_10.png", "image_2/1_10.png"]),
    (["image_02/1.png", "image_03/1.png"], ["image_02/1.png"]),
    (["cam0/0.png", "cam0/1.png", "cam1/0.png", "cam1/1.png"], ["cam0/0.png", "cam0/1.png"]),
    (["0_cam0.png", "1_cam0.png", "0_cam1.png", "1_cam1.png"], ["0_cam0.png", "1_cam0.png"]),
    (["cam_0/cam0_0.png", "cam_1/cam1_0.png"], ["cam_0/cam0_0.png"]),
])  # fmt: skip
def test_pairs_are_found_by_name_in_order(tmp_path, names, left):
    for name in names:
        save(tmp_path / name, picture(0))
    found = pair_images(tmp_path, [])
    assert [path.relative_to(tmp_path).as_posix() for path in found[0]] == left
    assert len(found[1]) == len(left)
    assert not set(found[0]) & set(found[1])


@pytest.mark.parametrize(("names", "sentence"), [
    (["a-left.png", "a-right.png", "b-right.png", "c.png"], r"b-right\.png, c\.png has no partner"),
    (["a_l.png", "a_r.png", "b_l.png"], r"b_l\.png has no partner"),
    ([], "contains no image pairs, only 0 images"),
    (["0.png", "1.png", "2.png", "3.png"], r"contains no image pairs, only 4 images"),
    (["0/0.png", "0/1.png", "1/0.png", "1/1.png"], r"contains no image pairs, only 4 images"),
    (["left/1.png", "right/1.png", "left_raw/1.png", "right_raw/1.png"], r"several cameras \(left, left_raw\)"),
    (["front_left_1.png", "front_right_1.png", "rear_left_1.png", "rear_right_1.png"],
     r"several cameras \(front_left_1\.png, rear_left_1\.png\); give a folder with those of one"),
    (["left_1.png", "right_1.png", "left_1_rect.png", "right_1_rect.png"], "several cameras"),
    (["front/left_1.png", "front/right_1.png", "rear/left_1.png", "rear/right_1.png"], "several cameras"),
    (["left/data/1.png", "right/data/1.png"], r"only 0 images in it and its folders \(deeper ones are not searched\)"),
    (["left/0.png", "right/0.jpg"], r"as left/0\.png and right/0\.jpg have different endings"),
    (["left_mask.png", "right_mask.png"], "as the names of all 2 images contain mask/disp/.*/gt; rename"),
])  # fmt: skip
def test_no_image_is_left_out_silently(tmp_path, names, sentence):
    for name in names:
        save(tmp_path / name, picture(0))
    with pytest.raises(LogError, match=sentence):
        pair_images(tmp_path, [])


@pytest.mark.parametrize("stems", [
    ["drive_01_%s", "drive_back_01_%s"], ["rock-%s", "gray-rock-%s"], ["%s_A", "%s_a"], ["é_%s", "è_%s"],
    ["site_front_%s", "site_back_%s"], ["pan_10_%s", "10_%s"], ["front_%s_1", "rear_%s_2"], ["%s/2", "%s/color1"],
])  # fmt: skip
def test_names_of_one_camera_may_have_any_words(tmp_path, stems):
    for stem in stems:
        for side in SIDES:
            save(tmp_path / f"{stem % side}.png", picture(0))
    assert len(pair_images(tmp_path, [])[0]) == 2


def test_images_that_are_left_out_or_may_be_of_several_cameras_are_noted(tmp_path):
    for name in ("sand", "mask_sand", "rock", "rock_2"):
        for side in SIDES:
            save(tmp_path / side / f"{name}.png", picture(0))
    left, _ = pair_images(tmp_path, notes := [])
    assert [path.stem for path in left] == ["rock", "rock_2", "sand"]
    assert notes == [
        "2 images left out, as the names contain mask/disp/disparity/depth/truth/gt, first: left/mask_sand.png",
        "all pairs are taken as those of one camera, with 2 kinds of names, such as left/rock.png, left/sand.png",
    ]


def test_hidden_files_and_pipes_are_no_images(tmp_path):
    make_pairs(tmp_path, 1)
    (tmp_path / "._0-left.png").write_bytes(b"of macOS")
    (tmp_path / "left").mkdir()
    os.mkfifo(tmp_path / "left" / "1.png")
    notes: list[str] = []
    assert [[path.name for path in side] for side in pair_images(tmp_path, notes)] == [["0-left.png"], ["0-right.png"]]
    assert notes == []


@pytest.mark.parametrize(("change", "sentence"), [
    ({"baseline": None}, "lacks 'baseline'"),
    ({"focal": 3.0}, "has the unknown 'focal'"),
    ({"fx": "wide"}, r": fx must be a number in px, not 'wide'"),
    ({"fx": 10**400}, r": fx must be a finite number in px"),
    ({"fx": 10**30}, r": fx must be at most 1e\+09 px, not 1e\+30 px"),
    ({"baseline": -0.2}, r": baseline must be at least .* not -20 cm"),
    ({"cx": 24.5}, "the calibration's centre .cx 24.5, cy 7.5. is outside"),
    ({"width": 640}, "is 24x16, but the calibration is for 640x16"),
])  # fmt: skip
def test_a_wrong_calibration_is_refused_and_leaves_no_file(tmp_path, change, sentence):
    calibration = {k: v for k, v in {**CALIBRATION, "height": 16, **change}.items() if v is not None}
    with pytest.raises(LogError, match=sentence):
        imported(tmp_path, make_pairs(tmp_path, 1), calibration)
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(("option", "values", "sentence"), [
    ("pitch_down", (91, np.nan), "are impossible"),
    ("roll", (181,), "are impossible"),
    ("height", (0.0, 1e10, np.inf, np.nan), "height .*must be"),
    ("rate", (0.0, np.inf, np.nan, 1e-12, 1e10), "rate .*must be"),
])  # fmt: skip
def test_an_impossible_attitude_height_or_rate_is_refused(tmp_path, option, values, sentence):
    pairs = make_pairs(tmp_path, 1)
    for value in values:
        with pytest.raises(LogError, match=sentence):
            imported(tmp_path, pairs, **{option: value})
    assert not list(tmp_path.glob("out*"))
    imported(tmp_path, pairs, rate=1e9)


def test_the_calibration_may_be_a_file(tmp_path):
    pairs, file = make_pairs(tmp_path, 1), tmp_path / "camera.yaml"
    file.write_text("fx: 20\nfy: 21.5\ncx: 11\ncy: 7\ncx_right: 13\nbaseline: 0.25\n")
    imported(tmp_path, pairs, file)
    camera = frame_of(tmp_path / "out.mcap").camera
    assert (camera.fy, camera.cx, camera.cx_right) == (21.5, 11.0, 13.0)
    file.write_text("fx: 20\nfy:\ncx: 11\ncy: 7\nwidth:\nheight: null\nbaseline: 0.25\n")  # as if not given
    assert imported(tmp_path, pairs, file) == (1, [])
    file.write_text("fx: [")
    with pytest.raises(LogError, match="cannot be read as YAML"):
        imported(tmp_path, pairs, file)


def test_pairs_that_are_not_rectified_have_the_calibration_of_its_files_and_end_up_row_aligned(tmp_path):
    folder = data_folder("polar")
    files = [folder / "calib" / f"{name}.yml" for name in ("left_intrinsics", "right_intrinsics", "extrinsics")]
    given = "--calibration", *files, "--pitch-down", 35, "--height", 1.35
    assert roverflow("import", "images", folder, tmp_path / "polar.mcap", *given) == 0
    frame = frame_of(tmp_path / "polar.mcap")
    camera = frame.camera
    assert camera.baseline == pytest.approx(0.3996, abs=1e-4)
    assert camera.raw[0].k[0, 0] == pytest.approx(1452.71)
    assert camera.raw[1].d[:2] == pytest.approx([-0.017925, -0.019475])
    assert abs(row_offset(frame)) > 2.0
    assert 1.0 < abs(row_offset(Rectify(row_offset=0)(frame))) < 2.0  # its calibration leaves about 1.6 px
    aligned = Rectify()(frame)
    rest = measure([(aligned.left, aligned.right)])
    assert not rest.clear
    assert rest.largest < 0.5


def row_offset(frame):
    """Median of v_left - v_right over mutual feature matches, px."""
    features = cv2.ORB.create(4000, nlevels=4)
    (points1, codes1), (points2, codes2) = (
        features.detectAndCompute(np.ascontiguousarray(image), None) for image in (frame.left, frame.right)
    )
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(codes1, codes2)
    moves = np.array([np.subtract(points1[p.queryIdx].pt, points2[p.trainIdx].pt) for p in pairs if p.distance < 40])
    likely = moves[(np.abs(moves[:, 1]) < 30) & (moves[:, 0] > 0)]
    return np.median(likely[:, 1])


def camera_info(shift: float) -> dict[str, Any]:
    """A camera_info file; shift: P[0, 3]."""
    k, d = np.array([[20.0, 0, 11.5], [0, 20.0, 7.5], [0, 0, 1.0]]), [0.01, 0.0, 0.0, 0.0, 0.0]
    matrices = {"camera_matrix": k, "distortion_coefficients": d, "rectification_matrix": np.eye(3),
                "projection_matrix": np.column_stack([k, [shift, 0, 0]])}  # fmt: skip
    data = {name: {"data": np.ravel(matrix).tolist()} for name, matrix in matrices.items()}
    return {"image_width": 24, "image_height": 16, "distortion_model": "plumb_bob", **data}


def test_camera_info_files_of_ros_have_the_baseline_of_their_projections(tmp_path):
    pairs, files = make_pairs(tmp_path, 1), [tmp_path / f"{side}.yaml" for side in SIDES]
    for path, shift in zip(files, (0.0, -5.0), strict=True):
        path.write_text(yaml.safe_dump(camera_info(shift)))
    assert imported(tmp_path, pairs, files) == (1, [])
    camera = frame_of(tmp_path / "out.mcap").camera
    assert (camera.baseline, camera.raw[0].d[0]) == (0.25, 0.01)
    swapped = (
        r"the first camera of .*right\.yaml and .*left\.yaml is the right one .*-0\.25 m.*; give the left one first"
    )
    with pytest.raises(LogError, match=swapped):
        imported(tmp_path, pairs, files[::-1])
    with pytest.raises(LogError, match=r"left\.yaml lacks the baseline of the cameras"):
        imported(tmp_path, pairs, [files[0], files[0]])


def test_a_calibration_before_rectification_needs_both_cameras_and_their_size(tmp_path):
    _, right = pairs = make_pairs(tmp_path, 1)
    lens = {"D1": [[0.01, 0, 0, 0]], "D2": [[0.02, 0, 0, 0]], "R": np.eye(3).tolist(), "T": [-0.25, 0, 0]}
    lens |= {name: [[20.0, 0, 11.5], [0, 20.0, 7.5], [0, 0, 1.0]] for name in ("M1", "M2")}
    (file := tmp_path / "stereo.yaml").write_text(yaml.safe_dump(lens))
    imported(tmp_path, pairs, file)
    camera = frame_of(tmp_path / "out.mcap").camera
    assert camera.baseline == pytest.approx(0.25)
    assert [model.d[0] for model in camera.raw] == [0.01, 0.02]
    file.write_text(yaml.safe_dump({**lens, "width": 24, "height": 16}))
    assert imported(tmp_path, pairs, file) == (1, [])
    save(right[0], picture(0)[:8])
    with pytest.raises(LogError, match="is 24x8, but the calibration is for 24x16"):
        imported(tmp_path, pairs, file)


def test_a_colour_image_may_have_a_gray_partner(tmp_path):
    _, right = pairs = make_pairs(tmp_path, 1)
    save(right[0], cv2.cvtColor(picture(1), cv2.COLOR_RGB2GRAY))
    assert picture(0).ndim == 3
    assert imported(tmp_path, pairs) == (1, [])
    frame = frame_of(tmp_path / "out.mcap")
    assert (frame.left.shape, frame.right.shape) == ((16, 24, 3), (16, 24))


def test_images_of_two_sizes_and_other_files_are_refused(tmp_path):
    _, right = pairs = make_pairs(tmp_path, 1)
    save(right[0], picture(0)[:8])
    with pytest.raises(LogError, match="differ in size or depth"):
        imported(tmp_path, pairs)
    right[0].write_bytes(b"no picture")
    with pytest.raises(LogError, match=r"0-right\.png is not a readable image"):
        imported(tmp_path, pairs)


def test_images_are_read_as_the_log_is_written(tmp_path, monkeypatch):
    pairs, read, so_far = make_pairs(tmp_path), set(), []
    monkeypatch.setattr(files, "read_bytes", lambda path: read.add(path.name) or path.read_bytes())
    assert imported(tmp_path, pairs, progress=lambda done: so_far.append(len(read))) == (3, [])
    assert so_far == [2, 4, 6]


def test_a_later_pair_that_is_cut_or_of_another_size_is_left_out(tmp_path, said):
    left, right = make_pairs(tmp_path / "pairs", 4)
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(CALIBRATION))
    right[1].write_bytes(right[1].read_bytes()[:-100])
    save(left[2], picture(0)[:8])
    given = "--calibration", tmp_path / "camera.yaml", "--pitch-down", 15, "--height", 0.9
    text = said(0, "import", "images", tmp_path / "pairs", tmp_path / "out.mcap", *given).out
    assert f"2 pairs left out, first: {right[1]} is truncated after" in text
    assert "2 stereo frames" in text
    assert np.diff(stamps_in(events(tmp_path / "out.mcap"))).tolist() == [3_000_000_000]


def test_a_first_image_of_a_rarer_size_is_refused(tmp_path):
    left, right = make_pairs(tmp_path, 4)
    for path in (left[0], right[0]):
        save(path, picture(0)[:8])
    with pytest.raises(LogError, match="the first image is 24x8, but more pairs are 24x16; give a folder"):
        imported(tmp_path, (left, right))
    _, (note,) = imported(tmp_path, (left[:2], right[:2]))
    assert note == f"1 pair left out, first: {left[1]} is 24x16, but the first image is 24x8"


def test_stamps_of_attitudes_near_zero_have_tilts_beside_them(tmp_path):
    (attitudes := tmp_path / "a.csv").write_text("name,stamp,pitch_down\n0-left,5,14\n1-left,500000000,14\n")
    assert imported(tmp_path, make_pairs(tmp_path, 2), attitudes=attitudes) == (2, [])
    assert [frame.stamp for frame in seen_in(tmp_path / "out.mcap")] == [5, 500_000_000]


def test_each_pair_has_the_attitude_of_a_csv_file(tmp_path):
    names = {"left": "L", "right": "R"}
    write_images(EXACT, lambda number, side: tmp_path / "pairs" / f"{names[side]}_{number:02d}.png")
    rows, bodies = ["name,stamp,yaw,pitch_down,roll"], []
    for number in (2, 0, 1):  # in any order
        stamp = EXACT.stamp(number)
        camera = EXACT.base_at(stamp).after(EXACT.mounts[0])
        turn = Rotation.from_matrix(camera.rotation @ BODY_FROM_OPTICAL.T)
        bodies.append((stamp, turn.as_matrix()))
        angles = [repr(float(angle)) for angle in turn.as_euler("ZYX", degrees=True)]
        rows.append(",".join([f"L_{number:02d}", str(stamp), *angles]))
    (tmp_path / "attitudes.csv").write_text("\r\n".join(rows))
    camera = {name: getattr(EXACT.camera, name) for name in ("fx", "cx", "cy", "baseline")}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(camera))
    given = "--calibration", tmp_path / "camera.yaml", "--attitudes", tmp_path / "attitudes.csv", "--height", 0.9
    log = tmp_path / "log.mcap"
    assert roverflow("import", "images", tmp_path / "pairs", log, *given) == 0
    assert_same(log, own_log(EXACT, tmp_path / "own.mcap"), mount=False)
    for frame, (stamp, body) in zip(seen_in(log), sorted(bodies, key=lambda item: item[0]), strict=True):
        assert frame.stamp == stamp
        np.testing.assert_allclose(frame.mount.rotation, body @ BODY_FROM_OPTICAL, atol=1e-9)
        np.testing.assert_allclose(frame.mount.translation, [0, 0, 0.9])


@pytest.mark.parametrize(("text", "words"), [
    ("name,pitch\n0-left,3\n", "has the unknown column 'pitch'; its first line must name"),
    ("name,roll\n0-left,3\n", "has the columns name, roll; its first line must name"),
    ("name,pitch_down\n1-left,3\n", "has no row for 0-left.png"),
    ("name,pitch_down,roll\n0-left,3\n", "line 2 has 2 columns, but the first line names 3"),
    ("name,pitch_down\n0-left,down\n", "line 2 contains what is not a number"),
    ("name,pitch_down\n0-left,1_4\n", "line 2 contains what is not a number"),
    ("name,pitch_down\n0-left,200\n", "line 2: pitch_down must be at most 180 deg"),
    ("name,pitch_down,pitch_down\n0-left,3,4\n", "has the column 'pitch_down' twice; its first line must name"),
    ("name,pitch_down\n0-left,3\n0-left.png,4\n", "line 3 has another attitude of .*0-left.png; give one row for"),
], ids=range(9))  # fmt: skip
def test_attitudes_that_are_none_are_refused(tmp_path, text, words):
    (tmp_path / "attitudes.csv").write_text(text)
    with pytest.raises(LogError, match=words):
        imported(tmp_path, make_pairs(tmp_path, 1), attitudes=tmp_path / "attitudes.csv")
    assert not list(tmp_path.glob("out*"))


def test_a_row_of_attitudes_names_one_image_by_its_folder_where_names_repeat(tmp_path):
    left, right = ([save(tmp_path / f"site{n}" / f"{side}.png", picture(n)) for n in (1, 2)] for side in SIDES)
    (attitudes := tmp_path / "attitudes.csv").write_text(
        "name,pitch_down\nsite2/left,40\nsite1/left.png,14\nsite3/left,3\n"
    )
    frames, notes = imported(tmp_path, (left, right), attitudes=attitudes)
    assert (frames, notes) == (2, ["attitudes.csv has 1 row of images that do not exist, first: site3/left"])
    pitches = [np.degrees(np.arcsin(-frame.mount.rotation[2, 2])) for frame in seen_in(tmp_path / "out.mcap")]
    np.testing.assert_allclose(pitches, [14, 40])
    attitudes.write_text("name,pitch_down\nleft,14\n")
    with pytest.raises(LogError, match=r"line 2: 'left' may be .*site1/left\.png and .*site2/left\.png; write the"):
        imported(tmp_path, (left, right), attitudes=attitudes)


def test_a_roll_beside_a_file_of_attitudes_is_refused(tmp_path):
    (attitudes := tmp_path / "attitudes.csv").write_text("name,pitch_down\n0-left,14\n")
    with pytest.raises(LogError, match=r"a roll of 30 degrees cannot be combined with .*; add a column 'roll' to it"):
        imported(tmp_path, make_pairs(tmp_path, 1), attitudes=attitudes, roll=30)
