"""A camera that moves on the rover, as on a mast or a pan-tilt head: its mount at the time of each frame.

The transforms that move are messages of their own, or angles of joints. Each is interpolated between two of them, as
the tilt is.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from recordings.discovery.roles import TRANSFORMS
from recordings.errors import LogError
from recordings.ros2.from_msg import frame_name, frame_of, stamp_or, transform_of
from recordings.source.calibration import Camera
from recordings.source.joints import Joint
from recordings.source.mount import mount_of
from recordings.source.topics import DecodedTopics, attempt
from recordings.source.transforms import TRANSFORM_ATOL, TransformTree
from stages.data import Mount, Transform

JOINTS = "sensor_msgs/msg/JointState"
MAX_GAP_NS = 1_000_000_000  # between two messages of a transform
MAX_SAMPLES = 5000  # of a transform, so that memory does not grow
MAX_CLOCK_NS = 60_000_000_000  # between frames and the messages of a transform, beyond which their clocks differ

Link = tuple[str, str]  # parent and child


@dataclass
class MovingMount:
    """The mount of a camera on the rover, while `samples` has its transforms.

    inclinometer, base: their frames; static: the transforms that do not move; links: those that do; topics: theirs;
    joints: by name; begun: transform -> its earliest stamp, ns; lost: transform -> stamps, ns, of the frames that lack
    it.
    """

    camera: Camera
    inclinometer: str
    base: str
    static: TransformTree
    links: Sequence[Link]
    topics: Sequence[str]
    joints: Mapping[str, Joint]
    samples: dict[Link, list[tuple[int, Transform]]] = field(init=False)
    begun: dict[Link, int] = field(init=False, default_factory=dict)
    lost: dict[Link, list[int]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.samples = {link: [] for link in self.links}

    def again(self) -> MovingMount:
        """The same without samples and lost frames."""
        return replace(self)

    @property
    def note(self) -> str:
        """What a user should know."""
        moving = ", ".join(f"'{parent}' <- '{child}'" for parent, child in self.links)
        return f"the camera moves on the rover: {moving} on {', '.join(self.topics)} is interpolated for each frame"

    def add(self, message: Any, log_time: int) -> None:
        """Add the transforms of a tf2_msgs/TFMessage or a sensor_msgs/JointState."""
        for link, stamp, transform in _transforms_in(message, log_time, self.joints, self.samples):
            self.begun[link] = min(stamp, self.begun.get(link, stamp))
            insort(self.samples[link], (stamp, transform), key=itemgetter(0))
            del self.samples[link][:-MAX_SAMPLES]

    def at(self, stamp: int) -> Mount:
        """The mount at `stamp`, ns. Raises LogError if a transform is unknown then."""
        moved = list[Transform]()
        for link, samples in self.samples.items():
            try:
                moved.append(_interpolated(link, samples, stamp))
            except LogError:
                self.lost.setdefault(link, []).append(stamp)
                raise
        return mount_of(self.camera, self.inclinometer, self.base, self.static.joined(moved), None, stamp)

    def gaps(self, begin: int) -> str:
        """The transforms that frames lack, and when, in seconds after `begin`, ns; empty if none is lost."""
        found = list[str]()
        for (parent, child), stamps in self.lost.items():
            first, last = (f"{(stamp - begin) / 1e9:+.1f} s" for stamp in (stamps[0], stamps[-1]))
            if len(stamps) > 1:
                lacking = f"{len(stamps)} frames from {first} to {last} lack it, and their images are lost"
            else:
                lacking = f"1 frame at {first} lacks it, and its images are lost"
            found.append(f"'{parent}' <- '{child}' {self._why_lost((parent, child), stamps)}: {lacking}")
        return "; ".join(found)

    def _why_lost(self, link: Link, stamps: Sequence[int]) -> str:
        """Why frames of these stamps lack a transform, by its samples at the end."""
        samples = self.samples[link]
        if not samples:
            return "has no message that can be read"
        apart = max(self.begun[link] - stamps[-1], stamps[0] - samples[-1][0])
        if apart > MAX_CLOCK_NS:
            off = f"{apart / 1e9:.1f} s off those of the images"
            return f"has stamps of another clock, {off}; record both with one clock"
        kept = [attempt(_interpolated, link, samples, stamp) for stamp in stamps if stamp >= samples[0][0]]
        if kept and not any(isinstance(each, LogError) for each in kept):
            return "is logged too late"
        return "has a gap"

    def first(self) -> Mount:
        """The mount at the first time at which all transforms are known."""
        unusable = f"no message of {', '.join(self.topics)} can be used for the mount of the camera"
        why = LogError(f"{unusable}; record rotations as unit quaternions, and a position with each joint")
        for stamp in sorted(stamp for stamp, _ in chain.from_iterable(self.samples.values())):
            try:
                return self.at(stamp)
            except LogError as error:
                why = error
        raise why


@dataclass(frozen=True, eq=False)
class MovingTransforms:
    """The transforms of a log that may move, as found in samples of each topic.

    messages: topic -> its sampled messages; links: topic -> the transforms in them; joints: name -> joint. Only joints
    with angles in the log are included. They win over transforms of the same frames.
    """

    messages: Mapping[str, Sequence[Any]]
    links: Mapping[str, Collection[Link]]
    joints: Mapping[str, Joint]

    @classmethod
    def of(cls, topics: DecodedTopics, joints: Mapping[str, Joint], most: int | None) -> MovingTransforms:
        """Sample a log. joints: of the source, by name; most: number of messages of each part of the log."""
        messages, links = dict[str, list[Any]](), dict[str, set[Link]]()
        for topic, schema in sorted(topics.schemas.items()):
            if (schema == TRANSFORMS and not topic.endswith("tf_static")) or (schema == JOINTS and joints):
                read = topics.sample(topic, lambda message: (message, _links_in(message, joints)), most)
                found = [each for each in read if not isinstance(each, LogError)]
                messages[topic] = [message for message, _ in found]
                links[topic] = {link for _, each in found for link in each}
        turned = set[Link]().union(*(links[topic] for topic in links if topics.schemas[topic] == JOINTS))
        for topic in links:
            links[topic] -= turned if topics.schemas[topic] == TRANSFORMS else set()
        return cls(messages, links, {name: joint for name, joint in joints.items() if _link_of(joint) in turned})

    @property
    def of_joints(self) -> set[Link]:
        """The transforms that joints turn."""
        return {_link_of(joint) for joint in self.joints.values()}

    def tree(self, static: TransformTree, without: str = "") -> TransformTree:
        """Static transforms and those that move, at unknown places. without: a frame that none of them places."""
        still = np.eye(3), np.zeros(3)
        links = sorted(set().union(*self.links.values()))
        moving = [link for link in links if link[1] != without and static.between(*link) is None]
        return static.joined(Transform(*link, *still) for link in moving)

    def contradictions(self, static: TransformTree, frames: Sequence[str]) -> list[LogError]:
        """The transforms between the first of these frames and the others that contradict static ones, as errors."""
        paths = [static.path(frames[0], other) for other in frames[1:]]
        still = {frozenset(step) for path in paths for step in pairwise(path)}
        found = dict[Link, LogError]()
        for topic, messages in self.messages.items():
            for item in chain.from_iterable(getattr(message, "transforms", ()) for message in messages):
                link, transform = (frame_of(item), frame_name(item.child_frame_id)), attempt(transform_of, item)
                if frozenset(link) not in still or link in found or isinstance(transform, LogError):
                    continue
                if isinstance(wrong := attempt(static.join, transform), LogError):
                    found[link] = LogError(f"{topic}: {wrong}")
        return [*found.values()]


def moving_mount(
    moves: MovingTransforms, camera: Camera, inclinometer: str, base: str, static: TransformTree
) -> MovingMount | None:
    """The mount of a camera that moving transforms join to its inclinometer or to the rover's base, with the samples.

    None if static transforms join it to both, or if no transform that moves does.
    """
    needed = _needed(camera.frame_id, inclinometer, base, static, moves)
    if not needed:
        return None
    topics = [topic for topic, links in moves.links.items() if {*links} & {*needed}]
    mount = MovingMount(camera, inclinometer, base, static, needed, topics, moves.joints)
    for message in chain.from_iterable(moves.messages[topic] for topic in topics):
        attempt(mount.add, message, 0)
    return mount


def _links_in(message: Any, joints: Mapping[str, Joint]) -> list[Link]:
    """The transforms that a message has."""
    if hasattr(message, "transforms"):
        return [(frame_of(item), frame_name(item.child_frame_id)) for item in message.transforms]
    return [_link_of(joints[name]) for name, _ in zip(message.name, message.position, strict=False) if name in joints]


def _link_of(joint: Joint) -> Link:
    return joint.origin.parent, joint.origin.child


def _transforms_in(
    message: Any, log_time: int, joints: Mapping[str, Joint], wanted: Collection[Link]
) -> Iterator[tuple[Link, int, Transform]]:
    """The wanted transforms of a message, with their stamps."""
    if hasattr(message, "transforms"):
        turned = {*map(_link_of, joints.values())}
        for link, item in zip(_links_in(message, joints), message.transforms, strict=True):
            if link in wanted and link not in turned:
                yield link, stamp_or(item.header, log_time), transform_of(item)
        return
    for name, angle in zip(message.name, message.position, strict=False):
        if name in joints and (link := _link_of(joints[name])) in wanted:
            if not np.isfinite(angle):
                raise LogError(f"the angle of joint '{name}' is {angle}")
            yield link, stamp_or(message.header, log_time), joints[name].at(float(angle))


def _needed(
    camera: str, inclinometer: str, base: str, static: TransformTree, moves: MovingTransforms
) -> tuple[Link, ...]:
    """The moving transforms that join the camera to its inclinometer and to the base, where the static ones do not.

    What places the base itself is the rover's pose, and is not used.
    """
    tree, needed = moves.tree(static, without=base), dict[Link, None]()
    moving = set().union(*moves.links.values())
    for frame in (inclinometer, base):
        if static.between(frame, camera) is None:
            path = tree.path(frame, camera)
            steps = [*pairwise(path), *pairwise(path[::-1])]
            needed |= dict.fromkeys(link for link in steps if link in moving and static.between(*link) is None)
    return tuple(needed)


def _interpolated(link: Link, samples: Sequence[tuple[int, Transform]], stamp: int) -> Transform:
    """A transform at `stamp`, between two samples; beside them only where it stands still."""
    from scipy.spatial.transform import Rotation  # takes long to import

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
