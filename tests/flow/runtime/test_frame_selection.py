"""A run of selected frames gives the same results for them as a run of all frames, and loses none."""

import pytest

from flow.errors import UsageError
from flow.runtime.frame_selection import Every
from tests.flow.toys import MS, Log, Number, Place, graph, replayed, replayed_log, traverse


def places(metres):
    """A pose 10 ms before each frame, with these positions, m."""
    return [(i * 100 * MS - 10 * MS, "way", Place(i * 100 * MS - 10 * MS, m)) for i, m in enumerate(metres)]


def taken(tmp_path, metres, every, frames=None):
    events = sorted(traverse(frames or len(metres)) + places(metres), key=lambda event: event[0])
    sink, summary = replayed(graph(tmp_path), events, every=every)
    assert summary["frames_in"] + summary["frames_left_out"] == (frames or len(metres))
    return [stamp // (100 * MS) for stamp in sink.values("raised")]


def test_every_third_frame_has_the_results_of_a_run_of_all(tmp_path):
    whole, _ = replayed(graph(tmp_path), traverse(10))
    part, summary = replayed(graph(tmp_path), traverse(10), every=Every(frames=3))
    assert part.values("raised") == {at: value for at, value in whole.values("raised").items() if at % (300 * MS) == 0}
    assert (summary["verdict"], summary["frames_in"], summary["frames_left_out"]) == ("COMPLETE", 4, 6)


def test_a_frame_that_is_left_out_cannot_be_lost(tmp_path):
    """Frame 3 cannot be paired, and the last frame has no level."""
    events = [event for event in traverse(6) if event[0] <= 500 * MS and event[:2] != (300 * MS, "left")]
    events.append((300 * MS, "left", Number(300 * MS, -1.0)))
    events.sort(key=lambda event: event[0])
    assert replayed(graph(tmp_path), events)[1]["drops"] == {"failed": 1, "unaligned": 1}
    _, summary = replayed(graph(tmp_path), events, every=Every(frames=2))
    assert (summary["drops"], summary["frames_left_out"]) == ({}, 3)


def test_one_frame_is_taken_for_each_stretch_driven(tmp_path):
    driven = [0.0, 0.2, 0.4, 0.6, 0.8, 0.8, 0.8, 1.2, 1.4, 0.9]
    assert taken(tmp_path, driven, Every(metres=0.5)) == [0, 3, 7]


def test_frames_of_unknown_place_are_taken(tmp_path):
    assert taken(tmp_path, [0.0, 0.2], Every(metres=0.5), frames=30) == [0, *range(21, 30)]
    assert taken(tmp_path, [], Every(metres=0.5), frames=3) == [0, 1, 2]


@pytest.mark.parametrize("given", [{"frames": 0}, {"frames": "2"}, {"metres": -1.0}, {"metres": float("nan")}])
def test_a_selection_without_a_meaning_is_refused(given):
    with pytest.raises(ValueError, match=rf"Every\.{next(iter(given))} must be "):
        Every(**given)


def test_a_stretch_needs_odometry(tmp_path):
    log = Log(traverse(3), missing={"way": "the log has no odometry"})
    with pytest.raises(UsageError, match=r"--every 0\.5m needs odometry: the log has no odometry; .* --every 2"):
        replayed_log(graph(tmp_path), log, every=Every(metres=0.5))
