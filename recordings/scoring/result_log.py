"""What a log that McapSink wrote tells of its run: which part of a log it took, and why a result is lacking."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Metadata
from mcap.stream_reader import StreamReader

from recordings.errors import LogError
from recordings.mcap.file import McapFile


def part_run(result: Path, log: Path) -> tuple[float | None, float | None]:
    """From where and to where the log `log` was run, s after its first message; None where all of it was, or the result
    does not tell."""
    about: dict[str, str] = {}
    with suppress(McapError, OSError, ValueError, struct.error), result.open("rb") as file:
        # A header, and what a run says of itself before all else.
        for record in islice(StreamReader(file, emit_chunks=True).records, 2):
            about = record.metadata if isinstance(record, Metadata) else {}
        if about.get("log") == log.name.encode("utf-8", "replace").decode():
            first, end = (about.get(name) for name in ("start", "end"))
            return float(first) if first else None, float(end) if end else None
    return None, None


def without_results(path: Path, wanted: Sequence[str], instead: Sequence[str] = (), remedy: str = "") -> LogError:
    """What to say of a log that holds none of the topics `wanted` of a run's results; and the `remedy` if it holds any
    that would do `instead`."""
    with McapFile(path) as log:
        topics = sorted({log.channel(n).topic for n in log.index.channels if log.count({n})})
    results = [topic for topic in topics if topic.startswith("/nav/")]
    if not results:
        return LogError(f"{path} is not a result log: it has no /nav topics; give the log that roverflow run wrote")
    holds = f"no {wanted[0]}" if len(wanted) == 1 else f"none of {', '.join(wanted)}"
    why = "the run made none, or its McapSink's 'results' leave it out"
    more = f"; {remedy}" if set(instead) & set(results) else ""
    return LogError(f"{path} holds {holds}, only {', '.join(results)}: {why}{more}")
