"""`roverflow try`: an instant of a log with and without a change."""

import re
from functools import wraps

import cv2
import numpy as np
import pytest
import rerun as rr

import stages
from recordings.comparison.sweep import chart
from recordings.comparison.text import moment
from tests.conftest import FRAMES, SMALL, rewrite, run_fast
from tests.flow.toys import PIPELINE

AT = ("--at", "0.5", "-p", "fast")
RIGHT = "/stereo/right/image_rect_color"


def test_stages_before_the_change_run_once(traverse, tmp_path, said, monkeypatch):
    runs = dict.fromkeys(("Match", "Voxelise", "FuseRegion", "Binarise"), 0)

    def counting(name):
        stage = getattr(stages, name)
        call = stage.__call__

        @wraps(call)
        def counted(self, *arguments, **inputs):
            runs[name] += 1
            return call(self, *arguments, **inputs)

        monkeypatch.setattr(stage, "__call__", counted)

    for name in runs:
        counting(name)
    out = tmp_path / "try.rrd"
    change = ("--set", "navigation_map.rover.max_step=5 cm", "-o", out)
    output = said(0, "try", traverse, *AT, "--frames", 2, *change).out
    assert " run once, 1 again with the change\nthe change affects navigation_map\n\nA: fast, unchanged\n" in output
    first = re.search(r"the results first differ at /nav/navigation_map, (\S+) \((\d+) ns\)\n", output)
    assert first is not None
    assert first[0].endswith(f"{moment(int(first[2]))}\n")
    assert output.index(f"wrote {out}") < output.index("bad-1") < output.index(f"added the errors to {out}")
    assert re.search(r"/nav/navigation_map: 2 of 2 messages differ; up to .* cells from free to hazard", output)
    assert "equal: /nav/disparity, " in output
    # A frame has three matches, cells for its own and the regional map, and maps of its own, changed, and regional.
    assert runs == {"Match": 6, "Voxelise": 2, "FuseRegion": 2, "Binarise": 6}
    assert out.stat().st_size > 10_000


def test_several_values_of_a_parameter_make_a_table_of_errors(traverse, tmp_path, said):
    values = [f"--set=disparities={number}" for number in (16, 64)]
    output = said(0, "try", traverse, *AT, *values, "-o", tmp_path / "try.rrd").out
    rows = [line.split() for line in output.splitlines() if re.match(r" +[A-C] +\d", line)]
    errors = {row[0]: float(row[row.index("%") + 3]) for row in rows}  # bad-1
    assert errors.keys() == {"A", "B", "C"}
    assert errors["B"] > 1.5 * errors["C"]
    charts = {chunk.entity_path: chunk for chunk in rr.chunk.RrdReader(str(tmp_path / "try.rrd")).stream()}
    assert {"/errors/A", "/errors/B", "/errors/C"} <= charts.keys()
    (blob,) = charts["/sweep/2"].to_record_batch().column("EncodedImage:blob").to_pylist()[0]
    picture = cv2.imdecode(np.array(blob, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(
        picture[..., ::-1], chart("disparities", ["16", "64"], [errors[label] for label in "ABC"])
    )


def test_a_variant_whose_maps_do_not_fit_the_truth_says_so(traverse, tmp_path, said):
    values = [f"--set=resolution={size}" for size in ("10cm", "5cm")]
    output = said(0, "try", traverse, *AT, "--set=disparities=64", *values, "-o", tmp_path / "try.rrd").out
    rows = {line.split()[0]: line.split()[-4:] for line in output.splitlines() if re.match(r" +[A-C] +\d", line)}
    assert rows["B"] == ["-"] * 4
    assert "-" not in rows["C"]
    assert "\nB not scored: /nav/elevation_map: its cells are 0.1 m wide, the truth's 0.05 m; " in output


STRICT = """
from dataclasses import dataclass
from stages import StereoFrame


@dataclass(frozen=True)
class Strict:
    limit: int = 0

    def __call__(self, frame: StereoFrame) -> StereoFrame:
        if self.limit > 1:
            raise ValueError("too strict")
        return frame
"""


def test_a_variant_whose_stage_fails_says_why_and_the_others_are_scored(traverse, tmp_path, said):
    (tmp_path / "limited.py").write_text(STRICT)
    own = said(0, "pipeline", "fast").out.replace("frame: rectified", "frame: passed")
    text = own.replace("streams:", "streams:\n  passed: {use: limited.Strict, frame: rectified}", 1)
    (tmp_path / "own.yaml").write_text(text)
    words = ("try", traverse, "--at", "0.5", "-p", tmp_path / "own.yaml")
    values = [f"--set=passed.limit={number}" for number in (2, 1)]
    output = said(0, *words, *values, "-o", tmp_path / "try.rrd").out
    assert "note: B lost 1 frame, first in passed@B: ValueError: too strict (limited.py, line 12" in output
    rows = {line.split()[0]: line.split()[1:] for line in output.splitlines() if re.match(r" +[A-C] +[-\d]", line)}
    assert (rows["A"] == rows["C"], set(rows["B"])) == (True, {"-"})
    assert "\nB not scored: it contains none of /nav/disparity, " in output


def test_frames_before_the_instant_give_the_stages_with_memory_their_state(traverse, tmp_path, said):
    change = ("-p", "fast", "--set", "regional_cells.max_range=4 m", "-o", tmp_path / "try.rrd")
    output = said(0, "try", traverse, "--at", "1.05", "--before", FRAMES, *change).out
    assert "1 frame from 1.013 s on, after 1 frame before it" in output
    assert "/nav/regional_map: 1 of 1 messages differ" in output


def test_frames_before_the_instant_are_neither_compared_nor_scored(traverse, tmp_path, said):
    def tried(*before):
        change = ("-p", "fast", "--set", "disparity/full.paths=8", "-o", tmp_path / "try.rrd")
        output = said(0, "try", traverse, "--at", "1.05", *before, *change).out
        first = re.search(r"first differ at /nav/disparity, \S+ \((\d+) ns\)", output)
        disparities = re.search(r"  /nav/disparity: .*", output)
        assert first is not None
        assert disparities is not None
        return first[1], disparities[0], [row.split()[:8] for row in output.splitlines() if re.match(" +[AB] +", row)]

    assert tried("--before", FRAMES) == tried()


def test_the_frames_that_were_compared_are_counted(traverse, tmp_path, said):
    words = ("--at", "1.05", "--frames", 99, "-p", "fast", *SMALL, "-o", tmp_path / "b.rrd")
    output = said(0, "try", traverse, *words).out
    assert "2 frames from 1.013 s on: " in output
    assert "\nnote: the log has only 2 frames from there on, not 99\n" in output


def test_a_right_image_that_is_missing_is_not_counted_as_a_frame(traverse, tmp_path, said, refused):
    log = rewrite(traverse, tmp_path / "a.mcap", lambda *one: None if one[0] == RIGHT and one[1] == 1 else one[2])
    words = ("-p", "fast", *SMALL, "-o", tmp_path / "b.rrd")
    output = said(0, "try", log, "--at", "0.5", "--frames", 3, *words).out
    assert "2 frames from 0.513 s on: " in output
    command = rf"roverflow run {re.escape(str(log))} -p fast --start \d\.\d+( --end \d\.\d+)? -o OTHER\.mcap says why\n"
    assert re.search(rf"\nnote: 1 frame gave no result; {command}", output)
    why = refused("try", log, "--at", "1.05", *words)
    assert re.search(rf"no frame was completed at 1\.013 s: left unmatched; {command}", why)
    out = run_fast(tmp_path / "a-nav.mcap", log, code=3)
    known = (
        "1.013 s: left unmatched: the nearest right without a partner is 500 ms away, more than 5 ms (stereo.slop)\n"
    )
    for asked in (("why", out, "--cell", "3,0"), ("try", log, "--result", out, *words[2:])):
        assert known in refused(*asked, "--at", "1.05")


def test_a_comparison_ends_before_the_disk_is_full(traverse, tmp_path, said, monkeypatch):
    """rerun's writer never returns from a full disk."""
    monkeypatch.setattr("recordings.sinks.rerun_recording.RESERVED_BYTES", 1 << 62)
    out = tmp_path / "try.rrd"
    assert f"cannot write {out}: less than" in said(1, "try", traverse, *AT, *SMALL, "-o", out).err
    assert not list(tmp_path.iterdir())


def test_a_change_without_effect_writes_no_recording(traverse, tmp_path, said):
    out = tmp_path / "try.rrd"
    output = said(0, "try", traverse, *AT, "--set", "navigation_map.rover.max_step=20 cm", "-o", out).out
    assert "\nthe change has no effect on 1 frame, so there is no recording to write\n" in output
    assert not out.exists()


@pytest.mark.parametrize(("arguments", "sentence"), [
    (("--at", "99", *SMALL), "--at 99 is outside the images of the log"),
    (("--at", "0", *SMALL, "--set", "source.left=/nix"), "a change of the source needs a run of its own"),
    (("--at", "0", "--set", "stereo.slop=9 ms"), "a change of 'stereo', which makes the frames, needs a run of"),
    (("--at", "0", *SMALL, *SMALL, *SMALL[:1], "a=1", *SMALL[:1], "a=2"), "only one setting may have several values"),
])  # fmt: skip
def test_what_cannot_be_tried_is_refused(traverse, tmp_path, refused, arguments, sentence):
    assert sentence in refused("try", traverse, *arguments, "-o", tmp_path / "try.rrd")


def test_a_source_of_ones_own_is_refused_by_name(traverse, tmp_path, refused):
    (tmp_path / "toy.yaml").write_text(PIPELINE % {"nap": 0, "bad": [], "fail_at": "null"})
    sentence = "tests.flow.toys.Source is not recordings.McapSource; this command reads logs only through that source"
    assert sentence in refused("try", traverse, "--at", 0.2, "-p", tmp_path / "toy.yaml", "--set", "twice.factor=3 m")
    assert sentence in refused("info", traverse, "-p", tmp_path / "toy.yaml")
