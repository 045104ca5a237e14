"""The topics of a result log that viewers draw without plugins."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from recordings.mcap.input_copy import OWN_FRAME
from recordings.ros2.viewer_msgs import camera_above, code_image, depth_messages, left_messages, terrain_points
from recordings.sinks.colormaps import (
    REASON_LEGEND,
    SOURCE_LEGEND,
    birds_eye,
    elevation_colors,
    top_eight_bits,
)  # fmt: skip
from recordings.source.transforms import TransformTree
from stages.data import LEVEL_FRAME, Disparity, ElevationMap, NavigationMap, StereoFrame, Transform

_Seen = TypeVar("_Seen", Disparity, StereoFrame)
_RERUN_ROOT = "tf#/"  # the frame in which rerun draws a log that it opens by itself


def viewer_messages(
    items: Mapping[str, Any], written: Mapping[str, Any], taken: Collection[str]
) -> Iterator[tuple[str, Any]]:
    """Topic and message of a frame for viewers.

    items: stream -> item of the whole frame; written: the streams that the log contains in this frame; taken: cameras
    that the input has too. rerun refuses two calibrations of one camera.
    """
    for stream, item in written.items():
        topic = f"/nav/{stream}"
        match item:
            case Disparity():
                for below, message in depth_messages(_seen(item, taken)).items():
                    yield topic + below, message
                frame_id = item.camera.frame_id if item.camera is not None else "camera"
                yield f"{topic}/source/color/compressed", code_image(item.stamp, frame_id, item.source, SOURCE_LEGEND)
            case ElevationMap():
                yield f"{topic}/points", terrain_points(item, elevation_colors(item))
            case NavigationMap():
                above = f"{stream}/above"  # rerun draws a picture in 3D only in the frame of a camera
                seen_from_above = birds_eye(item.reason)
                yield f"{topic}/reason/color/compressed", code_image(item.stamp, above, seen_from_above, REASON_LEGEND)
                info, placed = camera_above(item, above)
                yield f"{topic}/reason/camera_info", info
                yield "/tf", placed
    frames = [(stream, item) for stream, item in items.items() if isinstance(item, StereoFrame)]
    if frames:
        width = max(item.camera.width for _, item in frames)
        stream, frame = [known for known in frames if known[1].camera.width == width][-1]
        (left,) = top_eight_bits(frame.left)
        # Two calibrations of one camera would be two parents of its image plane, which rerun refuses.
        has_depth = any(isinstance(item, Disparity) and item.camera is not None for item in written.values())
        for below, message in left_messages(_seen(frame, taken), left, with_calibration=not has_depth).items():
            yield f"/nav/{stream}{below}", message


def _seen(item: _Seen, taken: Collection[str]) -> _Seen:
    """A disparity or a frame with its camera in the tree of the results."""
    camera = item.camera
    if camera is None or camera.frame_id not in taken:
        return item
    return replace(item, camera=replace(camera, frame_id=OWN_FRAME + camera.frame_id))


def rerun_root(transforms: Sequence[Transform], theirs: Mapping[str, str]) -> Transform:
    """The transform that joins the root of a tree to rerun's own root frame. theirs: frame -> parent in the input."""
    parents = {**theirs, **{known.child: known.parent for known in transforms}}
    return Transform(_RERUN_ROOT, _root(transforms[0].child, parents), np.eye(3), np.zeros(3))


def beside_inputs(transforms: Sequence[Transform], theirs: Mapping[str, str], regional: bool) -> list[Transform]:
    """The transforms of a frame such that no frame has two parents. theirs: frame -> parent in the input.

    A camera that has a parent in the input keeps it, and is `nav/<camera>` in the tree of the results. Where nothing in
    the input places the root of that tree, the input's camera does. regional: whether other frames of the run place
    `level`, as this one may lack a pose.
    """
    taken = [known.child for known in transforms if known.child in theirs]
    placed = [replace(known, child=OWN_FRAME + known.child) if known.child in taken else known for known in transforms]
    for camera in taken[:1]:
        root = _root(camera, {known.child: known.parent for known in transforms})
        unplaced = regional and root == LEVEL_FRAME
        if root not in theirs and root != _root(camera, theirs) and not unplaced:
            placed += filter(None, [TransformTree().joined(transforms).between(camera, root)])
    return placed


def _root(frame: str, parents: Mapping[str, str]) -> str:
    """The frame above all others of its tree; of a circle any."""
    for _ in parents:
        frame = parents.get(frame, frame)
    return frame
