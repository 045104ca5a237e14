"""A run reports and skips frames without a map, and does not change the others."""

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recordings.mcap.file import iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.ros2.cdr import make
from recordings.scoring.metrics import aligned
from tests.conftest import FRAMES, edit_of, rewrite, roverflow, slow

BAD = 1  # the frame that is made bad
MAPS = ("/nav/elevation_map", "/nav/navigation_map", "/nav/regional_map")
SETTINGS = ("--set", "disparities=64", "--set", "regional_elevation.step=0")  # maps of every frame
Change = Callable[[str, int, bytes], bytes | None]


def tilts_about(stamp: int, log: Path) -> set[int]:
    """Numbers of the inclinometer's messages within 0.3 s of a stamp."""
    stamps = [ros2.stamp_of(message.header) for _, _, message in iter_decoded(log, ["/imu/inclinometer"])]
    return {number for number, at in enumerate(stamps) if abs(at - stamp) < 300_000_000}


def images(paint: Callable[[int, int], np.ndarray]) -> Callable[[int, Path], Change]:
    """The images of the bad frame painted over."""

    def edit(index: int, message: Any) -> None:
        if index == BAD:
            picture = np.repeat(paint(message.height, message.width)[:, :, None], 3, axis=2)
            message.data = np.ascontiguousarray(picture, np.uint8).reshape(-1)

    return lambda stamp, log: edit_of("image_rect_color", "sensor_msgs/msg/Image", edit)


def clear_sky(height: int, width: int) -> np.ndarray:
    return np.broadcast_to(np.linspace(180, 235, height)[:, None], (height, width))


def grainy_sky(height: int, width: int) -> np.ndarray:
    return 200 + np.random.default_rng(0).integers(-3, 4, (height, width))


def no_tilt(stamp: int, log: Path) -> Change:
    gone = tilts_about(stamp, log)
    return lambda topic, index, data: None if topic == "/imu/inclinometer" and index in gone else data


def senseless_tilt(stamp: int, log: Path) -> Change:
    gone, nothing = tilts_about(stamp, log), make("geometry_msgs/msg/Quaternion", x=np.nan, y=0.0, z=0.0, w=1.0)

    def edit(index: int, message: Any) -> None:
        message.orientation = nothing if index in gone else message.orientation

    return edit_of("/imu/inclinometer", "sensor_msgs/msg/Imu", edit)


NO_POINT = "1 failed", "the frame has no measured point within range"
CASES: dict[str, tuple[Callable[[int, Path], Change], tuple[str, ...]]] = {
    "clear sky": (images(clear_sky), NO_POINT),
    "grainy sky": (images(grainy_sky), NO_POINT),
    "burnt out": (images(lambda h, w: np.full((h, w), 255)), NO_POINT),
    "tilt gap": (no_tilt, ("1 unaligned", "inclinometer has a gap of 650 ms, more than 200 ms")),
    "NaN tilt": (senseless_tilt, ("12 unreadable", "the quaternion of the inclinometer is not a rotation", "a gap of")),
}


#: The layer of the elevation map that holds the variance that the tilt's noise adds.
TILT_LAYER = "common_variance"


def maps_of(out: Path) -> dict[str, dict[int, Any]]:
    """Topic -> stamp -> map."""
    found: dict[str, dict[int, Any]] = {topic: {} for topic in MAPS}
    for topic, stamp, message in iter_decoded(out, MAPS):
        grid = ros2.read_occupancy_grid(message) if "navigation" in topic else ros2.read_grid_map(message)
        found[topic][stamp] = grid
    return found


@pytest.fixture(scope="module")
def sound(traverse: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[int, Any]]:
    """The maps of the log as it is."""
    out = tmp_path_factory.mktemp("sound") / "out.mcap"
    assert roverflow("run", traverse, *SETTINGS, "-o", out, "--no-rrd") == 0
    return maps_of(out)


@pytest.mark.parametrize("case", ["clear sky", "tilt gap", "NaN tilt", *slow("grainy sky", "burnt out")])
def test_a_bad_frame_is_reported_and_the_map_stays_correct(case, traverse, sound, tmp_path, said):
    make, words = CASES[case]
    stamps = sorted(sound["/nav/elevation_map"])
    log, out = rewrite(traverse, tmp_path / "log.mcap", make(stamps[BAD], traverse)), tmp_path / "out.mcap"
    output = said(3, "run", log, *SETTINGS, "-o", out, "--no-rrd")
    assert "INCOMPLETE" in output.out
    assert all(word in output.out for word in words)
    assert re.search(rf" at [+-]\d\.\d s \({stamps[BAD]} ns\): ", output.out)
    assert "Traceback" not in output.out + output.err
    maps, left = maps_of(out), [stamp for number, stamp in enumerate(stamps) if number != BAD]
    assert all(list(found) == left for found in maps.values())
    for stamp in left:
        mine, whole = (found["/nav/elevation_map"][stamp].layers for found in (maps, sound))
        assert all(np.array_equal(mine[name], whole[name], equal_nan=True) for name in whole if name != TILT_LAYER)
        # The noise of the tilt is estimated from the latest readings, and the bad ones are not among them.
        np.testing.assert_allclose(mine[TILT_LAYER], whole[TILT_LAYER], rtol=0.3)
        mine, whole = (found["/nav/navigation_map"][stamp].cells for found in (maps, sound))
        np.testing.assert_array_equal(mine, whole)
    regional, onto = (found["/nav/regional_map"][left[-1]] for found in (maps, sound))
    whole = onto.layers["elevation"]
    grid = onto.shape, onto.origin, onto.resolution
    regional = aligned(regional.layers["elevation"], regional.origin, *grid, np.nan)
    both = np.isfinite(regional) & np.isfinite(whole)
    assert both.sum() > 5000
    assert np.median(np.abs(regional - whole)[both]) < 0.005
    losses = [message for _, stamp, message in iter_decoded(out, ["/nav/diagnostics"]) if stamp == stamps[BAD]]
    assert max(status.level for message in losses for status in message.status) >= 1


def test_a_run_without_points_writes_no_map(traverse, tmp_path, said):
    out, nothing = tmp_path / "out.mcap", ("--set", "cleaned.max_range=0.1 m", "--set", "cleaned.margin=0 m")
    output = said(3, "run", traverse, "--set", "disparities=64", *nothing, "-o", out, "--no-rrd")
    assert "INCOMPLETE: 0 of" in output.out
    assert f"{FRAMES} failed, first: points" in output.out
    assert "Traceback" not in output.out + output.err
    counts = Counter(topic for topic, _, _ in iter_decoded(out))
    assert counts["/nav/disparity"] == FRAMES
    assert not counts.keys() & set(MAPS)
