"""Damaged files of data sets that were once a traceback, the end of the process, or a wrong rotation."""

import re
from io import BytesIO

import numpy as np
import pytest

from tests.fuzz.folders import LAYOUTS


def turned(content: bytes) -> bytes:
    """A transform whose rotation mirrors."""
    return content.replace(b"R: ", b"R: -")


def two_channels(content: bytes) -> bytes:
    """An array of numpy with a last dimension of 2."""
    np.save(file := BytesIO(), np.stack([np.load(BytesIO(content))] * 2, axis=-1))
    return file.getvalue()


CASES = {
    "a mirror as a rotation": ("drive", "calib_velo_to_cam.txt", turned, "no rotation"),
    "a quaternion of zeros": (
        "tartanair", "P0/pose_left.txt", lambda content: b"0 0 0 0 0 0 0\n" + content, "line 1 has a quaternion"),
    "a number without a float": (
        "sequence", "rig.yaml", lambda content: content + b"roll: " + b"9" * 400, "too large"),
    "a mirror as a pose": ("sequence", "poses/05.txt", lambda _: b"-1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "no rotation"),
    "a camera that cannot be rectified": (
        "euroc", "room/mav0/cam0/sensor.yaml", lambda content: re.sub(rb", [0-9.]+\] #fu", b", 0.0] #fu", content),
        "no image of 160x120 px can be rectified"),
    "a position that is no number": (
        "drive", "2011_09_26_drive_0001_sync/oxts/data/0000000001.txt", lambda content: b"9" + content, "nan"),
    "a time beyond all numbers": (
        "sequence", "sequences/05/times.txt", lambda content: b"1e999999\n" + content, "not seconds"),
    "an empty line among times": (
        "sequence", "sequences/05/times.txt", lambda content: content.replace(b"\n", b"\n\n", 1),
        "times.txt, line 2 is empty or a comment, but lines are counted as images are"),
    "an empty line among poses": (
        "sequence", "poses/05.txt", lambda content: b"# poses\n\n" + content, "05.txt, line 2 is empty or a comment"),
    "a comment among dates": (
        "drive", "2011_09_26_drive_0001_sync/image_00/timestamps.txt",
        lambda content: content.replace(b"\n", b"\n# lost\n", 1), "timestamps.txt, line 2 is empty or a comment"),
    "an empty line among dates of the Imu": (
        "drive", "2011_09_26_drive_0001_sync/oxts/timestamps.txt", lambda content: b"\n" + content,
        "timestamps.txt, line 1 is empty or a comment"),
    "an empty line among poses of TartanAir": (
        "tartanair", "P0/pose_left.txt", lambda content: content.replace(b"\n", b"\n \n", 1),
        "line 2 is empty or a comment"),
    "a stamp of thousands of digits": (
        "euroc", "room/mav0/imu0/data.csv", lambda content: content.replace(b"\n17", b"\n" + b"17" * 2500, 1),
        "not between 1970 and 2038"),
    "stamps that a spreadsheet rounded": (
        "euroc", "room/mav0/imu0/data.csv", lambda content: content.replace(b"1700086", b"1.7E+18"),
        "spreadsheets round stamps"),
    "a header of stamps": (
        "euroc", "room/mav0/cam0/data.csv", lambda content: content.replace(b"#", b"", 1),
        "the stamp 'timestamp [ns]', not whole nanoseconds since 1970; write such as 1403636579763555584"),
    "semicolons between columns": (
        "euroc", "room/mav0/cam0/data.csv", lambda content: content.replace(b",", b";"), "has only 1 of 2 columns"),
    "another lens": (
        "euroc", "room/mav0/cam1/sensor.yaml", lambda content: content.replace(b"pinhole", b"omni"),
        "the camera model 'omni'"),
    "no readings": ("euroc", "room/mav0/imu0/data.csv", lambda content: None, "cannot read"),
    "no calibration": ("euroc", "room/mav0/cam0/sensor.yaml", lambda content: None, "give --calibration"),
    "MATLAB's file cut off": (
        "katwijk", "P1/LocCam_calibstruct.mat", lambda content: content[:700], "no struct 'stereoParams'"),
    "no MATLAB's file": (
        "katwijk", "P1/LocCam_calibstruct.mat", lambda content: None, "LocCam_calibstruct.mat: No such file"),
    "a lens without a focal length": (
        "tartanair", "P0/rig.yaml", lambda content: re.sub(rb"fx: .*", b"fx: 0", content), "'fx': must be at least 1"),
    "depth of two channels": (
        "tartanair", "P0/depth_left/000000_left_depth.npy", two_channels, "not a depth image"),
    "numpy's header without an end": (
        "tartanair", "P0/depth_left/000000_left_depth.npy", lambda content: content.replace(b"'shape'", b"(((((((", 1),
        "not a depth image"),
}  # fmt: skip


def importing(kind, name, change, home):
    """The words of the import of a folder with one file changed, or without it where the change is to None."""
    write, words = LAYOUTS[kind]
    write(home)
    content = change((home / name).read_bytes())
    (home / name).unlink() if content is None else (home / name).write_bytes(content)
    words = [str(home / word) if (home / word).exists() else word for word in words]
    return "import", *words[:2], home / "out.mcap", *words[2:]


@pytest.mark.parametrize("case", CASES)
def test_a_damaged_file_is_named_in_one_sentence(case, tmp_path, refused):
    *change, sentence = CASES[case]
    assert sentence in refused(*importing(*change, tmp_path))
    assert not list(tmp_path.glob("out*"))


def test_a_listed_image_whose_name_is_too_long_is_missing(tmp_path, said):
    change = "room/mav0/cam0/data.csv", lambda content: content + b"1700086409000000000," + b"9" * 400
    assert "lists 2 images that cam0/data lacks" in said(0, *importing("euroc", *change, tmp_path)).out
