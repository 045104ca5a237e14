"""The rerun blueprint: how the views of a recording are laid out in the viewer.

Images are at the left in the order of the method, 3-D views in the middle, maps at the right, plots and the ledger
below. Its one trick: the layout is made from the entities that were really logged, so no view is ever empty.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumnKind, TimelineColumn

from stages.data import LEVEL_FRAME

CLOCK = "log clock"  # the timeline of the frames' stamps
FRAME = "frame"  # the timeline that counts frames

LEDGER, FRAMES, SUMMARY, SECONDS, QUEUES = "ledger", "frames", "summary", "seconds", "queues"
MAX_LEGEND_LINES = 4  # the legend of more lines would hide the plot

Specs = tuple["ViewSpec", ...]
_Part = rrb.View | rrb.Container


# The places of the layout. Derived images have another size than the camera's; OWN_... are of the user's own types.
Panel = Enum(
    "Panel",
    "LEFT RIGHT LEFT_DERIVED RIGHT_DERIVED DISPARITY SUPERPIXELS SOURCE SIGMA CLOUD VOXELS TERRAIN CAMERA TRAJECTORY "
    "RELIEF LAYER MAP REASON ANGLE HEALTH MATCHES FEATURES STAGE OWN_IMAGE OWN_NUMBER OWN_TEXT OWN_BARS OWN_TENSOR",
)


@dataclass(frozen=True)
class ViewSpec:
    """What a view shows: the entity `part` of a stream, in a panel, under a title.

    frame_id is the frame of reference of 3-D entities.
    """

    panel: Panel
    stream: str
    part: str
    title: str
    frame_id: str = LEVEL_FRAME

    @property
    def path(self) -> str:
        """The entity's path."""
        return f"{self.stream}/{self.part}" if self.part else self.stream


def blueprint(views: Iterable[ViewSpec], slowest: Sequence[str] = ()) -> rrb.Blueprint:
    """The layout of the entities logged so far, in the order in which each was first logged.

    slowest: the stages whose times are plotted with their names.
    """
    drawn = tuple(views)
    columns: list[tuple[_Part, float]] = []
    for part, share in ((_images(drawn), 6.4), (_space(drawn), 5.6), (_maps(drawn), 4.0)):
        if part is not None:
            columns.append((part, share))
    below = _below(drawn, slowest)
    if not columns:
        body: _Part = below
    else:
        above = rrb.Horizontal(*[part for part, _ in columns], column_shares=[share for _, share in columns])
        body = rrb.Vertical(above, below, row_shares=[3.1, 1.0])
    return rrb.Blueprint(body, rrb.TimePanel(state="collapsed", timeline=CLOCK), collapse_panels=True)


def _at(drawn: Specs, *panels: Panel) -> list[ViewSpec]:
    return [spec for spec in drawn if spec.panel in panels]


def _tabs(views: Iterable[_Part | None]) -> _Part | None:
    """Several views as tabs, the first one shown; a single view as it is; None for none."""
    parts = [view for view in views if view is not None]
    if len(parts) < 2:
        return parts[0] if parts else None
    return rrb.Tabs(*parts, active_tab=0)


def _stack(parts: Iterable[_Part | None]) -> _Part | None:
    present = [part for part in parts if part is not None]
    return rrb.Vertical(*present) if len(present) > 1 else (present[0] if present else None)


def _flat_views(drawn: Specs, *panels: Panel) -> list[rrb.View]:
    """The 2-D views of these panels; a title that two streams share is preceded by the stream's name."""
    specs = _at(drawn, *panels)
    streams: dict[str, set[str]] = {}
    for spec in specs:
        streams.setdefault(spec.title, set()).add(spec.stream)
    ambiguous = {stream for sharing in streams.values() if len(sharing) > 1 for stream in sharing}
    return [
        rrb.Spatial2DView(
            origin=spec.path, name=f"{spec.stream}: {spec.title}" if spec.stream in ambiguous else spec.title
        )
        for spec in specs
    ]


def _images(drawn: Specs) -> _Part | None:
    """Two columns: left and right image, two disparities, superpixels, origin of each disparity, and own images.

    Of several stereo streams the last one of the camera's size is shown (the rectified one), of other streams the last.
    The others are tabs behind it. The last disparity has a view of its own beside the tabs of the earlier ones.
    """
    left, right = _flat_views(drawn, Panel.LEFT), _flat_views(drawn, Panel.RIGHT)
    disparities = _flat_views(drawn, Panel.DISPARITY)
    parts = [
        _tabs([*reversed(left), *_flat_views(drawn, Panel.LEFT_DERIVED)]),
        _tabs([*reversed(right), *_flat_views(drawn, Panel.RIGHT_DERIVED)]),
        _tabs(disparities[-2::-1]),
        _tabs(disparities[-1:]),
        _tabs(reversed(_superpixels(drawn))),
        _tabs([*reversed(_flat_views(drawn, Panel.SOURCE)), *_flat_views(drawn, Panel.SIGMA)]),
        _tabs(_flat_views(drawn, Panel.OWN_IMAGE)),
    ]
    present = [part for part in parts if part is not None]
    return rrb.Grid(*present, grid_columns=2) if present else None


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
    return _stack([clouds, terrains])


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
    return _stack([_tabs([*reliefs, *layers]), _tabs([*maps, *reasons])])


def _plot(specs: Iterable[ViewSpec], title: str) -> rrb.View | None:
    """The numbers of these specs over time."""
    contents = [f"+ /{spec.path}/**" for spec in specs]
    legend = rrb.PlotLegend("LeftTop")
    return rrb.TimeSeriesView(origin="/", contents=contents, name=title, plot_legend=legend) if contents else None


def _below(drawn: Specs, slowest: Sequence[str]) -> _Part:
    """Plots of stage times, queues, angles and own numbers; the ledger with the run's summary behind it."""
    plots: list[_Part] = []
    shares: list[float] = []
    named = [spec for spec in _at(drawn, Panel.STAGE) if spec.stream == SECONDS and spec.title in slowest]
    for root, title in ((SECONDS, "stage time (s)"), (QUEUES, "queue depth (frames)")):
        lines = sum(spec.stream == root for spec in _at(drawn, Panel.STAGE))
        few = lines <= MAX_LEGEND_LINES
        if lines:
            name = title if few else f"{title}: hover for names"
            every = rrb.TimeSeriesView(origin=root, name=name, plot_legend=rrb.PlotLegend("LeftTop", visible=few))
            first = _plot(named, "slowest stages (s)") if root == SECONDS and not few else None
            plots.append(_tabs([first, every]) or every)
            shares.append(1.4)
    panels = (
        (Panel.ANGLE, "tilt (degrees)"),
        (Panel.HEALTH, "tilt check (degrees)"),
        (Panel.MATCHES, "matched (%)"),
        (Panel.FEATURES, "odometry"),
    )
    for tabs in (_tabs(_plot(_at(drawn, panel), title) for panel, title in panels), _tabs(_own_plots(drawn))):
        if tabs is not None:
            plots.append(tabs)
            shares.append(1.1)
    shown = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(CLOCK, visible=False), TimelineColumn(FRAME)],
        text_log_columns=[TextLogColumnKind.LogLevel, TextLogColumnKind.Body],
    )
    texts = [(LEDGER, LEDGER), (FRAMES, FRAMES), *((spec.path, spec.title) for spec in _at(drawn, Panel.OWN_TEXT))]
    logs = [rrb.TextLogView(origin=path, name=title, columns=shown) for path, title in texts]
    text = rrb.Tabs(logs[0], rrb.TextDocumentView(origin=SUMMARY, name="run"), *logs[1:], active_tab=0)
    return rrb.Horizontal(*plots, text, column_shares=[*shares, 2.0])


def _own_plots(drawn: Specs) -> list[rrb.View | None]:
    """For each stream of own numbers a plot; arrays of them as bar charts and tensors."""
    own = _at(drawn, Panel.OWN_NUMBER)
    streams = dict.fromkeys(spec.stream for spec in own)
    return [
        *(_plot([spec for spec in own if spec.stream == stream], stream) for stream in streams),
        *(rrb.BarChartView(origin=spec.path, name=spec.title) for spec in _at(drawn, Panel.OWN_BARS)),
        *(rrb.TensorView(origin=spec.path, name=spec.title) for spec in _at(drawn, Panel.OWN_TENSOR)),
    ]
