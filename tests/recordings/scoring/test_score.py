"""Scores of results with known errors: the truth with a known change."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flow.cli.main import main
from recordings.errors import LogError
from recordings.mcap.writer import Ros2Writer
from recordings.ros2 import to_msg as ros2
from recordings.scoring import score as scoring
from recordings.scoring.result_log import input_beside, names_of
from recordings.scoring.stereo_metrics import SURFACES
from recordings.scoring.table import (
    ROWS,
    SCORES,
    brief_columns,
    brief_figures,
    brief_row,
    format_brief,
    format_score,
    terrain_lines,
)  # fmt: skip
from recordings.simulator import write_log
from recordings.simulator.texture import TerrainClass
from stages.data import ElevationMap, Pose, Transform
from tests.conftest import chunks_of, edit_of, halves, rewrite, with_broken, write_messages
from tests.recordings.scoring.known_run import BLIND, SMALL, Run, frame_of, truth_of


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("truth") / "log.mcap"
    write_log(SMALL, path)
    return path


@pytest.fixture(scope="module")
def frames():
    return [frame_of(index) for index in range(SMALL.frames)]


@pytest.fixture
def scored(tmp_path, truth) -> Callable[..., scoring.Score]:
    """The score of a run with some changes, against the truth or another log."""

    def score(against: Path = truth, **changes: Any) -> scoring.Score:
        return scoring.score(Run(**changes).write(tmp_path / "out.mcap"), against)

    return score


def test_disparity_is_also_scored_by_the_class_of_the_surface(scored, frames):
    codes = {kind.name.lower(): int(kind) for kind in TerrainClass if kind != TerrainClass.SKY}
    assert codes == SURFACES
    off = frames[0].terrain_class == TerrainClass.ROCK
    found = scored(disparity=lambda pixels: pixels + np.float32(3) * off, skipped=(1,)).disparity
    both = frames[0].seen == 255
    for name, code in codes.items():
        pixels = int(np.count_nonzero(both & (frames[0].terrain_class == code)))
        hidden = int(np.count_nonzero((frames[1].seen == 255) & (frames[1].terrain_class == code)))
        assert found["by_surface"][name]["pixels"] == pixels + hidden
        bad = found["by_surface"][name]["bad_2"]
        expected = (hidden + pixels * (name == "rock")) / max(pixels + hidden, 1)
        assert math.isnan(bad) if pixels + hidden == 0 else bad == pytest.approx(expected)


def test_the_truth_itself_scores_perfectly(scored, frames):
    found = scored()
    assert (found.frames, found.compared, found.missing, found.unmatched) == (2, 2, {}, {})
    assert found.disparity["pixels"] == sum((frame.seen == 255).sum() for frame in frames)
    assert found.disparity["bad_0.5"] == found.disparity["rmse"] == 0
    counts = {name: region["pixels"] for name, region in found.disparity["whole_image"].items()}
    assert counts["nonocc"] == found.disparity["pixels"]
    assert counts["occluded"] == sum((frame.seen == 128).sum() for frame in frames)
    assert counts["all"] == counts["nonocc"] + counts["occluded"]
    heights, hazards, rocks = (found.terrain[name] for name in ("heights", "hazards", "rocks"))
    for ring in ("0-4 m", "4-8 m", "0-8 m"):
        assert heights[ring]["raw"]["rmse"] == 0
        assert heights[ring]["completeness"] == heights[ring]["raw"]["within_5cm"] == 1
    assert heights["0-8 m"]["raw"]["cells"] > 5000
    assert heights["0-8 m"]["seen"] == heights["0-4 m"]["seen"] + heights["4-8 m"]["seen"]
    assert hazards["recall"] == 1
    assert hazards["false_safe"] == hazards["false_alarm"] == hazards["unknown"] == 0
    assert hazards["free_on_rock"] == 0
    hallucinated = found.terrain["hallucinated"]
    assert hallucinated["claimed"] == 0 < hallucinated["of_values"] < hallucinated["unseen"]  # all are interpolated
    assert rocks["0.2 m"]["visible"] > 5
    assert rocks["0.2 m"]["recall"] == rocks["0.3 m"]["recall"] == 1
    assert found.tilt["frames"] == 2
    assert found.tilt["max"] < 1e-6
    assert found.untilted == {}


WIDE = r"its cells are 0\.1 m wide, the truth's 0\.05 m; run with that resolution"


@pytest.mark.parametrize(("changed", "reasons"), [
    ({"lens": {"fx": 200.0}}, {"disparity": "its camera has f = .*"}),
    ({"lens": {"baseline": 0.25}}, {"disparity": "its camera has f = .*"}),
    ({"resolution": 0.1}, {"elevation_map": WIDE, "navigation_map": WIDE}),
    ({"resolution": 0.1, "navigation": 0.05},
     {"elevation_map": WIDE, "navigation_map": "the frame's other map does not fit the truth"}),
    ({"lower": 0.1}, dict.fromkeys(("elevation_map", "navigation_map"),
     r"its origin is 1\.\d\d m from the camera, the truth's \(base_link\) \d\.\d\d m")),
])  # fmt: skip
def test_what_does_not_fit_the_truth_is_not_scored_but_all_else_is(scored, tmp_path, truth, changed, reasons):
    found = scored(**changed)
    assert found.unscored.keys() == {f"/nav/{name}" for name in reasons}
    for name, reason in reasons.items():
        ((why, count),) = found.unscored[f"/nav/{name}"].items()
        assert re.fullmatch(reason, why)
        assert count == 2
        assert f"not scored   /nav/{name}: 2 frames: {why[:15]}" in format_score(found)
    assert max(map(len, format_score(found).splitlines())) <= 100
    assert (found.disparity is None, found.terrain is None) == ("disparity" in reasons, "elevation_map" in reasons)
    assert found.tilt["frames"] == 2
    assert main(["score", str(tmp_path / "out.mcap"), "--truth", str(truth)]) == 3


def test_a_result_with_no_comparable_message_is_not_scored(scored):
    only = ("/nav/elevation_map", "/nav/navigation_map")
    with pytest.raises(LogError, match=r"no result fits the truth in .*: /nav/elevation_map: its cells"):
        scored(only=only, resolution=0.1)
    assert scored(resolution=0.1, skipped=(1,)).terrain is None


def test_simulated_frames_are_cropped_by_their_largest_disparity(scored, frames):
    largest = [np.nanmax(truth_of(index)[0].pixels) for index in range(SMALL.frames)]
    widths = [math.ceil(disparity / 16) * 16 for disparity in largest]
    found = scored().disparity["cropped_image"]
    assert found["leftmost_columns_cropped"] == sorted(set(widths))
    kept = [(frame.seen == 255)[:, width:].sum() for frame, width in zip(frames, widths, strict=True)]
    assert found["nonocc"]["pixels"] == sum(kept)


def test_a_smaller_map_is_compared_by_place_and_loses_completeness(scored):
    found = scored(crop=40).terrain
    assert found["heights"]["0-8 m"]["raw"]["rmse"] == 0
    assert found["heights"]["0-4 m"]["completeness"] == 1
    assert 0.05 < found["heights"]["4-8 m"]["completeness"] < 0.9
    assert found["hazards"]["false_safe"] == found["hazards"]["false_alarm"] == 0
    assert 0.05 < found["hazards"]["unknown"] < 0.9


def test_the_shares_of_a_blind_map_are_in_its_row_of_a_table(scored):
    nothing = scored(cells=BLIND["cells"])
    row = dict(zip(SCORES, brief_row("blind", brief_figures(nothing)), strict=True))
    assert (row["missed"], row["false alarm"], row["unknown"]) == ("0.00 %", "0.00 %", "100.00 %")


def test_the_columns_of_several_rows_have_their_units():
    figures = [0.98, 0.03, 0.02, 0.5, 0.0125, 0, 0.25, 0.5]
    columns = brief_columns([figures, [1, 0, 0, 0, math.nan, 0, 0, 1]])
    assert brief_row("A", figures)[1:6] == ("98.00 %", "3.00 %", "2.00 %", "0.500", "1.25")
    assert columns["density (%)"] == [98, 100]
    assert columns["RMS (px)"] == [0.5, 0]
    assert columns["height (cm)"] == pytest.approx([1.25, math.nan], nan_ok=True)
    assert columns["false alarm (%)"] == [25, 0]
    assert len(columns) == len(SCORES) - 1
    assert brief_columns([]) == {}


def test_a_pose_is_scored_alone_if_it_is_of_the_body_of_the_truth(tmp_path, truth):
    def posed(child):
        rows = [(SMALL.stamp(index), child) for index in range(SMALL.frames)]
        poses = [
            (stamp, "/nav/pose", ros2.odometry(Pose(stamp, [0, 0, 0], [0, 0, 0, 1], "odom", name)))
            for stamp, name in rows
        ]
        return write_messages(tmp_path / f"{child}.mcap", poses)

    assert scoring.score(posed("base_link"), truth).pose["frames"] == SMALL.frames
    with pytest.raises(
        LogError, match=r"no result fits the truth in .*: /nav/pose: it is of 'imu', the truth's of 'base_"
    ):
        scoring.score(posed("imu"), truth)


def test_truths_of_two_logs_at_one_stamp_are_refused(tmp_path, truth):
    other = tmp_path / "other.mcap"
    write_log(replace(SMALL, abundance=SMALL.abundance / 2), other)
    result = Run().write(tmp_path / "out.mcap")
    with pytest.raises(
        LogError, match=r"two messages of /truth/\w+ at \d+ ns differ; give the truth and the result of"
    ):
        scoring.score(result, [truth, other])
    assert scoring.score(result, [truth, truth]).compared == SMALL.frames


@pytest.mark.parametrize("lower", [0.0, 0.1])
def test_the_origin_of_maps_is_checked_under_a_mast_that_turns(scored, tmp_path, truth, lower):
    """The truth's mount of the camera is on the mast, and /tf places the mast."""

    def onto_mast(_, message):
        message.transforms = [item for item in message.transforms if item.child_frame_id == "left_camera_optical"]
        message.transforms[0].header.frame_id = "mast"

    mast = Transform("base_link", "mast", np.eye(3), np.zeros(3))
    log = rewrite(truth, tmp_path / "mast.mcap", edit_of("/tf_static", "tf2_msgs/msg/TFMessage", onto_mast))
    transforms = ros2.transform_message([(replace(mast, child="wheel"), SMALL.stamp(0)), (mast, SMALL.stamp(0))])
    transforms.transforms[0].transform.rotation.w = 0.0  # of a body that is not the camera's
    with Ros2Writer(tmp_path / "tf.mcap") as writer:
        writer.write("/tf", transforms, SMALL.stamp(0))
    found = scoring.score(Run(lower=lower).write(tmp_path / "out.mcap"), [log, tmp_path / "tf.mcap"])
    assert ("/nav/elevation_map" in found.unscored) == (lower > 0)


def test_a_missing_frame_scores_as_one_of_unknown_cells(scored, frames):
    alone = scored(only=("/nav/disparity",))
    assert alone.missing.keys() == {"/nav/elevation_map", "/nav/navigation_map"}
    assert alone.terrain["hazards"]["unknown"] == alone.disparity["density"] == 1
    silent = scored(skipped=(1,))
    honest = scored(blind=(1,))
    assert silent.disparity == honest.disparity
    assert terrain_lines(silent.terrain) == terrain_lines(honest.terrain)
    known, seen = np.sum(frames[0].seen == 255), sum(np.sum(frame.seen == 255) for frame in frames)
    assert silent.disparity["density"] == known / seen
    assert silent.disparity["bad_2"] == pytest.approx(1 - known / seen)
    heights, hazards, rocks = (silent.terrain[name] for name in ("heights", "hazards", "rocks"))
    assert 0.3 < heights["0-8 m"]["completeness"] < 0.7
    assert hazards["unknown"] == pytest.approx(1 - heights["0-8 m"]["completeness"])
    assert 0 < rocks["0.2 m"]["detected"] < rocks["0.2 m"]["visible"]
    assert (silent.frames, silent.compared) == (2, 1)
    assert silent.missing == {topic: [SMALL.stamp(1)] for topic in scoring.RESULTS}
    assert honest.missing == {}


def test_a_result_that_no_frame_has_is_missing_with_the_remedy(scored, tmp_path, truth):
    text = format_score(scored(only=scoring.RESULTS[1:]))
    assert "/nav/disparity: 2 of 2 frames, scored as all unknown; name the stream 'disparity', and" in text
    partly = Run(skipped=(1,)).write(tmp_path / "partly.mcap")
    assert "1 of 2 frames, scored as all unknown\n" in format_score(scoring.score(partly, truth))


def test_an_unscored_tilt_has_a_reason(scored):
    found = scored(only=scoring.RESULTS)
    assert found.tilt is None
    assert found.untilted == {"the result has no /tf from 'level' at that stamp": 2}
    assert "not scored in 2 frames: the result has no /tf from 'level'" in format_score(found)
    other = scored(camera="mast_camera")
    assert other.unscored == {"/tf": {"the truth has no mount of 'mast_camera' on 'left_camera_optical'": 2}}
    partly = scored(skipped=(0,))
    assert (partly.tilt["frames"], sum(partly.untilted.values())) == (1, 1)


def test_the_tilt_error_is_the_angle_between_the_two_ups(scored):
    found = scored(tilt_error=0.01)
    assert (found.tilt["mean"], found.tilt["max"]) == pytest.approx((0.01, 0.01), abs=1e-6)


def test_results_at_stamps_without_truth_are_reported_not_scored(scored):
    found = scored(shift={1: 1})
    assert (found.frames, found.compared) == (2, 1)
    assert found.unmatched == dict.fromkeys(scoring.RESULTS, 1)
    assert "/nav/disparity: 1 message at stamps without truth" in format_score(found)
    with pytest.raises(LogError, match=r"no result in .* has a stamp of"):
        scored(shift={0: 1, 1: 1})


@pytest.mark.parametrize(("topics", "ahead"), [("", -(10**18)), ("", 3_600_000_000_000), ("/truth/rocks", 3 * 10**9)])
def test_log_times_do_not_change_the_score(scored, tmp_path, truth, topics, ahead):
    path = tmp_path / "other.mcap"
    other = rewrite(truth, path, time=lambda topic, time: time + ahead * topic.startswith(topics))
    assert scored(other).to_json() == scored().to_json()


@pytest.mark.parametrize("off", [3 * 3600, -3 * 3600])
def test_a_wrong_stamp_in_the_truth_does_not_part_the_logs(scored, tmp_path, truth, frames, off):
    def wrong(index, message):
        message.header.stamp.sec += off * (index == 0)

    edit = edit_of("/truth/pose", "nav_msgs/msg/Odometry", wrong)
    found = scored(rewrite(truth, tmp_path / "other.mcap", edit))
    assert (found.frames, found.compared, found.missing, found.unmatched) == (3, 2, {}, {})


def without(truth, path, *topics):
    """The truth without the messages of some topics, but with their channels, as recorders write it."""
    return rewrite(truth, path, lambda topic, index, data: None if topic in topics else data, silent=True)


def test_a_truth_topic_without_messages_is_ignored(scored, tmp_path, truth):
    found = scored(without(truth, tmp_path / "bare.mcap", "/truth/occlusion", "/truth/rocks"))
    assert found.disparity["whole_image"]["all"]["bad_0.5"] == 0
    assert found.terrain["heights"]["0-8 m"]["raw"]["rmse"] < 1e-6
    assert found.unscored == {}


def test_an_incomplete_truth_names_the_missing_topic(scored, tmp_path, truth):
    found = scored(without(truth, tmp_path / "bare.mcap", "/truth/navigation_map"))
    assert found.terrain is None
    line = "not scored   /truth/elevation_map: 2 frames: the truth has no /truth/navigation_map there"
    assert line in format_score(found).splitlines()


def test_logs_that_cannot_be_compared_are_refused_with_the_reason(tmp_path, truth):
    run = Run().write(tmp_path / "run.mcap")
    with pytest.raises(LogError, match="no ground truth"):
        scoring.score(run, run)
    with pytest.raises(LogError, match="is not a result log: it has no /nav topics"):
        scoring.score(truth, truth)
    with Ros2Writer(tmp_path / "other.mcap") as writer:
        ones = {"elevation": np.ones((2, 2), np.float32)}
        writer.write("/nav/dense", ros2.grid_map(ElevationMap(1, ones, 0.05, (0, 0), "level")), 1)
    with pytest.raises(LogError, match=r"none of /nav/disparity, .*, only /nav/dense: the run produced none, or"):
        scoring.score(tmp_path / "other.mcap", truth)


def test_padded_rows_of_a_mask_do_not_change_the_score(scored, tmp_path, truth):
    def pad(_, image):
        rows = np.pad(np.asarray(image.data).reshape(image.height, -1), ((0, 0), (0, 3)))
        image.data, image.step = rows.ravel(), rows.shape[1]

    other = rewrite(truth, tmp_path / "other.mcap", edit_of("truth/occlusion", "sensor_msgs/msg/Image", pad))
    assert scored(other).disparity == scored().disparity


@pytest.mark.parametrize(("topic", "schema", "edit", "why"), [
    ("/occlusion", "sensor_msgs/msg/Image", lambda _, image: setattr(image, "height", 1),
     r"/truth/occlusion is \d+x1, /truth/disparity is \d+x\d+"),
    ("/navigation_map", "nav_msgs/msg/OccupancyGrid", lambda _, grid: setattr(grid.header, "frame_id", "x"), "it is "),
    ("/elevation_map", "grid_map_msgs/msg/GridMap", lambda _, grid: grid.layers.__setitem__(2, "x"), "the truth lacks"),
])  # fmt: skip
def test_a_truth_that_cannot_be_scored_is_named_with_the_reason(scored, tmp_path, truth, topic, schema, edit, why):
    other = rewrite(truth, tmp_path / "other.mcap", edit_of(f"truth{topic}", schema, edit))
    place = rf"out.mcap or .*other.mcap has a message at {SMALL.stamp(0)} ns that cannot be scored: {why}.*; record"
    with pytest.raises(LogError, match=place):
        scored(other)


def test_a_truth_in_several_files_is_that_of_one(tmp_path, truth, frames):
    run, folder = Run(blind=(1,)).write(tmp_path / "run.mcap"), tmp_path / "bag"
    folder.mkdir()
    files = halves(truth, folder)
    whole = scoring.score(run, truth)
    assert whole.frames == 2
    assert scoring.score(run, files).to_json() == scoring.score(run, folder).to_json() == whole.to_json()


def test_a_log_has_its_name_also_in_its_own_folder(tmp_path, monkeypatch):
    (tmp_path / "bag" / "inside").mkdir(parents=True)
    (tmp_path / "link.mcap").symlink_to("bag")
    monkeypatch.chdir(tmp_path / "bag" / "inside")
    assert names_of([Path()]) == "inside"
    assert names_of([Path(".."), tmp_path / "link.mcap"]) == "bag, link.mcap"


def test_frames_lost_in_a_damaged_truth_are_not_scored(tmp_path, truth):
    run = Run().write(tmp_path / "run.mcap")
    for topic in ("/truth/disparity", "/truth/rocks"):
        chunk, topics = next(each for each in chunks_of(truth) if topic in each[1])
        damaged = with_broken(truth, chunk)
        found = scoring.score(run, damaged)
        assert found.frames == found.compared == 2
        held = len(topics & {*scoring.TRUTHS})
        (why,) = found.lost[str(damaged)]
        assert why.startswith(f"the chunk at byte {chunk.chunk_start_offset} is broken")
        assert found.lost[str(damaged)][why] >= held
        rows = [row for row in found.per_frame if row.keys() != found.per_frame[-1].keys()]
        assert len(rows) == 1
        assert rows[0].keys() < found.per_frame[-1].keys()
        whole = scoring.score(run, truth).per_frame[0]
        assert rows[0] == {name: whole[name] for name in rows[0]}
        unscored = [count for counts in found.unscored.values() for count in counts.values()]
        assert set(unscored) <= {1}
        assert bool(unscored) == (topic == "/truth/rocks")
        assert f" of {damaged}: the chunk at byte" in " ".join(format_score(found).split())
        assert main(["score", str(run), "--truth", str(damaged)]) == 3
    assert main(["score", str(run), "--truth", str(truth)]) == 0


def test_a_score_prints_as_a_table_and_as_json(scored):
    found = scored(skipped=(1,), elevation=lambda layer: layer + np.float32(0.02))
    table = format_score(found)
    assert "1 of 2 have results" in table
    assert "/nav/disparity: 1 of 2 frames, scored as all unknown" in table
    assert [line.split()[4:9] for line in table.splitlines() if line.strip().startswith("0-4 m")] == [
        ["|", "2.00", "2.00", "2.00", "0.00"], ["|", "0.00", "0.00", "0.00", "0.00"]
    ]  # fmt: skip
    assert max(map(len, table.splitlines())) <= 100
    assert all(label in table for label in ROWS)
    brief = format_brief(found).splitlines()
    assert brief[:2] == table.splitlines()[:2]
    figures = {line.split()[0]: line for line in brief}
    assert {"disparity", "elevation", "hazards", "rocks", "tilt"} <= figures.keys()
    assert "RMS error 2.0 cm up to 4 m away, 2.0 cm up to 8 m" in figures["elevation"]
    assert max(map(len, brief)) <= 100
    read = json.loads(found.to_json())
    assert read["terrain"]["heights"]["0-4 m"]["raw"]["bias"] == pytest.approx(0.02, abs=1e-6)
    assert read["per_frame"][0]["stamp"] == SMALL.stamp(0)
    empty = scored(elevation=lambda layer: np.full_like(layer, np.nan))
    assert json.loads(empty.to_json())["terrain"]["heights"]["0-4 m"]["raw"]["rmse"] is None
    assert "nan" not in format_score(empty) + format_brief(empty)
    assert " 0.00% |      -      -      -      -            -" in format_score(empty)


def test_the_files_of_an_input_are_beside_its_result_if_all_of_them_are(tmp_path):
    result, files = tmp_path / "out.mcap", [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    with Ros2Writer(result) as log:
        log.metadata("roverflow", {"log": "a.mcap, b.mcap"})
    for file, beside in zip(files, ([tmp_path / "a.mcap, b.mcap"], files), strict=True):
        file.touch()
        assert input_beside(result) == beside
