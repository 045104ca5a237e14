"""Scores of results whose errors are known, because the results are the truth with a known change."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings import ros2, scoring
from recordings.errors import LogError
from recordings.simulator import Simulation, log
from stages.data import Cell, Disparity, ElevationMap, NavigationMap, Transform

SMALL = Simulation(
    frames=2, rate=1.0, width=320, height=240, relief_cells=512, abundance=0.2, color=False, seed=11
)  # fmt: skip


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("truth") / "log.mcap"
    SMALL.write(path)
    return path


@pytest.fixture(scope="module")
def frames():
    return [SMALL.frame(index) for index in range(SMALL.frames)]


@dataclass
class Run:
    """A result log made from the truth; each field changes one thing about it."""

    disparity: Callable[[np.ndarray], np.ndarray] = lambda pixels: pixels
    elevation: Callable[[np.ndarray], np.ndarray] = lambda layer: layer
    cells: Callable[[np.ndarray], np.ndarray] = lambda cells: cells
    tilt_error: float = 0.0
    crop: int = 0
    resolution: float = 0.05
    skipped: tuple[int, ...] = ()
    shift: dict[int, int] = field(default_factory=dict)
    only: tuple[str, ...] = field(default=scoring.RESULTS)

    def write(self, path: Path, frames) -> Path:
        with ros2.Ros2Writer(path) as writer:
            for index, frame in enumerate(frames):
                if index in self.skipped:
                    continue
                stamp = SMALL.stamp(index) + self.shift.get(index, 0)
                for topic, message in self.messages(stamp, frame).items():
                    if topic in self.only or topic == "/tf":
                        writer.write(topic, message, stamp)
        return path

    def messages(self, stamp, frame):
        true = log.true_disparity(SMALL, stamp, frame)
        disparity = Disparity(
            stamp, self.disparity(true.pixels.copy()), true.source, true.confidence, camera=SMALL.camera
        )  # fmt: skip
        terrain, navigation = log.truth_maps(SMALL, stamp, frame)
        inside = slice(self.crop, 320 - self.crop), slice(self.crop, 320 - 2 * self.crop)
        layer = np.ascontiguousarray(self.elevation(terrain.layers["elevation"].copy())[inside])
        cells = np.ascontiguousarray(self.cells(navigation.cells.copy())[inside])
        origin = (-8 + self.crop * 0.05, -8 + self.crop * 0.05)
        level_from_camera = frame.level.inverse().after(frame.base.after(SMALL.mounts[0]))
        off = Rotation.from_rotvec([0.6 * self.tilt_error, 0.8 * self.tilt_error, 0]).as_matrix()
        found = Transform(
            "level", "left_camera_optical", off @ level_from_camera.rotation, level_from_camera.translation
        )
        reason = np.zeros(cells.shape, np.uint8)
        return {
            "/nav/disparity": ros2.disparity_image(disparity),
            "/nav/elevation_map": ros2.grid_map(
                ElevationMap(stamp, {"elevation": layer}, self.resolution, origin, "level")
            ),
            "/nav/navigation_map": ros2.occupancy_grid(
                NavigationMap(stamp, cells, reason, self.resolution, origin, "level")
            ),
            "/tf": ros2.transform_message([(found, stamp)]),
        }


def scored(tmp_path, truth, frames, **changes) -> scoring.Score:
    return scoring.score(Run(**changes).write(tmp_path / "out.mcap", frames), truth)


def test_the_truth_itself_scores_perfectly(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames)
    assert (found.frames, found.compared, found.missing, found.unmatched) == (2, 2, {}, {})
    assert found.disparity["pixels"] == sum((frame.seen == 255).sum() for frame in frames)
    assert found.disparity["bad_0.5"] == found.disparity["rmse"] == 0
    for ring in ("0-4 m", "4-8 m", "0-8 m"):
        assert found.elevation[ring]["raw"]["rmse"] == 0
        assert found.elevation[ring]["completeness"] == found.elevation[ring]["raw"]["within_5cm"] == 1
    assert found.elevation["0-8 m"]["raw"]["cells"] > 5000
    assert found.navigation["recall"] == 1
    assert found.navigation["false_safe"] == found.navigation["false_alarm"] == found.navigation["unknown"] == 0
    assert found.rocks["seen"] > 5
    assert found.rocks["recall"] == 1
    assert found.tilt["frames"] == 2
    assert found.tilt["max"] < 1e-6


def test_disparity_errors_are_told_apart_from_missing_disparity(tmp_path, truth, frames):
    def change(pixels):
        pixels += np.float32(0.75)
        pixels[::2] = np.nan
        return pixels

    found = scored(tmp_path, truth, frames, disparity=change).disparity
    even = sum((frame.seen[::2] == 255).sum() for frame in frames) / found["pixels"]
    assert found["density"] == pytest.approx(1 - even)
    assert found["bad_1"] == pytest.approx(even)
    assert found["bad_0.5"] == found["bad_0.5_known"] == 1
    assert found["bad_1_known"] == 0
    assert (found["rmse"], found["mae"]) == pytest.approx((0.75, 0.75), abs=1e-5)


def test_a_raised_map_is_biased_and_level(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames, elevation=lambda layer: layer + np.float32(0.06))
    ring = found.elevation["4-8 m"]
    assert (ring["raw"]["bias"], ring["raw"]["rmse"]) == pytest.approx((0.06, 0.06), abs=1e-6)
    assert ring["raw"]["within_5cm"] == 0
    assert ring["raw"]["nmad"] < 1e-6
    assert ring["levelled"]["rmse"] < 1e-6


def test_a_tilted_map_is_worse_far_off_and_perfect_once_levelled(tmp_path, truth, frames):
    slope = ((np.arange(320) + 0.5) * 0.05 - 8).astype(np.float32)[None, :] * np.float32(0.01)
    found = scored(tmp_path, truth, frames, elevation=lambda layer: layer + slope).elevation
    assert 0.04 < found["4-8 m"]["raw"]["rmse"] < 0.08
    assert found["0-4 m"]["raw"]["rmse"] < 0.04
    assert found["0-8 m"]["levelled"]["rmse"] < 1e-6


def test_values_where_nobody_saw_the_ground_are_counted(tmp_path, truth, frames):
    seen = [log.truth_maps(SMALL, 0, frame)[0].layers["visible"] > 0.5 for frame in frames]
    found = scored(tmp_path, truth, frames)
    assert found.unseen == pytest.approx(1 - np.mean(seen))


def test_a_smaller_map_is_compared_by_place_and_loses_completeness(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames, crop=40)
    assert found.elevation["0-8 m"]["raw"]["rmse"] == 0
    assert found.elevation["0-4 m"]["completeness"] == 1
    assert 0.05 < found.elevation["4-8 m"]["completeness"] < 0.9
    assert found.navigation["false_safe"] == found.navigation["false_alarm"] == 0
    assert 0.05 < found.navigation["unknown"] < 0.9


def test_a_map_that_calls_everything_free_finds_no_rock(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames, cells=np.zeros_like)
    assert found.navigation["recall"] == found.rocks["found"] == 0
    assert found.navigation["false_safe"] == 1
    blind = scored(tmp_path, truth, frames, cells=lambda cells: np.full_like(cells, Cell.UNKNOWN))
    assert blind.navigation["unknown"] == 1
    assert blind.navigation["false_safe"] == 0
    assert blind.rocks["recall"] == 0


def test_the_tilt_error_is_the_angle_between_the_two_ups(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames, tilt_error=0.01)
    assert (found.tilt["mean"], found.tilt["max"]) == pytest.approx((0.01, 0.01), abs=1e-6)


def test_a_frame_without_results_is_missing_by_its_stamp(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames, skipped=(0,))
    assert (found.frames, found.compared) == (2, 1)
    assert found.missing == {topic: [SMALL.stamp(0)] for topic in scoring.RESULTS}
    partial = scored(tmp_path, truth, frames, only=("/nav/disparity",))
    assert partial.missing.keys() == {"/nav/elevation_map", "/nav/navigation_map"}
    assert partial.elevation is None
    assert partial.navigation is None


def test_results_at_stamps_without_truth_are_reported_and_never_compared(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames, shift={1: 1})
    assert (found.frames, found.compared) == (2, 1)
    assert found.unmatched == dict.fromkeys(scoring.RESULTS, 1)
    assert "/nav/disparity: 1 messages at stamps without truth" in scoring.format_score(found)
    with pytest.raises(LogError, match=r"no result of .* has the stamp of a true frame"):
        scored(tmp_path, truth, frames, shift={0: 1, 1: 1})


def test_logs_that_cannot_be_compared_say_why(tmp_path, truth, frames):
    run = Run().write(tmp_path / "run.mcap", frames)
    with pytest.raises(LogError, match="no ground truth"):
        scoring.score(run, run)
    with pytest.raises(LogError, match="has no results"):
        scoring.score(truth, truth)
    with pytest.raises(LogError, match=r"cells of 0\.1 m, the truth has 0\.05 m"):
        scored(tmp_path, truth, frames, resolution=0.1)


def test_a_score_prints_as_a_table_and_as_json(tmp_path, truth, frames):
    found = scored(tmp_path, truth, frames, skipped=(1,), elevation=lambda layer: layer + np.float32(0.02))
    table = scoring.format_score(found)
    assert "1 of 2 compared" in table
    assert "/nav/disparity: 1 of 2 frames" in table
    assert table.count("plane removed") == 3
    assert "2.00" in table
    read = json.loads(found.to_json())
    assert read["elevation"]["0-4 m"]["raw"]["bias"] == pytest.approx(0.02, abs=1e-6)
    assert read["per_frame"][0]["stamp"] == SMALL.stamp(0)
    empty = scored(tmp_path, truth, frames, elevation=lambda layer: np.full_like(layer, np.nan))
    assert json.loads(empty.to_json())["elevation"]["0-4 m"]["raw"]["rmse"] is None
    assert "nan" in scoring.format_score(empty)
