"""The pipeline and the input log of a result log, to run frames of it again, and the losses of its frames."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from flow.cli.debugging.instants import FrameLoss, is_other
from flow.cli.report import say
from flow.config.loader import load
from flow.contracts import LossReason
from flow.errors import RoverflowError, UsageError
from flow.runtime.graph import Graph

if TYPE_CHECKING:
    from recordings.source.log import McapLog

RESULT = "the log that roverflow run wrote"


def graph_of(result: Path, changes: Sequence[str] = (), *, with_sinks: bool = False) -> Graph:
    """The pipeline of a result log as it ran, with what its survey fixed, and then changed. Raises LogError."""
    from recordings.scoring.result_log import facts_of, pipeline_of

    about = facts_of(result, RESULT)
    with pipeline_of_run(about, result, pipeline_of(result)) as file:
        own = [*about["overrides"].splitlines(), *about.get("fixed", "").splitlines()]
        return load(str(file), [*own, *changes], with_sinks=with_sinks)


@contextmanager
def pipeline_of_run(about: Mapping[str, str], result: Path, name: str) -> Iterator[Path]:
    """The pipeline of a run in a temporary file of this name. about: the facts of the run."""
    for place in map(str, (Path.cwd(), result.resolve().parent)):  # so that stages can be there
        if place not in sys.path:
            sys.path.append(place)
    with TemporaryDirectory(prefix="roverflow-") as folder:
        file = Path(folder) / f"{name}.yaml"
        file.write_text(about["pipeline"], encoding="utf-8")
        yield file


def note_damage(result: Path) -> None:
    """Print a note if a result log is incomplete, as an interrupted copy is."""
    from recordings.mcap.file import McapFile

    with McapFile(result) as log:
        end = ["its end is missing"] if log.index.walked else []
        for reason in dict.fromkeys(item.reason for item in log.index.lost) or end:
            say(f"note: {result} is incomplete: {reason}")


def check_source(graph: Graph) -> None:
    """Raise UsageError for a graph with a source of the user's own, which opens only whole logs."""
    from recordings import McapSource

    if not isinstance(graph.source, McapSource):
        raise UsageError(
            f"{graph.source_use} is not recordings.McapSource; this command reads logs only through that source"
        )


@contextmanager
def input_of(
    graph: Graph, result: Path, log: Path | str | Sequence[Path | str] | None = None
) -> Iterator[tuple[McapLog, list[str]]]:
    """The opened input of a result log, and notes about it: `log`, its files, or what the result names, beside it.

    Raises UsageError if it is not there, cannot be read, or has none of the result's frames.
    """
    from recordings.errors import LogError
    from recordings.scoring.result_log import about_run, input_beside

    check_source(graph)
    named, given = about_run(result).get("log") or "which it does not name", input_beside(result)
    if log is not None:
        given = [Path(log)] if isinstance(log, Path | str) else [*map(Path, log)]
    for file in given:
        if not file.exists():
            missing = f"the input of {result}, {named}, is not in its folder; give it with --log"
            raise UsageError(missing if log is None else f"there is no log {file}, which --log names")
    with ExitStack() as stack:
        try:
            opened = stack.enter_context(graph.source.open(given))
            notes = check_input(opened, given, result, "" if log is None else f"; give {named}")
        except (LogError, RoverflowError) as error:
            taken = f" (taken for the input because the result names {named}; give --log)" if log is None else ""
            raise UsageError(f"{error}{taken}") from error
        yield opened, notes


def check_input(opened: McapLog, given: Sequence[Path], result: Path, remedy: str = "") -> list[str]:
    """Notes, if an opened log has other bytes than the input of a result log. Raises UsageError for other frames."""
    from recordings.scoring.result_log import about_run, is_input, stamps_of

    # A log in another form has another digest. Only a few stamps are compared, as reading all would take long.
    about = about_run(result)
    if is_input(about, given):
        return []
    names = ", ".join(map(str, given))
    if is_other(opened, stamps_of(result)):
        raise UsageError(f"{names} is not the input of {result}: its frames have other stamps{remedy}")
    note = f"note: {names} has other bytes than the input of {result}; only up to three stamps were compared"
    return [note] if "log_digest" in about else []


def loss_at(stamp: int, ledger: Sequence[Mapping[str, Any]], result: Path | None) -> FrameLoss | None:
    """The first loss at a stamp, ns, in the ledger of a part's run; None without one.

    result: log of the whole run, whose ledger has the details. That of a part does not say why a partner did not come,
    because the part ends before it could.
    """
    own = [
        FrameLoss(entry["stream"], entry["reason"], "" if entry["reason"] == LossReason.UNMATCHED else entry["detail"])
        for entry in ledger
        if entry["stamp"] == stamp
    ]
    whole = [] if result is None else _logged_losses(result, stamp)
    same = [loss for loss in whole if loss[:2] in {one[:2] for one in own}]
    return next(iter(same or own or whole), None)


def _logged_losses(result: Path, stamp: int) -> list[FrameLoss]:
    """The losses at a stamp, ns, in the diagnostics of a result log; they may be at another stamp."""
    from recordings.mcap.file import iter_decoded
    from recordings.ros2.from_msg import losses_in

    messages = (message for _, _, message in iter_decoded(result, ["/nav/diagnostics"], Counter()))
    losses = chain.from_iterable(map(losses_in, messages))
    return [FrameLoss(stream, reason, detail) for stream, at, reason, detail in losses if at == str(stamp)]
