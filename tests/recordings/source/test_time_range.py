"""A part of a log has whole frames; late and repeated messages cost nothing."""

import pytest

from tests.conftest import rewrite, run_fast
from tests.recordings.sample_log import (
    FRAMES,
    LEFT,
    PERIOD,
    RIGHT,
    START,
    changed,
    essences,
    items_of,
    stamps_in,
    write_sample,
)

APART = 4_000_000  # ns between the stamps of the images of a frame


@pytest.mark.parametrize("after", [-APART, APART])
@pytest.mark.parametrize("bounds", [{"end": 0.202}, {"end": 0.198}, {"start": 0.202}, {"start": 0.198}])
def test_an_edge_between_the_stamps_of_a_pair_cuts_no_frame_in_two(tmp_path, after, bounds):
    edit = changed(RIGHT, {"header.stamp.nanosec": lambda time: time + after}, range(1, FRAMES))
    events = items_of(write_sample(tmp_path / "log.mcap", edit), **bounds)
    left, right = (stamps_in(events, side) for side in ("left", "right"))
    assert len(left) == len(right) in (2, 3)
    assert all(abs(one - other) <= APART for one, other in zip(left, right, strict=True))
    low, high = (START + round(bounds.get(name, default) * 1e9) for name, default in (("start", 0), ("end", 9)))
    assert left == [at for at in range(START, START + 5 * PERIOD, PERIOD) if low <= at < high]


@pytest.mark.parametrize("bounds", [{}, {"end": 0.25}, {"start": 0.15}, {"start": 0.15, "end": 0.25}])
def test_right_images_logged_late_belong_to_the_frames_of_their_stamps(sample, tmp_path, bounds):
    path = rewrite(sample, tmp_path / "log.mcap", time=lambda topic, at: at + (1_400_000_000 if topic == RIGHT else 0))
    events = items_of(path, **bounds)
    assert stamps_in(events, "left") == stamps_in(events, "right")


def test_a_run_pairs_right_images_that_were_logged_late(traverse, tmp_path):
    late = {"/stereo/right/image_rect": 1_400_000_000}
    path = rewrite(traverse, tmp_path / "log.mcap", time=lambda topic, at: at + late.get(topic, 0))
    run_fast(tmp_path / "out.mcap", path)


@pytest.mark.parametrize("later", [0, 1, 3_000_000, PERIOD + 5_000_000])
def test_messages_recorded_twice_are_read_once(sample, whole, tmp_path, later):
    path = rewrite(sample, tmp_path / "log.mcap", order=lambda messages: [m for m in messages for _ in range(2)])
    seen = set()

    def time(topic, at):
        again = (topic, at) in seen
        seen.add((topic, at))
        return at + (later if again else 0)

    path = rewrite(path, tmp_path / "twice.mcap", time=time)
    assert essences(items_of(path)) == essences(whole)


def test_another_image_with_the_same_stamp_is_no_repetition(tmp_path):
    path = write_sample(tmp_path / "log.mcap", changed(LEFT, {"header.stamp.nanosec": 0}, [1]))
    assert stamps_in(items_of(path))[:3] == [START, START, START + 2 * PERIOD]
