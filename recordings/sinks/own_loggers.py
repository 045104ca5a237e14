"""How streams of a user's own types look in a rerun recording: images, points, plots, bar charts, text logs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr

from recordings.ros2.plain import is_image, is_points
from recordings.sinks.blueprint import Panel, ViewSpec
from recordings.sinks.canvas import MAX_POINTS, Canvas
from recordings.sinks.colormaps import stride, value_limits
from recordings.sinks.loggers import LOGGERS
from recordings.sinks.own_types import leaves
from stages.data import LEVEL_FRAME, Array

KNOWN = tuple(kinds[0] for kinds in LOGGERS if len(kinds) == 1)


def log_own(canvas: Canvas, stream: str, item: Any) -> str:
    """Log every part of an item under its own path; returns the value where the item is a single number.

    Parts that have no picture, such as a transform, are left out.
    """
    frame_id = str(getattr(item, "frame_id", LEVEL_FRAME))
    caption = ""
    for path, leaf in leaves(item, type(item), KNOWN):
        part = "/".join(map(rr.escape_entity_path_part, path))
        spec = ViewSpec(Panel.OWN_NUMBER, stream, part, ": ".join([stream, *path]), frame_id)
        if isinstance(leaf, KNOWN):
            draw = next(draw for kinds, draw in LOGGERS.items() if len(kinds) == 1 and isinstance(leaf, kinds))
            draw(canvas, spec.path, leaf)
        elif isinstance(leaf, str):
            canvas.log_text(spec.path, leaf)
            canvas.add_view(replace(spec, panel=Panel.OWN_TEXT))
        elif isinstance(leaf, bool | int | float):
            canvas.plot(spec.path, float(leaf), spec)
            caption = f"{stream} {leaf:g}" if not path else caption
        elif isinstance(leaf, np.ndarray) and leaf.dtype.kind in "biuf" and leaf.size:
            _log_array(canvas, spec, leaf)
    return caption


def _log_array(canvas: Canvas, spec: ViewSpec, array: Array) -> None:
    if array.ndim > 1 and not canvas.pictures:
        return
    if is_points(array):
        some = slice(None, None, stride(len(array), MAX_POINTS))
        points = rr.Points3D(array[some].astype(np.float32), radii=rr.Radius.ui_points(1.5))
        canvas.log(spec.path, points, replace(spec, panel=Panel.CLOUD))
    elif is_image(array):
        _log_image(canvas, replace(spec, panel=Panel.OWN_IMAGE), array)
    elif array.ndim == 1:
        canvas.log(spec.path, rr.BarChart(array.astype(np.float64)), replace(spec, panel=Panel.OWN_BARS))
    else:
        canvas.log(spec.path, rr.Tensor(array), replace(spec, panel=Panel.OWN_TENSOR))


def _log_image(canvas: Canvas, spec: ViewSpec, pixels: Array) -> None:
    """8-bit gray and RGB as they are; other (H, W) values in colours over their range (hover reads the values)."""
    if pixels.dtype == bool:
        pixels = pixels.astype(np.uint8) * 255
    if pixels.ndim == 3 and pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.dtype == np.uint8 and pixels.ndim == 3:
        canvas.log_image(spec.path, pixels, spec)
        return
    if pixels.dtype == np.uint8:  # masks and labels stay exact
        canvas.log_exact(spec.path, pixels, spec)
        return
    values = pixels.astype(np.float32)
    canvas.log_values(values, value_limits(values), spec, "")
