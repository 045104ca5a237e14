"""The survey: before the run, a stage sees frames of the whole log, even if only a part is run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest

from flow.config.loader import load
from flow.contracts import Finding
from flow.errors import PipelineError
from flow.runtime.interrupts import Stop
from flow.runtime.run import run
from tests.flow.toys import Couple, Keep, Log, Number

PIPELINE = """
source: {use: tests.flow.toys.Source}
streams:
  pair:     {use: flow.align.pair, left: left, right: right, slop: 1 ns}
  scaled:   {use: tests.flow.toys.Scale, couple: pair, factor: 2 m, bad: [%s]}
  centred:  {use: tests.flow.runtime.test_prepass.Centre, couple: scaled}
  doubled:  {use: tests.flow.toys.Add, a: centred, b: pair}
sinks:
  - {use: tests.flow.toys.Keep}
"""


@dataclass(frozen=True)
class Centre:
    """Subtracts the mean of the frames of its survey."""

    mean: float | None = None

    @property
    def surveys(self) -> bool:
        return self.mean is None

    def survey(self, couple: Sequence[Couple]) -> tuple["Centre", Finding]:
        values = [one.value for one in couple]
        mean = sum(values) / len(values) if values else 0.0
        return replace(self, mean=mean), Finding(f"mean {mean:g} of {len(values)}")

    def __call__(self, couple: Couple) -> Couple:
        return Couple(couple.stamp, couple.value - self.mean)


def survey_of(summary):
    """What the survey found."""
    return summary["surveys"]["centred"]["sentence"]


class Excerpted(Log):
    """A log whose excerpts are the given stretches of its events."""

    def __init__(self, events, stretches):
        super().__init__(events)
        self.stretches, self.asked = stretches, []

    def excerpts(self, count, streams):
        self.asked.append((count, streams))
        for first, last in self.stretches:
            yield iter(self.given[first:last])


def both(stamp, value):
    return [(stamp, "left", Number(stamp, value)), (stamp, "right", Number(stamp, 0.0))]


def result_of(tmp_path, log, bad="", stop=None):
    file = tmp_path / "p.yaml"
    file.write_text(PIPELINE % bad)
    graph, sink = load(str(file)), Keep()
    graph = replace(graph, sinks=(("Keep", sink),))
    return run(graph, log, {"Keep": tmp_path / "out.txt"}, stop=stop), sink


EVENTS = [event for stamp in range(1, 9) for event in both(stamp, float(stamp))]
FIRST = [(0, 6)]  # an excerpt of the first frames


def test_a_survey_sees_the_first_complete_frame_of_each_excerpt(tmp_path):
    log = Excerpted(EVENTS, [(0, 6), (7, 12), (12, 16)])  # the second begins between a left and its right
    summary, sink = result_of(tmp_path, log)
    assert survey_of(summary) == f"mean {2 * (1 + 5 + 7) / 3:g} of 3"
    assert sink.values("centred")[1] == pytest.approx(2 - 26 / 3)
    assert (summary["verdict"], summary["frames_in"]) == ("COMPLETE", 8)
    assert 0 < summary["survey_cpu_seconds"] < summary["cpu_seconds"]
    assert log.asked == [(7, {"left", "right"})]


def test_a_frame_with_a_failed_stage_is_not_surveyed(tmp_path):
    summary, _ = result_of(tmp_path, Excerpted(EVENTS, [(0, 6), (12, 16)]), bad="7")
    assert survey_of(summary) == "mean 2 of 1"
    assert summary["drops"] == {"failed": 1}


def test_a_failing_excerpt_is_left_out_of_the_survey(tmp_path):
    def broken():
        yield EVENTS[0]
        raise OSError("gone")

    log = Excerpted(EVENTS, FIRST)
    log.excerpts = lambda count, streams: [broken(), iter(EVENTS[:4])]
    assert survey_of(result_of(tmp_path, log)[0]) == "mean 2 of 1"


def test_a_survey_without_frames_reports_it_and_the_run_continues(tmp_path):
    summary, _ = result_of(tmp_path, Excerpted(EVENTS, []))
    assert survey_of(summary) == "mean 0 of 0"
    assert summary["frames_out"] == 8


def test_a_failing_survey_is_a_warning_and_the_run_continues(tmp_path, monkeypatch):
    monkeypatch.setattr(Centre, "survey", lambda self, couple: 1 // 0)
    summary, _ = result_of(tmp_path, Excerpted(EVENTS, [(0, 6)]))
    assert summary["surveys"]["centred"]["severity"] == "warning"
    assert survey_of(summary).startswith("the survey of the log failed: ZeroDivisionError: ")
    assert summary["drops"] == {"failed": 8}  # this stage cannot do without


def test_a_stage_with_state_cannot_come_before_a_survey(tmp_path):
    file = tmp_path / "p.yaml"
    remembering = (PIPELINE % "").replace("toys.Scale, couple: pair, factor: 2 m, bad: []", "toys.Total, couple: pair")
    file.write_text(remembering)
    with pytest.raises(PipelineError, match=r"p\.yaml:5: 'scaled' has state"):
        run(load(str(file)), Excerpted(EVENTS, [(0, 6)]), {})


def test_an_interrupt_during_the_survey_opens_no_output(tmp_path):
    stop = Stop()
    stop.request()
    summary, sink = result_of(tmp_path, Excerpted(EVENTS, [(0, 6)]), stop=stop)
    assert (summary["interrupted"], summary["frames_in"], summary["verdict"]) == (True, 0, "INCOMPLETE")
    assert (summary["outputs"], sink.summary) == ([], None)


def test_the_summary_names_the_parameters_that_a_survey_fixed(tmp_path):
    summary, _ = result_of(tmp_path, Excerpted(EVENTS, [(0, 6)]))
    assert summary["fixed"] == {"centred.mean": 2.0}
