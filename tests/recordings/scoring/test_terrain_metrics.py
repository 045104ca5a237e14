"""The scores of maps count errors, hallucinated values and hidden rocks correctly."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from recordings.scoring.table import terrain_lines
from recordings.scoring.terrain_metrics import TerrainTally, TrueGround
from recordings.simulator import Simulation, ground_truth
from recordings.simulator.ground_truth import in_sight, rocks_in_view
from stages.data import Array, Cell, ElevationMap
from tests.bench.terrain import TiltedTally

SMALL = Simulation(frames=1, width=320, height=240, abundance=0.15, relief_cells=512, seed=5, threads=1)
N = 320
MIDDLE = -8 + (np.arange(N) + 0.5) * 0.05
X, Y = np.meshgrid(MIDDLE, MIDDLE)
RADIUS = np.hypot(X, Y)


def flat_truth(rocks: tuple[tuple[float, ...], ...] = ()) -> TrueGround:
    """Ground at 0 seen ahead of base_link, in view one cell more; rocks of x, y, diameter, height, pixels, shown."""
    table = np.array(rocks, float).reshape(-1, 6)
    rock = np.zeros((N, N))
    for x, y, diameter, height, *_ in table:
        rock[np.hypot(X - x, Y - y) <= diameter / 2] = height
    visible = (X > 0.05).astype(np.float32)
    layers = {
        "elevation": np.zeros((N, N)), "mean": np.zeros((N, N)), "visible": visible, "in_view": X > 0, "rock": rock,
        "slope": np.full((N, N), np.radians(7.0)),
    }  # fmt: skip
    terrain = ElevationMap(1, {k: v.astype(np.float32) for k, v in layers.items()}, 0.05, (-8.0, -8.0), "level")
    return TrueGround.of(terrain, rock >= 0.2, table)


def scored(truth: TrueGround, layers: dict[str, Array], cells: Array | None = None) -> dict[str, Any]:
    tally = TerrainTally()
    tally.add(truth, layers, cells)
    return tally.metrics()


def test_heights_count_in_visible_cells_and_levelling_removes_a_plane():
    truth = flat_truth()
    tilted = np.where(X > 0.05, 0.02 * X + 0.01, np.nan)
    tilted[(X > 0.05) & (Y > 0)] = np.nan
    found = scored(truth, {"elevation": tilted})["heights"]
    assert found["0-8 m"]["completeness"] == pytest.approx(0.5, abs=0.01)
    assert found["0-8 m"]["levelled"]["rmse"] == pytest.approx(0, abs=1e-9)
    far = truth.seen & (RADIUS >= 6) & (Y < 0)
    assert found["6-8 m"]["raw"]["bias"] == pytest.approx(0.02 * np.mean(X[far]) + 0.01)
    assert found["0-2 m"]["seen"] + found["2-4 m"]["seen"] == found["0-4 m"]["seen"]


def test_values_out_of_view_are_hallucinated_those_between_pixels_not():
    truth = flat_truth()
    elevation = np.full((N, N), np.nan)
    elevation[160, 161:261] = 0  # seen
    elevation[100:110, 160] = 0  # in view, no pixel
    elevation[100:140, 100] = 0  # hidden
    interpolated = np.where(np.isfinite(elevation), 0.0, np.nan)
    interpolated[100:135, 100] = interpolated[160, 161:186] = 1
    found = scored(truth, {"elevation": elevation, "interpolated": interpolated})["hallucinated"]
    assert found["of_values"] == pytest.approx(40 / 150)
    assert found["unseen"] == pytest.approx(50 / 150)
    assert found["claimed"] == pytest.approx(15 / 150)


def test_stated_sigmas_cover_their_errors_and_tilt_only_the_total():
    truth, random = flat_truth(), np.random.default_rng(1)
    sigma, tilt = 0.01 + 0.002 * RADIUS, 0.02
    noise = random.normal(0, 1, (N, N)) * sigma
    layers = {"elevation": noise + tilt * X, "variance": sigma**2, "common_variance": (tilt * RADIUS) ** 2}
    found = scored(truth, layers)["intervals"]
    assert found["random"]["1"] == pytest.approx(0.683, abs=0.01)
    assert found["random"]["2"] == pytest.approx(0.954, abs=0.01)
    assert found["total"]["2"] > 0.99
    silent = scored(truth, {**layers, "common_variance": np.zeros((N, N))})["intervals"]
    assert silent["total"]["1"] < 0.4
    assert silent["random"] == found["random"]


def test_intervals_are_summed_over_the_given_tilt_errors():
    truth, random, tilt = flat_truth(), np.random.default_rng(3), 0.003
    own, others = np.array([0.2 * tilt, 0.1 * tilt]), random.normal(0, tilt, (400, 2))
    lean = own[0] * X + own[1] * Y
    layers = {"elevation": lean, "variance": np.full((N, N), 1e-12), "common_variance": (tilt * RADIUS) ** 2}
    assert scored(truth, layers)["intervals"]["total"]["1"] == 1.0
    tally = TiltedTally()
    tally.tilts = others - own
    tally.add(truth, layers, None)
    total = tally.metrics()["intervals"]["total"]
    assert total["1"] == pytest.approx(0.683, abs=0.03)
    assert total["2"] == pytest.approx(0.954, abs=0.02)


def test_a_rock_is_visible_by_half_its_height_and_detected_by_a_hazard():
    rocks = (
        (4.0, 0.0, 0.5, 0.25, 400.0, 0.9),  # found
        (4.0, 2.0, 0.5, 0.35, 400.0, 0.9),  # missed: the hazard is two cells off
        (6.0, 0.0, 0.5, 0.35, 60.0, 0.3),  # found, though only its top shows
        (6.0, 2.0, 0.5, 0.35, 0.0, 0.0),  # nothing of it shows
        (3.0, -2.0, 0.4, 0.15, 900.0, 1.0),  # low
        (7.9, 2.0, 0.6, 0.4, 100.0, 1.0),  # farther than 8 m
    )
    cells = np.full((N, N), np.int8(Cell.FREE))
    for x, y in ((4.2, 0.0), (4.0, 2.36), (6.0, 0.0)):
        cells[int((y + 8) / 0.05), int((x + 8) / 0.05)] = Cell.HAZARD
    found = scored(flat_truth(rocks), {}, cells)["rocks"]
    assert found["0.2 m"] == {
        "visible": 2, "detected": 1, "partly_visible": 3, "partly_visible_detected": 2, "recall": 0.5,
    }  # fmt: skip
    assert found["0.3 m"] == {
        "visible": 1, "detected": 0, "partly_visible": 2, "partly_visible_detected": 1, "recall": 0.0,
    }  # fmt: skip


def test_unknown_is_neither_a_false_alarm_nor_a_detection():
    truth = flat_truth(((4.0, 0.0, 0.5, 0.25, 400.0, 0.9), (-3.0, 0.0, 0.5, 0.25, 0.0, 0.0)))
    nothing = scored(truth, {}, None)
    assert nothing["hazards"]["unknown"] == 1
    assert nothing["hazards"]["false_alarm"] == nothing["hazards"]["recall"] == nothing["hazards"]["false_safe"] == 0
    assert nothing["rocks"]["0.2 m"]["detected"] == nothing["rocks"]["0.2 m"]["recall"] == 0
    free = scored(truth, {}, np.zeros((N, N), np.int8))["hazards"]
    assert free["free_on_rock"] == pytest.approx(np.count_nonzero(truth.rock) / np.count_nonzero(np.hypot(X, Y) < 8))
    assert free["rock_false_safe"] == free["false_safe"] == 1
    alarmed = np.where(Y > 0, Cell.HAZARD, Cell.UNKNOWN).astype(np.int8)
    hazards = scored(truth, {}, alarmed)["hazards"]
    assert hazards["false_alarm"] == hazards["by_slope"]["5-10 deg"] == pytest.approx(0.5, abs=0.01)
    assert np.isnan(hazards["by_slope"]["0-5 deg"])


def test_frames_add_up_and_the_table_prints():
    truth = flat_truth(((4.0, 0.0, 0.5, 0.25, 400.0, 0.9),))
    tally = TerrainTally()
    for height in (0.0, 0.1):
        layers = {"elevation": np.full((N, N), height), "variance": np.full((N, N), 1e-4)}
        tally.add(truth, layers, np.full((N, N), np.int8(Cell.HAZARD)))
    found = tally.metrics()
    assert found["heights"]["0-8 m"]["raw"]["bias"] == pytest.approx(0.05)
    assert found["intervals"]["total"] == {"1": 0.5, "2": 0.5}
    text = "\n".join(terrain_lines(found))
    assert text.count("2 of 2; 0 of 0") == 2  # rocks of 0.2 m, visible and partly visible; none of 0.3 m
    assert all(len(line) <= 100 for line in text.splitlines())


@pytest.fixture(scope="module")
def simulated() -> tuple[Any, ElevationMap]:
    truth = SMALL.frame(0)
    return truth, ground_truth.truth_maps(SMALL, SMALL.stamp(0), truth)[0]


def test_visible_cells_are_in_view_and_the_others_in_view_adjoin_them(simulated):
    layers = simulated[1].layers
    visible, in_view = layers["visible"] > 0.5, layers["in_view"] > 0.5
    assert in_view[visible].all()
    assert 0.3 < visible.sum() / in_view.sum() < 0.9  # 320 pixels across leave gaps far away
    gap = distance_transform_edt(~visible)[in_view & ~visible]
    assert np.quantile(gap, 0.95) < 6  # rows of so few pixels are as many cells apart
    mean = layers["mean"]
    np.testing.assert_array_equal(np.isfinite(mean), visible)
    smooth = visible & (layers["rock"] == 0)
    assert np.median(np.abs(mean - layers["elevation"])[smooth]) < 0.002


def test_a_point_below_the_ground_or_behind_the_camera_is_not_in_sight(simulated):
    truth, terrain = simulated
    row, col = np.nonzero(terrain.layers["visible"] > 0.5)
    x, y = (-8 + (index + 0.5) * 0.05 for index in (col, row))
    points = truth.level(np.stack([x, y, terrain.layers["elevation"][row, col] + 0.01], axis=1))
    assert in_sight(SMALL, truth, points).mean() > 0.9
    assert not in_sight(SMALL, truth, points - [0, 0, 0.3]).any()
    behind = truth.level(np.stack([-x, y, np.full(len(x), 0.5)], axis=1))
    assert not in_sight(SMALL, truth, behind).any()


def test_rocks_in_view_span_what_shows_of_them(simulated):
    truth, _ = simulated
    pixels, shown = rocks_in_view(SMALL, truth).T
    assert (pixels[shown > 0] >= 1).all()
    large = pixels > 150
    assert large.sum() >= 2
    assert (shown[large] > 0.5).all()
    assert shown.max() <= 1
    assert not rocks_in_view(replace(SMALL, region=0.2), truth)[:, 0].any()
