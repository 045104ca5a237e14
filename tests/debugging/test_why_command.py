"""`roverflow why`: what made a cell of a navigation map."""

import re
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.cli.debugging.explanation import index_of, why
from flow.cli.debugging.instants import part_of
from flow.cli.debugging.regional_explanation import why_regional
from flow.cli.debugging.result_input import graph_of
from flow.errors import UsageError
from recordings import McapSource
from recordings.comparison.text import moment
from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import level_in, read_disparity, read_grid_map, read_occupancy_grid, read_point_cloud
from stages import FuseRegion, Rectify, VisualOdometry
from stages.data import Cell, NavigationMap, PixelOrigin
from tests.conftest import (
    FRAMES,
    SMALL,
    an_hour_later,
    edit_of,
    halves,
    mcap_rows,
    rewrite,
    roverflow,
    run_fast,
    slow,
)

AT = 1.0
OWN_STAGE = """
from dataclasses import dataclass
from stages import StereoFrame

@dataclass(frozen=True)
class Pass:
    def __call__(self, frame: StereoFrame) -> StereoFrame:
        return frame
"""
OWN_PIPELINE = """
source: {use: recordings.McapSource}
streams:
  stereo:    {use: flow.align.pair, left: left, right: right}
  passed:    {use: own_stage.Pass, frame: stereo}
  disparity: {use: stages.Match, frame: passed, disparities: 16}
sinks: [{use: recordings.McapSink, results: [disparity]}]
"""


def messages(result, topic):
    return {stamp: message for _, stamp, message in iter_decoded(result, [topic])}


@pytest.fixture(scope="module")
def stamp(traverse):
    with McapSource().open(traverse) as log:
        part = part_of(log, AT, 1, 0)
    with McapSource().open(traverse, start=part.start, end=part.end) as log:
        return next(item.stamp for _, stream, item in log.events() if stream == "left")


def verdict_at(result, stamp, x, y):
    grid = read_occupancy_grid(messages(result, "/nav/navigation_map")[stamp])
    row, col = int((y - grid.origin[1]) / grid.resolution), int((x - grid.origin[0]) / grid.resolution)
    return grid.cells[row, col]


def places(result, stamp, state, number):
    """Centres of some cells of a state, the nearest to the rover first."""
    grid = read_occupancy_grid(messages(result, "/nav/navigation_map")[stamp])
    cells = np.argwhere(grid.cells == state)
    centres = (cells[:, ::-1] + 0.5) * grid.resolution + grid.origin
    order = np.argsort(np.hypot(*centres.T))
    return centres[order[:: max(1, len(order) // number)]][:number]


@pytest.mark.parametrize("state", [Cell.HAZARD, *slow(Cell.FREE)])
def test_the_change_that_would_turn_a_verdict_turns_it(traverse, fast_result, stamp, tmp_path, state):
    (x, y), *_ = places(fast_result, stamp, state, 3)
    found = why(fast_result, AT, cell=(x, y), log=traverse)
    assert (found.stamp, found.verdict, found.recorded) == (stamp, state, state)
    turn = found.turns[0]
    change = f"navigation_map.{turn.parameter}={turn.needed:.9f} {turn.unit}"
    out = run_fast(tmp_path / "turned.mcap", traverse, "--set", change)
    assert verdict_at(out, stamp, x, y) == turn.verdict != state


def test_the_pixels_of_a_cell_have_the_disparities_of_the_result(traverse, fast_result, stamp):
    _, (x, y), *_ = places(fast_result, stamp, Cell.FREE, 4)
    found = why(fast_result, AT, cell=(x, y), log=traverse)
    recorded = read_disparity(messages(fast_result, "/nav/disparity")[stamp]).ravel()[found.pixels]
    assert found.pixels.size > 3
    lowest, next_lowest = found.costs.astype(int)
    assert found.pixels.size == lowest.size
    assert np.median(lowest) < 128 < np.median(next_lowest)
    np.testing.assert_allclose(found.disparities, recorded, atol=1 / 64)
    row, col = divmod(int(found.pixels[0]), found.image.shape[1])
    again = why(fast_result, AT, pixel=(col, row), log=traverse)
    assert (again.x, again.y, again.verdict) == (found.x, found.y, found.verdict)
    assert sum(found.sources.values()) == found.pixels.size


def test_only_stages_before_the_map_run_and_the_log_is_not_surveyed_again(traverse, fast_result, stamp, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("not needed for the map of one frame")

    for stage, method in ((Rectify, "survey"), (VisualOdometry, "start"), (FuseRegion, "start")):
        monkeypatch.setattr(stage, method, refuse)
    (x, y), *_ = places(fast_result, stamp, Cell.HAZARD, 1)
    assert why(fast_result, AT, cell=(x, y), log=traverse).recorded == Cell.HAZARD


def test_the_command_prints_limits_and_draws_the_pixels(traverse, fast_result, stamp, tmp_path, said):
    (x, y), *_ = places(fast_result, stamp, Cell.HAZARD, 1)
    out, log = tmp_path / "why.png", ("--log", traverse)
    for _ in range(2):  # the second picture replaces the first
        output = said(0, "why", fast_result, "--at", AT, f"--cell={x},{y}", *log, "-o", out).out
    assert f"cell ({x:.3f}, {y:.3f}) m at {moment(stamp)}: hazard, reason " in output
    assert re.search(r"\n  step .* the limit 0.17 m \(rover.max_step 0.2 - height_margin 0.03\)\n", output)
    assert "\n  drop                     none (only hidden cells have one)\n" in output
    assert re.search(r"\nwould be (free|unknown) with navigation_map\.[a-z_.]+ = ", output)
    assert "\npixels: " in output
    assert re.search(r"\nsearch: lowest cost \d+ to \d+, median \d+; lead over the next \d+ to \d+, median ", output)
    picture = cv2.imread(str(out)).astype(int)
    assert ((picture[..., 2] > 200) & (picture[..., 1] < 80) & (picture[..., 0] > 150)).sum() > 20


def test_the_nearest_cell_of_fast_was_not_searched_at_full_size(traverse, fast_result, tmp_path, said, stamp):
    (x, y), *_ = places(fast_result, stamp, Cell.FREE, 1)
    words = ("why", fast_result, "--at", AT, f"--cell={x},{y}", "--log", traverse, "-o", tmp_path / "why.png")
    assert "\nsearch: no cost below 255: not searched at full size, or no match was found\n" in said(0, *words).out


@pytest.mark.parametrize(("words", "why_not"), [
    (("--cell", "1,1"), "traverse.mcap, is not in its folder; give it with --log"),
    (("--cell", "99,1", "--log"), "is outside the map, which has x "),
    (("--cell", "1e308,1", "--log"), "is outside the map, which has x "),
    (("--pixel", "999,1", "--log"), "is outside the image of 320x240"),
    (("--cell", "1,1", "--map", "nix", "--log"), "navigation map 'nix', only navigation_map, regional_navigation_map"),
])  # fmt: skip
def test_what_cannot_be_explained_is_refused(traverse, fast_result, refused, words, why_not):
    log = (traverse,) if "--log" in words else ()
    assert why_not in refused("why", fast_result, "--at", AT, *words, *log)


@pytest.mark.parametrize(("given", "why_not"), [
    ({"at": "soon", "cell": (3, 0)}, "an instant must be seconds after the log's first message, .* not 'soon'"),
    ({"at": np.inf, "cell": (3, 0)}, "an instant must be .* not inf"),
    *(({"at": AT, "cell": odd}, "the cell must be two finite numbers, not") for odd in ("3,0", (1, 2, 3), (np.nan, 0))),
    ({"at": AT, "pixel": ("a", 2)}, r"the pixel must be two finite numbers, not \('a', 2\)"),
])  # fmt: skip
def test_a_question_of_python_without_an_answer_is_refused(traverse, fast_result, given, why_not):
    with pytest.raises(UsageError, match=why_not):
        why(fast_result, **given, log=traverse)


def test_an_unsure_cell_says_what_keeps_it_from_being_free(traverse, fast_result, stamp, said):
    grid = messages(fast_result, "/nav/navigation_map")[stamp]
    terrain = read_grid_map(messages(fast_result, "/nav/elevation_map")[stamp])
    unsure = read_occupancy_grid(grid, messages(fast_result, "/nav/navigation_map/reason")[stamp]).reason == 9
    for few, cells in ((True, terrain.layers["count"] < 1), (False, terrain.layers["count"] >= 1)):
        row, col = np.argwhere(unsure & cells)[0]
        x, y = (terrain.origin[axis] + (place + 0.5) * terrain.resolution for axis, place in ((0, col), (1, row)))
        output = said(0, "why", fast_result, "--at", AT, f"--cell={x},{y}", "--log", traverse).out
        (because,) = re.findall(r"\nnot free because: (.+)\n", output)
        assert "unknown, reason unsure\n" in output
        assert ("fewer points than min_points" in because) == few
    (x, y), *_ = places(fast_result, stamp, Cell.FREE, 1)
    assert not why(fast_result, AT, cell=(x, y), log=traverse).doubts


def test_a_stage_of_ones_own_is_found_here_and_beside_the_result(traverse, tmp_path, monkeypatch, refused):
    (tmp_path / "own_stage.py").write_text(OWN_STAGE)
    (tmp_path / "own.yaml").write_text(OWN_PIPELINE)
    out, path = tmp_path / "own-nav.mcap", [*sys.path]
    assert roverflow("run", traverse, "-p", tmp_path / "own.yaml", "-o", out) == 0
    (tmp_path / "away").mkdir()
    away = shutil.copy(out, tmp_path / "away")
    for folder, result, found in ((tmp_path, away, True), (tmp_path.parent, out, True), (tmp_path.parent, away, False)):
        monkeypatch.setattr(sys, "path", [*path])
        monkeypatch.delitem(sys.modules, "own_stage", raising=False)
        monkeypatch.chdir(folder)
        if found:
            assert "passed" in graph_of(Path(result)).kinds
        else:
            assert "no module 'own_stage'" in (sentence := refused("why", result, "--at", AT, "--cell", "1,1"))
            assert "; set PYTHONPATH to its folder\n" in sentence


def test_a_cell_without_height_has_no_limits(traverse, fast_result, stamp, said):
    grid = read_occupancy_grid(messages(fast_result, "/nav/navigation_map")[stamp])
    x, y = (start + 0.5 * grid.resolution for start in grid.origin)
    output = said(0, "why", fast_result, "--at", AT, f"--cell={x},{y}", "--log", traverse).out
    assert "unknown, reason unobserved\nno height, so no limit applies\n" in output


def test_the_files_of_a_log_in_parts_are_found_beside_the_result_and_taken_by_log(traverse, tmp_path, said):
    (tmp_path / "result").mkdir()
    parts = halves(traverse, tmp_path)
    out = run_fast(tmp_path / "result" / "out.mcap", parts)
    words = ("--at", AT, "--cell", "3,0")
    explained = said(0, "why", out, *words, "--log", *parts).out
    shutil.move(out, tmp_path)
    beside = said(0, "why", tmp_path / out.name, *words).out
    assert explained.splitlines()[:-1] == beside.splitlines()[:-1] != []


@pytest.mark.parametrize("regional", [(), ("--map", "regional_navigation_map")])
def test_a_log_of_other_stamps_is_not_taken_for_the_input(traverse, fast_result, tmp_path, refused, regional):
    other = an_hour_later(traverse, tmp_path / "b.mcap")
    words = ("--at", AT, "--cell", "3,0", *regional)
    sentence = refused("why", fast_result, *words, "--log", other)
    assert f"b.mcap is not the input of {fast_result}: its frames have other stamps; give traverse.mcap\n" in sentence
    result = shutil.copy(fast_result, tmp_path / "out.mcap")
    other.rename(tmp_path / "traverse.mcap")
    guessed = "other stamps (taken for the input because the result names traverse.mcap; give --log)"
    assert guessed in refused("why", result, *words)


def test_a_log_of_the_same_stamps_and_other_content_is_noted(traverse, fast_result, tmp_path, said, refused):
    other, none = rewrite(traverse, tmp_path / "other.mcap", lambda *one: one[2], chunk_size=1 << 16), tmp_path / "none"
    words = ("why", fast_result, "--at", AT, "--cell", "3,0", "--log")
    noted = f"note: {other} has other bytes than the input of {fast_result}; only up to three stamps were compared\n"
    assert noted in said(0, *words, other).out
    assert f"there is no log {none}, which --log names\n" in refused(*words, none)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9999])
def test_a_result_that_was_cut_is_said_to_be_incomplete(traverse, fast_result, share, tmp_path, said):
    data, cut = fast_result.read_bytes(), tmp_path / "out.mcap"
    words = ("--at", 0.6, "--cell", "3,0", "--log", traverse)
    cut.write_bytes(data[: int(share * len(data))])
    notes = [line for line in said(0, "why", cut, *words).out.splitlines() if line.startswith("note: ")]
    why = "its end is missing" if share > 0.99 else "the log is truncated or damaged"
    assert [note.partition(" at byte ")[0] for note in notes] == [f"note: {cut} is incomplete: {why}"]
    assert "note: " not in said(0, "why", fast_result, *words).out


def test_a_regional_cell_names_the_frames_that_saw_it(traverse, fast_result, said, refused):
    grids = messages(fast_result, "/nav/regional_navigation_map")
    end, grid = max(grids), read_occupancy_grid(grids[max(grids)])
    layers = read_grid_map(messages(fast_result, "/nav/regional_map")[end]).layers
    seen = np.where(grid.cells == Cell.FREE, layers["count"], np.nan)
    row, col = np.unravel_index(np.nanargmax(seen), seen.shape)
    x, y = ((place + 0.5) * grid.resolution + start for place, start in zip((col, row), grid.origin, strict=True))
    late = ("--at", 60, f"--cell={x},{y}", "--map", "regional_navigation_map", "--log", traverse)
    output = said(0, "why", fast_result, *late).out
    assert f"cell ({x:.3f}, {y:.3f}) m in 'odom', map of {moment(end)}: free, reason clear" in output
    assert output.startswith("note: --at is after the last 'regional_navigation_map', which is explained; it is at 1.5")
    found = why_regional(fast_result, 60, (x, y), log=traverse)
    assert found.layers["frames"] == len(found.frames) == FRAMES
    assert all(abs(frame.height - found.layers["elevation"]) < 0.05 for frame in found.frames)
    assert output.count(" points, height ") == FRAMES
    assert why_regional(fast_result, np.datetime64(end, "ns"), (x, y)).frames == found.frames  # without input
    kept = "of the clouds that the log keeps, thinned to 2 cm"
    assert f"frames with measured points in the cell ({kept}): {FRAMES}\n" in output
    assert len(why_regional(fast_result, 0, (x, y), log=traverse).frames) == 1
    for cell, why_not in (("--pixel=9,9", "is a regional map: give --cell"), ("--cell=999,1", "map in 'odom'")):
        assert why_not in refused("why", fast_result, *late[:2], cell, *late[3:])


@pytest.fixture(scope="module")
def first_frame(traverse, tmp_path_factory):
    """The result of the first frame, with maps of 4 m, and the points in it."""
    out = tmp_path_factory.mktemp("first") / "out.mcap"
    ranges = ("--set", "cells.max_range=4 m", "--set", "regional_cells.max_range=4 m")
    run_fast(out, traverse, "--end", 0.8, *ranges)
    ((_, stamp, cloud), (_, _, transforms)) = iter_decoded(out, ["/nav/points", "/tf"])
    fields, level = read_point_cloud(cloud), level_in([transforms], "odom")
    return out, np.datetime64(stamp, "ns"), fields, level


def test_guessed_and_distant_points_are_no_part_of_a_regional_cell(first_frame):
    out, stamp, fields, level = first_frame
    cells = np.floor(level(np.column_stack([fields[axis] for axis in "xyz"]))[:, :2] / 0.05)
    guessed, distant = fields["source"] != PixelOrigin.MEASURED, np.hypot(fields["x"], fields["y"]) > 4.1
    for others in (guessed, distant):
        alone = set(map(tuple, cells[others].tolist())) - set(map(tuple, cells[~others].tolist()))
        x, y = 0.05 * (np.array(min(alone, key=lambda cell: np.hypot(*cell))) + 0.5)
        assert why_regional(out, stamp, (x, y)).frames == []


def test_points_beyond_the_range_of_a_map_are_named(traverse, first_frame, said):
    out, stamp, fields, _ = first_frame
    beyond = (fields["x"] < 3.95) & (np.hypot(fields["x"], fields["y"]) > 4.1)
    beyond &= fields["source"] == PixelOrigin.MEASURED
    place = np.flatnonzero(beyond)[0]
    cell = f"--cell={fields['x'][place]},{fields['y'][place]}"
    output = said(0, "why", out, "--at", stamp.astype(int), cell, "--log", traverse).out
    assert output.startswith("note: the measured points of the cell lie beyond cells.max_range, 4 m from base_link\n")
    assert "unknown, reason unobserved\nno height, so no limit applies\n" in output


def test_a_frame_that_the_result_does_not_have_is_noted(traverse, first_frame):
    out, stamp, *_ = first_frame
    found, only = why(out, 1.0, cell=(3, 0), log=traverse), moment(int(stamp.astype(int)))
    note = f"note: the result has no 'navigation_map' at {moment(found.stamp)}; its maps are from {only} to {only}"
    assert (found.notes, found.recorded) == ([note], None)
    assert not why(out, 0.5, cell=(3, 0), log=traverse).notes


def test_a_frame_in_the_messages_of_another_profile_is_not_noted_as_missing(traverse, tmp_path):
    out = run_fast(tmp_path / "out.mcap", traverse, "--end", 0.8, "--profile", "foxglove")
    found = why(out, 0.5, cell=(3, 0), log=traverse)
    assert (found.notes, found.recorded) == ([], None)


def test_a_frame_without_a_map_names_what_it_lost(traverse, tmp_path, refused):
    times = {"/imu/inclinometer": [row[3] for row in mcap_rows(traverse) if row[0] == "/imu/inclinometer"]}

    def change(topic, index, data):
        return data if topic not in times or abs(times[topic][index] - times[topic][0] - 10**9) > 4e8 else None

    log = rewrite(traverse, tmp_path / "in.mcap", change)
    out = run_fast(tmp_path / "out.mcap", log, code=3)
    lost = "the frame at 1.013 s has no navigation map 'navigation_map': tilt unaligned: inclinometer has a gap of "
    assert lost in refused("why", out, "--at", 1.0, "--cell", "3,0")


def test_a_place_on_a_border_is_in_one_cell_of_every_map():
    cells = np.zeros((400, 400), np.int8)
    for border in (-0.6, 3.4, *(0.05 * np.arange(-20, 20))):
        found = set()
        for first in range(-200, -150):
            grid = NavigationMap(0, cells, cells.astype(np.uint8), 0.05, (first * 0.05, first * 0.05), "odom")
            found.add(tuple(first + place for place in index_of(grid, border, border)))
        assert found == {(round(border / 0.05),) * 2}


@pytest.mark.parametrize("stream", ["pose", "health/frames"])
def test_a_stream_that_is_no_navigation_map_is_named_as_such(traverse, tmp_path, refused, stream):
    out, also = tmp_path / "out.mcap", ("--set", "McapSink.also=[health]")
    assert roverflow("run", traverse, *SMALL, *also, "--end", 0.8, "--no-rrd", "-o", out) == 0
    assert f"no navigation map '{stream}'" in refused("why", out, "--at", 0.5, "--pixel=9,9", "--map", stream)


@pytest.mark.parametrize(("given", "why_not"), [
    (("--profile", "foxglove"), "has results in Foxglove's messages; run the log again with --profile ros2"),
    (("--set", "McapSink.results=[points]"), "contains no /nav/regional_navigation_map, only /nav/diag"),
])  # fmt: skip
def test_a_result_without_the_regional_map_is_refused(traverse, tmp_path, refused, given, why_not):
    out = run_fast(tmp_path / "out.mcap", traverse, "--end", 0.8, *given)
    words = ("--at", 0.6, "--cell", "3,0", "--map", "regional_navigation_map", "--log", traverse)
    assert why_not in refused("why", out, *words)


def test_a_regional_map_without_the_frame_at_the_instant_says_so(traverse, fast_result, tmp_path, said):
    *_, before, last = messages(fast_result, "/nav/pose")

    def tip(index, message):
        if message.header.stamp.sec * 10**9 + message.header.stamp.nanosec > (before + last) // 2:
            turn = Rotation.from_quat([getattr(message.orientation, axis) for axis in "xyzw"])
            turn *= Rotation.from_rotvec([0.0, np.deg2rad(15.0), 0.0])
            for axis, value in zip("xyzw", turn.as_quat().tolist(), strict=True):
                setattr(message.orientation, axis, value)

    log = rewrite(traverse, tmp_path / "in.mcap", edit_of("/imu/inclinometer", "sensor_msgs/msg/Imu", tip))
    out = run_fast(tmp_path / "out.mcap", log, code=3)
    words = ("--at", f"{last}", "--cell", "3,0", "--map", "regional_navigation_map")
    until = f"note: the 'regional_navigation_map' from --at on has only frames up to {moment(before)}\n"
    assert said(0, "why", out, *words).out.startswith(until)


def test_transforms_for_viewers_do_not_hide_the_frames_that_saw_a_cell(traverse, tmp_path):
    out = run_fast(tmp_path / "out.mcap", traverse, "--set", "McapSink.viewers=true", "--end", 0.8)
    assert len(why_regional(out, 60, (3.0, 0.0), log=traverse).frames) == 1
