"""What the messages of an Imu contain: orientations, accelerations, rates. Drivers mark what is absent, or write 0."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from recordings.errors import LogError
from recordings.ros2.tilt_from_msg import acceleration_of, rate_of, tilt_of
from recordings.source.topics import attempt

_IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class ImuContent:
    """no_orientation: why no message has one, empty if one does; accelerations, rates: whether some are not 0."""

    no_orientation: str
    accelerations: bool
    rates: bool


def imu_content(messages: Iterable[Any | LogError]) -> ImuContent:
    """What some messages of an Imu contain.

    An orientation that is 1 in all of several messages with accelerations is a default of the driver.
    """
    why, seen, accelerations, rates = "it has no messages", list[tuple[float, ...]](), False, False
    for message in messages:
        if isinstance(message, LogError):
            why = str(message)
            continue
        tilt = attempt(tilt_of, message, 0)
        if isinstance(tilt, LogError):
            why = str(tilt)
        else:
            seen.append(tuple(getattr(message.orientation, name) for name in "xyzw"))
        accelerations |= _measures(attempt(acceleration_of, message))
        rates |= _measures(attempt(rate_of, message))
    if accelerations and len(seen) > 1 and set(seen) == {_IDENTITY}:
        return ImuContent("it is 1 in every message, as of a driver that has none", accelerations, rates)
    return ImuContent("" if seen else why, accelerations, rates)


def _measures(vector: tuple[float, ...] | LogError | None) -> bool:
    return not isinstance(vector, LogError) and vector is not None and any(vector)
