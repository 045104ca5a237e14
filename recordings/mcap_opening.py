"""Opens an MCAP log: looks at its topics, its calibration and its static transforms, and says for each stream that the
log cannot give why not.

A message may have any fields, whatever its type's name: what cannot be made of one is an error of that message, said
like a broken one's, and never ends the opening.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from mcap.records import Channel

from recordings.decode import camera_model, frame_name, frame_of, pixels_of, pose_of, tilt_of, unread_encoding
from recordings.discovery import TRANSFORMS, Topic, Topics, discover
from recordings.errors import LogError, counted, said
from recordings.mcap_index import Lost
from recordings.mcap_reader import CONVERT, McapFile
from recordings.rig import Camera, Frames, baseline_note, calibrated_pair, mounted
from recordings.ros2_types import decoder_for, full_name
from stages.data import LEVEL_FRAME, Array, CameraModel, Mount, Pose

if TYPE_CHECKING:
    from recordings.mcap_source import McapSource

CAMERAS = ("left", "right")
EVER = 0  # ns, the stamp of what holds throughout: frames may be before the log's first message, or of another clock
_STREAMS = (*CAMERAS, "inclinometer", "odometry")
_PLACES = 4  # in a log, at which messages are looked at until one can be read: a filter may begin with nonsense
_LOOKED_AT = 20  # messages at most at each of them
_TRANSFORMS_LOOKED_AT = 100  # messages from the first one of the rover on; others may come more rarely
_LISTED = 5  # topics in a sentence

Decoder = Callable[[bytes | memoryview], Any]
T = TypeVar("T")


class _GoneError(LogError):
    """A message that the file does not hold any more."""


class Opening:
    """What a log offers.

    decoders: by channel; missing: stream -> why the log does not provide it, and what to do; refused: setting of the
    source that the log does not bear out -> why; undecodable: the topics that are, in words; topics: stream -> topic;
    infos: side -> topic of its calibration, and the first of it; cameras: the calibrated pair, where both are there;
    baseline_note: what there is to say of that; static: the log's static transforms; tilt_frame: of the inclinometer's
    first message; problems: (stream, loss) that came up.
    """

    def __init__(self, file: McapFile, source: McapSource) -> None:
        self.file, self.source = file, source
        self.missing: dict[str, str] = {}
        self.refused: dict[str, str] = {}
        self.topics: dict[str, str] = {}
        self.infos: dict[str, tuple[str, CameraModel]] = {}
        self.cameras: tuple[Camera, Camera] | None = None
        self.static = Frames()
        self.mount: Mount | None = None
        self.baseline_note = ""
        self.tilt_frame = ""
        self.problems: list[tuple[str, LogError]] = []
        self.schemas: dict[str, str] = {}
        self.decoders: dict[int, Decoder] = {}
        self.undecodable = ""
        self._sought = set[str]()  # streams of which no topic was found
        self._sealed: dict[int, str] = {}  # channel -> why it cannot be decoded
        self._find_decoders()
        self._read_static()
        found = self._discover()
        self._find_cameras(found)
        self._find_mount()
        self._check_pose()
        self._check_encodings()
        self._check_pixels()
        for stream in self.missing:
            self.topics.pop(stream, None)
        self._tell_sealed()

    def refusals(self) -> dict[str, str]:
        """`missing`, each as a sentence that stands alone: what was sought may be among what cannot be decoded or is
        lost."""
        lost = f"messages were lost: {self.file.index.lost[0].reason}" if self.file.index.lost else ""
        aside = "".join(f" ({what})" for what in (self.undecodable, lost) if what)
        return {name: why + aside if name in self._sought else why for name, why in self.missing.items()}

    def channels_of(self, topic: str) -> set[int]:
        """The channels of a topic that can be decoded."""
        return self.file.channels_of([topic]) & self.decoders.keys()

    def _find_decoders(self) -> None:
        for number, channel in self.file.index.channels.items():
            try:
                self.decoders[number] = self._decoder(channel)
            except LogError as error:
                self._sealed[number] = str(error)

    def _decoder(self, channel: Channel) -> Decoder:
        schema = self.file.schema(channel)
        if channel.message_encoding != "cdr":
            remedy = f"; convert the bag itself: {CONVERT}" if channel.message_encoding == "ros1" else ""
            raise LogError(f"its messages are in '{channel.message_encoding}', not in 'cdr' as those of ROS 2{remedy}")
        if schema is None:
            raise LogError("its messages have no schema")
        decoder = decoder_for(schema.name, schema.encoding, schema.data)
        self.schemas[channel.topic] = full_name(schema.name)
        return decoder

    def _read_static(self) -> None:
        for topic, schema in sorted(self.schemas.items()):
            if schema == TRANSFORMS and topic.endswith("tf_static"):
                for transforms in self._made(topic, lambda message: message.transforms, any_order=True):
                    for item in [transforms] if isinstance(transforms, LogError) else transforms:
                        added = item if isinstance(item, LogError) else _attempt(self.static.add, item)
                        if isinstance(added, LogError):
                            self.problems.append(("log", LogError(f"{topic}: {added}")))

    def _discover(self) -> Topics:
        topics = [Topic(name, self.schemas[name], self.file.count(self.channels_of(name))) for name in self.schemas]
        topics.sort(key=lambda topic: topic.name)
        angles = self.source.angles()
        found = discover(topics, self.source, angles is not None, self._frame_of, self._untilted, self._unplaced)
        if angles is not None and (topic := found.chosen.get("inclinometer")):
            checked = self._first(topic, angles.check)
            if isinstance(checked, LogError):
                del found.chosen["inclinometer"]
                found.refuse("inclinometer", "pitch and roll", f"bare angles of {topic}: {checked}")
        sealed = {self.file.channel(n).topic: why for n, why in self._sealed.items() if self.file.count({n})}
        listed = [f"{topic}: {why}" for topic, why in sorted(sealed.items()) if topic not in self.schemas]
        if listed:
            more = f", and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
            self.undecodable = f"topics that cannot be decoded: {'; '.join(listed[:_LISTED])}{more}"
        self._sought = set(found.missing)
        self.missing.update(found.missing)
        self.refused.update(found.refused)
        self.topics.update({role: name for role, name in found.chosen.items() if role in _STREAMS})
        return found

    def _find_cameras(self, found: Topics) -> None:
        if any(role not in found.chosen for side in CAMERAS for role in (side, f"{side}_info")):
            return
        frames = []
        for side in CAMERAS:
            topic = found.chosen[f"{side}_info"]
            info = self._first(topic, lambda message: (camera_model(message), frame_of(message)))
            if isinstance(info, LogError):
                self.missing[side] = f"the calibration on {topic} cannot be read: {info}"
            else:
                self.infos[side] = topic, info[0]
                frames.append(info[1] or self._frame_of(found.chosen[side]))
        if len(frames) < len(CAMERAS):
            return
        topics = (found.chosen["left"], found.chosen["right"])
        models = (self.infos["left"][1], self.infos["right"][1])
        cameras = _attempt(calibrated_pair, models, (frames[0], frames[1]), topics, self.static)
        if isinstance(cameras, LogError):
            self.missing.update(left=str(cameras), right=str(cameras))
        else:
            self.cameras = cameras
            self.baseline_note = baseline_note(cameras, models, (frames[0], frames[1]), self.static)

    def _find_mount(self) -> None:
        if self.cameras is None:
            why = next(self.missing[side] for side in CAMERAS if side in self.missing)
            self.missing["mount"] = f"without a calibrated pair of cameras there is no mount: {why}"
        elif "inclinometer" in self.missing:
            self.missing["mount"] = f"without an inclinometer there is no mount: {self.missing['inclinometer']}"
        else:
            frame = self._first(self.topics["inclinometer"], frame_of)
            self.tilt_frame = "" if isinstance(frame, LogError) else frame
            given, base = self.source.camera_from_inclinometer, self.source.base_frame
            mount = _attempt(mounted, EVER, self.cameras[0], self.tilt_frame, base, self.static, given)
            if isinstance(mount, LogError):
                self.missing["mount"] = str(mount)
            else:
                self.mount = mount

    def _check_pose(self) -> None:
        """A pose in a frame that moves along is missing, and so is that of something of which nothing tells how the
        camera sits on it."""
        if self.cameras is None or "odometry" not in self.topics:
            return
        topic, camera = self.topics["odometry"], self.cameras[0].frame_id
        pose = self._first(topic, lambda message: _pose_of(message, self.source.base_frame))
        if isinstance(pose, LogError):
            return
        moving, resting = pose.child_frame_id, pose.frame_id
        base = self.mount.base_from_camera if self.mount is not None else self.static.between(moving, camera)
        why = ""
        if resting in (LEVEL_FRAME, camera, self.cameras[0].image_frame, moving):
            why = f"{topic} is a pose in the frame '{resting}', which moves with the rover; record it in one that rests"
        elif moving not in (camera, self.cameras[0].image_frame) and (base is None or base.parent != moving):
            why = (
                f"{topic} is the pose of '{moving}', and nothing tells how the camera '{camera}' sits on it; record "
                "that in /tf_static, or set 'base_frame' of the source where it has another name"
            )
        if why:
            self.missing["odometry"] = why
            if self.source.odometry:
                self.refused["odometry"] = why

    def _check_encodings(self) -> None:
        """A camera whose first image is in an encoding that cannot be read is missing; the others are in it, too."""
        for side in CAMERAS:
            if side in self.topics and side not in self.missing:
                unread = self._first(self.topics[side], unread_encoding)
                if unread and not isinstance(unread, LogError):
                    self.missing[side] = f"{self.topics[side]}: {unread}; record it in one of these"

    def _check_pixels(self) -> None:
        """Cameras whose images cannot be read wherever one looks, or of which the first and the last do not fit their
        calibration or each other, are missing: so hardly any frame could be made."""
        if any(side not in self.infos or side in self.missing for side in CAMERAS):
            return
        first = {side: self._pixels(side) for side in CAMERAS}
        if self._misfits(first):
            last = self._misfits({side: self._pixels(side, last=True) for side in CAMERAS})
            self.missing.update((side, why) for side, why in self._misfits(first).items() if side in last)

    def _misfits(self, images: dict[str, Array | LogError | None]) -> dict[str, str]:
        """Side -> why there is no image, or it does not fit its calibration or that of the other side."""
        said = dict[str, str]()
        for side, pixels in images.items():
            topic, (info, model) = self.topics[side], self.infos[side]
            if isinstance(pixels, LogError):
                said[side] = f"{topic}: {pixels}"
            elif pixels is not None and pixels.shape[:2] != (model.height, model.width):
                size = f"{pixels.shape[1]}x{pixels.shape[0]}"
                said[side] = (
                    f"the images on {topic} are {size}, but {info}, its binning and region of "
                    f"interest counted, is the calibration of images of {model.width}x{model.height}; set "
                    f"'{side}_info' of the source to that of these, or record it"
                )
        left, right = (images[side] for side in CAMERAS)
        if said or not isinstance(left, np.ndarray) or not isinstance(right, np.ndarray):
            return said
        if _kind(left) != _kind(right):
            one, other = self.topics["left"], self.topics["right"]
            why = f"the images on {one} are {_kind(left)}, those on {other} {_kind(right)}; record both alike"
            said.update(left=why, right=why)
        return said

    def _pixels(self, side: str, last: bool = False) -> Array | LogError | None:
        """The first image of a side that can be decoded, or its last; else why not; None where nothing is known."""
        topic, found = self.topics[side], None
        if last:
            made = self._made(topic, pixels_of, max(self.file.times(self.channels_of(topic)).tolist(), default=None))
        else:
            made = self._looked_at(topic, pixels_of)
        for found in made:
            if not isinstance(found, LogError):
                break
        return found

    def _tell_sealed(self) -> None:
        """Messages of a chosen topic that came in another encoding, or by another schema, are lost."""
        streams = {topic: stream for stream, topic in self.topics.items()}
        streams |= {topic: side for side, (topic, _) in self.infos.items() if side in self.topics}
        for number, why in sorted(self._sealed.items()):
            topic, count = self.file.channel(number).topic, self.file.count({number})
            if topic in streams and count:
                lost = f"{topic}: {counted(count, 'message')} of its channel {number} cannot be decoded: {why}"
                self.problems.append((streams[topic], LogError(lost)))

    def _frame_of(self, topic: str) -> str:
        frame = self._first(topic, frame_of)
        return "" if isinstance(frame, LogError) else frame

    def _untilted(self, topic: str) -> str | None:
        """Why the messages of an Imu tell no tilt, as far as some from all over the log show; None where one does."""
        why = LogError("it has no messages")
        for tilt in self._looked_at(topic, lambda message: tilt_of(message, 0)):
            if not isinstance(tilt, LogError):
                return None
            why = tilt
        return str(why)

    def _unplaced(self, topic: str) -> str | None:
        """Why the transforms of a topic tell no pose of the base frame, or more than one; None where they tell one."""
        base, parents, looked_at = self.source.base_frame, dict[str, set[str]](), 0
        for message in self._made(topic, lambda message: message.transforms):
            for item in [] if isinstance(message, LogError) else message:
                parents.setdefault(frame_name(item.child_frame_id), set()).add(frame_of(item))
            looked_at += base in parents
            if looked_at == _TRANSFORMS_LOOKED_AT:
                break
        if base not in parents:
            others = ", ".join(f"'{child}'" for child in sorted(parents)[:_LISTED]) or "nothing"
            return f"no transform places '{base}' (they place {others}); set 'base_frame' of the source to the rover's"
        first, *more = sorted(parents[base])
        if more:
            return f"'{base}' has two parents, '{first}' and '{more[0]}'; record the pose that is meant as Odometry"
        # map <- odom <- base_link is the one chain (REP 105) in which the last link alone is a pose.
        if first in parents and first.rpartition("/")[2] != "odom":
            above = min(parents[first])
            return (
                f"'{base}' is placed in '{first}', and that in '{above}'; set 'base_frame' of the source to '{first}' "
                "if that is the rover's frame, or record the pose that is meant as Odometry"
            )
        return None

    def _looked_at(self, topic: str, make: Callable[[Any], T]) -> Iterator[T | LogError]:
        """What `make` makes of some messages of a topic from all over the log that the file still holds."""
        for place in range(_PLACES):
            start = self.file.start + (self.file.end - self.file.start) * place // _PLACES
            made = self._made(topic, make, start, any_order=True)
            yield from islice((each for each in made if not isinstance(each, _GoneError)), _LOOKED_AT)

    def _made(
        self, topic: str, make: Callable[[Any], T], start: int | None = None, any_order: bool = False
    ) -> Iterator[T | LogError]:
        """What `make` makes of each message of a topic, from a log time on; a LogError for one of which it makes
        nothing."""
        for raw in self.file.messages(self.channels_of(topic), start, any_order=any_order):
            if not isinstance(raw, Lost):
                yield _attempt(lambda data, decoder: make(decoder(data)), raw.data, self.decoders[raw.channel])
            elif raw.channel is not None:
                yield _GoneError(raw.reason)

    def _first(self, topic: str, make: Callable[[Any], T]) -> T | LogError:
        """What `make` makes of the first message of which it makes anything, else the LogError of the last."""
        made: T | LogError = LogError(f"{topic} has no messages")
        for made in self._made(topic, make):
            if not isinstance(made, LogError):
                return made
        return made


def _pose_of(message: Any, base_frame: str) -> Pose:
    pose = pose_of(message, 0, base_frame)
    if pose is None:
        raise LogError(f"it holds no pose of '{base_frame}'")
    return pose


def _kind(pixels: Array) -> str:
    """What the two images of a frame have in common, in words."""
    kind = "gray" if pixels.ndim == 2 else "colour"
    return f"{pixels.shape[1]}x{pixels.shape[0]} {kind} of {8 * pixels.itemsize} bit"


def _attempt(make: Callable[..., T], *arguments: Any) -> T | LogError:
    """What `make` returns, or what it raises: foreign messages may fail a codec or a conversion in any way."""
    try:
        return make(*arguments)
    except LogError as error:
        return error
    except (AttributeError, TypeError) as error:
        return LogError(f"it is not what its type's name says ({said(error)})")
    except Exception as error:
        return LogError(said(error))


def peek_stamp(data: memoryview) -> int:
    """The stamp, ns, of a CDR message that begins with a std_msgs/Header, without decoding it; 0 if it is too short."""
    if len(data) < 12:
        return 0
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
