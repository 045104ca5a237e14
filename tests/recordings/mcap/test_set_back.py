"""The order of a file costs nothing; messages are lost only where all clocks were set back."""

from itertools import pairwise

import numpy as np
import pytest

from recordings import McapSource
from recordings.containers.clock import MAX_JITTER_NS
from recordings.containers.container import RawMessage
from recordings.containers.opening import open_recording
from recordings.errors import LogError
from tests.conftest import Row, mcap_rows, rewrite
from tests.recordings.sample_log import FRAMES, LAYOUTS, LEFT, PERIOD, START, essences, inventory_of, items_of, sound

BACK = 23 * PERIOD // 10
_NAMES = "small chunks", "no index", "no chunks"  # where messages are found by an index, in a walk, or outside chunks
EVERY_LAYOUT = pytest.mark.parametrize("options", [LAYOUTS[name] for name in _NAMES], ids=_NAMES)
FIRST = 3  # the first frame after the clock was set back


def set_back(rows: list[Row]) -> list[Row]:
    """All clocks set back before the message at FIRST: the stamps as well as the log times."""
    changed = []
    for topic, encoding, schema, log_time, data in rows:
        if log_time >= START + FIRST * PERIOD:
            log_time -= BACK
            if schema[0].startswith(("sensor_msgs", "nav_msgs")):
                nanoseconds = int.from_bytes(data[8:12], "little") - BACK
                data = data[:8] + nanoseconds.to_bytes(4, "little") + data[12:]
        changed.append((topic, encoding, schema, log_time, data))
    return changed


@EVERY_LAYOUT
def test_messages_after_a_set_back_clock_are_lost_until_its_old_time(sample, whole, tmp_path, options):
    path = rewrite(sample, tmp_path / "log.mcap", order=set_back, **options)
    events = items_of(path)
    assert sound(events) == essences(event for event in whole if event[0] < START + FIRST * PERIOD)
    lost = [(time, str(item)) for time, stream, item in events if isinstance(item, Exception) and stream == "left"]
    images = [(time, sentence) for time, sentence in lost if sentence.startswith(f"{LEFT}: ")]
    assert [time for time, _ in images] == [START + number * PERIOD - BACK + 1000 for number in range(FIRST, FRAMES)]
    sentence = (
        "the recorder's clock and the header stamps were set back by at least 0.13 s: times repeat, so messages are "
        "lost until the clock is 1 s past its old time"
    )
    assert {errors for _, errors in images} == {f"{LEFT}: {sentence}"}
    with McapSource().open(path) as log:
        assert log.file.times(log.channels("left")).tolist() == [START + n * PERIOD + 1000 for n in range(FIRST)]
        kept = log.file.messages(log.channels("left"), allow_repeats=True)
        assert sum(isinstance(item, RawMessage) for item in kept) == FRAMES
        surveyed = [item for events in log.excerpts(9, {"left"}) for _, stream, item in events if stream == "left"]
    assert {item.stamp for item in surveyed if not isinstance(item, Exception)} == {
        START + number * PERIOD for number in range(FIRST)
    }
    description = inventory_of(path)
    assert description["frames"]["pairs"] == FIRST
    assert f"{LEFT} at {images[0][0]} ns: {sentence}" in " ".join(description["damage"])


@EVERY_LAYOUT
@pytest.mark.parametrize("back", [BACK, 50 * PERIOD])
@pytest.mark.parametrize("until", [FIRST + 1, FRAMES], ids=["for a frame", "for good"])
def test_a_recorder_whose_clock_alone_is_set_back_loses_nothing(sample, whole, tmp_path, options, back, until):
    def time(topic, log_time):
        return log_time - (back if FIRST <= (log_time - START) // PERIOD < until else 0)

    path = rewrite(sample, tmp_path / "log.mcap", time=time, **options)
    assert essences(items_of(path)) == essences(whole)
    description = inventory_of(path)
    assert description["frames"]["with_tilt"] == FRAMES
    note = f"the recorder's clock was set back by {back / 1e9:.3g} s, and its log times are corrected by header stamps"
    assert description["notes"]["left"] == note


def test_the_end_is_that_of_the_corrected_log_times(sample, tmp_path):
    def time(topic, log_time):
        return log_time - (50 * PERIOD if (log_time - START) // PERIOD == FIRST else 0)

    path = rewrite(sample, tmp_path / "log.mcap", time=time)
    with open_recording(path) as log, open_recording(sample) as right:
        assert abs(log.end - right.end) < 10_000_000
    with pytest.raises(LogError, match="start 1 s is after its end"):
        McapSource().open(path, start=1)


def by_topic(rows: list[Row]) -> list[Row]:
    """By topic, and in each the messages two by two in the wrong order."""
    topics = [[row for row in rows if row[0] == topic] for topic in dict.fromkeys(row[0] for row in rows)]
    assert max(b[3] - a[3] for own in topics for a, b in pairwise(own)) == MAX_JITTER_NS
    return [own[place] for own in topics for place in sorted(range(len(own)), key=lambda number: number ^ 1)]


ORDERS = {
    "last first": lambda found: found[::-1],
    "halves exchanged": lambda found: found[len(found) // 2 :] + found[: len(found) // 2],
    "every second": lambda found: found[::2] + found[1::2],
    "overlapping": lambda found: [found[n] for n in sorted(range(len(found)), key=lambda n: (n // 8, n % 2))],
    "any": lambda found: [found[n] for n in np.random.default_rng(len(found)).permutation(len(found))],
    "by topic, with jitter": by_topic,
}


@EVERY_LAYOUT
@pytest.mark.parametrize("order", ORDERS)
def test_messages_stored_in_another_order_are_all_read_in_log_time_order(sample, whole, tmp_path, options, order):
    events = items_of(rewrite(sample, tmp_path / "log.mcap", order=ORDERS[order], **options))
    assert [time for time, _, _ in events] == sorted(time for time, _, _ in events)
    assert sorted(essences(events)) == sorted(essences(whole))


@EVERY_LAYOUT
def test_images_and_tilts_across_a_set_back_clock_are_not_joined(sample, tmp_path, options):
    def rare_images(rows):
        """The clock set back, without the left images of frames 1 and 2: they alone do not show it."""
        rare = range(START + PERIOD, START + FIRST * PERIOD)
        return set_back([row for row in rows if row[0] != LEFT or row[3] not in rare])

    path = rewrite(sample, tmp_path / "log.mcap", order=rare_images, **options)
    left = [item for _, stream, item in items_of(path) if stream == "left"]
    assert [item.stamp for item in left if not isinstance(item, Exception)] == [START]
    assert sum(str(item).startswith(f"{LEFT}: the recorder's clock and the header stamps") for item in left) == 2


@EVERY_LAYOUT
def test_a_single_log_time_that_leaps_ahead_is_damage(sample, tmp_path, options):
    one = next(row[3] for row in mcap_rows(sample) if row[0] == LEFT and row[3] > START + PERIOD)

    def ahead(topic, log_time):
        return log_time + (10**13 if (topic, log_time) == (LEFT, one) else 0)

    events = items_of(rewrite(sample, tmp_path / "log.mcap", time=ahead, **options))
    assert not [item for _, _, item in events if isinstance(item, Exception)]
    assert sum(stream == "left" for _, stream, _ in events) == FRAMES


def test_static_transforms_hold_whenever_they_were_logged(sample, tmp_path):
    def late_before(rows):
        *channel, _, data = rows[0]
        assert channel[0] == "/tf_static"
        return [(*channel, START + 9 * PERIOD, data[:4] + bytes(4)), *rows]

    with McapSource().open(rewrite(sample, tmp_path / "log.mcap", order=late_before)) as log:
        assert (log.missing, log.resolution.problems) == ({}, [])
