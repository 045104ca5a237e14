"""Images from compressed video: what is lost, what is not, and where decoding begins."""

import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from recordings import McapSource
from recordings.errors import LogError
from recordings.video.formats import FrameNumbers, is_key_frame
from stages.data import CameraImage
from tests.conftest import rewrite
from tests.recordings.sample_log import LEFT, items_of, missing_in
from tests.recordings.video.encoder import KEY_INTERVAL, Encoder, gray_of, video_log

FORMATS = ("h264", "h265")


def images_of(path, side="left", **bounds):
    """The images of a side, or the reasons why they are lost."""
    return [item for _, stream, item in items_of(path, **bounds) if stream == side]


def without(path, out, topic, number):
    """The log without one message, as if it had never arrived."""
    return rewrite(path, out, lambda *of: None if of[:2] == (topic, number) else of[2])


@pytest.mark.parametrize(
    ("video", "encoding"), [("h264", "protobuf"), ("h264", "json"), ("h264", "cdr"), ("h265", "cdr")]
)
def test_images_from_video_are_those_that_were_encoded(sample, whole, tmp_path, video, encoding):
    log = video_log(sample, tmp_path / "log.mcap", video, encoding)
    given = [item for _, stream, item in whole if stream == "right"]
    read = images_of(log, "right")
    assert [image.stamp for image in read] == [image.stamp for image in given]
    for one, other in zip(read, given, strict=True):
        assert np.abs(one.pixels.astype(int) - gray_of(other.pixels)).max() <= 4
    with McapSource().open(log) as opened:
        assert "the images are compressed video" in opened.notes()["left"]
        raws = opened.file.messages(opened.channels("right"))
        assert [opened.stamp_of(raw, "right") for raw in raws] == [image.stamp for image in given]


@pytest.mark.parametrize("video", FORMATS)
def test_a_missing_message_costs_the_images_up_to_the_next_key_frame(sample, tmp_path, video):
    log = video_log(sample, tmp_path / "log.mcap", video)
    cut = images_of(without(log, tmp_path / "cut.mcap", LEFT, 1))
    assert [isinstance(item, LogError) for item in cut] == [False, True, False, False]
    begun_late = images_of(without(log, tmp_path / "late.mcap", LEFT, 0))
    assert [isinstance(item, LogError) for item in begun_late] == [True, True, False, False]
    assert "no key frame yet" in str(begun_late[0])
    kept = [item.pixels.tobytes() for item in images_of(log)]
    assert [item.pixels.tobytes() for item in cut if isinstance(item, CameraImage)] == [kept[0], *kept[3:]]


def test_a_part_of_a_video_has_the_images_of_the_whole(sample, tmp_path, monkeypatch):
    monkeypatch.setattr("recordings.source.log.MAX_LATENESS_NS", 0)
    log = video_log(sample, tmp_path / "log.mcap", "h264")
    part, whole = images_of(log, start=0.15), images_of(log)
    assert [image.pixels.tobytes() for image in part] == [image.pixels.tobytes() for image in whole[2:]]


@pytest.mark.parametrize("video", FORMATS)
def test_key_frames_and_gaps_are_found_in_the_bytes(video):
    encode, rng = Encoder(video), np.random.default_rng(1)
    frames = [encode(rng.integers(0, 256, (64, 48), np.uint8)) for _ in range(2 * KEY_INTERVAL)]
    assert [is_key_frame(video, frame) for frame in frames] == [True, False, False] * 2
    if video == "h264":
        numbers = FrameNumbers()
        assert [numbers.follows(frame) for frame in (*frames[:3], frames[4])] == [True, True, True, False]


def test_video_without_its_library_is_refused_with_the_remedy(sample, tmp_path, monkeypatch):
    log = video_log(sample, tmp_path / "log.mcap", "h264")
    monkeypatch.setattr("recordings.video.formats.find_spec", lambda name: None)
    remedy = f"install it by `{sys.executable} -m pip install av`"
    assert missing_in(log)["left"] == f"{LEFT}: compressed video needs PyAV; {remedy}"
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    assert [line[:4] for line in project["optional-dependencies"]["video"]] == ["av>="]
