"""The findings of a run: what was left out, and what its stages found in the whole log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from flow.contracts import Finding, Severity, StageError
from flow.runtime.graph import Graph
from flow.runtime.ledger import failure


def warning(sentence: str) -> Finding:
    """A finding that results may be wrong."""
    return Finding(sentence, Severity.WARNING)


def checked(returned: Any) -> Finding | None:
    """What a stage returned as its finding; raises StageError for anything but a Finding or None."""
    if isinstance(returned, Finding | None):
        return returned
    raise StageError(f"the stage must return a flow.contracts.Finding or None, not {returned!r:.80}")


def findings(graph: Graph, states: Mapping[str, Any], surveys: Mapping[str, Finding]) -> dict[str, Finding]:
    """Stream -> finding at the end of a run: why it was left out, or what `finding(state)` of its stage returns.

    surveys: stream -> finding of its pre-pass.
    """
    found: dict[str, Finding | None] = {name: Finding(f"left out: {why}") for name, why in graph.left_out.items()}
    for node in graph.stages:
        if node.stateful and hasattr(node.actor, "finding"):
            try:
                found[node.name] = checked(node.actor.finding(states[node.name]))
            except Exception as error:  # must not leave the outputs open
                found[node.name] = warning(failure(error))
    return explained({name: finding for name, finding in found.items() if finding is not None}, surveys)


def explained(found: dict[str, Finding], surveys: Mapping[str, Finding]) -> dict[str, Finding]:
    """The findings, with notes in place of the warnings that a fault in them or in the surveys may explain."""
    every = [*found.items(), *surveys.items()]
    faults = {finding.about: name for name, finding in every if finding.severity is Severity.FAULT}
    for name, finding in found.items():
        if finding.severity is Severity.WARNING and finding.assumes and finding.assumes in faults:
            cause = f"The fault that {faults[finding.assumes]} reports may be the cause."
            found[name] = replace(finding, severity=Severity.NOTE, sentence=f"{finding.sentence} {cause}")
    return found


def has_fault(found: Mapping[str, Finding]) -> bool:
    """Whether any finding is a fault."""
    return any(finding.severity is Severity.FAULT for finding in found.values())


def as_dicts(found: Mapping[str, Finding]) -> dict[str, dict[str, str]]:
    """Findings as the summary holds them, in plain JSON values."""
    return {name: finding.as_dict() for name, finding in found.items()}


def lines(found: Mapping[str, Mapping[str, str]], severity: str) -> list[str]:
    """The findings of a summary that have this severity, one line each."""
    return [f"{name}: {item['sentence']}" for name, item in found.items() if item["severity"] == severity]
