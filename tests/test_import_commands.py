"""`roverflow import`: scenes of a data set become logs that run and score."""

import json

import pytest

from tests.conftest import roverflow
from tests.recordings.importers.middlebury_scene import write_scene

MATCHING = """
source: {use: recordings.McapSource}
streams:
  stereo: {use: flow.align.pair, left: left, right: right, slop: 5 ms}
  disparity: {use: stages.Match, frame: stereo, disparities: 192}
sinks: [{use: recordings.McapSink}]
"""


def test_a_middlebury_scene_is_imported_run_and_scored(tmp_path, said):
    scene, log, out = write_scene(tmp_path / "Box"), tmp_path / "box.mcap", tmp_path / "out.mcap"
    note, wrote = said(0, "import", "middlebury", scene, log).out.splitlines()
    assert note == f"{scene}: with true disparities and occlusions; run it with --set disparities=32"
    assert wrote.startswith(f"{log}: 1 stereo frame (")
    assert roverflow("run", log, "--set", "disparities=32", "-o", out, "--no-rrd") == 0
    (tmp_path / "matching.yaml").write_text(MATCHING)
    matching = ("-p", tmp_path / "matching.yaml", "--set", "disparity.disparities=32")
    assert roverflow("run", log, *matching, "-o", tmp_path / "matched.mcap", "--no-rrd") == 0
    scores = []
    for name in ("out", "matched"):
        paths = tmp_path / f"{name}.mcap", tmp_path / f"{name}.json"
        table = said(0, "score", paths[0], "--truth", log, "--json", paths[1]).out
        words = ("bad-0.5", "bad-4", "seen by one camera", "without the leftmost 32 columns")
        assert all(word in table for word in words)
        assert "missing" not in table  # maps without truth
        scores.append(json.loads(paths[1].read_text())["disparity"])
    for score in scores:
        assert score["whole_image"]["all"]["pixels"] == 96 * 64 - 28
        assert score["cropped_image"]["leftmost_columns_cropped"] == [32]
        assert score["cropped_image"]["nonocc"]["bad_1"] < 0.05
    refined, matched = (score["whole_image"]["all"] for score in scores)
    assert refined["density"] > matched["density"]


def test_the_help_of_import_names_its_assumptions(capsys):
    with pytest.raises(SystemExit):
        roverflow("import", "middlebury", "--help")
    assert "assumes a level camera 1 m above ground" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("given", "lacking"), [
    ((), "SOURCE, OUT.mcap, --calibration, --height, --pitch-down or --attitudes"),
    (("a", "b.mcap", "--height", 1), "--calibration, --pitch-down or --attitudes"),
    (("a", "b.mcap", "--height", 1, "--attitudes", "a.csv"), "--calibration"),
])  # fmt: skip
def test_one_sentence_names_all_that_a_command_line_lacks(given, lacking, capsys):
    with pytest.raises(SystemExit) as caught:
        roverflow("import", "images", *given)
    assert caught.value.code == 2
    assert capsys.readouterr().err.endswith(f"error: the following arguments are required: {lacking}\n")
