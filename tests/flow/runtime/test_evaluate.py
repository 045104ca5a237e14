"""Streams of a pipeline are evaluated in memory: those given are not made, those not needed are not made either."""

from dataclasses import dataclass, replace

import pytest

from flow.config.loader import load
from flow.contracts import StageError
from flow.errors import UsageError
from flow.runtime.evaluate import evaluate
from tests.flow.toys import Couple, Number, graph

GIVEN = {"both": Couple(7, 5.0)}
OPEN = """
source: {use: tests.flow.toys.Source}
streams:
  both:   {use: flow.align.pair, left: left, right: right}
  height: {use: flow.align.interpolate, stream: level, at: both}
  either: {use: tests.flow.toys.Either, a: both, b: height}
sinks: [{use: tests.flow.toys.Keep}]
"""


def test_only_streams_between_those_given_and_the_wanted_one_are_made(tmp_path):
    toys = graph(tmp_path)
    assert evaluate(toys, GIVEN, "sum") == GIVEN | {
        "twice": Couple(7, 10.0), "thrice": Couple(7, 15.0), "sum": Couple(7, 25.0),
    }  # fmt: skip
    found = evaluate(toys, {"sum": Couple(7, 1.0), "height": Number(7, 2.0)}, "raised")
    assert found == {"sum": Couple(7, 1.0), "height": Number(7, 2.0), "raised": Couple(7, 3.0)}
    assert evaluate(toys, GIVEN, "both") == GIVEN
    own = GIVEN | {"twice": Couple(7, 1.0)}  # not that of its input
    assert evaluate(toys, own, "twice") == own
    assert evaluate(toys, own, "sum")["sum"] == Couple(7, 16.0)


@pytest.mark.parametrize(("stage", "error", "why"), [
    ("Liar", TypeError, "Text, not Couple"), ("Late", StageError, "the stamp 8 ns, not that of its frame"),
])  # fmt: skip
def test_a_result_that_a_run_would_lose_is_an_error(tmp_path, stage, error, why):
    text = OPEN.replace("toys.Either, a: both, b: height", f"toys.{stage}, couple: both")
    with pytest.raises(error, match=f"{stage} returned {why}"):
        evaluate(graph(tmp_path, text=text), GIVEN, "either")


def test_a_state_continues_only_where_it_is_kept(tmp_path):
    toys, states = graph(tmp_path), {}
    assert [evaluate(toys, GIVEN, "total", states)["total"].value for _ in range(3)] == [10, 20, 30]
    assert states == {"total": [10, 10, 10]}
    assert [evaluate(toys, GIVEN, "total")["total"].value for _ in range(2)] == [10, 10]


def test_an_input_that_a_stage_can_do_without_may_be_left_out(tmp_path):
    (tmp_path / "open.yaml").write_text(OPEN)
    toys = load(str(tmp_path / "open.yaml"))
    assert evaluate(toys, GIVEN, "either")["either"] == Couple(7, 5.0)
    assert evaluate(toys, GIVEN | {"height": Number(7, 1.0)}, "either")["either"] == Couple(7, 6.0)
    with pytest.raises(UsageError, match=r"stream 'either': Either\.both needs a `b`"):
        evaluate(load(str(tmp_path / "open.yaml"), ["either.both=true"]), GIVEN, "either")


@dataclass(frozen=True)
class Silent:
    def __call__(self, couple: Couple) -> Couple | None:
        return None


def test_a_stream_with_nothing_new_is_absent_with_those_that_need_it(tmp_path):
    toys = graph(tmp_path)
    nodes = tuple(replace(node, actor=Silent()) if node.name == "twice" else node for node in toys.nodes)
    assert evaluate(replace(toys, nodes=nodes), GIVEN, "sum") == GIVEN | {"thrice": Couple(7, 15.0)}


@pytest.mark.parametrize(("given", "wanted", "sentence"), [
    (GIVEN, "summ", "the pipeline has no stream 'summ'; did you mean 'sum'?"),
    ({"sum": Couple(7, 1.0)}, "raised", "'raised' needs a stream that only a run makes from a log; give 'height'"),
    ({}, "left", "'left' needs a stream that only a run makes from a log; give 'left'"),
])  # fmt: skip
def test_what_cannot_be_made_is_refused_in_one_sentence(tmp_path, given, wanted, sentence):
    with pytest.raises(UsageError) as raised:
        evaluate(graph(tmp_path), given, wanted)
    assert str(raised.value) == sentence


def test_a_stage_that_reads_the_log_itself_needs_that_stream(tmp_path):
    toys = graph(tmp_path)
    nodes = tuple(replace(node, inputs={"couple": "left"}) if node.name == "twice" else node for node in toys.nodes)
    with pytest.raises(UsageError, match="'twice' needs a stream that only a run makes from a log; give 'left'"):
        evaluate(replace(toys, nodes=nodes), {}, "twice")


def test_a_name_in_place_of_a_pipeline_is_refused():
    with pytest.raises(UsageError, match=r"must be what flow\.config\.loader\.load returns, not a str"):
        evaluate("rover", GIVEN, "sum")  # type: ignore[arg-type]
