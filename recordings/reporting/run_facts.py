"""What a report says about a result log, read in one pass."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from recordings.export.map_files import DIAGNOSTICS, REGIONAL, MapFiles, part_with
from recordings.export.png_pages import PAGES
from recordings.mcap.file import by_stamp, iter_decoded
from recordings.ros2.from_msg import losses_in, read_disparity, read_occupancy_grid
from recordings.scoring.result_log import check_profile, end_of_run, facts_of
from stages.data import Cell

TOPICS = (*PAGES, "/nav/pose", DIAGNOSTICS, *filter(None, REGIONAL))


@dataclass
class RunFacts:
    """A result log in figures.

    about, counts: facts of the run, and its verdict, counts and findings; unreadable: reason -> number of messages;
    stamps: of the frames, ns; series: name with unit -> stamp -> value; tracks: frame of reference -> (x, y) of the
    rover, m; losses: (stream, stamp, reason, detail); drawn: name -> stamp and messages by topic, of the frames that
    are drawn; regional: name -> each part of the regional map.
    """

    path: Path
    about: dict[str, str]
    counts: dict[str, str]
    unreadable: Counter[str] = field(default_factory=Counter)
    stamps: list[int] = field(default_factory=list)
    series: dict[str, dict[int, float]] = field(default_factory=dict)
    tracks: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    losses: list[tuple[str, str, str, str]] = field(default_factory=list)
    drawn: dict[str, tuple[int, dict[str, Any]]] = field(default_factory=dict)
    regional: dict[str, MapFiles] = field(default_factory=dict)


def read_facts(path: Path, beside: Mapping[str, tuple[int, Any]] | None = None) -> RunFacts:
    """Read a result log twice: once for its figures, and once for the frames that are drawn.

    beside: what is drawn of a result that stands beside it; the frames of the same stamps are drawn, if it has them.
    Raises LogError if the file is not a result log, or cannot be read.
    """
    about = facts_of(path, "a log that roverflow run wrote")
    check_profile(path, about)
    facts = RunFacts(path, about, end_of_run(path))
    for stamp, messages in by_stamp(path, TOPICS, facts.unreadable):
        for topic, found in messages.items():
            for message in found:
                _add(facts, topic, stamp, message)
        if part := part_with(facts.regional, REGIONAL, messages, wanted=("elevation",)):
            part.add(path, REGIONAL, messages)
    facts.stamps = sorted({stamp for values in facts.series.values() for stamp in values})
    chosen = {name: stamp for name, (stamp, _) in (beside or {}).items()}
    if not chosen or not set(chosen.values()) <= set(facts.stamps):
        chosen = _chosen(facts)
    frames = {stamp: dict[str, Any]() for stamp in chosen.values()}
    if frames:
        for topic, stamp, message in iter_decoded(path, PAGES, Counter()):
            if stamp in frames:
                frames[stamp][topic] = message
    facts.drawn = {name: (stamp, frames[stamp]) for name, stamp in chosen.items()}
    return facts


def _add(facts: RunFacts, topic: str, stamp: int, message: Any) -> None:
    """Add one message."""
    values = dict[str, float]()
    if topic == "/nav/disparity":
        values["known pixels, %"] = 100 * float(np.isfinite(read_disparity(message)).mean())
    elif topic == "/nav/navigation_map":
        cells = read_occupancy_grid(message).cells
        values["free cells"] = float(np.sum(cells == Cell.FREE))
        values["hazard cells"] = float(np.sum(cells == Cell.HAZARD))
    elif topic == "/nav/pose":
        place = message.pose.pose.position
        facts.tracks.setdefault(message.header.frame_id, []).append((place.x, place.y))
    elif topic == DIAGNOSTICS:
        facts.losses += losses_in(message)
    for name, value in values.items():
        facts.series.setdefault(name, {})[stamp] = value


def _chosen(facts: RunFacts) -> dict[str, int]:
    """Name -> stamp of the frames that are drawn: the worst and a typical one, by the share of known pixels."""
    shares = facts.series.get("known pixels, %") or facts.series.get("free cells") or {}
    ordered = sorted(shares, key=lambda stamp: (shares[stamp], stamp))
    if not ordered:
        return {}
    return {"typical frame": ordered[len(ordered) // 2]} | ({"worst frame": ordered[0]} if len(ordered) > 1 else {})
