"""Binarise finds hazards on any slope the rover can climb, and calls no unseen cell free."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation

from stages.data import Cell, CellReason, MatchFailure, Rover
from stages.terrain.binarise import Binarise
from stages.terrain.features import TerrainFeatures
from stages.terrain.verdict_limits import doubts_at
from tests.stages.terrain.terrain_scene import grid, map_of, rolling_terrain

X, Y = grid(80)
LEVEL = np.zeros_like(X)


def decided(elevation, **parameters):
    return Binarise(**parameters)(TerrainFeatures()(elevation))


def with_plane(elevation, gx, gy, offset):
    plane = offset + elevation.resolution * (gx * np.arange(80) + gy * np.arange(80)[:, None])
    raised = {name: layer + plane * (name != "count") for name, layer in elevation.layers.items()}
    return replace(elevation, layers={name: layer.astype(np.float32) for name, layer in raised.items()})


def shares(terrain, result):
    """Recall of cells 0.2 m above the ground, share of them called free, false alarms at least three cells from any
    rock, share of rocks found."""
    hazard = result.cells == Cell.HAZARD
    high, clear = terrain.above_mean >= 0.2, ~binary_dilation(terrain.rock > 0, np.ones((7, 7)))
    found = [hazard[terrain.rock == k].any() for k in range(1, terrain.rock.max() + 1)]
    free = (result.cells == Cell.FREE)[high].mean()
    return float(hazard[high].mean()), float(free), float(hazard[clear].mean()), float(np.mean(found))


GROUNDS = {
    "flat": {},
    "10 degrees": {"slope": np.deg2rad(10)},
    "17 degrees": {"slope": np.deg2rad(17)},
    "rolling": {"amplitude": 0.15, "wavelength": 6.0},
    "rolling slope": {"amplitude": 0.15, "wavelength": 8.0, "slope": np.deg2rad(5)},
    "noisy": {"noise": 0.02},
}


@pytest.mark.parametrize("ground", GROUNDS.values(), ids=GROUNDS)
def test_every_rock_on_any_ground_is_found_with_few_false_alarms(ground):
    terrains = [rolling_terrain(seed, **ground) for seed in range(3)]
    results = [shares(terrain, decided(terrain.elevation)) for terrain in terrains]
    recall, free, alarms, found = np.mean(results, axis=0)
    assert found == 1.0
    assert recall >= 0.99
    assert free <= 0.005
    assert alarms <= 0.002


def test_a_ceiling_without_the_layer_occluded_makes_no_drop():
    heights, ceiling = np.float32(LEVEL), np.float32(LEVEL)
    heights[30:40] = np.nan
    elevation = replace(map_of(LEVEL), layers={"elevation": heights, "ceiling": ceiling})
    assert (decided(elevation).cells[30:40] == Cell.UNKNOWN).all()


def test_a_map_without_cells_stays_one():
    assert decided(map_of(np.zeros((0, 5)))).cells.shape == (0, 5)


@example(degrees=20.0, heading=0.3, offset=50.0)
@given(degrees=st.floats(0, 19.9), heading=st.floats(0, 2 * np.pi), offset=st.floats(-50, 50))
def test_a_plane_within_the_slope_limit_is_free_where_it_was_seen(degrees, heading, offset):
    z = offset + np.tan(np.deg2rad(degrees)) * (np.cos(heading) * X + np.sin(heading) * Y)
    seen = np.hypot(X, Y) > 1.0
    result = decided(map_of(np.where(seen, z, np.nan)))
    assert (result.cells[seen] == Cell.FREE).all()
    assert (result.cells[~seen] == Cell.UNKNOWN).all()


@pytest.mark.parametrize("resolution", [0.05, 0.2, 0.4, 0.5, 0.7])
@pytest.mark.parametrize("heading", [0.0, 0.4, 0.8])
def test_the_slope_within_a_cell_is_no_step(resolution, heading):
    """At 18 degrees a cell of 0.5 m reaches up by 0.2 m from one corner to the other."""
    x, y = (axis / 0.05 * resolution for axis in grid(20))
    east, north = np.tan(np.deg2rad(18)) * np.array([np.cos(heading), np.sin(heading)])
    z, half = east * x + north * y, (abs(east) + abs(north)) * resolution / 2
    plane = map_of(z, resolution, minimum=z - half, maximum=z + half)
    assert (decided(plane).cells[3:-3, 3:-3] == Cell.FREE).all()
    blocked = z.copy()
    blocked[10, 10] += 0.25
    rock = map_of(blocked, resolution, minimum=z - half, maximum=np.maximum(z + half, blocked))
    assert decided(rock).reason[10, 10] == CellReason.STEP


@pytest.mark.parametrize(("resolution", "wheel"), [(0.05, 0.14), (0.1, 0.3), (0.2, 0.3)])
def test_level_ground_is_free_under_a_wheel_that_spans_three_cells(resolution, wheel):
    rover = Rover(wheel=wheel)
    result = Binarise(rover=rover)(TerrainFeatures(rover=rover)(map_of(LEVEL, resolution)))
    assert (result.cells[10:-10, 10:-10] == Cell.FREE).all()


@pytest.mark.parametrize("limit", ["max_step", "ground_clearance"])
def test_a_limit_that_level_ground_would_reach_is_refused(limit):
    rover = Rover(**{limit: 0.03})
    with pytest.raises(ValueError, match=rf"Binarise.rover.{limit} must be above Binarise.height_margin, 0.03 m"):
        Binarise(rover=rover)
    Binarise(method="absolute", rover=rover)


@pytest.mark.parametrize("limit", ["max_step", "ground_clearance"])
def test_a_limit_that_no_rover_has_is_refused(limit):
    with pytest.raises(ValueError, match=rf"Rover.{limit} must be at most 20 m, not 1e\+99 m"):
        Rover(**{limit: 1e99})


def test_a_plane_beyond_the_slope_limit_is_a_hazard_for_its_slope():
    result = decided(map_of(np.tan(np.deg2rad(20.2)) * X))
    assert (result.reason == CellReason.SLOPE).all()
    assert (result.cells == Cell.HAZARD).all()


def test_a_ridge_near_the_slope_limit_is_unknown_and_a_gentle_one_free():
    ridge = np.exp(-(((X - 2) / 0.24) ** 2))
    steep, doubtful, gentle = (map_of(height * ridge) for height in (0.14, 0.12, 0.1))
    flanks = np.abs(np.abs(X - 2) - 0.17) < 0.03
    assert (decided(steep).reason[flanks] == CellReason.SLOPE).all()
    assert (decided(doubtful).reason[flanks] == CellReason.UNSURE).all()
    assert (decided(doubtful, steepness_error=0.0).cells == Cell.FREE).all()
    assert (decided(gentle).cells == Cell.FREE).all()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), gx=st.floats(-0.2, 0.2), gy=st.floats(-0.2, 0.2), offset=st.floats(-5, 5))
def test_tilting_and_raising_the_scene_changes_no_hazard(seed, gx, gy, offset):
    terrain = rolling_terrain(seed, rocks=5, cells=80).elevation
    plain, moved = (
        Binarise(rover=Rover(max_slope=1.3))(TerrainFeatures(rover=Rover(max_slope=1.0))(elevation))
        for elevation in (terrain, with_plane(terrain, gx, gy, offset))
    )
    # float32 heights round; a cell that lies on a threshold may fall to the other side, and its neighbours with it.
    assert (plain.cells != moved.cells).mean() <= 0.002


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_a_mirrored_map_gives_the_mirrored_result(seed):
    elevation = rolling_terrain(seed, amplitude=0.1, rocks=5, cells=80).elevation
    mirrored = replace(elevation, layers={name: layer[::-1] for name, layer in elevation.layers.items()})
    assert (decided(mirrored).cells[::-1] != decided(elevation).cells).mean() <= 0.0005


def test_a_rock_on_a_slope_is_a_hazard_and_the_slope_is_free():
    distance = np.hypot(X - 2, Y - 2)
    rock = np.where(distance < 0.3, np.sqrt(np.maximum(0.09 - distance**2, 0)), 0)
    result = decided(map_of(np.tan(np.deg2rad(10)) * X + rock))
    assert (result.reason[distance < 0.18] == CellReason.STEP).all()
    assert (result.cells[distance > 0.45] == Cell.FREE).all()
    assert (result.cells[distance > 0.35] == Cell.FREE).mean() > 0.98


@pytest.mark.parametrize("step", [0.12, 0.16, 0.18, 0.25])
@pytest.mark.parametrize("limit", [0.14, 0.17, 0.22])
@pytest.mark.parametrize("degrees", [0.0, 12.0])
def test_an_edge_is_a_step_only_if_it_exceeds_the_limit(step, limit, degrees):
    """A terrace across a slope: only its edge is a step."""
    scene = map_of(np.tan(np.deg2rad(degrees)) * X + np.where(Y > 2, step, 0.0))
    features = TerrainFeatures(rover=Rover(max_step=limit))(scene)
    result = Binarise(rover=Rover(max_step=limit, max_slope=1.5), height_margin=0.0, max_roughness=1.0)(features)
    assert (result.reason[np.abs(Y - 2.05) < 0.05] == CellReason.STEP).all() == (step > limit)
    assert not (result.reason[np.abs(Y - 2) > 0.6] == CellReason.STEP).any()


def test_a_half_hidden_rock_behind_a_rise_is_found():
    """Behind a crest the ground is hidden, and only the upper half of a rock is visible."""
    x, y = grid(120)
    ground = 0.25 * np.exp(-(((x - 2) / 0.7) ** 2)) - 0.12 * np.exp(-(((x - 3.5) / 0.6) ** 2))
    distance = np.hypot(x - 3.5, y - 3)
    top = np.where(distance < 0.3, np.sqrt(np.maximum(0.09 - distance**2, 0)), 0)
    hidden = (x > 2.4) & (x < 3.35) | ((x > 3.35) & (x < 4.3) & (top < 0.1))
    result = decided(map_of(np.where(hidden, np.nan, ground + top)))
    assert (result.cells[(distance < 0.2) & ~hidden] == Cell.HAZARD).all()
    assert (result.cells[(x < 1) & ~hidden] == Cell.FREE).all()


def test_a_ditch_is_a_hazard_and_so_are_its_edges():
    ditch = np.abs(X - 2) < 0.2
    result = decided(map_of(np.where(ditch, -0.3, 0.02 * np.sin(3 * Y))))
    assert (result.reason[ditch] == CellReason.STEP).all()
    assert (result.cells[np.abs(X - 2) < 0.3] == Cell.HAZARD).all()
    assert (result.cells[np.abs(X - 2) > 0.7] == Cell.FREE).all()


def test_a_bump_higher_than_the_ground_clearance_is_a_hazard():
    bump = 0.15 * np.exp(-((X - 2) ** 2 + (Y - 2) ** 2) / 0.3**2)
    low, high = (decided(map_of(bump), rover=Rover(ground_clearance=clearance)) for clearance in (0.1, 0.25))
    assert (low.reason == CellReason.CLEARANCE).sum() > 20
    assert (low.cells[np.hypot(X - 2, Y - 2) > 1] == Cell.FREE).all()
    assert (high.cells == Cell.FREE).mean() > 0.9


def test_a_hazard_margin_beyond_the_map_is_that_of_the_map():
    bumpy = map_of(np.where(np.eye(9, dtype=bool), 0.4, 0.0))
    assert np.array_equal(decided(bumpy, hazard_margin=1e6).reason, decided(bumpy, hazard_margin=1.0).reason)


def test_cells_within_the_hazard_margin_of_an_obstacle_are_hazards():
    rock = (np.abs(X - 2) < 0.2) & (np.abs(Y - 2) < 0.2)
    rovers = (Rover(max_slope=1.5), Rover(max_slope=1.5, max_step=1.0))  # too high for a wheel; only for the belly
    for beside, rover in product((0.0, 0.05, 0.1), rovers):
        result = decided(map_of(np.where(rock, 0.4, 0.0)), rover=rover, hazard_margin=beside)
        around = (np.abs(X - 2) < 0.2 + beside) & (np.abs(Y - 2) < 0.2 + beside) & ~rock
        assert (result.cells[around] == Cell.HAZARD).all()
        np.testing.assert_array_equal(result.reason == CellReason.BESIDE, around)


def test_empty_cells_are_unmatched_occluded_or_unobserved():
    flat, occluded, unmatched = LEVEL.copy(), LEVEL.copy(), np.full(LEVEL.shape, np.nan)
    flat[20:40, 20:40] = np.nan
    occluded[20:40, 20:30], occluded[20:40, 30:40] = 1, np.nan
    flat[30, 31] = occluded[30, 31] = 0
    unmatched[20:40, 20:23] = MatchFailure.DARK
    seen = np.isfinite(unmatched)
    result = decided(map_of(flat, occluded=occluded, unmatched=unmatched))
    assert (result.reason[seen] == CellReason.UNMATCHED).all()
    assert (result.reason[(occluded == 1) & ~seen] == CellReason.OCCLUDED).all()
    assert (result.reason[np.isnan(occluded)] == CellReason.UNOBSERVED).all()
    assert result.reason[30, 31] == CellReason.UNSURE
    assert (result.cells[20:40, 20:40] == Cell.UNKNOWN).all()


def test_a_map_without_terrain_features_is_refused():
    with pytest.raises(ValueError, match="no layer 'ground'; put stages"):
        Binarise()(map_of(LEVEL))


def test_noise_of_two_centimetres_is_no_hazard():
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0, 0.02, (160, 160))
        assert (decided(map_of(noise, maximum=noise + 0.02, minimum=noise - 0.02)).cells == Cell.FREE).all()


def test_the_low_back_of_a_rock_is_part_of_the_obstacle(monkeypatch):
    """A wide rock, 0.22 m high in front, whose back runs down to the ground over 0.8 m."""
    rock = (X > 1.5) & (X < 2.3) & (np.abs(Y - 2) < 0.5)
    height = np.where(rock, 0.22 * (1 - (X - 1.5) / 0.8), 0.0)
    far = np.hypot(X - 3.4, Y - 0.6) < 0.12
    touching = ~rock & (np.abs(X - 1.9) < 0.1) & (Y > 2.4) & (Y < 2.7)
    scene = map_of(height + 0.08 * far + 0.04 * touching)
    back = rock & (height > 0.1) & (height < 0.15)
    whole = decided(scene, hazard_margin=0.0)
    monkeypatch.setattr("stages.terrain.features.MIN_SKIRT_HEIGHT", 1.0)
    peaks_only = decided(scene, rover=Rover(max_slope=1.0), hazard_margin=0.0)
    assert (whole.reason[back] == CellReason.STEP).all()
    assert (whole.cells[rock & (height < 0.03)] == Cell.FREE).mean() > 0.9
    assert not (whole.reason[~rock] == CellReason.STEP).any()
    assert (peaks_only.reason[back] != CellReason.STEP).mean() > 0.4
    assert (peaks_only.reason[rock & (height > 0.2)] == CellReason.STEP).all()


def test_a_cell_with_a_large_sigma_is_not_free():
    sigma = np.full(LEVEL.shape, 0.02)
    sigma[10:20, 10:20], sigma[30, 30] = 0.1, np.nan
    result = decided(map_of(LEVEL, variance=sigma**2))
    np.testing.assert_array_equal(result.reason == CellReason.UNSURE, ~(sigma <= 0.05))
    np.testing.assert_array_equal(result.cells == Cell.FREE, sigma <= 0.05)
    lax, without = decided(map_of(LEVEL, variance=sigma**2), max_sigma=0.15), decided(map_of(LEVEL))
    assert np.argwhere(lax.cells != Cell.FREE).tolist() == [[30, 30]]
    assert (without.cells == Cell.FREE).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", ["rover", "absolute"])
def test_heights_that_are_not_finite_are_unknown(method):
    infinite, top, bottom = np.zeros((3, 40, 40))
    infinite[5, 5], infinite[6, 6] = np.inf, -np.inf
    top[20, 20], bottom[20, 20], top[21, 21], bottom[5, 5] = np.inf, -np.inf, np.nan, np.inf
    result = decided(map_of(infinite, maximum=top, minimum=bottom), method=method)
    assert np.argwhere(result.cells != Cell.FREE).tolist() == [[5, 5], [6, 6]]
    assert result.cells[5, 5] == result.cells[6, 6] == Cell.UNKNOWN


def test_one_stray_point_is_no_hazard_but_a_rock_is():
    top = LEVEL.copy()
    top[40, 40] = 0.5
    assert (decided(map_of(LEVEL, maximum=top, minimum=LEVEL)).cells == Cell.FREE).all()
    assert decided(map_of(top * 0.5, maximum=top, minimum=LEVEL)).cells[40, 40] == Cell.HAZARD


def test_rubble_too_low_to_be_a_step_is_too_rough():
    rubble = np.where(np.random.default_rng(5).random(LEVEL.shape) < 0.4, 0.15, 0.0)
    assert (decided(map_of(rubble)).reason == CellReason.ROUGHNESS).mean() > 0.95


def test_unseen_cells_are_unknown():
    terrain, seen = rolling_terrain(2).elevation, np.random.default_rng(0).random((160, 160)) > 0.3
    layers = {name: np.where(seen, layer, 0 if name == "count" else np.nan) for name, layer in terrain.layers.items()}
    for method in ("rover", "absolute"):
        result = decided(replace(terrain, layers=layers), method=method)
        assert (result.cells[~seen] == Cell.UNKNOWN).all()
        assert (result.reason[~seen] == CellReason.UNOBSERVED).all()
        np.testing.assert_array_equal(result.cells == Cell.FREE, result.reason == CellReason.CLEAR)
        unknown = np.isin(result.reason, (CellReason.UNOBSERVED, CellReason.UNSURE))
        np.testing.assert_array_equal(result.cells == Cell.UNKNOWN, unknown)


def test_lone_ground_is_unknown_and_a_lone_high_face_is_a_hazard():
    lone = np.full((80, 80), np.nan)
    lone[40, 40:42] = lone[10, :] = 0.0
    assert (decided(map_of(lone)).cells == Cell.UNKNOWN).all()
    face = decided(map_of(lone, minimum=lone - 0.3, maximum=lone + 0.3))
    assert face.cells[40, 40] == Cell.HAZARD
    assert face.reason[40, 40] == CellReason.STEP


@pytest.mark.parametrize("method", ["rover", "absolute"])
def test_a_cell_with_few_points_is_unsure_because_of_min_points(method):
    count = np.full(LEVEL.shape, 3.0)
    count[40, 40] = 2
    terrain, rule = TerrainFeatures()(map_of(LEVEL, count=count)), Binarise(method=method, min_points=3)
    assert rule(terrain).reason[40, 40] == CellReason.UNSURE
    assert np.argwhere(rule(terrain).cells != Cell.FREE).tolist() == [[40, 40]]
    assert doubts_at(rule, terrain, 40, 40) == ["fewer points than min_points"]
    assert doubts_at(rule, terrain, 40, 42) == []


def test_only_the_absolute_rule_makes_a_gentle_slope_a_hazard():
    x, _ = grid(160)
    gentle = map_of(np.tan(np.deg2rad(3)) * x)
    absolute = Binarise(method="absolute")(gentle)
    np.testing.assert_array_equal(absolute.reason == CellReason.ELEVATION, gentle.layers["elevation"] > 0.2)
    assert (absolute.cells == Cell.HAZARD).mean() > 0.5
    assert (decided(gentle).cells == Cell.FREE).all()


def test_the_grid_of_the_map_is_kept():
    result = decided(rolling_terrain(0).elevation)
    assert (result.stamp, result.resolution, result.origin, result.frame_id) == (7, 0.05, (-4.0, -4.0), "level")
    assert result.cells.shape == (160, 160)


@pytest.mark.parametrize(("layer", "sound", "doubtful"), [("count", 5.0, 0.5), ("variance", 0.0004, 0.01)])
def test_a_splatted_or_uncertain_cell_may_be_a_hazard_but_not_free(layer, sound, doubtful):
    height, evidence = LEVEL.copy(), np.full(LEVEL.shape, sound)
    height[20:23, 20:23] = 0.4
    evidence[20:23, 20:23] = evidence[40, 40] = doubtful
    navigation = decided(map_of(height, **{layer: evidence}))
    assert (navigation.cells[40, 40], navigation.reason[40, 40]) == (Cell.UNKNOWN, CellReason.UNSURE)
    assert (navigation.cells[20:23, 20:23] == Cell.HAZARD).all()
    assert (navigation.cells[19, 19:24] == Cell.HAZARD).all()


def test_an_obstacle_is_surrounded_by_hazard_and_unsure_cells():
    height = LEVEL.copy()
    height[40, 40] = 0.4
    navigation = decided(map_of(height))
    assert navigation.reason[40, 39:44].tolist() == [
        CellReason.BESIDE, CellReason.STEP, CellReason.BESIDE, CellReason.UNSURE, CellReason.CLEAR
    ]  # fmt: skip
    assert navigation.cells[40, 39:44].tolist() == [Cell.HAZARD] * 3 + [Cell.UNKNOWN, Cell.FREE]


def test_a_cell_without_a_steepness_is_not_free():
    """The top of an obstacle lower than a step is in no plane."""
    height = LEVEL.copy()
    height[40:43, 40:43] = 0.25
    navigation = decided(map_of(height), rover=Rover(max_step=0.4, ground_clearance=0.5))
    assert (navigation.cells[40:43, 40:43] == Cell.UNKNOWN).all()
