"""Finds the topic of each role in a log.

Topics are chosen by schema, then by name. Nothing is guessed. If candidates are equally good or missing, a sentence
names them and the setting that decides.
"""

from __future__ import annotations

from collections.abc import Sequence

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
)  # fmt: skip
from recordings.discovery.tilt import find_tilt
from recordings.errors import LogError
from recordings.ros2.from_msg import frame_name, frame_of
from recordings.source.settings import LogSettings
from recordings.source.topics import MAX_TRIED, DecodedTopics

_MAX_LISTED = 5  # frames in a sentence
VISUAL = "visual"  # the value of the setting 'odometry' by which a run does without the log's pose
_TRUTH = "/truth/"  # the simulator's ground truth, used only if a setting names it


def discover(messages: DecodedTopics, settings: LogSettings) -> DiscoveredTopics:
    """Find the topic of each role. settings: the topics named by the user."""
    topics = [Topic(name, schema, messages.count(name)) for name, schema in sorted(messages.schemas.items())]
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
            find_info(topics, settings, side, messages, found)
    find_tilt(topics, settings, messages, found)
    poses = [
        topic for topic in topics if topic.schema in POSES and topic.messages and not topic.name.startswith(RESULTS)
    ]
    if "inclinometer" in found.missing:
        for topic in poses:
            frame = messages.frame_of(topic.name)
            upright = Remedy({"inclinometer": topic.name, "upright_frame": frame}, f"if z of '{frame}' points up")
            found.remedies.setdefault("inclinometer", []).append(upright)
    _find_pose(topics, settings, messages, found)
    return found


def _find_pose(
    topics: Sequence[Topic], settings: LogSettings, messages: DecodedTopics, found: DiscoveredTopics
) -> None:
    poses = [topic for topic in topics if topic.schema in POSES and topic.messages]
    if settings.odometry == VISUAL:
        found.missing["odometry"] = f"the source's 'odometry' is set to {VISUAL}"
        return
    moving = [topic for topic in topics if topic.schema == TRANSFORMS and not topic.name.endswith("tf_static")]
    if settings.odometry is not None:
        candidates = poses + [topic for topic in moving if topic.messages]
        if settings.odometry not in {topic.name for topic in candidates}:
            found.refuse_topic("odometry", "odometry", settings.odometry, "pose", candidates)
        elif settings.odometry in {topic.name for topic in moving} and (
            why := _no_pose_reason(messages, settings.odometry, settings.base_frame)
        ):
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
        poses += [t for t in moving if t.messages and not _no_pose_reason(messages, t.name, settings.base_frame)]
        other = f" (there is {names_of(poses)}; set 'odometry' of the source to use it)" if poses else ""
        found.offer("odometry", "odometry", [topic.name for topic in poses if not topic.name.startswith(RESULTS)])
        found.missing["odometry"] = f"the log has no nav_msgs/Odometry from a sensor{other}"


def _no_pose_reason(messages: DecodedTopics, topic: str, base: str) -> str | None:
    """Why the transforms on a topic are not the pose of the frame `base`; None if they are."""
    parents = dict[str, set[str]]()
    for message in messages.sample(topic, lambda message: message.transforms, MAX_TRIED):
        for item in [] if isinstance(message, LogError) else message:
            parents.setdefault(frame_name(item.child_frame_id), set()).add(frame_of(item))
    if base not in parents:
        others = ", ".join(f"'{child}'" for child in sorted(parents)[:_MAX_LISTED]) or "nothing"
        return f"no transform places '{base}' (they place {others}); set 'base_frame' of the source to the rover's"
    first, *more = sorted(parents[base])
    if more:
        return f"'{base}' has two parents, '{first}' and '{more[0]}'; record the pose as Odometry"
    # map <- odom <- base_link is the one chain (REP 105) in which the last link alone is a pose.
    if first in parents and first.rpartition("/")[2] != "odom":
        above = min(parents[first])
        return (
            f"'{base}' is placed in '{first}', and that in '{above}'; set 'base_frame' of the source to '{first}' "
            "if that is the rover's frame, or record the pose as Odometry"
        )
    return None
