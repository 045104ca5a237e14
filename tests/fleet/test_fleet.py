"""`roverflow fleet` and `roverflow list`: many logs, each once, with the bits of `roverflow run`."""

import json
import os
import re
import shutil
import signal
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import pytest
from distributed import Client

from flow.cli import checkpoint_file
from flow.cli.fleet.catalogue import Catalogue
from flow.cli.fleet.engine import Fleet, cluster
from flow.cli.fleet.jobs import jobs_of, reason_to_run
from flow.cli.fleet.page import write_fleet_page
from flow.cli.fleet.progress import Progress
from flow.cli.fleet.task import Pipeline, Task, _columns, remove_unfinished, run_task, unfit
from flow.errors import UsageError
from recordings.simulator import Simulation, write_log
from tests.conftest import chunks_of, rewrite, roverflow, with_broken

PIPELINE = ("-p", "fast", "--set", "disparities=48")
TRAP = """
import os, time
from dataclasses import dataclass
from stages import StereoFrame

@dataclass(frozen=True)
class Trap:
    def __call__(self, frame: StereoFrame) -> StereoFrame:
        width = frame.left.shape[1]
        if width == 160:
            os.kill(os.getpid(), 9)
        while width == 176:
            time.sleep(1)
        if width == 192:
            held = bytearray(8_000_000_000)
            held[::4096] = b"x" * len(held[::4096])
            time.sleep(60)
        return frame
"""
TRAPPED = """
source: {use: recordings.McapSource}
streams:
  stereo:    {use: flow.align.pair, left: left, right: right}
  passed:    {use: trap.Trap, frame: stereo}
  disparity: {use: stages.Match, frame: passed, disparities: 16}
sinks: [{use: recordings.McapSink, results: [disparity]}]
"""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Three logs of different length, one of them in a folder, and a file that is none."""
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "site").mkdir()
    for name, frames in (("a", 1), ("b", 2), ("site/c", 1)):
        write_log(Simulation(frames=frames, width=160, height=120, relief_cells=512), folder / f"{name}.mcap")
    (folder / "junk.mcap").write_text("this is no log")
    return folder


def rows_of(folder: Path) -> dict[str, dict]:
    return {row["name"]: row for row in Catalogue(folder).rows()}


def test_a_task_writes_what_run_writes_and_is_not_repeated(logs, tmp_path):
    (job,) = jobs_of([str(logs / "a.mcap")], tmp_path / "out")
    pipeline = Pipeline.of("fast", ("disparities=48",))
    task = Task(job, tmp_path / "out", pipeline, recording=False, workers=2)
    row = run_task(task)
    assert (row["state"], row["verdict"], row["frames"], row["result"]) == ("done", "COMPLETE", 1, "a-nav.mcap")
    assert roverflow("run", logs / "a.mcap", *PIPELINE, "--no-rrd", "-o", tmp_path / "plain.mcap") == 0
    assert task.result.read_bytes() == (tmp_path / "plain.mcap").read_bytes()
    written = task.result.stat().st_mtime_ns
    assert run_task(task) == row
    assert task.result.stat().st_mtime_ns == written
    assert reason_to_run(job, {**row, "result": row["result"]}, pipeline.digest, row["version"], tmp_path / "out") == ""
    assert reason_to_run(job, row, "other", row["version"], tmp_path / "out") == "of another pipeline"
    same = (pipeline.digest, row["version"], tmp_path / "out", True)
    assert reason_to_run(job, row, *same) == "without its recording"
    assert run_task(replace(task, recording=True))["result"] == "a-nav.mcap"
    assert reason_to_run(job, row, *same) == ""
    broken = run_task(replace(task, job=replace(job, name="junk", log=logs / "junk.mcap")))
    assert (broken["state"], "is not an MCAP log" in broken["why"]) == ("unusable", True)
    absent = run_task(replace(task, job=replace(job, name="nix", log=logs / "nix.mcap")))
    assert (absent["state"], "paths must mean the same on all machines" in absent["why"]) == ("failed", True)


STATES = """
from dataclasses import dataclass
from stages import StereoFrame

@dataclass(frozen=True)
class Locked:
    def start(self):
        return [lambda: None] if {locked} else []

    def __call__(self, frame: StereoFrame, *, state) -> StereoFrame:
        return frame
"""


def test_a_link_that_leads_nowhere_is_unusable_and_not_tried_again(tmp_path, said):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/gone.mcap").symlink_to("nowhere")
    (job,) = jobs_of([str(tmp_path / "logs")], tmp_path / "out")
    task = Task(job, tmp_path / "out", Pipeline.of("fast", ()), recording=False, workers=1)
    row = run_task(task)
    assert (row["state"], unfit(task)) == ("unusable", "")
    assert "gone.mcap: No such file or directory" in row["why"]
    assert reason_to_run(job, row, task.pipeline.digest, row["version"], task.folder) == ""


@pytest.mark.parametrize("ending", ["json", "progress"])
def test_a_task_replaces_no_file_of_others(logs, tmp_path, ending):
    (job,) = (job for job in jobs_of([str(logs)], tmp_path) if job.name == "a")
    task = Task(job, tmp_path, Pipeline.of("fast", ()), recording=False, workers=1)
    (other := tmp_path / f"a-nav.{ending}").write_text('{"waypoints": [1, 2, 3]}')
    row = run_task(task)
    assert (row["state"], row["why"]) == (
        "failed", f"{other} is not a file of a fleet; rename it, or choose another --out"
    )  # fmt: skip
    assert other.read_text() == '{"waypoints": [1, 2, 3]}'
    assert not task.result.exists()


def test_what_another_run_is_writing_stays(logs, tmp_path):
    (job,) = (job for job in jobs_of([str(logs)], tmp_path) if job.name == "a")
    task = Task(job, tmp_path, Pipeline.of("fast", ()), recording=False, workers=1)
    (partial := tmp_path / "a-nav.mcap.1-0.partial").touch()
    with checkpoint_file.only_run_of(task.result):
        row = run_task(task)
    assert (row["state"], row["why"].partition(" is being")[0]) == ("failed", str(task.result))
    assert partial.exists()
    assert run_task(task)["state"] == "done"
    assert not partial.exists()


def test_what_is_written_for_a_log_of_another_name_stays(logs, tmp_path):
    job = replace(jobs_of([str(logs / "a.mcap")], tmp_path)[0], name="a[1]")
    task = Task(job, tmp_path, Pipeline.of("fast", ()), recording=False, workers=1)
    own, other = tmp_path / "a[1]-nav.mcap.1-0.partial", tmp_path / "a1-nav.mcap.1-0.partial"
    for file in (own, other):
        file.touch()
    remove_unfinished(task)
    assert (own.exists(), other.exists()) == (False, True)


def test_a_name_that_is_too_long_is_a_failure_of_its_log_alone(logs, tmp_path):
    name = "L" * 240
    job = replace(jobs_of([str(logs / "a.mcap")], tmp_path)[0], name=name)
    row = run_task(Task(job, tmp_path, Pipeline.of("fast", ()), recording=False, workers=1))
    assert row["state"] == "failed"
    assert "-nav.mcap: File name too long" in row["why"]


def test_a_pipeline_takes_the_packages_beside_it_along(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "there"))
    (tmp_path / "there").mkdir()
    (tmp_path / "here/travelling/inner").mkdir(parents=True)
    for name in ("__init__", "inner/__init__"):
        (tmp_path / f"here/travelling/{name}.py").touch()
    stage, own = tmp_path / "here/travelling/inner/stage.py", tmp_path / "here/own.yaml"
    stage.write_text("from stages import Rectify\n")
    own.write_text(TRAPPED.replace("trap.Trap", "travelling.inner.stage.Rectify"))
    (tmp_path / "here/unused").mkdir()
    for folder in ("unused", "travelling"):
        os.mkfifo(tmp_path / f"here/{folder}/pipe.py")
        (tmp_path / f"here/{folder}/.#edit.py").symlink_to("nowhere")
    (tmp_path / "here/unused/script.py").touch()
    pipeline = Pipeline.of(str(own), ())
    names = {"own.yaml", *(f"travelling/{name}.py" for name in ("__init__", "inner/__init__", "inner/stage"))}
    assert pipeline.files.keys() == names
    copy = Path(pipeline.local())
    assert (copy.parent / "travelling/inner/stage.py").read_bytes() == stage.read_bytes()
    stage.write_text("from stages import Rectify  # and more\n")
    assert Pipeline.of(str(own), ()).digest != pipeline.digest


@pytest.mark.parametrize("locked", [False, True])
def test_a_task_goes_on_where_a_worker_died_if_the_pipeline_can(tmp_path, monkeypatch, locked):
    monkeypatch.setattr(checkpoint_file, "INTERVAL", 0.0)
    monkeypatch.setattr(checkpoint_file, "MAX_SHARE", 1e9)
    write_log(Simulation(frames=6, width=120, height=96, relief_cells=256), tmp_path / "log.mcap")
    module = f"locked_{locked}"  # a module is imported once
    (tmp_path / f"{module}.py").write_text(STATES.format(locked=locked))
    (tmp_path / "own.yaml").write_text(TRAPPED.replace("trap.Trap", f"{module}.Locked"))
    (job,) = jobs_of([str(tmp_path / "log.mcap")], tmp_path / "out")
    task = Task(job, tmp_path / "out", Pipeline.of(str(tmp_path / "own.yaml"), ()), recording=False, workers=1)
    died, write_text, keep = tmp_path / "died", Path.write_text, checkpoint_file.CheckpointFile.keep

    def write(file, text):
        if locked and file == task.progress and text == "6":  # five frames are through
            shutil.copytree(tmp_path / "out", died)
        return write_text(file, text)

    def kept(file, checkpoint):
        keep(file, checkpoint)
        if not died.exists():
            shutil.copytree(tmp_path / "out", died)

    monkeypatch.setattr(Path, "write_text", write)
    monkeypatch.setattr(checkpoint_file.CheckpointFile, "keep", kept)
    wanted = run_task(task)
    assert (died / "log-nav.mcap.checkpoint").exists() != locked
    (died / "log-nav.mcap.1-0.partial").touch()
    row = run_task(replace(task, folder=died))
    same = ("state", "verdict", "frames", "complete", "losses", "result")
    assert [row[name] for name in same] == [wanted[name] for name in same]
    assert (died / "log-nav.mcap").read_bytes() == task.result.read_bytes()
    assert {path.name for path in died.iterdir()} == {"log-nav.mcap", "log-nav.json"}
    resumed = json.loads((died / "log-nav.json").read_text())["summary"]["frames_resumed"]
    assert resumed == 0 if locked else resumed > 0


@pytest.mark.slow
def test_a_fleet_runs_nothing_twice_and_lists_what_became_of_each_log(logs, tmp_path, said, refused):
    out = tmp_path / "out"
    words = ("fleet", logs, "--out", out, *PIPELINE, "--processes", 1)
    printed = said(3, *words).out
    assert "4 logs: 0 done before, 4 to run (4 new)" in printed
    assert "junk: unusable: " in printed
    assert {name: row["state"] for name, row in rows_of(out).items()} == {
        "a": "done", "b": "done", "site/c": "done", "junk": "unusable"
    }  # fmt: skip
    (out / "a-nav.mcap").unlink()
    assert "4 logs: 3 done before, 1 to run (1 without its result)" in said(3, *words).out
    assert (out / "a-nav.mcap").is_file()
    listed = said(0, "list", out, "--where", "verdict = 'COMPLETE'", "--sort", "frames DESC", "--json").out
    assert json.loads(listed)[0]["name"] == "b"
    table = said(0, "score", out).out.splitlines()
    assert [line.split()[0] for line in table] == ["fast", "log", "a", "b", "site/c", "mean", "not"]
    assert json.loads(rows_of(out)["a"]["scores"])["density"] > 0
    assert "3 done, 1 unusable; 4 frames so far, 0.00 GB left" in said(3, "fleet", "--out", out, "--watch").out
    listed = said(0, "list", out, "--where", "verdict != 'COMPLETE'", "--csv").out
    assert [line.split(",")[0] for line in listed.splitlines()] == ["name", "junk"]
    assert roverflow("report", out) == 0
    page = (out / "report.html").read_text()
    assert "<td>site/c</td><td>COMPLETE</td><td>1 of 1</td>" in page
    assert "<td>junk</td><td>unusable</td>" in page
    assert "its columns are name, log, bytes" in refused("list", out, "--where", "nonsense")


def test_a_progress_file_that_is_just_being_written_is_no_stall(logs, tmp_path):
    (job,) = jobs_of([str(logs / "a.mcap")], tmp_path)
    task = Task(job, tmp_path, Pipeline.of("fast", ()), False, workers=1)
    progress = Progress({"a": job.size})
    fleet = Fleet(Catalogue(tmp_path, create=True), {"a": task}, progress, left={"a"})
    fleet.catalogue.put("a", {"state": "waiting"})
    for content, state in (("", "waiting"), ("1", "running"), ("", "running")):
        task.progress.write_text(content)
        fleet._watch(None, {object(): "a"})
        assert rows_of(tmp_path)["a"]["state"] == state


def test_a_log_keeps_its_name_and_no_other_log_takes_it(logs, tmp_path):
    (first,) = jobs_of([str(logs / "site")], tmp_path)
    row = {"name": first.name, "log": str(first.log), "log_digest": first.digest}
    assert first.name == "c"
    assert [job.name for job in jobs_of([str(logs)], tmp_path, [row])] == ["b", "a", "c", "junk"]
    moved = tmp_path / "moved"
    moved.mkdir()
    (moved / "c.mcap").write_bytes(first.log.read_bytes())
    assert [job.name for job in jobs_of([str(moved)], tmp_path, [row])] == ["c"]
    (moved / "c.mcap").write_bytes((logs / "b.mcap").read_bytes())
    with pytest.raises(UsageError, match=r"has results of .*site/c.mcap under the name c; choose another --out"):
        jobs_of([str(moved)], tmp_path, [row])


def test_a_second_fleet_in_the_folder_is_refused(logs, tmp_path, refused):
    with Catalogue(tmp_path, create=True).held():
        why = refused("fleet", logs / "a.mcap", "--out", tmp_path, *PIPELINE)
    assert f"another roverflow fleet runs in {tmp_path}; --watch shows it" in why
    assert Catalogue(tmp_path).is_held() is False


def test_an_empty_log_that_ends_first_leaves_all_time(capsys):
    with Progress({"empty": 0, "log": 9}) as progress:
        progress.end("empty", {"state": "unusable", "why": "it is empty"})
    assert capsys.readouterr().out.startswith("1 of 2: empty: unusable: it is empty; 0 frames so far, 0.00 GB left")


def test_a_watched_fleet_whose_process_is_gone_is_named(tmp_path, said):
    catalogue = Catalogue(tmp_path, create=True)
    catalogue.put("a", {"state": "running", "bytes": 9})
    printed = said(3, "fleet", "--out", tmp_path, "--watch").out
    assert "no process runs this fleet, 1 log left; run its command again to continue" in printed
    catalogue.put("a", {"state": "unusable"})
    assert said(3, "fleet", "--out", tmp_path, "--watch").out.count("1 unusable;") == 1
    catalogue.put("a", {"state": "done", "verdict": "COMPLETE"})
    said(0, "fleet", "--out", tmp_path, "--watch")


def test_a_worker_that_stays_forgets_the_stages_of_an_earlier_fleet(logs, tmp_path):
    (job,) = jobs_of([str(logs / "a.mcap")], tmp_path)
    task = Task(job, tmp_path, Pipeline.of("fast", ()), False, workers=1)
    text = TRAPPED.replace("trap.Trap", "travelled_trap.Trap").encode()
    for code, refused in ((TRAP, ""), ("", "cannot load the pipeline"), (TRAP, "")):
        files = {"own.yaml": text, "travelled_trap.py": code.encode()}
        assert unfit(replace(task, pipeline=Pipeline("own.yaml", files, ()))).startswith(refused)
        assert bool(unfit(replace(task, pipeline=Pipeline("own.yaml", files, ())))) == bool(refused)


def cores_of_workers(client: Client) -> list[set[int]]:
    """The cores of the threads in which two workers run their logs."""
    client.wait_for_workers(2)
    futures = [client.submit(os.sched_getaffinity, 0, workers=[worker], pure=False) for worker in client.nthreads()]
    return client.gather(futures)


@pytest.mark.slow
@pytest.mark.skipif(
    len(getattr(os, "sched_getaffinity", lambda _: ())(0)) < 2, reason="needs two cores that can be chosen"
)
def test_worker_processes_have_cores_of_their_own_also_after_a_death():
    with cluster(None, 2, cores=1, memory="2GB", dashboard=False) as client:
        first, second = cores_of_workers(client)
        assert (len(first), len(second), len(first | second)) == (1, 1, 2)
        before = set(client.run(os.getpid).values())
        os.kill(min(before), signal.SIGKILL)
        while len(before | set(client.run(os.getpid, on_error="ignore").values())) < 3:
            time.sleep(0.1)
        assert set.union(*cores_of_workers(client)) == first | second
    many = len(os.sched_getaffinity(0))
    with cluster(None, 2, cores=many, memory="2GB", dashboard=False) as client:
        assert {len(cores) for cores in cores_of_workers(client)} == {many}


def test_logs_are_named_by_files_folders_patterns_and_lists(logs, tmp_path):
    (logs / "which.txt").write_text("a.mcap  # the first\n\nsite\n")

    def names(given):
        return [job.name for job in jobs_of([str(logs / given)], tmp_path)]

    assert (names("b.mcap"), names("site")) == (["b"], ["c"])
    assert (names("*.mcap"), names("which.txt")) == (["b", "a", "junk"], ["a", "site/c"])
    assert names(".") == ["b", "a", "site/c", "junk"]
    with pytest.raises(UsageError, match=r"no file, folder or pattern .*nix"):
        jobs_of([str(logs / "nix")], tmp_path)
    shutil.copy(logs / "a.mcap", logs / "site #1-nav.mcap")  # no result, although named so
    (logs / "which.txt").write_text("# the second\nsite #1-nav.mcap # here\n")
    assert names("which.txt") == ["site #1-nav"]
    assert "site #1-nav" in names(".")
    (logs / "which.txt").write_text("nix.mcap\n")
    with pytest.raises(UsageError, match=r"no file, folder or pattern .*nix\.mcap, which .*which\.txt names"):
        jobs_of([str(logs / "which.txt")], tmp_path)
    (logs / "which.txt").write_text("more.txt\n")
    for again in ("*.txt", f"../{logs.name}/which.txt"):
        (logs / "more.txt").write_text(f"a.mcap\n{again}\n")
        with pytest.raises(UsageError, match=r"the text file .*\.txt names itself; take it out of its lines"):
            jobs_of([str(logs / "which.txt")], tmp_path)


def test_results_of_logs_above_the_working_folder_stay_in_the_folder_of_the_fleet(logs, tmp_path, monkeypatch):
    monkeypatch.chdir(logs / "site")
    assert [job.name for job in jobs_of(["c.mcap", "../a.mcap"], tmp_path)] == ["a", "site/c"]


def test_a_row_names_the_faults_and_the_first_loss_of_each_kind():
    zero = dict.fromkeys(("frames_in", "frames_out", "wall_seconds", "cpu_seconds", "survey_cpu_seconds"), 0)
    fault = {"rectified": {"severity": "fault", "sentence": "left and right are swapped"}}
    lost = [("unmatched", "left", "no partner"), ("unreadable", "log", "cut"), ("unmatched", "right", "late")]
    summary = {"verdict": "INCOMPLETE", "interrupted": False, "surveys": fault, "findings": {}, "cpu_seconds_of": {}}
    summary |= {"drops": {"unmatched": 2, "unreadable": 1}, "outputs": []} | zero
    summary["ledger"] = [dict(zip(("reason", "stream", "detail"), entry, strict=True)) for entry in lost]
    row = _columns(summary)
    first = "1 unreadable, first: log: cut; 2 unmatched, first: left: no partner"
    assert row["why"] == f"rectified: left and right are swapped; {first}"
    assert row["findings"] == {"rectified": "fault: left and right are swapped"}
    assert _columns(summary | {"surveys": {}})["why"] == first


def test_a_calibration_that_changed_makes_another_pipeline(tmp_path):
    for name in ("left.yaml", "right.yaml", "joints.yaml"):
        (tmp_path / name).write_text("old")
    changes = (
        f"source.calibration=[{tmp_path / 'left.yaml'},{tmp_path / 'right.yaml'}]",
        f"source.joints={tmp_path / 'joints.yaml'}",
    )
    digests = {Pipeline.of("fast", changes).digest}
    for name in ("right.yaml", "joints.yaml"):
        (tmp_path / name).write_text("new")
        digests.add(Pipeline.of("fast", changes).digest)
    assert len(digests) == 3
    assert Pipeline.of("fast", changes).digest in digests


def test_the_scores_of_a_fleet_are_written_as_json_and_other_logs_are_named(logs, tmp_path, said, refused):
    (job,) = jobs_of([str(logs / "a.mcap")], tmp_path)
    row = run_task(Task(job, tmp_path, Pipeline.of("fast", ("disparities=48",)), False, workers=2))
    here = {"log": str(job.log), "pipeline": "fast"}
    Catalogue(tmp_path, create=True).put_all({"a": row | here, "junk": here | {"state": "unusable"}})
    for _ in range(2):  # its own file may be replaced
        assert "not scored: junk: no result\n" in said(0, "score", tmp_path, "--json", tmp_path / "scores.json").out
    figures = json.loads((tmp_path / "scores.json").read_text())["pipelines"]["fast"]["a"]
    assert figures["disparity"]["density"] == json.loads(rows_of(tmp_path)["a"]["scores"])["density"]
    listed = json.loads(said(0, "list", tmp_path, "--where", "name = 'a'", "--json").out)
    assert listed[0]["scores"]["density"] == figures["disparity"]["density"]
    assert "--truth is for one result log" in refused("score", tmp_path, "--truth", job.log)
    assert "not merged: junk has no result (unusable)" in said(0, "export", tmp_path, tmp_path / "maps", "--merge").out
    changed = rewrite(job.log, tmp_path / "b.mcap")
    for log, code in ((changed, 3), (job.log, 0)):
        Catalogue(tmp_path).put("a", {"log": str(log)})
        printed = said(code, "score", tmp_path).out
        assert ("not scored: a: the log has changed since its run; run the fleet again" in printed) == (code == 3)
    result = tmp_path / "a-nav.mcap"
    with_broken(result, chunks_of(result)[0][0]).replace(result)
    assert re.search(r"not scored: a: the chunk at byte \d+ is broken", said(3, "score", tmp_path).out)
    result.write_bytes(b"")
    assert "not scored: a:" in said(3, "score", tmp_path).out
    result.unlink()
    assert "not scored: a: cannot read" in said(3, "score", tmp_path).out


def test_the_page_of_a_fleet_states_losses_and_findings_in_words(tmp_path):
    findings = {"tilt": "note: 2 gaps.", "health": "fault: The sign is flipped."}
    sound = {"state": "done", "verdict": "COMPLETE", "findings": {}, "why": ""}
    lossy = {"state": "done", "findings": findings, "seconds": 2.0, "why": "4 unmatched, 1 failed"}
    Catalogue(tmp_path, create=True).put_all({"lossy": lossy | {"verdict": "INCOMPLETE"}, "sound": sound})
    write_fleet_page(tmp_path / "report.html", tmp_path)
    page = (tmp_path / "report.html").read_text()
    sentences = "tilt: note: 2 gaps. health: fault: The sign is flipped."
    assert f"<td>{sentences}</td><td>2.0</td><td>4 unmatched, 1 failed</td>" in page
    assert "<td></td><td></td>" in page
    assert page.index("<td>lossy</td>") < page.index("<td>sound</td>")


def test_a_file_is_no_folder_of_a_fleet(logs, refused):
    assert "a.mcap is a file; give the name of a folder" in refused("fleet", logs / "b.mcap", "--out", logs / "a.mcap")


@pytest.mark.slow
def test_logs_that_end_or_stop_their_workers_leave_the_others_alone(logs, tmp_path, said):
    home, out = tmp_path / "home", tmp_path / "out"
    home.mkdir()
    for name, width in (("dies", 160), ("hangs", 176), ("grows", 192), ("sound", 208), ("sound2", 208)):
        write_log(Simulation(frames=1, width=width, height=120), home / f"{name}.mcap")
    (home / "trap.py").write_text(TRAP)
    (home / "own.yaml").write_text(TRAPPED)
    words = ("fleet", home, "--out", out, "-p", home / "own.yaml", "--processes", 2, "--stall", 15, "--memory", "2GB")
    assert roverflow(*words) == 3
    states = {name: row["state"] for name, row in rows_of(out).items()}
    assert states == {"dies": "killed", "hangs": "hung", "grows": "killed", "sound": "done", "sound2": "done"}
    assert "5 logs: 5 done before, 0 to run" in said(3, *words).out
