"""What a run prints: notes on the way, and a warning last, where it is not missed."""

from pathlib import Path

from flow.report import report
from flow.run import run
from tests.flow.test_engine import graph, traverse
from tests.flow.toys import Log


def printed(folder, frames, capsys):
    """The lines that a run of so many frames prints."""
    pipeline = graph(folder)
    ((use, _),) = pipeline.sinks
    summary = run(pipeline, Log(traverse(frames)), {use: Path("unused")})
    report(summary | {"outputs": []})
    return capsys.readouterr().out.splitlines()


def test_a_note_is_one_of_the_lines_and_a_warning_the_last(tmp_path, capsys):
    assert printed(tmp_path, 5, capsys)[1:] == ["  total: the sum is 20.0"]
    verdict, *more = printed(tmp_path, 6, capsys)
    assert verdict.startswith("COMPLETE: 6 of 6 frames whole")
    assert more == ["WARNING: total: the sum is 30.0"]
