"""Refusals of the command line: one sentence with what, where and the remedy, before anything is written."""

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import rerun

from flow.cli.commands.demo import check_folder
from flow.cli.replay import replay
from flow.config.loader import pipeline_file
from flow.errors import SinkError, UsageError
from recordings import RerunSink
from recordings.scoring.result_log import about_run, pipeline_of
from recordings.sinks.overwrite import is_ours
from tests.conftest import SMALL, rewrite, roverflow, write_mcap
from tests.recordings.importers.middlebury_scene import write_scene

ROOT = Path(__file__).parent.parent
OPTIONS = "--help lists the options, and --set STREAM.PARAM=VALUE changes the pipeline"
TAKEN = "exists and is not a roverflow {}; choose another name or remove it"


def drop(*parts: str):
    return lambda topic, index, data: None if any(part in topic for part in parts) else data


@pytest.mark.parametrize(("change", "words"), [
    (drop("/imu", "/truth"), "tilt"),
    (drop("camera_info"), "CameraInfo"),
    (drop("/right"), "only one image topic"),
    (drop("/tf_static"), "tf_static"),
    (drop("/"), "no messages"),
    (lambda topic, index, data: data.replace(b"\0rgb8\0", b"\0xyzw\0"), "encoding 'xyzw' is not supported"),
], ids=["no tilt", "no calibration", "one camera", "no mounting", "nothing", "an encoding nobody reads"])  # fmt: skip
def test_an_incomplete_log_is_refused_in_one_sentence(traverse, tmp_path, refused, change, words):
    log = rewrite(traverse, tmp_path / "lacking.mcap", change)
    assert words in refused("run", log, "-o", tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [log]


def test_an_invalid_setting_is_quoted_as_written(traverse, tmp_path, said):
    words = ("run", traverse, "--set", "rover.max_slope=95deg", "-o", tmp_path / "out.mcap")
    for more in ((), ("--debug",)):  # which shows the way there, and changes no exit code
        printed = said(2, *words, *more).err
        assert "must be at most 89 deg, not 95deg" in printed.splitlines()[-1]
        assert ("Traceback" in printed) == bool(more)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["-o", "--rrd", "--summary", "--json"])
def test_an_input_is_never_overwritten(traverse, result, tmp_path, refused, option):
    before = traverse.stat()
    (tmp_path / "link").symlink_to(traverse)
    scoring, running = ("score", result, "--truth", traverse), ("run", traverse, "-o", tmp_path / "out.mcap")
    for name in (traverse, tmp_path / "link"):
        words = scoring if option == "--json" else running
        assert "is an input of this command" in refused(*words, option, name)
    assert traverse.stat() == before


OF_OTHERS = {
    "notes.md": "mine", "bare": "mine", "table.json": "{}", "list.json": "[1]", "frames.json": '{"frames_in": 3}',
    "open.json": '{"verdict": "COMPLETE", "frames_in": 3,', "deep.json": '{"a":' + "[" * 100_000,
    "theirs.rrd": "RRF2 theirs", "noise.mcap": "noise", "theirs.mcap": "",
}  # fmt: skip


@pytest.mark.parametrize("name", OF_OTHERS)
def test_an_output_never_replaces_a_file_of_another_kind(traverse, result, tmp_path, refused, name):
    mine, run = tmp_path / name, ["run", traverse, "-o", tmp_path / "o.mcap"]
    mine.write_text(OF_OTHERS[name])
    if name == "theirs.mcap":
        write_mcap(mine, [])
    before = mine.read_bytes()
    for kind, command in (
        ("input log", ["simulate", mine, "--frames", 1]), ("input log", ["import", "middlebury", tmp_path, mine]),
        ("result log", ["run", traverse, "-o", mine]),
        ("recording", [*run, "--rrd", mine]), ("summary", [*run, "--summary", mine]),
        ("score", ["score", result, "--truth", traverse, "--json", mine]),
    ):  # fmt: skip
        assert refused(*command) == f"roverflow: {mine} {TAKEN.format(kind)}\n"
    assert mine.read_bytes() == before


def test_an_output_replaces_only_an_earlier_one_of_its_kind(traverse, result, tmp_path):
    score = tmp_path / "score.json"
    assert roverflow("score", result, "--truth", traverse, "--json", score) == 0
    files = {
        "input log": traverse, "result log": result, "recording": result.with_suffix(".rrd"),
        "summary": result.with_suffix(".json"), "score": score,
    }  # fmt: skip
    (tmp_path / "empty").touch()
    for kind in files:
        assert [other for other, file in files.items() if is_ours(file, kind)] == [kind]
        assert is_ours(tmp_path / "empty", kind)


def test_a_recording_of_another_program_is_none_of_ours(tmp_path):
    sink, recording = RerunSink(), tmp_path / "out.rrd"
    sink.open(recording, {}, {"log": "traverse.mcap", "pipeline": "# a line of many\n" * 5000})
    sink.close({"verdict": "COMPLETE"})
    assert is_ours(recording, "recording")
    with rerun.RecordingStream("theirs") as theirs:
        theirs.set_sinks(rerun.FileSink(str(tmp_path / "theirs.rrd")))
        theirs.log("picture", rerun.TextDocument("mine"))
    assert not is_ours(tmp_path / "theirs.rrd", "recording")


def test_the_demo_refuses_a_folder_with_other_files(traverse, tmp_path, refused):
    for name, content in (("notes.txt", b"mine"), ("traverse.mcap", b"theirs"), ("maps/mine.tif", b"mine")):
        folder = tmp_path / name.replace("/", "-")
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_bytes(content)
        assert "not from an earlier demo; choose another folder" in refused("demo", "--out", folder, "--frames", 1)
        assert (folder / name).read_bytes() == content
    with pytest.raises(UsageError, match="is a file; give the name of a folder"):
        check_folder(tmp_path / "notes.txt" / "notes.txt")
    folder = tmp_path / "earlier"
    folder.mkdir()
    check_folder(folder)
    (folder / "traverse.mcap").write_bytes(traverse.read_bytes())
    check_folder(folder)
    (folder / "maps").mkdir()
    with pytest.raises(UsageError):
        check_folder(folder)
    (folder / "summary.json").touch()
    check_folder(folder)


@pytest.mark.parametrize(("option", "name", "words"), [
    ("-o", "nowhere/out.mcap", "there is no folder"),
    *((option, "taken", "taken is a folder or a device") for option in ("-o", "--rrd", "--summary")),
    *((option, "out.mcap", "is given for two outputs") for option in ("--rrd", "--summary")),
])  # fmt: skip
def test_an_impossible_output_is_refused_before_anything_runs(traverse, tmp_path, refused, option, name, words):
    (tmp_path / "taken").mkdir()
    assert words in refused("run", traverse, "-o", tmp_path / "out.mcap", option, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_an_output_that_cannot_be_opened_keeps_earlier_results(traverse, result, tmp_path, said, monkeypatch):
    out, rrd = tmp_path / "out.mcap", tmp_path / "out.rrd"
    out.write_bytes(result.read_bytes())
    monkeypatch.setattr("recordings.sinks.rerun_recording.RESERVED_BYTES", 1 << 62)
    assert "MB more can be written" in said(1, "run", traverse, *SMALL, "-o", out, "--rrd", rrd).err
    assert list(tmp_path.iterdir()) == [out]
    assert out.read_bytes() == result.read_bytes()


@pytest.mark.parametrize("bounds", [("--end", "0"), ("--start", "2.1"), ("--start", "0.1", "--end", "0.2")])
def test_a_range_without_images_is_refused(traverse, result, tmp_path, refused, bounds):
    out = tmp_path / "out.mcap"
    out.write_bytes(result.read_bytes())
    why = refused("run", traverse, *SMALL, "-o", out, "--no-rrd", *bounds)
    assert "has no image on /stereo/left/image_rect_color from" in why
    assert out.read_bytes() == result.read_bytes()


@pytest.mark.parametrize("linked", [False, True])
def test_a_failed_export_does_not_block_the_next(result, tmp_path, said, monkeypatch, linked):
    folder = tmp_path / "maps"
    if linked:
        (tmp_path / "disk").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "disk")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("recordings.export.point_files.write_ply", full)
        assert "No space left on device" in said(1, "export", result, folder).err
    assert folder.exists() == linked
    assert not linked or folder.stat().st_mode & 0o777 == 0o700
    assert roverflow("export", result, folder) == 0


@pytest.mark.parametrize(("option", "value", "printed"), [
    ("--slope", "80", "--slope must be at most 45 deg, not 80 deg"),
    ("--size", "1x20", "the width of --size must be at least 16 px, not 1 px"),
    ("--odometry-scale", "300", "--odometry-scale must be at most 100 %, not 300 %"),
    ("--rocks", "nan", "--rocks must be a finite number"),
])  # fmt: skip
def test_a_simulation_beyond_its_limits_is_refused_by_option(tmp_path, refused, option, value, printed):
    assert re.search(printed, refused("simulate", tmp_path / "log.mcap", option, value))
    assert not list(tmp_path.iterdir())


def test_a_log_given_twice_is_one_log(traverse, fast_result, tmp_path):
    out = tmp_path / "out.mcap"
    assert roverflow("run", traverse, traverse, "-p", "fast", *SMALL, "-o", out, "--no-rrd") == 0
    assert out.read_bytes() == fast_result.read_bytes()


SIZE = "must be a number with MB, GB or TB, at least 500MB, such as 4GB, not"
SECONDS = "must be seconds after the log's first message"


@pytest.mark.parametrize(("option", "value", "printed"), [
    ("--workers", "0", "must be a whole number of at least 1, not '0'"),
    ("--workers", "9" * 20, "must be at most 1024"),
    ("--start", "1e300", "at most 9e+09"),
    ("--every", "0", "must be a whole number of frames of at least 1, such as 2, or a length above 0 m, such as 0.5m"),
    ("--every", "infm", "not 'infm'"),
    *(("--start", odd, SECONDS) for odd in ("nan", "inf", "-1", "soon")),
    *(("--memory", odd, f"{SIZE} '{odd}'") for odd in ("lots", "4", "0GB", "-1GB", "GB", "499MB")),
])  # fmt: skip
def test_an_impossible_number_is_refused(traverse, tmp_path, option, value, printed, capsys):
    command = ("fleet", traverse, "--out") if option == "--memory" else ("run", traverse, "-o")
    with pytest.raises(SystemExit, match="2"):
        roverflow(*command, tmp_path / "out.mcap", f"{option}={value}")
    assert printed in capsys.readouterr().err


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder in which nobody can write")
def test_every_command_reports_an_unwritable_path_alike(traverse, result, tmp_path, said):
    scene = write_scene(tmp_path / "scenes" / "Box")
    (tmp_path / "cam.yaml").write_text("{fx: 100, cx: 10, cy: 10, baseline: 0.1}")
    (tmp_path / "x.rrd").symlink_to(result.with_suffix(".rrd"))
    images = ("images", scene, "/proc/x.mcap", "--calibration", tmp_path / "cam.yaml", "--pitch-down", 20)
    for command in (
        ("run", traverse, *SMALL, "-o", "/proc/x.mcap", "--no-rrd"), ("simulate", "/proc/x.mcap", "--frames", 1),
        ("import", *images, "--height", 1), ("import", "middlebury", scene, "/proc/x.mcap"),
        ("score", result, "--truth", traverse, "--json", "/proc/x.json"),
        ("export", result, "/proc/x"), ("demo", "--out", "/proc/x"), ("fleet", traverse, "--out", "/proc/x"),
        ("desk", tmp_path / "x.rrd", "--out", "/proc"),
        ("try", traverse, "--at", 0, "-p", "fast", "--set", "disparities=32", "-o", "/proc/x.rrd"),
        ("run", traverse, *SMALL, "-o", tmp_path / "out.mcap", "--no-rrd", "--summary", "/proc/x.json"),
    ):  # fmt: skip
        output, printed = said(1, *command)
        assert not output  # it is said before the work
        assert "cannot write /proc/x" in printed
        assert printed.count("/proc/x") == 1
        assert "; choose another folder for the output" in printed
        assert printed.count("\n") == 1


def test_the_remedy_for_a_long_name_is_a_shorter_one(traverse, tmp_path, said):
    printed = said(1, "run", traverse, *SMALL, "-o", tmp_path / f"{'a' * 250}.mcap", "--no-rrd")[1]
    assert "File name too long; choose a shorter name\n" in printed


def test_a_full_disk_is_reported_in_one_sentence():
    """A disk that is full where the drawing of a graph is sent to."""
    code = "import sys; from flow.cli.main import main; sys.exit(main(['graph']))"
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert done.returncode == 1
    assert done.stderr.startswith("roverflow: stdout: No space left on device")


@pytest.mark.parametrize(("key", "topic", "there"), [
    ("odometry", "/nix", "its pose topics are /odometry"),
    ("odometry", "/stereo/left/camera_info", "its pose topics are /odometry"),
    ("left", "/nix", "its image topics are /stereo/left/image_rect_color"),
    ("inclinometer", "/nix", "its tilt topics are /imu"),
    ("inclinometer", "/odometry", "its tilt topics are /imu"),
])  # fmt: skip
def test_a_topic_that_is_set_but_absent_is_refused(traverse, tmp_path, refused, key, topic, there):
    printed = refused("run", traverse, "--set", f"source.{key}={topic}", "-o", tmp_path / "out.mcap")
    assert f"the source's '{key}' is set to {topic}, which is not a suitable topic of the log ({there}" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("field", "words"), [
    ("orientation.xx", "no 'xx' in its geometry_msgs/msg/Quaternion (it has x, y, z, w)"),
    ("orientation", "field 'orientation' contains a geometry_msgs/msg/Quaternion, which is not a number"),
    ("header.frame_id", "which is not a number"),
])  # fmt: skip
def test_angles_of_an_absent_field_are_refused_before_the_run(traverse, tmp_path, refused, field, words):
    imu, other = "/imu/inclinometer", "orientation.x"
    angles = [
        f"--set=source.{key}={{field: {name}, unit: deg, sign: 1}}" for key, name in (("pitch", field), ("roll", other))
    ]
    angles += ["--set=source.tilt_model=axis", f"--set=source.inclinometer={imu}"]
    printed = refused("run", traverse, *angles, "-o", tmp_path / "out.mcap")
    assert f"the bare angles of {imu}: " in printed
    assert words in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", [
    "run", "info", "report", "diff PIPE", "try --at 0 --set a=1 --result PIPE", "desk",
])  # fmt: skip
def test_a_pipe_is_refused(tmp_path, refused, command):
    os.mkfifo(tmp_path / "pipe")
    words = command.replace("PIPE", str(tmp_path / "pipe")).split()
    what = "a recording" if command == "desk" else "a log"
    assert f"pipe is a pipe or a device; give {what}" in refused(*words, tmp_path / "pipe")


@pytest.mark.parametrize(("settings", "printed"), [
    (["max_range=1km"], "stages.Clean.max_range: must be at most 200 m, not 1km"),
    (["cells.max_range=100m", "cells.resolution=2cm"], "makes a map 10000 cells of 0.02 m wide; the limit is 4000"),
    (["regional_cells.max_range=200m"], "makes a map 8000 cells of 0.05 m wide; the limit is 4000"),
    (["regional_elevation.window=400m"], "stages.MapRegion.window: must be at most 200 m, not 400m"),
])  # fmt: skip
def test_maps_beyond_memory_are_refused_before_the_run(settings, printed, refused):
    assert printed in refused("graph", *(f"--set={setting}" for setting in settings))


@pytest.mark.parametrize(("sinks", "printed"), [
    (["tests.flow.toys.Keep"], "tests.flow.toys.Keep writes .txt files, but a run writes only .mcap and .rrd files"),
    (["recordings.McapSink", "another.Another"], "several sinks write .mcap files, but a run writes only one"),
])  # fmt: skip
def test_a_sink_without_an_output_is_refused(traverse, tmp_path, refused, sinks, printed):
    if "another.Another" in sinks:
        (tmp_path / "another.py").write_text("from recordings import McapSink\nclass Another(McapSink):\n    pass\n")
    listed = ", ".join(f"{{use: {use}}}" for use in sinks)
    shipped = (ROOT / "flow" / "pipelines" / "paper.yaml").read_text()
    (tmp_path / "own.yaml").write_text(f"{shipped.partition('sinks:')[0]}sinks: [{listed}]\n")
    assert printed in refused("run", traverse, "-p", tmp_path / "own.yaml", "-o", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(("sink", "options", "printed"), [
    ("McapSink", ("--rrd", "a.rrd", "--desk", "tilt"), "no sink that writes .rrd files; leave out --rrd and --desk"),
    ("McapSink", ("--serve",), "no sink that writes .rrd files; leave out --serve"),
    ("RerunSink", ("-o", "a.mcap", "--with-inputs"), "writes .mcap files; leave out --out and --with-inputs"),
    ("RerunSink", ("--profile", "foxglove"), "no sink that writes .mcap files; leave out --profile"),
    ("RerunSink", ("--no-rrd",), "the pipeline writes only .rrd files, and the run is to write none"),
])  # fmt: skip
def test_options_of_an_output_that_the_pipeline_does_not_write_are_refused(
    traverse, tmp_path, refused, monkeypatch, sink, options, printed
):
    monkeypatch.chdir(tmp_path)
    shipped = (ROOT / "flow" / "pipelines" / "paper.yaml").read_text()
    (tmp_path / "own.yaml").write_text(f"{shipped.partition('sinks:')[0]}sinks: [{{use: recordings.{sink}}}]\n")
    assert printed in refused("run", traverse, "-p", "own.yaml", *options)
    assert [file.name for file in tmp_path.iterdir()] == ["own.yaml"]


def test_recordings_of_a_fleet_whose_pipeline_writes_none_are_refused(traverse, tmp_path, refused):
    shipped = (ROOT / "flow" / "pipelines" / "paper.yaml").read_text()
    (tmp_path / "own.yaml").write_text(f"{shipped.partition('sinks:')[0]}sinks: [{{use: recordings.McapSink}}]\n")
    why = refused("fleet", traverse, "-p", tmp_path / "own.yaml", "--out", tmp_path / "all", "--rrd")
    assert "the pipeline has no sink that writes .rrd files; leave out --rrd" in why


def test_a_run_whose_streams_no_result_log_contains_is_refused(traverse, tmp_path, refused):
    (tmp_path / "own.yaml").write_text("""
source: {use: recordings.McapSource}
streams:
  stereo: {use: flow.align.pair, left: left, right: right}
  own:    {use: stages.Match, frame: stereo, disparities: 64}
sinks: [{use: recordings.McapSink}]
""")
    why = refused("run", traverse, "-p", tmp_path / "own.yaml", "-o", tmp_path / "out.mcap")
    assert "recordings.McapSink writes none of the streams stereo, own; name some in its 'also', or leave it out" in why


@pytest.mark.parametrize("workers", [0, 10**9])
def test_a_run_of_python_without_workers_or_with_too_many_is_refused(traverse, tmp_path, workers):
    with pytest.raises(UsageError, match=f"a run needs 1 to 1024 workers, not {workers}"):
        replay(traverse, "rover", tmp_path / "out.mcap", None, workers=workers)


def test_a_run_of_python_takes_a_number_of_frames(traverse, tmp_path):
    assert replay(traverse, "fast", tmp_path / "out.mcap", None, overrides=["disparities=64"], every=2)[
        "frames_left_out"
    ]


def test_names_of_logs_and_pipelines_need_not_be_unicode(traverse, tmp_path, refused):
    log, own = (tmp_path / os.fsdecode(name) for name in (b"Fahrt-s\xfcd.mcap", b"s\xfcd.yaml"))
    os.link(traverse, log)
    own.write_text(pipeline_file("fast").read_text())
    result = log.with_name(f"{log.stem}-nav.mcap")
    for stream in (sys.stdout, sys.stderr):  # as the program's start does
        stream.reconfigure(errors="backslashreplace")
    assert roverflow("run", log, "-p", own, *SMALL, "--end", 0.6) == 0
    assert not list(tmp_path.glob("*.partial"))
    assert (about_run(result)["log"], pipeline_of(result)) == ("Fahrt-s\\udcfcd.mcap", "s\\udcfcd")
    assert roverflow("verify", result) == 0
    assert roverflow("report", result) == 0
    assert roverflow("try", log, "--at", 0.5, "-p", own, *SMALL, "--set", "disparity.max_step=0") == 0
    assert "-nav.rrd, whose name is not Unicode; rename it" in refused("desk", result.with_suffix(".rrd"))


def test_a_pipeline_of_nested_aliases_is_refused_at_once(tmp_path, refused):
    lines = [f"a0: &a0 {['x'] * 9}", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10))]
    (tmp_path / "bomb.yaml").write_text("\n".join(lines))
    why = refused("graph", "-p", tmp_path / "bomb.yaml")
    assert "bomb.yaml:1: too large after expanding YAML aliases (limit: 100000 values)" in why


@pytest.mark.parametrize(("command", "usage", "name", "remedy"), [
    ("rnu a.mcap", "", "argument COMMAND: invalid choice: 'rnu'", "did you mean 'run'?"),
    ("frobnicate", "", "argument COMMAND: invalid choice: 'frobnicate' (choose from", ")"),
    ("import kiti a", " import", "argument KIND: invalid choice: 'kiti'", "; did you mean 'kitti'?"),
    ("run a --desk til", " run", "argument --desk: invalid choice: 'til'", "; did you mean 'tilt'?"),
    ("export a.mcap b --mpa x", " export", "unknown: --mpa x", "; did you mean '--map'?"),
    ("run a b --recording x", " run", "unknown: --recording x", f"; roverflow run {OPTIONS}"),
    ("run a b --ever 2 --sumary s.json", " run", "unknown: --sumary s.json", "; did you mean '--summary'?"),
    ("score a.mcap -x", " score", "unknown: -x", "; roverflow score --help lists the options"),
])  # fmt: skip
def test_an_unknown_name_is_answered_with_the_usage_and_the_nearest(command, usage, name, remedy, capsys):
    with pytest.raises(SystemExit, match="2"):
        roverflow(*command.split())
    printed = capsys.readouterr().err
    assert printed.startswith(f"usage: roverflow{usage} [-h]")
    assert f"\nroverflow{usage}: error: {name}" in printed
    assert printed.endswith(f"{remedy}\n")


def test_an_unknown_pipeline_is_answered_with_templates_too(refused):
    printed = refused("pipeline", "rover_disparty")
    assert printed.startswith(
        "roverflow: no pipeline or template 'rover_disparty': neither a file nor one of accurate, "
    )
    assert printed.endswith("match_right, rover_disparity; did you mean 'rover_disparity'?\n")


def test_a_file_that_is_no_text_is_no_pipeline_to_print(tmp_path, refused):
    (tmp_path / "a.png").write_bytes(b"\x89PNG")
    assert "a.png is not text in UTF-8; give accurate, fast, paper, rover or a YAML file" in refused(
        "pipeline", tmp_path / "a.png"
    )


@pytest.mark.parametrize(("options", "printed"), [
    ("--fixes a.mcap", "--fixes needs --crs, such as --crs utm"),
    ("--merge --crs utm", "--merge merges regional maps in their own frame; leave out --frames, --map and --crs"),
])  # fmt: skip
def test_options_that_an_export_would_not_use_are_refused(result, tmp_path, refused, options, printed):
    assert printed in refused("export", result, tmp_path / "maps", *options.split())


def test_an_output_needs_the_ending_of_its_kind(traverse, fast_result, tmp_path, refused):
    out = tmp_path / "out.txt"
    why = refused("run", traverse, "-o", out)
    assert why.endswith("out.txt is not the name of a log; end it in .mcap\n")
    assert refused("simulate", out) == why
    assert "out.txt is not the name of a recording; end it in .rrd" in refused("run", traverse, "--rrd", out)
    assert "out.txt is not the name of a report; end it in .html" in refused("report", fast_result, "-o", out)
    why = refused("why", fast_result, "--at", "0", "--cell=2,0", "-o", out)
    assert "out.txt is not the name of a picture; end it in .png" in why


def test_a_pair_of_numbers_may_begin_with_a_minus(result, traverse, tmp_path, said):
    words = ("--log", traverse, "--at", 1, "--cell", "-1.2,0.4", "-o", tmp_path / "a.png")
    assert "cell (-1.175, 0.425) m" in said(0, "why", result, *words).out


@pytest.mark.parametrize(
    ("out", "rrd", "kind"), [("log.mcap", None, "result log"), ("new.mcap", "log.mcap", "recording")]
)
def test_a_run_of_python_replaces_no_file_that_no_run_wrote(traverse, tmp_path, monkeypatch, out, rrd, kind):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.mcap").write_bytes(traverse.read_bytes())
    with pytest.raises(SinkError, match=rf"log\.mcap: it exists and is not a roverflow {kind}"):
        replay("log.mcap", "fast", out, rrd, end=1)
    assert (tmp_path / "log.mcap").read_bytes() == traverse.read_bytes()
    assert [file.name for file in tmp_path.iterdir()] == ["log.mcap"]
