"""Fuse merges many frames into one grid: aligned, weighted, and corrected by later frames."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flow.contracts import StageError
from stages import Binarise, Cell, Fuse, FuseRegion, PixelOrigin, TerrainFeatures
from stages.terrain.fused_map import CELL, SHARED_SHARE, Observation, merged
from stages.terrain.map_registration import frame_grid, register
from tests.conftest import slow
from tests.stages.running import Running
from tests.stages.terrain.region_scene import MOUNT, SECOND, START, cell, centres, drive, flat, fused, part, rolling


def test_frames_at_any_heading_make_one_map_of_the_ground():
    _, terrain = fused(drive(frame) for frame in range(12))
    assert (terrain.frame_id, terrain.stamp) == ("odom", START + 11 * SECOND)
    error = terrain.layers["elevation"] - rolling(*centres(terrain))
    known = np.isfinite(error)
    assert known.sum() > 25_000
    assert np.sqrt(np.mean(error[known] ** 2)) < 0.003
    assert np.median(terrain.layers["count"][known]) > 16  # more than any frame alone has


def test_a_rock_seen_from_two_headings_keeps_its_place():
    def with_rock(x, y):
        return np.where(np.hypot(x - 1.0, y - 2.0) < 0.3, 0.25, 0.0)

    places = (-3.0, 2.0, 0.0), (1.0, -2.0, np.pi / 2), (4.0, 5.0, np.radians(-135))
    _, terrain = fused(drive(frame, with_rock, at=at) for frame, at in enumerate(places))
    x, y = centres(terrain)
    rock = terrain.layers["elevation"] > 0.125
    assert rock.sum() * 0.05**2 == pytest.approx(np.pi * 0.3**2, rel=0.1)
    assert (x[rock].mean(), y[rock].mean()) == (pytest.approx(1.0, abs=0.01), pytest.approx(2.0, abs=0.01))


def give_ceilings(monkeypatch, *heights):
    """Give each frame a ceiling of its height in the unknown cells up to 3 m from its rover."""
    heights = iter(heights)

    def hiding(*arguments):
        frame = frame_grid(*arguments)
        hidden = ~frame.known & (np.hypot(*centres(frame.terrain)) < 3)
        ceiling = np.where(hidden, next(heights), np.nan).astype(np.float32)
        return replace(frame, terrain=replace(frame.terrain, layers={**frame.terrain.layers, "ceiling": ceiling}))

    use_whole_frames(monkeypatch)
    monkeypatch.setattr("stages.terrain.fuse.frame_grid", hiding)


def test_cells_hidden_from_all_frames_differ_from_cells_out_of_view(monkeypatch):
    give_ceilings(monkeypatch, -0.2, -0.1)
    _, terrain = fused(drive(frame, flat, at=(0.0, 0.0, 1.2 * frame)) for frame in range(2))
    assert [cell(terrain, *place, "occluded") for place in ((1.02, 0.02), (2.52, 0.02), (1.02, 2.22))] == [1, 0, 0]
    assert np.isnan(cell(terrain, -5.0, 0.02, "occluded"))
    assert np.isnan(cell(terrain, 1.02, 0.02))
    assert cell(terrain, 1.02, 0.02, "ceiling") == pytest.approx(-0.2, abs=0.01)  # the lower of the two
    assert np.isnan(cell(terrain, 2.52, 0.02, "ceiling"))


def test_the_ceiling_of_a_frame_is_aligned_with_its_cells(monkeypatch):
    give_ceilings(monkeypatch, np.nan, -0.14)
    first, (cloud, pose) = (drive(n, flat, at=(0.0, 0.0, 0.0)) for n in range(2))
    raised = replace(pose, position=pose.position + np.array([0, 0, 0.06]))
    _, terrain = fused([first, (cloud, raised)])
    assert cell(terrain, 4.02, 0.02) == pytest.approx(0, abs=0.002)
    assert cell(terrain, 1.02, 0.02, "ceiling") == pytest.approx(-0.2, abs=0.002)


@pytest.mark.parametrize(("sigma", "leans"), [(1e-4, 0.01), (0.1, 0.0)])
def test_the_tilt_counts_by_the_sigma_of_its_own_frame(sigma, leans):
    cloud, pose = drive(0, flat, tilt=(0.01, 0.0), at=(0.0, 0.0, 0.0))
    _, terrain = fused([(replace(cloud, tilt_sigma=sigma), pose)], attitude_sigma=0.01)
    rise = cell(terrain, 6.02, 0.02) - cell(terrain, 3.02, 0.02)
    assert rise / 3 == pytest.approx(leans, abs=0.001)


def use_whole_frames(monkeypatch):
    """Let the grid of a frame keep the cells that it does not show."""
    monkeypatch.setattr("stages.terrain.dem.Voxelise._window", lambda self, cloud, ceiling, whole: whole)
    monkeypatch.setattr("stages.terrain.map_registration._seen", lambda layers: (slice(0, 320), slice(0, 320)))


def test_a_mean_over_frames_is_weighted_by_inverse_variance(monkeypatch):
    use_whole_frames(monkeypatch)
    first, (cloud, pose) = (drive(frame, flat, sigma, at=(0.0, 0.0, 0.0)) for frame, sigma in ((0, 0.02), (1, 0.04)))
    frames = first, (replace(cloud, points=cloud.points + np.float32([0, 0, 0.01])), pose)
    local = [
        frame_grid(cloud, register(Fuse(), cloud, pose, MOUNT)[0], 0.05, 8.0).terrain.layers for cloud, pose in frames
    ]
    fuse, terrain = fused(frames, tilt_sigma=0.0, height_sigma=0.0, position_sigma=0.0)
    one, other = (layers["variance"].astype(float) + fuse.alignment_sigma**2 for layers in local)
    share = (1 / other) / (1 / one + 1 / other)
    elevation = terrain.layers["elevation"][40:360, 40:360]
    both = np.isfinite(one) & np.isfinite(other)
    assert both.sum() > 10_000
    np.testing.assert_allclose(elevation[both], (0.01 * share)[both], atol=1e-6)
    variance = (1 - SHARED_SHARE) / (1 / one + 1 / other) + SHARED_SHARE * np.minimum(one, other)
    np.testing.assert_allclose(terrain.layers["variance"][40:360, 40:360][both], variance[both], rtol=2e-3)


def test_position_errors_add_to_the_variance_of_steep_cells():
    variance, steep = {}, 0.2
    for position in (0.0, 0.05):
        _, terrain = fused([drive(0, lambda x, y: steep * x, at=(0.0, 0.0, 0.0))], position_sigma=position)
        variance[position] = terrain.layers["variance"]
    known = np.isfinite(variance[0.0])
    added = float(np.mean((variance[0.05] - variance[0.0])[known]))
    assert added == pytest.approx((0.05 * steep) ** 2, rel=0.3)


def test_many_frames_do_not_reduce_the_variance_they_share():
    layers, frames = {}, [drive(frame, at=(0.0, 0.0, 0.3)) for frame in range(40)]
    for count in (1, 40):
        _, terrain = fused(frames[:count], alignment_sigma=0.01, position_sigma=0.0)
        layers[count] = terrain.layers
    single, variance = layers[1]["variance"], layers[40]["variance"]
    known = (layers[40]["frames"] > 35) & np.isfinite(single)
    assert np.all(variance[known] >= 0.99 * SHARED_SHARE * np.nanmin(single))
    assert np.all(variance[known] <= single[known])


def test_cells_count_their_frames_and_keep_their_first_and_last_time():
    _, terrain = fused(drive(frame, at=(1.0 * frame, 0.0, 0.0)) for frame in range(6))
    assert [cell(terrain, 5.52, 0.02, layer) for layer in ("first", "last", "frames")] == [0.0, 3.0, 4.0]
    assert [cell(terrain, 8.52, 0.02, layer) for layer in ("first", "last", "frames")] == [2.0, 5.0, 4.0]
    assert np.isnan(cell(terrain, 1.0, 0.02, "first"))
    assert cell(terrain, 1.0, 0.02, "frames") == 0


@pytest.mark.parametrize("gap", [12.0, *slow(0.0, 5.0)])
def test_a_drifting_height_aligns_after_a_gap_and_makes_no_step(gap):
    fuse = Running(Fuse())
    for frame in range(90):
        along = 0.25 * frame + (gap if frame >= 60 else 0.0)
        cloud, pose = drive(frame, flat, at=(along, 0.0, 0.0), noise=0.005, points=12_500)
        pose = replace(pose, position=np.add(pose.position, (0, 0, 0.016 * along)))
        terrain = fuse(cloud, pose, MOUNT)
    assert fuse.finding() is None
    known = np.isfinite(terrain.layers["elevation"])
    assert not (Binarise()(TerrainFeatures()(terrain)).cells[known] == Cell.HAZARD).any()


def test_a_clock_that_jumps_by_years_keeps_the_map():
    fuse, _ = fused(drive(frame, flat, at=(0.0, 0.0, 0.0)) for frame in range(2))
    cloud, pose = drive(2, flat, at=(0.0, 0.0, 0.0))
    later = START + 1_700_000_000 * SECOND
    terrain = fuse(replace(cloud, stamp=later), replace(pose, stamp=later), MOUNT)
    assert np.nanmax(terrain.layers["frames"]) == 3


def test_a_pose_in_a_frame_without_a_name_makes_the_same_map():
    frames = [drive(frame) for frame in range(3)]
    (_, named), (_, nameless) = (
        fused((cloud, replace(pose, frame_id=name)) for cloud, pose in frames) for name in ("odom", "")
    )
    assert nameless.frame_id == ""
    np.testing.assert_equal(dict(nameless.layers), dict(named.layers))


def with_box(x, y):
    return np.where((np.abs(x - 4) < 0.4) & (np.abs(y) < 0.4), 0.5, 0.0)


def test_newer_frames_clear_an_obstacle_that_is_gone():
    fuse, terrain = fused(drive(frame, with_box, at=(0.05 * frame, 0.0, 0.0)) for frame in range(5))
    assert cell(terrain, 4.02, 0.02) == pytest.approx(0.5, abs=1e-3)
    for frame in range(5, 10):
        terrain = fuse(*drive(frame, flat, at=(0.05 * frame, 0.0, 0.0)), MOUNT)
    assert np.nanmax(np.abs(terrain.layers["elevation"])) < 0.01
    assert cell(terrain, 4.02, 0.02, "first") >= 5.0
    assert cell(terrain, 4.02, 0.02, "contradictions") >= 1
    assert cell(terrain, 3.02, 0.02, "contradictions") == 0
    assert cell(terrain, 3.02, 0.02, "first") == 0.0


def test_one_uncertain_frame_does_not_overturn_many():
    frames = [drive(frame, with_box, at=(0.05 * frame, 0.0, 0.0)) for frame in range(6)]
    _, terrain = fused([*frames, drive(6, flat, at=(0.3, 0.0, 0.0), sigma=0.3)])
    assert cell(terrain, 4.02, 0.02) == pytest.approx(0.5, abs=1e-3)
    assert cell(terrain, 4.02, 0.02, "last") == 5.0


@pytest.mark.parametrize(("sigmas", "contradicted"), [(2.9, False), (3.1, True)])
def test_heights_three_sigma_apart_are_a_doubt_until_a_frame_agrees(sigmas, contradicted):
    def seen(height: float, sigma: float) -> Observation:
        return Observation(*np.array([[0, 0, height, height, height, sigma**2, 5]]).T)

    cells = merged(np.zeros(1, CELL), seen(0.0, 0.01), 0)
    cells = merged(cells, seen(sigmas * np.hypot(0.01, 0.02), 0.02), 1)
    assert (cells["contradictions"][0], cells["doubt"][0] > 0) == (contradicted, contradicted)
    assert merged(cells, seen(0.0, 0.01), 2)["doubt"][0] == 0


def test_an_obstacle_that_appears_is_never_mapped_as_sure_flat_ground():
    fuse = Running(Fuse())
    for frame in range(16):
        ground, sigma = (with_box, 0.05) if frame >= 10 else (flat, 0.01)
        terrain = fuse(*drive(frame, ground, at=(0.0, 0.0, 0.0), sigma=sigma), MOUNT)
        height, variance = (cell(terrain, 4.02, 0.02, name) for name in ("elevation", "variance"))
        if frame >= 10:
            assert height + np.sqrt(variance) > 0.45
    assert height == pytest.approx(0.5, abs=0.02)
    assert variance < 0.05**2


def test_an_empty_cloud_changes_nothing():
    cloud, pose = drive(0)
    fuse, terrain = fused([(part(cloud, np.s_[:0]), pose)])
    assert np.isnan(terrain.layers["elevation"]).all()
    assert np.isfinite(fuse(*drive(1), MOUNT).layers["elevation"]).any()


def test_points_without_a_sigma_do_not_enter_the_map():
    cloud, pose = drive(0)
    unsure = np.where(cloud.points[:, 1] > 0, np.float32(np.nan), cloud.sigma)
    fuse, terrain = fused([(replace(cloud, sigma=unsure), pose)])
    assert 0 < np.isfinite(terrain.layers["elevation"]).sum() < 0.6 * len(cloud.points) / 6
    terrain = fuse(*drive(1), MOUNT)
    known = np.isfinite(terrain.layers["elevation"])
    assert np.abs(terrain.layers["elevation"] - rolling(*centres(terrain)))[known].max() < 0.03


def test_filled_points_do_not_enter_the_map():
    cloud, pose = drive(0)
    filled = cloud.points[:, 1] > 0
    partly_filled = replace(cloud, source=np.where(filled, PixelOrigin.FILLED, PixelOrigin.MEASURED).astype(np.uint8))
    (_, terrain), (_, expected) = (fused([(points, pose)]) for points in (partly_filled, part(cloud, ~filled)))
    assert np.isfinite(terrain.layers["elevation"]).any()
    np.testing.assert_equal(dict(terrain.layers), dict(expected.layers))


def test_a_map_of_a_log_is_not_continued_from_another_place():
    fuse, (cloud, pose) = Fuse(), drive(0)
    _, terrain = fused([(cloud, pose)])
    assert fuse(cloud, pose, MOUNT, state=fuse.resumed([terrain])).stamp == START
    for shift in ([0.06, 0, 0], [0, -0.06, 0]):
        state = fuse.resumed([terrain])
        with pytest.raises(StageError, match="its pose is more than a cell off that map"):
            fuse(cloud, replace(pose, position=pose.position + shift), MOUNT, state=state)


def test_a_range_of_too_many_cells_is_refused():
    with pytest.raises(ValueError, match=r"^FuseRegion\.max_range = 150 m makes a map 6000 cells"):
        FuseRegion(max_range=150.0)


TRACK = """
import sys
import numpy as np
from stages import Fuse, Pose, Transform
from tests.stages.builders import cloud_of
from tests.stages.running import Running
def peak():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM"))
before, fuse, step = peak(), Running(Fuse(max_range=11.0, window=25.0)), 8.0
x, y = (axis.ravel() + 0.025 for axis in np.meshgrid(np.arange(-4, 4, 0.05), np.arange(-10, 10, 0.05)))
points = np.column_stack([x, y, 0.1 * np.sin(x)]).astype(np.float32)
sensor = Transform("level", "camera", np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.array([0, 0, 1.0]))
for frame in range(int(sys.argv[1]) // 8):
    pose = Pose(frame + 1, [frame * step, 0.0, 0.0], [-0.5, 0.5, -0.5, 0.5], "odom", "camera")
    fuse(cloud_of(points, stamp=frame + 1, sensor=sensor), pose)
tiles = fuse.state.cells.tiles.values()
cells = sum(int((tile["frames"] > 0).sum()) for tile in tiles)
print(cells, sum(tile.nbytes for tile in tiles) / 1e6, peak() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the memory of a process as Linux does")
@pytest.mark.parametrize("metres", [160, *slow(1000)])
def test_a_kilometre_20_metres_wide_fits_into_500_megabytes(metres):
    done = subprocess.run([sys.executable, "-c", TRACK, str(metres)], capture_output=True, text=True, check=True)
    cells, map_size, grown = (float(value) for value in done.stdout.split())
    assert cells == pytest.approx(metres * 20 / 0.05**2, rel=0.01)
    assert map_size < 0.26 * metres + 2
    # Of the 500 MB 150 are for the libraries: how much of their files is in memory differs between systems.
    assert grown < 350 - 0.26 * (1000 - metres)
