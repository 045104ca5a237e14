"""Stages: `help()` shows the meaning of every parameter."""

from __future__ import annotations

import pytest

import stages
from flow.config.reference import stage_reference
from stages.stage import Stage

NAMED = {name: getattr(stages, name) for name in stages.__all__}
KINDS = {name: kind for name, kind in NAMED.items() if isinstance(kind, type) and issubclass(kind, Stage)}


@pytest.mark.parametrize("name", sorted(KINDS))
def test_help_shows_the_meaning_of_every_parameter(name: str) -> None:
    (found,) = stage_reference(name)
    text = KINDS[name].__doc__
    assert text.count("\nParameters\n----------\n") == bool(found.parameters)
    for item in found.parameters:
        assert item.meaning in text or "." in item.name  # those of a value such as the rover stand in its own help
