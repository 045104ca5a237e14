"""One simulated traverse in several files, as video, and with one gray camera, gives the same maps."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import read_grid_map
from tests.conftest import SMALL, edit_of, rewrite, roverflow, run_fast
from tests.recordings.containers.forms import rows_of, write_rosbag2
from tests.recordings.video.encoder import video_log


def heights_of(log: Path) -> dict[tuple[int, int], float]:
    """The elevations of the last map of a result log by the place of the cell."""
    *_, (_, _, last) = iter_decoded(log, ["/nav/elevation_map"])
    terrain = read_grid_map(last)
    row, column = (round(place / terrain.resolution) for place in terrain.origin[::-1])
    elevation = terrain.layers["elevation"]
    return {(row + i, column + j): float(elevation[i, j]) for i, j in np.argwhere(np.isfinite(elevation)).tolist()}


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_the_files_of_a_recording_may_be_named_one_by_one(traverse, fast_result, tmp_path, plugin):
    files = sorted(write_rosbag2(rows_of(traverse), tmp_path / "bag", plugin, parts=3).glob("bag_*"))
    assert rows_of(run_fast(tmp_path / "out.mcap", files)) == rows_of(fast_result)


def test_a_log_in_h264_gives_nearly_the_same_maps(traverse, fast_result, tmp_path):
    video = video_log(traverse, tmp_path / "log.mcap", "h264", "cdr")
    exact, found = heights_of(fast_result), heights_of(run_fast(tmp_path / "out.mcap", video))
    check_same(exact, found)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_gray_camera_beside_a_colour_one_gives_nearly_the_same_maps(traverse, fast_result, tmp_path, side):
    def gray(index: int, message: Any) -> None:
        pixels = message.data.reshape(message.height, message.width, 3)
        message.encoding, message.step = "mono8", message.width
        message.data = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).reshape(-1)

    topic = f"/stereo/{side}/image_rect_color"
    mixed = rewrite(traverse, tmp_path / "log.mcap", edit_of(topic, "sensor_msgs/msg/Image", gray))
    check_same(heights_of(fast_result), heights_of(run_fast(tmp_path / "out.mcap", mixed)))
    assert roverflow("run", mixed, "-p", "paper", *SMALL, "-o", tmp_path / "paper.mcap") == 0  # with a recording


def check_same(exact: dict[tuple[int, int], float], found: dict[tuple[int, int], float]) -> None:
    """Check that two maps have nearly the same cells and heights."""
    both = found.keys() & exact.keys()
    assert len(both) > 0.85 * len(exact)
    assert np.median([abs(found[place] - exact[place]) for place in both]) < 0.005
