"""Results in Foxglove's messages, read back with Foxglove's own reader and held against the ROS 2 ones."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import read_disparity, read_grid_map, read_point_cloud
from recordings.sinks.overwrite import is_ours
from tests.conftest import SMALL, roverflow

TYPES = {np.float32: 7, np.uint8: 1, np.int8: 2}  # numpy type -> PackedElementField


@pytest.fixture(scope="module")
def foxglove(traverse, tmp_path_factory):
    out = tmp_path_factory.mktemp("foxglove") / "out.mcap"
    assert roverflow("run", traverse, *SMALL, "-o", out, "--no-rrd", "--profile", "foxglove", "--every", 4) == 0
    return out


@pytest.fixture(scope="module")
def messages(foxglove):
    """Topic -> its first message."""
    found = {}
    with foxglove.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(channel.topic, message)
    return found


@pytest.fixture(scope="module")
def ros2(result):
    """The same of the run in the profile ros2."""
    return {topic: message for topic, _, message in reversed(list(iter_decoded(result)))}


def column(message, name, stride):
    """A field of a packed message, one value for each element."""
    field = next(field for field in message.fields if field.name == name)
    kind = next(kind for kind, code in TYPES.items() if code == field.type)
    rows = np.frombuffer(message.data, np.uint8).reshape(-1, stride)
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(rows[:, field.offset : field.offset + size]).view(kind)[:, 0]


def test_disparity_and_points_keep_every_value(messages, ros2):
    image = messages["/nav/disparity"]
    np.testing.assert_array_equal(
        np.frombuffer(image.data, np.float32).reshape(image.height, image.width), read_disparity(ros2["/nav/disparity"])
    )
    cloud, own = messages["/nav/points"], read_point_cloud(ros2["/nav/points"])
    for name in ("x", "y", "z", "sigma"):
        np.testing.assert_array_equal(column(cloud, name, cloud.point_stride), own[name])
    for place, name in enumerate(("red", "green", "blue")):
        np.testing.assert_array_equal(column(cloud, name, cloud.point_stride), own["colors"][:, place])


@pytest.mark.parametrize("topic", ["/nav/elevation_map", "/nav/regional_map"])
def test_a_terrain_grid_has_every_layer_in_place_and_colours_where_known(messages, ros2, topic):
    grid, own = messages[topic], read_grid_map(ros2[topic])
    assert (grid.pose.position.x, grid.pose.position.y) == pytest.approx(own.origin)
    assert grid.cell_size.x == pytest.approx(own.resolution)
    assert grid.column_count == own.layers["elevation"].shape[1]
    for name, layer in own.layers.items():
        np.testing.assert_array_equal(column(grid, name, grid.cell_stride), layer.reshape(-1))
    known = np.isfinite(own.layers["elevation"].reshape(-1))
    np.testing.assert_array_equal(column(grid, "alpha", grid.cell_stride), np.where(known, 255, 0))
    assert column(grid, "red", grid.cell_stride)[known].std() > 10


def test_cells_transforms_and_losses_are_those_of_the_ros_messages(messages, ros2):
    grid, own = messages["/nav/navigation_map"], ros2["/nav/navigation_map"]
    np.testing.assert_array_equal(column(grid, "cells", grid.cell_stride), own.data)
    assert (column(grid, "alpha", grid.cell_stride)[own.data == -1] == 0).all()
    frames = [(item.parent_frame_id, item.child_frame_id, item.translation.z) for item in messages["/tf"].transforms]
    assert frames == [
        (item.header.frame_id, item.child_frame_id, item.transform.translation.z) for item in ros2["/tf"].transforms
    ]
    assert messages["/nav/diagnostics"].message == ros2["/nav/diagnostics"].status[0].message
    assert messages["/nav/pose"].pose.position.x == ros2["/nav/pose"].pose.pose.position.x


def test_it_is_replaced_by_the_next_run_and_refused_by_readers_of_ros_messages(foxglove, traverse, result, capsys):
    assert is_ours(foxglove, "result log")
    scoring = (["score", foxglove], ["score", foxglove, "--truth", traverse])
    for command in (*scoring, ["diff", foxglove, result], ["report", foxglove]):
        assert roverflow(*command) == 2, command
        assert "--profile ros2" in capsys.readouterr().err


def test_the_pipeline_is_attached_as_it_ran(result):
    with result.open("rb") as file:
        (attached,) = make_reader(file).iter_attachments()
    assert (attached.name, attached.media_type) == ("pipeline.yaml", "application/yaml")
    first, *rest = attached.data.decode().splitlines()
    assert first == f"# --set {SMALL[1]}"
    assert "streams:" in rest
