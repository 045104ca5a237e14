"""What each type of `stages.data` looks like in a rerun recording: one function per type, registered with `@draws`.

A picture that takes several types names them all. Its one trick: a canvas remembers what hangs where, and clears what a
frame lacks in that frame's time step, so the viewer never shows the last frame's picture as this frame's.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from flow.contracts import counted
from recordings.scoring.metrics import cell_centres
from recordings.sinks import colormaps as paint
from recordings.sinks.blueprint import LEDGER, Panel, ViewSpec
from recordings.sinks.png16 import png16
from stages.data import (
    LEVEL_FRAME,
    Array,
    CameraMotion,
    Cell,
    Disparity,
    ElevationMap,
    MatchHealth,
    NavigationMap,
    PixelOrigin,
    PointCloud,
    Pose,
    StereoCamera,
    StereoFrame,
    Tilt,
    TiltHealth,
    VoxelMap,
    known,
)

DISPARITY_STEPS = 8  # disparities are kept to 1/8 px: four fifths of the size that 1/16 px takes
LIFT = 0.03  # m; hazards float that far above the ground, so that the surface does not swallow them
LINE_SPACING = 2  # m, between the lines across a map
AMBER: paint.Rgb = (255, 210, 60)
TEXT: paint.Rgb = (225, 228, 235)
CURVES: tuple[paint.Rgb, ...] = ((255, 210, 60), (95, 175, 255), (245, 120, 95), (125, 215, 140), (205, 145, 245))
THUMBNAIL = 0.25  # size of the image in the camera's frustum

Draw = Callable[..., str | None]
PICTURES: dict[tuple[type, ...], Draw] = {}


def draws(*kinds: type) -> Callable[[Draw], Draw]:
    """Register a picture: `draw(canvas, path, item, ...)` logs items of these types under `path`, and may say in a few
    words what it saw. A picture of one type is drawn for every stream of it; one of several types once for every frame
    of reference, from the last stream of each, under the path of the first."""

    def register(draw: Draw) -> Draw:
        PICTURES[kinds] = draw
        return draw

    return register


@dataclass(eq=False)
class Canvas:
    """Where pictures go: one recording, whose clocks stand at one frame.

    What frames have in common, as a legend, is logged where it changes only (`keep`): that saves half of all the calls.
    hung: every place that ever had a picture, in the order of hanging; the desk is made from it; camera: of the first
    frame, by which a pair at half size, say, is told from the pair itself.
    """

    recording: rr.RecordingStream
    jpeg_quality: int
    max_points: int
    hung: dict[tuple[Panel, str], ViewSpec] = field(default_factory=dict)
    camera: StereoCamera | None = None
    _curves: dict[Panel, list[str]] = field(default_factory=dict)
    _said: dict[str, str] = field(default_factory=dict)
    _legends: dict[str, Mapping[int, tuple[str, paint.Rgb]]] = field(default_factory=dict)
    _kept: dict[str, Hashable] = field(default_factory=dict)
    _before: dict[str, type] = field(default_factory=dict)
    _now: dict[str, type] = field(default_factory=dict)

    def log(self, path: str, archetype: Any, *places: ViewSpec) -> None:
        """Log at the frame's time; `places` are where the desk shall show it."""
        self.recording.log(path, archetype)
        self._now[path] = type(archetype)
        for place in places:
            self.add_view(place)

    def add_view(self, place: ViewSpec) -> None:
        """Have the desk show what is logged there."""
        self.hung.setdefault((place.panel, place.path), place)

    def keep(self, path: str, content: Hashable, draw: Callable[[], Any]) -> None:
        """Log what `draw()` makes, unless it hangs there since the frame before and has the same `content`."""
        if path in self._before and self._kept.get(path) == content:
            self._now[path] = self._before[path]
        else:
            self._kept[path] = content
            self.log(path, draw())

    def curve(self, path: str, name: str, value: float, place: ViewSpec) -> None:
        """A value over time; the first five curves of a panel differ in colour."""
        at, drawn = f"{path}/{rr.escape_entity_path_part(name)}", self._curves.setdefault(place.panel, [])
        if at not in drawn:
            self.recording.log(at, rr.SeriesLines(colors=[CURVES[len(drawn) % len(CURVES)]]), static=True)
            drawn.append(at)
        self.log(at, rr.Scalars(float(value)), place)

    def say(self, path: str, text: str, level: rr.TextLogLevel) -> None:
        """A line in the ledger, where it is not what `path` said last."""
        if self._said.get(path) != text:
            self._said[path] = text
            self.recording.log(f"{LEDGER}/{path}", rr.TextLog(text, level=level))

    def log_image(self, path: str, pixels: Array, place: ViewSpec) -> None:
        """An image (H, W) gray or (H, W, 3) RGB, 8 bit, as JPEG."""
        stored = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
        _, blob = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        self.log(path, rr.EncodedImage(contents=blob, media_type="image/jpeg"), place)

    def labels(self, path: str, codes: Array, legend: Mapping[int, tuple[str, paint.Rgb]], place: ViewSpec) -> None:
        """A label image (H, W); its names stand above it and appear on hover."""
        if self._legends.get(path) != legend:
            self._legends[path] = legend
            names = [rr.AnnotationInfo(id=code & 0xFF, label=name, color=rgb) for code, (name, rgb) in legend.items()]
            self.recording.log(path, rr.AnnotationContext(names), static=True)
        self.log(f"{path}/labels", rr.SegmentationImage(codes.astype(np.uint8)), place)
        self.legend(f"{path}/legend", codes.shape, legend.values())

    def scale(self, path: str, shape: tuple[int, ...], low: float, high: float, unit: str, palette: int) -> None:
        """The legend of a colour map: three of its values above the picture."""
        self.legend(path, shape, _scale(low, high, unit, palette))

    def legend(self, path: str, shape: tuple[int, ...], entries: Iterable[tuple[str, paint.Rgb]]) -> None:
        """Named dots above a picture of (H, W)."""
        height, width = shape
        content = shape, *entries
        names, colours = zip(*content[1:], strict=True)
        dots = [((place + 0.5) * width / len(names), -0.14 * height) for place in range(len(names))]
        round_dot, pin = rr.Radius.ui_points(5.0), rr.Radius.ui_points(0.5)
        self.keep(path, content, lambda: rr.Points2D(dots, colors=colours, radii=round_dot, draw_order=30.0))
        # A label takes its dot's colour, which may be as dark as the desk: the text hangs on dots of its own.
        texts: dict[str, Any] = {"labels": names, "show_labels": True, "radii": pin, "draw_order": 31.0}
        self.keep(f"{path}/text", content, lambda: rr.Points2D(dots, colors=[TEXT], **texts))

    def clear_the_rest(self) -> None:
        """Take down what hung in the frame before and was not drawn again."""
        for path, kind in self._before.items():
            if path in self._now:
                continue
            if issubclass(kind, rr.EncodedImage | rr.EncodedDepthImage):
                # Cleared, it would go on being shown (rerun-io/rerun#12793); without bytes it is not.
                self.recording.log(path, kind.from_fields(clear_unset=True))
            else:
                self.recording.log(path, rr.Clear(recursive=False))
        self._before, self._now = self._now, {}


@lru_cache(maxsize=256)
def _scale(low: float, high: float, unit: str, palette: int) -> tuple[tuple[str, paint.Rgb], ...]:
    """Three values of a colour map, with their colours."""
    values = np.linspace(low, high, 3)
    colours = [(int(r), int(g), int(b)) for r, g, b in paint.colours(values, low, high, palette)]
    return tuple((f"{paint.figure(value)} {unit}", colour) for value, colour in zip(values, colours, strict=True))


def same_view(one: StereoCamera, other: StereoCamera) -> bool:
    """Whether both left cameras see alike, rectified or not: one at half size, say, does not."""
    return all(getattr(one, name) == getattr(other, name) for name in ("width", "height", "cx"))


@draws(StereoFrame)
def draw_stereo(canvas: Canvas, path: str, frame: StereoFrame) -> None:
    """Both images."""
    canvas.camera = canvas.camera or frame.camera
    own = same_view(frame.camera, canvas.camera)
    left, right = (Panel.LEFT, Panel.RIGHT) if own else (Panel.LEFT_DERIVED, Panel.RIGHT_DERIVED)
    pixels = paint.top_eight_bits(frame.left, frame.right)
    canvas.log_image(f"{path}/left", pixels[0], ViewSpec(left, f"{path}/left", f"{path}: left"))
    canvas.log_image(f"{path}/right", pixels[1], ViewSpec(right, f"{path}/right", f"{path}: right"))


@draws(Disparity)
def draw_disparity(canvas: Canvas, path: str, disparity: Disparity) -> str:
    """The disparities (hover reads them in px), where each comes from, and the superpixels' edges."""
    # Rounded; NaN and what is below 0 becomes 0.
    steps: Array = cv2.multiply(disparity.pixels, DISPARITY_STEPS, dtype=cv2.CV_16U)  # type: ignore[call-overload]
    blob = png16(steps)
    limit = paint.disparity_limit(disparity.pixels)
    image = rr.EncodedDepthImage(
        blob, media_type="image/png", meter=DISPARITY_STEPS, colormap=rr.components.Colormap.Turbo,
        depth_range=(0.0, limit * DISPARITY_STEPS),
    )  # fmt: skip
    canvas.log(f"{path}/pixels", image, ViewSpec(Panel.DISPARITY, f"{path}/pixels", path))
    canvas.scale(f"{path}/pixels/scale", steps.shape, 0.0, limit, "px", cv2.COLORMAP_TURBO)
    share_known = _percent(known(disparity.source))
    shares = {kind: _percent(disparity.source == kind) for kind in (PixelOrigin.PLANE, PixelOrigin.FILLED)}
    made = {kind: share for kind, share in shares.items() if share}
    if made:  # else it is measured wherever it is known
        source = ViewSpec(Panel.SOURCE, f"{path}/source", f"{path}: source")
        canvas.labels(f"{path}/source", disparity.source, paint.SOURCES, source)
    if disparity.segments is not None:
        edges = paint.segment_edges(disparity.segments).astype(np.uint8) * 255
        _, lines = cv2.imencode(".png", edges, [cv2.IMWRITE_PNG_BILEVEL, 1])
        overlay = rr.EncodedImage(contents=lines, media_type="image/png", opacity=0.4, draw_order=10.0)
        place = ViewSpec(Panel.SUPERPIXELS, f"{path}/superpixels", f"{path}: superpixels")
        canvas.log(place.path, overlay, place)
    parts = (f"{share:.0f} % {kind.name.lower()}" for kind, share in made.items())
    return f"{path} {', '.join([f'{share_known:.0f} % known', *parts])}"


@draws(PointCloud)
def draw_cloud(canvas: Canvas, path: str, cloud: PointCloud) -> str:
    """Every n-th point, where the cloud knows its sensor's place: the camera's own frame is nowhere in level space."""
    if cloud.sensor is not None:
        some = slice(None, None, max(1, -(-len(cloud.points) // canvas.max_points)))
        points = rr.Points3D(cloud.points[some], colors=cloud.colors[some], radii=rr.Radius.ui_points(1.5))
        canvas.log(f"{path}/points", points, ViewSpec(Panel.CLOUD, f"{path}/points", path, cloud.frame_id))
        # An optical axis (z) below the horizon is pitch down, the image's right side (x) below it roll to the right.
        for name, axis in (("camera pitch down", 2), ("camera roll right", 0)):
            angle = float(np.degrees(np.arcsin(np.clip(-cloud.sensor.rotation[2, axis], -1.0, 1.0))))
            canvas.curve(path, name, angle, ViewSpec(Panel.ANGLE, path, path))
    return f"{path} {counted(len(cloud.points), 'point')}"


@draws(VoxelMap)
def draw_voxels(canvas: Canvas, path: str, voxels: VoxelMap) -> str:
    """The cubes, each in its mean colour, as many as the canvas shows points at most."""
    some = slice(None, None, max(1, -(-len(voxels.index) // canvas.max_points)))
    centres = (voxels.index[some] + np.float32(0.5)) * np.float32(voxels.resolution)
    half = np.full((1, 3), voxels.resolution / 2, np.float32)
    boxes = rr.Boxes3D(centers=centres, half_sizes=np.broadcast_to(half, centres.shape), colors=voxels.colors[some],
                       fill_mode=rr.components.FillMode.Solid)  # fmt: skip
    canvas.log(f"{path}/voxels", boxes, ViewSpec(Panel.VOXELS, f"{path}/voxels", path, voxels.frame_id))
    return f"{path} {len(voxels.index)} voxels"


@draws(Tilt)
def draw_tilt(canvas: Canvas, path: str, tilt: Tilt) -> None:
    """The angles of the inclinometer's axes to the horizon, up positive, in degrees."""
    for name, along in (("x axis up", tilt.up[0]), ("y axis up", tilt.up[1])):
        angle = float(np.degrees(np.arcsin(np.clip(along, -1.0, 1.0))))
        canvas.curve(path, name, angle, ViewSpec(Panel.ANGLE, path, path))


@draws(Pose)
def draw_pose(canvas: Canvas, path: str, pose: Pose) -> None:
    """An arrow along the rover's heading; the desk shows those of all frames so far."""
    forward = Rotation.from_quat(pose.quaternion).apply([0.4, 0.0, 0.0])
    arrow = rr.Arrows3D(origins=[pose.position], vectors=[forward], colors=[AMBER])
    place = ViewSpec(Panel.TRAJECTORY, f"{path}/trajectory", f"{path} ({pose.frame_id})", pose.frame_id)
    canvas.log(place.path, arrow, place)


@draws(CameraMotion)
def draw_motion(canvas: Canvas, path: str, motion: CameraMotion) -> str:
    """How many features the camera was tracked by."""
    canvas.curve(path, "features", motion.inliers, ViewSpec(Panel.FEATURES, path, path))
    return f"{path}: {motion.lost}" if motion.lost else f"{path} {counted(motion.inliers, 'feature')}"


@draws(MatchHealth)
def draw_matches(canvas: Canvas, path: str, health: MatchHealth) -> None:
    """How much is matched, in percent: of all pixels, and of the nearest ground."""
    for name, part in (("all", health.all), ("near", health.near)):
        canvas.curve(path, name, 100 * part, ViewSpec(Panel.MATCHES, path, path))


@draws(TiltHealth)
def draw_health(canvas: Canvas, path: str, health: TiltHealth) -> str:
    """Tilt against the camera's own turns and against the ground in view, in degrees; what is wrong, in words."""
    for name, angle in (("tilt off turn", health.turn), ("ground off level", health.ground)):
        if np.isfinite(angle):
            canvas.curve(path, name, np.degrees(angle), ViewSpec(Panel.HEALTH, path, path))
    canvas.say(path, health.judgement, rr.TextLogLevel.WARN if health.fault else rr.TextLogLevel.INFO)
    return f"{path}: {health.fault}" if health.fault else ""


@draws(ElevationMap)
def draw_terrain(canvas: Canvas, path: str, terrain: ElevationMap) -> str:
    """Shaded relief, the surface in space, and of a frame's own map every layer with its values (hover reads them);
    those of the region are in the result log."""
    terrain = paint.terrain_ahead(terrain)
    elevation, where = terrain.layers["elevation"], _frame_suffix(terrain.frame_id)
    low, high = paint.elevation_limits(elevation)
    rgb = paint.paint_elevation(terrain, (low, high))
    relief = f"{path}/relief"
    canvas.log(relief, rr.Image(paint.birds_eye(rgb)), ViewSpec(Panel.RELIEF, relief, f"relief{where}"))
    canvas.scale(f"{relief}/scale", terrain.shape[::-1], low, high, "m", cv2.COLORMAP_VIRIDIS)
    _lines_ahead(canvas, f"{relief}/lines", terrain.shape, terrain)
    for name, layer in terrain.layers.items() if terrain.frame_id == LEVEL_FRAME else ():
        start, end = paint.value_limits(layer)
        image = rr.DepthImage(
            paint.birds_eye(layer.astype(np.float16)), meter=1.0, colormap=rr.components.Colormap.Turbo,
            depth_range=(start - 0.1 * (end - start), end),  # the palette's darkest end is left to unknown cells
        )  # fmt: skip
        place = ViewSpec(Panel.LAYER, f"{path}/layers/{rr.escape_entity_path_part(name)}", f"{name}{where}")
        canvas.log(place.path, image, place)
    vertices, triangles = paint.surface(terrain)
    if len(triangles):
        known = np.isfinite(elevation)
        mesh = rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, vertex_colors=rgb[known])
        canvas.log(f"{path}/surface", mesh, ViewSpec(Panel.TERRAIN, f"{path}/surface", path, terrain.frame_id))
    return f"{path} {counted(len(vertices), 'cell')}"


@draws(NavigationMap)
def draw_navigation(canvas: Canvas, path: str, navigation: NavigationMap) -> str:
    """The three states of the cells, and their reasons."""
    navigation = paint.navigation_ahead(navigation)
    cells, where = paint.birds_eye(navigation.cells), _frame_suffix(navigation.frame_id)
    canvas.labels(f"{path}/cells", cells, paint.CELLS, ViewSpec(Panel.MAP, f"{path}/cells", f"navigation{where}"))
    _lines_ahead(canvas, f"{path}/cells/lines", navigation.cells.shape, navigation)
    place = ViewSpec(Panel.REASON, f"{path}/reason", f"reason{where}")
    canvas.labels(place.path, paint.birds_eye(navigation.reason), paint.REASONS, place)
    free, hazard = (int(np.count_nonzero(cells == state)) for state in (Cell.FREE, Cell.HAZARD))
    return f"{path} {free} free, {hazard} hazard"


@draws(StereoFrame, PointCloud)
def draw_camera(canvas: Canvas, path: str, frame: StereoFrame, cloud: PointCloud) -> None:
    """The left image, small, in its frustum, where the cloud was seen from, and a plumb line to the ground plane."""
    camera, sensor = frame.camera, cloud.sensor
    if sensor is None:
        return
    small = cv2.resize(
        paint.top_eight_bits(frame.left, frame.right)[0], None, fx=THUMBNAIL, fy=THUMBNAIL, interpolation=cv2.INTER_AREA
    )
    height, width = small.shape[:2]
    at, line = f"{path}/camera", f"{path}/plumb"
    canvas.log_image(f"{at}/image", small, ViewSpec(Panel.CAMERA, at, path, cloud.frame_id))
    pinhole = rr.Pinhole(
        focal_length=(camera.fx * THUMBNAIL, camera.fy * THUMBNAIL), width=width, height=height, color=AMBER,
        principal_point=((camera.cx + 0.5) * THUMBNAIL - 0.5, (camera.cy + 0.5) * THUMBNAIL - 0.5),
        camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.7,
    )  # fmt: skip
    # Not the canvas's: a frame without a camera clears the image; the empty frustum may stay where it was last known.
    canvas.recording.log(at, rr.Transform3D(translation=sensor.translation, mat3x3=sensor.rotation), pinhole)
    plumb = [sensor.translation, sensor.translation * (1.0, 1.0, 0.0)]
    strip = rr.LineStrips3D([plumb], colors=[AMBER], radii=rr.Radius.ui_points(1.0))
    canvas.log(line, strip, ViewSpec(Panel.CAMERA, line, path, cloud.frame_id))


@draws(NavigationMap, ElevationMap)
def draw_hazards(canvas: Canvas, path: str, navigation: NavigationMap, terrain: ElevationMap) -> None:
    """The hazard cells on the ground; a hazard without an elevation is only on the map."""
    if (navigation.cells.shape, navigation.frame_id) != (terrain.shape, terrain.frame_id):
        return
    elevation = terrain.layers["elevation"]
    row, col = np.nonzero((navigation.cells == Cell.HAZARD) & np.isfinite(elevation))
    if len(row):
        x, y = cell_centres(terrain)
        centres = np.column_stack([x[col], y[row], elevation[row, col] + LIFT])
        hazards = rr.Points3D(centres, colors=[paint.CELLS[Cell.HAZARD][1]], radii=0.4 * terrain.resolution)
        canvas.log(f"{path}/hazards", hazards, ViewSpec(Panel.TERRAIN, f"{path}/hazards", path, terrain.frame_id))


def _percent(layer: Array) -> float:
    """How much of it is not 0."""
    return 100.0 * np.count_nonzero(layer) / layer.size


def _frame_suffix(frame_id: str) -> str:
    return "" if frame_id == LEVEL_FRAME else f" ({frame_id})"


def _lines_ahead(canvas: Canvas, path: str, shape: tuple[int, int], grid: ElevationMap | NavigationMap) -> None:
    """Lines across a bird's-eye view at every second metre of x, with their distance, and where the rover is."""
    width, rover = float(shape[0]), _rover(grid)
    far, left = (start + count * grid.resolution for start, count in zip(grid.origin, shape[::-1], strict=True))
    first, last = np.ceil(grid.origin[0] / LINE_SPACING), np.floor(far / LINE_SPACING)
    ahead = LINE_SPACING * np.arange(first, last + 1) + 0.0  # no minus zero
    depths = (far - ahead) / grid.resolution
    lines = [[(0.0, depth), (width, depth)] for depth in depths]
    marks = [(width, depth) for depth in depths]
    names = [f"{x:.0f} m" for x in ahead]
    if rover is not None:
        spot = ((left - rover[1]) / grid.resolution, (far - rover[0]) / grid.resolution)
        marks, names = [*marks, spot], [*names, "rover"]
    content, thin, dot = (tuple(marks), tuple(names)), rr.Radius.ui_points(0.6), rr.Radius.ui_points(2.0)
    faint, white = [(255, 255, 255, 80)], [(255, 255, 255)]
    canvas.keep(path, content, lambda: rr.LineStrips2D(lines, colors=faint, radii=thin, draw_order=20.0))
    points: dict[str, Any] = {"labels": names, "show_labels": True, "colors": white, "radii": dot, "draw_order": 21.0}
    canvas.keep(f"{path}/distances", content, lambda: rr.Points2D(marks, **points))


def _rover(grid: ElevationMap | NavigationMap) -> tuple[float, float] | None:
    """Where the rover is in a grid, m: at the origin of frame `level`; None where that is not known."""
    if grid.frame_id == LEVEL_FRAME:
        return 0.0, 0.0
    level = getattr(grid, "level", None)
    return None if level is None else (float(level.translation[0]), float(level.translation[1]))
