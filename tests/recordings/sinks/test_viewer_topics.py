"""What viewers draw without plugins, read back with another decoder."""

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader
from scipy.spatial.transform import Rotation

from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import read_disparity, read_occupancy_grid, read_point_cloud
from recordings.sinks.colormaps import REASON_LEGEND, legend_colors
from recordings.sinks.viewer_topics import beside_inputs
from stages.data import CellReason, Transform
from tests.conftest import SMALL, roverflow


@pytest.fixture(scope="module")
def messages(traverse, tmp_path_factory):
    """Topic -> its first message, by mcap-ros2-support."""
    out = tmp_path_factory.mktemp("viewers") / "out.mcap"
    viewers = ("--set", "McapSink.viewers=true")
    assert roverflow("run", traverse, "-p", "fast", *SMALL, *viewers, "-o", out, "--no-rrd", "--end", 0.8) == 0
    found, cameras = {}, {}  # cameras: frame -> its first transform
    with out.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(channel.topic, message)
            for placed in message.transforms[:1] if channel.topic == "/tf" else ():
                cameras.setdefault(placed.child_frame_id, [placed])
    found["cameras"] = cameras
    found["own"] = {topic: message for topic, _, message in reversed(list(iter_decoded(out)))}
    return found


def test_depth_is_that_of_the_disparities_with_the_calibration_of_its_pixels(messages):
    depth, info = messages["/nav/disparity/depth/image_rect"], messages["/nav/disparity/depth/camera_info"]
    disparity = read_disparity(messages["own"]["/nav/disparity"])
    metres = np.frombuffer(depth.data, np.float32).reshape(depth.height, depth.width)
    assert (depth.encoding, info.width, info.height) == ("32FC1", depth.width, depth.height)
    known = np.isfinite(disparity) & (disparity > 1)
    scale = messages["/nav/disparity"].f * messages["/nav/disparity"].t
    np.testing.assert_allclose(metres[known] * disparity[known], scale, rtol=0.02)  # disparities are rounded to 1/32
    assert np.isnan(metres[np.isnan(disparity)]).all()
    assert info.k[0] == pytest.approx(messages["/nav/disparity"].f)


def test_terrain_and_images_have_colours(messages):
    points = read_point_cloud(messages["own"]["/nav/elevation_map/points"])
    assert len(points["x"]) > 1000
    assert points["colors"].std() > 10
    for topic in ("rectified/left/image_rect", "disparity/source/color", "navigation_map/reason/color"):
        picture = cv2.imdecode(np.frombuffer(messages[f"/nav/{topic}/compressed"].data, np.uint8), cv2.IMREAD_COLOR)
        assert picture.std() > 5, topic


def test_maps_are_offered_to_late_subscribers(result):
    with Reader(result) as reader:
        offered = {each.topic: each.ext.offered_qos_profiles for each in reader.connections}
    for topic, qualities in offered.items():
        kept = [quality.durability for quality in qualities] == [QosDurability.TRANSIENT_LOCAL]
        assert kept == ("map" in topic), topic


def test_the_tree_of_frames_hangs_from_the_frame_in_which_rerun_draws_a_log(messages):
    (root,) = messages["/tf_static"].transforms
    parents = {item.header.frame_id for item in messages["/tf"].transforms}
    children = {item.child_frame_id for item in messages["/tf"].transforms}
    assert (root.header.frame_id, root.child_frame_id) == ("tf#/", *(parents - children))


@pytest.mark.parametrize("name", ["navigation_map", "regional_navigation_map"])
def test_the_camera_of_the_reasons_sees_each_cell_at_its_pixel(messages, name):
    own, info = messages["own"][f"/nav/{name}"].info, messages[f"/nav/{name}/reason/camera_info"]
    compressed = messages[f"/nav/{name}/reason/color/compressed"]
    picture = cv2.imdecode(np.frombuffer(compressed.data, np.uint8), cv2.IMREAD_COLOR)
    assert (info.height, info.width) == picture.shape[:2]
    (pose,) = messages["cameras"][f"{name}/above"]
    assert compressed.header.frame_id == info.header.frame_id == pose.child_frame_id
    assert pose.header.frame_id == messages[f"/nav/{name}"].header.frame_id
    q, t = pose.transform.rotation, pose.transform.translation
    down = Rotation.from_quat([q.x, q.y, q.z, q.w])
    reason = read_occupancy_grid(messages["own"][f"/nav/{name}"], messages["own"][f"/nav/{name}/reason"]).reason
    row, col = np.argwhere(np.isin(reason, [CellReason.CLEAR, CellReason.STEP, CellReason.BESIDE])).T
    x, y = (own.origin.position.x + (col + 0.5) * own.resolution, own.origin.position.y + (row + 0.5) * own.resolution)
    cells = down.inv().apply(np.column_stack([x - t.x, y - t.y, np.full_like(x, -t.z)]))
    u, v, depth = np.reshape(info.k, (3, 3)) @ cells.T
    seen = picture[np.rint(v / depth).astype(int), np.rint(u / depth).astype(int), ::-1]
    np.testing.assert_array_equal(seen, legend_colors(reason[row, col], REASON_LEGEND))
    assert len(np.unique(seen, axis=0)) > 1


@pytest.mark.parametrize(("regional", "joined"), [(True, []), (False, [("camera", "level")])])
def test_a_frame_without_a_pose_does_not_give_level_the_camera_as_its_parent(regional, joined):
    placed = Transform("level", "camera", np.eye(3), np.array([0.0, 0.0, 1.0]))
    found = beside_inputs([placed], {"camera": "base_link"}, regional)
    assert [(item.parent, item.child) for item in found] == [("level", "nav/camera"), *joined]
