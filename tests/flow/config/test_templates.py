"""Templates are expanded when a pipeline is loaded; their inner streams are streams like any other."""

import textwrap
from typing import Any

import pytest

from flow.config.draw import draw
from flow.config.loader import load, shipped
from flow.config.templates import SHIPPED
from flow.errors import PipelineError

TOY = """\
settings: {stretch: 25 cm}
templates:
  scaled_twice:
    inputs: {couple: Couple}
    parameters: {factor: 2 m, second: 3 m}
    output: last
    streams:
      first: {use: tests.flow.toys.Scale, couple: couple, factor: $factor}
      last:  {use: tests.flow.toys.Scale, couple: first, factor: $second}
source: {use: tests.flow.toys.Source}
streams:
  both: {use: flow.align.pair, left: left, right: right}
  out:  {template: scaled_twice, couple: both, factor: $stretch}
  sum:  {use: tests.flow.toys.Add, a: out, b: out/first}
sinks:
  - {use: tests.flow.toys.Keep}
"""
NESTED = TOY.replace("source: {use", """\
  outer:
    inputs: {couple: Couple}
    parameters: {factor: 1 m}
    output: end
    streams:
      begin: {template: scaled_twice, couple: couple, factor: $factor}
      end:   {template: scaled_twice, couple: begin/first}
source: {use""", 1)  # fmt: skip
NESTED = NESTED.replace("scaled_twice, couple: both", "outer, couple: both").replace("out/first", "out/begin")


def loaded(tmp_path, text=TOY, overrides=()):
    file = tmp_path / "toy.yaml"
    file.write_text(textwrap.dedent(text))
    return load(str(file), overrides)


def factors(graph):
    return {node.name: node.actor.factor for node in graph.nodes if hasattr(node.actor, "factor")}


def refusal(tmp_path, text=TOY, overrides=()):
    with pytest.raises(PipelineError) as caught:
        loaded(tmp_path, text, overrides)
    return str(caught.value)


def test_the_output_has_the_name_of_the_use_and_inner_streams_a_path(tmp_path):
    nodes = {node.name: node for node in loaded(tmp_path).nodes}
    assert list(nodes) == ["both", "out/first", "out", "sum"]
    assert nodes["out/first"].inputs == {"couple": "both"}
    assert nodes["out"].inputs == {"couple": "out/first"}
    assert nodes["sum"].inputs == {"a": "out", "b": "out/first"}


def test_a_use_sets_parameters_and_keeps_the_defaults_of_others(tmp_path):
    assert factors(loaded(tmp_path)) == {"out/first": 0.25, "out": 3.0}


@pytest.mark.parametrize(("override", "expected"), [
    ("stretch=4 m", {"out/first": 4.0, "out": 3.0}),
    ("out.second=5 m", {"out/first": 0.25, "out": 5.0}),
    ("out/first.factor=6 m", {"out/first": 6.0, "out": 3.0}),
    ("out/last.factor=7 m", {"out/first": 0.25, "out": 7.0}),
    ("out/first.factor=$stretch", {"out/first": 0.25, "out": 3.0}),
])  # fmt: skip
def test_the_command_line_sets_parameters_and_inner_streams(tmp_path, override, expected):
    assert factors(loaded(tmp_path, overrides=[override])) == expected


def test_a_parameter_of_the_output_is_set_by_the_name_of_the_use(tmp_path):
    graph = loaded(tmp_path, overrides=["out.bad=[1, 2]"])
    assert {node.name: node for node in graph.nodes}["out"].actor.bad == (1.0, 2.0)


def test_templates_use_templates(tmp_path):
    graph = loaded(tmp_path, NESTED)
    assert factors(graph) == {
        "out/begin/first": 0.25, "out/begin": 3.0, "out/end/first": 2.0, "out": 3.0
    }  # fmt: skip
    nodes = {node.name: node for node in graph.nodes}
    assert nodes["out/end/first"].inputs == {"couple": "out/begin/first"}
    changed = loaded(tmp_path, NESTED, ["out/begin.second=9 m", "out/end/last.factor=8 m"])
    assert factors(changed) == {
        "out/begin/first": 0.25, "out/begin": 9.0, "out/end/first": 2.0, "out": 8.0
    }  # fmt: skip
    assert factors(loaded(tmp_path, NESTED, ["out.template=scaled_twice", "sum.b=out"])) == factors(loaded(tmp_path))


def test_optional_applies_to_the_inner_streams(tmp_path):
    text = TOY.replace("couple: both,", "couple: both, optional: true,").replace("a: out, b: out/first", "a: both")
    graph = loaded(tmp_path, text.replace("Add, a: both", "Either, a: both"))
    assert {node.name: node.optional for node in graph.nodes} == {
        "both": False, "out/first": True, "out": True, "sum": False
    }  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), [
    ("{template: scaled_twice", "{template: scald_twice",
     "toy.yaml:13: there is no template 'scald_twice'; did you mean 'scaled_twice'?"),
    ("{template: scaled_twice", "{template: mine.yaml",
     "toy.yaml:13: there is no template 'mine.yaml'; write it under 'templates' in the pipeline file"),
    ("couple: both, factor", "factor",
     "toy.yaml:13: 'out' lacks its input 'couple' (template 'scaled_twice' needs it)"),
    ("both, factor:", "both, faktor:",
     "toy.yaml:13: template 'scaled_twice' has no input or parameter 'faktor'; did you mean 'factor'?"),
    ("couple: both,", "couple: bath,", "toy.yaml:13: there is no stream 'bath'; did you mean 'both'?"),
    ("couple: both,", "couple: left,",
     "toy.yaml:13: template 'scaled_twice' takes Couple as 'couple', but 'left' is Number"),
    ("output: last", "output: lost",
     "toy.yaml:6: the output 'lost' is not a stream of 'scaled_twice'; did you mean 'last'?"),
    ("    output: last\n", "", "toy.yaml:3: template 'scaled_twice' lacks 'output'"),
    ("    inputs:", "    input:", "toy.yaml:4: template 'scaled_twice' has no 'input'; did you mean 'inputs'?"),
    ("      first:", "      couple:", "toy.yaml:8: 'couple' is already an input of template 'scaled_twice'"),
    ("factor: $second", "factor: 1 m",
     "toy.yaml:5: the parameter 'second' of 'scaled_twice' is not used; write $second to use it, or remove it"),
    ("inputs: {couple: Couple}", "inputs: {couple: Couple, spare: Couple}",
     "toy.yaml:4: no stream of 'scaled_twice' reads its input 'spare'; connect it, or remove it"),
    ("factor: $second", "factor: $secund",
     "toy.yaml:9: template 'scaled_twice' has no parameter 'secund'; did you mean 'second'?"),
    ("couple: first", "couple: $couple",
     "toy.yaml:9: 'couple' is an input of template 'scaled_twice'; write it without $"),
    ("inputs: {couple: Couple}", "inputs: {couple: Cuple}",
     "toy.yaml:4: 'couple' has an unknown type, 'Cuple'; did you mean 'Couple'?"),
    ("couple: first", "couple: frist",
     "toy.yaml:9: the template has no stream or input 'frist'; did you mean 'first'? (template used at toy"),
    ("couple: couple, factor", "couple: couple, faktor",
     ("toy.yaml:8: tests.flow.toys.Scale has no input or parameter 'faktor'; did you mean 'factor'? "
      "(template used at toy.yaml:13)")),
    ("second: 3 m", "second: 3 s",
     ("toy.yaml:5: tests.flow.toys.Scale.factor: '3 s' is a time; expected a length in cm or m "
      "(template used at toy.yaml:13)")),
    ("stretch: 25 cm", "stretch: 25 s", "toy.yaml:1: tests.flow.toys.Scale.factor: '25 s' is a time"),
    ("out:  {", "out:  {use: tests.flow.toys.Scale, ", "toy.yaml:13: an entry must have 'use' or 'template', not "),
    ("b: out/first", "b: out/frist", "toy.yaml:14: there is no stream 'out/frist'; did you mean 'out/first'?"),
    ("templates:", "template:", "toy.yaml:2: a pipeline has no 'template'; did you mean 'templates'?"),
])  # fmt: skip
def test_a_mistake_is_one_sentence_with_both_lines(tmp_path, old, new, message):
    assert old in TOY
    assert refusal(tmp_path, TOY.replace(old, new, 1)).startswith(message)


def test_a_mistake_in_a_nested_template_names_every_use(tmp_path):
    sentence = refusal(tmp_path, NESTED.replace("second: 3 m", "second: 3 s"))
    assert sentence.startswith("toy.yaml:5: ")
    assert sentence.endswith("(template used at toy.yaml:15) (template used at toy.yaml:20)")


def test_a_template_that_uses_itself_is_refused(tmp_path):
    text = NESTED.replace("first: {use: tests.flow.toys.Scale,", "first: {template: outer,")
    assert "template 'outer' uses itself: outer -> scaled_twice -> outer" in refusal(tmp_path, text)


@pytest.mark.parametrize(("override", "message"), [
    ("out/frist.factor=1 m", "there is no stream 'out/frist'; did you mean 'out/first'?"),
    ("out.secnd=1 m", "neither template 'scaled_twice' nor its output, tests.flow.toys.Scale, has 'secnd'; did"),
    ("out.second=1 s", "tests.flow.toys.Scale.factor: '1 s' is a time"),
    ("out/first.factor=1", "tests.flow.toys.Scale.factor: 1 needs a unit"),
    ("out=1", "name the parameter of 'out', as in out.parameter=value"),
    ("out/first=1", "name the parameter of 'out/first', as in out/first.parameter=value"),
])  # fmt: skip
def test_a_bad_setting_of_a_template_is_named(tmp_path, override, message):
    assert refusal(tmp_path, overrides=[override]).startswith(f"--set {override}: {message}")


def test_graph_draws_a_template_as_one_box_or_its_streams(tmp_path):
    graph = loaded(tmp_path)
    folded, expanded = draw(graph, "text"), draw(graph, "text", expand=True)
    assert "Couple        = scaled_twice(both, factor=25 cm), 2 streams: --expand" in folded
    assert "out/first" not in folded.replace("sum   Couple        = tests.flow.toys.Add(out, out/first)", "")
    assert "out/first  Couple        = tests.flow.toys.Scale(both, factor=25 cm)" in expanded
    assert "Couple        = outer(both, factor=25 cm), 4 streams: --expand" in draw(loaded(tmp_path, NESTED), "text")
    for form in ("mermaid", "svg"):
        assert "scaled_twice" in draw(graph, form)
        assert "out/first" in draw(graph, form, expand=True)


def test_the_shipped_pipelines_are_short():
    lines = {name: len((SHIPPED / f"{name}.yaml").read_text().splitlines()) for name in shipped()}
    assert lines["rover"] <= 70
    assert sum(lines.values()) <= 200 * len(lines) / 3


@pytest.mark.parametrize("name", ["rover", "fast", "accurate"])
def test_one_rover_reaches_every_stage_that_needs_it(name):
    nodes = load(name, ["rover.max_step=40 cm", "rover.wheel=60cm"]).nodes
    rovers = [node.actor.rover for node in nodes if hasattr(node.actor, "rover")]
    assert len(rovers) == 4
    assert {(rover.max_step, rover.wheel, rover.footprint) for rover in rovers} == {(0.4, 0.6, 1.0)}


@pytest.mark.parametrize(("override", "message"), [
    ("rover.max_stp=1m", "stages.TerrainFeatures.rover has no parameter 'max_stp'; did you mean 'max_step'?"),
    ("rover.max_step=1s", "stages.TerrainFeatures.rover.max_step: '1s' is a time; expected a length in cm or m"),
    ("rover.wheel=1km", "stages.TerrainFeatures.rover.wheel: must be at most 5 m, not 1km"),
    ("rover=3", "stages.TerrainFeatures.rover: expected a mapping of footprint, wheel_track, wheel, max_step"),
    ("McapSink.compresion=zstd", "recordings.McapSink has no parameter 'compresion'; did you mean 'compression'?"),
    ("McapSink.compression=zip", "recordings.McapSink.compression: must be one of lz4, zstd, none, not zip"),
    ("McapSnk.compression=zstd", "there is no stream 'McapSnk'; did you mean 'McapSink'?"),
    ("McapSink.also=[disparity/fall]", "there is no stream 'disparity/fall'; did you mean 'disparity/full'?"),
    ("RerunSink.without=[cloud, clowd]", "no stream of the frames matches 'clowd'; did you mean 'cloud'?"),
    ("RerunSink.live_pipe=3", "recordings.RerunSink has no parameter 'live_pipe'; it has max_width, jpeg_quality"),
])  # fmt: skip
def test_a_mistake_in_the_rover_or_a_sink_names_the_setting(override, message):
    with pytest.raises(PipelineError) as caught:
        load("rover", [override])
    assert str(caught.value).startswith(f"--set {override}: {message}")


def test_the_command_line_sets_parameters_of_sinks():
    graph = load("rover", ["McapSink.compression=zstd", "McapSink.also=[disparity/full]"])
    sink: Any = dict(graph.sinks)["recordings.McapSink"]
    assert (sink.compression, sink.also) == ("zstd", ("disparity/full",))


@pytest.mark.parametrize("uses", ["a: {template: t%d}, b: {template: t%d}", "a: {template: t%d}"])
def test_templates_that_multiply_or_nest_streams_endlessly_are_refused(tmp_path, uses):
    inner = [uses.replace("%d", str(number + 1)) for number in range(400)]
    templates = "".join(f"  t{number}: {{output: a, streams: {{{used}}}}}\n" for number, used in enumerate(inner))
    text = TOY.replace("source: {use", f"{templates}source: {{use", 1)
    text = text.replace("sinks:", "  more: {template: t0}\nsinks:")
    assert "the pipeline has more than 300 streams" in refusal(tmp_path, text)
