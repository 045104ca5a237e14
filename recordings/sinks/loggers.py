"""How each type of `stages.data` looks in a rerun recording: one function per type, registered with `@logger_for`."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import rerun as rr

from flow.contracts import counted
from recordings.png import png
from recordings.sinks import colormaps
from recordings.sinks.blueprint import Panel, ViewSpec
from recordings.sinks.canvas import CAMERA_RGB, MAX_POINTS, Canvas, label_counts
from recordings.sinks.entity_rows import components_of, drawn, fields_of
from recordings.sinks.map_cropping import ahead
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
    cell_centres,
    known,
)
from stages.data.rotations import matrix_of

# Steps of drawn values: to a px of disparity, to a px of sigma, to a metre of depth; the result log has more digits
DISPARITY_STEPS, SIGMA_STEPS, DEPTH_STEPS = 4, 250, 250
POINT_STEPS = 256  # to a metre, of points and heights; a power of 2, so that their lower bits are 0
DIFFERENCE_STEPS = 0.25  # the difference of the images is drawn to 4 gray levels
MAX_DIFFERENCE = 32  # gray levels, the upper end of the scale of the images' difference
MAX_COST = 255.0  # the upper end of the scales of sums of costs, which are bytes
MAX_SIGMA = 0.5  # px, the upper end of the scale of the disparities' standard deviation
MAX_CELLS = 4000  # known ones, of a surface and of the layers of a map; a relief has all
MAX_DEPTH = 16.0  # m, the upper end of the scale of depths
MIN_DEPTH = 0.2  # m in front of the camera, of what is drawn over its image
HAZARD_LIFT = 0.03  # m above the ground at which hazards are drawn, so that the surface does not hide them
THUMBNAIL_SCALE = 0.25  # of the image in the camera's frustum
FRUSTUM = components_of(
    rr.Pinhole.from_fields(color=CAMERA_RGB, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.7)
)

Logger = Callable[..., str | None]
LOGGERS: dict[tuple[type, ...], Logger] = {}


def logger_for(*kinds: type) -> Callable[[Logger], Logger]:
    """Register `log(canvas, stream, item, ...)`, which logs items of these types under `stream`.

    It may return a caption of a few words. A logger of one type is called for every stream of that type. A logger of
    several types is called once for every frame of reference, with the last stream of each type, under the first one.
    """

    def register(log: Logger) -> Logger:
        LOGGERS[kinds] = log
        return log

    return register


def same_view(one: StereoCamera, other: StereoCamera) -> bool:
    """Whether both left cameras have the same image size and centre, rectified or not."""
    return all(getattr(one, name) == getattr(other, name) for name in ("width", "height", "cx"))


@logger_for(StereoFrame)
def log_stereo(canvas: Canvas, stream: str, frame: StereoFrame) -> None:
    """Both images."""
    canvas.camera = canvas.camera or frame.camera
    own = same_view(frame.camera, canvas.camera)
    panels = (Panel.LEFT, Panel.RIGHT) if own else (Panel.LEFT_DERIVED, Panel.RIGHT_DERIVED)
    if not canvas.pictures:
        return
    images = colormaps.top_eight_bits(frame.left, frame.right)
    for side, panel, pixels in zip(("left", "right"), panels, images, strict=True):
        shown = colormaps.shrunk(pixels, canvas.width(stream))
        view = ViewSpec(panel, stream, side, f"{stream}: {side}", size=shown.shape[1::-1])
        canvas.log_image(view.path, shown, view)


@logger_for(Disparity)
def log_disparity(canvas: Canvas, stream: str, disparity: Disparity) -> str:
    """The disparities, what is known of them, and the superpixels; the caption has the shares of the drawn pixels."""
    source = np.ascontiguousarray(colormaps.every_nth(disparity.source, canvas.width(stream)))
    counts, final = label_counts(source), stream in canvas.full_size
    if canvas.pictures:
        _log_pixels(canvas, stream, disparity.pixels, source == PixelOrigin.FILLED if final else None)
        _log_source(canvas, stream, source, counts)
        if final:
            _log_confidence(canvas, stream, disparity, Panel.CONFIDENCE, "confidence")
            _log_sigma(canvas, stream, disparity)
            _log_depth(canvas, stream, disparity)
        elif stream in canvas.matched and disparity.segments is None:
            _log_confidence(canvas, stream, disparity, Panel.MATCH_CONFIDENCE, "confidence of the match")
        _log_costs(canvas, stream, disparity)
        _log_superpixels(canvas, stream, disparity)
    shares = {kind: 100.0 * counts[kind] / source.size for kind in (PixelOrigin.PLANE, PixelOrigin.FILLED)}
    parts = (f"{share:.0f} % {kind.name.lower()}" for kind, share in shares.items() if share)
    share = 100.0 * counts[known(np.arange(256))].sum() / source.size
    return f"{stream} {', '.join([f'{share:.0f} % known', *parts])}"


def _log_pixels(canvas: Canvas, stream: str, pixels: Array, filled: Array | None) -> None:
    """The disparities of every n-th pixel, with their scale. filled: which of these are faint, as guesses are."""
    thinned = colormaps.every_nth(pixels, canvas.width(stream))
    _, limit = canvas.limits(stream, 0.0, colormaps.disparity_limit(thinned))
    view, steps = ViewSpec(Panel.DISPARITY, stream, "pixels", stream), colormaps.whole_steps(thinned, DISPARITY_STEPS)
    canvas.log_steps(steps, DISPARITY_STEPS, limit, view, "px", veiled=("filled", filled))


def _log_source(canvas: Canvas, stream: str, source: Array, counts: Array) -> None:
    """The origin of every n-th pixel, unless all of them are measured or unknown. counts: of each code."""
    if not {*np.flatnonzero(counts).tolist()} <= {PixelOrigin.UNKNOWN, PixelOrigin.MEASURED}:
        view = ViewSpec(Panel.SOURCE, stream, "source", f"{stream}: source")
        canvas.log_labels(view, source, colormaps.SOURCE_LEGEND, beside=True, counts=counts)


def _log_superpixels(canvas: Canvas, stream: str, disparity: Disparity) -> None:
    """The edges of the superpixels, over the left image. Edges of fewer pixels are denser, so they are fainter."""
    if (segments := disparity.segments) is not None:
        thinned = np.ascontiguousarray(colormaps.every_nth(segments, canvas.whole_width))
        lines, step = png(colormaps.segment_edges(thinned)), colormaps.stride(segments.shape[1], canvas.whole_width)
        style = {"media_type": "image/png", "opacity": 0.4 / step, "draw_order": 10.0}
        view = ViewSpec(Panel.SUPERPIXELS, stream, "superpixels", f"{stream}: superpixels")
        canvas.log_blob(view.path, rr.EncodedImage, lines, view, **style)


def _log_confidence(canvas: Canvas, stream: str, disparity: Disparity, panel: Panel, title: str) -> None:
    """The confidence of every n-th pixel, in percent; 0 is unknown, and as dark as the least."""
    pixels, confidence = (
        colormaps.every_nth(layer, canvas.small_width) for layer in (disparity.pixels, disparity.confidence)
    )
    percent = np.where(np.isnan(pixels), np.float32(0), 100 * confidence)
    view = ViewSpec(panel, stream, "confidence", f"{stream}: {title}")
    canvas.log_values(np.rint(percent).astype(np.uint8), (20.0, 100.0), view, "%")


def _log_costs(canvas: Canvas, stream: str, disparity: Disparity) -> None:
    """What a search at full size found at every n-th pixel: its lowest cost, and by how much that beats the next."""
    if disparity.costs is None or not canvas.camera or disparity.pixels.shape[1] != canvas.camera.width:
        return
    lowest, next_lowest = (colormaps.every_nth(layer, canvas.small_width) for layer in disparity.costs)
    view = ViewSpec(Panel.COST, stream, "cost", f"{stream}: lowest cost")
    canvas.log_values(np.ascontiguousarray(lowest), (0.0, MAX_COST), view, "")
    view = ViewSpec(Panel.LEAD, stream, "lead", f"{stream}: lead over the next cost")
    canvas.log_values(next_lowest - np.minimum(lowest, next_lowest), (0.0, MAX_COST), view, "")


def _log_sigma(canvas: Canvas, stream: str, disparity: Disparity) -> None:
    """The standard deviation of every n-th disparity."""
    if disparity.sigma is not None:
        pixels, sigma = (
            colormaps.every_nth(layer, canvas.small_width) for layer in (disparity.pixels, disparity.sigma)
        )
        steps = colormaps.whole_steps(np.where(np.isnan(pixels), pixels, sigma), SIGMA_STEPS)
        view = ViewSpec(Panel.SIGMA, stream, "sigma", f"{stream}: sigma")
        canvas.log_steps(steps, SIGMA_STEPS, MAX_SIGMA, view, "px")


def _log_depth(canvas: Canvas, stream: str, disparity: Disparity) -> None:
    """The depth of every n-th pixel, in front of the left camera."""
    if (camera := disparity.camera) is not None:
        shifted = colormaps.every_nth(disparity.pixels, canvas.small_width) + np.float32(camera.cx_right - camera.cx)
        depth = camera.fx * camera.baseline / np.where(shifted > 0, shifted, np.float32(np.nan))
        view = ViewSpec(Panel.DEPTH, stream, "depth", f"{stream}: depth")
        canvas.log_steps(colormaps.whole_steps(depth, DEPTH_STEPS), DEPTH_STEPS, MAX_DEPTH, view, "m")


@logger_for(PointCloud)
def log_cloud(canvas: Canvas, stream: str, cloud: PointCloud) -> str:
    """Every n-th point, if the sensor's pose is known; a cloud in the camera's own frame is not drawn."""
    if cloud.sensor is not None:
        if canvas.pictures:
            some = slice(None, None, colormaps.stride(len(cloud.points), MAX_POINTS))
            places = np.rint(POINT_STEPS * cloud.points[some]) / np.float32(POINT_STEPS)
            colors = colormaps.fewer_shades(cloud.colors[some])
            points = drawn(rr.Points3D, positions=places, colors=colors, radii=rr.Radius.ui_points(2.0))
            view = ViewSpec(Panel.CLOUD, stream, "points", stream, cloud.frame_id)
            canvas.log(view.path, points, view)
        # An optical axis (z) below the horizon is pitch down; the image's right side (x) below it is roll right.
        for name, axis in (("camera pitch down", 2), ("camera roll right", 0)):
            _plot_angle(canvas, stream, name, -cloud.sensor.rotation[2, axis])
    return f"{stream} {counted(len(cloud.points), 'point')}"


@logger_for(VoxelMap)
def log_voxels(canvas: Canvas, stream: str, voxels: VoxelMap) -> str:
    """Every n-th cube, in its mean colour."""
    caption = f"{stream} {counted(len(voxels.index), 'voxel')}"
    if not canvas.pictures:
        return caption
    some = slice(None, None, colormaps.stride(len(voxels.index), MAX_POINTS))
    centres = (voxels.index[some] + np.float32(0.5)) * np.float32(voxels.resolution)
    colors = colormaps.fewer_shades(voxels.colors[some])
    shape = {"centers": centres, "half_sizes": np.full_like(centres, voxels.resolution / 2), "colors": colors}
    boxes = drawn(rr.Boxes3D, **shape, fill_mode=rr.components.FillMode.Solid)
    view = ViewSpec(Panel.VOXELS, stream, "voxels", stream, voxels.frame_id)
    canvas.log(view.path, boxes, view)
    return caption


@logger_for(Tilt)
def log_tilt(canvas: Canvas, stream: str, tilt: Tilt) -> None:
    """The angles of the inclinometer's axes above the horizon, in degrees."""
    for axis, sine in zip("xy", tilt.up, strict=False):
        _plot_angle(canvas, stream, f"inclinometer {axis} up", sine)


@logger_for(Pose)
def log_pose(canvas: Canvas, stream: str, pose: Pose) -> None:
    """An arrow along the rover's heading; the viewer shows those of all frames so far."""
    forward = matrix_of(pose.quaternion) @ [0.4, 0.0, 0.0]
    arrow = drawn(rr.Arrows3D, origins=[pose.position], vectors=[forward], colors=[CAMERA_RGB])
    view = ViewSpec(Panel.TRAJECTORY, stream, "trajectory", f"{stream} ({pose.frame_id})", pose.frame_id)
    canvas.log(view.path, arrow, view)
    canvas.ways.setdefault(pose.frame_id, []).append((float(pose.position[0]), float(pose.position[1])))


@logger_for(CameraMotion)
def log_motion(canvas: Canvas, stream: str, motion: CameraMotion) -> str:
    """The number of features that the camera was tracked by."""
    canvas.plot(f"{stream}/features", motion.inliers, ViewSpec(Panel.FEATURES, stream, "", stream))
    return f"{stream}: {motion.lost}" if motion.lost else f"{stream} {counted(motion.inliers, 'feature')}"


@logger_for(MatchHealth)
def log_matches(canvas: Canvas, stream: str, health: MatchHealth) -> None:
    """The matched share of all pixels and of the nearest ground, and the share of matches with a rival, in percent."""
    for name, part in (("all", health.all), ("near", health.near), ("repeated", health.repeated)):
        if np.isfinite(part):
            canvas.plot(f"{stream}/{name}", 100 * part, ViewSpec(Panel.MATCHES, stream, "", stream))


@logger_for(TiltHealth)
def log_health(canvas: Canvas, stream: str, health: TiltHealth) -> str:
    """The tilt against the camera's rotation and against the ground in view, in degrees; the fault in words."""
    for name, angle in (("tilt off turn", health.turn), ("ground off level", health.ground)):
        if np.isfinite(angle):
            path = f"{stream}/{rr.escape_entity_path_part(name)}"
            canvas.plot(path, np.degrees(angle), ViewSpec(Panel.HEALTH, stream, "", stream))
    canvas.log_change(stream, health.judgement, rr.TextLogLevel.WARN if health.fault else rr.TextLogLevel.INFO)
    return f"{stream}: {health.fault}" if health.fault else ""


@logger_for(ElevationMap)
def log_terrain(canvas: Canvas, stream: str, terrain: ElevationMap) -> str:
    """Shaded relief, the surface in 3-D, and every layer of a frame's own map (hover reads the values).

    A regional map comes seldom, so all are drawn, but only the layers that say which frames they are made of.
    """
    terrain = ahead(terrain)
    elevation, suffix = terrain.layers["elevation"], _frame_suffix(terrain.frame_id)
    low, high = canvas.limits(stream, *colormaps.elevation_limits(elevation))
    rgb, known = colormaps.elevation_colors(terrain, (low, high), exact=False), np.isfinite(elevation)
    relief = ViewSpec(Panel.RELIEF, stream, "relief", f"relief{suffix}")
    canvas.log_exact(relief.path, colormaps.birds_eye(rgb), relief)
    canvas.log_scale(f"{relief.path}/scale", terrain.shape[::-1], low, high, "m", cv2.COLORMAP_VIRIDIS)
    canvas.log_distances(f"{relief.path}/lines", terrain.shape, terrain)
    caption = f"{stream} {counted(int(np.count_nonzero(known)), 'cell')}"
    if not canvas.pictures and terrain.frame_id == LEVEL_FRAME:
        return caption
    step = colormaps.cell_stride(elevation, MAX_CELLS)
    coarse = colormaps.every_nth_cell(terrain, step)
    _log_layers(canvas, stream, coarse, (low, high))
    vertices, triangles = colormaps.surface(coarse)
    vertices[:, 2] = np.rint(POINT_STEPS * vertices[:, 2]) / np.float32(POINT_STEPS)
    if len(triangles):
        colors = rgb[step // 2 :: step, step // 2 :: step][np.isfinite(coarse.layers["elevation"])]
        mesh = drawn(rr.Mesh3D, vertex_positions=vertices, triangle_indices=triangles, vertex_colors=colors)
        canvas.log(f"{stream}/surface", mesh, ViewSpec(Panel.TERRAIN, stream, "surface", stream, terrain.frame_id))
    return caption


def _log_layers(canvas: Canvas, stream: str, terrain: ElevationMap, heights: tuple[float, float]) -> None:
    """The layers of a terrain. heights: the ends of the scale of elevations, m."""
    layers = terrain.layers if terrain.frame_id == LEVEL_FRAME else colormaps.provenance(terrain)
    for name, layer in layers.items():
        end, unit = colormaps.LAYER_SCALES.get(name, (0.0, ""))
        picture = colormaps.birds_eye(np.degrees(layer) if unit == "deg" else layer)
        with np.errstate(over="ignore"):  # beyond 65504, such as seconds after 18 hours, a value is infinite
            values = picture.astype(np.float16)
        part, title = f"layers/{rr.escape_entity_path_part(name)}", name + _frame_suffix(terrain.frame_id)
        view = ViewSpec(Panel.LAYER, stream, part, title, terrain.frame_id)
        if name == "elevation":
            canvas.log_values(values, heights, view, "m", cv2.COLORMAP_VIRIDIS)
        elif unit:
            canvas.log_values(values, (0.0, end), view, unit, hazard=canvas.hazard_limits.get(f"{stream}/{name}"))
        else:
            canvas.log_values(values, colormaps.value_limits(picture), view)


@logger_for(NavigationMap)
def log_navigation(canvas: Canvas, stream: str, navigation: NavigationMap) -> str:
    """The states of the cells, and their reasons."""
    navigation = ahead(navigation)
    cells, suffix = colormaps.birds_eye(navigation.cells), _frame_suffix(navigation.frame_id)
    view = ViewSpec(Panel.MAP, stream, "cells", f"navigation{suffix}")
    canvas.log_labels(view, cells, colormaps.CELL_LEGEND)
    canvas.log_distances(f"{view.path}/lines", navigation.cells.shape, navigation)
    reason = ViewSpec(Panel.REASON, stream, "reason", f"reason{suffix}")
    canvas.log_labels(reason, colormaps.birds_eye(navigation.reason), colormaps.REASON_LEGEND)
    free, hazard = (int(np.count_nonzero(cells == state)) for state in (Cell.FREE, Cell.HAZARD))
    return f"{stream} {free} free, {hazard} hazard"


@logger_for(Disparity, StereoFrame)
def log_difference(canvas: Canvas, stream: str, disparity: Disparity, frame: StereoFrame) -> None:
    """The difference of the images at a final disparity; hover reads it. It is large where the match is wrong."""
    if stream not in canvas.full_size or disparity.pixels.shape != frame.left.shape[:2] or not canvas.pictures:
        return
    difference = colormaps.gray_difference(frame.left, frame.right, disparity.pixels, canvas.small_width)
    steps = np.rint(DIFFERENCE_STEPS * np.minimum(np.nan_to_num(difference), MAX_DIFFERENCE)).astype(np.uint16)
    of = f" of {stream}" if len(canvas.full_size) > 2 else ""  # more than one frame and one disparity
    view = ViewSpec(Panel.DIFFERENCE, stream, "difference", f"difference{of}: wrong match, occlusion, glint")
    canvas.log_steps(steps, DIFFERENCE_STEPS, MAX_DIFFERENCE, view, "gray levels", cv2.COLORMAP_INFERNO)


@logger_for(StereoFrame, PointCloud)
def log_camera(canvas: Canvas, stream: str, frame: StereoFrame, cloud: PointCloud) -> None:
    """The left image, small, in the camera's frustum, and a plumb line from the camera to the ground plane."""
    camera, sensor = frame.camera, cloud.sensor
    if sensor is None or not canvas.pictures:
        return
    left, scale = colormaps.top_eight_bits(frame.left, frame.right)[0], THUMBNAIL_SCALE
    small = colormaps.shrunk(left, int(np.ceil(scale * left.shape[1])))
    view = ViewSpec(Panel.CAMERA, stream, "camera", stream, cloud.frame_id)
    canvas.log_image(f"{view.path}/image", small, view)
    cx, cy = (camera.cx + 0.5) * scale - 0.5, (camera.cy + 0.5) * scale - 0.5
    matrix = (camera.fx * scale, 0.0, cx), (0.0, camera.fy * scale, cy), (0.0, 0.0, 1.0)
    lens = fields_of(rr.Pinhole, image_from_camera=matrix, resolution=small.shape[1::-1])
    place = components_of(rr.Transform3D(translation=sensor.translation, mat3x3=sensor.rotation))
    canvas.log_components(view.path, rr.Pinhole, place, (*lens, *FRUSTUM))
    plumb = [sensor.translation, sensor.translation * (1.0, 1.0, 0.0)]
    strip = drawn(rr.LineStrips3D, strips=[plumb], colors=[CAMERA_RGB], radii=rr.Radius.ui_points(1.0))
    canvas.log(f"{stream}/plumb", strip, ViewSpec(Panel.CAMERA, stream, "plumb", stream, cloud.frame_id))


@logger_for(NavigationMap, ElevationMap)
def log_hazards(canvas: Canvas, stream: str, navigation: NavigationMap, terrain: ElevationMap) -> None:
    """The hazard cells on the ground; a hazard without an elevation is on the map only."""
    centres = _hazards(navigation, terrain)
    if len(centres):
        raised, red = centres + np.array([0.0, 0.0, HAZARD_LIFT]), [colormaps.CELL_LEGEND[Cell.HAZARD][1]]
        hazards = drawn(rr.Points3D, positions=raised, colors=red, radii=0.4 * terrain.resolution)
        canvas.log(f"{stream}/hazards", hazards, ViewSpec(Panel.TERRAIN, stream, "hazards", stream, terrain.frame_id))


@logger_for(StereoFrame, PointCloud, ElevationMap, NavigationMap)
def log_hazards_in_view(
    canvas: Canvas, stream: str, frame: StereoFrame, cloud: PointCloud, terrain: ElevationMap, navigation: NavigationMap
) -> None:
    """The hazard cells of the frame's own map over the left image; hidden ones too."""
    camera, sensor = frame.camera, cloud.sensor
    if sensor is None or terrain.frame_id != LEVEL_FRAME or not canvas.pictures:
        return
    seen = (_hazards(navigation, terrain) - sensor.translation) @ sensor.rotation
    seen = seen[seen[:, 2] > MIN_DEPTH]
    scale = min(1.0, canvas.width(stream) / camera.width)
    focal = np.array([camera.fx, camera.fy])
    pixels = (seen[:, :2] / seen[:, 2:] * focal + (camera.cx, camera.cy) + 0.5) * scale
    size = scale * np.array([camera.width, camera.height])
    inside = np.all((pixels >= 0) & (pixels < size), axis=1)
    radii = np.maximum(1.0, 0.4 * terrain.resolution * camera.fx * scale / seen[inside, 2])
    colors = [(*colormaps.CELL_LEGEND[Cell.HAZARD][1], 150)]
    dots = drawn(rr.Points2D, positions=pixels[inside], colors=colors, radii=radii, draw_order=20.0)
    canvas.log(f"{stream}/left/hazards", dots)


def _hazards(navigation: NavigationMap, terrain: ElevationMap) -> Array:
    """The centres (n, 3) of the hazard cells that have an elevation; none if the maps differ in size or frame."""
    if (navigation.cells.shape, navigation.frame_id) != (terrain.shape, terrain.frame_id):
        return np.empty((0, 3))
    row, col = np.divmod(np.flatnonzero(navigation.cells == Cell.HAZARD), navigation.cells.shape[1])
    elevation, (x, y) = terrain.layers["elevation"][row, col], cell_centres(terrain)
    centres = np.column_stack([x[col], y[row], elevation])
    return centres[np.isfinite(elevation)]


def _plot_angle(canvas: Canvas, stream: str, name: str, sine: float) -> None:
    """An angle, given by its sine, in degrees over time."""
    angle = float(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))
    path = f"{stream}/{rr.escape_entity_path_part(name)}"
    canvas.plot(path, angle, ViewSpec(Panel.ANGLE, stream, "", stream))


def _frame_suffix(frame_id: str) -> str:
    return "" if frame_id == LEVEL_FRAME else f" ({frame_id})"
