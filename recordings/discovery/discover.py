"""Finds the topic of each role in a log.

Topics are chosen by schema, then by name. Nothing is guessed. If candidates are equally good or missing, a sentence
names them and the setting that decides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from recordings.discovery.images import find_images, find_info
from recordings.discovery.roles import (
    ODOMETRY,
    POSES,
    RESULTS,
    TRANSFORMS,
    DiscoveredTopics,
    Remedy,
    Topic,
    names_of,
    not_there,
)  # fmt: skip
from recordings.discovery.tilt import find_tilt
from recordings.inertial.imu_content import ImuContent
from recordings.source.settings import LogSettings

_TRUTH = "/truth/"  # the simulator's ground truth, used only if a setting names it


def discover(
    topics: Sequence[Topic],
    settings: LogSettings,
    frame_of: Callable[[str], str],
    content_of: Callable[[str], ImuContent],
    no_pose_reason: Callable[[str], str | None],
) -> DiscoveredTopics:
    """Find the topic of each role.

    settings: the topics named by the user; frame_of: topic -> the frame_id of its messages; content_of: Imu topic ->
    what its messages contain; no_pose_reason: topic of transforms -> why they are not the rover's pose.
    """
    named = (
        settings.left, settings.right, settings.left_info, settings.right_info, settings.inclinometer,
        settings.gyroscope, settings.odometry,
    )  # fmt: skip
    if not any(name.startswith(_TRUTH) for name in named if name is not None):
        topics = [topic for topic in topics if not topic.name.startswith(_TRUTH)]
    found = DiscoveredTopics()
    find_images(topics, settings, found)
    for side in ("left", "right"):
        if side in found.chosen and settings.calibration is None:
            find_info(topics, settings, side, frame_of, found)
    find_tilt(topics, settings, content_of, found)
    poses = [
        topic for topic in topics if topic.schema in POSES and topic.messages and not topic.name.startswith(RESULTS)
    ]
    if "inclinometer" in found.missing:
        for topic in poses:
            frame = frame_of(topic.name)
            upright = Remedy({"inclinometer": topic.name, "upright_frame": frame}, f"if z of '{frame}' points up")
            found.remedies.setdefault("inclinometer", []).append(upright)
    _find_pose(topics, settings, no_pose_reason, found)
    return found


def _find_pose(
    topics: Sequence[Topic], settings: LogSettings, no_pose_reason: Callable[[str], str | None], found: DiscoveredTopics
) -> None:
    poses = [topic for topic in topics if topic.schema in POSES and topic.messages]
    if settings.odometry is not None:
        moving = [topic for topic in topics if topic.schema == TRANSFORMS and not topic.name.endswith("tf_static")]
        candidates = poses + [topic for topic in moving if topic.messages]
        if settings.odometry not in {topic.name for topic in candidates}:
            found.refuse("odometry", "odometry", not_there("odometry", settings.odometry, "pose", candidates))
        elif settings.odometry in {topic.name for topic in moving} and (why := no_pose_reason(settings.odometry)):
            found.refuse("odometry", "odometry", f"the source's 'odometry' is set to {settings.odometry}, where {why}")
        else:
            found.chosen["odometry"], found.why["odometry"] = settings.odometry, "as set"
        return
    choice = [topic for topic in poses if topic.schema == ODOMETRY and not topic.name.startswith(RESULTS)]
    if len(choice) == 1:
        found.chosen["odometry"], found.why["odometry"] = choice[0].name, "the only Odometry"
    elif choice:
        found.offer("odometry", "odometry", [topic.name for topic in choice])
        found.missing["odometry"] = f"several topics are odometry ({names_of(choice)}); set 'odometry' of the source"
    else:
        other = f" (there is {names_of(poses)}; set 'odometry' of the source to use it)" if poses else ""
        found.offer("odometry", "odometry", [topic.name for topic in poses if not topic.name.startswith(RESULTS)])
        found.missing["odometry"] = f"the log has no nav_msgs/Odometry from a sensor{other}"
