"""The frame assembler: damaged stamps cost single messages, and clocks that were set cost little."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flow.runtime.frame_assembler import FrameAssembler
from flow.runtime.ledger import Ledger
from tests.flow.toys import MS, PIPELINE, Number, Text, graph, replayed, traverse

AHEAD = 4_000 * MS, 12_000 * MS, 3_600_000 * MS
DAMAGED = (4,), (4, 8), (4, 7, 13), (0,), (0, 2, 9)
IN_A_ROW = {4: 3_600_000 * MS, 5: 7_200_000 * MS}


@pytest.mark.parametrize("damaged", [*(dict.fromkeys(at, ahead) for at in DAMAGED for ahead in AHEAD), IN_A_ROW])
def test_every_damaged_stamp_costs_one_message(tmp_path, damaged):
    """Damaged: by how much, ns, the stamps of some left messages are ahead."""
    events = [
        (at, stream, Number(at + damaged.get(at // (100 * MS), 0), item.value) if stream == "left" else item)
        for at, stream, item in traverse(20)
    ]
    _, summary = replayed(graph(tmp_path), events)
    assert summary["frames_out"] == 20 - len(damaged)
    assert summary["drops"] == {"out of order": len(damaged), "unmatched": len(damaged)}


def shifted(events, shift, since=-50 * MS):
    """The events with the stamps of those logged from `since` on shifted, ns."""
    return [
        (at, stream, Number(item.stamp + shift, item.value) if at >= since else item) for at, stream, item in events
    ]


def test_a_clock_set_forward_costs_one_frame(tmp_path):
    sink, summary = replayed(graph(tmp_path), shifted(traverse(10), 3_600_000 * MS, since=451 * MS))
    assert len(sink.values("sum")) == 10
    assert summary["drops"] == {"unaligned": 1}


def test_a_clock_set_back_loses_the_rest_and_the_ledger_names_the_option(tmp_path):
    sink, summary = replayed(graph(tmp_path), shifted(traverse(10), -3_600_000 * MS, since=451 * MS))
    assert len(sink.values("sum")) == 5
    lost = [entry for entry in summary["ledger"] if entry["reason"] == "out of order"]
    assert len(lost) == 15
    assert all("--start" in entry["detail"] for entry in lost)


@pytest.mark.parametrize("frames", [1, 10])
def test_a_clock_years_from_that_of_the_log_costs_nothing(tmp_path, frames):
    for years in (-50, 50):
        sink, summary = replayed(graph(tmp_path), shifted(traverse(frames), years * 31_557_600_000 * MS))
        assert len(sink.values("raised")) == frames
        assert summary["verdict"] == "COMPLETE"


LAST_WORDS = PIPELINE.replace("sinks:", "  last_words: {use: flow.align.latest, stream: words, at: both}\nsinks:")
ALONE = (0, "words", Text(3_600_000 * MS, "alone"))


@given(stalls=st.lists(st.tuples(st.integers(0, 9_000), st.integers(1, 9_000)), max_size=4))
def test_a_log_that_was_written_in_bursts_loses_nothing(tmp_path_factory, stalls):
    """A recorder that stalls for up to nine seconds then logs all waiting messages at once."""

    def logged(at):
        ends = [(begin + length) * MS for begin, length in stalls if begin * MS <= at < (begin + length) * MS]
        return max(ends, default=at)

    events = [(logged(at), stream, item) for at, stream, item in traverse(100)]
    assembler = FrameAssembler(graph(tmp_path_factory.mktemp("burst")), ledger := Ledger())
    assert len(list(assembler.frames(sorted(events, key=lambda event: event[0])))) == 100
    assert not [entry for entry in ledger.entries if entry.reason == "out of order"]


def test_a_suspect_stamp_does_not_hold_up_the_log(tmp_path):
    """The assembler does not read the whole log to wait for a second message of a stream."""
    read = Counter()

    def counted(events):
        for at, stream, item in events:
            read[stream] += 1
            yield at, stream, item

    assembler = FrameAssembler(graph(tmp_path, text=LAST_WORDS), Ledger())
    next(assembler.frames(counted([ALONE, *traverse(1000)[1:]])))
    assert read["left"] < 110


def test_reading_ahead_of_a_suspect_stamp_is_bounded(tmp_path):
    often = [(at, "level", Number(at, at / 1e9)) for at in range(MS, 5000 * MS, MS)]
    read = iter([ALONE, *traverse(1)[:3], *often])
    next(FrameAssembler(graph(tmp_path, text=LAST_WORDS), Ledger()).frames(read))
    assert len(often) - len(list(read)) < 130
