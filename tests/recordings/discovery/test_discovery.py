"""The topics of a log are found by schema and name; ambiguous ones are reported, not guessed."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings import McapSource
from recordings.errors import LogError
from recordings.ros2.to_msg import camera_info, image, odometry, transform_message
from stages.data import Pose, Transform
from tests.conftest import write_messages
from tests.recordings.sample_log import (
    FRAMES,
    LEFT,
    PERIOD,
    RIGHT,
    START,
    TILT,
    changed,
    compressed,
    items_of,
    losses_in,
    missing_in,
    model,
    picture,
    refused_in,
    write_sample,
)


def images(path: Path, topics: dict[str, str], infos: dict[str, str]) -> Path:
    """A log of images and calibrations alone; both: topic -> frame_id."""
    rows = []
    for number in range(2):
        stamp = START + number * PERIOD
        for topic, frame in infos.items():
            rows.append((stamp, topic, camera_info(stamp, frame, model("right" if "right" in topic else "left"))))
        rows += [(stamp, topic, image(stamp, frame, picture(number))) for topic, frame in topics.items()]
    return write_messages(path, rows)


def test_two_stereo_cameras_are_equally_good(tmp_path):
    sides = ("left", "right")
    topics = [f"/{place}/{side}/{kind}" for place, kind in (("front", "image_raw"), ("rear", "image_rect"))
              for side in sides]  # fmt: skip
    infos = [f"/{place}/{side}/camera_info" for place in ("front", "rear") for side in sides]
    path = images(tmp_path / "log.mcap", dict.fromkeys(topics, "a"), dict.fromkeys(infos, "a"))
    found = missing_in(path)["left"]
    assert "/front/left/image_raw with /front/right/image_raw" in found
    assert "/rear/left/image_rect with /rear/right/image_rect" in found
    with McapSource(right="/front/right/image_raw").open(path) as log:
        assert log.topics["left"] == "/front/left/image_raw"
    twice = refused_in(path, left=topics[0], right=topics[0])["right"]
    assert twice == f"the source's 'left' and 'right' are both set to {topics[0]}; set two topics"
    with McapSource(left=topics[2], right=topics[1]).open(path) as log:  # with any names
        assert (log.topics["left"], log.topics["right"]) == (topics[2], topics[1])


def test_one_camera_may_send_its_images_compressed(tmp_path):
    edit = compressed(LEFT, cv2.imencode(".png", picture(0))[1].tobytes())
    with McapSource().open(write_sample(tmp_path / "log.mcap", edit)) as log:
        assert (log.topics["left"], log.topics["right"]) == (LEFT, RIGHT)
        assert [item.pixels.shape for _, _, item in log.events(["left"])] == [picture(0).shape] * FRAMES


@pytest.mark.parametrize("raw", ["/cam/left/image_raw", "/cam/left_raw/image_raw"])
def test_rectified_images_are_preferred(tmp_path, raw):
    names = [raw, "/cam/left/image_rect"]
    topics = [*names, *(name.replace("left", "right") for name in names)]
    found = missing_in(images(tmp_path / "log.mcap", dict.fromkeys(topics, "a"), {}))
    for side in ("left", "right"):
        assert f"no CameraInfo belongs to /cam/{side}/image_rect" in found[side]


@pytest.mark.parametrize(("frame", "found"), [("front_left", True), ("rear_left", False), ("", False)])
def test_a_calibration_elsewhere_must_have_the_frame_of_the_images(tmp_path, frame, found):
    topics = {f"/front/{side}/image_rect": frame.replace("left", side) for side in ("left", "right")}
    infos = {f"/calibration/{side}": f"front_{side}" if frame else "" for side in ("left", "right")}
    why = missing_in(images(tmp_path / "log.mcap", topics, infos)).get("left")
    assert why is None if found else "no CameraInfo belongs to /front/left/image_rect" in why


def test_the_calibration_below_the_image_topic_is_preferred(tmp_path):
    topics = {f"/cam/{side}": side for side in ("left", "right")}
    infos = {f"/cam/{side}/camera_info": side for side in topics.values()} | {"/cam/camera_info": "other"}
    with McapSource().open(images(tmp_path / "log.mcap", topics, infos)) as log:
        assert log.resolution.cameras is not None
        assert [camera.frame_id for camera in log.resolution.cameras] == ["left", "right"]


def test_truth_topics_are_used_only_if_set(tmp_path):
    names = ("/truth/left/image_rect", "/truth/right/image_rect")
    path = write_sample(tmp_path / "log.mcap", names=names)
    assert "the log has no camera image" in missing_in(path)["left"]
    with McapSource(left=names[0]).open(path) as log:
        assert log.missing == {}
        assert log.topics["right"] == names[1]


def test_a_pose_among_results_is_named_but_not_used(tmp_path):
    pose = odometry(Pose(START, [0, 0, 0], [0, 0, 0, 1], "odom", "base_link"))
    path = write_messages(tmp_path / "log.mcap", [(START, "/nav/odometry", pose)])
    assert "there is /nav/odometry; set 'odometry' of the source to use it" in missing_in(path)["odometry"]
    with McapSource(odometry="/nav/odometry").open(path) as log:
        assert log.topics["odometry"] == "/nav/odometry"


def test_a_run_may_do_without_the_pose_of_the_log(tmp_path):
    with McapSource(odometry="visual").open(write_sample(tmp_path / "log.mcap")) as log:
        assert log.missing == {"odometry": "the source's 'odometry' is set to visual"}
        assert log.refused == {}


ODOM, MAP, WHEEL = ("odom", "base_link"), ("map", "odom"), ("base_link", "wheel")


def moving(path: Path, *links: tuple[str, str], count: int = 5) -> Path:
    """A log of transforms that move, each link (parent, child) in messages of its own."""
    return write_messages(path, [
        (stamp, "/tf", transform_message([(Transform(*link, np.eye(3), [stamp - START, 0.0, 0.0]), stamp)]))
        for stamp in range(START, START + count * PERIOD, PERIOD) for link in links
    ])  # fmt: skip


@pytest.mark.parametrize(("links", "sentence"), [
    ([WHEEL], "no transform places 'base_link' (they place 'wheel'); set 'base_frame' of the source"),
    ([ODOM, ("map", "base_link")], "'base_link' has two parents, 'map' and 'odom'; record"),
    ([("odom", "foot"), ("foot", "base_link")], "'base_link' is placed in 'foot', and that in 'odom'; set 'base_fr"),
])  # fmt: skip
def test_transforms_with_no_pose_or_two_are_refused(tmp_path, links, sentence):
    why = refused_in(moving(tmp_path / "log.mcap", *links), odometry="/tf")["odometry"]
    assert f"the source's 'odometry' is set to /tf, where {sentence}" in why


def test_a_topic_that_supplies_nothing_is_judged_by_a_sample(tmp_path, monkeypatch):
    path, seen = moving(tmp_path / "log.mcap", WHEEL, count=2000), []
    monkeypatch.setattr("recordings.discovery.discover.frame_name", lambda name: seen.append(name) or name)
    with McapSource(odometry="/tf").open(path) as log:
        assert "no transform places 'base_link'" in log.refused["odometry"]
        assert len(seen) <= 800
        seen.clear()
        failed = log.resolution.messages.first("/tf", lambda message: seen.append(message) or message.pitch)
    assert isinstance(failed, LogError)
    assert len(seen) <= 801


@pytest.mark.parametrize("links", [(WHEEL, MAP, ODOM), (("/odom", "/base_link"),)], ids=["map", "leading slash"])
def test_the_pose_in_odom_is_preferred_to_that_in_map_and_a_leading_slash_is_ignored(tmp_path, links):
    path = moving(tmp_path / "log.mcap", *links)
    assert {(pose.frame_id, pose.child_frame_id) for _, _, pose in items_of(path, McapSource(odometry="/tf"))} == {ODOM}


@pytest.mark.parametrize("given", [None, "/odom"])
def test_a_pose_of_a_frame_not_joined_to_the_camera_is_refused(tmp_path, given):
    edit = changed("/odom", {"child_frame_id": "foot"})
    with McapSource(odometry=given).open(write_sample(tmp_path / "log.mcap", edit)) as log:
        sentence = "/odom is the pose of 'foot', but no static transform joins it to the camera 'left_optical'"
        assert sentence in log.missing["odometry"]
        assert ("odometry" in log.refused) == (given is not None)


def test_the_pose_may_be_rare_among_other_transforms(tmp_path):
    path = moving(tmp_path / "log.mcap", *[WHEEL] * 50, ODOM, count=20)
    with McapSource().open(path) as log:
        assert "there is /tf; set 'odometry' of the source to use it" in log.missing["odometry"]
    with McapSource(odometry="/tf").open(path) as log:
        assert log.topics["odometry"] == "/tf"
        children = lambda message: {item.child_frame_id: item for item in message.transforms}  # noqa: E731
        assert not isinstance(log.resolution.messages.first("/tf", lambda m: children(m)["base_link"]), LogError)


def test_the_pose_is_that_of_the_set_base_frame(tmp_path):
    path = moving(tmp_path / "log.mcap", MAP, ("odom", "foot"))
    poses = items_of(path, McapSource(odometry="/tf", base_frame="foot"))
    assert [pose.position[0] for _, _, pose in poses] == [number * PERIOD for number in range(5)]


@pytest.mark.parametrize("bad", [5, FRAMES])
def test_an_imu_without_unit_quaternions_is_no_inclinometer(tmp_path, bad):
    edit = changed(TILT, {f"orientation.{name}": 0.0 for name in "xyzw"}, range(bad))
    log = write_sample(tmp_path / "log.mcap", edit)
    sentence = f"{TILT} contains no orientation (the quaternion of the inclinometer is not a rotation: [0.0, 0.0"
    assert sentence in missing_in(log)["inclinometer"]


@pytest.mark.parametrize("invalid", [1, FRAMES - 2])
def test_an_imu_that_begins_invalid_is_an_inclinometer(tmp_path, monkeypatch, invalid):
    edit = changed(TILT, {"orientation_covariance": np.full(9, -1.0)}, range(invalid))
    monkeypatch.setattr("recordings.source.topics._MAX_SAMPLES", 1)
    with McapSource().open(write_sample(tmp_path / "log.mcap", edit)) as log:
        assert log.missing == {}
        assert [stream for _, stream, _ in losses_in(log.events())] == ["inclinometer"] * invalid


@pytest.mark.parametrize(("names", "merits"), [
    (("image_rect", "image_raw"), "rectified, uncompressed"),
    (("image_rect_color", "image_rect"), "rectified, uncompressed, colour"),
    (("image_rgb", "image_gray"), "uncompressed, colour"),
])  # fmt: skip
def test_the_reason_of_a_choice_is_what_the_chosen_pair_has(tmp_path, names, merits):
    topics = dict.fromkeys([f"/cam/{side}/{name}" for side in ("left", "right") for name in names], "a")
    infos = dict.fromkeys([f"/cam/{side}/camera_info" for side in ("left", "right")], "a")
    with McapSource().open(images(tmp_path / "log.mcap", topics, infos)) as log:
        assert log.resolution.chosen["left"] == f"/cam/left/{names[0]}"
        assert log.resolution.why["left"] == f"the best of 2 pairs: {merits}"
