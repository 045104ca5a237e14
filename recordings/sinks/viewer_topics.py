"""The topics of a result log that viewers draw without plugins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from recordings.ros2.viewer_msgs import code_image, depth_messages, left_messages, terrain_points
from recordings.sinks.colormaps import (
    REASON_LEGEND,
    SOURCE_LEGEND,
    birds_eye,
    elevation_colors,
    top_eight_bits,
)  # fmt: skip
from stages.data import Disparity, ElevationMap, NavigationMap, StereoFrame


def viewer_messages(items: Mapping[str, Any], written: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Topic and message of a frame for viewers.

    items: stream -> item of the whole frame; written: the streams that the log contains in this frame.
    """
    for stream, item in written.items():
        topic = f"/nav/{stream}"
        match item:
            case Disparity():
                for below, message in depth_messages(item).items():
                    yield topic + below, message
                colors = {code: rgb for code, (_, rgb) in SOURCE_LEGEND.items()}
                frame_id = item.camera.frame_id if item.camera is not None else "camera"
                yield f"{topic}/source/color/compressed", code_image(item.stamp, frame_id, item.source, colors)
            case ElevationMap():
                yield f"{topic}/points", terrain_points(item, elevation_colors(item))
            case NavigationMap():
                colors = {code: rgb for code, (_, rgb) in REASON_LEGEND.items()}
                picture = code_image(item.stamp, item.frame_id, birds_eye(item.reason), colors)
                yield f"{topic}/reason/color/compressed", picture
    frames = [(stream, item) for stream, item in items.items() if isinstance(item, StereoFrame)]
    if frames:
        width = max(item.camera.width for _, item in frames)
        stream, frame = [known for known in frames if known[1].camera.width == width][-1]
        (left,) = top_eight_bits(frame.left)
        for below, message in left_messages(frame, left).items():
            yield f"/nav/{stream}{below}", message
