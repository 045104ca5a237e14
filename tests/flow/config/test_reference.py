"""The reference lists what a pipeline can use, with the parameters as a pipeline file writes them."""

import pytest

from flow.config.reference import stage_reference
from flow.errors import UsageError


def parameters(name):
    (node,) = stage_reference(name)
    return {item.name: item for item in node.parameters}


def test_the_reference_lists_every_role():
    roles = {node.use: node.role for node in stage_reference()}
    assert roles["stages.Match"] == "stage"
    assert roles["flow.align.pair"] == "aligner"
    assert roles["recordings.McapSource"] == "source"
    assert roles["recordings.RerunSink"] == "sink"
    assert "stages.Transform" not in roles  # a data type


def test_every_parameter_has_a_meaning():
    missing = [f"{node.use}.{item.name}" for node in stage_reference() for item in node.parameters if not item.meaning]
    assert missing == []


def test_a_stage_has_its_inputs_and_output():
    (match,) = stage_reference("Match")
    assert match.use == "stages.Match"
    assert match.inputs == {"frame": "StereoFrame", "prior": "Disparity | None"}
    assert match.optional_inputs == ("prior",)
    assert match.output == "Disparity"


@pytest.mark.parametrize(("stage", "name", "values", "default"), [
    ("stages.Match", "disparities", "1 to 1024 px", "192 px"),
    ("Match", "paths", "4, 8", "8"),
    ("Binarise", "rover.max_slope", "0 to 89 deg", "20 deg"),
    ("TerrainFeatures", "rover.footprint", "5 cm to 20 m", "1 m"),
    ("flow.align.pair", "slop", "at least 0", "5 ms"),
    ("McapSink", "compression", "lz4, zstd, none", "lz4"),
])  # fmt: skip
def test_ranges_and_defaults_are_written_as_in_a_pipeline_file(stage, name, values, default):
    item = parameters(stage)[name]
    assert (item.range, item.default) == (values, default)


def test_data_types_list_their_fields_and_codes_their_names():
    (reason,), (rover,), (health,) = map(stage_reference, ("CellReason", "Rover", "MatchHealth"))
    assert reason.inputs["UNMATCHED"] == "10"
    assert rover.inputs["max_step"] == "highest step that is not a hazard, m"
    assert list(health.inputs) == ["stamp", "all, near", "repeated"]


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(UsageError, match=r"called 'Mach'; did you mean 'Match'\?"):
        stage_reference("Mach")
