"""What the messages of an Imu contain: orientations, accelerations, rates. Drivers mark what is absent, or write 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recordings.errors import LogError
from recordings.ros2.tilt_from_msg import acceleration_of, rate_of, tilt_of
from recordings.source.topics import DecodedTopics, attempt
from stages.data import Array

MIN_GRAVITY = 0.3  # m/s^2, of a mean acceleration; less is a bias of the sensor
MIN_COMMON_SHARE = 0.3  # of the size of accelerations, that their mean has
_IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class ImuContent:
    """no_orientation: why no message has one, empty if one does; accelerations: whether they contain gravity; rates:
    whether some are not 0."""

    no_orientation: str
    accelerations: bool
    rates: bool


def imu_content(messages: DecodedTopics, topic: str) -> ImuContent:
    """What the messages of an Imu contain, by a sample.

    An orientation that is 1 in all of several messages with accelerations is a default of the driver. One whose roll
    and pitch are exactly 0 in all of them is a heading alone.
    """
    why, seen, forces, rates = "it has no messages", list[tuple[float, ...]](), list[tuple[float, ...]](), False
    for message in messages.sample(topic, lambda message: message):
        if isinstance(message, LogError):
            why = str(message)
            continue
        tilt = attempt(tilt_of, message, 0)
        if isinstance(tilt, LogError):
            why = str(tilt)
        else:
            seen.append(tuple(getattr(message.orientation, name) for name in "xyzw"))
        forces += _measured(attempt(acceleration_of, message))
        rates |= any(map(any, _measured(attempt(rate_of, message))))
    gravity = _contain_gravity(np.array(forces, np.float64).reshape(-1, 3))
    if np.any(forces) and not gravity:
        return ImuContent("" if seen else f"{why}; its accelerations contain no gravity", gravity, rates)
    if gravity and len(seen) > 1 and set(seen) == {_IDENTITY}:
        return ImuContent("it is 1 in every message, as from a driver without an orientation", gravity, rates)
    if gravity and len(seen) > 1 and all(x == y == 0 for x, y, _, _ in seen):
        return ImuContent("its roll and pitch are 0 in every message, so it is a heading alone", gravity, rates)
    return ImuContent("" if seen else why, gravity, rates)


def _measured(vector: tuple[float, ...] | LogError | None) -> list[tuple[float, ...]]:
    return [] if isinstance(vector, LogError) or vector is None else [vector]


def _contain_gravity(forces: Array) -> bool:
    """Whether accelerations (n, 3), m/s^2, have a common direction; some drivers subtract gravity."""
    if not len(forces):
        return False
    mean, size = float(np.linalg.norm(forces.mean(axis=0))), float(np.sqrt((forces**2).sum(axis=1).mean()))
    return mean > MIN_GRAVITY and mean > MIN_COMMON_SHARE * size
