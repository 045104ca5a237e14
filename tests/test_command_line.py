"""The command line on real files: arguments, outputs, and messages about what cannot be done."""

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from flow.config.loader import load
from flow.runtime.run import run
from recordings.containers.container import RawMessage
from recordings.mcap.file import McapFile, iter_decoded
from recordings.ros2.from_msg import read_disparity, read_grid_map, stamp_of
from recordings.simulator import Simulation, write_log
from recordings.simulator.traverse import level_pose
from recordings.sinks.mcap_sink import McapSink
from stages.data import PixelOrigin, known
from tests.conftest import FRAMES, SMALL, TRAVERSE, mcap_rows, rewrite, roverflow, slow, write_mcap
from tests.limits import file_size_limited
from tests.recordings.sinks.recorded_scene import entities

ROOT = Path(__file__).parent.parent
RESULTS = {
    "/nav/disparity", "/nav/points", "/nav/elevation_map", "/nav/navigation_map", "/nav/pose", "/nav/regional_map",
    "/nav/regional_navigation_map", "/tf", "/nav/diagnostics", "/nav/navigation_map/reason",
    "/nav/regional_navigation_map/reason", "/nav/disparity/source", "/nav/disparity/camera_info",
}  # fmt: skip


def messages_of(log: Path, topic: str) -> list[Any]:
    """The messages of a topic."""
    return [message for _, _, message in iter_decoded(log, [topic])]


def raw_messages(path: Path) -> list[tuple[str, int, str]]:
    with path.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages()
        return [(channel.topic, at.log_time, hashlib.sha256(at.data).hexdigest()) for _, channel, at in found]


def test_every_frame_leaves_every_result(result):
    counts = Counter(topic for topic, _, _ in raw_messages(result))
    assert set(counts) == RESULTS
    assert all(counts[topic] >= (2 if "regional" in topic else FRAMES) for topic in RESULTS)  # those of each step
    assert not list(result.parent.glob("*.partial"))


def test_a_run_notes_once_which_streams_use_log_times(traverse, tmp_path, said):
    def unstamped(topic, index, data):
        return data[:4] + bytes(8) + data[12:] if topic == "/odometry" else data

    log, summary = rewrite(traverse, tmp_path / "log.mcap", unstamped), tmp_path / "out.json"
    printed = said(0, "run", log, *SMALL, "-o", tmp_path / "out.mcap", "--no-rrd", "--summary", summary).out
    sentence = "the header stamps are 0, so log times are used"
    assert json.loads(summary.read_text())["findings"]["odometry"] == {"severity": "note", "sentence": sentence}
    assert printed.count(f"odometry: {sentence}") == 1


def test_every_known_disparity_has_its_origin(result):
    disparities, sources = (messages_of(result, topic) for topic in ("/nav/disparity", "/nav/disparity/source"))
    assert len(disparities) == len(sources) == FRAMES
    for disparity, source in zip(disparities, sources, strict=True):
        assert stamp_of(source.header) == stamp_of(disparity.header)
        assert source.header.frame_id == disparity.header.frame_id
        codes = source.data.reshape(source.height, source.width)
        np.testing.assert_array_equal(known(codes), np.isfinite(read_disparity(disparity)))
        assert set(np.unique(codes)) >= {PixelOrigin.MEASURED, PixelOrigin.PLANE, PixelOrigin.FILLED}


def test_the_summary_contains_frame_counts_losses_and_seconds_per_stage(result):
    summary = json.loads(result.with_suffix(".json").read_text())
    assert (summary["verdict"], summary["frames_in"], summary["frames_out"]) == ("COMPLETE", FRAMES, FRAMES)
    assert summary["drops"] == {}
    assert summary["surveys"]["rectified"]["sentence"].endswith("): too small to correct")
    assert summary["seconds"]["disparity/full"] > 0
    assert set(summary["seconds"]) >= {"rectified", "disparity", "points", "elevation_map", "navigation_map"}


def test_a_log_without_a_pose_gets_a_visual_one_named_as_such(traverse, tmp_path, said):
    poses = ("/odometry", "/tf")
    log = rewrite(traverse, tmp_path / "log.mcap", lambda topic, _, data: None if topic in poses else data)
    out, summary = tmp_path / "out.mcap", tmp_path / "out.json"
    printed = said(0, "run", log, *SMALL, "-o", out, "--no-rrd", "--summary", summary).out
    written, regional = (messages_of(out, topic) for topic in ("/nav/pose", "/nav/regional_map"))
    assert [(pose.header.frame_id, pose.child_frame_id) for pose in written] == [("visual_odom", "base_link")] * FRAMES
    simulation = Simulation(**TRAVERSE)
    start = level_pose(simulation.base_at(simulation.stamp(0))).inverse()
    for index, pose in enumerate(written):
        true = start.after(simulation.base_at(simulation.stamp(index))).translation
        place = pose.pose.pose.position
        assert np.linalg.norm([place.x - true[0], place.y - true[1], place.z - true[2]]) < 0.03
    sentence = f"Visual odometry supplies the pose ({FRAMES} poses, frame visual_odom)."
    assert json.loads(summary.read_text())["findings"]["pose"]["sentence"] == sentence
    assert f"pose: {sentence}" in printed
    assert {message.header.frame_id for message in regional} == {"visual_odom"}
    assert read_grid_map(regional[-1]).layers["frames"].max() == FRAMES


def test_a_logged_pose_is_kept_and_the_tilt_is_still_checked(result):
    assert {pose.header.frame_id for pose in messages_of(result, "/nav/pose")} == {"odom"}
    (finding,) = json.loads(result.with_suffix(".json").read_text())["findings"].values()
    assert finding["sentence"].startswith("The tilt was not checked: too few frames in which the rover moved (")


def test_a_pipeline_without_a_recording_writes_and_lists_none(traverse, tmp_path, said):
    pipeline = tmp_path / "short.yaml"
    text = (ROOT / "flow" / "pipelines" / "rover.yaml").read_text()
    pipeline.write_text(text.replace("  - {use: recordings.RerunSink}\n", ""))
    words = ("-p", pipeline, *SMALL, "-o", tmp_path / "out.mcap", "--end", "0.8")
    assert ".rrd" not in said(0, "run", traverse, *words).out


def test_a_row_offset_is_measured_once_for_the_log_reported_and_corrected(traverse, tmp_path, said):
    def displaced(topic, _, data):
        if "right" in topic and "image" in topic:  # the pixels are the last of the message
            image = np.frombuffer(data, np.uint8)[-320 * 240 * 3 :].reshape(240, 320, 3)
            return data[: -image.size] + np.roll(image, 2, axis=0).tobytes()
        return data

    log = rewrite(traverse, tmp_path / "displaced.mcap", displaced)
    whole, part, summary = (tmp_path / name for name in ("whole.mcap", "part.mcap", "whole.json"))
    printed = said(0, "run", log, *SMALL, "--no-rrd", "-o", whole, "--summary", summary).out
    (survey,) = json.loads(summary.read_text())["surveys"].values()
    finding = survey["sentence"]
    assert f"rectified: {finding}" in printed
    assert float(re.search(r"differ by (\S+) px at the centre", finding)[1]) == pytest.approx(-2, abs=0.1)
    assert "; corrected, as row_offset=[" in finding
    assert roverflow("run", log, *SMALL, "--no-rrd", "-o", part, "--start", "1.5") == 0
    images = [{m for m in raw_messages(path) if m[0] == "/nav/disparity"} for path in (whole, part)]
    assert images[1] < images[0]  # the same messages, though the run saw but a part
    assert images[1]


def test_the_result_reads_back_with_rosbags(result):
    with AnyReader([result]) as reader:
        messages = [(each.topic, reader.deserialize(data, each.msgtype)) for each, _, data in reader.messages()]
    assert len(messages) == len(raw_messages(result))
    disparity: Any = dict(messages)["/nav/disparity"]
    assert disparity.image.encoding == "32FC1"


def test_the_result_reads_back_with_reruns_own_loader(result, tmp_path):
    rrd = tmp_path / "loaded.rrd"
    convert = [sys.executable, "-m", "rerun", "mcap", "convert", result, "-o", rrd]
    assert subprocess.run(convert, capture_output=True).returncode == 0
    assert entities(rrd) >= RESULTS


def test_the_recording_verifies_and_contains_every_intermediate(result):
    rrd = result.with_suffix(".rrd")
    check = subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", rrd], capture_output=True, text=True)
    assert check.returncode == 0, check.stderr
    streams = {entity.strip("/").removesuffix("/pixels") for entity in entities(rrd)}
    assert streams >= {"rectified/left", "rectified/right", "disparity/full", "disparity"}
    assert {stream.partition("/")[0] for stream in streams} >= {"points", "elevation_map", "navigation_map"}


@pytest.mark.parametrize(("part", "compared"), [
    (("--end", 1.1), 2),
    (("--start", 0.52), FRAMES - 1),  # the first frame's stamp is before that time, and its messages were logged after
    (("--start", 0.7, "--end", 1.3), 1),
    (("--every", 2), -(-FRAMES // 2)),
])  # fmt: skip
def test_the_score_of_a_part_counts_that_part_alone(traverse, tmp_path, said, part, compared):
    out, score_file = tmp_path / "part.mcap", tmp_path / "score.json"
    printed = said(0, "run", traverse, *SMALL, "-o", out, "--no-rrd", *part).out
    left_out = FRAMES - compared
    assert (f"{left_out} frame{'s' * (left_out > 1)} left out by --every 2" in printed) == ("--every" in part)
    printed = said(0, "score", out, "--truth", traverse, "--json", score_file).out
    assert f"{left_out} frame{'s' * (left_out > 1)} outside the part of the log that was run" in printed
    found = json.loads(score_file.read_text())
    assert (found["frames"], found["compared"], found["beyond"], found["missing"]) == (compared, compared, left_out, {})
    assert found["disparity"]["whole_image"]["nonocc"]["bad_1"] < 0.1


def test_the_part_of_a_log_of_several_files_is_scored_as_that_of_one(traverse, tmp_path, said):
    rows, out = mcap_rows(traverse), tmp_path / "out.mcap"
    half = len(rows) // 2
    files = [write_mcap(tmp_path / "a.mcap", rows[:half]), write_mcap(tmp_path / "b.mcap", rows[half:])]
    said(0, "run", *files, "-p", "fast", *SMALL, "-o", out, "--no-rrd", "--end", 1.1)
    counted = "frames       2 of 2 have results\nnot counted  1 frame outside the part of the log "
    for truths in (files, files[::-1]):
        given = [word for file in truths for word in ("--truth", file)]
        assert said(0, "score", *given, out).out.startswith(counted)
    moved = [shutil.copy(file, tmp_path / f"of-{file.name}") for file in files]
    assert said(0, "score", "--truth", moved[0], "--truth", moved[1], out).out.startswith(counted)


def test_a_truth_of_another_traverse_is_noted(traverse, fast_result, tmp_path, said):
    """Seeds fix the stamps, so that they do not distinguish the traverses."""
    other, none = tmp_path / "traverse.mcap", tmp_path / "none.mcap"
    write_log(Simulation(**{**TRAVERSE, "abundance": 0.5}), other)
    note = "other input  the log with the truth has other bytes than the input of the run; it may be another traverse"
    printed = said(3, "score", fast_result, "--truth", other).out
    assert note in " ".join(printed.split()).replace("other input ", "other input  ")
    rewrite(traverse, none, lambda topic, _, data: data if topic.startswith("/t") else None)
    assert "other input" not in said(0, "score", fast_result, "--truth", none).out  # a log of truth alone


def test_a_run_without_any_result_replaces_none(tmp_path, said):
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(Simulation(frames=1, width=32, height=32, relief_cells=256), log)
    assert roverflow("run", log, "-p", "paper", "-o", out, "--no-rrd") == 0
    before = out.read_bytes()
    printed = said(3, "run", log, "-o", out).out  # too small to be halved twice
    assert out.read_bytes() == before
    assert "out.mcap was not written because the run produced no results" in printed
    assert out.with_suffix(".rrd").exists()  # which shows why
    words = ("--set", "McapSink.results=[]", "-p", "paper", "-o", tmp_path / "none.mcap", "--no-rrd")
    printed = said(0, "run", log, *words).out
    assert "none.mcap was not written because the run produced no results.\n" in printed
    assert not (tmp_path / "none.mcap").exists()


def test_a_full_disk_keeps_the_partial_and_the_previous_result(traverse, fast_result, tmp_path, said):
    out = Path(shutil.copy(fast_result, tmp_path))
    command = ("run", traverse, "-p", "fast", *SMALL, "-o", out, "--no-rrd", "--workers", 1)
    before = out.read_bytes()
    with file_size_limited(len(before) // 2):
        captured = said(1, *command)
    assert captured.out.startswith("INCOMPLETE: ")
    (kept,) = set(tmp_path.iterdir()) - {out}
    with McapFile(kept) as log:
        held = [item for item in log.messages(set(log.channels)) if isinstance(item, RawMessage)]
        topics = {log.channels[item.channel].topic for item in held}
    assert f"File too large (its first {len(held)} messages are in {kept}); " in captured.err
    assert captured.err.count("\n") == 1
    assert topics >= {"/nav/disparity", "/nav/points", "/nav/elevation_map"}
    assert out.read_bytes() == before


def test_a_closed_pipe_does_not_change_the_exit_code(traverse):
    command = f"{sys.executable} -m flow info {traverse} | true; exit ${{PIPESTATUS[0]}}"
    assert subprocess.run(["bash", "-c", command], cwd=ROOT, stderr=subprocess.PIPE).returncode == 0


SLOW = """
source: {use: recordings.McapSource}
streams:
  stereo: {use: flow.align.pair, left: left, right: right}
  late:   {use: tests.slow.Nap, frame: stereo}
  matched: {use: stages.Match, frame: late, disparities: 64}
sinks: [{use: recordings.McapSink, results: [matched]}]
"""


def test_an_interrupt_leaves_a_readable_result_and_exits_130(traverse, tmp_path):
    pipeline, out = tmp_path / "slow.yaml", tmp_path / "out.mcap"
    pipeline.write_text(SLOW)
    arguments = ["run", traverse, "-p", pipeline, "-o", out, "--no-rrd", "--workers", "1"]
    command = [sys.executable, "-m", "flow", *map(str, arguments)]
    child = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    until = time.monotonic() + 60
    while not list(tmp_path.glob("*.partial")) and time.monotonic() < until:
        time.sleep(0.05)
    time.sleep(0.5)
    child.send_signal(signal.SIGINT)
    _, stderr = child.communicate(timeout=60)
    assert child.returncode == 130, stderr
    assert b"Traceback" not in stderr
    assert 1 <= len(raw_messages(out)) < 3 * FRAMES + 1
    assert not list(tmp_path.glob("*.partial"))


def test_an_interrupted_demo_reports_its_files_and_stops(traverse, tmp_path, said, monkeypatch):
    written = McapSink.write

    def interrupted(sink, record):
        written(sink, record)
        if record.index == 0:
            os.kill(os.getpid(), signal.SIGINT)

    folder = tmp_path / "demo"
    monkeypatch.setattr("flow.cli.commands.demo.simulate", lambda log, frames: log.write_bytes(traverse.read_bytes()))
    monkeypatch.setattr(McapSink, "write", interrupted)
    assert f"{folder / 'result.mcap'} (" in said(130, "demo", "--out", folder).out.splitlines()[-2]
    assert {path.name for path in folder.iterdir()} == {"traverse.mcap", "result.mcap", "result.rrd", "summary.json"}
    assert json.loads((folder / "summary.json").read_text())["interrupted"]


@pytest.mark.slow
def test_the_demo_says_beforehand_how_much_it_writes(tmp_path, said):
    folder = tmp_path / "demo"
    printed = said(0, "demo", "--out", folder, "--frames", 8).out
    stated = re.fullmatch(r"The demo writes about (\d+) MB to .*", printed.splitlines()[0])
    written = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
    assert written == pytest.approx(int(stated[1]), rel=0.15)


def test_an_interrupt_inside_compiled_code_is_an_interrupt(traverse, said, monkeypatch):
    def compiled(*arguments, **more):
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr("flow.cli.commands.run.replay", compiled)
    interrupted = said(130, "run", traverse, "-o", traverse.with_name("interrupted.mcap"))
    assert interrupted.err == "roverflow: interrupted\n"


ON_IMPORT = """
sys.addaudithook(lambda event, what: event == "import" and what[0] == "{}" and os.kill(os.getpid(), signal.SIGINT))
"""
AT_EXIT = "atexit.register(os.kill, os.getpid(), signal.SIGINT)"


@pytest.mark.parametrize("moment", [ON_IMPORT.format("flow.cli.report"), AT_EXIT, *slow(ON_IMPORT.format("numpy"))])
def test_an_interrupt_at_start_or_exit_prints_no_traceback(moment):
    heard = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # what runs in the background may ignore it
    code = f"import atexit, os, signal, sys\n{heard}\n{moment}\nimport flow.__main__"
    done = subprocess.run([sys.executable, "-c", code, "graph"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == (0 if moment == AT_EXIT else 130)  # at the exit all is done
    assert done.stderr == ("" if moment == AT_EXIT else "roverflow: interrupted\n")


def test_an_abandoned_stage_at_work_neither_delays_nor_breaks_the_exit():
    code = """
import atexit, sys, threading, time
from flow.cli import __main__ as program, main as cli
def abandoned():
    threading.Thread(target=time.sleep, args=(60,), daemon=True, name="worker-0").start()
    print("INCOMPLETE")
    return 130
cli.main = abandoned
atexit.register(print, "the interpreter is torn down")  # under native code that is at work
sys.exit(program.program())
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout) == (130, "INCOMPLETE\n")


@pytest.mark.parametrize("closed", ["stdout", *slow("stderr")])
def test_the_program_works_without_stdout_or_stderr(traverse, tmp_path, closed):
    arguments = ["run", traverse, "-p", "fast", *SMALL, "-o", tmp_path / "out.mcap", "--no-rrd", "--end", "0.8"]
    command = ["bash", "-c", f'"$@" {"" if closed == "stdout" else "2"}>&-', "bash"]
    command += [sys.executable, "-m", "flow", *map(str, arguments)]
    assert subprocess.run(command, cwd=ROOT, capture_output=True).returncode == 0
    assert raw_messages(tmp_path / "out.mcap")


def test_help_imports_nothing_heavy():
    heavy = "print(sorted({'numpy', 'cv2'} & set(sys.modules)))"
    code = f"import sys; from flow.cli.main import parser; parser().format_help(); {heavy}"
    assert subprocess.check_output([sys.executable, "-c", code], cwd=ROOT, text=True).strip() == "[]"


@pytest.mark.parametrize("form", ["text", "mermaid", "svg"])
def test_graph_draws_every_stream(form, said):
    drawn = said(0, "graph", "--format", form).out
    for stream in ("stereo", "tilt", "disparity", "points", "elevation_map", "navigation_map"):
        assert stream in drawn
    assert drawn.count("every stream of the frame") == (0 if form == "text" else 2)  # to the two sinks


def test_a_stream_may_have_the_name_of_a_keyword_of_mermaid(tmp_path, said):
    text = (ROOT / "flow" / "pipelines" / "paper.yaml").read_text()
    (tmp_path / "own.yaml").write_text(re.sub(r"\bstereo\b", "end", text))
    assert "  s0[end<br/>flow.align.pair]" in said(0, "graph", "-p", tmp_path / "own.yaml", "--format", "mermaid").out


def test_graph_shows_what_is_set(said):
    drawn = said(0, "graph", "--set", "disparities=128", "--set", "rover.max_slope=25deg").out
    assert all(shown in drawn for shown in ("disparities=128", "smooth=100 ms)", "rover.max_slope=25 deg)"))


def test_stages_lists_every_stage_and_describes_one_or_a_data_type(said, refused):
    listed = said(0, "stages").out
    assert all(f"  {use} " in listed for use in ("stages.Match", "flow.align.pair", "recordings.McapSink"))
    for name, shown in {
        "Clean": "max_range = 8 m  (float, 10 cm to 200 m)\n      horizontal range wanted in the map",
        "Match": "max_depth = 0  (float, m, at least 0)\n",
        "Disparity": "fields:\n  stamp: Nanoseconds.\n  pixels: (H, W) float32, px, NaN = unknown.\n",
        "PointCloud": "\n  points: (N, 3) float32. Metres, in `frame_id`.\n",
        "tests.slow.Nap": "tests.slow.Nap (stage): Passes frames on after a second.\ninputs:\n  frame: StereoFrame\n",
    }.items():
        assert shown in said(0, "stages", name).out
    assert refused("stages", "Mtach").endswith("did you mean 'Match'?\n")


@pytest.mark.parametrize("name", ["rover", "fast", "accurate", "paper"])
def test_a_printed_pipeline_is_a_pipeline_to_start_from(name, tmp_path, said):
    copy = tmp_path / "mine.yaml"
    copy.write_text(said(0, "pipeline", name).out)
    mine, shipped = (said(0, "graph", "-p", which).out.splitlines() for which in (copy, name))
    assert mine[1:] == shipped[1:]


def test_a_log_that_a_graph_wrote_in_python_is_a_result_like_others(traverse, tmp_path, said):
    pipeline, out = load("fast", ["disparities=64"]), tmp_path / "out.mcap"
    with pipeline.source.open(traverse, start=None, end=None) as log:
        run(pipeline, log, {"recordings.McapSink": out})
    made = "This is a result of roverflow of unknown version: pipeline fast, run on a log that it does not name."
    assert made in said(0, "info", out).out
    plain = tmp_path / "plain.mcap"
    assert roverflow("run", traverse, "-p", "fast", *SMALL, "--no-rrd", "-o", plain) == 0
    for one, other in ((out, plain), (plain, out)):
        assert "equal: all " in said(0, "diff", one, other).out
    assert "run the log that they were made from, which it does not name" in said(2, "run", out).err
    assert said(0, "verify", out, "--log", traverse)


def test_debug_may_stand_before_the_command(said):
    assert said(0, "--debug", "graph", "-p", "fast").out == said(0, "graph", "-p", "fast").out
