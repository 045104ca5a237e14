"""The simulator's truth, compared with its own images and with plain references."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from recordings.mcap.file import iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.simulator import Simulation, ground_truth, raycast, terrain, traverse, write_log
from recordings.simulator.odometry import dead_reckoning
from recordings.simulator.simulation import HORIZON
from stages.data import Cell, Transform

SMALL = Simulation(
    scene="gravel", frames=2, rate=1.0, width=400, height=300, relief_cells=512, abundance=0.12, color=False, noise=0.0,
    tilt_noise=0.0, frame_offset=0.0, seed=5,
)  # fmt: skip


@pytest.fixture(scope="module")
def seen():
    return SMALL.frame(1)


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "traverse.mcap"
    write_log(SMALL, path)
    messages: dict[str, list] = {}
    order = []
    for topic, log_time, message in iter_decoded(path):
        messages.setdefault(topic, []).append(message)
        order.append(log_time)
    return messages, order


def world_points(seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every surface pixel's place in the world by way of the disparity image and the static transforms."""
    camera = SMALL.camera
    disparity = ground_truth.true_disparity(SMALL, 0, seen).pixels.astype(np.float64)
    v, u = np.nonzero(np.isfinite(disparity))
    z = camera.fx * camera.baseline / disparity[v, u]
    optical = np.column_stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    return seen.base.after(SMALL.mounts[0])(optical), v, u


def solid(rocks: terrain.Rocks, facets: np.ndarray, index: int, points: np.ndarray, extent: float) -> np.ndarray:
    """Signed excess of points over a rock's surface in its unit space (plain numpy): 0 on it, negative inside."""
    offset = points - [*rocks.center[index], rocks.middle[index]]
    offset[:, :2] = (offset[:, :2] + extent / 2) % extent - extent / 2
    c, s = np.cos(rocks.yaw[index]), np.sin(rocks.yaw[index])
    unit = offset @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) / rocks.semi_axes[index]
    planes = facets[rocks.shape[index]]
    return np.maximum(np.linalg.norm(unit, axis=1) - 1, (unit @ planes[:, :3].T - planes[:, 3]).max(axis=1))


def test_true_disparity_reprojects_to_a_mm_of_the_true_surface(seen):
    points, v, u = world_points(seen)
    bare = seen.surface[v, u] == raycast.GROUND
    height = SMALL.terrain.elevation(points[bare, 0], points[bare, 1])
    assert bare.sum() > 40_000
    assert np.abs(height - points[bare, 2]).max() < 1e-3
    on_rock = seen.surface[v, u]
    rocks = np.unique(on_rock[on_rock >= 0])
    assert len(rocks) > 50
    ground = SMALL.terrain
    for rock in rocks:
        excess = solid(ground.rocks, ground.facets, rock, points[on_rock == rock], ground.extent)
        assert np.abs(excess).max() * ground.rocks.semi_axes[rock].max() < 1e-3


def test_no_surface_lies_before_the_hits_of_the_rays(seen):
    ground, rocks = SMALL.terrain, SMALL.terrain.rocks
    points, _, _ = world_points(seen)
    eye = seen.base.after(SMALL.mounts[0]).translation
    rng = np.random.default_rng(0)
    for point in points[rng.choice(len(points), 25, replace=False)]:
        way = eye + np.linspace(0, 1 - 1e-4, 800)[:, None] * (point - eye)
        assert (way[:, 2] - ground.elevation(way[:, 0], way[:, 1])).min() > -1e-6
        for index in np.flatnonzero(rocks.diameter > 0.15):
            assert solid(rocks, ground.facets, index, way, ground.extent).min() > -1e-4


def residual(simulation: Simulation, truth, low: float, high: float, shift: float) -> float:
    """Mean squared gray level between the left image and the right one, warped by the true disparity plus `shift`."""
    disparity = ground_truth.true_disparity(simulation, 0, truth).pixels
    left, right = (picture.astype(np.float32) for picture in truth.images)
    height, width = left.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    ring = (truth.seen == 255) & (truth.depth >= low) & (truth.depth < high) & (u - np.nan_to_num(disparity) > 4)
    warped = cv2.remap(right, u - disparity - np.float32(shift), v, cv2.INTER_LINEAR)[ring]
    gain = left[ring] @ warped / (warped @ warped)  # the cameras' gains differ on purpose
    return float(np.mean((gain * warped - left[ring]) ** 2))


@pytest.mark.parametrize("rings", [(0, 3), (3, 5), (5, 8)])
def test_the_images_agree_at_the_true_disparity_and_nowhere_else(seen, rings):
    before, at, after = (residual(SMALL, seen, *rings, shift) for shift in (-1, 0, 1))
    assert at < 0.5 * min(before, after)


def test_images_of_bare_ground_match_the_truth_to_a_hundredth_of_a_px():
    # Without rocks, that is without edges, over which the lens's blur mixes two surfaces.
    bare = replace(SMALL, abundance=0.0, width=1000, height=750)
    truth = bare.frame(0)
    for rings in ((0, 3), (3, 5), (5, 8)):
        before, at, after = (residual(bare, truth, *rings, shift) for shift in (-0.5, 0.0, 0.5))
        assert abs(0.25 * (before - after) / (before - 2 * at + after)) < 0.01
        assert at < 8.0


def test_occluded_pixels_are_those_hidden_from_the_right_camera(seen):
    pose = seen.base.after(SMALL.mounts[1])
    right = np.full(seen.depth.shape, np.nan)
    surface, facet = np.empty(right.shape, np.int32), np.empty(right.shape, np.int8)
    raycast.cast_rows(
        SMALL.terrain.scene, pose.translation, pose.rotation, SMALL.camera.fx, SMALL.camera.fy, SMALL.camera.cx,
        SMALL.camera.cy, HORIZON, 0, right, surface, facet,
    )  # fmt: skip
    v, u = np.nonzero(np.isfinite(seen.depth))
    depth, mask = seen.depth[v, u], seen.seen[v, u]
    column = u - SMALL.camera.fx * SMALL.baseline / depth
    assert (mask[column < -0.5] == 128).all()
    inside = column > 0
    v, mask, depth, column = v[inside], mask[inside], depth[inside], column[inside]
    low = np.floor(column).astype(int)
    beside = np.stack([right[v, low], right[v, np.minimum(low + 1, SMALL.width - 1)]])
    # Half a pixel of disparity is what neighbours of one surface may differ by.
    gap = SMALL.camera.fx * SMALL.baseline * (1 / beside - 1 / depth)
    hidden, plain = (gap > 1.5).all(axis=0), (np.abs(gap) < 0.5).all(axis=0)
    assert hidden.sum() > 200
    assert (mask[hidden] == 128).mean() > 0.995
    assert (mask[plain] == 255).mean() > 0.995
    assert ((seen.seen == 0) == np.isinf(seen.depth)).all()


@pytest.mark.parametrize("abundance", [0.05, 0.10, 0.20])
@pytest.mark.parametrize("smallest", [0.06, 0.2, 0.5, 1.0])
def test_rock_numbers_are_the_integral_of_golombeks_density(abundance, smallest):
    q = 1.79 + 0.152 / abundance
    number, _ = quad(lambda d: abundance * q * np.exp(-q * d) / (np.pi * d**2 / 4), smallest, 20.0, epsrel=1e-9)
    assert terrain.rocks_per_area(abundance, smallest, 20.0)[1][-1] == pytest.approx(number, rel=1e-4)


def test_strewn_rocks_have_the_size_frequency_and_cover_of_the_law():
    ground = terrain.make_terrain(np.random.default_rng(3), 2048, 0.04, 0.05, 0.1, 0.08, 2.5)
    area = ground.extent**2
    for diameter in (0.08, 0.15, 0.3, 0.6, 1.0):
        expected = terrain.rocks_per_area(0.1, diameter, 2.5)[1][-1] * area
        assert abs((ground.rocks.diameter >= diameter).sum() - expected) < 4 * np.sqrt(expected)
    cover = np.pi / 4 * np.sum(ground.rocks.diameter**2) / area
    smallest, largest = 0.1 * np.exp(-terrain.decay(0.1) * np.array([0.08, 2.5]))  # F_k of them
    assert cover == pytest.approx(smallest - largest, rel=0.06)
    ratio = ground.rocks.height / ground.rocks.diameter
    assert ratio.min() >= 0.3
    assert ratio.max() <= 0.6


def test_rocks_have_the_height_and_width_of_the_truth():
    rocks = SMALL.terrain.rocks
    large = np.flatnonzero(rocks.diameter > 0.3)[:40]
    shapes = SMALL.terrain.facets
    for index in large:
        one = rocks.only(np.arange(len(rocks)) == index)
        single = terrain.Terrain(np.full((64, 64), one.base[0], np.float32), 0.1, one, shapes)
        reach = np.linspace(-1.6, 1.6, 161)
        x, y = np.meshgrid(one.center[0, 0] + reach, one.center[0, 1] + reach)
        top, surface = raycast.tops_at(single.scene, x.ravel(), y.ravel(), single.scene.ceiling)
        assert top.max() - one.base[0] == pytest.approx(one.height[0], rel=0.05)
        width = 2 * np.sqrt((surface >= 0).sum() * 0.02**2 / np.pi)
        assert width == pytest.approx(one.diameter[0], rel=0.25)


@pytest.mark.parametrize("slope", [2.0, 15.0])
def test_relief_has_the_set_slope_and_no_seam(slope):
    ground = terrain.relief(np.random.default_rng(1), 512, 0.05, np.radians(slope)).astype(np.float64)
    rise = [np.roll(ground, 20, axis=axis) - ground for axis in (0, 1)]
    assert np.degrees(np.arctan(np.sqrt(np.mean(np.square(rise))))) == pytest.approx(slope, rel=1e-3)
    step = np.abs(np.diff(ground, axis=0))
    assert np.abs(ground[0] - ground[-1]).mean() < 1.5 * step.mean()


def test_the_ground_repeats_without_end():
    scene, extent = SMALL.terrain.scene, SMALL.terrain.extent
    rng = np.random.default_rng(2)
    for _ in range(200):
        x, y = rng.uniform(0, extent, 2)
        direction = (rng.normal(), rng.normal(), rng.uniform(-0.6, -0.02))
        here = raycast.first_hit(scene, x, y, 3.0, *direction, 300.0)
        there = raycast.first_hit(scene, x + 2 * extent, y - extent, 3.0, *direction, 300.0)
        assert there[1] == here[1]
        assert there[0] == pytest.approx(here[0], abs=1e-4)


def test_no_surface_stands_above_the_top_of_its_cell():
    rng, scene = np.random.default_rng(6), SMALL.terrain.scene
    x, y = rng.uniform(0, SMALL.terrain.extent, (2, 200_000))
    z, surface = raycast.tops_at(scene, x, y, scene.ceiling)
    cell = np.floor(y / SMALL.relief_resolution) * SMALL.relief_cells + np.floor(x / SMALL.relief_resolution)
    assert (surface >= 0).sum() > 10_000
    assert (scene.tops[cell.astype(int)] - z).min() > -1e-6


@pytest.mark.parametrize(("east", "north", "heading"), [(0.1, 0.0, 0.0), (-0.05, 0.2, 0.7), (0.0, -0.15, 2.5)])
def test_on_a_plane_the_body_tilts_with_the_plane(east, north, heading):
    nodes = np.arange(128) * 0.1
    plane = (east * nodes[None, :] + north * nodes[:, None]).astype(np.float32)
    bare = SMALL.terrain.rocks.only(np.zeros(len(SMALL.terrain.rocks), bool))
    ground = terrain.Terrain(plane, 0.1, bare, SMALL.terrain.facets)
    route = traverse.Route((6.0, 6.5), heading, 0.0, 9.0, 1.0, 1.0)
    base = traverse.base_pose(ground, route, 0.0)
    normal = np.array([-east, -north, 1.0])
    np.testing.assert_allclose(base.rotation[:, 2], normal / np.linalg.norm(normal), atol=1e-6)
    np.testing.assert_allclose(base.translation, [6.0, 6.5, 6.0 * east + 6.5 * north], atol=1e-6)
    assert np.arctan2(base.rotation[1, 0], base.rotation[0, 0]) == pytest.approx(heading)
    np.testing.assert_allclose(traverse.level_pose(base).rotation[:, 2], [0, 0, 1], atol=1e-12)


def test_the_inclinometer_and_its_mount_give_the_true_tilt(logged):
    messages, _ = logged
    mount = {t.child_frame_id: t for m in messages["/tf_static"] for t in m.transforms}[traverse.INCLINOMETER_FRAME]
    base_from_sensor = rotation(mount.transform.rotation)
    readings = {ros2.stamp_of(m.header): m for m in messages["/imu/inclinometer"]}
    for truth in messages["/truth/tilt"]:
        up_sensor = rotation(readings[ros2.stamp_of(truth.header)].orientation)[2]
        up_base = SMALL.mounts[0].rotation @ rotation(truth.quaternion)[2]
        np.testing.assert_allclose(base_from_sensor @ up_sensor, up_base, atol=1e-7)
        assert 1e-3 < np.arccos(up_base[2]) < np.radians(25)
    assert np.degrees(np.arccos(base_from_sensor[2, 2])) > 3  # an ignored mount would show


def test_true_elevation_is_where_the_seen_ground_is(seen):
    elevation, hazards = ground_truth.truth_maps(SMALL, 0, seen)
    points, v, u = world_points(seen)
    local = seen.level.inverse()(points)
    kept = (seen.surface[v, u] == raycast.GROUND) & (np.abs(local[:, :2]).max(axis=1) < 8)
    column, row = np.floor((local[kept, :2] - elevation.origin) / elevation.resolution).astype(int).T
    clear = hazards.cells[row, column] == Cell.FREE
    error = np.abs(elevation.layers["elevation"][row, column] - local[kept, 2])[clear]
    assert np.median(error) < 0.005
    mirrored = np.abs(elevation.layers["elevation"][::-1][row, column] - local[kept, 2])[clear]
    assert np.median(mirrored) > 5 * np.median(error)
    visible = elevation.layers["visible"]
    assert set(np.unique(visible)) == {0.0, 1.0}
    assert visible[:, :140].sum() == 0  # nothing behind the rover
    assert 0.05 < visible.mean() < 0.4


def test_high_rocks_are_hazards_and_open_ground_is_free(seen):
    elevation, hazards = ground_truth.truth_maps(SMALL, 0, seen)
    rocks = ground_truth.rocks_in_level(SMALL, seen)
    high = rocks[(rocks[:, 4] >= 0.2) & (np.abs(rocks[:, :2]).max(axis=1) < 7.9)]
    assert len(high) > 5
    column, row = np.floor((high[:, :2] + 8) / 0.05).astype(int).T
    assert (hazards.cells[row, column] == Cell.HAZARD).all()
    assert (elevation.layers["elevation"][row, column] - high[:, 2] > 0.08).all()
    assert (hazards.cells == Cell.HAZARD).mean() < 0.3
    assert (hazards.cells != Cell.UNKNOWN).all()


def test_no_high_rock_is_in_the_path_of_the_rover():
    rocks = SMALL.terrain.rocks
    for way in np.arange(0, 1.0, 0.1):
        base = traverse.base_pose(SMALL.terrain, SMALL.route, way)
        near = np.hypot(*(rocks.center - base.translation[:2]).T) < 0.4 + rocks.semi_axes[:, :2].max(axis=1)
        assert rocks.height[near].max(initial=0.0) < 0.12


def test_a_log_has_everything_a_replay_needs_in_log_time_order(logged):
    messages, order = logged
    assert order == sorted(order)
    per_frame = {topic for topic in messages if topic.startswith(("/stereo", "/truth"))}
    assert per_frame == {
        "/stereo/left/image_rect", "/stereo/left/camera_info", "/stereo/right/image_rect", "/stereo/right/camera_info",
        "/truth/disparity", "/truth/occlusion", "/truth/terrain_class", "/truth/elevation_map", "/truth/navigation_map",
        "/truth/rocks", "/truth/tilt", "/truth/pose",
    }  # fmt: skip
    wanted = [SMALL.stamp(index) for index in range(SMALL.frames)]
    for topic in per_frame:
        assert [ros2.stamp_of(message.header) for message in messages[topic]] == wanted
    for topic in ("/imu/inclinometer", "/odometry"):
        stamps = [ros2.stamp_of(message.header) for message in messages[topic]]
        assert stamps[0] < wanted[0]
        assert stamps[-1] > wanted[-1]
    right = messages["/stereo/right/camera_info"][0]
    assert -right.p[3] / right.p[0] == pytest.approx(SMALL.baseline)
    static = {t.child_frame_id for m in messages["/tf_static"] for t in m.transforms}
    assert static == {"left_camera_optical", "right_camera_optical", "inclinometer_link"}


def test_the_true_pose_is_logged_with_every_frame(logged):
    for message in logged[0]["/truth/pose"]:
        base, place = SMALL.base_at(ros2.stamp_of(message.header)), message.pose.pose.position
        assert (message.header.frame_id, message.child_frame_id) == ("world", "base_link")
        np.testing.assert_array_equal([place.x, place.y, place.z], base.translation)
        np.testing.assert_allclose(rotation(message.pose.pose.orientation), base.rotation, atol=1e-12)


def test_odometry_without_errors_is_exact():
    exact = replace(SMALL, odometry_scale=0.0, odometry_turn=0.0)
    odom = traverse.level_pose(exact.base_at(exact.begin)).inverse()
    for pose in exact.odometry:
        expected = odom.after(exact.base_at(pose.stamp))
        np.testing.assert_allclose(Rotation.from_quat(pose.quaternion).as_matrix(), expected.rotation, atol=1e-12)
        np.testing.assert_allclose(pose.position, expected.translation, atol=1e-9)


@pytest.mark.slow
def test_odometry_has_the_scale_error_and_heading_drift_of_its_settings():
    """Over many drives, the errors of heading and of lateral position grow with the distance as the model states."""
    long, scale, turn = 16.0, 0.02, np.radians(0.5)
    ways = np.linspace(0, long, 161)
    bases = [Transform("world", "base_link", np.eye(3), np.array([way, 0.0, 0.0])) for way in ways]
    ends = []
    for seed in range(400):
        pose = dead_reckoning(range(161), bases, ways, scale, turn, np.random.default_rng(seed))[-1]
        ends.append([*pose.position, Rotation.from_quat(pose.quaternion).as_euler("zyx")[0]])
    along, across, up, heading = np.array(ends).T
    assert np.median(along) == pytest.approx(long * (1 + scale), rel=0.002)
    assert np.std(heading) == pytest.approx(turn * np.sqrt(long), rel=0.1)
    assert np.std(across) == pytest.approx(turn * np.sqrt(long**3 / 3), rel=0.1)
    assert np.abs(up).max() == 0.0
    stated = np.sqrt(np.diag(pose.covariance))
    assert stated[5] == pytest.approx(np.std(heading), rel=0.1)
    assert stated[1] == pytest.approx(np.hypot(scale * long, np.std(across)), rel=0.1)


def test_odometry_does_not_drift_while_the_rover_stands():
    still = [Transform("world", "base_link", np.eye(3), np.zeros(3))] * 50
    first, *poses = dead_reckoning(range(50), still, np.zeros(50), 0.02, 0.1, np.random.default_rng(0))
    for pose in poses:
        np.testing.assert_array_equal([*pose.position, *pose.quaternion], [*first.position, *first.quaternion])


def test_the_number_of_threads_does_not_change_the_log(tmp_path):
    tile = Simulation(frames=1, width=96, height=72, relief_cells=256, map_half_width=1.0)
    for threads in (1, 3):
        write_log(replace(tile, threads=threads), tmp_path / f"{threads}.mcap")
    assert (tmp_path / "1.mcap").read_bytes() == (tmp_path / "3.mcap").read_bytes()


@pytest.mark.slow
def test_another_seed_makes_another_ground():
    one, other = (Simulation(frames=1, width=96, height=72, relief_cells=256, seed=seed).frame(0) for seed in (1, 2))
    assert not np.array_equal(one.images[0], other.images[0])
    assert not np.array_equal(one.depth, other.depth)


@pytest.mark.parametrize("seed", [0, 3999, 6000, 1 << 40])
def test_a_log_of_any_seed_has_stamps_that_can_be_written(seed):
    start = Simulation(seed=seed).start
    assert 1_700_000_000 <= start / 1e9 < (1 << 31) - 1e8
    assert start != Simulation(seed=seed + 1).start


@pytest.mark.parametrize(("name", "value", "why"), [
    ("relief_cells", 1000, "must be a power of two"), ("frames", 0, "must be at least 1, not 0"),
    ("relief_cells", 32, "must be a power of two"), ("frame_offset", 1e9, "must be at most"),
    ("region", -1.0, "must be"),
])  # fmt: skip
def test_an_impossible_simulation_is_refused_with_the_parameters_name(name, value, why):
    with pytest.raises(ValueError, match=f"{name} {why}"):
        Simulation(**{name: value})


def test_ground_of_a_tile_smaller_than_its_waves_is_refused():
    with pytest.raises(ValueError, match=r"relief_cells x relief_resolution must be above 2 m, not 1\.28 m"):
        Simulation(relief_cells=64, relief_resolution=0.02)


def rotation(quaternion) -> np.ndarray:
    return Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w]).as_matrix()


def test_a_mast_that_pans_sees_the_same_world(seen):
    panning, straight = replace(SMALL, pan=float(np.radians(30)), pan_time=4.0), seen
    seen = panning.frame(1)
    assert np.degrees(panning.pan_at(panning.stamp(1))) == pytest.approx(30)
    assert (seen.base.translation == straight.base.translation).all()
    right, ahead = (eye.rotation[:, 2] @ seen.mounts[0].rotation[:, 2] for eye in (seen.mounts[1], straight.mounts[0]))
    assert right == pytest.approx(1)
    assert ahead == pytest.approx(1 - np.cos(panning.pitch_down) ** 2 * (1 - np.cos(np.radians(30))))
    elevation, _ = ground_truth.truth_maps(panning, 0, seen)
    other, _ = ground_truth.truth_maps(SMALL, 0, straight)
    np.testing.assert_array_equal(elevation.layers["elevation"], other.layers["elevation"])
    shown = elevation.layers["in_view"] > 0
    row, column = np.nonzero(shown)
    left_of_rover = np.degrees(np.arctan2(row - shown.shape[0] / 2, column - shown.shape[1] / 2))
    assert np.median(left_of_rover) == pytest.approx(30, abs=5)
