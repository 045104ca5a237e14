"""Finds which topics of a log are the stereo pair, its calibrations, the inclinometer and the pose.

Topics are chosen by schema, then by name: two image topics are a pair if exchanging left and right in one name gives
the other. Nothing is guessed. If candidates are equally good or missing, a sentence names them and the setting that
decides.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import takewhile

from recordings.inertial.imu_content import ImuContent
from recordings.source.settings import LogSettings
from recordings.video.formats import VIDEO

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", VIDEO)  # the best first
INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
TILTS = (IMU, "geometry_msgs/msg/QuaternionStamped", "geometry_msgs/msg/Quaternion")
BARE_TILT = "geometry_msgs/msg/Vector3Stamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (ODOMETRY, "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped")

# (pattern of the left side in a topic's name, replacement for the right side)
SIDES = (
    (re.compile("left"), "right"),
    (re.compile("Left"), "Right"),
    (re.compile("LEFT"), "RIGHT"),
    (re.compile(r"(?<![A-Za-z])l(?![A-Za-z])"), "r"),
    (re.compile(r"(?<=infra)1(?!\d)"), "2"),
    (re.compile(r"(?<!\d)0(?!\d)"), "1"),
)
_TRANSPORTS = re.compile(r"/(compressed|compressedDepth|ffmpeg|theora)$")
_TRUTH = "/truth/"  # the simulator's ground truth, used only if a setting names it
_RESULTS = "/nav/"  # results of an earlier run; a pose there is used only if a setting names it
_OTHER_IMAGES = re.compile(r"compressedDepth$|(^|[/_])(depth|disparity|mask|truth|confidence|theora)([/_]|$)")


@dataclass(frozen=True)
class Topic:
    """A topic that can be decoded. schema: full ROS 2 name; messages: their number."""

    name: str
    schema: str
    messages: int


class TiltKind(StrEnum):
    """What a tilt is made of."""

    ORIENTATION = "orientation"
    ANGLES = "plain angles"
    ACCELERATIONS = "accelerations"  # each by itself, as of an inclinometer
    ESTIMATE = "estimate"  # from accelerations and rates
    POSE = "pose"


@dataclass
class DiscoveredTopics:
    """chosen: role (left, right, left_info, right_info, inclinometer, gyroscope, odometry) -> topic; tilt: what the
    messages of the inclinometer are; missing: stream -> reason and remedy; refused: setting that names a topic the log
    does not have -> reason."""

    chosen: dict[str, str] = field(default_factory=dict)
    tilt: TiltKind = TiltKind.ORIENTATION
    missing: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    def refuse(self, stream: str, setting: str, why: str) -> None:
        """Note that a stream is missing because of a user's setting; nothing replaces it."""
        self.missing[stream] = self.refused[setting] = why


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
    _find_images(topics, settings, found)
    for side in ("left", "right"):
        if side in found.chosen and settings.calibration is None:
            _find_info(topics, settings, side, frame_of, found)
    _find_tilt(topics, settings, content_of, found)
    _find_pose(topics, settings, no_pose_reason, found)
    return found


def partners(name: str) -> list[str]:
    """The possible names of the right topic for a left topic `name`, the likeliest first."""
    found: list[str] = []
    for word, other in SIDES:
        if matches := list(word.finditer(name)):
            found.append(word.sub(other, name))
            found += [name[: match.start()] + other + name[match.end() :] for match in matches]
    return list(dict.fromkeys(found))


def _find_images(topics: Sequence[Topic], settings: LogSettings, found: DiscoveredTopics) -> None:
    images = [topic for topic in topics if topic.schema in IMAGES]
    names = {topic.name for topic in images}
    for side, given in (("left", settings.left), ("right", settings.right)):
        if given is not None and given not in names:
            found.refuse(side, side, _not_there(side, given, "image", images))
        elif given is not None and settings.left == settings.right:
            found.refuse(side, side, f"the source's 'left' and 'right' are both set to {given}; set two topics")
    if found.missing:
        return
    named = settings.left or settings.right  # then only its partner can be the other one
    candidates = [topic for topic in images if topic.messages and (named or not _OTHER_IMAGES.search(topic.name))]
    if settings.left and settings.right:
        found.chosen.update(left=settings.left, right=settings.right)
        return
    by_name = {topic.name: topic for topic in candidates}
    pairs = [
        (left, by_name[name])
        for left in candidates
        for name in partners(left.name)
        if name in by_name and settings.left in (None, left.name) and settings.right in (None, name)
    ]
    if not pairs:
        listed = _listed(candidates)
        silent = _listed([topic for topic in images if not topic.messages and not _OTHER_IMAGES.search(topic.name)])
        unread = f": no message of {silent} can be read" if silent else ""
        why = {
            0: f"the log has no camera images (sensor_msgs/Image or CompressedImage){unread}; give a log with images",
            1: f"the log has only one image topic ({listed}), but stereo needs two{unread}",
        }.get(len(candidates), f"no two image topics have names of a left and a right camera ({listed})")
        remedy = "; set 'left' and 'right' of the source to the topics" if len(candidates) > 1 else ""
        found.missing.update(left=why + remedy, right=why + remedy)
        return
    cameras = dict.fromkeys(map(_camera, pairs))  # two stereo cameras are equally good
    equal = [pair for camera in cameras for pair in _best([pair for pair in pairs if _camera(pair) == camera])]
    if len(equal) > 1:
        listed = ", ".join(f"{left.name} with {right.name}" for left, right in equal)
        why = f"several stereo pairs are equally good ({listed}); set 'left' and 'right' of the source"
        found.missing.update(left=why, right=why)
        return
    found.chosen.update(left=equal[0][0].name, right=equal[0][1].name)


def _camera(pair: tuple[Topic, Topic]) -> str:
    """The name of the stereo camera: the common start of both topics, "/front/" or "/cam"."""
    shared = takewhile(lambda letters: letters[0] == letters[1], zip(pair[0].name, pair[1].name, strict=False))
    return "".join(letter for letter, _ in shared)


def _best(pairs: Sequence[tuple[Topic, Topic]]) -> list[tuple[Topic, Topic]]:
    best = max(map(_rank, pairs))
    return [pair for pair in pairs if _rank(pair) == best]


def _rank(pair: tuple[Topic, Topic]) -> tuple[bool, int, bool]:
    """Rectified before raw, uncompressed before compressed before video, colour before gray."""
    name = pair[0].name
    return looks_rectified(name), -IMAGES.index(pair[0].schema), "color" in name or "rgb" in name


def looks_rectified(topic: str) -> bool:
    """Whether a topic is named rectified, as image_proc names its output."""
    return re.search(r"(^|[/_])rect(ified)?([/_]|$)", topic) is not None


def _find_info(
    topics: Sequence[Topic], settings: LogSettings, side: str, frame_of: Callable[[str], str], found: DiscoveredTopics
) -> None:
    infos = [topic for topic in topics if topic.schema == INFO and topic.messages]
    given = getattr(settings, f"{side}_info")
    image = found.chosen[side]
    if given is not None:
        if given in {topic.name for topic in infos}:
            found.chosen[f"{side}_info"] = given
        else:
            found.refuse(side, f"{side}_info", _not_there(f"{side}_info", given, "CameraInfo", infos))
        return
    base = _TRANSPORTS.sub("", image)
    names = {topic.name for topic in infos}
    for name in (f"{base}/camera_info", f"{base.rpartition('/')[0]}/camera_info"):
        if name in names:
            found.chosen[f"{side}_info"] = name
            return
    frame = frame_of(image)  # Foxglove's calibrations belong to an image by their frame alone
    matching = [name for name in sorted(names) if frame and frame_of(name) == frame]
    if len(matching) == 1:
        found.chosen[f"{side}_info"] = matching[0]
        return
    listed = f"the log's CameraInfo topics are {_listed(infos)}" if infos else "the log has no CameraInfo"
    remedy = f"set '{side}_info' of the source" if infos else "record it, or add it to the log"
    found.missing[side] = f"no CameraInfo belongs to {image} ({listed}); {remedy}"


def _find_tilt(
    topics: Sequence[Topic], settings: LogSettings, content_of: Callable[[str], ImuContent], found: DiscoveredTopics
) -> None:
    """Find the inclinometer, and for an estimate the gyroscope."""
    topics = [topic for topic in topics if topic.messages]
    found.tilt = _kind_set(settings)
    given = settings.inclinometer
    if given is None:
        _search_tilt(topics, settings, content_of, found)
    else:
        topic = next((topic for topic in topics if topic.name == given), None)
        if topic is None or topic.schema not in _schemas_of(found.tilt, topic.schema):
            candidates = [topic for topic in topics if topic.schema in (*TILTS, BARE_TILT)]
            found.refuse("inclinometer", "inclinometer", _not_there("inclinometer", given, "tilt", candidates))
        elif found.tilt == TiltKind.ORIENTATION and topic.schema not in TILTS:
            found.refuse("inclinometer", "inclinometer", _undefined(topic))
        else:
            found.chosen["inclinometer"] = given
            content = content_of(given) if topic.schema == IMU and found.tilt == TiltKind.ORIENTATION else None
            if content is not None and content.no_orientation and content.accelerations:
                found.tilt = TiltKind.ACCELERATIONS
    if "inclinometer" in found.chosen and (settings.gyroscope or found.tilt == TiltKind.ACCELERATIONS):
        _find_gyroscope(topics, settings, content_of, found)


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
    topics: Sequence[Topic], settings: LogSettings, content_of: Callable[[str], ImuContent], found: DiscoveredTopics
) -> None:
    """Find the inclinometer without a setting of its topic."""
    bare = [topic for topic in topics if topic.schema == BARE_TILT]
    candidates = {
        TiltKind.POSE: [topic for topic in topics if topic.schema in POSES and not topic.name.startswith(_RESULTS)],
        TiltKind.ORIENTATION: [topic for topic in topics if topic.schema in TILTS],
    }.get(found.tilt, bare)
    choice, why = candidates, ""
    if found.tilt == TiltKind.ORIENTATION:
        contents = {topic.name: content_of(topic.name) for topic in candidates if topic.schema == IMU}
        unoriented = {name: content.no_orientation for name, content in contents.items() if content.no_orientation}
        choice = [topic for topic in candidates if topic.name not in unoriented]
        why = next(iter(unoriented.values()), "")
        if not choice and (forced := [topic for topic in candidates if contents[topic.name].accelerations]):
            choice = [topic for topic in forced if contents[topic.name].rates] or forced
            found.tilt = TiltKind.ACCELERATIONS
    choice = [topic for topic in choice if re.search("inclin|tilt", topic.name, re.IGNORECASE)] or choice
    if len(choice) == 1:
        found.chosen["inclinometer"] = choice[0].name
    elif len(choice) > 1:
        found.missing["inclinometer"] = (
            f"several topics could be the inclinometer ({_listed(choice)}); set 'inclinometer' of the source"
        )
    elif candidates:
        found.missing["inclinometer"] = (
            f"{_listed(candidates)} contains no orientation ({why}) and no accelerations; record one of them"
        )
    elif bare:
        found.missing["inclinometer"] = _undefined(bare[0])
    else:
        found.missing["inclinometer"] = (
            "the log has no tilt (an Imu, or a QuaternionStamped); set 'inclinometer' of the source"
        )


def _find_gyroscope(
    topics: Sequence[Topic], settings: LogSettings, content_of: Callable[[str], ImuContent], found: DiscoveredTopics
) -> None:
    """Find the rates that go with the accelerations; without any, up is that of each acceleration."""
    imus, own = [topic for topic in topics if topic.schema == IMU], found.chosen["inclinometer"]
    if settings.gyroscope is not None:
        if settings.gyroscope not in {topic.name for topic in imus}:
            found.refuse("inclinometer", "gyroscope", _not_there("gyroscope", settings.gyroscope, "Imu", imus))
            return
        if settings.accelerations is None and not _accelerates(own, imus, content_of):
            own = next((name for name in (settings.gyroscope,) if settings.inclinometer is None), own)
            if not _accelerates(own, imus, content_of):
                why = f"{own} has no accelerations to go with the rates; set 'inclinometer' to the Imu that has them"
                found.refuse("inclinometer", "gyroscope", f"'gyroscope' of the source is set, but {why}")
                del found.chosen["inclinometer"]
                return
            found.chosen["inclinometer"] = own
        rated = [settings.gyroscope]
    elif settings.accelerations is not None:
        return
    else:
        rated = [topic.name for topic in imus if content_of(topic.name).rates]
        rated = [name for name in rated if name in (own, own.replace("accel", "gyro"))] or rated
        rated = [own] if own in rated else rated
    if len(rated) > 1:
        del found.chosen["inclinometer"]
        found.missing["inclinometer"] = (
            f"several topics have rates that may go with the accelerations of {own} ({', '.join(rated)}); "
            "set 'gyroscope' of the source"
        )
    elif rated:
        found.tilt, found.chosen["gyroscope"] = TiltKind.ESTIMATE, rated[0]


def _accelerates(name: str, imus: Sequence[Topic], content_of: Callable[[str], ImuContent]) -> bool:
    return name in {topic.name for topic in imus} and content_of(name).accelerations


def _undefined(topic: Topic) -> str:
    return (
        f"{topic.name} is a {topic.schema}, whose numbers have no defined meaning; "
        "set 'pitch', 'roll' (each field, unit, sign) and 'tilt_model' of the source, or 'accelerations'"
    )


def _find_pose(
    topics: Sequence[Topic], settings: LogSettings, no_pose_reason: Callable[[str], str | None], found: DiscoveredTopics
) -> None:
    poses = [topic for topic in topics if topic.schema in POSES and topic.messages]
    if settings.odometry is not None:
        moving = [topic for topic in topics if topic.schema == TRANSFORMS and not topic.name.endswith("tf_static")]
        candidates = poses + [topic for topic in moving if topic.messages]
        if settings.odometry not in {topic.name for topic in candidates}:
            found.refuse("odometry", "odometry", _not_there("odometry", settings.odometry, "pose", candidates))
        elif settings.odometry in {topic.name for topic in moving} and (why := no_pose_reason(settings.odometry)):
            found.refuse("odometry", "odometry", f"the source's 'odometry' is set to {settings.odometry}, where {why}")
        else:
            found.chosen["odometry"] = settings.odometry
        return
    choice = [topic for topic in poses if topic.schema == ODOMETRY and not topic.name.startswith(_RESULTS)]
    if len(choice) == 1:
        found.chosen["odometry"] = choice[0].name
    elif choice:
        found.missing["odometry"] = f"several topics are odometry ({_listed(choice)}); set 'odometry' of the source"
    else:
        other = f" (there is {_listed(poses)}; set 'odometry' of the source to use it)" if poses else ""
        found.missing["odometry"] = f"the log has no nav_msgs/Odometry from a sensor{other}"


def _not_there(setting: str, given: str, kind: str, topics: Sequence[Topic]) -> str:
    listed = f"its {kind} topics are {_listed(topics)}" if topics else f"it has no {kind} topic that can be decoded"
    return f"the source's '{setting}' is set to {given}, which is not a suitable topic of the log ({listed})"


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(topic.name for topic in topics)
