"""The rerun blueprints: how the views of a recording are laid out in the viewer, a desk for each kind of question.

The desk `overview` has images at the left in the order of the method, 3-D views in the middle, maps at the right, plots
and the ledger below. A layout is made from the entities that were really logged, so no view is ever empty.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumnKind, TimelineColumn

from recordings.containers.finding import first_bytes
from recordings.errors import LogError
from recordings.sinks import ENTITIES
from stages.data import LEVEL_FRAME

APPLICATION = "roverflow"  # whose recordings share the layout that the viewer saves
CLOCK = "log clock"  # the timeline of the frames' stamps
FRAME = "frame"  # the timeline that counts frames

LEDGER, FRAMES, SUMMARY, SECONDS, QUEUES, LAYOUT, CURVES = ENTITIES
SLOWEST = f"{LAYOUT}/slowest"  # those of the slowest stages, which differ from run to run
LEDGER_CHARS = 80  # of a line of a text log, which the viewer does not wrap
MAX_LEGEND_LINES = 4  # the legend of more lines would hide the plot
# Side by side on the desk `terrain`; the others are tabs.
SHOWN_LAYERS = ("step", "slope", "steepness", "roughness", "variance")

_HIDDEN = rrb.PlotLegend(visible=False)
Specs = tuple["ViewSpec", ...]
_Part = rrb.View | rrb.Container


# The places of the layout. Derived images have another size than the camera's; OWN_... are of the user's own types.
Panel = Enum(
    "Panel",
    "LEFT RIGHT LEFT_DERIVED RIGHT_DERIVED DISPARITY SUPERPIXELS SOURCE COST LEAD MATCH_CONFIDENCE CONFIDENCE SIGMA "
    "DEPTH DIFFERENCE CLOUD VOXELS TERRAIN CAMERA TRAJECTORY RELIEF LAYER MAP REASON ANGLE HEALTH MATCHES FEATURES "
    "STAGE OWN_IMAGE OWN_NUMBER OWN_TEXT OWN_BARS OWN_TENSOR",
)

ERRORS = (Panel.CONFIDENCE, Panel.SIGMA, Panel.DIFFERENCE)  # what is known of the last disparity's
MATCHED = "matched (%)"
SENSOR_PLOTS = (
    (Panel.ANGLE, "tilt (degrees)"),
    (Panel.HEALTH, "tilt check (degrees)"),
    (Panel.MATCHES, MATCHED),
    (Panel.FEATURES, "features of visual odometry"),
)


@dataclass(frozen=True)
class ViewSpec:
    """What a view shows: the entity `part` of a stream, in a panel, under a title.

    frame_id is the frame of reference of 3-D entities; size is the width and height of a picture that stays in its
    place, whatever is drawn over it.
    """

    panel: Panel
    stream: str
    part: str
    title: str
    frame_id: str = LEVEL_FRAME
    size: Sequence[int] = ()

    @property
    def path(self) -> str:
        """The entity's path."""
        return f"{self.stream}/{self.part}" if self.part else self.stream


@dataclass(frozen=True)
class Layout:
    """What the desks of a recording are made from.

    views: of the entities logged so far, in the order in which each was first logged; slowest: the stages whose times
    are plotted with their names.
    """

    views: Specs
    slowest: tuple[str, ...] = ()

    def blueprint(self, desk: str = "overview") -> rrb.Blueprint:
        """The blueprint of one of DESKS."""
        body = DESKS[desk](self.views, self.slowest)
        return rrb.Blueprint(body, rrb.TimePanel(state="collapsed", timeline=CLOCK), collapse_panels=True)

    def as_json(self) -> str:
        """The text that a recording keeps."""
        views = [[spec.panel.name, *[*vars(spec).values()][1:]] for spec in self.views]
        return json.dumps({"slowest": self.slowest, "views": views})


def read_layout(recording: Path) -> Layout:
    """The layout that a recording of `RerunSink` keeps. Raises LogError."""
    first_bytes(recording, "a recording")  # refuses what is no file, or empty
    try:
        with warnings.catch_warnings(action="ignore"):  # of a recording without its end
            for chunk in rr.chunk.RrdReader(str(recording)).stream():
                if chunk.entity_path == f"/{LAYOUT}":
                    (text,) = chunk.to_record_batch().column("TextDocument:text").to_pylist()[-1]
                    found = json.loads(text)
                    views = tuple(ViewSpec(Panel[panel], *rest) for panel, *rest in found["views"])
                    return Layout(views, tuple(found["slowest"]))
    except UnicodeEncodeError as error:
        raise LogError(f"rerun does not read {recording}, whose name is not Unicode; rename it") from error
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise LogError(f"cannot read {recording} as a recording: {error}; run the log again") from error
    raise LogError(f"{recording} keeps no layout: its run was cut short, or another program made it; run the log again")


def _overview(drawn: Specs, slowest: Sequence[str]) -> _Part:
    """All of it: images, space, maps, plots and the ledger."""
    above = _row((_images(drawn), 6.4), (_space(drawn), 5.6), (_maps(drawn), 4.0))
    return _shared(rrb.Vertical, "row_shares", (above, 3.1), (_below(drawn, slowest), 1.0)) or _ledger(drawn)


def _matching(drawn: Specs, slowest: Sequence[str]) -> _Part:
    """Both images and their difference, disparity and origin of each step, and what is known of its errors."""
    disparities, sources = _flat_views(drawn, Panel.DISPARITY), _flat_views(drawn, Panel.SOURCE)
    parts = [
        *_image_tabs(drawn), _tabs(_flat_views(drawn, Panel.DIFFERENCE)),
        _tabs([*_flat_views(drawn, Panel.COST), *reversed(_superpixels(drawn))]),
        _tabs(disparities[-2::-1]), _tabs([*disparities[-1:], *_flat_views(drawn, Panel.DEPTH)]),
        _tabs(sources[-2::-1]), _tabs(sources[-1:]),
        _tabs([*_flat_views(drawn, Panel.LEAD), *_flat_views(drawn, Panel.MATCH_CONFIDENCE)]),
        *(_tabs(_flat_views(drawn, panel)) for panel in (Panel.CONFIDENCE, Panel.SIGMA)),
        _panel(drawn, Panel.MATCHES, MATCHED, in_tab=False),
    ]  # fmt: skip
    return _held(rrb.Grid, parts, grid_columns=4) or _ledger(drawn)


def _terrain(drawn: Specs, slowest: Sequence[str]) -> _Part:
    """The maps, their reasons and layers, and the surface; what made a regional map is behind its reasons."""
    layers = _flat_views(tuple(spec for spec in drawn if spec.frame_id == LEVEL_FRAME), Panel.LAYER)
    regional = _flat_views(tuple(spec for spec in drawn if spec.frame_id != LEVEL_FRAME), Panel.LAYER)
    shown = [view for view in layers if view.name in SHOWN_LAYERS]
    flat = [
        *(_tabs(_flat_views(drawn, panel)) for panel in (Panel.RELIEF, Panel.MAP)),
        _tabs([*_flat_views(drawn, Panel.REASON), *regional]), *shown,
        _tabs(view for view in layers if view not in shown),
    ]  # fmt: skip
    return _row((_held(rrb.Grid, flat, grid_columns=3), 5.0), (_space(drawn), 3.0)) or _ledger(drawn)


def _runtime(drawn: Specs, slowest: Sequence[str]) -> _Part:
    """Times of stages and sinks, queues, and all that was lost."""
    plots = _held(rrb.Vertical, map(_tabs, _stage_plots(drawn, slowest)))
    texts = _held(rrb.Vertical, [*_texts(drawn)[:2], _summary()])
    return _row((plots, 3.0), (texts, 2.0)) or _ledger(drawn)


def _tilt(drawn: Specs, slowest: Sequence[str]) -> _Part:
    """The readings, their residuals in the images, and the cloud that is levelled by them."""
    plots = [_panel(drawn, panel, title, in_tab=False) for panel, title in SENSOR_PLOTS]
    space = _held(
        rrb.Vertical,
        [*_image_tabs(drawn)[:1], _tabs(_spaces(drawn, Panel.CLOUD, "cloud")), _tabs(_trajectories(drawn))],
    )
    rows = [(plots[0], 3.0), (plots[1], 4.0), (plots[3], 2.0), (_ledger(drawn), 3.0)]  # the check's angles are small
    right = _shared(rrb.Vertical, "row_shares", *rows)
    return _row((space, 2.0), (right, 3.0)) or _ledger(drawn)


DESKS: dict[str, Callable[[Specs, Sequence[str]], _Part]] = {
    "overview": _overview,
    "matching": _matching,
    "terrain": _terrain,
    "runtime": _runtime,
    "tilt": _tilt,
}


def _held(container: type[rrb.Container], parts: Iterable[_Part | None], **options: Any) -> _Part | None:
    """The parts that there are in a container; a single one as it is; None for none."""
    present = [part for part in parts if part is not None]
    return container(*present, **options) if len(present) > 1 else next(iter(present), None)


def _shared(container: type[rrb.Container], shares: str, *parts: tuple[_Part | None, float]) -> _Part | None:
    """The same of parts with their shares of the room."""
    present = [(part, share) for part, share in parts if part is not None]
    return _held(container, [part for part, _ in present], **{shares: [share for _, share in present]})


def _row(*columns: tuple[_Part | None, float]) -> _Part | None:
    return _shared(rrb.Horizontal, "column_shares", *columns)


def _at(drawn: Specs, *panels: Panel) -> list[ViewSpec]:
    return [spec for spec in drawn if spec.panel in panels]


def _tabs(views: Iterable[_Part | None]) -> _Part | None:
    """Several views as tabs, the first one shown."""
    return _held(rrb.Tabs, views, active_tab=0)


def _flat_views(drawn: Specs, *panels: Panel) -> list[rrb.View]:
    """The 2-D views of these panels; a title that two streams share is preceded by the stream's name."""
    specs = _at(drawn, *panels)
    streams: dict[str, set[str]] = {}
    for spec in specs:
        streams.setdefault(spec.title, set()).add(spec.stream)
    ambiguous = {stream for sharing in streams.values() if len(sharing) > 1 for stream in sharing}
    views: list[rrb.View] = []
    for spec in specs:
        title = f"{spec.stream}: {spec.title}" if spec.stream in ambiguous else spec.title
        ranges = {f"{axis}_range": (0.0, side) for axis, side in zip("xy", spec.size, strict=False)}
        bounds = rrb.VisualBounds2D(**ranges) if ranges else None
        views.append(rrb.Spatial2DView(origin=spec.path, name=title, visual_bounds=bounds))
    return views


def _images(drawn: Specs) -> _Part | None:
    """Rows of two: left and right image, two disparities, superpixels, origin of each disparity, and own images.

    Of several stereo streams the last one of the camera's size is shown (the rectified one), of other streams the last.
    The others are tabs behind it. The last disparity has a view of its own beside the tabs of the earlier ones.
    """
    disparities = _flat_views(drawn, Panel.DISPARITY)
    parts = [
        *_image_tabs(drawn),
        _tabs(disparities[-2::-1]),
        _tabs([*disparities[-1:], *_flat_views(drawn, Panel.DEPTH)]),
        _tabs(reversed(_superpixels(drawn))),
        _tabs([*reversed(_flat_views(drawn, Panel.SOURCE)), *_flat_views(drawn, *ERRORS)]),
        _tabs(_flat_views(drawn, Panel.OWN_IMAGE)),
    ]
    present = [part for part in parts if part is not None]
    rows = [present[first : first + 2] for first in range(0, len(present), 2)]
    if len(rows) > 1 and len(rows[-1]) == 1:  # no place stays empty
        rows[-2:] = [rows[-2] + rows[-1]]
    return _held(rrb.Vertical, (_held(rrb.Horizontal, row) for row in rows))


def _image_tabs(drawn: Specs) -> list[_Part | None]:
    """The left and the right images, the last ones in front."""
    sides = ((Panel.LEFT, Panel.LEFT_DERIVED), (Panel.RIGHT, Panel.RIGHT_DERIVED))
    return [_tabs([*reversed(_flat_views(drawn, own)), *_flat_views(drawn, derived)]) for own, derived in sides]


def _superpixels(drawn: Specs) -> list[rrb.View]:
    """The superpixels' edges over the left image that was segmented."""
    images = [f"+ /{spec.path}" for spec in _at(drawn, Panel.LEFT)[-1:]]
    return [
        rrb.Spatial2DView(origin="/", contents=[f"+ /{spec.path}/**", *images], name=spec.title)
        for spec in _at(drawn, Panel.SUPERPIXELS)
    ]


def _space(drawn: Specs) -> _Part | None:
    """For each frame of reference the clouds and the terrains, both with the cameras; and the trajectory so far."""
    clouds = _tabs([*_spaces(drawn, Panel.CLOUD, "cloud"), *_spaces(drawn, Panel.VOXELS, "voxels")])
    terrains = _tabs([*_spaces(drawn, Panel.TERRAIN, "terrain"), *_trajectories(drawn)])
    return _held(rrb.Vertical, [clouds, terrains])


def _spaces(drawn: Specs, panel: Panel, name: str) -> list[rrb.View]:
    views: list[rrb.View] = []
    for frame_id in sorted({spec.frame_id for spec in _at(drawn, panel)}, key=lambda frame: frame != LEVEL_FRAME):
        paths = [spec.path for spec in _at(drawn, panel, Panel.CAMERA) if spec.frame_id == frame_id]
        # Behind the rover's right shoulder, looking down on the ground ahead; other frames have no such place.
        eye = rrb.EyeControls3D(position=(-2.2, -4.0, 3.5), look_target=(3.4, 0.1, -0.1), eye_up=(0, 0, 1))
        views.append(
            rrb.Spatial3DView(
                origin="/",
                contents=[f"+ /{path}/**" for path in paths],
                name=name if frame_id == LEVEL_FRAME else f"{name} ({frame_id})",
                eye_controls=eye if frame_id == LEVEL_FRAME else None,
                line_grid=rrb.LineGrid3D(spacing=1.0, stroke_width=0.4, color=(110, 114, 126, 80)),
            )
        )
    return views


def _trajectories(drawn: Specs) -> list[rrb.View]:
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    ranges = [rrb.VisibleTimeRange(timeline, start=start, end=now) for timeline in (CLOCK, FRAME)]
    return [
        rrb.Spatial3DView(origin="/", contents=[f"+ /{spec.path}/**"], name=spec.title, time_ranges=ranges)
        for spec in _at(drawn, Panel.TRAJECTORY)
    ]


def _maps(drawn: Specs) -> _Part | None:
    reliefs, layers = _flat_views(drawn, Panel.RELIEF), _flat_views(drawn, Panel.LAYER)
    maps, reasons = _flat_views(drawn, Panel.MAP), _flat_views(drawn, Panel.REASON)
    return _held(rrb.Vertical, [_tabs([*reliefs, *layers]), _tabs([*maps, *reasons])])


def _plot(specs: Iterable[ViewSpec], title: str, **options: Any) -> rrb.View | None:
    """The numbers of these specs over time."""
    contents = [f"+ /{spec.path}/**" for spec in specs]
    options = {"plot_legend": rrb.PlotLegend("LeftTop")} | options
    return rrb.TimeSeriesView(origin="/", contents=contents, name=title, **options) if contents else None


def _panel(drawn: Specs, panel: Panel, title: str, in_tab: bool) -> _Part | None:
    """The numbers of a panel over time."""
    return _named(_at(drawn, panel), title, f"{CURVES}/{panel.name}", in_tab)


def _named(specs: Iterable[ViewSpec], title: str, names_at: str, in_tab: bool) -> _Part | None:
    """Numbers over time, with the names of the curves in their colours beside them, where they hide none."""
    plot = _plot(specs, title, plot_legend=_HIDDEN, titlebar=not in_tab)
    if plot is None:
        return None
    bounds = rrb.VisualBounds2D(x_range=(-1.5, 1.5), y_range=(-0.7, 4.7))
    names = rrb.Spatial2DView(origin=names_at, titlebar=False, visual_bounds=bounds)
    return rrb.Horizontal(plot, names, column_shares=[5, 2] if in_tab else [4, 1], name=title)


def _below(drawn: Specs, slowest: Sequence[str]) -> _Part:
    """Plots of stage times, queues, angles and own numbers; the ledger with the run's summary behind it."""
    sensors = (_panel(drawn, panel, title, in_tab=True) for panel, title in SENSOR_PLOTS)
    plots = [_tabs(part for group in _stage_plots(drawn, slowest) for part in group), _tabs(sensors)]
    ledger, *texts = _texts(drawn)
    text = rrb.Tabs(ledger, _summary(), *texts, active_tab=0)
    below = _row((plots[0], 2.0), (plots[1], 2.0), (_tabs(_own_plots(drawn)), 1.2), (text, 2.5))
    return text if below is None else below


def _stage_plots(drawn: Specs, slowest: Sequence[str]) -> list[list[_Part]]:
    """The times of the slowest stages and those of all stages; and their queues."""
    plots: list[list[_Part]] = []
    named = [spec for spec in _at(drawn, Panel.STAGE) if spec.stream == SECONDS and spec.title in slowest]
    for root, title in ((SECONDS, "time of stages and sinks (s)"), (QUEUES, "queue depth (frames)")):
        lines = sum(spec.stream == root for spec in _at(drawn, Panel.STAGE))
        few = lines <= MAX_LEGEND_LINES
        if lines:
            name = title if few else f"{title}: hover for names"
            every = rrb.TimeSeriesView(origin=root, name=name, plot_legend=rrb.PlotLegend("LeftTop", visible=few))
            first = None
            if root == SECONDS and not few:
                first = _named(named, "slowest stages and sinks (s)", SLOWEST, in_tab=True)
            plots.append([every] if first is None else [first, every])
    return plots


def _texts(drawn: Specs) -> list[rrb.View]:
    """The ledger, a line for each frame, and own texts."""
    shown = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(CLOCK, visible=False), TimelineColumn(FRAME)],
        text_log_columns=[TextLogColumnKind.LogLevel, TextLogColumnKind.Body],
    )
    texts = [(LEDGER, LEDGER), (FRAMES, FRAMES), *((spec.path, spec.title) for spec in _at(drawn, Panel.OWN_TEXT))]
    return [rrb.TextLogView(origin=path, name=title, columns=shown) for path, title in texts]


def _ledger(drawn: Specs) -> rrb.View:
    return _texts(drawn)[0]


def _summary() -> rrb.View:
    return rrb.TextDocumentView(origin=SUMMARY, name="run")


def _own_plots(drawn: Specs) -> list[rrb.View | None]:
    """For each stream of own numbers a plot; arrays of them as bar charts and tensors."""
    own = _at(drawn, Panel.OWN_NUMBER)
    streams = dict.fromkeys(spec.stream for spec in own)
    return [
        *(_plot([spec for spec in own if spec.stream == stream], stream) for stream in streams),
        *(rrb.BarChartView(origin=spec.path, name=spec.title) for spec in _at(drawn, Panel.OWN_BARS)),
        *(rrb.TensorView(origin=spec.path, name=spec.title) for spec in _at(drawn, Panel.OWN_TENSOR)),
    ]
