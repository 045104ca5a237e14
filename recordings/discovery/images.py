"""Finds the stereo pair and its calibrations.

Topics are chosen by schema, then by name: two image topics are a pair if exchanging left and right in one name gives
the other.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import takewhile

from recordings.discovery.roles import IMAGES, INFO, DiscoveredTopics, Remedy, Topic, names_of
from recordings.source.settings import LogSettings
from recordings.source.topics import DecodedTopics

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
_OTHER_IMAGES = re.compile(r"compressedDepth$|(^|[/_])(depth|disparity|mask|truth|confidence|theora)([/_]|$)")


def find_images(topics: Sequence[Topic], settings: LogSettings, found: DiscoveredTopics) -> None:
    images = [topic for topic in topics if topic.schema in IMAGES]
    names = {topic.name for topic in images}
    for side, given in (("left", settings.left), ("right", settings.right)):
        if given is not None and given not in names:
            found.refuse_topic(side, side, given, "image", images)
            other = settings.right if side == "left" else settings.left
            found.offer(side, side, [topic.name for topic in images if topic.name != other])
        elif given is not None and settings.left == settings.right:
            found.refuse(side, side, f"the source's 'left' and 'right' are both set to {given}; set two topics")
    if found.missing:
        return
    named = settings.left or settings.right  # then only its partner can be the other one
    candidates = [topic for topic in images if topic.messages and (named or not _OTHER_IMAGES.search(topic.name))]
    if settings.left and settings.right:
        found.chosen.update(left=settings.left, right=settings.right)
        found.why.update(left="as set", right="as set")
        return
    by_name = {topic.name: topic for topic in candidates}
    pairs = [
        (left, by_name[name])
        for left in candidates
        for name in partners(left.name)
        if name in by_name and settings.left in (None, left.name) and settings.right in (None, name)
    ]
    if not pairs:
        listed = names_of(candidates)
        silent = names_of([topic for topic in images if not topic.messages and not _OTHER_IMAGES.search(topic.name)])
        unread = f": no message of {silent} can be read" if silent else ""
        why = {
            0: f"the log has no camera images (sensor_msgs/Image or CompressedImage){unread}; give a log with images",
            1: f"the log has only one image topic ({listed}), but stereo needs two{unread}; record both cameras",
        }.get(len(candidates), f"no two image topics have names of a left and a right camera ({listed})")
        remedy = "; set 'left' and 'right' of the source to the topics" if len(candidates) > 1 else ""
        found.missing.update(left=why + remedy, right=why + remedy)
        if len(candidates) == 2:
            one, two = (topic.name for topic in candidates)
            orders = ((one, two), (two, one))
            found.remedies["left"] = [Remedy({"left": a, "right": b}, f"if {a} is the left camera") for a, b in orders]
        return
    cameras = dict.fromkeys(map(_camera, pairs))  # two stereo cameras are equally good
    equal = [pair for camera in cameras for pair in _best([pair for pair in pairs if _camera(pair) == camera])]
    if len(equal) > 1:
        listed = ", ".join(f"{left.name} with {right.name}" for left, right in equal)
        why = f"several stereo pairs are equally good ({listed}); set 'left' and 'right' of the source"
        found.missing.update(left=why, right=why)
        found.remedies["left"] = [Remedy({"left": left.name, "right": right.name}) for left, right in equal]
        return
    found.chosen.update(left=equal[0][0].name, right=equal[0][1].name)
    why = f"the best of {len(pairs)} pairs: {_merits(equal[0])}" if len(pairs) > 1 else "the only stereo pair"
    found.why.update(left=why, right=why)


def find_info(
    topics: Sequence[Topic], settings: LogSettings, side: str, messages: DecodedTopics, found: DiscoveredTopics
) -> None:
    infos = [topic for topic in topics if topic.schema == INFO and topic.messages]
    given = getattr(settings, f"{side}_info")
    image = found.chosen[side]
    if given is not None:
        if given in {topic.name for topic in infos}:
            found.chosen[f"{side}_info"] = given
        else:
            found.refuse_topic(side, f"{side}_info", given, "CameraInfo", infos)
            found.offer(side, f"{side}_info", [topic.name for topic in infos], f"if it is that of {image}")
        return
    base = _TRANSPORTS.sub("", image)
    names = {topic.name for topic in infos}
    for name in (f"{base}/camera_info", f"{base.rpartition('/')[0]}/camera_info"):
        if name in names:
            found.chosen[f"{side}_info"] = name
            return
    frame = messages.frame_of(image)  # Foxglove's calibrations belong to an image by their frame alone
    matching = [name for name in sorted(names) if frame and messages.frame_of(name) == frame]
    if len(matching) == 1:
        found.chosen[f"{side}_info"] = matching[0]
        return
    listed = f"the log's CameraInfo topics are {names_of(infos)}" if infos else "the log has no CameraInfo"
    remedy = f"set '{side}_info' of the source" if infos else "set 'calibration' of the source to its file"
    found.missing[side] = f"no CameraInfo belongs to {image} ({listed}); {remedy}"
    found.offer(side, f"{side}_info", [topic.name for topic in infos], f"if it is that of {image}")
    file = Remedy({"calibration": "FILE"}, "the calibration of this pair by ROS, Kalibr, EuRoC or OpenCV")
    found.remedies[side].append(file)


def partners(name: str) -> list[str]:
    """The possible names of the right topic for a left topic `name`, the likeliest first."""
    found: list[str] = []
    for word, other in SIDES:
        if matches := list(word.finditer(name)):
            found.append(word.sub(other, name))
            found += [name[: match.start()] + other + name[match.end() :] for match in matches]
    return list(dict.fromkeys(found))


def looks_rectified(topic: str) -> bool:
    """Whether a topic is named rectified, as image_proc names its output."""
    return re.search(r"(^|[/_])rect(ified)?([/_]|$)", topic) is not None


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


def _merits(pair: tuple[Topic, Topic]) -> str:
    """What a pair has by its names and its type, of that by which it is ranked."""
    rectified, place, colour = _rank(pair)
    merits = {"rectified": rectified, "uncompressed": place == 0, "colour": colour}
    return ", ".join(merit for merit, has in merits.items() if has) or "none is rectified or uncompressed"
