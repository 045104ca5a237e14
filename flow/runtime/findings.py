"""What there is to say of a whole run or log, a sentence for a stream: a note, or a warning that must not be missed.

A warning is no loss: it changes neither the ledger nor the verdict. Findings are plain dictionaries with a "severity"
and a "sentence", as the summary has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flow.runtime.graph import Graph
from flow.runtime.ledger import failure

Finding = dict[str, str]

NOTE, WARNING = "note", "warning"


def finding(severity: str, sentence: str) -> Finding:
    """One finding, as the summary has it."""
    return {"severity": severity, "sentence": sentence}


def plain(said: Any) -> Finding:
    """A finding out of what a stage returns: an object with `severity` and `sentence`; what is none, or has a severity
    that is none, is a warning that says so."""
    if not (hasattr(said, "severity") and hasattr(said, "sentence")):
        return finding(WARNING, f"its finding must have a severity and a sentence, or be None, not {said!r:.80}")
    severity, sentence = str(said.severity), str(said.sentence)
    if severity not in (NOTE, WARNING):
        wrong = f"a {type(said).__name__}'s severity must be {NOTE} or {WARNING}, not '{severity}'"
        severity, sentence = WARNING, f"{sentence} ({wrong})"
    return finding(severity, sentence)


def findings(graph: Graph, states: Mapping[str, Any]) -> dict[str, Finding]:
    """What there is to say at the end of a run: what was left out, and what the `finding(state)` of stages returns."""
    said = {name: finding(NOTE, f"left out: {why}") for name, why in graph.left_out.items()}
    for node in graph.stages:
        if not (node.stateful and hasattr(node.actor, "finding")):
            continue
        try:
            returned = node.actor.finding(states[node.name])
            if returned is not None:
                said[node.name] = plain(returned)
        except Exception as error:  # no reason to leave the outputs open
            said[node.name] = finding(WARNING, failure(error))
    return said


def lines(found: Mapping[str, Finding], severity: str) -> list[str]:
    """The findings of this severity, a line each."""
    return [f"{name}: {item['sentence']}" for name, item in found.items() if item["severity"] == severity]
