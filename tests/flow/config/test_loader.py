"""A pipeline file that cannot run is refused before anything runs, with file, line and the nearest valid name."""

import math
import re
import textwrap
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flow.config.loader import load
from flow.errors import PipelineError, UsageError
from flow.units import as_written, quantity
from recordings.ros2.tilt_from_msg import AngleField

GOOD = """\
source: {use: tests.flow.toys.Source, gain: 2.5}
streams:
  both:   {use: flow.align.pair, left: left, right: right, slop: 5 ms}
  height: {use: flow.align.interpolate, stream: level, at: both, max_gap: 0.2 s}
  twice:  {use: tests.flow.toys.Scale, couple: both, factor: 25 cm, bad: [1, 2.5]}
  sum:    {use: tests.flow.toys.Add, a: twice, b: height}
sinks:
  - {use: tests.flow.toys.Keep}
"""


def loaded(tmp_path, text=GOOD, overrides=()):
    file = tmp_path / "toy.yaml"
    file.write_text(textwrap.dedent(text))
    return load(str(file), overrides)


def test_a_good_file_becomes_a_graph_with_units_converted(tmp_path):
    graph = loaded(tmp_path)
    nodes = {node.name: node for node in graph.nodes}
    assert nodes["both"].actor.slop == 5_000_000
    assert nodes["height"].actor.max_gap == 200_000_000
    assert nodes["twice"].actor.factor == 0.25
    assert nodes["twice"].actor.bad == (1.0, 2.5)
    assert graph.source.gain == 2.5
    assert graph.clock == "both"
    assert list(graph.frame_streams) == ["both", "height", "twice", "sum"]


@given(st.integers(1, 10**7), st.sampled_from([("us", 3), ("ms", 6), ("s", 9), ("min", 9)]))
def test_times_of_whole_nanoseconds_are_exact(nanoseconds, unit):
    name, digits = unit
    number = Decimal(nanoseconds).scaleb(-digits)
    assert quantity(f"{number} {name}", "ns") == nanoseconds * (60 if name == "min" else 1)


@pytest.mark.parametrize(("text", "number"), [("1e-400 s", 0.0), ("0 s", 0.0), ("1e400 s", math.inf)])
def test_numbers_beyond_float_range_become_zero_or_infinite(text, number):
    assert quantity(text, "ns") == number


def test_streams_may_be_written_in_any_order(tmp_path):
    lines = GOOD.splitlines()
    swapped = "\n".join([*lines[:2], *reversed(lines[2:6]), *lines[6:]])
    assert [node.name for node in loaded(tmp_path, swapped).nodes][-1] == "sum"


def test_a_setting_from_the_command_line_replaces_one_in_the_file(tmp_path):
    graph = loaded(tmp_path, overrides=["twice.factor=3 m", "source.gain=1"])
    assert {n.name: n for n in graph.nodes}["twice"].actor.factor == 3.0
    assert graph.source.gain == 1.0


def test_one_key_of_a_mapping_is_replaced_alone(tmp_path):
    angle = "{field: vector.x, unit: deg, sign: 1}"
    text = f"""\
        source: {{use: recordings.McapSource, pitch: {angle}}}
        streams:
          stereo: {{use: flow.align.pair, left: left, right: right, slop: 5 ms}}
          rectified: {{use: stages.Rectify, frame: stereo}}
        sinks: [{{use: tests.flow.toys.Keep}}]
    """
    settings = [f"source.roll.{key}" for key in ("field=vector.y", "unit=rad", "sign=1")]
    source = loaded(tmp_path, text, ["source.pitch.sign=-1", "source.tilt_model=axis", *settings]).source
    assert source.pitch == AngleField("vector.x", "deg", -1)
    assert source.roll == AngleField("vector.y", "rad", 1)
    with pytest.raises(PipelineError, match=r"--set source.pitch.sign=-2: .*must be one of 1, -1, not -2"):
        loaded(tmp_path, text, ["source.tilt_model=axis", *settings, "source.pitch.sign=-2"])


SHARED_ANGLE = """\
settings: {angle: {field: vector.x, unit: deg, sign: 1}}
source: {use: recordings.McapSource, pitch: $angle, roll: $angle, tilt_model: axis}
streams:
  stereo: {use: flow.align.pair, left: left, right: right, slop: 5 ms}
  rectified: {use: stages.Rectify, frame: stereo}
sinks: [{use: tests.flow.toys.Keep}]
"""


@pytest.mark.parametrize(("overrides", "pitch", "roll"), [
    (["angle.sign=-1"], -1, -1),
    (["source.pitch.sign=-1"], -1, 1),
    (["source.pitch.sign=1", "angle.sign=-1"], 1, -1),
])  # fmt: skip
def test_a_key_of_a_setting_is_replaced_everywhere_or_in_one_entry(tmp_path, overrides, pitch, roll):
    source = loaded(tmp_path, SHARED_ANGLE, overrides).source
    assert source.pitch == AngleField("vector.x", "deg", pitch)
    assert source.roll == AngleField("vector.x", "deg", roll)


@pytest.mark.parametrize(("old", "new", "line", "words"), [
    ("factor", "faktor", 5, ["no input or parameter 'faktor'", "did you mean 'factor'"]),
    ("tests.flow.toys.Scale, couple: both, factor: 25 cm, bad: [1, 2.5]", "stages.Binarise, max_slope: 10 deg", 5,
     ["no input or parameter 'max_slope'", "did you mean 'rover.max_slope'"]),
    ("25 cm", "quick", 5, ["factor", "'quick' is not a number"]),
    ("25 cm", "25 ms", 5, ["'25 ms' is a time", "expected a length in cm or m"]),
    ("25 cm", "25 parsec", 5, ["unknown unit 'parsec'; expected mm, cm, m, km"]),
    ("25 cm", "25 px", 5, ["'25 px' is a number of pixels; expected a length in cm or m"]),
    ("bad: [1, 2.5]", "size: 3 cm", 5, ["'3 cm' is a length; expected a number of pixels, such as 3 px"]),
    ("25 cm", "-1 m", 5, ["at least 0 m"]),
    ("25 cm", "true", 5, ["expected a number in m"]),
    ("5 ms", "-5 ms", 3, ["must be at least 0 ns, not -5 ms"]),
    ("25 cm", ".inf", 5, ["must be a finite number in m"]),
    ("5 ms", "5", 3, ["pair.slop: 5 needs a unit; write 5 ms or 5 s"]),
    ("25 cm", "0.25", 5, ["Scale.factor: 0.25 needs a unit; write 0.25 cm or 0.25 m"]),
    ("25 cm", "'25'", 5, ["25 needs a unit"]),
    ("[1, 2.5]", "3", 5, ["expected a list"]),
    ("a: twice", "a: thrice", 6, ["no stream 'thrice'", "did you mean 'twice'"]),
    ("a: twice, ", "", 6, ["lacks its input 'a'"]),
    ("a: twice", "a: height", 6, ["takes Couple as 'a'", "'height' is Number"]),
    ("couple: both", "couple: sum", 5, ["cycle", "twice -> sum -> twice"]),
    ("right: right", "right: words", 3, ["a Number cannot be paired with a Text"]),
    ("stream: level", "stream: words", 4, ["a Text cannot be interpolated"]),
    ("right: right", "right: left", 3, ["'both' aligns 'left' with itself"]),
    ("stream: level, at: both", "stream: level, at: right", 6, ["different clocks", "align them first"]),
    ("toys.Scale", "toys.Scael", 5, ["no dataclass 'Scael'", "did you mean 'Scale'"]),
    ("flow.toys.Scale", "flaw.toys.Scale", 5, ["cannot import 'tests.flaw.toys'"]),
    ("tests.flow.toys.Scale", "stage.Clean", 5, ["no module 'stage'", "did you mean 'stages.Clean'?"]),
    ("tests.flow.toys.Scale", "stages.matching.Match", 5, ["no dataclass 'Match'; did you mean 'stages.Match'?"]),
    ("flow.align.pair", "flow.aline.pair", 3, ["cannot import 'flow.aline'", "did you mean 'flow.align.pair'?"]),
    ("toys.Add, a: twice, b: height", "toys.Mute, a: twice", 6, ["does not say the type of its input 'a'"]),
    ("toys.Scale", "toys.Keep", 5, ["Keep is no stage"]),
    ("gain: 2.5", "gian: 2.5", 1, ["no parameter 'gian'", "did you mean 'gain'"]),
    ("toys.Keep}", "toys.Keep, only: [sum, twise]}", 8, ["there is no stream 'twise'", "did you mean 'twice'"]),
    ("toys.Keep}", "toys.Keep, only: [sum,\n  twise]}", 9, ["there is no stream 'twise'"]),
    ("2.5}", "*gain}", 1, ["found undefined alias"]),
    ("toys.Keep}", "toys.Keep, only: [sum, level]}", 8,
     ["'level' does not run on the clock of the frames, 'both'; align"]),
    ("  twice:", "  source:", 5, ["'source' cannot name a stream"]),
    ("sinks:", "sinkz:", 7, ["no 'sinkz'", "did you mean 'sinks'"]),
    ("  both:", "  left:", 3, ["'left' is already a stream of the source"]),
    ("  sum: ", "  both:", 6, ["'both' is here twice"]),
    ("  - {use", "  - {use: [", 8, ["not valid YAML"]),
    ("5 ms}", "5 ms", 4, ["not valid YAML: ", "a flow mapping from line 3 on; check indentation"]),
    ("2.5}", "2\x01}", 1, ["not valid YAML: the character #x0001"]),
    ("[1, 2.5]", "[" * 3000, 1, ["nested too deep"]),
    ("2.5}", f"{10**400}}}", 1, ["gain: int too large"]),
    ("2.5}", f"1{'0' * 5000}}}", 1, ["looks like a YAML int but is none; quote it"]),
    ("2.5}", f"0x{'f' * 5000}}}", 1, ["hexadecimal, binary or base-60 number; write a decimal one"]),
    ("2.5}", "0300}", 1, ["YAML reads '0300' as an octal"]),
    ("2.5}", "1:30}", 1, ["YAML reads '1:30' as an octal"]),
    ("sinks:", f"# {'x' * 200_000}\nsinks:", 1, ["too large for a pipeline file (limit: 200000 characters)"]),
    ("25 cm", "2001-99-99", 5, ["'2001-99-99' looks like a YAML timestamp but is none; quote it"]),
    ("  twice:", "  my-twice:", 5, ["'my-twice' cannot name a stream"]),
    ("  twice:", "  yes:", 5, ["'yes' is not a name", "quoted"]),
    ("  twice:", "  ? [1]\n  :", 5, ["a list or a mapping is not a name"]),
    ("a: twice", "a: [twice]", 6, ["'a' must be the name of a stream, not ['twice']"]),
    ("tests.flow.toys.Add", "[tests.flow.toys.Add]", 6, ["'use: ['tests.flow.toys.Add']' must be a module and"]),
    ("tests.flow.toys.Add", "tests..toys.Add", 6, ["'use: tests..toys.Add' must be a module and a class"]),
    ("gain: 2.5", "optional: true", 1, ["no parameter 'optional'"]),
    ("toys.Keep", "toys.Keep, optional: true", 8, ["no parameter 'optional'"]),
    ("a: twice, ", "a: twice, optional: maybe, ", 6, ["'optional' must be true or false, not maybe"]),
    ("tests.flow.toys.Source, gain: 2.5", "tests.flow.toys.Scale", 1, ["is no source: it has no 'streams'"]),
    ("toys.Keep", "toys.Scale", 8, ["tests.flow.toys.Scale is no sink: it has no 'suffix'"]),
])  # fmt: skip
def test_a_mistake_is_named_with_its_line(tmp_path, old, new, line, words):
    assert old in GOOD
    with pytest.raises(PipelineError) as caught:
        loaded(tmp_path, GOOD.replace(old, new, 1))
    message = str(caught.value)
    assert message.startswith(f"toy.yaml:{line}: "), message
    for word in words:
        assert word in message


@pytest.mark.parametrize(("text", "why"), [
    *((text, r"\d: ") for text in ("just words", "[1, 2]", "streams: {}", "source: 3\nstreams: 4\nsinks: 5")),
    *((text, "1: .*; begin with a copy of .*/flow/pipelines/rover.yaml") for text in ("", "source: {use: a.B}")),
    ("a: &a [*a]\n", r"\d: .*anchor"),
])  # fmt: skip
def test_a_file_that_is_no_pipeline_is_refused(tmp_path, text, why):
    with pytest.raises(PipelineError, match=rf"toy\.yaml:{why}"):
        loaded(tmp_path, text)


SETTINGS = "settings: {stretch: 25 cm}\n" + GOOD.replace("factor: 25 cm", "factor: $stretch")


def test_a_setting_is_filled_in_wherever_it_is_named(tmp_path):
    def factor(**options):
        return next(node.actor.factor for node in loaded(tmp_path, SETTINGS, **options).nodes if node.name == "twice")

    assert factor() == 0.25
    assert factor(overrides=["stretch=3 m"]) == 3
    assert factor(overrides=["twice.factor=4 m"]) == 4


@pytest.mark.parametrize(("text", "overrides", "message"), [
    (SETTINGS.replace("$stretch", "$strech"), [], r"toy.yaml:6: there is no setting 'strech'; did you mean 'stretch'"),
    (SETTINGS.replace("$stretch", "2 m"), [], r"toy.yaml:1: the setting 'stretch' is not used"),
    (SETTINGS.replace("25 cm", "25 s"), [], r"toy.yaml:1: .*'25 s' is a time"),
    (SETTINGS.replace("25 cm", "25"), [], r"toy.yaml:1: .*Scale.factor: 25 needs a unit; write 25 cm or 25 m"),
    (SETTINGS, ["stretch=20"], r"--set stretch=20: .*Scale.factor: 20 needs a unit; write 20 cm or 20 m"),
    (SETTINGS, ["twice.factor=20"], r"--set twice.factor=20: .*20 needs a unit; write 20 cm or 20 m"),
    (SETTINGS, ["stretch=-1 m"], r"--set stretch=-1 m: .*at least 0 m"),
    (SETTINGS, ["strech=1 m"], r"--set strech=1 m: the pipeline has no setting 'strech'; did you mean 'stretch'"),
    (SETTINGS, ["disparities=1"], r"--set disparities=1: the pipeline has no setting 'disparities'; it has .*stretch"),
    (SETTINGS, ["strech.a=1 m"], r"--set strech.a=1 m: there is no stream 'strech'; did you mean 'stretch'"),
    (SETTINGS, ["Scale.factor=1 m"], r"--set Scale.factor=1 m: write the stream in place of its class 'Scale': twice"),
    (SETTINGS, ["streams.twice.factor=1 m"], r"--set streams.twice.factor=1 m: leave out 'streams.'"),
    (SETTINGS, ["twice=1 m"], r"--set twice=1 m: name the parameter of 'twice', as in twice.parameter=value"),
    (SETTINGS, ["twice.optional=maybe"], r"--set twice.optional=maybe: 'optional' must be true or false, not maybe"),
    (SETTINGS.replace("settings", "setings"), [], r"toy.yaml:1: a pipeline has no 'setings'; did you mean 'settings'"),
    (SETTINGS.replace("{stretch: 25 cm}", "{stretch: $other, other: 1 m}"), [], r"toy.yaml:1: .*'stretch' refers"),
    ("settings: 3\n" + GOOD, [], r"toy.yaml:1: 'settings' must be a mapping"),
    (SETTINGS, ["stretch.sign=1"], r"--set stretch.sign=1: 'stretch' is '25 cm', not a mapping with 'sign'"),
    (SETTINGS, ["stretch=1e400"], r"--set stretch=1e400: .*Scale.factor: must be a finite number in m, not 1e400"),
])  # fmt: skip
def test_an_invalid_setting_is_named(tmp_path, text, overrides, message):
    with pytest.raises((PipelineError, UsageError), match=message):
        loaded(tmp_path, text, overrides=overrides)


def test_a_mapping_that_is_needed_cannot_be_null():
    with pytest.raises(PipelineError, match=r"--set rover=null: stages.TerrainFeatures.rover: expected a mapping, not"):
        load("rover", ["rover=null"])


@pytest.mark.parametrize("setting", [
    "nonsense", "twise.factor=3", "twice.faktor=3", "twice.bad=[", "twice.bad=!!python/x y", "twice.factor.sign=3",
    "twice.bad=!!int x", "twice.bad=&a [*a]",
])  # fmt: skip
def test_an_invalid_set_option_is_named(tmp_path, setting):
    with pytest.raises((PipelineError, UsageError), match="--set"):
        loaded(tmp_path, overrides=[setting])


SCALE = "tests.flow.toys.Scale, couple: both, factor: 25 cm, bad: [1, 2.5]"
ADD = "tests.flow.toys.Add, a: twice, b: height"
IMPORTS = "from __future__ import annotations\nfrom tests.flow.toys import *\n"
IMPORTS += "from collections.abc import Sequence; from typing import Literal\n"
OWN = (
    IMPORTS
    + """@dataclass(frozen=True)
class Own:
    a: {field} = 0
    def __call__(self, {takes}) -> {returns}: ...
"""
)
ODD = IMPORTS + "@dataclass(frozen=True)\nclass Own(Add):\n    __call__ = Add.__call__\n"
ODD += "    def __post_init__(self):\n        {}['nix']\n"
IDLE = OWN.format(field="int", takes="a: Couple | None = None", returns="Couple")
PLAIN = "class Own:\n    def __call__(self): ...\n"


def own(field="int", takes="couple: Couple", returns="Couple"):
    return OWN.format(field=field, takes=takes, returns=returns)


@pytest.mark.parametrize(("source", "replaced", "entry", "message"), [
    ("1 / 0\n", SCALE, "Own",
     "5: cannot import 'MODULE': ZeroDivisionError: division by zero (MODULE.py, line 1; --debug"),
    ("import sys\nsys.exit(3)\n", SCALE, "Own", "5: cannot import 'MODULE': SystemExit: 3"),
    (own(field="list[Nix]"), SCALE, "Own, couple: both",
     "5: the annotations of Own cannot be read: name 'Nix' is not defined"),
    (own(takes="couple: Nix"), SCALE, "Own, couple: both",
     "5: the annotations of Own.__call__ cannot be read: name 'Nix' is not defined"),
    (own(takes="*couple: Couple"), SCALE, "Own, couple: both", "5: Own.__call__ must take each input by its name"),
    (own(returns="Couple | Number"), SCALE, "Own, couple: both",
     "5: Own.__call__ does not say which one type it returns"),
    (IDLE, ADD, "Own", "6: 'sum' has no input"),
    (ODD, ADD, "Own, a: twice, b: height", "6: KeyError: 'nix' (MODULE.py, line 8; --debug"),
    (PLAIN, SCALE, "Own", "5: MODULE.Own is not a dataclass; decorate"),
    (IMPORTS + "class Own(Scale):\n    more: int = field(default=0)\n", SCALE, "Own, couple: both",
     "5: MODULE.Own has parameters, but is not a dataclass; decorate it with @dataclass(frozen=True)"),
    (PLAIN + "def function(): ...\n", SCALE, "function",
     "5: MODULE.function is not a dataclass; a stage is a class with __call__"),
    *((own(field=field), SCALE, f"Own, couple: both, a: {value}", f"5: MODULE.Own.a: {why}") for field, value, why in (
        ("list[int]", "[1, 'x']", "'x' is not a number"), ("Sequence[int]", "5", "expected a list, not 5"),
        ("tuple[int, str]", "[1, 2]", "expected a text, not 2"), ("dict[str, int]", "{n: x}", "'x' is not a number"),
        ("tuple[int, str]", "[1]", "expected 2 values, not [1]"), ("dict[str, int]", "3", "expected a mapping, not 3"),
        ("Literal['x', 'y']", "z", "must be one of x, y, not 'z'"),
        ("bool", "'no'", "expected true or false, not 'no'"),
    )),
])  # fmt: skip
def test_a_mistake_in_a_module_of_ones_own_is_named_with_its_line(tmp_path, source, replaced, entry, message):
    module = f"own_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(source)
    with pytest.raises(PipelineError, match=re.escape(f"toy.yaml:{message.replace('MODULE', module)}")) as caught:
        loaded(tmp_path, GOOD.replace(replaced, f"{module}.{entry}"))
    assert "did you mean" not in str(caught.value)  # such as the refused name itself


def test_the_invalid_one_of_several_settings_is_named(tmp_path):
    (tmp_path / "strict.py").write_text(
        ODD.replace("Add", "Scale").replace("{}['nix']", "raise ValueError('Own.nap: no')")
    )
    text = GOOD.replace("tests.flow.toys.Scale", "strict.Own")
    with pytest.raises(PipelineError, match=r"--set twice.nap=1 s: Own.nap: no"):
        loaded(tmp_path, text, overrides=["twice.nap=1 s", "twice.factor=2 m"])


def test_stages_may_be_in_the_folder_of_the_pipeline_file(tmp_path):
    (tmp_path / "beside.py").write_text("from tests.flow.toys import Scale\nclass Near(Scale):\n    pass\n")
    text = GOOD.replace("tests.flow.toys.Scale", "beside.Near")
    assert {node.name: node.use for node in loaded(tmp_path, text).nodes}["twice"] == "beside.Near"


RANGED = """
from dataclasses import dataclass
from stages.stage import Stage, parameter
from tests.flow.toys import Couple

@dataclass(frozen=True)
class Ranged(Stage):
    widths: tuple[float, ...] = parameter((1.0, 2.0), "widths", unit="m", low=0)
    share: float = parameter(0.1, "share", unit="share")

    def __call__(self, couple: Couple) -> Couple:
        return couple
"""


@pytest.mark.parametrize("name", ["near", "statistics"])
def test_a_module_is_that_beside_the_pipeline_file_or_refused(tmp_path, name):
    text = GOOD.replace("tests.flow.toys.Scale", f"{name}.Near")
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{name}.py").write_text(
            f"from tests.flow.toys import Scale\nclass Near(Scale):\n    folder = '{folder}'\n"
        )
    if name == "near":
        assert loaded(tmp_path / "first", text)
    taken = rf"toy.yaml:\d+: the name '{name}' is taken by another module \(.*\); rename .*second/{name}.py"
    with pytest.raises(PipelineError, match=taken):
        loaded(tmp_path / "second", text)


@pytest.mark.parametrize("init", [True, False])
def test_a_module_of_a_package_is_that_beside_the_pipeline_file_or_refused(tmp_path, init):
    name, text = f"package_{init}", GOOD.replace("tests.flow.toys.Scale", f"package_{init}.near.Near")
    for folder in ("first", "second"):
        (tmp_path / folder / name).mkdir(parents=True)
        module = f"from tests.flow.toys import Scale\nclass Near(Scale):\n    folder = '{folder}'\n"
        (tmp_path / folder / name / "near.py").write_text(module)
        if init:
            (tmp_path / folder / name / "__init__.py").touch()
    assert loaded(tmp_path / "first", text)
    with pytest.raises(PipelineError, match=rf"the name '{name}.near' is taken by another module \(.*first/"):
        loaded(tmp_path / "second", text)


def test_a_list_may_have_a_range_and_a_share_is_offered_in_percent(tmp_path):
    (tmp_path / "ranged.py").write_text(RANGED)
    text = GOOD.replace("tests.flow.toys.Scale, couple: both, factor: 25 cm", "ranged.Ranged, couple: both, %s")
    text = text.replace(", bad: [1, 2.5]", "")
    twice = {node.name: node.actor for node in loaded(tmp_path, text % "widths: [1 m, 20 cm]").nodes}["twice"]
    assert twice.widths == (1.0, 0.2)
    with pytest.raises(PipelineError, match=r"toy.yaml:5: ranged.Ranged.widths: must be at least 0 m, not -1 m"):
        loaded(tmp_path, text % "widths: [1 m, -1 m]")
    with pytest.raises(PipelineError, match=r"ranged.Ranged.share: 0.07 needs a unit; write 7 %"):
        loaded(tmp_path, text % "share: 0.07")


@pytest.mark.parametrize(("value", "unit", "text"), [
    (100_000_000, "ns", "100 ms"), (0.05, "m", "5 cm"), (math.radians(60), "rad", "60 deg"), (12.0, "m", "12 m"),
    (0, "ns", "0"), (128, "px", "128"),
])  # fmt: skip
def test_numbers_are_written_in_the_unit_that_a_user_would_choose(value, unit, text):
    assert as_written(value, unit) == text
    assert quantity(text, unit) == pytest.approx(value)


def test_a_unit_that_only_one_parameter_has_may_be_written():
    nodes = {node.name: node.actor for node in load("rover", ["disparity/full.max_memory=300 MB"]).nodes}
    assert nodes["disparity/full"].max_memory == 300


def test_a_text_in_place_of_a_list_of_changes_is_refused():
    with pytest.raises(UsageError, match=r"the overrides must be a list of texts, such as \['disparities=64'\]"):
        load("rover", "disparities=64")


def test_a_pipeline_that_is_not_there_may_be_given_as_a_path(tmp_path):
    with pytest.raises(UsageError, match=r"no pipeline '.*a.yaml': neither a file nor one of"):
        load(tmp_path / "a.yaml")


def test_a_binary_pipeline_file_is_refused_with_the_valid_names(tmp_path):
    (tmp_path / "t.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(UsageError, match=r"t.mcap is not text in UTF-8; give accurate, fast, .*or a YAML file"):
        load(str(tmp_path / "t.mcap"))
