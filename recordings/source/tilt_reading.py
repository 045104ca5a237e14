"""How the tilts of a log are read: each from a message, or estimated from the samples of an Imu."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any

import numpy as np

from flow.contracts import Finding, Severity
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

REORDER_NS = 100_000_000  # by which samples of two topics may be logged out of order
MAX_JUMP_NS = 1_000_000_000  # of stamps against log times
GRAVITIES = {"Earth": 9.81, "Mars": 3.71, "the Moon": 1.62}  # m/s^2
GRAVITY_RTOL = 0.03

Sampled = tuple[int, InertialSample | LogError]  # log time, ns, and what was logged then


@dataclass(frozen=True)
class TiltReading:
    """What the tilts are made of.

    topic: of the inclinometer; gyroscope: of the rates, of an estimate; turn: (3, 3) rotation from the gyroscope's
    frame to the inclinometer's; why: no orientation is used.
    """

    kind: TiltKind
    topic: str
    gyroscope: str = ""
    turn: Array = field(default_factory=lambda: np.eye(3))
    why: str = ""

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

    def samplers(self, settings: LogSettings) -> dict[str, Callable[[Any, int], InertialSample]]:
        """Topic -> the function from a message and its log time to its sample, for an estimate."""
        read = settings.accelerations or acceleration_of
        if self.gyroscope == self.topic:
            return {self.topic: lambda message, time: sample_of(message, time, read(message), rate_of(message))}
        return {
            self.topic: lambda message, time: sample_of(message, time, read(message), None),
            self.gyroscope: lambda message, time: sample_of(message, time, None, self._turned(rate_of(message))),
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
        said = f"the tilt is estimated from the {parts}{because}"
        if estimator is None or not estimator.seconds:
            return said
        return (
            f"{said}; at rest for {estimator.rest_seconds:.0f} of {estimator.seconds:.0f} s; "
            f"{_gravity(estimator.measured_gravity, settings.gravity)}"
        )

    def fault(self, estimator: UpEstimator) -> Finding | None:
        """A fault of the sensors that the samples show, after a run."""
        if not estimator.contradicts:
            return None
        return Finding(
            f"The rates on {self.gyroscope} contradict the accelerations on {self.topic}, so the estimated tilt "
            "is wrong. Check the axes, the signs and the unit (rad/s) of the gyroscope.",
            Severity.FAULT,
            about="tilt",
        )


def _gravity(measured: float, given: float | None) -> str:
    """The measured magnitude of gravity, compared with that of the settings or of a planet."""
    found = f"gravity is {measured:.2f} m/s2"
    if given is not None:
        differs = abs(measured / given - 1) > GRAVITY_RTOL
        return f"{found}, but 'gravity' of the source is {given:g}; correct it" if differs else found
    near = [name for name, value in GRAVITIES.items() if abs(measured / value - 1) < GRAVITY_RTOL]
    return f"{found}, as on {near[0]}" if near else f"{found}, unlike on {', '.join(GRAVITIES)}; check the unit"


def estimated_tilts(samples: Iterable[Sampled], estimator: UpEstimator) -> Iterator[tuple[int, Tilt | LogError]]:
    """The tilts of samples in the order of log time, with the log times of their samples; errors stay in place."""
    latest = 0
    for log_time, item in _answers(samples, estimator):
        latest = max(latest, log_time)
        yield latest, item


def _answers(samples: Iterable[Sampled], estimator: UpEstimator) -> Iterator[tuple[int, Tilt | LogError]]:
    waiting = deque[Sampled]()
    for log_time, sample in _by_stamp(samples):
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


def _by_stamp(samples: Iterable[Sampled]) -> Iterator[Sampled]:
    """The samples in the order of stamps; a LogError in place of one whose stamp does not follow the one before."""
    heap = list[tuple[int, int, int, InertialSample]]()
    last = dict[bool, tuple[int, int]]()  # stamp and log time, of each of two topics
    doubted, newest = dict[bool, int](), dict[bool, InertialSample]()
    given = 0  # the stamp up to which samples were given
    for number, (log_time, sample) in enumerate(samples):
        if isinstance(sample, LogError):
            yield log_time, sample
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
            yield log_time, LogError(f"its stamp {sample.stamp} ns does not follow {max(stamp, given)} ns")
            continue
        last[topic] = sample.stamp, log_time
        heappush(heap, (sample.stamp, number, log_time, sample))
        while heap[0][0] <= sample.stamp - REORDER_NS:
            given, _, time, first = heappop(heap)
            yield time, first
    while heap:
        _, _, time, first = heappop(heap)
        yield time, first
