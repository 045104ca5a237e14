"""`roverflow run --resume` goes on where a run was stopped or killed, and its outputs are those of a whole run."""

import os
import shutil
import signal
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import rerun as rr

from flow.cli import checkpoint_file
from flow.cli.replay import replay
from flow.config.templates import SHIPPED
from flow.errors import SinkError, UsageError
from recordings.errors import UnwritableError
from recordings.simulator import Simulation, write_log

FRAMES, STOP_AFTER = 7, 2
OVERRIDES = ["disparities=32"]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A short traverse."""
    path = tmp_path_factory.mktemp("log") / "traverse.mcap"
    write_log(Simulation(frames=FRAMES, width=160, height=120, relief_cells=256, seed=3), path)
    return path


@pytest.fixture(scope="module")
def whole(log, tmp_path_factory):
    """The result log of a run that was not stopped; its recording is beside it."""
    return run(log, tmp_path_factory.mktemp("whole"), resume=False, draw=True)[0]


@pytest.fixture(autouse=True)
def _checkpoint_after_each_frame(monkeypatch):
    monkeypatch.setattr(checkpoint_file, "INTERVAL", 0.0)
    monkeypatch.setattr(checkpoint_file, "MAX_SHARE", 1e9)


def run(log, folder, resume=True, draw=False, **options):
    """(the result log, the summary) of a run."""
    out = folder / "nav.mcap"
    options = {"overrides": OVERRIDES, "on_frame": lambda complete: None, **options}
    return out, replay(log, "fast", out, out.with_suffix(".rrd") if draw else None, resume=resume, **options)


def after(frames, act):
    """What calls `act` after some frames."""
    through = []

    def advance(complete):
        through.append(complete)
        if len(through) == frames:
            act()

    return advance


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


def drawn(recording):
    """Entity -> the frames that it was logged at, without what is logged once and the times of the work."""
    frames = Counter()
    for chunk in rr.chunk.RrdReader(str(recording)).stream():
        path, columns = chunk.entity_path, chunk.to_record_batch().to_pydict()
        if "frame" in columns and not path.startswith(("/seconds", "/queues")):
            frames.update((path, number) for number in columns["frame"])
    return Counter({key: count for key, count in frames.items() if not key[0].endswith(("scale", "legend", "text"))})


def names(folder):
    return sorted(path.name for path in Path(folder).iterdir())


def test_an_interrupted_run_goes_on_to_the_outputs_of_a_whole_one(log, whole, stopped):
    assert names(stopped) == ["nav.mcap", "nav.mcap.checkpoint", "nav.rrd"]
    out, summary = run(log, stopped, draw=True)
    assert (summary["verdict"], summary["frames_through"]) == ("COMPLETE", FRAMES)
    assert STOP_AFTER - 1 <= summary["frames_resumed"] < FRAMES
    assert names(stopped) == ["nav.mcap", "nav.rrd"]
    assert out.read_bytes() == whole.read_bytes()
    assert drawn(out.with_suffix(".rrd")).keys() >= drawn(whole.with_suffix(".rrd")).keys()


def test_a_run_that_is_stopped_again_before_its_first_checkpoint_goes_on(log, whole, stopped, monkeypatch):
    monkeypatch.setattr(checkpoint_file, "INTERVAL", 1e9)
    for _ in range(2):
        _, summary = run(log, stopped, draw=True, on_frame=after(STOP_AFTER, interrupt))
        assert (summary["interrupted"], names(stopped)) == (True, ["nav.mcap", "nav.mcap.checkpoint", "nav.rrd"])
    out, summary = run(log, stopped, draw=True)
    assert out.read_bytes() == whole.read_bytes()
    assert drawn(out.with_suffix(".rrd")).keys() >= drawn(whole.with_suffix(".rrd")).keys()


@pytest.mark.parametrize("options", [{"with_inputs": True}, {"profile": "foxglove", "draw": True}])
def test_a_killed_run_goes_on_to_the_outputs_of_a_whole_one(log, tmp_path, options, monkeypatch):
    keep = checkpoint_file.CheckpointFile.keep

    def kill(file, checkpoint):
        keep(file, checkpoint)
        if file.path.parent == tmp_path / "run" and not (tmp_path / "killed").exists():
            shutil.copytree(tmp_path / "run", tmp_path / "killed")  # what a kill would leave

    for folder in ("whole", "run"):
        (tmp_path / folder).mkdir()
    wanted, _ = run(log, tmp_path / "whole", resume=False, **options)
    monkeypatch.setattr(checkpoint_file.CheckpointFile, "keep", kill)
    run(log, tmp_path / "run", **options)
    left = names(tmp_path / "killed")
    assert "nav.mcap.checkpoint" in left
    assert [name for name in left if name.endswith(".partial")]
    out, summary = run(log, tmp_path / "killed", **options)
    assert 0 < summary["frames_resumed"] < FRAMES
    assert out.read_bytes() == wanted.read_bytes()
    assert names(tmp_path / "killed") == names(tmp_path / "whole")


def test_a_run_without_a_checkpoint_begins_with_the_first_frame(log, whole, tmp_path):
    out, summary = run(log, tmp_path)
    assert (summary["frames_resumed"], names(tmp_path)) == (0, ["nav.mcap"])
    assert out.read_bytes() == whole.read_bytes()


@pytest.fixture(scope="module")
def interrupted(log, tmp_path_factory):
    """The folder of an interrupted run."""
    folder = tmp_path_factory.mktemp("interrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint_file, "INTERVAL", 0.0)
        patch.setattr(checkpoint_file, "MAX_SHARE", 1e9)
        run(log, folder, draw=True, on_frame=after(STOP_AFTER, interrupt))
    return folder


@pytest.fixture
def stopped(interrupted, tmp_path):
    """A copy of it."""
    return shutil.copytree(interrupted, tmp_path / "stopped")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (["--set", "disparities=64"], "--set changed since the run that {} continues"),
        (["-p", "rover"], "the pipeline file changed since"),
        (["--no-rrd", "--end", "2"], "--end and an output or its options changed since"),
        (["--rate", "2"], "--resume is for runs as fast as possible; leave out --rate"),
    ],
)
def test_another_run_is_not_continued(log, stopped, said, changed, sentence):
    same = [part for override in OVERRIDES for part in ("--set", override)]
    before = {path: path.read_bytes() for path in stopped.iterdir()}
    error = said(2, "run", log, "-p", "fast", "-o", stopped / "nav.mcap", *same, "--resume", *changed).err
    assert sentence.format(stopped / "nav.mcap.checkpoint") in error
    assert {path: path.read_bytes() for path in stopped.iterdir()} == before


def test_a_run_without_resume_begins_anew_and_removes_the_checkpoint(log, stopped):
    _, summary = run(log, stopped, resume=False, draw=True)
    assert (summary["frames_resumed"], names(stopped)) == (0, ["nav.mcap", "nav.rrd"])


def test_an_output_that_lacks_a_part_is_refused_and_stays(log, stopped):
    for name in ("nav.mcap", "nav.rrd"):
        content = (stopped / name).read_bytes()
        (stopped / name).unlink()
        with pytest.raises(SinkError, match=f"{name} lacks .* of the run that is to be resumed; run without --resume"):
            run(log, stopped, draw=True)
        (stopped / name).write_bytes(content[: len(content) // 3])
        with pytest.raises(SinkError, match=f"{name} lacks .* of the run that is to be resumed; run without --resume"):
            run(log, stopped, draw=True)
        assert (stopped / name).read_bytes() == content[: len(content) // 3]
        (stopped / name).write_bytes(content)
    assert run(log, stopped, draw=True)[1]["verdict"] == "COMPLETE"


def test_a_foreign_file_is_no_checkpoint(log, tmp_path, said):
    foreign = tmp_path / "nav.mcap.checkpoint"
    foreign.write_bytes(np.arange(9).tobytes())
    error = said(2, "run", log, "-o", tmp_path / "nav.mcap", "--resume").err
    assert error == (
        f"roverflow: {foreign} is not a checkpoint; remove it, or choose another name for the result log\n"
    )
    checkpoint_file.remove_checkpoint([tmp_path / "nav.mcap"])
    assert foreign.exists()


def test_a_checkpoint_that_is_cut_is_refused(log, stopped, said):
    checkpoint = stopped / "nav.mcap.checkpoint"
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    error = said(2, "run", log, "-p", "fast", "-o", stopped / "nav.mcap", "--resume").err
    assert error.startswith(f"roverflow: cannot read the checkpoint {checkpoint}: ")
    assert error.endswith("; run without --resume to begin with the first frame\n")


def test_a_checkpoint_that_cannot_be_written_does_not_stop_the_run(log, tmp_path, monkeypatch, capsys):
    (tmp_path / "nav.mcap.checkpoint").mkdir()
    monkeypatch.setattr(checkpoint_file.CheckpointFile, "_read", lambda file: None)
    _, summary = run(log, tmp_path)
    assert summary["verdict"] == "COMPLETE"
    assert capsys.readouterr().err.count("no further checkpoints: cannot write ") == 1


def test_two_runs_do_not_write_one_output(log, stopped):
    with (
        checkpoint_file.only_run_of(stopped / "nav.mcap"),
        pytest.raises(UnwritableError, match=r"nav\.mcap is being written by another run; wait for it, or stop it"),
    ):
        run(log, stopped, draw=True)
    assert run(log, stopped, draw=True)[1]["verdict"] == "COMPLETE"
    assert names(stopped) == ["nav.mcap", "nav.rrd"]


def test_what_a_kill_has_left_is_removed_with_the_checkpoint(log, stopped):
    for name in ("nav.mcap.1-ab.partial", "nav.rrd.1-ab.partial"):
        (stopped / name).touch()
    run(log, stopped, resume=False, draw=True)
    assert names(stopped) == ["nav.mcap", "nav.rrd"]


def test_what_a_run_of_another_name_is_writing_stays(tmp_path):
    own, other = tmp_path / "nav [3].mcap.1-ab.partial", tmp_path / "nav 3.mcap.1-ab.partial"
    for file in (own, other, checkpoint := tmp_path / "nav [3].mcap.checkpoint"):
        file.write_bytes(checkpoint_file._MAGIC)
    checkpoint_file.remove_checkpoint([tmp_path / "nav [3].mcap"])
    assert (own.exists(), other.exists(), checkpoint.exists()) == (False, True, False)


@pytest.mark.parametrize("name", ["beside_resumed.py", "package_resumed/inner/part.py"])
def test_a_changed_module_beside_the_pipeline_is_refused(log, tmp_path, name, monkeypatch):
    monkeypatch.setitem(sys.modules, "package_resumed", ModuleType("package_resumed"))  # is imported
    pipeline, module, out = tmp_path / "own.yaml", tmp_path / name, tmp_path / "nav.mcap"
    module.parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).parent.parent.joinpath("__init__.py").touch()
    pipeline.write_text((SHIPPED / "fast.yaml").read_text())
    module.write_text("VALUE = 1\n")
    options = {"overrides": OVERRIDES, "resume": True}
    replay(log, pipeline, out, None, on_frame=after(STOP_AFTER, interrupt), **options)
    module.write_text("VALUE = 2\n")
    with pytest.raises(UsageError, match="a module beside the pipeline file changed since the run that"):
        replay(log, pipeline, out, None, **options)
