"""The debugging desk: how the pictures of a recording are laid out in the rerun viewer.

Images on the left in the order of the method, space in the middle, maps on the right, time and the ledger below. Its
one trick: the layout is made from the pictures that were really drawn, so no view is ever empty.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, auto

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumnKind, TimelineColumn

from stages.data import LEVEL_FRAME

CLOCK = "log clock"  # the timeline of the frames' own stamps
FRAME = "frame"  # the timeline that counts frames

LEDGER, SUMMARY, SECONDS, QUEUES = "ledger", "summary", "seconds", "queues"
LEGEND_LINES = 4  # of a plot; the legend of more would hide the plot

Places = tuple["ViewSpec", ...]
_View = rrb.Spatial2DView | rrb.Spatial3DView | rrb.TimeSeriesView | rrb.TextLogView | rrb.TextDocumentView
_Part = _View | rrb.Tabs | rrb.Vertical | rrb.Horizontal | rrb.Grid


class Panel(Enum):
    """The places of the desk."""

    LEFT = auto()
    RIGHT = auto()
    LEFT_DERIVED = auto()  # images that no camera took so: half as large, say
    RIGHT_DERIVED = auto()
    DISPARITY = auto()
    SUPERPIXELS = auto()
    SOURCE = auto()
    CLOUD = auto()
    VOXELS = auto()
    TERRAIN = auto()
    CAMERA = auto()
    TRAJECTORY = auto()
    RELIEF = auto()
    LAYER = auto()
    MAP = auto()
    REASON = auto()
    ANGLE = auto()
    HEALTH = auto()
    MATCHES = auto()
    FEATURES = auto()
    STAGE = auto()


@dataclass(frozen=True)
class ViewSpec:
    """Where a picture hangs: its panel, its entity, the title of its view, and for pictures in space their frame."""

    panel: Panel
    path: str
    title: str
    frame_id: str = LEVEL_FRAME

    @property
    def stream(self) -> str:
        """What hangs there: the path begins with it."""
        return self.path.partition("/")[0]


def blueprint(hung: Iterable[ViewSpec]) -> rrb.Blueprint:
    """The blueprint for the pictures that hang so far, in the order in which they were first hung."""
    drawn = tuple(hung)
    columns: list[tuple[_Part, float]] = []
    for part, share in ((_images(drawn), 6.4), (_space(drawn), 5.6), (_maps(drawn), 4.0)):
        if part is not None:
            columns.append((part, share))
    below = _below(drawn)
    if not columns:
        body: _Part = below
    else:
        above = rrb.Horizontal(*[part for part, _ in columns], column_shares=[share for _, share in columns])
        body = rrb.Vertical(above, below, row_shares=[3.1, 1.0])
    return rrb.Blueprint(body, rrb.TimePanel(state="collapsed", timeline=CLOCK), collapse_panels=True)


def _at(drawn: Places, *panels: Panel) -> list[ViewSpec]:
    return [place for place in drawn if place.panel in panels]


def _tabs(views: Iterable[_Part | None]) -> _Part | None:
    """One view as it stands, several as tabs of which the first is shown; None for none."""
    parts = [view for view in views if view is not None]
    if len(parts) < 2:
        return parts[0] if parts else None
    return rrb.Tabs(*parts, active_tab=0)


def _stack(parts: Iterable[_Part | None]) -> _Part | None:
    present = [part for part in parts if part is not None]
    return rrb.Vertical(*present) if len(present) > 1 else (present[0] if present else None)


def _pictures(drawn: Places, *panels: Panel) -> list[_View]:
    """The pictures of these panels; streams of which two would have tabs of one name put their own before it."""
    places = _at(drawn, *panels)
    streams: dict[str, set[str]] = {}
    for place in places:
        streams.setdefault(place.title, set()).add(place.stream)
    alike = {stream for sharing in streams.values() if len(sharing) > 1 for stream in sharing}
    return [
        rrb.Spatial2DView(
            origin=place.path, name=f"{place.stream}: {place.title}" if place.stream in alike else place.title
        )
        for place in places
    ]


def _images(drawn: Places) -> _Part | None:
    """Two columns: left and right image; last disparity but one and last; superpixels and where each disparity comes
    from.

    Of several stereo streams the last that a camera took so (the rectified one) is shown, of other streams the last;
    the others are tabs behind it.
    """
    left, right = _pictures(drawn, Panel.LEFT), _pictures(drawn, Panel.RIGHT)
    disparities = _pictures(drawn, Panel.DISPARITY)
    parts = [
        _tabs([*reversed(left), *_pictures(drawn, Panel.LEFT_DERIVED)]),
        _tabs([*reversed(right), *_pictures(drawn, Panel.RIGHT_DERIVED)]),
        _tabs(disparities[-2::-1]),
        _tabs(disparities[-1:]),
        _tabs(reversed(_superpixels(drawn))),
        _tabs(reversed(_pictures(drawn, Panel.SOURCE))),
    ]
    present = [part for part in parts if part is not None]
    return rrb.Grid(*present, grid_columns=2) if present else None


def _superpixels(drawn: Places) -> list[_View]:
    """The superpixels' edges over the left image that was cut into them."""
    images = [f"+ /{place.path}" for place in _at(drawn, Panel.LEFT)[-1:]]
    return [
        rrb.Spatial2DView(origin="/", contents=[f"+ /{place.path}/**", *images], name=place.title)
        for place in _at(drawn, Panel.SUPERPIXELS)
    ]


def _space(drawn: Places) -> _Part | None:
    """Per frame of reference the clouds and the terrains, each with the cameras; and the trajectory so far."""
    clouds = _tabs([*_spaces(drawn, Panel.CLOUD, "cloud"), *_spaces(drawn, Panel.VOXELS, "voxels")])
    terrains = _tabs([*_spaces(drawn, Panel.TERRAIN, "terrain"), *_trajectories(drawn)])
    return _stack([clouds, terrains])


def _spaces(drawn: Places, panel: Panel, name: str) -> list[_View]:
    views: list[_View] = []
    for frame_id in sorted({place.frame_id for place in _at(drawn, panel)}, key=lambda frame: frame != LEVEL_FRAME):
        seen = [place.path for place in _at(drawn, panel, Panel.CAMERA) if place.frame_id == frame_id]
        # Behind the rover's right shoulder, looking down on the ground ahead; other frames have no such place.
        eye = rrb.EyeControls3D(position=(-2.2, -4.0, 3.5), look_target=(3.4, 0.1, -0.1), eye_up=(0, 0, 1))
        views.append(
            rrb.Spatial3DView(
                origin="/",
                contents=[f"+ /{path}/**" for path in seen],
                name=name if frame_id == LEVEL_FRAME else f"{name} ({frame_id})",
                eye_controls=eye if frame_id == LEVEL_FRAME else None,
                line_grid=rrb.LineGrid3D(spacing=1.0, stroke_width=0.4, color=(110, 114, 126, 80)),
            )
        )
    return views


def _trajectories(drawn: Places) -> list[_View]:
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    ranges = [rrb.VisibleTimeRange(timeline, start=start, end=now) for timeline in (CLOCK, FRAME)]
    return [
        rrb.Spatial3DView(origin="/", contents=[f"+ /{place.path}/**"], name=place.title, time_ranges=ranges)
        for place in _at(drawn, Panel.TRAJECTORY)
    ]


def _maps(drawn: Places) -> _Part | None:
    layers, reliefs = _pictures(drawn, Panel.LAYER), _pictures(drawn, Panel.RELIEF)
    reasons, maps = _pictures(drawn, Panel.REASON), _pictures(drawn, Panel.MAP)
    return _stack([_tabs([*reliefs, *layers]), _tabs([*maps, *reasons])])


def _series(drawn: Places, panel: Panel, title: str) -> _View | None:
    """What hangs in a panel, over time."""
    contents = [f"+ /{place.path}/**" for place in _at(drawn, panel)]
    legend = rrb.PlotLegend("LeftTop")
    return rrb.TimeSeriesView(origin="/", contents=contents, name=title, plot_legend=legend) if contents else None


def _below(drawn: Places) -> _Part:
    """Stage times, queues and angles over time, and the ledger with the run's summary behind it."""
    plots: list[_Part] = []
    shares: list[float] = []
    for root, title in ((SECONDS, "stage time (s)"), (QUEUES, "queue depth (frames)")):
        lines = sum(place.stream == root for place in _at(drawn, Panel.STAGE))
        few = lines <= LEGEND_LINES
        if lines:
            name = title if few else f"{title}: hover for names"
            plots.append(rrb.TimeSeriesView(origin=root, name=name, plot_legend=rrb.PlotLegend("LeftTop", visible=few)))
            shares.append(1.4)
    panels = (
        (Panel.ANGLE, "tilt (degrees)"),
        (Panel.HEALTH, "tilt check (degrees)"),
        (Panel.MATCHES, "matched (%)"),
        (Panel.FEATURES, "odometry"),
    )
    angles = _tabs((_series(drawn, panel, title) for panel, title in panels))
    if angles is not None:
        plots.append(angles)
        shares.append(1.1)
    shown = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(CLOCK, visible=False), TimelineColumn(FRAME)],
        text_log_columns=[TextLogColumnKind.LogLevel, TextLogColumnKind.Body],
    )
    log = rrb.TextLogView(origin=LEDGER, name="ledger", columns=shown)
    text = rrb.Tabs(log, rrb.TextDocumentView(origin=SUMMARY, name="run"), active_tab=0)
    return rrb.Horizontal(*plots, text, column_shares=[*shares, 2.0])
