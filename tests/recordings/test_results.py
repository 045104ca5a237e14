"""A result log is read back as the data types that the run made."""

import numpy as np
import pytest

from recordings.errors import LogError
from recordings.mcap.file import iter_decoded
from recordings.results import read_result
from stages import Reproject
from stages.data import Disparity, ElevationMap, NavigationMap, PixelOrigin, Pose, StereoFrame, known
from tests.conftest import FRAMES


def test_each_stream_is_read_as_its_type(result):
    frames = list(read_result(result))
    assert len(frames) == FRAMES
    assert [frame.stamp for frame in frames] == sorted(frame.stamp for frame in frames)
    items = frames[-1].items
    kinds = {"disparity": Disparity, "elevation_map": ElevationMap, "navigation_map": NavigationMap, "pose": Pose,
             "regional_map": ElevationMap, "regional_navigation_map": NavigationMap, "points": dict}  # fmt: skip
    assert {name: type(items[name]) for name in kinds} == kinds
    assert all(item.stamp == frames[-1].stamp for item in items.values() if not isinstance(item, dict))
    region, pose = items["regional_map"], items["pose"]
    assert region.epoch == frames[0].stamp
    assert np.hypot(*(region.level.translation - pose.position)[:2]) < 0.02


def test_disparities_have_their_origins_and_maps_their_reasons(result):
    frame = next(read_result(result, ["disparity", "navigation_map"]))
    disparity, navigation = frame.items["disparity"], frame.items["navigation_map"]
    assert set(frame.items) == {"disparity", "navigation_map"}
    np.testing.assert_array_equal(np.isfinite(disparity.pixels), known(disparity.source))
    assert (disparity.source == PixelOrigin.OUT_OF_VIEW).any()
    assert np.isnan(disparity.confidence).all()
    assert disparity.sigma is None
    assert len(np.unique(navigation.reason)) > 3


def test_a_disparity_of_a_log_becomes_points_in_a_notebook(result, traverse):
    """The points are those of the log's own calibration and disparities."""
    disparity = next(read_result(result, "disparity")).items["disparity"]
    _, _, info = next(iter_decoded(traverse, ["/stereo/left/camera_info"]))
    _, _, logged = next(iter_decoded(result, ["/nav/disparity"]))
    gray = np.zeros(disparity.pixels.shape, np.uint8)
    cloud = Reproject()(StereoFrame(disparity.stamp, gray, gray, disparity.camera), disparity)
    fx, cx, fy, cy = info.p[[0, 2, 5, 6]]
    row, col = np.divmod(cloud.pixel, gray.shape[1])
    depth = logged.f * logged.t / disparity.pixels[row, col]
    exact = np.column_stack([(col - cx) / fx * depth, (row - cy) / fy * depth, depth])
    np.testing.assert_allclose(cloud.points, exact, rtol=1e-4, atol=1e-5)
    assert len(row) > gray.size / 3


def test_one_stream_may_be_given_by_its_name_alone(result):
    assert all(set(frame.items) == {"pose"} for frame in read_result(result, "pose"))


def test_streams_may_be_given_one_after_the_other(result):
    assert set(next(read_result(result, (name for name in ("pose", "disparity")))).items) == {"pose", "disparity"}


def test_other_logs_and_unknown_streams_are_refused(result, traverse):
    with pytest.raises(LogError, match="is not a result log"):
        next(read_result(traverse))
    with pytest.raises(LogError, match="no stream 'depth', only disparity, "):
        next(read_result(result, ["depth"]))
