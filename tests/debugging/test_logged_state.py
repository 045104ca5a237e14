"""`roverflow try --result`: the state before an instant comes from the result log."""

from pathlib import Path

import numpy as np
import pytest

from flow.cli.debugging.logged_state import logged_state
from flow.cli.debugging.result_input import graph_of
from flow.cli.debugging.variants import merged
from flow.cli.debugging.what_if import run_variants
from recordings.results import read_result
from stages import FuseRegion
from tests.conftest import SMALL, an_hour_later, edit_of, rewrite, run_fast, slow

AT = 1.5  # s, the last frame
HEIGHT_STEP = 1 / 1024  # m, to which the log rounds heights
POSE = "nav_msgs/msg/Odometry"
END = 1 << 62  # ns, after all stamps
EVERY_MAP = ("--set", "regional_elevation.step=0 m")


@pytest.fixture(scope="module", params=["visual odometry", *slow("logged poses")])
def run(request, traverse, tmp_path_factory):
    """A log and its result, which has a regional map of every frame."""
    log = traverse
    if request.param == "visual odometry":
        log = tmp_path_factory.mktemp("visual") / "log.mcap"
        rewrite(traverse, log, lambda topic, _, data: None if topic == "/odometry" else data)
    return log, run_fast(tmp_path_factory.mktemp("result") / "out.mcap", log, *EVERY_MAP)


def last_frame(path):
    *_, frame = read_result(path, ["regional_map", "pose"])
    return frame


def common(terrain, other):
    """The layers of a map in the rectangle that both maps have."""
    corners = [np.rint(np.array(one.origin[::-1]) / one.resolution).astype(int) for one in (terrain, other)]
    low = np.maximum(*corners)
    high = np.minimum(*(corner + one.shape for corner, one in zip(corners, (terrain, other), strict=True)))
    rows, cols = (slice(*edge) for edge in np.stack([low, high], 1) - corners[0][:, None])
    return {name: layer[rows, cols] for name, layer in terrain.layers.items()}


def tried(log, pipeline, folder):
    """The last frame of the log, run with the state of a result log, or of no other frame; and the number before it."""
    changes = () if isinstance(pipeline, Path) else (SMALL[1], EVERY_MAP[1])
    paths, _, part, _ = run_variants([log], pipeline, {"A": changes}, folder, at=AT, frames=1, before=0, workers=2)
    return last_frame(paths["A"]), part.before


def test_the_map_and_the_pose_are_those_of_the_whole_run(run, tmp_path):
    log, result = run
    whole = last_frame(result)
    found, before = tried(log, result, tmp_path)
    assert (found.stamp, before) == (whole.stamp, 1)
    pose, own, wanted, terrain = (frame.items[name] for name in ("pose", "regional_map") for frame in (whole, found))
    assert own.frame_id == pose.frame_id
    assert own.position == pytest.approx(pose.position, abs=2e-3)
    layers, expected = (common(one, other) for one, other in ((terrain, wanted), (wanted, terrain)))
    known = np.isfinite(expected["elevation"])
    assert known.sum() == np.isfinite(wanted.layers["elevation"]).sum() == np.isfinite(layers["elevation"]).sum()
    for name in ("frames", "first", "last"):
        assert np.mean(layers[name][known] == expected[name][known]) > 0.999
    off = np.abs(layers["elevation"] - expected["elevation"])[known]
    assert np.median(off) <= HEIGHT_STEP
    assert np.percentile(off, 99) <= 3 * HEIGHT_STEP


def test_without_a_state_the_map_has_only_the_frame(run, tmp_path):
    log, result = run
    found, before = tried(log, "fast", tmp_path)
    terrain, wanted = found.items["regional_map"], last_frame(result).items["regional_map"]
    assert (before, terrain.layers["frames"].max()) == (0, 1)
    assert np.isfinite(terrain.layers["elevation"]).sum() < 0.9 * np.isfinite(wanted.layers["elevation"]).sum()


def test_the_state_is_reported(run, tmp_path, said):
    log, result = run
    change = ("--set", "regional_cells.max_range=4 m", "-o", tmp_path / "try.rrd")
    output = said(0, "try", log, "--at", AT, "--result", result, *change).out
    assert "1 frame from 1.513 s on, after 1 frame before it" in output
    streams = "regional_cells" if log.name == "traverse.mcap" else "motion, pose, regional_cells"
    assert f"state of {streams}, regional_cells@B from {result} at 22:13:20.513 (1700086400513000000 ns)" in output
    assert "the log rounds its heights to 1 mm and its variances to 1 %" in output
    assert "(a result log does not contain it)" in output
    assert f"A: the run of {result}" in output
    assert "/nav/regional_map: 1 of 1 messages differ" in output  # that of the state is not compared


def test_cells_of_another_size_begin_without_a_state(run, tmp_path, said):
    log, result = run
    change = ("--set", "resolution=10 cm", "-o", tmp_path / "try.rrd")
    reason = "the logged map has cells of 0.05 m, not 0.1 m"
    output = said(0, "try", log, "--at", AT, "--result", result, *change).out
    assert f"without state: regional_cells@B ({reason})" in output


def test_without_the_pose_of_visual_odometry_its_map_has_no_state(run, tmp_path):
    log, result = run
    bare = rewrite(result, tmp_path / "bare.mcap", lambda topic, _, data: None if topic == "/nav/pose" else data)
    graphs, visual = {"A": graph_of(result)}, log.name != "traverse.mcap"
    if visual:
        graphs = {"A": graphs["A"].without({"odometry": "the log has none"})}
    states, without = logged_state(bare, graphs["A"], END).states(graphs, merged(graphs))
    assert list(states) == ([] if visual else ["regional_cells"])
    assert without.get("regional_cells") == ("the log has no pose in the map's frame 'visual_odom'" if visual else None)
    assert ("pose" in without) == visual


@pytest.mark.parametrize(("frame", "found"), [
    ("visual_odom", True), ("visual_odom/2", True), ("visual_odom_ekf", False), ("visual_odom/map", False),
])  # fmt: skip
def test_only_poses_in_a_frame_of_visual_odometry_continue(run, frame, found, tmp_path):
    def rename(_, message):
        message.header.frame_id = frame

    _, result = run
    edited = rewrite(result, tmp_path / "b.mcap", edit_of("/nav/pose", POSE, rename))
    assert bool(logged_state(edited, graph_of(result), END).poses) == found


def test_a_state_that_variants_share_is_made_once(run, monkeypatch):
    _, result = run
    made, resumed = [], FuseRegion.resumed
    monkeypatch.setattr(FuseRegion, "resumed", lambda stage, maps: made.append(stage) or resumed(stage, maps))
    changes = {"A": [], "B": ["rover.max_step=5 cm"], "C": ["regional_cells.max_range=4 m"]}
    graphs = {label: graph_of(result, own) for label, own in changes.items()}
    states, _ = logged_state(result, graphs["A"], END).states(graphs, merged(graphs))
    assert {name for name in states if "cells" in name} == {"regional_cells", "regional_cells@C"}
    assert [stage.max_range for stage in made] == [8.0, 4.0]


@pytest.mark.parametrize(("option", "sentence"), [
    (("--every", 2), "has only the frames of --every 2; give the result of a whole run\n"),
    (("--profile", "foxglove"), "has results in Foxglove's messages; run the log again with --profile ros2\n"),
])  # fmt: skip
def test_a_result_without_the_state_of_each_frame_is_refused(traverse, option, sentence, tmp_path, refused):
    result = run_fast(tmp_path / "out.mcap", traverse, "--end", 0.7, *option)
    rest = *SMALL, "-o", tmp_path / "try.rrd"
    assert f"{result} {sentence}" in refused("try", traverse, "--at", 1, "--result", result, *rest)


def test_the_result_of_another_log_or_of_another_pipeline_is_refused(traverse, fast_result, tmp_path, refused):
    rest, other = (*SMALL, "-o", tmp_path / "try.rrd"), an_hour_later(traverse, tmp_path / "b.mcap")
    for log, result, more, why in (
        (other, fast_result, (), f"{other} is not the input of {fast_result}: its frames have other stamps\n"),
        (traverse, fast_result, ("-p", "rover"), f"the pipeline is that of {fast_result}; leave out -p\n"),
        (traverse, traverse, (), f"{traverse} is not a result log; give the log that roverflow run wrote"),
    ):
        assert why in refused("try", log, "--at", 1, "--result", result, *more, *rest)


def test_at_the_first_frame_there_is_no_state(traverse, fast_result, tmp_path, said):
    output = said(0, "try", traverse, "--at", 0.5, "--result", fast_result, *SMALL, "-o", tmp_path / "try.rrd").out
    assert "has no regional map or visual odometry before the instant, so no stage has a state" in output
