"""Writes a recording of a data set as a log: calibration, mounts, images, sensors and truth.

Images of PNG and JPEG files are logged with their bytes unchanged. Messages keep the stamps of the files, and are in
their order. The log gets its name when it is complete. An import that was interrupted is continued by the next one of
the same images: it does not read those again that the unfinished log contains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from flow.contracts import counted
from recordings.calibration.formats import StereoCalibration
from recordings.errors import LogError
from recordings.importers.files import encoding_of, image_size, read_bytes, read_pixels
from recordings.importers.track import Track, upright
from recordings.mcap.resumable import ResumableWriter
from recordings.ros2 import to_msg as ros2
from recordings.ros2.cdr import make
from recordings.ros2.image_from_msg import is_cut
from recordings.source.calibration import Camera, calibrated_pair, pinhole
from recordings.source.transforms import TransformTree
from stages.data import CameraModel, StereoCamera, Transform

BASE, LEFT, RIGHT, IMU = "base_link", "left_camera_optical", "right_camera_optical", "imu_link"
SIDES = ("left", "right")
ENDINGS = "", "/compressed"  # of the topic of an image
FIRST_STAMP = 1_000_000_000  # ns, where the files have no time; a stamp of zero means "not stamped" in ROS

Logged = tuple[int, str, Any]


@dataclass(frozen=True)
class Deferred:
    """A message that is made only if the unfinished log lacks it."""

    make: Callable[[], Any]


@dataclass(frozen=True)
class ImagePair:
    """The files of a stereo frame."""

    stamp: int
    left: Path
    right: Path


@dataclass(frozen=True, eq=False)
class ImportedRecording:
    """What a data set contains.

    cameras: left and right; rectified: whether the images are; pairs: in the order of stamps; mounts: static
    transforms, None for an unknown one; first_size: whether the size of the cameras is that of the first image;
    sensors: streams of (stamp, topic, message), each in the order of stamps; truth: the exact poses, written at the
    frames; true_tilt: whether they are better than the sensors' tilt; more: further messages of a frame; metadata: name
    and content of a record; notes: what a user should know.
    """

    cameras: tuple[CameraModel, CameraModel]
    rectified: bool
    pairs: Sequence[ImagePair]
    mounts: Sequence[Transform | None]
    first_size: bool = field(default=False, kw_only=True)
    sensors: Sequence[Iterable[Logged]] = ()
    truth: Track | None = None
    true_tilt: bool = False
    more: Callable[[int], Iterable[Logged]] = lambda number: ()
    metadata: tuple[str, Mapping[str, str]] | None = None
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of_rectified(
        cls, camera: StereoCamera, pairs: Sequence[ImagePair], mount: Transform | None, *others: Transform, **rest: Any
    ) -> ImportedRecording:
        """The recording of rectified pairs. mount: base_link <- left camera; others: of sensors; rest: as above."""
        return cls(
            rectified_models(camera), True, pairs, [mount, beside(camera), *others], first_size=True, **rest
        )  # fmt: skip


def write_recording(
    recording: ImportedRecording,
    out: Path,
    progress: Callable[[int], None] = lambda done: None,
    report: Callable[[str], None] = lambda sentence: None,
) -> tuple[int, list[str]]:
    """Write the log, or continue it; returns its number of frames and the notes.

    progress: called with the frames done so far; report: called with a sentence about an interrupted import. A pair
    with a file that is no whole image of the calibration's size, or with the time of the pair before it, is left out
    with a note. Raises LogError if no log can be made.
    """
    tree, mounts = TransformTree(), [mount for mount in recording.mounts if mount is not None]
    for mount in mounts:
        tree.join(mount)
    topics = [f"/stereo/{side}/{'image_rect' if recording.rectified else 'image_raw'}" for side in SIDES]
    cameras = calibrated_pair(recording.cameras, (LEFT, RIGHT), (topics[0], topics[1]), tree)
    if not recording.pairs:
        raise LogError("no pair of images was found; check the folder")
    unreadable: list[LogError] = []

    with ResumableWriter(out, _mark(recording)) as writer:
        if writer.contained:
            done = sum(len(writer.contained.get(topics[1] + ending, ())) for ending in ENDINGS)
            report(f"{out}: continues the interrupted import after {counted(done, 'frame')}")
        elif writer.others:
            report(f"{out}: an interrupted import of other images is not continued")
        frames = _frames(recording, cameras[0], tree, topics, writer, unreadable, progress)
        events = merge(*recording.sensors, frames, key=itemgetter(0))
        for number, (stamp, topic, message) in enumerate(events):
            if number == 0:
                writer.write("/tf_static", ros2.transform_message((mount, stamp) for mount in mounts), stamp)
            if not isinstance(message, Deferred):
                writer.write(topic, message, stamp)
            elif not writer.skip(topic, stamp):
                writer.write(topic, message.make(), stamp)
        if recording.metadata is not None:
            writer.metadata(*recording.metadata)
        if len(unreadable) == len(recording.pairs):
            raise LogError(f"none of {counted(len(unreadable), 'pair')} can be used, first: {unreadable[0]}")
        _check_first_size(recording, unreadable)
    left_out = f"{counted(len(unreadable), 'pair')} left out, first: {unreadable[0]}" if unreadable else ""
    return len(recording.pairs) - len(unreadable), [*recording.notes, *filter(None, [left_out])]


def _frames(
    recording: ImportedRecording,
    camera: Camera,
    tree: TransformTree,
    topics: Sequence[str],
    writer: ResumableWriter,
    unreadable: list[LogError],
    progress: Callable[[int], None],
) -> Iterator[Logged]:
    """The messages of each frame; those of images that the unfinished log contains are `Deferred`.

    The reasons why a pair is left out go into `unreadable`.
    """
    before = -1
    for number, pair in enumerate(recording.pairs):
        stamp = pair.stamp
        try:
            if stamp == before:
                raise LogError(f"{pair.left} has the same time as the image before it, {stamp} ns")
            images = _images(pair, recording, topics, writer.contained)
        except LogError as error:
            unreadable.append(error)
            continue
        before = stamp
        for side, frame, model in zip(SIDES, (LEFT, RIGHT), recording.cameras, strict=True):
            yield stamp, f"/stereo/{side}/camera_info", ros2.camera_info(stamp, frame, model)
        yield from images
        yield from _true_pose(recording, stamp, camera, tree)
        yield from recording.more(number)
        progress(number + 1)


def _images(
    pair: ImagePair, recording: ImportedRecording, topics: Sequence[str], contained: Mapping[str, Collection[int]]
) -> list[Logged]:
    """The messages of a pair, `Deferred` if an unfinished log contains both. Raises LogError."""
    sides = zip((LEFT, RIGHT), (pair.left, pair.right), recording.cameras, strict=True)
    makers = [partial(image_message, pair.stamp, *side, recording.first_size) for side in sides]
    possible = [topic + ending for topic in topics for ending in ENDINGS]
    named = [topic for topic in possible if pair.stamp in contained.get(topic, ())]
    if len(named) == len(makers):
        return [(pair.stamp, topic, Deferred(make)) for topic, make in zip(named, makers, strict=True)]
    messages = [make() for make in makers]
    named = [topic + ENDINGS[hasattr(message, "format")] for topic, message in zip(topics, messages, strict=True)]
    return [(pair.stamp, topic, message) for topic, message in zip(named, messages, strict=True)]


class _OtherSizeError(LogError):
    """An image has another size, px, than the calibration."""

    def __init__(self, sentence: str, size: tuple[int, int]) -> None:
        super().__init__(sentence)
        self.size = size


def _check_first_size(recording: ImportedRecording, unreadable: Sequence[LogError]) -> None:
    """Raise LogError if the size of the cameras is that of the first image, and more pairs have another one."""
    sizes = Counter(error.size for error in unreadable if isinstance(error, _OtherSizeError))
    if not recording.first_size or not sizes:
        return
    (size, count), model = sizes.most_common(1)[0], recording.cameras[0]
    if count > len(recording.pairs) - len(unreadable):
        raise LogError(
            f"the first image is {model.width}x{model.height}, but more pairs are {size[0]}x{size[1]}; give a folder "
            "with images of one size"
        )


def image_message(stamp: int, frame: str, path: Path, model: CameraModel, first_size: bool = False) -> Any:
    """The message of an image file. Raises LogError if it is truncated or does not fit the calibration.

    first_size: whether the size of the calibration is that of the first image.
    """
    if (size := image_size(path)) != (model.width, model.height):
        other = f"the {'first image is' if first_size else 'calibration is for'} {model.width}x{model.height}"
        raise _OtherSizeError(f"{path} is {size[0]}x{size[1]}, but {other}", size)
    content = read_bytes(path)
    if encoding := encoding_of(content):
        if is_cut(content):
            raise LogError(f"{path} is truncated after {len(content)} bytes")
        return ros2.compressed_image(stamp, frame, np.frombuffer(content, np.uint8), encoding)
    return ros2.image(stamp, frame, read_pixels(path))


def _mark(recording: ImportedRecording) -> str:
    """What stands for the images of the log: stamps, names, sizes and times of change, and the calibration's size."""
    digest = sha256(repr([(model.width, model.height) for model in recording.cameras]).encode())
    for pair in recording.pairs:
        for path in (pair.left, pair.right):
            with suppress(OSError):  # it is left out later
                state = path.stat()
                line = f"{pair.stamp} {path.name} {state.st_size} {state.st_mtime_ns}\n"
                digest.update(line.encode(errors="surrogateescape"))
    return digest.hexdigest()[:12]


def _true_pose(recording: ImportedRecording, stamp: int, camera: Camera, tree: TransformTree) -> Iterator[Logged]:
    """The true pose of base_link, or of the left camera's rectified image without it, and the true tilt."""
    placed = None if recording.truth is None else recording.truth.at(stamp)
    to_camera = None if placed is None else tree.between(placed.child, LEFT)
    if placed is None or to_camera is None:
        return
    base = tree.between(placed.child, BASE)
    body = placed.after(to_camera.after(camera.image) if base is None else base)
    yield stamp, "/truth/pose", ros2.exact_odometry(body, stamp)
    if recording.true_tilt:
        yield stamp, "/truth/tilt", ros2.quaternion_stamped(placed.after(to_camera).rotation, stamp, LEFT)


def paired(
    sides: Sequence[Mapping[Any, Path]], what: str, folder: Path, notes: list[str]
) -> Iterator[tuple[Any, Path, Path]]:
    """Key, left and right image of the keys that both sides have, in order. A note counts the images of the others.

    what: the keys in words; folder: of the images. Raises LogError if there is no pair.
    """
    left, right = sides
    if alone := len(left.keys() ^ right.keys()):
        notes.append(f"{counted(alone, 'image')} without a partner of the same {what}")
    if left.keys().isdisjoint(right):
        raise LogError(
            f"{folder} contains no left and right image of the same {what}; give the folder of one recording"
        )
    return ((key, left[key], right[key]) for key in sorted(left.keys() & right.keys()))


def common_size(pairs: Sequence[ImagePair]) -> tuple[int, int]:
    """Width and height of the first left image that can be read, px. Raises LogError if none can."""
    why = "there is none"
    for pair in pairs:
        try:
            return image_size(pair.left)
        except LogError as error:
            why = str(error)
    raise LogError(f"no left image can be read: {why}")


def tilts_of(track: Track, stamps: Iterable[int]) -> Iterator[Logged]:
    """The tilt of the track's body, without its heading, at each of the stamps that the track contains."""
    for stamp in stamps:
        if (placed := track.at(stamp)) is not None:
            yield stamp, "/inclinometer", ros2.imu(stamp, track.body, upright(placed.rotation[2]))


def note_frames_without_pose(track: Track, pairs: Sequence[ImagePair], file: str, notes: list[str]) -> None:
    """Add a note about the pairs that have no pose, and so no tilt. file: of the poses."""
    if without := sum(track.at(pair.stamp) is None for pair in pairs):
        notes.append(f"{file} has no pose for {counted(without, 'pair')}, without tilt in the log")


def fix(stamp: int, frame: str, latitude: float, longitude: float, altitude: float) -> Logged:
    """The place of a frame by GPS, deg and m, of unknown accuracy."""
    status = make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
    message = make(
        "sensor_msgs/msg/NavSatFix", header=ros2.header(stamp, frame), status=status, latitude=latitude,
        longitude=longitude, altitude=altitude, position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip
    return stamp, "/gps/fix", message


def rectified_models(camera: StereoCamera) -> tuple[CameraModel, CameraModel]:
    """The calibration of a rectified pair."""
    return pinhole(camera, "left"), pinhole(camera, "right")


def raw_models(
    calibration: StereoCalibration, size: tuple[int, int], files: Sequence[Path]
) -> tuple[CameraModel, CameraModel]:
    """The calibration of a pair before rectification, with K as the projection and `size`, px, where it has none.

    files: of the calibration. Raises LogError if the left camera is not the first one, or the baseline is unknown.
    """
    shown, baseline = " and ".join(map(str, files)), calibration.baseline
    if not baseline and calibration.right_in_left is None:
        raise LogError(f"{shown} lacks the baseline of the cameras; give the files of the stereo calibration")
    if baseline < 0:
        raise LogError(
            f"the first camera of {shown} is the right one (baseline {baseline:.4g} m); give the left one first"
        )
    models = []
    for model in calibration.models:
        p = model.p if np.any(model.p) else np.column_stack([model.k, np.zeros(3)])
        width, height = (model.width, model.height) if model.width and model.height else size
        models.append(replace(model, p=p, width=width, height=height))
    return models[0], models[1]


def beside(camera: StereoCamera) -> Transform:
    """left camera <- right camera of a rectified pair."""
    return Transform(LEFT, RIGHT, np.eye(3), np.array([camera.baseline, 0.0, 0.0]))
