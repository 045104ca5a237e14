"""The inventory of a log for `roverflow info`: topics, calibration, pairs, tilts, missing streams and damage."""

from __future__ import annotations

import re
from array import array
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recordings.containers.container import LostMessage, RawMessage
from recordings.discovery.discover import VISUAL
from recordings.inertial.blocks import InertialSample
from recordings.inventory.poses import MaxGapOf, describe_poses, gap_sentence, sampled
from recordings.inventory.search_range import UPSIDE_DOWN, search_range
from recordings.scoring.result_log import about_run, pipeline_of
from recordings.source.cameras import CAMERAS, CalibrationHistory
from recordings.source.log import McapLog
from recordings.source.topics import attempt
from stages.data import StereoCamera, Tilt

MAX_VERIFIED_BYTES = 300_000_000  # of a log whose messages are all read; it takes a second
LAST_CALIBRATIONS = 20  # of a large log, that are read
MIN_STEP = 0.45  # s, between the delays of two readings, for the second to begin a stretch
Stamps = NDArray[np.int64]


class Damage(dict[str, tuple[int, str]]):
    """Sentences about damage: without the numbers of single messages -> how many are alike, and the first of them."""

    def add(self, sentence: str) -> None:
        """Add a sentence."""
        if not re.search(r" at \d+ ns\b", sentence):  # of the log
            self[sentence] = 1, sentence
            return
        alike = re.sub(r"(?<=[\s\[(])-?\d[\d.e+-]*", "", sentence)
        count, first = self.get(alike, (0, sentence))
        self[alike] = count + 1, first

    def listed(self) -> list[str]:
        """A sentence for each kind of damage."""
        return [f"{count} similar, first: {first}" if count > 1 else first for count, first in self.values()]


def describe(
    log: McapLog,
    slop: int = 5_000_000,
    max_gap_of: MaxGapOf | None = None,
    max_pose_gap_of: MaxGapOf | None = None,
) -> dict[str, Any]:
    """The inventory of an opened log as plain JSON values.

    Pairs and tilts are counted by their stamps alone; a run may also lose messages that were logged too late. slop:
    largest difference between the stamps of the two images of a frame, ns; max_gap_of: from the intervals of the tilts,
    ns, to the largest one around a frame; None: do not count frames with a tilt; max_pose_gap_of: the same of poses.
    """
    resolution, lost = log.resolution, log.file.lost
    damage = Damage()
    for sentence in sorted({item.reason for item in lost} | {str(problem) for _, problem in resolution.problems}):
        damage.add(sentence)
    delays, of_tilts = array("q"), array("q")
    stamps = {stream: _stamps(log, stream, damage, delays if stream == "left" else None) for stream in CAMERAS}
    stamps["inclinometer"] = _tilts(log, damage, of_tilts)
    distinct = {stream: _distinct(log, stream, damage, stamps[stream]) for stream in stamps}
    left, right = (_calibrated(log, side, damage, distinct[side]) for side in CAMERAS)
    tilts = distinct["inclinometer"]
    pairs = _pairs(left, right, slop)
    max_gap = None if max_gap_of is None else max_gap_of(np.diff(tilts).tolist())
    (with_tilt, _), (tilted_pairs, in_gap) = (
        (None, 0) if max_gap is None else sampled(of, tilts, max_gap) for of in (left, pairs)
    )
    if in_gap and tilted_pairs:
        damage.add(gap_sentence(in_gap, pairs, "tilts", max_gap))
    poses = describe_poses(log, left, pairs, _is_verified(log), max_pose_gap_of, damage.add)
    return {
        "path": str(log.path),
        "result": _run(log),
        "size_bytes": log.file.size,
        "profile": log.file.profile,
        "indexed": log.file.indexed,
        "start": log.file.start,
        "end": log.file.end,
        "duration_s": (log.file.end - log.file.start) / 1e9,
        "topics": _topics(log),
        "notes": log.notes(),
        "streams": dict(log.topics),
        "why": {stream: why for stream, why in resolution.why.items() if stream in log.topics},
        "calibration": _calibration(log),
        "frames": {
            "left": len(stamps["left"]),
            "right": len(stamps["right"]),
            "pairs": pairs.size,
            "slop_s": slop / 1e9,
            "pair_offset_s": _offset(*sorted((left, right), key=len)),
            "with_tilt": with_tilt,
            "pairs_with_tilt": tilted_pairs,
            "tilt_gap_s": None if max_gap is None else max_gap / 1e9,
            "delay_s": [float(np.quantile(delays, part)) / 1e9 for part in (0, 0.5, 1)] if delays else None,
            "tilt_delay_s": float(np.median(of_tilts)) / 1e9 if of_tilts else None,
            "tilt_delay_step_s": _step(np.asarray(of_tilts) / 1e9),
            "tilt_offset_s": log.time_offset("inclinometer") / 1e9,
        },
        "poses": poses,
        "transforms": resolution.static.listed(),
        "mount": _mount(log),
        "search_range": _search_range(log),
        "missing": {
            stream: why
            for stream, why in resolution.unavailable.items()
            if stream != "odometry" or log.source.odometry != VISUAL
        },
        "remedies": {
            stream: [asdict(remedy) for remedy in remedies]
            for stream, remedies in resolution.remedies.items()
            if stream in resolution.unavailable
        },
        "undecodable": resolution.undecodable,
        "damage": damage.listed(),
    }


def _run(log: McapLog) -> str:
    """The run that wrote a result log, in words; empty for another log."""
    about = about_run(log.path)
    pipeline = pipeline_of(log.path) if log.file.indexed else "unknown"
    version, named = about.get("roverflow", "of unknown version"), about.get("log") or "a log that it does not name"
    return f"roverflow {version}: pipeline {pipeline}, run on {named}" if about else ""


def _topics(log: McapLog) -> list[dict[str, Any]]:
    found = []
    for channel in sorted(log.file.channels.values(), key=lambda channel: (channel.topic, channel.number)):
        times = log.file.times({channel.number})
        spaced = times[:0] if channel.topic.endswith("tf_static") else times  # each of its publishers logs once
        gaps = np.diff(spaced)
        span = float(times[-1] - times[0]) / 1e9 if gaps.size else 0.0
        found.append(
            {
                "topic": channel.topic,
                "schema": channel.schema.name if channel.schema else "",
                "encoding": channel.message_encoding,
                "messages": int(times.size),
                "hz": (times.size - 1) / span if span > 0 else None,
                "largest_gap_s": float(gaps.max()) / 1e9 if gaps.size else None,
            }
        )
    return found


def _stamps(log: McapLog, stream: str, damage: Damage, delays: array[int] | None = None) -> Stamps:
    """The stamps of a camera's images, ns, without decoding them; losses are added to `damage`.

    delays: receives the log times less the stamps, ns.
    """
    if stream not in log.topics:
        return np.zeros(0, np.int64)
    topic, stamps = log.topics[stream], array("q")
    for raw in (log.file.messages if _is_verified(log) else log.file.heads)(log.channels(stream)):
        if not isinstance(raw, LostMessage):
            stamps.append(log.stamp_of(raw, stream))
            if delays is not None:
                delays.append(raw.log_time - stamps[-1])
        elif raw.channel is not None:
            damage.add(f"{topic} at {raw.log_time} ns: {raw.reason}")
    return np.asarray(stamps, np.int64)


def _tilts(log: McapLog, damage: Damage, delays: array[int]) -> Stamps:
    """The stamps of the tilts, ns; errors are added to `damage`. Nothing is estimated for them.

    Those of a large log are not decoded. delays: as of `_stamps`.
    """
    if not _is_verified(log):
        return _stamps(log, "inclinometer", damage, delays)
    stamps = array("q")
    for log_time, stream, item in log.events(("inclinometer",), estimate=False):
        if isinstance(item, Tilt | InertialSample):
            stamps.append(item.stamp)
            delays.append(log_time - item.stamp)
        elif stream == "inclinometer":
            damage.add(str(item))
    return np.asarray(stamps, np.int64)


def _step(delays: NDArray[np.float64]) -> float:
    """The largest change, s, from one stretch of delays to the next where a clock was set; 0 if there is none.

    Single delays do not count, nor do changes between stretches whose ranges meet: readings that are logged in batches.
    """
    if not delays.size:
        return 0.0
    starts = np.append(0, np.flatnonzero(np.abs(np.diff(delays)) > MIN_STEP) + 1)
    lengths = np.diff(starts, append=delays.size)
    last = lengths > 1
    low, high, total = (of.reduceat(delays, starts)[last] for of in (np.minimum, np.maximum, np.add))
    apart = np.maximum(low[1:] - high[:-1], low[:-1] - high[1:]) > MIN_STEP
    return float(np.abs(np.diff(total / lengths[last]))[apart].max(initial=0.0))


def _is_verified(log: McapLog) -> bool:
    """Whether all messages of the streams are read and checked; of a large log only their stamps are read."""
    return log.file.size <= MAX_VERIFIED_BYTES


def _distinct(log: McapLog, stream: str, damage: Damage, stamps: Stamps) -> Stamps:
    """The sorted unique stamps; repeated ones are noted in `damage`."""
    distinct = np.unique(stamps)
    if repeated := len(stamps) - distinct.size:
        what = f"{repeated} of {len(stamps)} messages repeat a stamp; a run drops them"
        damage.add(f"{log.topics[stream]}: {what}")
    return distinct


def _calibrated(log: McapLog, side: str, damage: Damage, stamps: Stamps) -> Stamps:
    """The stamps of images that the log's first calibration is for; the others are noted in `damage`.

    Of a large log only the last calibrations are read.
    """
    if side not in log.resolution.infos:
        return stamps
    info, messages = log.resolution.infos[side], log.resolution.messages
    history, channels = CalibrationHistory(info.model), messages.channels_of(info.topic)
    first = None if _is_verified(log) else min(log.file.times(channels)[-LAST_CALIBRATIONS:], default=None)
    for raw in log.file.messages(channels, first):
        if isinstance(raw, RawMessage):
            attempt(lambda raw: history.note(messages.decoders[raw.channel](raw.data), raw.log_time), raw)
    errors = {stamp: attempt(history.check, stamp) for stamp in stamps.tolist()}
    for stamp, error in errors.items():
        if error is not None:
            damage.add(f"{log.topics[side]} at {stamp} ns: {error}")
    return np.array([stamp for stamp, error in errors.items() if error is None], np.int64)


def _pairs(left: Stamps, right: Stamps, slop: int) -> Stamps:
    """The stamps of the left images with a right one within the slop; each right image is used once."""
    pairs, place = array("q"), 0
    for stamp in left.tolist():
        while place < right.size and right[place] < stamp - slop:
            place += 1
        if place < right.size and right[place] <= stamp + slop:
            pairs.append(stamp)
            place += 1
    return np.asarray(pairs, np.int64)


def _offset(fewer: Stamps, more: Stamps) -> float | None:
    """The difference of stamps, s, that nine of ten images have at most from the nearest one of the other camera.

    None where the images of one camera follow each other as closely, so that stamps alone do not pair them.
    """
    if fewer.size < 2:
        return None
    after = np.searchsorted(more, fewer)
    nearest = [np.abs(more[np.clip(place, 0, more.size - 1)] - fewer) for place in (after - 1, after)]
    offset = float(np.quantile(np.minimum(*nearest), 0.9))
    return offset / 1e9 if offset < np.median(np.diff(fewer)) / 4 else None


def _calibration(log: McapLog) -> dict[str, Any] | None:
    if log.resolution.cameras is None:
        return None
    left, right = log.resolution.cameras
    camera = StereoCamera.from_models(left.model, right.model, left.image_frame, left.rectified)
    names = ("width", "height", "fx", "fy", "cx", "cy", "cx_right", "baseline", "frame_id")
    values = {name: getattr(camera, name) for name in names}
    return values | {"rectified": left.rectified, "doubts": list(camera.doubts)}


def _search_range(log: McapLog) -> dict[str, Any] | None:
    """The disparities that the camera's mount and the first tilt suggest; None if its height is unknown."""
    cameras, mount = log.resolution.cameras, log.resolution.mount
    if cameras is None or mount is None or mount.base_from_camera is None:
        return None
    tilt = next((item for _, _, item in log.events(("inclinometer",)) if isinstance(item, Tilt)), None)
    if tilt is None:
        return None
    left, right = cameras
    camera = StereoCamera.from_models(left.model, right.model, left.image_frame, left.rectified)
    up, base = mount.camera_from_inclinometer @ tilt.up, mount.base_from_camera
    found = search_range(camera, up, float(base.translation[2]))
    if found is not None and (base.rotation @ up)[2] < 0:
        found["doubt"] = UPSIDE_DOWN
    return found


def _mount(log: McapLog) -> dict[str, Any] | None:
    mount = log.resolution.mount
    if mount is None:
        return None
    base = mount.base_from_camera
    return {
        "camera_from_inclinometer": mount.camera_from_inclinometer.tolist(),
        "base": None if base is None else base.parent,
        "position": None if base is None else base.translation.tolist(),
    }
