"""Every log of a campaign is one job: split, listed, compressed, linked, moved, unreadable and with any name."""

import os

import pytest

from flow.cli.fleet.jobs import UNREADABLE, jobs_of, reason_to_run
from recordings.containers.finding import METADATA

LISTED = "rosbag2_bagfile_information:\n  relative_file_paths: [{}]\n"


def make(folder, *names):
    """Files that differ in their content."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"\x89MCAP0\r\n" + name.encode("utf-8", "surrogateescape") * 9)
    return folder


def names(folder, **others):
    return sorted(job.name for job in jobs_of([str(folder)], folder / "out", **others))


@pytest.mark.parametrize(("files", "jobs"), [
    (("bag_0.mcap", "bag_1.mcap", "bag_10.mcap"), ["logs"]),
    (("day_1.mcap", "day_2.mcap"), ["day_1", "day_2"]),
    (("rover_20261126.mcap", "rover_20261127.mcap"), ["rover_20261126", "rover_20261127"]),
    (("a_0.mcap", "b.mcap"), ["a_0", "b"]),
    (("A.MCAP", "b.mcap"), ["A", "b"]),
    (("bag_0.mcap", "bag_1.mcap", "late/extra.mcap"), ["logs", "logs/late/extra"]),
])  # fmt: skip
def test_only_files_that_are_numbered_from_zero_are_one_recording(tmp_path, files, jobs):
    assert names(make(tmp_path / "logs", *files)) == jobs


def test_logs_beside_those_that_a_metadata_file_lists_are_logs_of_their_own(tmp_path):
    logs = make(tmp_path / "logs", "a_0.mcap", "other.mcap", "deep/d.mcap")
    (logs / METADATA).write_text(LISTED.format("a_0.mcap"))
    assert names(logs) == ["logs", "logs/deep/d", "logs/other"]


def test_a_compressed_file_in_a_folder_of_its_own_is_a_log(tmp_path):
    assert names(make(tmp_path / "logs", "bag/t_0.mcap.zstd", "a.mcap")) == ["a", "bag"]
    (packed,) = jobs_of([str(make(tmp_path / "more", "a.mcap", "b.mcap.zstd"))], tmp_path / "out")[1:]
    assert packed.digest == UNREADABLE  # `run` refuses it beside other logs, and says what to do


def test_a_link_to_another_log_and_a_loop_of_folders_add_none(tmp_path):
    logs = make(tmp_path / "logs", "b.mcap")
    (logs / "a.mcap").symlink_to("b.mcap")
    (logs / "loop").symlink_to("../logs")
    assert names(logs) == ["b"]
    elsewhere = make(tmp_path / "elsewhere", "c.mcap")
    (logs / "c.mcap").symlink_to(elsewhere / "c.mcap")
    assert names(logs) == ["b", "c"]


def test_a_link_that_leads_nowhere_and_a_name_of_other_bytes_stop_no_other_log(tmp_path):
    logs = make(tmp_path / "logs", "a.mcap", os.fsdecode(b"b\xff.mcap"))
    (logs / "gone.mcap").symlink_to("nowhere")
    jobs = {job.name: job for job in jobs_of([str(logs)], tmp_path / "out")}
    assert sorted(jobs) == ["a", "b\\udcff", "gone"]
    assert jobs["gone"].digest == UNREADABLE != jobs["a"].digest


def test_a_log_that_was_moved_keeps_its_name_and_is_not_run_again(tmp_path):
    logs = make(tmp_path / "logs", "a.mcap", "b.mcap")
    jobs = jobs_of([str(logs)], tmp_path / "out")
    ran = {"state": "unusable", "result": None, "pipeline_digest": "p", "version": "v"}
    rows = [{"name": job.name, "log": str(job.log), "log_digest": job.digest, **ran} for job in jobs]
    (logs / "a.mcap").rename(logs / "renamed.mcap")
    assert names(logs, rows=rows) == ["a", "b"]
    moved, row = (next(each for each in found) for found in (
        (job for job in jobs_of([str(logs)], tmp_path / "out", rows) if job.name == "a"),
        (row for row in rows if row["name"] == "a"),
    ))  # fmt: skip
    assert moved.log == logs / "renamed.mcap"
    make(logs, "a.mcap")  # another log under the old name
    rows = [{**row, "log": str(moved.log)} if row["name"] == "a" else row for row in rows]
    assert names(logs, rows=rows) == ["a", "a-2", "b"]
    assert reason_to_run(moved, row, "p", "v", tmp_path) == ""


def test_a_log_that_cannot_be_read_takes_the_name_of_no_other_one(tmp_path):
    logs = make(tmp_path / "logs", "a.mcap")
    row = {"name": "z", "log": str(logs / "z.mcap"), "log_digest": UNREADABLE}
    for name in ("x.mcap", "y.mcap"):
        (logs / name).symlink_to("nowhere")
    assert names(logs, rows=[row]) == ["a", "x", "y"]


def test_copies_of_a_log_that_was_moved_have_names_of_their_own(tmp_path):
    logs = make(tmp_path / "logs", "new/a.mcap")
    (logs / "new/b.mcap").write_bytes((logs / "new/a.mcap").read_bytes())
    (job, _) = jobs_of([str(logs)], tmp_path / "out")
    rows = [{"name": name, "log": str(logs / f"old/{name}.mcap"), "log_digest": job.digest} for name in ("a", "b")]
    assert len(set(names(logs, rows=rows))) == 2


def test_a_log_that_a_link_named_first_keeps_its_name(tmp_path):
    logs, elsewhere = make(tmp_path / "logs", "a.mcap"), make(tmp_path / "elsewhere", "c.mcap")
    (logs / "c.mcap").symlink_to(elsewhere / "c.mcap")
    rows = [{"name": job.name, "log": str(job.log), "log_digest": job.digest} for job in jobs_of([str(logs)], tmp_path)]
    again = jobs_of([str(logs), str(elsewhere)], tmp_path, rows)
    assert sorted(job.name for job in again) == ["a", "c"]
