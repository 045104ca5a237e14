"""Alignment joins clocks by stamps, gives up in bounded time, and accounts for every message."""

import random
import re
from collections import Counter
from dataclasses import dataclass, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flow.align import Interpolate, Latest, Nearest, Pair, Token
from flow.contracts import Absent, Loss, LossReason
from tests.flow.toys import Number

MS = 1_000_000


@dataclass(frozen=True)
class Reading(Number):
    """A number that can be averaged."""

    def interpolated(self, later, stamp):
        share = (stamp - self.stamp) / (later.stamp - self.stamp)
        return Reading(stamp, (1 - share) * self.value + share * later.value)

    @staticmethod
    def smoothed(samples, stamp):
        return Reading(stamp, sum(sample.value for sample in samples) / len(samples))


def feed(aligner, *messages, kind=Number):
    """Feed (port, stamp, value[, log time]) messages; all answers, with `end` last."""
    answers = []
    for port, stamp, value, *log_time in messages:
        at = log_time[0] if log_time else stamp
        answers += aligner.tick(at)
        answers += aligner.push(port, at, Token(stamp, kind(stamp, value)))
    return [*answers, *aligner.end()]


def pairing(*messages, **config):
    return feed(Pair(**config).start("stereo", {"left": "left", "right": "right"}), *messages)


def started(config):
    return config.start("tilt", {"stream": "level", "at": "stereo"})


def sampling(config, *messages, kind=Number):
    return feed(started(config), *messages, kind=kind)


def by_stamp(samples, frames):
    """Messages of (stamp, value) samples and of frames' stamps, logged when they were taken."""
    messages = [*(("stream", stamp, value) for stamp, value in samples), *(("at", stamp, 0.0) for stamp in frames)]
    return sorted(messages, key=lambda message: (message[1], message[0]))


def values(answers):
    return [(a.stamp, a.value.value) for a in answers if isinstance(a, Token) and not isinstance(a.value, Absent)]


def reasons(answers):
    return [a.value.cause.reason for a in answers if isinstance(a, Token) and isinstance(a.value, Absent)]


def test_a_pair_carries_the_left_stamp():
    assert values(pairing(("left", 10, 1.0), ("right", 12, 2.0), slop=5)) == [(10, 3.0)]


def test_a_missing_right_image_loses_only_its_left_image():
    answers = pairing(
        ("left", 0, 1.0), ("right", 0, 1.0), ("left", 100, 2.0), ("left", 200, 3.0), ("right", 200, 3.0), slop=5
    )
    assert values(answers) == [(0, 2.0), (200, 6.0)]
    assert [(a.stream, a.stamp) for a in answers if isinstance(a, Loss)] == [("left", 100)]


def test_messages_that_wait_for_a_partner_are_bounded():
    lefts = [("left", at * MS, 1.0) for at in range(8)]
    answers = pairing(*lefts, max_waiting=5)
    waited = "no partner among the next 5 messages (stereo.max_waiting)"
    assert [answer.detail for answer in answers] == [waited] * 3 + [
        "the part of the log that was read ended before its partner came"
    ] * 5


def test_partners_logged_more_than_a_second_late_are_paired():
    frames = [(side, at * MS, 1.0, (at + 1400 * (side == "right")) * MS) for at in range(0, 5000, 33)
              for side in ("left", "right")]  # fmt: skip
    assert len(values(pairing(*sorted(frames, key=lambda frame: frame[3])))) == len(frames) // 2


def test_a_pair_too_far_apart_reports_the_distance_and_the_setting():
    frames = [(side, at * MS + (side == "right") * 8_020_000, 1.0) for at in (0, 500) for side in ("left", "right")]
    lost = pairing(*frames)
    lost_sides = [(entry.stream, entry.reason) for entry in lost]
    assert lost_sides == [(side, LossReason.UNMATCHED) for side in ("left", "right", "left", "right")]
    away = "the nearest {} without a partner is 8.02 ms away, more than 5 ms (stereo.slop)"
    assert [entry.detail for entry in lost[:3]] == [away.format(side) for side in ("right", "left", "right")]
    assert len(pairing(*frames, slop=10 * MS)) == 2


def test_a_partner_logged_too_late_reports_the_delay_and_the_setting():
    frames = [(side, at * MS, 1.0, (at + 1500 * (side == "right")) * MS) for at in range(0, 3000, 500)
              for side in ("left", "right")]  # fmt: skip
    frames.sort(key=lambda frame: frame[3])
    details = {(entry.stream, entry.detail) for entry in pairing(*frames, patience=1000 * MS)}
    assert details == {
        ("left", "no partner within 1 s of log time (stereo.patience)"),
        ("right", "it was logged 1.5 s after its left, more than 1 s (stereo.patience)"),
    }
    assert len(values(pairing(*frames, patience=1500 * MS))) == 6


def test_items_that_cannot_be_paired_lose_their_frame_with_the_reason():
    (answer,) = pairing(("left", 10, -1.0), ("right", 10, 2.0))
    assert (answer.stamp, answer.value.cause.reason) == (10, LossReason.FAILED)
    assert "negative" in answer.value.cause.detail


@given(
    lefts=st.lists(st.integers(0, 300), unique=True, max_size=30),
    rights=st.lists(st.integers(0, 300), unique=True, max_size=30),
)
def test_every_message_is_in_a_pair_or_in_the_ledger_but_never_in_both(lefts, rights):
    messages = sorted([("left", s, 1.0) for s in lefts] + [("right", s, 1.0) for s in rights], key=lambda m: m[1])
    answers = pairing(*messages, slop=4)
    pairs = [a for a in answers if isinstance(a, Token)]
    lost = Counter(a.stream for a in answers if isinstance(a, Loss))
    assert len(pairs) + lost["left"] == len(lefts)
    assert len(pairs) + lost["right"] == len(rights)
    assert [p.stamp for p in pairs] == sorted(p.stamp for p in pairs)


ONE, TWO = ("stream", 0, 1.0), ("stream", 100, 2.0)
UNALIGNED = [LossReason.UNALIGNED]


@pytest.mark.parametrize(("config", "messages", "found", "lost"), [
    (Interpolate(), [ONE, ("at", 0, 0.0), ("at", 25, 0.0), TWO, ("at", 100, 0.0)],
     [(0, 1.0), (25, 1.25), (100, 2.0)], []),
    (Interpolate(), [("at", 0, 0.0), ("stream", 10, 1.0), ("stream", 20, 1.0)], [], UNALIGNED),
    (Interpolate(), [("stream", 10, 1.0), ("at", 30, 0.0)], [], UNALIGNED),
    (Interpolate(), [ONE, ("at", 50, 0.0), (*TWO, 900 * MS)], [(50, 1.5)], []),
    (Interpolate(patience=10 * MS), [ONE, ("at", 50, 0.0), (*TWO, 900 * MS)], [], UNALIGNED),
    (Nearest(slop=50), [ONE, ("at", 60, 0.0), TWO, ("at", 400, 0.0)], [(60, 2.0)], UNALIGNED),
    (Latest(), [ONE, ("at", 60, 0.0), TWO, ("at", 90, 0.0, 110), ("at", 400, 0.0)],
     [(60, 1.0), (90, 1.0), (400, 2.0)], []),
], ids=[
    "exact at and between samples", "no sample before", "no sample after", "a sample logged late",
    "a sample logged too late", "the nearer neighbour within the slop", "the last sample logged by then",
])  # fmt: skip
def test_a_sampler_takes_the_samples_that_it_should(config, messages, found, lost):
    answers = sampling(config, *messages)
    assert (values(answers), reasons(answers)) == (found, lost)


def test_a_gap_longer_than_the_patience_is_a_gap_for_every_frame_in_it():
    messages = by_stamp([(at * MS, 0.0) for at in (50, 1450)], [at * MS for at in (100, 900, 1500)])
    details = [answer.value.cause.detail for answer in sampling(Interpolate(), *messages)]
    assert details == [
        "no later level sample within 1 s of log time (tilt.patience); the last is 50 ms earlier",
        "level has a gap of 1.4 s, more than 1.2 s (tilt.max_gap)",
        "no later level sample by the log's end; the last is 50 ms earlier",
    ]


def jittered(rate, seconds=20, jitter=4):
    """Stamps, ns, of a stream of so many Hz whose samples are early or late by up to `jitter` ms."""
    rng = random.Random(1)
    return [round(count / rate * 1000 * MS) + rng.randint(-jitter, jitter) * MS for count in range(1, seconds * rate)]


def unaligned(stamps, smooth=0, **config):
    """Of frames every 90 ms, those without a sample, by their reason; and the number of all frames."""
    frames = range(stamps[0] + MS, stamps[-1] - 300 * MS, 90 * MS)
    messages = by_stamp([(stamp, 0.0) for stamp in stamps], frames)
    answers = sampling(Interpolate(smooth=smooth, **config), *messages, kind=Reading)
    assert len(answers) == len(frames)
    return {answer.stamp: answer.value.cause.detail for answer in answers if isinstance(answer.value, Absent)}


@pytest.mark.parametrize("rate", [1, 2, 5, 20, 100])
@pytest.mark.parametrize("smooth", [0, 100 * MS])
def test_a_stream_of_any_rate_has_no_gaps_by_jitter(rate, smooth):
    assert unaligned(jittered(rate), smooth, patience=1500 * MS) == {}


@pytest.mark.parametrize(
    ("rate", "lost", "limit"), [(2, 1, r"8[67][\d.]+ ms"), (5, 1, r"3[45][\d.]+ ms"), (20, 5, "200 ms")]
)
def test_lost_samples_are_a_gap_for_the_frames_in_it(rate, lost, limit):
    stamps = jittered(rate)
    first, last = stamps[8 * rate - 1], stamps[8 * rate + lost]
    del stamps[8 * rate : 8 * rate + lost]
    found = unaligned(stamps)
    assert found
    assert all(first < stamp < last for stamp in found)
    sentence = rf"level has a gap of [\d.]+ m?s, more than {limit} \(tilt\.max_gap\)"
    assert all(re.fullmatch(sentence, why) for why in found.values())


def test_a_set_gap_does_not_depend_on_the_rate():
    assert len(unaligned(jittered(5), max_gap=190 * MS)) > 100


CONFIGS = [Interpolate(), Nearest()]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: type(config).__name__)
def test_samples_logged_too_late_report_the_wait_and_its_setting(config):
    messages = [("at", 100 * MS, 0.0), *(("stream", at * MS, 0.0, (at + 2500) * MS) for at in range(0, 300, 50))]
    (answer,) = sampling(config, *messages)
    assert answer.value.cause.detail == "no level sample within 1 s of log time (tilt.patience)"
    assert len(values(sampling(replace(config, patience=5000 * MS), *messages))) == 1


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: type(config).__name__)
@pytest.mark.parametrize(("sample", "frame"), [(3_600_000 * MS, 0), (0, 3_600_000 * MS)])
def test_clocks_that_are_far_apart_report_the_distance(config, sample, frame):
    (answer,) = sampling(config, ("stream", sample, 0.0, 0), ("at", frame, 0.0, 0))
    assert "3600 s " in answer.value.cause.detail


def test_an_unaligned_sample_names_the_limit_it_exceeds():
    def detail(config, *messages):
        return sampling(config, *messages)[0].value.cause.detail

    messages = [("stream", 0, 1.0), ("at", 60 * MS, 0.0), ("stream", 200 * MS, 2.0)]
    assert detail(Nearest(), *messages) == "the nearest level sample is 60 ms away, more than 50 ms (tilt.slop)"
    assert detail(Latest(), *messages[1:]) == "no level sample logged by then"


@given(st.lists(st.integers(0, 1000), min_size=2, unique=True).map(sorted), st.integers(0, 50))
def test_every_wanted_stamp_gets_exactly_one_answer_in_order(stamps, gap):
    messages = [("at" if i % 2 else "stream", s, float(s)) for i, s in enumerate(stamps)]
    answers = sampling(Interpolate(max_gap=gap), *messages)
    assert [a.stamp for a in answers] == [s for p, s, _ in messages if p == "at"]
    assert all(value == pytest.approx(stamp) for stamp, value in values(answers))


def fed_at_100_hz(config, latency, images_every=100 * MS, seconds=30):
    """Samples at 100 Hz, stamps wanted every 100 ms and logged `latency` late; the aligner and its answers."""
    aligner = started(config)
    messages = [("stream", at, at / 1e9, at) for at in range(0, seconds * 1000 * MS, 10 * MS)]
    messages += [("at", at, 0.0, at + latency) for at in range(MS, seconds * 1000 * MS - latency, images_every)]
    return aligner, feed(aligner, *sorted(messages, key=lambda message: message[3]))


@pytest.mark.parametrize("config", [Latest(), Interpolate(), Nearest()], ids=lambda config: type(config).__name__)
@pytest.mark.parametrize("latency", [0, 80 * MS, 1500 * MS])
def test_images_logged_later_than_their_stamp_still_find_their_sample(config, latency):
    aligner, answers = fed_at_100_hz(config, latency)
    found = values(answers)
    assert len(found) >= 280
    assert all(abs(value - stamp / 1e9) <= 0.010 for stamp, value in found)
    assert reasons(answers) == []
    assert len(aligner.samples) < 100 + 2 * latency / (10 * MS)


def test_old_samples_are_dropped_even_without_requests():
    aligner, _ = fed_at_100_hz(Interpolate(), 0, images_every=10**18)
    assert len(aligner.samples) < 1100


def test_absence_passes_through_chained_aligners_with_one_entry():
    aligner = started(Interpolate())
    lost = Absent(Loss("level", 5, "level", LossReason.FAILED, "broken"))
    answers = [*aligner.push("stream", 5, Token(5, lost)), *aligner.push("at", 5, Token(5, None)), *aligner.end()]
    assert reasons(answers) == [LossReason.UNALIGNED]


def smoothing(readings, at, smooth):
    return sampling(Interpolate(smooth=smooth, max_gap=40), *by_stamp(readings, at), kind=Reading)


def test_smoothing_takes_all_samples_about_the_stamp_and_waits_for_them():
    noisy = [(10 * count, float(count) + (0.3 if count % 2 else -0.3)) for count in range(30)]
    found = values(smoothing(noisy, [100, 205], 40))
    assert found == [(100, pytest.approx(9.967, abs=1e-3)), (205, pytest.approx(20.5))]


@pytest.mark.parametrize(("power", "more"), [(1, 0), (2, 10)])  # of five samples to either side, the mean is 10 more
def test_smoothing_reaches_equally_far_back_and_ahead_for_each_frame(power, more):
    curve = [(10 * count, float(count**power)) for count in range(30)]
    found = values(smoothing(curve, [100, 110, 120, 130], 50))
    assert found == [(stamp, pytest.approx((stamp / 10) ** power + more)) for stamp in (100, 110, 120, 130)]


def test_smoothing_does_not_lag_at_the_ends_of_a_stream():
    ramp = [(10 * count, float(count)) for count in range(8)]
    assert values(smoothing(ramp, [5, 12, 65], 50)) == [(5, 0.5), (12, pytest.approx(1.0)), (65, 6.5)]
    assert reasons(smoothing([(0, 0.0), (10, 1.0), (90, 9.0), (100, 10.0)], [50], 50)) == [LossReason.UNALIGNED]


def test_a_sample_exactly_at_the_stamp_is_used_before_a_gap():
    for smooth in (0, 50):
        samples = [(30, 3.0), (40, 4.0), (50, 5.0), (120, 12.0), (130, 13.0)]
        assert values(smoothing(samples, [50], smooth)) == [(50, 5.0)]


def test_smoothing_of_an_unsuitable_type_is_refused_before_the_run():
    with pytest.raises(TypeError, match="a Number cannot be smoothed"):
        Interpolate(smooth=10).output({"stream": Number, "at": Number})
    assert Interpolate(smooth=10).output({"stream": Reading, "at": Number}) is Reading
