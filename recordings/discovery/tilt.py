"""Finds the inclinometer, and the gyroscope of an estimate."""

from __future__ import annotations

import re
from collections.abc import Sequence

from recordings.discovery.roles import (
    BARE_TILT,
    IMAGES,
    IMU,
    INFO,
    POSES,
    RESULTS,
    TILTS,
    TRANSFORMS,
    DiscoveredTopics,
    Remedy,
    TiltKind,
    Topic,
    names_of,
)  # fmt: skip
from recordings.errors import LogError
from recordings.inertial.imu_content import imu_content
from recordings.ros2.from_msg import frame_of
from recordings.source.settings import LogSettings
from recordings.source.topics import DecodedTopics


def find_tilt(topics: Sequence[Topic], settings: LogSettings, messages: DecodedTopics, found: DiscoveredTopics) -> None:
    """Find the inclinometer, and for an estimate the gyroscope."""
    topics = [topic for topic in topics if topic.messages]
    found.tilt = _kind_set(settings)
    apart = settings.pitch.topic if settings.pitch is not None else None
    given, setting = (apart, "pitch.topic") if apart is not None else (settings.inclinometer, "inclinometer")
    if given is None:
        _search_tilt(topics, settings, messages, found)
    else:
        topic = next((topic for topic in topics if topic.name == given), None)
        if topic is None or topic.schema not in _schemas_of(found.tilt, topic.schema):
            candidates = [topic for topic in topics if topic.schema in (*TILTS, BARE_TILT)]
            found.refuse_topic("inclinometer", setting, given, "tilt", candidates)
            found.offer("inclinometer", "inclinometer", [t.name for t in candidates if t.schema in TILTS])
        elif found.tilt == TiltKind.ORIENTATION and topic.schema not in TILTS:
            found.refuse("inclinometer", "inclinometer", _undefined(topic))
            found.remedies["inclinometer"] = _meanings(topic.name)
        else:
            found.chosen["inclinometer"], found.why["inclinometer"] = given, "as set"
            if settings.roll is not None and settings.roll.topic not in (None, given):
                found.why["inclinometer"] += f"; rolls are on {settings.roll.topic}"
            if topic.schema == IMU and found.tilt == TiltKind.ORIENTATION:
                content = imu_content(messages, given)
                if content.no_orientation and content.accelerations:
                    found.tilt = TiltKind.ACCELERATIONS
    if "inclinometer" in found.chosen and (settings.gyroscope or found.tilt == TiltKind.ACCELERATIONS):
        _find_gyroscope(topics, settings, messages, found)


def _kind_set(settings: LogSettings) -> TiltKind:
    """What the settings make a tilt of."""
    if settings.angles() is not None:
        return TiltKind.ANGLES
    if settings.upright_frame is not None:
        return TiltKind.POSE
    return TiltKind.ORIENTATION if settings.accelerations is None else TiltKind.ACCELERATIONS


def _schemas_of(kind: TiltKind, schema: str) -> tuple[str, ...]:
    """The schemas that a tilt of this kind may have: `schema`, unless such messages never contain one."""
    if kind == TiltKind.POSE:
        return (*POSES, TRANSFORMS)
    never = (*IMAGES, INFO, TRANSFORMS, *(POSES if kind == TiltKind.ORIENTATION else ()))
    return () if schema in never else (schema,)


def _search_tilt(
    topics: Sequence[Topic], settings: LogSettings, messages: DecodedTopics, found: DiscoveredTopics
) -> None:
    """Find the inclinometer without a setting of its topic."""
    bare = [topic for topic in topics if topic.schema == BARE_TILT]
    candidates = {
        TiltKind.POSE: [topic for topic in topics if topic.schema in POSES and not topic.name.startswith(RESULTS)],
        TiltKind.ORIENTATION: [topic for topic in topics if topic.schema in TILTS],
        TiltKind.ACCELERATIONS: _accelerating(topics, settings, messages),
    }.get(found.tilt, bare)
    choice, why = candidates, ""
    if found.tilt == TiltKind.ORIENTATION:
        contents = {topic.name: imu_content(messages, topic.name) for topic in candidates if topic.schema == IMU}
        unoriented = {name: content.no_orientation for name, content in contents.items() if content.no_orientation}
        choice = [topic for topic in candidates if topic.name not in unoriented]
        why = next(iter(unoriented.values()), "")
        if not choice and (forced := [topic for topic in candidates if contents[topic.name].accelerations]):
            choice = [topic for topic in forced if contents[topic.name].rates] or forced
            found.tilt = TiltKind.ACCELERATIONS
    choice = [topic for topic in choice if re.search("inclin|tilt", topic.name, re.IGNORECASE)] or choice
    if len(choice) == 1:
        found.chosen["inclinometer"] = choice[0].name
        found.why["inclinometer"] = "the only tilt" if len(candidates) == 1 else "by its name and content"
    elif len(choice) > 1:
        found.missing["inclinometer"] = (
            f"several topics could be the inclinometer ({names_of(choice)}); set 'inclinometer' of the source"
        )
        found.offer("inclinometer", "inclinometer", [topic.name for topic in choice])
    elif candidates:
        found.missing["inclinometer"] = next(filter(None, (_mixed(topic.name, messages) for topic in candidates)), (
            f"{names_of(candidates)} contains no orientation ({why}) and no accelerations; record one of them"
        ))  # fmt: skip
    elif bare:
        found.missing["inclinometer"] = _undefined(bare[0])
        found.remedies["inclinometer"] = [remedy for topic in bare for remedy in _meanings(topic.name)]
    else:
        found.missing["inclinometer"] = (
            "the log has no tilt (an Imu, or a QuaternionStamped); set 'inclinometer' of the source, and for a message "
            "of bare angles 'pitch', 'roll' and 'tilt_model'"
        )


def _find_gyroscope(
    topics: Sequence[Topic], settings: LogSettings, messages: DecodedTopics, found: DiscoveredTopics
) -> None:
    """Find the rates that go with the accelerations; without any, up is that of each acceleration."""
    imus, own = [topic for topic in topics if topic.schema == IMU], found.chosen["inclinometer"]
    if settings.gyroscope is not None:
        if settings.gyroscope not in {topic.name for topic in imus}:
            found.refuse_topic("inclinometer", "gyroscope", settings.gyroscope, "Imu", imus)
            return
        if settings.accelerations is None and not _accelerates(own, imus, messages):
            own = settings.gyroscope if settings.inclinometer is None else own
            if not _accelerates(own, imus, messages):
                why = f"{own} has no accelerations to go with the rates; set 'inclinometer' to the Imu that has them"
                found.refuse("inclinometer", "gyroscope", f"'gyroscope' of the source is set, but {why}")
                del found.chosen["inclinometer"]
                return
            found.chosen["inclinometer"] = own
        rated = [settings.gyroscope]
    elif own not in {topic.name for topic in imus}:
        return
    else:
        rated = [topic.name for topic in imus if imu_content(messages, topic.name).rates]
        rated = [name for name in rated if name in (own, own.replace("accel", "gyro"))] or rated
        rated = [own] if own in rated else rated
    if len(rated) > 1:
        del found.chosen["inclinometer"]
        found.missing["inclinometer"] = (
            f"several topics have rates that may go with the accelerations of {own} ({', '.join(rated)}); "
            "set 'gyroscope' of the source"
        )
        found.offer("inclinometer", "gyroscope", rated)
    elif rated:
        found.tilt, found.chosen["gyroscope"] = TiltKind.ESTIMATE, rated[0]


def _accelerating(topics: Sequence[Topic], settings: LogSettings, messages: DecodedTopics) -> list[Topic]:
    """The topics with the field of the setting 'accelerations', without Imus of rates alone; all, if none has it."""
    field, imus = settings.accelerations, [topic for topic in topics if topic.schema == IMU]
    every = [topic for topic in topics if topic.schema in (BARE_TILT, IMU)]
    if field is None:
        return every
    named = [topic for topic in every if not isinstance(messages.first(topic.name, field), LogError)]
    return [topic for topic in named if topic not in imus or _accelerates(topic.name, imus, messages)] or named or every


def _accelerates(name: str, imus: Sequence[Topic], messages: DecodedTopics) -> bool:
    return name in {topic.name for topic in imus} and imu_content(messages, name).accelerations


def _mixed(name: str, messages: DecodedTopics) -> str:
    """That several sensors are on a topic; empty if all messages have one frame."""
    frames = sorted({frame for frame in messages.sample(name, frame_of) if not isinstance(frame, LogError)})
    if len(frames) < 2:
        return ""
    listed = ", ".join(f"'{frame}'" for frame in frames)
    return (
        f"{name} contains messages of several sensors (in the frames {listed}), which show no common tilt; record each "
        "on a topic of its own"
    )


def _undefined(topic: Topic) -> str:
    return (
        f"{topic.name} is a {topic.schema}, whose numbers have no defined meaning; "
        "set 'pitch', 'roll' (each field, unit, sign) and 'tilt_model' of the source, or 'accelerations'"
    )


def _meanings(topic: str) -> list[Remedy]:
    """Settings that define bare numbers."""
    angles = {
        name: {"field": f"vector.{axis}", "unit": "deg", "sign": 1} for name, axis in (("pitch", "y"), ("roll", "x"))
    }
    return [
        Remedy(
            {"inclinometer": topic, **angles, "tilt_model": "axis"}, "with the sensor's own fields, units and signs"
        ),
        Remedy({"inclinometer": topic, "accelerations": {"field": "vector"}}, "if these are accelerations"),
    ]
