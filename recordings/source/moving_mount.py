"""A camera that moves on the rover, as on a mast or a pan-tilt head: its mount at the time of each frame.

The transforms that move are messages of their own. Each is interpolated between two of them, as the tilt is.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice, pairwise
from operator import itemgetter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.ros2.from_msg import frame_name, frame_of, stamp_or, transform_of
from recordings.source.calibration import Camera
from recordings.source.discovery import TRANSFORMS
from recordings.source.mount import mount_of
from recordings.source.topics import DecodedTopics
from recordings.source.transforms import TRANSFORM_ATOL, TransformTree
from stages.data import Mount, Transform

MAX_GAP_NS = 1_000_000_000  # between two messages of a transform
MAX_SAMPLES = 5000  # of a transform, so that memory does not grow
MAX_LOOKED_AT = 200  # messages of each topic, to find the transforms

Link = tuple[str, str]  # parent and child


@dataclass
class MovingMount:
    """The mount of a camera on the rover, while `samples` has its transforms.

    inclinometer, base: their frames; static: the transforms that do not move; links: those that do; topics: theirs.
    """

    camera: Camera
    inclinometer: str
    base: str
    static: TransformTree
    links: Sequence[Link]
    topics: Sequence[str]
    samples: dict[Link, list[tuple[int, Transform]]] = field(init=False)

    def __post_init__(self) -> None:
        self.samples = {link: [] for link in self.links}

    def again(self) -> MovingMount:
        """The same without samples."""
        return replace(self)

    @property
    def note(self) -> str:
        """What a user should know."""
        moving = ", ".join(f"'{parent}' <- '{child}'" for parent, child in self.links)
        return f"the camera moves on the rover: {moving} on {', '.join(self.topics)} is interpolated for each frame"

    def add(self, message: Any, log_time: int) -> None:
        """Add the transforms of a tf2_msgs/TFMessage."""
        for item in message.transforms:
            link = frame_of(item), frame_name(item.child_frame_id)
            if link in self.samples:
                insort(self.samples[link], (stamp_or(item.header, log_time), transform_of(item)), key=itemgetter(0))
                del self.samples[link][:-MAX_SAMPLES]

    def at(self, stamp: int) -> Mount:
        """The mount at `stamp`, ns. Raises LogError if a transform is unknown then."""
        moved = [_interpolated(link, samples, stamp) for link, samples in self.samples.items()]
        return mount_of(self.camera, self.inclinometer, self.base, self.static.joined(moved), None, stamp)

    def first(self) -> Mount:
        """The mount at the first time at which all transforms are known."""
        stamps = sorted(stamp for stamp, _ in chain.from_iterable(self.samples.values()))
        for stamp in stamps:
            try:
                return self.at(stamp)
            except LogError as error:
                why = error
        raise why


def moving_mount(
    messages: DecodedTopics, camera: Camera, inclinometer: str, base: str, static: TransformTree
) -> MovingMount | None:
    """The mount of a camera that no static transform joins to its inclinometer or to the rover's base, but moving ones;
    None if there are none. It has the first samples."""
    if all(static.between(frame, camera.frame_id) is not None for frame in (inclinometer, base)):
        return None
    found, links = dict[str, list[Any]](), dict[Link, None]()
    for topic, schema in sorted(messages.schemas.items()):
        if schema == TRANSFORMS and not topic.endswith("tf_static"):
            read = islice(messages.each(topic, lambda message: message), MAX_LOOKED_AT)
            found[topic] = [message for message in read if not isinstance(message, LogError)]
            items = chain.from_iterable(message.transforms for message in found[topic])
            links |= dict.fromkeys((frame_of(item), frame_name(item.child_frame_id)) for item in items)
    needed = _needed(camera.frame_id, inclinometer, base, static, links)
    topics = [
        topic
        for topic, read in found.items()
        if any((frame_of(item), frame_name(item.child_frame_id)) in needed for m in read for item in m.transforms)
    ]
    if not needed:
        return None
    mount = MovingMount(camera, inclinometer, base, static, needed, topics)
    for topic in topics:
        for message in found[topic]:
            try:
                mount.add(message, 0)
            except LogError:
                continue
    return mount


def _needed(
    camera: str, inclinometer: str, base: str, static: TransformTree, links: Iterable[Link]
) -> tuple[Link, ...]:
    """The moving transforms that join the camera to its inclinometer and to the base, where the static ones do not.

    What places the base itself is the rover's pose, and is not used.
    """
    still = np.eye(3), np.zeros(3)
    known = {link: Transform(*link, *still) for link in links if base != link[1] and static.between(*link) is None}
    tree, needed = static.joined(known.values()), dict[Link, None]()
    for frame in (inclinometer, base):
        if static.between(frame, camera) is None:
            path = tree.path(frame, camera)
            steps = [*pairwise(path), *pairwise(path[::-1])]
            needed |= dict.fromkeys(link for link in steps if link in known)
    return tuple(needed)


def _interpolated(link: Link, samples: Sequence[tuple[int, Transform]], stamp: int) -> Transform:
    """A transform at `stamp`, between two samples; beside them only where it stands still."""
    name = f"the transform '{link[0]}' <- '{link[1]}'"
    first = min(max(bisect_right(samples, stamp, key=itemgetter(0)) - 1, 0), max(len(samples) - 2, 0))
    near = samples[first : first + 2]
    if not near or min(abs(at - stamp) for at, _ in near) > MAX_GAP_NS:
        raise LogError(f"{name} has no message within {MAX_GAP_NS / 1e9:g} s of {stamp} ns")
    (begin, before), (end, after) = near[0], near[-1]
    turn = Rotation.from_matrix(before.rotation.T @ after.rotation).as_rotvec()
    way = after.translation - before.translation
    if stamp in (begin, end):
        return before if stamp == begin else after
    if len(near) == 2 and max(np.abs(turn).max(), np.abs(way).max()) < TRANSFORM_ATOL:
        return before
    if not begin < stamp < end or end - begin > MAX_GAP_NS:
        raise LogError(f"{name} moves, and {stamp} ns is not between two of its messages")
    share = (stamp - begin) / (end - begin)
    rotation = before.rotation @ Rotation.from_rotvec(share * turn).as_matrix()
    return Transform(*link, rotation, before.translation + share * way)
