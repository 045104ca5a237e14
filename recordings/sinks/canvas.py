"""Where loggers put their entities: one recording at the time of one frame.

Its one trick: the canvas remembers which entities the last frame had, and clears those that this frame lacks, so the
viewer never shows an old picture as this frame's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from textwrap import wrap
from typing import Any

import cv2
import numpy as np
import rerun as rr

from recordings.png import png
from recordings.sinks import colormaps
from recordings.sinks.blueprint import CURVES, LEDGER, LEDGER_CHARS, Panel, ViewSpec
from recordings.sinks.colormaps import UNKNOWN_RGB, Legend, Point, Rgb
from recordings.sinks.entity_rows import (
    At,
    Component,
    Drawn,
    EntityRows,
    blob,
    components_of,
    depth_range,
    drawn,
    fields_of,
    image_format,
    masking,
)
from stages.data import Array, ElevationMap, NavigationMap, StereoCamera

TEXT_RGB: Rgb = (225, 228, 235)
CAMERA_RGB: Rgb = (255, 210, 60)
VEIL: tuple[int, int, int, int] = (96, 100, 112, 170)  # over guesses
CURVE_RGB: tuple[Rgb, ...] = ((255, 210, 60), (95, 175, 255), (245, 120, 95), (125, 215, 140), (205, 145, 245))
MIN_WHOLE_WIDTH, MAX_WHOLE_WIDTH, MIN_SMALL_WIDTH = 320, 640, 120  # px, of pictures of results; of intermediates
MAX_POINTS = 8_000  # of a cloud
LEGEND_COLUMNS = (4, 3)  # of a single row, and of several, which have the longer names
VIEWER_COLORMAPS = {  # the viewer's own, by OpenCV's
    cv2.COLORMAP_TURBO: rr.components.Colormap.Turbo,
    cv2.COLORMAP_VIRIDIS: rr.components.Colormap.Viridis,
    cv2.COLORMAP_INFERNO: rr.components.Colormap.Inferno,
}
LEGEND_ROW = (0.14, 0.2)  # height of a single row of a legend, and of several, share of the picture's height
ROW_BESIDE = 0.2  # least height of a row of a legend beside the picture, share of the picture's height
MAX_UNIT_CHARS = 3  # of a unit that stands at each value of a scale; a longer one stands at the last
CLEARED = components_of(rr.Clear(recursive=False))
(NUMBER,) = (one.descriptor for one in components_of(rr.Scalars(0.0)))
LINE_SPACING = 2  # m, between the lines across a map
_OF_ONE_RECORDING = ("recording", "rows", "numbers", "_recurred")
HEADROOM = 0.35  # above the first row of a legend, share of the height of a row


@dataclass(eq=False)
class Canvas:
    """A recording at the time of one frame.

    views: every entity that was ever logged, in the order of the first time; the blueprint is made from it. camera: of
    the first frame; identifies streams of another image size. What does not change from frame to frame, such as a
    legend, is logged once, which halves the number of calls.
    """

    recording: rr.RecordingStream
    jpeg_quality: int
    max_width: int  # of a picture, px; 0: by the camera's images
    at: At = (0, 0)  # the frame's
    pictures: bool = True  # whether this frame's images, clouds and surfaces are drawn
    full_size: frozenset[str] = frozenset()  # streams of disparities and images that are no intermediates
    sized: frozenset[str] = frozenset()  # all streams of disparities and images
    matched: frozenset[str] = frozenset()  # the stream of the match that the last disparity is made from
    counts_bytes: bool = False
    hazard_limits: Mapping[str, float] = field(default_factory=dict)  # stream/layer -> in the unit of its scale
    logged_bytes: int = 0  # so far, before compression
    views: dict[tuple[Panel, str], ViewSpec] = field(default_factory=dict)
    camera: StereoCamera | None = None
    ways: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # frame -> x and y of the poses so far
    _curves: dict[Panel, list[str]] = field(default_factory=dict)
    _texts: dict[str, str] = field(default_factory=dict)
    _present: dict[str, set[int]] = field(default_factory=dict)
    _limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    _recurred: dict[str, tuple[Component, ...]] = field(default_factory=dict)
    _veiled: set[str] = field(default_factory=set)
    _before: dict[str, type] = field(default_factory=dict)
    _now: dict[str, type] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rows, self.numbers = EntityRows(self.recording), EntityRows(self.recording)

    def remembered(self) -> dict[str, Any]:
        """What the canvas remembers of the frames so far. What recurs is logged once more."""
        return {name: value for name, value in vars(self).items() if name not in _OF_ONE_RECORDING}

    def log(self, path: str, archetype: Any, *views: ViewSpec) -> None:
        """Log an entity at the frame's time; views: where the blueprint shows it."""
        shown = archetype if isinstance(archetype, Drawn) else Drawn(type(archetype), components_of(archetype))
        self.log_components(path, *shown)
        for view in views:
            self.add_view(view)

    def log_components(
        self,
        path: str,
        kind: type,
        content: Sequence[Component] = (),
        recurring: tuple[Component, ...] = (),
    ) -> None:
        """Log an entity. What recurs is left out while it is that of the last frame, which the viewer then takes."""
        logged = {*map(id, self._recurred.get(path, ()))} if path in self._before else ()
        row = (*content, *(one for one in recurring if id(one) not in logged))
        self._recurred[path], self._now[path] = recurring, kind
        if row:
            self.rows.add(path, self.at, row)
        if self.counts_bytes:
            self.logged_bytes += sum(one.nbytes for one in row)

    def add_view(self, view: ViewSpec) -> None:
        """Add a view to the blueprint."""
        self.views.setdefault((view.panel, view.path), view)

    def keep_all(self, stream: str) -> None:
        """Leave the entities of a stream as they were in the last frame."""
        self._now |= {path: kind for path, kind in self._before.items() if f"{path}/".startswith(f"{stream}/")}

    def log_number(self, path: str, value: float, view: ViewSpec) -> None:
        """A value over time. Numbers wait for those of other frames: one by one they would be half of all calls."""
        self.numbers.add(path, self.at, (Component(NUMBER, float(value)),))
        self._now[path] = rr.Scalars
        self.add_view(view)

    def plot(self, path: str, value: float, view: ViewSpec) -> None:
        """A value over time; the first five curves of a panel differ in colour."""
        drawn = self._curves.setdefault(view.panel, [])
        if path not in drawn:
            self.recording.log(path, rr.SeriesLines(colors=[CURVE_RGB[len(drawn) % len(CURVE_RGB)]]), static=True)
            drawn.append(path)
            self.name_curves(
                f"{CURVES}/{view.panel.name}", [name.rpartition("/")[2].replace("\\", "") for name in drawn]
            )
        self.log_number(path, value, view)

    def name_curves(self, path: str, names: Sequence[str]) -> None:
        """Log the names of curves below each other, in the colours of `CURVE_RGB`."""
        colors = [CURVE_RGB[number % len(CURVE_RGB)] for number in range(len(names))]
        places = [(0.0, float(row)) for row in range(len(names))]
        labels = rr.Points2D(places, colors=colors, radii=rr.Radius.ui_points(0.5), labels=names, show_labels=True)
        self.recording.log(path, labels, static=True)

    def log_text(
        self, path: str, text: str, level: rr.TextLogLevel = rr.TextLogLevel.INFO, at: At | None = None
    ) -> None:
        """A text in lines that the ledger has room for. at: the frame's time by default."""
        limits: dict[str, Any] = {"subsequent_indent": "... ", "break_long_words": False, "break_on_hyphens": False}
        for line in (part for own in text.splitlines() for part in wrap(own, LEDGER_CHARS, **limits)):
            self.rows.add(path, at or self.at, drawn(rr.TextLog, text=line, level=level).components)

    def log_change(self, path: str, text: str, level: rr.TextLogLevel) -> None:
        """A text in the ledger, unless it is the last one of `path`."""
        if self._texts.get(path) != text:
            self._texts[path] = text
            self.log_text(f"{LEDGER}/{path}", text, level)

    @property
    def whole_width(self) -> int:
        """The widest picture of a result, px."""
        if self.max_width:
            return self.max_width
        half = self.camera.width // 2 if self.camera else MAX_WHOLE_WIDTH
        return min(max(half, MIN_WHOLE_WIDTH), MAX_WHOLE_WIDTH)

    @property
    def small_width(self) -> int:
        """The widest picture of an intermediate, px."""
        return max(self.whole_width * 3 // 8, 1 if self.max_width else MIN_SMALL_WIDTH)

    def width(self, stream: str) -> int:
        """The widest picture of a stream of disparities or images, px."""
        return self.small_width if stream in self.sized - self.full_size else self.whole_width

    def log_exact(self, path: str, pixels: Array, view: ViewSpec) -> None:
        """An 8-bit image, (H, W) gray or (H, W, 3) RGB, as PNG."""
        self.log_blob(path, rr.EncodedImage, png(pixels), view, media_type="image/png")

    def log_image(self, path: str, pixels: Array, view: ViewSpec) -> None:
        """An 8-bit image, (H, W) gray or (H, W, 3) RGB, as JPEG."""
        stored = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
        _, jpeg = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        self.log_blob(path, rr.EncodedImage, jpeg, view, media_type="image/jpeg")

    def log_blob(self, path: str, kind: type, content: bytes | Array, view: ViewSpec, **fields: Any) -> None:
        """An image that is encoded already, and the other fields of its archetype, which recur."""
        self.log_components(path, kind, [blob(kind, "blob", content)], fields_of(kind, **fields))
        self.add_view(view)

    def _log_raw(self, path: str, kind: type, pixels: Array, recurring: tuple[Component, ...] = ()) -> None:
        """Log an image that is not encoded."""
        form = image_format(kind, pixels.shape, pixels.dtype)
        self.log_components(path, kind, [blob(kind, "buffer", pixels)], (*form, *recurring))

    def log_values(
        self,
        values: Array,
        limits: tuple[float, float],
        view: ViewSpec,
        unit: str | None = None,
        palette: int = cv2.COLORMAP_TURBO,
        hazard: float | None = None,
    ) -> None:
        """Values (H, W) in colours over a range; hover reads them. Unknown ones have `UNKNOWN_RGB` or nearly black.

        unit: of the scale above the picture; None: no scale; hazard: the value from which cells are hazards.
        """
        low, high = limits
        ends = (low - 0.1 * (high - low), high)
        colours = fields_of(rr.DepthImage, meter=1.0, colormap=VIEWER_COLORMAPS[palette])
        self._log_raw(view.path, rr.DepthImage, values, (*colours, depth_range(ends)))
        self.add_view(view)
        if palette != cv2.COLORMAP_TURBO:  # which begins with nearly black
            mask = np.isnan(values).view(np.uint8)
            self._log_raw(f"{view.path}/unknown", rr.SegmentationImage, mask, masking("unknown", UNKNOWN_RGB))
        if unit is not None:
            self.log_legend(f"{view.path}/scale", values.shape, _scale(low, high, unit, palette, hazard, ends[0]))

    def log_steps(
        self,
        steps: Array,
        per_unit: float,
        limit: float,
        view: ViewSpec,
        unit: str,
        palette: int = cv2.COLORMAP_TURBO,
        veiled: tuple[str, Array | None] = ("", None),
    ) -> None:
        """Numbers of steps (H, W), uint16, as PNG, in colours from 0 to `limit`; hover reads units of `per_unit` steps.

        limit: in units; veiled: a name, and which pixels (H, W) bool are faint. The viewer draws such images of 8 bits
        black.
        """
        self.log_blob(
            view.path, rr.EncodedDepthImage, png(steps), view, media_type="image/png", meter=per_unit,
            colormap=VIEWER_COLORMAPS[palette], depth_range=(0.0, limit * per_unit),
        )  # fmt: skip
        name, faint = veiled
        if faint is not None and (faint.any() or view.path in self._veiled):
            self._veiled.add(view.path)
            mask = np.ascontiguousarray(faint).view(np.uint8)
            self._log_raw(f"{view.path}/{name}", rr.SegmentationImage, mask, masking(name, VEIL))
        entries = [(name, VEIL[:3])] if view.path in self._veiled and faint is not None else []
        self.log_legend(f"{view.path}/scale", steps.shape, [*_scale(0.0, limit, unit, palette), *entries])

    def log_labels(
        self, view: ViewSpec, codes: Array, legend: Legend, beside: bool = False, counts: Array | None = None
    ) -> None:
        """A label image (H, W); its names are above or beside it and appear on hover. counts: its `label_counts`."""
        path, labels = view.path, codes.astype(np.uint8, copy=False)
        self._log_raw(f"{path}/labels", rr.SegmentationImage, labels, _annotations(tuple(legend.items())))
        self.add_view(view)
        counts = label_counts(labels) if counts is None else counts
        present = self._present.setdefault(path, set())  # codes of any frame so far, so that the legend stays
        present.update(code for code in legend if counts[code & 0xFF])
        self.log_legend(f"{path}/legend", codes.shape, [legend[code] for code in legend if code in present], beside)

    def log_scale(self, path: str, shape: tuple[int, ...], low: float, high: float, unit: str, palette: int) -> None:
        """The legend of a colour map: three of its values above the picture."""
        self.log_legend(path, shape, _scale(low, high, unit, palette))

    def log_legend(
        self, path: str, shape: tuple[int, ...], entries: Iterable[tuple[str, Rgb]], beside: bool = False
    ) -> None:
        """Named dots above a picture of (H, W), in a row of at most four or rows of three; or in a column beside."""
        named = tuple(entries)
        for part, draw in (("", _dots), ("/text", _names)):
            self.log_components(f"{path}{part}", rr.Points2D, recurring=draw(shape, named, beside))

    def log_distances(self, path: str, shape: tuple[int, int], grid: ElevationMap | NavigationMap) -> None:
        """Lines across a bird's-eye view at every second metre of x, with distances; the rover's place and way."""
        lines, marks = _distances(shape, (*grid.origin,), grid.resolution, colormaps.rover_place(grid))
        self.log_components(path, lines.kind, recurring=lines.components)
        self.log_components(f"{path}/distances", marks.kind, recurring=marks.components)
        ways = colormaps.way_on(grid, shape, self.ways.get(grid.frame_id, []))
        if ways:
            shown: dict[str, Any] = {"colors": [CAMERA_RGB], "radii": rr.Radius.ui_points(1.2), "draw_order": 22.0}
            self.log(f"{path}/way", drawn(rr.LineStrips2D, strips=ways, **shown))

    def limits(self, path: str, low: float, high: float) -> tuple[float, float]:
        """The lowest and the highest value given for `path` so far, so that a scale stays."""
        lowest, highest = self._limits.get(path, (low, high))
        self._limits[path] = min(low, lowest), max(high, highest)
        return self._limits[path]

    def clear_missing(self) -> None:
        """Clear the entities of the last frame that this frame lacks."""
        for path, kind in self._before.items():
            if path in self._now:
                continue
            if issubclass(kind, rr.Scalars):
                self.numbers.add(path, self.at, (Component(NUMBER, math.nan),))
            elif issubclass(kind, rr.EncodedImage | rr.EncodedDepthImage):
                # The viewer goes on showing a cleared encoded image (rerun-io/rerun#12793), but not an empty one.
                self.rows.add(path, self.at, fields_of(kind, clear_unset=True))
            else:
                self.rows.add(path, self.at, CLEARED)
        self._before, self._now = self._now, {}


def label_counts(labels: Array) -> Array:
    """The number of pixels with each of 256 labels, (256,); labels: (H, W) uint8."""
    return np.ravel(cv2.calcHist([labels], [0], None, [256], [0, 256]))


@lru_cache(maxsize=16)
def _annotations(legend: tuple[tuple[int, tuple[str, Rgb]], ...]) -> tuple[Component, ...]:
    """The names and the colours of labels."""
    infos = [rr.AnnotationInfo(code & 0xFF, name, rgb) for code, (name, rgb) in legend]
    return components_of(rr.AnnotationContext(infos))


@lru_cache(maxsize=256)
def _scale(
    low: float, high: float, unit: str, palette: int, hazard: float | None = None, begin: float | None = None
) -> tuple[tuple[str, Rgb], ...]:
    """Three values of a colour map, with their colours; the middle one is the limit of hazards, if there is one.

    begin: where the colours begin, `low` by default.
    """
    values = np.array([low, (low + high) / 2 if hazard is None else hazard, high])
    shades = colormaps.apply_palette(values, low if begin is None else begin, high, palette)
    colors = [(int(r), int(g), int(b)) for r, g, b in shades]
    units = [unit] * 3 if len(unit) <= MAX_UNIT_CHARS else ["", "", unit]
    names = [f"{colormaps.format_value(value)} {end}".rstrip() for value, end in zip(values, units, strict=True)]
    names[1] = names[1] if hazard is None else f"limit {names[1]}"
    return tuple(zip(names, colors, strict=True))


@lru_cache(maxsize=256)
def _dots(shape: tuple[int, ...], entries: Sequence[tuple[str, Rgb]], beside: bool) -> tuple[Component, ...]:
    """The dots of a legend."""
    dots, _, rows, row_height = _places(shape, len(entries), beside)
    colors, radii = [rgb for _, rgb in entries], [5.0] * len(entries)
    if not beside:
        # The view ends at the uppermost points, unless they are few among many; so points without extent keep the first
        # row's dots whole.
        above = [(x, -(rows + HEADROOM) * row_height) for x, y in dots if y == dots[0][1]]
        dots, colors, radii = [*dots, *above], colors + [(0, 0, 0)] * len(above), radii + [0.0] * len(above)
    sizes = rr.Radius.ui_points(radii)
    return drawn(rr.Points2D, positions=dots, colors=colors, radii=sizes, draw_order=30.0).components


@lru_cache(maxsize=256)
def _names(shape: tuple[int, ...], entries: Sequence[tuple[str, Rgb]], beside: bool) -> tuple[Component, ...]:
    """The names of a legend. A label takes the colour of its dot, which may be as dark as the background, so labels
    have dots of their own."""
    _, pins, *_ = _places(shape, len(entries), beside)
    texts: dict[str, Any] = {"labels": [name for name, _ in entries], "show_labels": True, "draw_order": 31.0}
    return drawn(rr.Points2D, positions=pins, colors=[TEXT_RGB], radii=rr.Radius.ui_points(0.5), **texts).components


def _places(
    shape: tuple[int, ...], count: int, beside: bool
) -> tuple[list[tuple[float, float]], list[tuple[float, float]], int, float]:
    """The places (x, y) of a legend's dots and of its names, its rows, and the height of one above the picture."""
    height, width = shape
    rows = count if beside else -(-count // LEGEND_COLUMNS[count > LEGEND_COLUMNS[0]])
    columns, row_height = -(-count // rows), LEGEND_ROW[rows > 1] * height
    places = [divmod(number, columns) for number in range(count)]
    if beside:
        pitch = max(1 / rows, ROW_BESIDE) * height
        dots = [(1.1 * width, height / 2 + (row + (1 - rows) / 2) * pitch) for row in range(rows)]
        # A label is centred below its pin.
        return dots, [(x + 0.41 * width, y - 0.45 * pitch) for x, y in dots], rows, row_height
    dots = [((column + 0.5) * width / columns, (row - rows) * row_height) for row, column in places]
    return dots, dots, rows, row_height


@lru_cache(maxsize=256)
def _distances(shape: tuple[int, int], origin: Point, resolution: float, rover: Point | None) -> tuple[Drawn, Drawn]:
    """Lines across a bird's-eye view of a grid at every second metre of x, and named points: distances, rover."""
    width = float(shape[0])
    far, left = (start + count * resolution for start, count in zip(origin, shape[::-1], strict=True))
    first, last = np.ceil(origin[0] / LINE_SPACING), np.floor(far / LINE_SPACING)
    ahead = LINE_SPACING * np.arange(first, last + 1) + 0.0  # no minus zero
    depths = (far - ahead) / resolution
    marks, names = [(width, depth) for depth in depths], [f"{x:.0f} m" for x in ahead]
    if rover is not None:
        marks, names = [*marks, ((left - rover[1]) / resolution, (far - rover[0]) / resolution)], [*names, "rover"]
    strips, thin = [[(0.0, depth), (width, depth)] for depth in depths], rr.Radius.ui_points(0.6)
    points: dict[str, Any] = {"colors": [(255, 255, 255)], "radii": rr.Radius.ui_points(2.0), "draw_order": 21.0}
    return (
        drawn(rr.LineStrips2D, strips=strips, colors=[(255, 255, 255, 80)], radii=thin, draw_order=20.0),
        drawn(rr.Points2D, positions=marks, labels=names, show_labels=True, **points),
    )
