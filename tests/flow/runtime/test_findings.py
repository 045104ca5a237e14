"""Findings of the stages reach the user and the sinks, warnings last."""

import pytest

from flow.cli.report import headline, report
from flow.contracts import Finding, LossReason, Severity
from flow.runtime.findings import explained
from tests.flow.toys import Total, graph, replayed, traverse


def printed(folder, frames, capsys):
    """The lines that a run of so many frames prints."""
    _, summary = replayed(graph(folder), traverse(frames))
    report(summary | {"outputs": [], "bottleneck": {}})
    return capsys.readouterr().out.splitlines()


def test_a_note_is_one_of_the_lines_and_a_warning_the_last(tmp_path, capsys):
    assert printed(tmp_path, 5, capsys)[1:] == ["  total: the sum is 20.0"]
    verdict, *more = printed(tmp_path, 6, capsys)
    assert verdict.startswith("COMPLETE: 6 of 6 frames complete")
    assert more == ["WARNING: total: the sum is 30.0"]


def test_a_fault_makes_the_verdict_incomplete_and_is_printed_last(tmp_path, capsys):
    verdict, *more = printed(tmp_path, 7, capsys)
    assert verdict.startswith("INCOMPLETE: 7 frames complete, fault reported by total")
    assert more == ["FAULT: total: the sum is 42.0"]


def test_the_time_of_the_first_loss_is_that_of_start_also_with_stamps_of_another_clock(tmp_path, capsys):
    _, summary = replayed(graph(tmp_path), traverse(5))
    lost = [{"reason": reason, "stream": "left", "stamp": 9_500_000_000, "detail": "why"} for reason in LossReason]
    drops = dict.fromkeys(("unreadable", "unmatched"), 1)
    clocks = {"log_begin": 9_000_000_000, "first_stamp": 2_000_000_000}
    report(summary | clocks | {"outputs": [], "bottleneck": {}, "drops": drops, "ledger": lost})
    printed = capsys.readouterr().out
    assert "1 unreadable, first: left at +0.5 s (9500000000 ns): why" in printed
    assert "1 unmatched, first: left at +7.5 s (9500000000 ns): why" in printed


def test_a_warning_that_assumes_what_has_a_fault_becomes_a_note():
    fault = Finding("The mount is wrong.", Severity.FAULT, about="tilt")
    blamed, other = (Finding("The pose leans.", Severity.WARNING, assumes=assumed) for assumed in ("tilt", ""))
    found = explained({"pose": blamed, "wheels": other, "health": fault}, {})
    assert found["pose"].severity is Severity.NOTE
    assert found["pose"].sentence == "The pose leans. The fault that health reports may be the cause."
    assert (found["wheels"], found["health"]) == (other, fault)
    assert explained({"pose": blamed}, {}) == {"pose": blamed}
    assert explained({"pose": blamed}, {"rectified": fault})["pose"].severity is Severity.NOTE


@pytest.mark.parametrize(("changes", "line"), [
    ({"verdict": "COMPLETE"}, "COMPLETE: 18 of 18 frames complete"),
    ({"drops": {"unmatched": 2}}, "INCOMPLETE: 18 frames complete, 2 losses: 2 unmatched"),
    ({"frames_out": 17, "drops": {"failed": 1, "unreadable": 2}},
     "INCOMPLETE: 17 of 18 frames complete, 3 losses: 2 unreadable, 1 failed"),
    ({"drops": {"unmatched": 5, "unreadable": 5}},  # the cause first
     "INCOMPLETE: 18 frames complete, 10 losses: 5 unreadable, 5 unmatched"),
    ({"interrupted": True, "frames_in": 1, "frames_out": 1}, "INCOMPLETE: interrupted after 1 frame"),
    ({"interrupted": True, "frames_out": 15, "drops": {"abandoned": 3}},  # which are no losses
     "INCOMPLETE: interrupted after 15 of 18 frames, 3 abandoned"),
    ({"interrupted": True, "frames_out": 14, "drops": {"abandoned": 3, "failed": 1}},
     "INCOMPLETE: interrupted after 14 of 18 frames, 3 abandoned, 1 loss: 1 failed"),
    ({"interrupted": True, "verdict": "COMPLETE"}, "COMPLETE: 18 of 18 frames complete"),
])  # fmt: skip
def test_the_verdict_line_counts_the_losses_by_reason_and_abandoned_frames_apart(changes, line):
    summary = {"verdict": "INCOMPLETE", "interrupted": False, "frames_in": 18, "frames_out": 18, "drops": {}}
    assert headline({**summary, "frames_per_second": 2.5, **changes}).removesuffix("; 2.50 frames/s") == line


def test_findings_reach_the_summary_and_the_sinks(tmp_path):
    sink, summary = replayed(graph(tmp_path), traverse(5))
    findings = {"total": {"severity": "note", "sentence": "the sum is 20.0"}}
    assert summary["findings"] == sink.summary["findings"] == findings
    warned = replayed(graph(tmp_path), traverse(6))[1]
    assert warned["findings"] == {"total": {"severity": "warning", "sentence": "the sum is 30.0"}}
    assert warned["verdict"] == "COMPLETE"  # for nothing was lost
    assert replayed(graph(tmp_path), [])[1]["findings"] == {}


def test_a_failing_finding_becomes_a_warning_and_the_run_is_complete(tmp_path):
    _, summary = replayed(graph(tmp_path), traverse(4))
    found = summary["findings"]["total"]
    assert (summary["verdict"], found["severity"]) == ("COMPLETE", "warning")
    assert found["sentence"].startswith("RuntimeError: unlucky (toys.py, line ")


def test_a_finding_of_another_type_or_severity_becomes_a_warning(tmp_path, monkeypatch):
    for wrong, sentence in (
        (lambda: "loose", "the stage must return a flow.contracts.Finding or None, not 'loose'"),
        (lambda: Finding("loose", "warn"), "ValueError: 'warn' is not a valid Severity (test_findings.py, line "),
    ):
        monkeypatch.setattr(Total, "finding", lambda self, state, wrong=wrong: wrong())
        _, summary = replayed(graph(tmp_path), traverse(5))
        assert summary["findings"]["total"]["severity"] == "warning"
        assert summary["findings"]["total"]["sentence"].startswith(sentence)
