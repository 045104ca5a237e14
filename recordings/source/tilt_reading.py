"""How the tilts of a log are read: each from a message, or estimated from the samples of an Imu."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from typing import Any

import numpy as np

from flow.contracts import Finding, Severity
from recordings.containers.time_range import MAX_LATENESS_NS
from recordings.discovery.roles import TiltKind
from recordings.errors import LogError
from recordings.inertial.blocks import InertialSample
from recordings.inertial.up_estimator import UpEstimator
from recordings.ros2.tilt_from_msg import (
    JoinedAngles,
    Vector,
    acceleration_of,
    rate_of,
    sample_of,
    tilt_of,
    tilt_of_acceleration,
    tilt_of_pose,
)
from recordings.source.settings import LogSettings
from stages.data import Array, Tilt

MAX_LAG_NS = 100_000_000  # of the rates after the accelerations, or before, that is not mentioned
MAX_WAITING_NS = 120_000_000_000  # of samples for their tilts; an estimate that goes on makes them earlier
MAX_JUMP_NS = 1_000_000_000  # of stamps against log times
GRAVITIES = {"Earth": 9.81, "Mars": 3.71, "the Moon": 1.62}  # m/s^2
GRAVITY_RTOL = 0.03

Sampler = Callable[[Any, int], InertialSample]  # of a message and its log time
Sampled = tuple[int, InertialSample | LogError]  # log time, ns, and what was logged then


@dataclass(frozen=True)
class TiltReading:
    """What the tilts are made of.

    topic: of the inclinometer; gyroscope: of the rates, of an estimate; turn: (3, 3) rotation from the gyroscope's
    frame to the inclinometer's; why: no orientation is used; lag: by how much later after their stamps, ns, the rates
    are logged than the accelerations.
    """

    kind: TiltKind
    topic: str
    gyroscope: str = ""
    turn: Array = field(default_factory=lambda: np.eye(3))
    why: str = ""
    lag: int = 0

    def readers(self, settings: LogSettings) -> dict[str, Callable[[Any, int], Tilt | None]]:
        """Topic -> the function from a message and its log time to its tilt, if it has one."""
        made: Callable[[Any, int], Tilt | None] = tilt_of
        if (angles := settings.angles()) is not None:
            roll = angles.roll.topic or self.topic
            if roll != self.topic:
                joined = JoinedAngles(angles)
                return {self.topic: joined.add_pitch, roll: joined.add_roll}
            made = angles
        elif (upright := settings.upright_frame) is not None:
            made = lambda message, time: tilt_of_pose(message, time, upright, settings.base_frame)  # noqa: E731
        elif self.kind == TiltKind.ACCELERATIONS:
            read = settings.accelerations or acceleration_of
            made = lambda message, time: tilt_of_acceleration(message, time, read(message))  # noqa: E731
        return {self.topic: made}

    @property
    def estimates(self) -> bool:
        """Whether the tilt is estimated from several messages."""
        return self.kind == TiltKind.ESTIMATE

    def samplers(self, settings: LogSettings) -> dict[str, Sampler]:
        """Topic -> the function to its samples, for an estimate."""
        read = settings.accelerations or acceleration_of
        if self.gyroscope == self.topic:
            return {self.topic: lambda message, time: sample_of(message, time, read(message), rate_of(message))}
        offset = settings.offset_of("gyroscope")

        def rated(message: Any, time: int) -> InertialSample:
            sample = sample_of(message, time, None, self._turned(rate_of(message)))
            return replace(sample, stamp=sample.stamp + offset)

        return {
            self.topic: lambda message, time: sample_of(message, time, read(message), None),
            self.gyroscope: rated,
        }

    def _turned(self, rate: Vector | None) -> Vector | None:
        if rate is None:
            return None
        x, y, z = (self.turn @ np.array(rate)).tolist()
        return x, y, z

    def note(self, estimator: UpEstimator | None, settings: LogSettings) -> str:
        """What a user should know; empty if the log contains the tilt. estimator: after a run."""
        because = f", because its orientation is not used: {self.why}" if self.why else ""
        if self.kind == TiltKind.POSE:
            return f"the tilt is that of the poses on {self.topic}, whose frame '{settings.upright_frame}' has z up"
        if self.kind == TiltKind.ACCELERATIONS:
            return f"the tilt is the direction of the acceleration on {self.topic}, right only at rest{because}"
        if self.kind != TiltKind.ESTIMATE:
            return ""
        parts = f"accelerations and rates on {self.topic}"
        if self.gyroscope != self.topic:
            parts = f"accelerations on {self.topic} and the rates on {self.gyroscope}"
        said = f"the tilt is estimated from the {parts}{because}{self._lag(settings)}"
        if estimator is None or not estimator.seconds:
            return said
        return f"{said}; at rest for {estimator.rest_seconds:.0f} of {estimator.seconds:.0f} s; {_gravity(estimator)}"

    def _lag(self, settings: LogSettings) -> str:
        """What is unusual about the times at which accelerations and rates are logged."""
        if abs(self.lag) <= MAX_LAG_NS:
            return ""
        when = "later" if self.lag > 0 else "earlier"
        return (
            f"; rates are logged {abs(self.lag) / 1e9:.2f} s {when} after their stamps than accelerations: if a clock "
            f"is wrong, {rates_corrected(self.lag, settings)}"
        )

    def fault(self, estimator: UpEstimator) -> Finding | None:
        """A fault of the sensors that the samples show, after a run."""
        if estimator.contradicts_gravity and abs(estimator.measured_gravity - 1) < GRAVITY_RTOL:
            sentence = (
                f"Gravity is {estimator.measured_gravity:.2f} by the accelerations on {self.topic}: they are in g, so "
                "the estimated tilt is wrong. Convert them to m/s2 in the driver or the log."
            )
        elif estimator.contradicts_gravity:
            unit = ", and its unit is m/s2, not g" if estimator.gravity == 1 else ""
            sentence = (
                f"Gravity is {estimator.measured_gravity:.2f} m/s2 by the accelerations on {self.topic}, so the "
                f"estimated tilt is wrong: 'gravity' of the source is {estimator.gravity:g}{unit}. Correct it, or "
                "leave it out."
            )
        elif estimator.contradicts:
            sentence = (
                f"The rates on {self.gyroscope} contradict the accelerations on {self.topic}, so the estimated tilt "
                "is wrong. Check the axes, the signs and the unit (rad/s) of the gyroscope."
            )
        else:
            return None
        return Finding(sentence, Severity.FAULT, about="tilt")


def rates_corrected(lag: int, settings: LogSettings) -> str:
    """The setting that corrects the stamps of rates. lag: as of TiltReading."""
    offset = settings.offset_of("gyroscope") + lag
    return f"--set source.time_offset.gyroscope={offset / 1e9:.3f}s corrects the rates"


def _gravity(estimator: UpEstimator) -> str:
    """The measured magnitude of gravity, compared with that of the settings or of a planet."""
    measured, given = estimator.measured_gravity, estimator.gravity
    found = f"gravity is {measured:.2f} m/s2"
    if given is not None:
        return f"{found}, but 'gravity' of the source is {given:g}" if estimator.contradicts_gravity else found
    near = [name for name, value in GRAVITIES.items() if abs(measured / value - 1) < GRAVITY_RTOL]
    return f"{found}, as on {near[0]}" if near else f"{found}, unlike on {', '.join(GRAVITIES)}; check the unit"


def estimated_tilts(
    reading: TiltReading, samples: Iterable[Sampled], estimator: UpEstimator
) -> Iterator[tuple[int, Tilt | LogError]]:
    """The tilts of samples in the order of log time, with the log times of their samples; errors stay in place."""
    latest = 0
    for log_time, item in _answers(in_order_of_stamps(reading, samples), estimator):
        latest = max(latest, log_time)
        yield latest, item


def _answers(samples: Iterable[Sampled], estimator: UpEstimator) -> Iterator[tuple[int, Tilt | LogError]]:
    waiting = deque[Sampled]()
    for log_time, sample in samples:
        if waiting and log_time - waiting[0][0] > MAX_WAITING_NS:  # only errors, or no rates, have followed
            yield from _answered(waiting, estimator.finish())
            yield from ((time, item) for time, item in waiting if isinstance(item, LogError))
            waiting.clear()
        waiting.append((log_time, sample))
        if not isinstance(sample, LogError):
            yield from _answered(waiting, estimator.push(sample))
    yield from _answered(waiting, estimator.finish())
    yield from ((log_time, item) for log_time, item in waiting if isinstance(item, LogError))


def _answered(waiting: deque[Sampled], tilts: list[Tilt]) -> Iterator[tuple[int, Tilt | LogError]]:
    """Take the samples of these tilts, and those before them, from the waiting ones."""
    for tilt in tilts:
        while waiting:
            log_time, sample = waiting.popleft()
            if isinstance(sample, LogError):
                yield log_time, sample
            elif sample.stamp == tilt.stamp and sample.rate is not None:
                yield log_time, tilt
                break


def in_order_of_stamps(reading: TiltReading, samples: Iterable[Sampled]) -> Iterator[Sampled]:
    """The samples in the order of stamps; a LogError in place of one whose stamp does not follow the one before.

    Those of two topics may be logged out of order, up to 3 s apart.
    """
    heap = list[tuple[int, int, int, InertialSample | LogError]]()
    last = dict[bool, tuple[int, int]]()  # stamp and log time, of each of two topics
    doubted, newest = dict[bool, int](), dict[bool, InertialSample]()
    given = reached = 0  # the stamps up to which samples were given, and up to which they were read
    for number, (log_time, sample) in enumerate(samples):
        while heap and (heap[0][0] <= reached - MAX_LATENESS_NS or heap[0][2] <= log_time - MAX_LATENESS_NS):
            given, _, time, first = heappop(heap)
            yield time, first
        if isinstance(sample, LogError):
            heappush(heap, (reached, number, log_time, sample))
            continue
        topic = sample.rate is None
        if sample == newest.get(topic):  # recorded twice
            continue
        newest[topic] = sample
        stamp, logged = last.get(topic, (sample.stamp - 1, log_time))
        ahead = sample.stamp - stamp > log_time - logged + MAX_JUMP_NS
        believed = 0 < sample.stamp - doubted.get(topic, sample.stamp) <= MAX_JUMP_NS  # two in a row are
        if sample.stamp <= stamp or sample.stamp < given or (ahead and not believed):
            doubted[topic] = sample.stamp
            why = f"does not follow {stamp} ns"
            if ahead:
                why = f"is {(sample.stamp - stamp) / 1e9:.1f} s ahead of the one before"
            if stamp < sample.stamp < given:
                why = f"is {(reached - sample.stamp) / 1e9:.1f} s behind the other topic's; log both within 3 s"
            names = reading.gyroscope, reading.topic
            error = LogError(f"{names[topic]} at {log_time} ns: its stamp {sample.stamp} ns {why}")
            heappush(heap, (reached, number, log_time, error))
            continue
        last[topic], reached = (sample.stamp, log_time), max(reached, sample.stamp)
        heappush(heap, (sample.stamp, number, log_time, sample))
    while heap:
        _, _, time, first = heappop(heap)
        yield time, first
