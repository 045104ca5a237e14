"""Resolves the topics of an MCAP log to streams: what the log provides, and for each missing stream the reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from typing import Any

import numpy as np

from flow.contracts import Finding, counted
from recordings.calibration.log_calibration import INCLINOMETER, calibrations_of_files
from recordings.containers.recording import Recording
from recordings.containers.time_range import MAX_LATENESS_NS
from recordings.discovery.discover import VISUAL, discover
from recordings.discovery.roles import IMU, TRANSFORMS, DiscoveredTopics, Remedy, TiltKind
from recordings.errors import LogError
from recordings.inertial.imu_content import imu_content
from recordings.inertial.up_estimator import UpEstimator
from recordings.ros2.from_msg import frame_name, frame_of, pose_of, transform_of
from recordings.source.calibration import Camera, baseline_fault, baseline_note, calibrated_pair
from recordings.source.cameras import CAMERAS, first_calibrations, in_known_frames, mismatched_images
from recordings.source.joints import read_joints
from recordings.source.mount import ODOMETRY_FRAME, mount_of, pose_of_base
from recordings.source.moving_mount import MovingMount, MovingTransforms, moving_mount
from recordings.source.settings import LogSettings
from recordings.source.tilt_reading import TiltReading, rates_corrected
from recordings.source.topics import MAX_TRIED, DecodedTopics, attempt
from recordings.source.transforms import TransformTree, are_same
from stages.data import LEVEL_FRAME, Mount, Pose, StereoCamera

_STREAMS = (*CAMERAS, "inclinometer", "odometry")
_MAX_LISTED = 5  # topics in a sentence
_FIXED_FRAMES = {"earth", "map", ODOMETRY_FRAME, "world"}  # by REP 105; none of them is a rover's
_MIN_APART = 0.1  # m, between the poses of two publishers, and
_MIN_ALTERNATION = 2.0  # times the way from one pose to the next but one; noise reaches 1
_MIN_POSES = 20


class SourceResolution:
    """What a log provides.

    messages: decoded by topic; topics: stream -> topic; chosen: role -> topic; why: stream -> why its topic;
    unavailable: stream -> reason and remedy; remedies: stream -> settings, any of which would supply it; refused:
    setting of the source that contradicts the log -> reason; undecodable: a sentence; static: the tf tree; infos: side
    -> its first calibration; cameras: the calibrated pair, if complete; findings: (side, finding) pairs about it; tilt:
    how it is read, if there is an inclinometer; tilt_frame: of the first inclinometer message; mount: of the camera on
    the rover, the first one if it moves; moving: its mount at any time, if it moves; problems: (stream, error) pairs
    for the ledger.
    """

    def __init__(self, file: Recording, source: LogSettings) -> None:
        self.file, self.source = file, source
        self.messages = DecodedTopics(file, source.max_pixels, source.max_rate)
        self.undecodable = self._undecodable_topics()
        found = self._discovered()
        self.chosen, self.why, self.remedies = found.chosen, found.why, found.remedies
        self.unavailable, self.refused = dict(found.missing), dict(found.refused)
        self._without_topic = frozenset(found.missing)  # streams without a topic
        self._resolve_cameras()
        self._resolve_tilt(found.tilt)
        self._resolve_mount()
        self._check_base_frame()
        self._check_baseline()
        self._resolve_pose()
        if all(side in self.infos and side not in self.unavailable for side in CAMERAS):
            self.unavailable |= mismatched_images(self.messages, self.chosen, self.infos)
        self.topics = {
            role: topic for role, topic in self.chosen.items() if role in _STREAMS and role not in self.unavailable
        }
        self.problems += self._undecodable_messages()

    @property
    def missing(self) -> dict[str, str]:
        """`unavailable` as complete sentences; they mention lost messages and undecodable topics."""
        lost = f"messages were lost: {self.file.lost[0].reason}" if self.file.lost else ""
        hint = "".join(f" ({what})" for what in (self.undecodable, lost) if what)
        part = f" ({self.file.part})" if self.file.part else ""
        return {
            name: why + (hint if name in self._without_topic else "") + part for name, why in self.unavailable.items()
        }

    def _read_static(self) -> list[tuple[str, LogError]]:
        """Add the log's static transforms to the tree; returns the problems with those left out."""
        problems = list[tuple[str, LogError]]()
        for topic, schema in sorted(self.messages.schemas.items()):
            if schema == TRANSFORMS and (topic.endswith("tf_static") or self._is_foxglove(topic)):
                for transforms in self._static_messages(topic):
                    for item in [transforms] if isinstance(transforms, LogError) else transforms:
                        added = item if isinstance(item, LogError) else attempt(self.static.add, item)
                        if isinstance(added, LogError):
                            problems.append(("log", LogError(f"{topic}: {added}")))
        return problems

    def _is_foxglove(self, topic: str) -> bool:
        """Whether a topic has Foxglove's transforms, which have no topic of their own for static ones."""
        channels = (self.file.channels[number] for number in self.messages.channels_of(topic))
        return any(channel.schema is not None and channel.schema.name.startswith("foxglove") for channel in channels)

    def _static_messages(self, topic: str) -> Iterator[Any]:
        """The lists of static transforms of a topic: of /tf_static all, of others those that never change."""
        if topic.endswith("tf_static"):
            yield from self.messages.each(topic, lambda message: message.transforms, allow_repeats=True)
            return
        found, moving = dict[tuple[str, str], Any](), set[tuple[str, str]]()
        for transforms in self.messages.sample(topic, lambda message: message.transforms):
            for item in [] if isinstance(transforms, LogError) else transforms:
                name = (frame_of(item), frame_name(item.child_frame_id))
                known, place = found.setdefault(name, item), attempt(transform_of, item)
                first = attempt(transform_of, known)
                if isinstance(place, LogError) or isinstance(first, LogError) or not are_same(first, place):
                    moving.add(name)
        yield [item for name, item in found.items() if name not in moving]

    def _undecodable_topics(self) -> str:
        """A sentence that lists the topics that cannot be decoded; empty if there are none."""
        channels = self.messages.undecodable_channels.items()
        reasons = {self.file.channels[n].topic: why for n, why in channels if self.file.count({n})}
        listed = [f"{topic}: {why}" for topic, why in sorted(reasons.items()) if topic not in self.messages.schemas]
        more = f", and {len(listed) - _MAX_LISTED} more" if len(listed) > _MAX_LISTED else ""
        return f"topics that cannot be decoded: {'; '.join(listed[:_MAX_LISTED])}{more}" if listed else ""

    def _discovered(self) -> DiscoveredTopics:
        """The topic of each role, and why other roles have none."""
        angles, found = self.source.angles(), discover(self.messages, self.source)
        if (topic := found.chosen.get("inclinometer")) is None:
            return found
        checks: list[tuple[str, Any]] = [(topic, self.source.accelerations)]
        if angles is not None:
            checks = [(angle.topic or topic, angle.check) for angle in (angles.pitch, angles.roll)]
        for of, check in checks:
            checked = None if check is None else self.messages.first(of, check)
            if isinstance(checked, LogError):
                found.chosen.pop("inclinometer", None)
                names = "accelerations" if angles is None else "pitch and roll"
                kind = names if angles is None else found.tilt
                found.refuse("inclinometer", names, f"the {kind} of {of}: {checked}")
        return found

    def notes(self, estimator: UpEstimator | None) -> list[tuple[str, str]]:
        """(Stream, note, which may be empty) on baseline, tilt and mount; estimator: of the direction of up, if any."""
        notes = []
        notes += [(side, finding.sentence) for side, finding in self.findings if side in self.topics]
        if self.source.odometry == VISUAL:
            notes.append(("odometry", self.unavailable["odometry"]))
        if self._is_pose_unnamed and "odometry" in self.topics:
            unnamed = f"the frame_id of {self.topics['odometry']} is empty; its poses are read as in '{ODOMETRY_FRAME}'"
            notes.append(("odometry", unnamed))
        if self._poses_apart and "odometry" in self.topics:
            apart = f"{self.topics['odometry']} alternate between places {self._poses_apart:.2f} m apart"
            notes.append(("odometry", f"poses on {apart}, as of two publishers, and are mixed; record one of them"))
        if self.tilt is not None:
            notes.append(("inclinometer", self.tilt.note(estimator, self.source)))
        if self.mount is not None and self.mount.base_from_camera is None:
            others = self._rover_frames()
            notes.append(("mount", (
                f"no transform joins '{self.source.base_frame}' and the camera, so the map origin is placed "
                "`points.camera_height` (default 1 m) below the camera and x is its viewing direction"
                + (f"; set 'base_frame' of the source to the rover's frame ({others})" if others else "")
            )))  # fmt: skip
        if self.moving is not None:
            notes.append(("mount", self.moving.note))
        return notes

    def _resolve_cameras(self) -> None:
        """The static transforms, the calibrations and the pair."""
        self.static, files = TransformTree(), self.source.calibration
        of_files = calibrations_of_files(files, self.messages, self.chosen, self.static) if files else {}
        self.problems = self._read_static()
        self.infos, unread = (of_files, {}) if files else first_calibrations(self.messages, self.chosen)
        self.unavailable |= unread
        self.cameras: tuple[Camera, Camera] | None = None
        self.findings = list[tuple[str, Finding]]()
        if not files:
            images = {side: self.messages.frame_of(self.chosen[side]) for side in self.infos}
            self.infos, self.findings = in_known_frames(self.infos, images, self.static)
        if len(self.infos) < len(CAMERAS):
            return
        left, right = (self.infos[side] for side in CAMERAS)
        models, names = (left.model, right.model), (left.frame_id, right.frame_id)
        pair = attempt(calibrated_pair, models, names, (self.chosen["left"], self.chosen["right"]), self.static)
        if isinstance(pair, LogError):
            self.unavailable |= dict.fromkeys(CAMERAS, str(pair))
            return
        of_file = Finding(f"the calibration is that of {left.topic}")
        note = of_file if files else baseline_note(pair, models, names, self.static)
        self.cameras = pair
        self.findings += [("right", note)] if note is not None else []

    def _resolve_tilt(self, kind: TiltKind) -> None:
        """How the tilt is read."""
        self.tilt: TiltReading | None = None
        topic, gyroscope = self.chosen.get("inclinometer"), self.chosen.get("gyroscope", "")
        if topic is None:
            return
        turn, frames = np.eye(3), (self.messages.frame_of(topic), self.messages.frame_of(gyroscope or topic))
        if frames[0] != frames[1]:
            transform = self.static.between(*frames)
            if transform is None:
                self.unavailable["inclinometer"] = (
                    f"no static transform joins the accelerometer ('{frames[0]}', {topic}) and the gyroscope "
                    f"('{frames[1]}', {gyroscope}); record /tf_static"
                )
                return
            turn = transform.rotation
        lag = 0
        if gyroscope not in ("", topic):
            lag = self.messages.delay_of(gyroscope) - self.messages.delay_of(topic) - self.source.offset_of("gyroscope")
        if abs(lag) > MAX_LATENESS_NS:
            self.unavailable["inclinometer"] = (
                f"the stamps of the accelerations ({topic}) and the rates ({gyroscope}) are of clocks that differ by "
                f"{abs(lag) / 1e9:.1f} s; record both with one; {rates_corrected(lag, self.source)}, if both are "
                "logged equally soon"
            )
            return
        why, is_imu = "", self.messages.schemas[topic] == IMU and self.source.accelerations is None
        if is_imu and kind != TiltKind.ORIENTATION:
            why = imu_content(self.messages, topic).no_orientation
        self.tilt = TiltReading(kind, topic, gyroscope, turn, why, lag)

    def _resolve_mount(self) -> None:
        """The inclinometer's frame and the mount."""
        self.tilt_frame = ""
        self.mount: Mount | None = None
        self.moving: MovingMount | None = None
        self.moves = MovingTransforms({}, {}, {})
        if self.cameras is None:
            why = next(self.unavailable[side] for side in CAMERAS if side in self.unavailable)
            self.unavailable["mount"] = f"the mount needs a calibrated pair of cameras: {why}"
            return
        if "inclinometer" in self.unavailable:
            self.unavailable["mount"] = f"the mount needs an inclinometer: {self.unavailable['inclinometer']}"
            return
        self.tilt_frame = frame = self._inclinometer_frame(self.chosen["inclinometer"])
        given, base = self.source.camera_from_inclinometer, self.source.base_frame
        joints = attempt(read_joints, self.source.joints) if self.source.joints is not None else {}
        if isinstance(joints, LogError):
            self.refused["joints"] = str(joints)
            joints = {}
        camera = self.cameras[0]
        is_fixed = all(self.static.between(name, camera.frame_id) is not None for name in (frame, base))
        # Most transforms on /tf may be of other frames, but where static ones suffice a few are enough to contradict.
        self.moves = MovingTransforms.of(self.messages, joints, None if is_fixed and not joints else MAX_TRIED)
        static = self.static.without(self.moves.of_joints)  # a setting wins over the log
        self.problems += [("log", error) for error in self.moves.contradictions(static, (camera.frame_id, frame, base))]
        moving = moving_mount(self.moves, camera, frame, base, static)
        if joints and (moving is None or not {*moving.links} & self.moves.of_joints):
            why = "the log has no angles of joints that join the camera and the rover"
            self.refused["joints"] = f"{why} by {self.source.joints}; correct the names in it, or remove the setting"
        if moving is None:
            mount = attempt(mount_of, camera, frame, base, static, given)
        else:
            mount = attempt(moving.first)
            if given is not None:
                self.refused["camera_from_inclinometer"] = (
                    f"the source's 'camera_from_inclinometer' is a fixed rotation, but {moving.note}; remove the "
                    "setting, and record the transform of the inclinometer"
                )
        if not isinstance(mount, LogError):
            self.mount, self.moving = mount, moving
            return
        ahead = "if x of the inclinometer points where the camera looks, and z up; a run then names a closer rotation"
        self.remedies["mount"] = [Remedy({"camera_from_inclinometer": [0.5, -0.5, 0.5, 0.5]}, ahead)]
        self.unavailable["mount"] = str(mount)

    def _check_base_frame(self) -> None:
        """Refuse the source's 'base_frame' if the camera is joined to other frames but not to it, or if it moves on the
        frame whose poses the log has."""
        base = self.source.base_frame
        if base == type(self.source).base_frame or self.mount is None:
            return
        said = f"the source's 'base_frame' is set to '{base}', but "
        others = self._rover_frames()
        if self.mount.base_from_camera is None and others:
            self.refused["base_frame"] = (
                f"{said}transforms join the camera to {others} only; set it to one of these, or record its transform "
                "to the camera"
            )
        assert self.cameras is not None  # a mount needs them
        fixed, posed = self._posed_frames()
        path = self.moves.tree(self.static).path(posed, self.cameras[0].frame_id)
        if base in path and not any(map(fixed, path)) and self.static.between(posed, base) is None:
            why = f"this frame moves on '{posed}', whose poses {self.chosen['odometry']} contains"
            self.refused["base_frame"] = f"{said}{why}; set it to '{posed}'"

    def _check_baseline(self) -> None:
        """Note a baseline that cannot be right for the camera's height."""
        if self.cameras is None:
            return
        (left, right), base = self.cameras, self.mount.base_from_camera if self.mount is not None else None
        baseline = StereoCamera.from_models(left.model, right.model, left.image_frame, left.rectified).baseline
        fault = baseline_fault(baseline, 0.0 if base is None else float(base.translation[2]))
        self.findings += [("right", fault)] if fault is not None else []

    def _rover_frames(self) -> str:
        """The frames that transforms join to the camera and that may be the rover's; the one whose poses the log has,
        if it is among them."""
        assert self.cameras is not None  # a mount needs them
        own = {self.tilt_frame, *(camera.frame_id for camera in self.cameras)}
        tree, camera = self.moves.tree(self.static), self.cameras[0].frame_id
        fixed, posed = self._posed_frames()
        joined = {name for name in tree.edges if tree.between(name, camera) is not None and not fixed(name)} - own
        return ", ".join(f"'{name}'" for name in ([posed] if posed in joined else sorted(joined)))

    def _posed_frames(self) -> tuple[Callable[[str], bool], str]:
        """Whether a frame does not move, by its name or because the poses are in it; and the frame whose poses the log
        has, empty if there is none."""
        topic, parent, child = self.chosen.get("odometry"), "", ""
        if topic is not None:
            pose = self.messages.first(topic, lambda message: _pose_of(message, self.source.base_frame))
            if not isinstance(pose, LogError):
                parent, child = pose.frame_id, pose.child_frame_id
        return lambda name: name == parent or name.rpartition("/")[2] in _FIXED_FRAMES, child

    def _resolve_pose(self) -> None:
        """Whether the poses can be used: in a fixed frame, of a frame that is joined to the camera."""
        self._is_pose_unnamed, self._poses_apart = False, 0.0
        if self.cameras is None or "odometry" not in self.chosen:
            return
        topic, camera, image = self.chosen["odometry"], self.cameras[0].frame_id, self.cameras[0].image_frame
        pose = self.messages.first(topic, lambda message: _pose_of(message, self.source.base_frame))
        if isinstance(pose, LogError):
            return
        self._is_pose_unnamed, of = not pose.frame_id, pose.child_frame_id
        self._poses_apart = _apart(self.messages.sample(topic, lambda each: _timed_place(each, self.source.base_frame)))
        placed = pose_of_base(pose, self.cameras[0], self.source.base_frame, self.static)
        fixed, moving = placed.frame_id, placed.child_frame_id
        base = self.mount.base_from_camera if self.mount is not None else self.static.between(moving, camera)
        if fixed in (LEVEL_FRAME, image, of, moving) or self.static.between(fixed, camera) is not None:
            why = f"{topic} is a pose in the frame '{fixed}', which moves with the rover; record it in a fixed frame"
        elif moving not in (camera, image) and (base is None or base.parent != moving):
            renamed = ", or set 'base_frame' of the source if the rover's frame has another name"
            why = (
                f"{topic} is the pose of '{of}', but no static transform joins it to the camera '{camera}'; record "
                f"one in /tf_static{'' if of == self.source.base_frame else renamed}"
            )
        else:
            return
        self.unavailable["odometry"] = why
        if self.source.odometry:
            self.refused["odometry"] = why

    def _undecodable_messages(self) -> list[tuple[str, LogError]]:
        """The messages of a used topic in an undecodable channel, as losses of its stream."""
        streams = {topic: stream for stream, topic in self.topics.items()}
        streams |= {info.topic: side for side, info in self.infos.items() if side in self.topics}
        lost = list[tuple[str, LogError]]()
        for number, why in sorted(self.messages.undecodable_channels.items()):
            topic, count = self.file.channels[number].topic, self.file.count({number})
            if topic in streams and count:
                what = f"{topic}: {counted(count, 'message')} of its channel {number} cannot be decoded: {why}"
                lost.append((streams[topic], LogError(what)))
        return lost

    def _inclinometer_frame(self, topic: str) -> str:
        """The frame that the tilt is in: that of its messages, or the one whose poses they are."""
        if self.source.upright_frame is None:
            own = INCLINOMETER if INCLINOMETER in self.static.edges else ""
            return self.messages.frame_of(topic) or own
        pose = self.messages.first(topic, lambda message: _pose_of(message, self.source.base_frame))
        return "" if isinstance(pose, LogError) else pose.child_frame_id


def _pose_of(message: Any, base_frame: str) -> Pose:
    pose = pose_of(message, 0, base_frame)
    if pose is None:
        raise LogError(f"it contains no pose of '{base_frame}'")
    return pose


def _timed_place(message: Any, base_frame: str) -> tuple[float, float, float, float]:
    """Stamp, ns, and position, m, of a pose."""
    pose = _pose_of(message, base_frame)
    x, y, z = pose.position
    return pose.stamp, x, y, z


def _apart(sampled: Iterable[tuple[float, float, float, float] | LogError]) -> float:
    """How far apart, m, the poses of two publishers are that alternate; 0 for those of one."""
    timed = sorted((each for each in sampled if not isinstance(each, LogError)), key=itemgetter(0))
    if len(timed) < _MIN_POSES:
        return 0.0
    at = np.array([place for _, *place in timed])
    apart = float(np.median(np.linalg.norm(at[1:-1] - (at[:-2] + at[2:]) / 2, axis=1)))
    moved = float(np.median(np.linalg.norm(at[2:] - at[:-2], axis=1)))
    return apart if apart > max(_MIN_APART, _MIN_ALTERNATION * moved) else 0.0
