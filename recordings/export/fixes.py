"""The fixes of satellite receivers in a log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from recordings.containers.opening import open_recording
from recordings.errors import LogError
from recordings.ros2.from_msg import stamp_of
from recordings.source.settings import MAX_RATE
from recordings.source.topics import DecodedTopics
from stages.data import Array

FIX = "sensor_msgs/msg/NavSatFix"
MAX_LATITUDE = 84  # deg, of UTM


class _Fix(NamedTuple):
    """stamp: ns; latitude, longitude: deg; fault: why it is not usable, else empty."""

    stamp: int
    latitude: float
    longitude: float
    fault: str


def read_fixes(logs: Sequence[Sequence[Path]], lost: Counter[str]) -> dict[str, Array]:
    """Topic -> (n, 3) stamp, ns, latitude and longitude, deg, of the usable fixes in the first log that has any.

    logs: each of one or several files; lost: counts the reasons why fixes were lost. Raises LogError if there are none.
    """
    reasons = list[str]()
    for log in logs:
        named, losses = ", ".join(map(str, log)), list[str]()
        fixes = _fixes(log, losses)
        usable = {topic: [each[:3] for each in own if not each.fault] for topic, own in fixes.items()}
        if tracks := {topic: np.unique(np.array(own, float), axis=0) for topic, own in usable.items() if own}:
            lost.update(f"fixes of {named}: {why}" for why in losses)
            return tracks
        faults = Counter((topic, each.fault) for topic, own in fixes.items() for each in own)
        causes = [f"{count} of {topic} have {fault}" for (topic, fault), count in faults.items()] + losses
        what = f"no usable fixes are in {named}: {', '.join(causes)}" if causes else f"no fixes ({FIX}) are in {named}"
        reasons.append(what)
    raise LogError(f"{', '.join(reasons)}; give the log that has them with --fixes, or export without --crs")


def _fixes(log: Sequence[Path], losses: list[str]) -> dict[str, list[_Fix]]:
    """Topic -> its fixes. losses: receives the reasons why fixes were lost."""
    with open_recording(log) as file:
        topics = DecodedTopics(file, 0, MAX_RATE)
        for number, why in topics.undecodable_channels.items():
            channel = file.channels[number]
            if channel.schema is not None and channel.schema.name.replace("/msg/", "/") == FIX.replace("/msg/", "/"):
                losses.append(f"{channel.topic}: {why}")
        fixes = dict[str, list[_Fix]]()
        for topic in sorted(topic for topic, schema in topics.schemas.items() if schema == FIX):
            fixes[topic] = []
            for found in topics.each(topic, _fix):
                if isinstance(found, LogError):
                    losses.append(f"{topic}: {found}")
                else:
                    fixes[topic].append(found)
        losses += [item.reason for item in file.lost]
        return fixes


def _fix(message: Any) -> _Fix:
    latitude, longitude, fault = float(message.latitude), float(message.longitude), ""
    if message.status.status < 0:
        fault = f"status {message.status.status}, no fix"
    elif latitude == longitude == 0:
        fault = "latitude and longitude 0, as of a receiver without a fix"
    elif not (abs(latitude) <= 90 and abs(longitude) <= 180):
        fault = "no latitude and longitude in range"
    elif abs(latitude) > MAX_LATITUDE:
        fault = f"latitudes beyond {MAX_LATITUDE} deg, which UTM does not cover"
    return _Fix(stamp_of(message.header), latitude, longitude, fault)
