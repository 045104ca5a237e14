"""A graph is configuration: its runs, one after the other or at once, share no state."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from flow.config.loader import load
from flow.errors import PipelineError
from flow.runtime.run import run
from tests.conftest import FRAMES, mcap_rows, slow
from tests.flow.toys import PIPELINE, Couple, Log, graph, replayed
from tests.flow.toys import traverse as numbers


@dataclass
class Lines:
    """A sink that writes a line a frame."""

    suffix: ClassVar[str] = ".txt"

    def wants(self, stream: str, kind: type) -> bool:
        return True

    def open(self, path: Path, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        self.file = path.open("w")

    def write(self, record: Any) -> None:
        self.file.write(f"{record.stamp} {dict(record.items)} {record.entries}\n")

    def close(self, summary: Mapping[str, Any]) -> None:
        self.file.write(str(summary["findings"]))
        self.file.close()


TOYS = PIPELINE[: PIPELINE.index("sinks:")] + "sinks: [{use: tests.flow.runtime.test_state.Lines}]\n"
NUMBERS = 40


def lines_of(pipeline, path, events, **options):
    """What a run of a graph writes."""
    run(pipeline, Log(events), {"tests.flow.runtime.test_state.Lines": path}, **options)
    return path.read_text()


def test_a_graph_run_in_two_threads_at_once_gives_the_bits_of_two_runs(tmp_path):
    loaded = graph(tmp_path, nap=0.003, text=TOYS)
    logs = [numbers(NUMBERS), numbers(NUMBERS, start=1)]
    alone = [lines_of(loaded, tmp_path / f"alone{i}.txt", log) for i, log in enumerate(logs)]
    with ThreadPoolExecutor(2) as pool:
        paths = [tmp_path / f"at_once{i}.txt" for i in range(2)]
        at_once = list(pool.map(lambda path, log: lines_of(loaded, path, log, workers=3), paths, logs))
    assert at_once == alone
    assert "the sum is 1560.0" in alone[0]


@dataclass(frozen=True)
class CannotStart:
    def start(self) -> list[float]:
        raise OSError("no map on this disk")

    def __call__(self, couple: Couple, *, state: list[float]) -> Couple:
        return couple


START, FINDING = "def start(self): ...", "def finding(self, state): ..."


@pytest.mark.parametrize(("methods", "takes", "sentence"), [
    ("", ", *, state", "Half.__call__ needs a 'state', so Half must have 'start', which makes it"),
    (START, "", r"Half has 'start', so its __call__ must take 'state' by keyword only \(after '\*'\)"),
    (FINDING, "", "Half.finding needs a 'state', so Half must have 'start', which makes it"),
])  # fmt: skip
def test_a_stage_with_half_of_a_state_is_refused_with_its_line(tmp_path, methods, takes, sentence):
    call = f"def __call__(self, couple: Couple{takes}) -> Couple: ..."
    head = "from tests.flow.toys import *\n@dataclass(frozen=True)\nclass Half:\n"
    (tmp_path / f"{tmp_path.name}.py").write_text(f"{head}    {methods or 'pass'}\n    {call}\n")
    with pytest.raises(PipelineError, match=r"toy\.yaml:10: " + sentence):
        graph(tmp_path, text=TOYS.replace("tests.flow.toys.Total", f"{tmp_path.name}.Half"))


def test_a_stage_that_cannot_start_is_named_before_anything_runs(tmp_path):
    use = f"tests.flow.runtime.test_state.{CannotStart.__name__}"
    pipeline = graph(tmp_path, text=TOYS.replace("tests.flow.toys.Total", use))
    with pytest.raises(PipelineError, match=r"toy\.yaml:10: 'total' cannot start: OSError: no map on this disk"):
        lines_of(pipeline, tmp_path / "out.txt", numbers(3))
    assert not (tmp_path / "out.txt").exists()


@pytest.mark.parametrize("pipeline", ["rover", *slow("paper")])
def test_a_pipeline_gives_the_same_again_with_any_number_of_workers(traverse, tmp_path, pipeline):
    """A simulated log through one loaded graph: once, then twice at once."""
    loaded = load(pipeline, ["disparities=64"])
    ((use, _), _) = loaded.sinks

    def result(workers):
        out = tmp_path / f"{workers}.mcap"
        with loaded.source.open(traverse, start=None, end=None) as log:
            summary = run(loaded, log, {use: out}, workers=workers)
        return mcap_rows(out), summary["findings"], summary["ledger"]

    first = result(1)
    with ThreadPoolExecutor(2) as pool:
        at_once = list(pool.map(result, [2, 4]))
    assert len(first[0]) >= 6 * FRAMES
    assert at_once == [first] * 2


@dataclass(frozen=True)
class Sums:
    """Adds to an array that it has returned."""

    def start(self) -> list[Any]:
        """The sum, and the parts of the last result."""
        return [np.zeros(1)]

    def __call__(self, couple: Couple, *, state: list[Any]) -> dict[str, Any]:
        """The sum in an own type, in a mapping."""
        state[0] += couple.value
        return {"own": Own(state[0])}


@dataclass(frozen=True)
class Views:
    """Returns a view of its state."""

    def start(self) -> Any:
        """The sum."""
        return np.zeros(3)

    def __call__(self, couple: Couple, *, state: Any) -> NDArray[np.float64]:
        """The first of three."""
        state += couple.value
        return state[:1]  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Counts:
    """Returns its state."""

    def start(self) -> dict[str, list[int]]:
        """No frame."""
        return {"frames": []}

    def __call__(self, couple: Couple, *, state: dict[str, list[int]]) -> dict[str, list[int]]:
        """The frames so far."""
        state["frames"].append(couple.stamp)
        return state


@dataclass(frozen=True)
class Own:
    """A type with an array."""

    values: Any


def test_a_list_or_dict_that_a_stage_returns_is_a_copy(tmp_path):
    text = PIPELINE.replace("tests.flow.toys.Total", "tests.flow.runtime.test_state.Counts")
    sink, _ = replayed(graph(tmp_path, text=text), numbers(5), workers=4)
    assert [len(record.items["total"]["frames"]) for record in sink.records] == [1, 2, 3, 4, 5]


def test_a_view_of_a_state_that_a_stage_returns_is_a_copy(tmp_path):
    text = PIPELINE.replace("tests.flow.toys.Total", "tests.flow.runtime.test_state.Views")
    sink, summary = replayed(graph(tmp_path, text=text), numbers(5), workers=4)
    assert [float(record.items["total"][0]) for record in sink.records] == [0, 2, 6, 12, 20]
    assert summary["verdict"] == "COMPLETE"


def test_a_stage_cannot_change_an_array_that_it_has_returned(tmp_path):
    text = TOYS.replace("tests.flow.toys.Total", "tests.flow.runtime.test_state.Sums")
    pipeline = graph(tmp_path, text=text)
    ((use, _),) = pipeline.sinks
    summary = run(pipeline, Log(numbers(3)), {use: tmp_path / "out.txt"})
    assert {entry["detail"].partition(" (")[0] for entry in summary["ledger"]} == {
        "ValueError: output array is read-only"
    }
    assert summary["frames_out"] == 1
