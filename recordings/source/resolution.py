"""Opens an MCAP log: looks at its topics, its calibration and its static transforms, and says for each stream that the
log cannot give why not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flow.contracts import counted
from recordings.errors import LogError
from recordings.mcap.file import McapFile
from recordings.ros2.from_msg import frame_name, frame_of, pose_of
from recordings.ros2.tilt_from_msg import tilt_of
from recordings.source.calibration import Camera, baseline_note, calibrated_pair
from recordings.source.cameras import CAMERAS, first_infos, unfit_images, unread_images
from recordings.source.discovery import TRANSFORMS, Topic, Topics, discover
from recordings.source.mount import mounted, rovers
from recordings.source.settings import LogSettings
from recordings.source.topics import DecodedTopics, attempt
from recordings.source.transforms import TransformTree
from stages.data import LEVEL_FRAME, Mount, Pose

_STREAMS = (*CAMERAS, "inclinometer", "odometry")
_TRANSFORMS_LOOKED_AT = 100  # messages from the first one of the rover on; others may come more rarely
_LISTED = 5  # topics in a sentence


class SourceResolution:
    """What a log offers.

    messages: of its topics; topics: stream -> topic; lacking: stream -> why the log does not provide it, and what to
    do; refused: setting of the source that the log does not bear out -> why; undecodable: the topics that are, in
    words; static: the log's static transforms; infos: side -> its first calibration; cameras: the calibrated pair,
    where both are there; baseline_note: what there is to say of that; tilt_frame: of the inclinometer's first message;
    mount: how the camera sits on the rover; problems: (stream, loss) that came up.
    """

    def __init__(self, file: McapFile, source: LogSettings) -> None:
        self.file, self.source, self.messages = file, source, DecodedTopics(file)
        self.static, self.problems = self._read_static()
        self.undecodable = self._sealed_topics()
        found = self._discovered()
        self._sought = frozenset(found.missing)  # streams of which no topic was found
        self.infos, unread = first_infos(self.messages, found.chosen)
        self.cameras, self.baseline_note, unpaired = self._paired(found.chosen)
        lacking = found.missing | unread | unpaired
        self.tilt_frame, self.mount, unmounted = self._mounted(found.chosen, lacking)
        moving = self._moving_pose(found.chosen)
        self.refused = found.refused | (moving if self.source.odometry else {}) | self._unjoined_base()
        lacking |= unmounted | moving
        there = [side for side in CAMERAS if side in found.chosen and side not in lacking]
        lacking |= unread_images(self.messages, found.chosen, there)
        if all(side in self.infos and side not in lacking for side in CAMERAS):
            lacking |= unfit_images(self.messages, found.chosen, self.infos)
        self.lacking = lacking
        self.topics = {role: topic for role, topic in found.chosen.items() if role in _STREAMS and role not in lacking}
        self.problems += self._sealed_messages()

    @property
    def missing(self) -> dict[str, str]:
        """`lacking`, each as a sentence that stands alone: what was sought may be among what cannot be decoded or is
        lost."""
        lost = f"messages were lost: {self.file.index.lost[0].reason}" if self.file.index.lost else ""
        aside = "".join(f" ({what})" for what in (self.undecodable, lost) if what)
        return {name: why + aside if name in self._sought else why for name, why in self.lacking.items()}

    def _read_static(self) -> tuple[TransformTree, list[tuple[str, LogError]]]:
        """The static transforms, and what is wrong with those that are not among them."""
        frames, problems = TransformTree(), list[tuple[str, LogError]]()
        for topic, schema in sorted(self.messages.schemas.items()):
            if schema == TRANSFORMS and topic.endswith("tf_static"):
                for transforms in self.messages.each(topic, lambda message: message.transforms, any_order=True):
                    for item in [transforms] if isinstance(transforms, LogError) else transforms:
                        added = item if isinstance(item, LogError) else attempt(frames.add, item)
                        if isinstance(added, LogError):
                            problems.append(("log", LogError(f"{topic}: {added}")))
        return frames, problems

    def _sealed_topics(self) -> str:
        """The topics of which nothing can be decoded, in words; empty where there are none."""
        reasons = self.messages.sealed.items()
        sealed = {self.file.channel(n).topic: why for n, why in reasons if self.file.count({n})}
        listed = [f"{topic}: {why}" for topic, why in sorted(sealed.items()) if topic not in self.messages.schemas]
        more = f", and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
        return f"topics that cannot be decoded: {'; '.join(listed[:_LISTED])}{more}" if listed else ""

    def _discovered(self) -> Topics:
        """The topic of each role, and why others have none."""
        schemas, angles = self.messages.schemas, self.source.angles()
        topics = [Topic(name, schemas[name], self.messages.count(name)) for name in sorted(schemas)]
        found = discover(topics, self.source, self.messages.frame_of, self._untilted, self._unplaced)
        if angles is not None and (topic := found.chosen.get("inclinometer")):
            checked = self.messages.first(topic, angles.check)
            if isinstance(checked, LogError):
                del found.chosen["inclinometer"]
                found.refuse("inclinometer", "pitch and roll", f"bare angles of {topic}: {checked}")
        return found

    def _paired(self, chosen: Mapping[str, str]) -> tuple[tuple[Camera, Camera] | None, str, dict[str, str]]:
        """The calibrated pair, what there is to say of its baseline, and side -> why it is none."""
        if len(self.infos) < len(CAMERAS):
            return None, "", {}
        left, right = (self.infos[side] for side in CAMERAS)
        models, names = (left.model, right.model), (left.frame_id, right.frame_id)
        cameras = attempt(calibrated_pair, models, names, (chosen["left"], chosen["right"]), self.static)
        if isinstance(cameras, LogError):
            return None, "", dict.fromkeys(CAMERAS, str(cameras))
        return cameras, baseline_note(cameras, models, names, self.static), {}

    def _mounted(
        self, chosen: Mapping[str, str], lacking: Mapping[str, str]
    ) -> tuple[str, Mount | None, dict[str, str]]:
        """The inclinometer's frame, how the camera sits to it and on the rover, and why that is not known."""
        if self.cameras is None:
            why = next(lacking[side] for side in CAMERAS if side in lacking)
            return "", None, {"mount": f"without a calibrated pair of cameras there is no mount: {why}"}
        if "inclinometer" in lacking:
            return "", None, {"mount": f"without an inclinometer there is no mount: {lacking['inclinometer']}"}
        frame = self.messages.frame_of(chosen["inclinometer"])
        given, base = self.source.camera_from_inclinometer, self.source.base_frame
        mount = attempt(mounted, self.cameras[0], frame, base, self.static, given)
        if isinstance(mount, LogError):
            return frame, None, {"mount": str(mount)}
        return frame, mount, {}

    def _unjoined_base(self) -> dict[str, str]:
        """Why the source's 'base_frame' cannot be as it is set, where the camera sits on others but not on that."""
        base = self.source.base_frame
        if base == type(self.source).base_frame or self.mount is None or self.mount.base_from_camera is not None:
            return {}
        assert self.cameras is not None  # or there were no mount
        own = {self.tilt_frame, *(camera.frame_id for camera in self.cameras)}
        joined = (name for name in self.static.edges if self.static.between(name, self.cameras[0].frame_id) is not None)
        others = ", ".join(f"'{name}'" for name in sorted(set(joined) - own))
        if not others:
            return {}
        return {
            "base_frame": f"the source's 'base_frame' is set to '{base}', which /tf_static does not join to the camera "
            f"as it does {others}; set it to one of these, or record where the camera sits on it"
        }

    def _moving_pose(self, chosen: Mapping[str, str]) -> dict[str, str]:
        """Why the poses are of no use, where they are told in a frame that moves along, or are those of something of
        which nothing tells how the camera sits on it."""
        if self.cameras is None or "odometry" not in chosen:
            return {}
        topic, camera, image = chosen["odometry"], self.cameras[0].frame_id, self.cameras[0].image_frame
        pose = self.messages.first(topic, lambda message: _pose_of(message, self.source.base_frame))
        if isinstance(pose, LogError):
            return {}
        told, resting = pose.child_frame_id, pose.frame_id
        moving = rovers(pose, self.cameras[0], self.source.base_frame, self.static).child_frame_id
        base = self.mount.base_from_camera if self.mount is not None else self.static.between(moving, camera)
        why = ""
        if resting in (LEVEL_FRAME, image, told, moving) or self.static.between(resting, camera) is not None:
            why = f"{topic} is a pose in the frame '{resting}', which moves with the rover; record it in one that rests"
        elif moving not in (camera, image) and (base is None or base.parent != moving):
            renamed = ", or set 'base_frame' of the source where it has another name"
            why = (
                f"{topic} is the pose of '{told}', and nothing tells how the camera '{camera}' sits on it; record "
                f"that in /tf_static{'' if told == self.source.base_frame else renamed}"
            )
        return {"odometry": why} if why else {}

    def _sealed_messages(self) -> list[tuple[str, LogError]]:
        """Messages of a chosen topic that came in another encoding, or by another schema, as losses of its stream."""
        streams = {topic: stream for stream, topic in self.topics.items()}
        streams |= {info.topic: side for side, info in self.infos.items() if side in self.topics}
        lost = list[tuple[str, LogError]]()
        for number, why in sorted(self.messages.sealed.items()):
            topic, count = self.file.channel(number).topic, self.file.count({number})
            if topic in streams and count:
                what = f"{topic}: {counted(count, 'message')} of its channel {number} cannot be decoded: {why}"
                lost.append((streams[topic], LogError(what)))
        return lost

    def _untilted(self, topic: str) -> str | None:
        """Why the messages of an Imu tell no tilt, as far as some from all over the log show; None where one does."""
        why = LogError("it has no messages")
        for tilt in self.messages.some(topic, lambda message: tilt_of(message, 0)):
            if not isinstance(tilt, LogError):
                return None
            why = tilt
        return str(why)

    def _unplaced(self, topic: str) -> str | None:
        """Why the transforms of a topic tell no pose of the base frame, or more than one; None where they tell one."""
        base, parents, looked_at = self.source.base_frame, dict[str, set[str]](), 0
        for message in self.messages.each(topic, lambda message: message.transforms):
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


def _pose_of(message: Any, base_frame: str) -> Pose:
    pose = pose_of(message, 0, base_frame)
    if pose is None:
        raise LogError(f"it holds no pose of '{base_frame}'")
    return pose
