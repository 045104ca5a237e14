"""The recorder's clock is judged by log times in file order and the header stamps beside them."""

from functools import cache

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recordings.containers.clock import SETTLING_NS, ClockStep, clock_steps, corrected
from recordings.containers.timeline import Timeline

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
RATES = {0: 10, 1: 10, 2: 100}  # Hz, by channel
LATE = {0: 40_000_000, 1: 40_000_000, 2: 3_000_000}  # ns from stamp to log time
STAMPED = set(RATES)


@cache
def recorded(seconds, seed=0):
    """Channels, log times and stamps of some seconds, in the order of recording, with jitter."""
    random, rows = np.random.default_rng(seed), []
    for channel, rate in RATES.items():
        stamps = START + np.arange(seconds * rate) * SECOND // rate
        logged = stamps + LATE[channel] + random.integers(0, SECOND // rate // 8, len(stamps))
        rows += zip(logged.tolist(), [channel] * len(stamps), stamps.tolist(), strict=True)
    times, channels, stamps = np.array(sorted(rows)).T
    return channels, times, stamps


def steps_of(channels, times, stamps):
    return clock_steps(Timeline.of(channels, times), STAMPED, lambda place: int(stamps[place]))


@given(
    st.integers(150, 4000),
    st.sampled_from(["last first", "overlapping", "every second", "two recorders", "any order", "by channel"]),
    st.integers(0, 9),
)
def test_a_file_stored_in_another_order_has_no_step(size, how, seed):
    channels, times, stamps = recorded(40, seed)
    number, random = np.arange(len(times)), np.random.default_rng(seed)
    order = {
        "last first": np.lexsort((number, -(number // size))),
        "overlapping": np.lexsort((number, number % 2, number // size)),
        "every second": np.lexsort((number, (number + number // 7) % 2)),
        "two recorders": np.lexsort((number, random.integers(0, 2, len(number)))),
        "any order": random.permutation(len(number)),
        "by channel": np.lexsort((number, channels)),
    }[how]
    assert steps_of(channels[order], times[order], stamps[order]) == []


@given(st.integers(2, 30), st.floats(0.4, 3000), st.booleans(), st.integers(0, 9))
def test_a_recorder_whose_clock_was_set_back_alone_is_corrected(at, back, is_corrected, seed):
    channels, times, stamps = recorded(40, seed)
    low, high = np.searchsorted(times, START + np.array([at, at + 5]) * SECOND)
    wrong = np.zeros(len(times), np.int64)
    wrong[low : high if is_corrected else None] = round(back * SECOND)
    steps = steps_of(channels, times - wrong, stamps)
    shifts = np.zeros(len(times), np.int64)
    for step in steps:
        assert step.repeats_until == 0
        shifts[step.place :] = step.shift
    assert np.abs(shifts - wrong).max() < 20_000_000


@given(st.integers(12, 30), st.integers(1000, 10_000), st.booleans(), st.integers(0, 9))
def test_times_that_repeat_because_all_clocks_were_set_back_are_found(at, back, is_stamped, seed):
    channels, times, stamps = recorded(40, seed)
    place = int(np.searchsorted(times, START + at * SECOND))
    wrong = np.where(np.arange(len(times)) < place, 0, back * 1_000_000)
    (step,) = steps_of(channels, times - wrong, stamps - wrong if is_stamped else np.zeros_like(stamps))
    assert abs(step.place - place) < 15
    assert step.shift == 0
    assert step.repeats_until == times[:place].max() + SETTLING_NS


def test_a_recording_written_twice_is_no_step_of_the_clock():
    twice = [np.concatenate([column, column]) for column in recorded(10)]
    assert steps_of(*twice) == []


def test_a_step_without_stamps_is_judged_by_the_log_times_alone():
    channels, times, stamps = recorded(20)
    # The times do not repeat, so nothing shows that the clock was set.
    times = times - 100 * SECOND * (np.arange(len(times)) >= 1500)
    assert clock_steps(Timeline.of(channels, times), set(), lambda place: 0) == []
    (step,) = steps_of(channels, times, stamps)
    assert step == ClockStep(step.place, step.shift, 0, step.fall)


def test_damaged_times_stay_damaged_and_the_second_pass_ends_at_its_limit():
    times = [50, 60, -1, 10, 20, 30]
    step = ClockStep(place=2, shift=5, repeats_until=20, fall=50)
    timeline, repeated = corrected(Timeline.of(np.zeros(6, int), np.array(times)), [step])
    assert timeline.log_times.tolist() == [50, 60, -1, 15, 25, 35]
    assert repeated.tolist() == [False, False, False, True, False, False]
