"""Rectification: both images resampled so that corresponding points lie on the same row.

One table of source positions combines undistortion and rectifying rotation (Bouguet's method, as in image_pipeline).
It is computed once per camera. The row offset that the calibration leaves is measured (stages.rectification.row_offset)
and added to the right camera's table.

If the principal point of the right camera lies farther right than that of the left one, distant points have negative
disparities, which matchers do not search by default. Then the right image is moved to the left by whole columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real
from typing import cast

import cv2
import numpy as np

from flow.contracts import Finding, Severity, StageError, counted
from stages.data import Array, CameraModel, StereoCamera, StereoFrame
from stages.matching.intensity import eight_bit, gray
from stages.rectification.row_offset import MODELS, RowOffset, measure, moved_down, offset_field
from stages.stage import Stage, check_types, parameter

MAX_ROW_OFFSET = 64.0  # px
MAX_IMPLIED_COLUMNS = 0.0045  # of the width, that columns come with the rows; a focal length off by 0.9 % does more
UNUSUAL_ROW_OFFSET = 8.0  # px, more than a calibration leaves
MAX_CROSSED_SHARE = 0.5  # of the features, beyond infinity
MIN_NEGATIVE_SHARE = 0.05  # of the features, with negative disparity; chance makes less than 0.01


@dataclass(frozen=True)
class Rectify(Stage):
    """A stereo frame with row-aligned images; rectified input is only corrected by row offset and columns.

    Pixels without a raw pixel are 0. A run measures row offset and columns once, on frames of the whole log (`survey`),
    and corrects all frames alike. A call on a single frame measures them on that frame.

    Examples
    --------
    >>> import numpy as np
    >>> from stages import CameraModel, Rectify, StereoCamera, StereoFrame
    >>> k, p = np.diag([100, 100, 1]), np.diag([100, 100, 1, 0])[:3]
    >>> raw = CameraModel(width=80, height=48, k=k, d=np.zeros(5), r=np.eye(3), p=p)
    >>> camera = StereoCamera(100, 100, 0, 0, baseline=0.1, width=80, height=48, raw=(raw, raw))
    >>> image = np.full((48, 80), 7, np.uint8)
    >>> rectified = Rectify(row_offset=0.0)(StereoFrame(0, image, image, camera))
    >>> rectified.camera.raw is None, bool((rectified.left == image).all())
    (True, True)
    """

    row_offset: float | tuple[float, ...] | None = parameter(
        None,
        "rows by which a point is lower in the left rectified image than in the right one (v_left - v_right); the"
        " right image is moved down by them. A number, or the weights of 1, x, y, xy, y^2 (from the centre, in widths"
        " and heights); default: measured, and corrected if the evidence is clear",
        unit="px",
    )
    columns: int | None = parameter(
        None,
        "columns by which the right image is moved to the left, which adds them to all disparities; a rectified image"
        " loses them at its left edge. Default: the distance of the principal points, if the images show that it is"
        " needed for disparities of at least 0",
        unit="px", low=0, high=1024,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.row_offset
        if isinstance(given, list):
            object.__setattr__(self, "row_offset", tuple(given))
        terms = given if isinstance(given, tuple | list) else (0.0 if given is None else given,)
        numbers = all(isinstance(term, Real) and not isinstance(term, bool) for term in terms)
        if not (numbers and 1 <= len(terms) <= MODELS[0] and all(abs(term) <= MAX_ROW_OFFSET for term in terms)):
            raise ValueError(
                f"Rectify.row_offset must be one to {MODELS[0]} numbers, each at most {MAX_ROW_OFFSET:g} px, "
                f"not {given!r}"
            )

    def __call__(self, frame: StereoFrame) -> StereoFrame:
        """The rectified frame; its `camera` has no `raw`."""
        check_types(self, frame=frame)
        if self._terms is not None and not self._may_move(frame.camera):
            return _rectified(frame, self._terms, self.columns or 0)
        plain = _rectified(frame)
        offset = _measured([plain])
        clear = offset.terms if offset is not None and offset.clear else ()
        terms = clear if self._terms is None else self._terms
        columns = _columns_needed(frame.camera, offset) if self.columns is None else self.columns
        return _rectified(frame, terms, columns) if terms or columns else plain

    @property
    def surveys(self) -> bool:
        """Whether the stage needs frames of the whole log before the first call: unless both parameters are set."""
        return self.row_offset is None or self.columns is None

    def survey(self, frame: Sequence[StereoFrame]) -> tuple[Rectify, Finding | None]:
        """The stage with the row offset and the columns that suit all frames, and a finding about them."""
        plain = []
        for each in frame:
            with suppress(ValueError):  # the run reports this frame when it reaches it
                plain.append(_rectified(each))
        camera = plain[0].camera if plain else None
        moves = camera is not None and self._may_move(camera)
        offset = _measured(plain) if self.row_offset is None or moves else None
        stage, of_rows = self._fitted(plain, offset) if self.row_offset is None else (self, None)
        found = [Finding("; ".join(camera.doubts), Severity.WARNING)] if camera and camera.doubts else []
        found += [of_rows] if of_rows else []
        columns = self.columns or 0
        if camera is not None and moves and (columns := _columns_needed(camera, offset)):
            farther = f"the right image is moved to the left by {columns} px, as its principal point lies farther right"
            found.append(Finding(farther))
        return replace(stage, columns=columns), _joined(found)

    def _may_move(self, camera: StereoCamera) -> bool:
        """Whether the images decide if the right one is moved."""
        return self.columns is None and _infinity(camera) < 0

    def _fitted(self, plain: Sequence[StereoFrame], offset: RowOffset | None) -> tuple[Rectify, Finding]:
        """The stage with the row offset measured on rectified frames, and a finding about it."""
        if offset is None:
            unclear = "the row offset is not clear from the images; none is corrected"
            return replace(self, row_offset=0.0), Finding(unclear)
        if offset.crossed > MAX_CROSSED_SHARE:
            swapped = (
                f"{offset.crossed:.0%} of the features that both images show look farther than infinity: left and "
                "right are swapped, or the calibration is not that of these images; exchange 'left' and 'right' of the "
                "source, and set 'left_info' and 'right_info' to the topics that they have now"
            )
            return replace(self, row_offset=0.0), Finding(swapped, Severity.FAULT, about="cameras")
        terms = tuple(round(term, 4) for term in offset.terms)
        found = (
            f"rows of left and right differ by {terms[0]:+z.2f} px at the centre, at most {offset.largest:.2f} px "
            f"(sigma {offset.error:.2f}, {offset.features} features of {counted(len(plain), 'frame')})"
        )
        if not offset.clear:
            return replace(self, row_offset=0.0), Finding(f"{found}: too small to correct")
        severity = Severity.NOTE
        if offset.largest > UNUSUAL_ROW_OFFSET:
            severity = Severity.WARNING
            found += "; so much is unusual: are the images rectified, and with this calibration?"
        sentence = f"{found}; corrected, as row_offset={list(terms)} would"
        columns = _columns_implied(plain[0].camera, offset.terms)
        if columns > MAX_IMPLIED_COLUMNS * plain[0].camera.width:
            severity = Severity.WARNING
            sentence += (
                ". What moves rows so, a turned camera or a wrong focal length, also moves columns by up to "
                f"{columns:.1f} px, which nothing corrects: heights may be wrong; check the calibration"
            )
        return replace(self, row_offset=terms), Finding(sentence, severity)

    @property
    def _terms(self) -> tuple[float, ...] | None:
        """The given row offset as weights of the terms."""
        if self.row_offset is None or isinstance(self.row_offset, tuple):
            return self.row_offset
        return (float(self.row_offset),)


def _joined(found: Sequence[Finding]) -> Finding | None:
    """Several findings as one with the worst severity, None for none."""
    worst = max(found, key=lambda each: list(Severity).index(each.severity), default=None)
    return None if worst is None else replace(worst, sentence="; ".join(each.sentence for each in found))


def _infinity(camera: StereoCamera) -> float:
    """The disparity of what is infinitely far, px."""
    return camera.cx - camera.cx_right


def _measured(frames: Sequence[StereoFrame]) -> RowOffset | None:
    pairs = [tuple(gray(image) for image in eight_bit(frame.left, frame.right)) for frame in frames]
    infinity = _infinity(frames[0].camera) if frames else 0.0
    return measure(cast(list[tuple[Array, Array]], pairs), infinity)


def _columns_needed(camera: StereoCamera, offset: RowOffset | None) -> int:
    """The columns by which to move the right image to the left: 0 unless enough features have negative disparities."""
    shown = offset is not None and offset.negative >= MIN_NEGATIVE_SHARE and offset.crossed <= MAX_CROSSED_SHARE
    return math.ceil(max(-_infinity(camera), 0.0)) if shown else 0


def _columns_implied(camera: StereoCamera, terms: Sequence[float]) -> float:
    """The largest shift of columns, px, by the rotation and the focal length that move rows by these terms."""
    _, x, y, xy, _ = (*terms, 0.0, 0.0, 0.0, 0.0)[:5]
    width, height = camera.width, camera.height
    return (abs(x) * height / width + abs(y) * width / height) / 2 + abs(xy) * camera.fx**2 / (width * height)


def _rectified(frame: StereoFrame, row_terms: tuple[float, ...] = (), columns: int = 0) -> StereoFrame:
    """The rectified frame, its right image moved down by the row offset and to the left by `columns`."""
    camera, terms = frame.camera, row_terms if any(row_terms) else ()
    left, right = frame.left, frame.right
    if camera.raw is not None:
        left = cv2.remap(left, *_rectifying_maps(*_frozen(camera.raw[0]), (), 0), cv2.INTER_CUBIC)
        right = cv2.remap(right, *_rectifying_maps(*_frozen(camera.raw[1]), terms, columns), cv2.INTER_CUBIC)
    elif terms:
        right = moved_down(right, terms)
    if columns and camera.raw is None:
        right = np.pad(right[:, columns:], [(0, 0), (0, min(columns, camera.width))] + [(0, 0)] * (right.ndim - 2))
    camera = replace(camera, raw=None, cx_right=camera.cx_right - columns)
    return StereoFrame(frame.stamp, left, right, camera)


def _frozen(model: CameraModel) -> tuple[str, int, int, bytes]:
    """The calibration as a hashable value: equal calibrations share their maps, whatever object holds them."""
    values = np.concatenate([model.k.ravel(), model.r.ravel(), model.p.ravel(), model.d.ravel()])
    return model.model, model.width, model.height, values.tobytes()


@lru_cache(maxsize=8)
def _rectifying_maps(
    model: str, width: int, height: int, values: bytes, terms: tuple[float, ...], first: int
) -> tuple[Array, Array]:
    """Positions of the rectified pixels in the raw image, moved down by the row offset, from column `first` on.

    They are in cv2.remap's fixed point.
    """
    numbers = np.frombuffer(values)
    k, r, p, d = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:30].reshape(3, 4), numbers[30:]
    if wrong := CameraModel(width, height, k, d, r, p, model).unusable:
        raise StageError(f"Rectify: {wrong}")
    undistort = cv2.fisheye.initUndistortRectifyMap if model == "equidistant" else cv2.initUndistortRectifyMap
    down = offset_field(terms, width, height, first)
    above = int(np.ceil(np.abs(down).max())) if terms else 0  # rows beyond the image that the offset may need
    projection = p[:, :3].copy()
    projection[:2, 2] += -first, above
    x, y = undistort(k, d, r, projection, (width, height + 2 * above), cv2.CV_32FC1)
    if terms:
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        x, y = (cv2.remap(table, columns, rows + above - down, cv2.INTER_LINEAR) for table in (x, y))
    maps = cv2.convertMaps(x, y, cv2.CV_16SC2)
    return maps[0], maps[1]
