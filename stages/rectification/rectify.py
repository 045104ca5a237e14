"""Rectification: both images resampled so that corresponding points lie on the same row.

Each camera's undistortion and rectifying rotation are folded into one table of source positions (Bouguet's method, as
in image_pipeline), computed once per camera and then only looked up. What the calibration leaves of a row offset is
measured (stages.rectification.row_offset) and folded into the right camera's table.

A right camera whose principal point lies farther right than the left one's has disparities below 0 for all that is far
off, which no matcher searches by itself: then its image is moved to the left by whole columns.
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
from stages.stage import Stage, parameter

LARGEST_OFFSET = 64.0  # px
UNUSUAL = 8.0  # px, more than a calibration leaves
MOST_CROSSED = 0.5  # of the features
LEAST_NEGATIVE = 0.05  # of them, where chance makes less than 0.01


@dataclass(frozen=True)
class Rectify(Stage):
    """A stereo frame with row-aligned images; rectified input passes through but for these corrections.

    Pixels that no raw pixel maps to are 0. A run measures row offset and columns once, on frames from all over the log
    (`survey`), and corrects all frames alike; called on a single frame the stage measures that frame's own.
    """

    row_offset: float | tuple[float, ...] | None = parameter(
        None,
        "rows by which rectification leaves a point lower in the left image than in the right one (v_left - v_right);"
        " the right image is moved down by as many. A number, or the weights of 1, x, y, xy, y^2 (from the centre, in"
        " widths and heights); by default measured, and corrected where the evidence is clear",
        unit="px",
    )
    columns: int | None = parameter(
        None,
        "columns by which the right image is moved to the left; by default as many as its principal point lies farther"
        " right, where the images show that this much is needed for disparities not to be below 0. What is nearest has"
        " then larger disparities, and of a rectified image as many columns at its left edge are lost",
        unit="px", low=0, high=1024,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.row_offset
        if isinstance(given, list):
            object.__setattr__(self, "row_offset", tuple(given))
        terms = given if isinstance(given, tuple | list) else (0.0 if given is None else given,)
        numbers = all(isinstance(term, Real) and not isinstance(term, bool) for term in terms)
        if not (numbers and 1 <= len(terms) <= MODELS[0] and all(abs(term) <= LARGEST_OFFSET for term in terms)):
            raise ValueError(
                f"Rectify.row_offset must be one to {MODELS[0]} numbers, each at most {LARGEST_OFFSET:g} px, "
                f"not {given!r}"
            )

    def __call__(self, frame: StereoFrame) -> StereoFrame:
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
        """Whether the stage wants to see frames of the whole log before it is called: unless it is told all."""
        return self.row_offset is None or self.columns is None

    def survey(self, frame: Sequence[StereoFrame]) -> tuple[Rectify, Finding | None]:
        """The stage with the row offset and the columns that suit all frames, and what there is to say about it."""
        plain = []
        for each in frame:
            with suppress(ValueError):  # the run will meet the frame again, and say what is the matter with it
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
        """Whether the images have to tell if the right one is moved."""
        return self.columns is None and _infinity(camera) < 0

    def _fitted(self, plain: Sequence[StereoFrame], offset: RowOffset | None) -> tuple[Rectify, Finding]:
        """The stage with the row offset of frames that are rectified but for it, and what there is to say of that."""
        if offset is None:
            unclear = "the row offset is not clear from the images; none is corrected"
            return replace(self, row_offset=0.0), Finding(unclear)
        if offset.crossed > MOST_CROSSED:
            swapped = (
                f"{offset.crossed:.0%} of the features that both images show look farther than infinity: left and "
                "right are swapped, or the calibration is not that of these images; exchange 'left' and 'right' of the "
                "source"
            )
            return replace(self, row_offset=0.0), Finding(swapped, Severity.WARNING)
        terms = tuple(round(term, 4) for term in offset.terms)
        found = (
            f"rows differ by {terms[0]:+.2f} px at the centre, by up to {offset.largest:.2f} px, +- {offset.error:.2f}"
            f" ({offset.features} features of {counted(len(plain), 'frame')})"
        )
        if not offset.clear:
            return replace(self, row_offset=0.0), Finding(f"{found}: too little to correct")
        severity = Severity.NOTE
        if offset.largest > UNUSUAL:
            severity = Severity.WARNING
            found += "; so much is unusual: are the images rectified, and with this calibration?"
        sentence = f"{found}; corrected, as row_offset={list(terms)} would"
        return replace(self, row_offset=terms), Finding(sentence, severity)

    @property
    def _terms(self) -> tuple[float, ...] | None:
        """The given row offset as weights of the terms."""
        if self.row_offset is None or isinstance(self.row_offset, tuple):
            return self.row_offset
        return (float(self.row_offset),)


def _joined(found: Sequence[Finding]) -> Finding | None:
    """Several findings as one, None for none."""
    worst = Severity.WARNING if any(each.severity == Severity.WARNING for each in found) else Severity.NOTE
    return Finding("; ".join(each.sentence for each in found), worst) if found else None


def _infinity(camera: StereoCamera) -> float:
    """The disparity of what is infinitely far, px."""
    return camera.cx - camera.cx_right


def _measured(frames: Sequence[StereoFrame]) -> RowOffset | None:
    pairs = [tuple(gray(image) for image in eight_bit(frame.left, frame.right)) for frame in frames]
    infinity = _infinity(frames[0].camera) if frames else 0.0
    return measure(cast(list[tuple[Array, Array]], pairs), infinity)


def _columns_needed(camera: StereoCamera, offset: RowOffset | None) -> int:
    """By how much to move the right image to the left, as far as the features of `offset` tell. Near scenes that were
    taken by such cameras may well lack disparities below 0."""
    shown = offset is not None and offset.negative >= LEAST_NEGATIVE and offset.crossed <= MOST_CROSSED
    return math.ceil(max(-_infinity(camera), 0.0)) if shown else 0


def _rectified(frame: StereoFrame, row_terms: tuple[float, ...] = (), columns: int = 0) -> StereoFrame:
    """The frame rectified, its right image moved down by the offset of these terms, and to the left."""
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
    """Where in the raw image each rectified pixel lies, moved down by the offset, in cv2.remap's fixed point; from the
    rectified column `first` on."""
    numbers = np.frombuffer(values)
    k, r, p, d = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:30].reshape(3, 4), numbers[30:]
    if wrong := CameraModel(width, height, k, d, r, p, model).unusable:
        raise StageError(f"Rectify: {wrong}")
    undistort = cv2.fisheye.initUndistortRectifyMap if model == "equidistant" else cv2.initUndistortRectifyMap
    down = offset_field(terms, width, height, first)
    above = int(np.ceil(np.abs(down).max())) if terms else 0  # rows beyond the image that the offset may look up
    projection = p[:, :3].copy()
    projection[:2, 2] += -first, above
    x, y = undistort(k, d, r, projection, (width, height + 2 * above), cv2.CV_32FC1)
    if terms:
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        x, y = (cv2.remap(table, columns, rows + above - down, cv2.INTER_LINEAR) for table in (x, y))
    maps = cv2.convertMaps(x, y, cv2.CV_16SC2)
    return maps[0], maps[1]
