"""Disparity errors, on cases small enough to work out by hand and against the definition written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.scoring.score import Score
from recordings.scoring.stereo_metrics import StereoErrors, cropped_columns
from recordings.scoring.table import brief_figures

NAN, INF = float("nan"), float("inf")


def measured(estimate, truth, occlusion, columns=0):
    """The metrics of one frame of float32 disparities."""
    pixels = (np.array(values, np.float32) for values in (estimate, truth))
    return StereoErrors.of(*pixels, None if occlusion is None else np.array(occlusion, np.uint8), columns).metrics()


def defined(estimate, truth, counted):
    """The metrics of the pixels `counted`, as Middlebury's evaluation defines them."""
    estimate, truth = estimate.astype(np.float64)[counted], truth.astype(np.float64)[counted]
    unknown = ~np.isfinite(estimate)
    error = np.abs(estimate - truth)[~unknown]
    found = {"pixels": len(truth), "density": 1 - unknown.mean(), "mae": error.mean()}
    found["rmse"] = np.sqrt((error**2).mean())
    for limit in (0.5, 1, 2, 4):
        found[f"bad_{limit}"] = (np.sum(error > limit) + unknown.sum()) / len(truth)
        found[f"bad_{limit}_known"] = np.mean(error > limit)
    return found


@pytest.mark.parametrize("columns", [0, 16, 21])
def test_every_region_is_as_defined(columns):
    rng = np.random.default_rng(columns)
    truth = rng.uniform(1, 100, (40, 50)).astype(np.float32)
    estimate = (truth + rng.normal(0, 2, truth.shape)).astype(np.float32)
    estimate[rng.random(truth.shape) < 0.2] = NAN
    truth[rng.random(truth.shape) < 0.1] = INF
    occlusion = rng.choice(np.array([255, 128, 0], np.uint8), truth.shape, p=[0.7, 0.25, 0.05])
    found = measured(estimate, truth, occlusion, columns)
    places = {"whole_image": np.ones(truth.shape, bool), "cropped_image": np.indices(truth.shape)[1] >= columns}
    for image, place in places.items():
        counted = place & np.isfinite(truth)
        assert found[image]["nonocc"] | found == found or image == "cropped_image"
        assert found[image]["nonocc"] == pytest.approx(defined(estimate, truth, counted & (occlusion == 255)))
        assert found[image]["all"] == pytest.approx(defined(estimate, truth, counted))
        assert found[image]["occluded"] == pytest.approx(defined(estimate, truth, counted & (occlusion == 128)))
    assert found["cropped_image"]["leftmost_columns_cropped"] == [columns]


def test_an_image_that_is_cropped_whole_has_no_error():
    beyond = measured([[9, 9]], [[10, 10]], [[255, 255]], 16)["cropped_image"]
    assert beyond["all"]["pixels"] == 0
    assert np.isnan(beyond["all"]["bad_2"])


@pytest.mark.parametrize(
    ("disparities", "columns"), [(0, 0), (-3, 0), (1, 16), (64, 64), (64.5, 80), (73, 80), (760, 768), (NAN, 0)]
)
def test_the_crop_is_the_range_rounded_up_to_sixteen(disparities, columns):
    assert cropped_columns(disparities) == columns


def test_without_an_occlusion_mask_only_all_pixels_are_scored():
    found = measured([[10, 12, NAN]], [[10, 10, 10]], None)
    assert found["whole_image"]["all"]["bad_1"] == pytest.approx(2 / 3)
    assert found["whole_image"]["nonocc"]["pixels"] == found["whole_image"]["occluded"]["pixels"] == 0
    assert np.isnan(found["bad_1"])
    assert np.isnan(found["whole_image"]["occluded"]["bad_1"])


def test_values_where_stereo_cannot_measure_are_counted_on_their_own():
    truth = [[10.0, 20.0, 30.0, 40.0, 50.0, NAN, NAN, INF]]
    estimate = [[10.0, 22.5, 32.0, NAN, 51.0, 7.0, NAN, 60.0]]
    found = measured(estimate, truth, [[255, 128, 128, 128, 128, 0, 0, 0]])
    assert (found["pixels"], found["density"], found["values"]) == (1, 1, 6)
    assert found["given_occluded"] == {"pixels": 3, "share": 0.5, "bad_2": pytest.approx(1 / 3)}  # 2.0 is not over 2
    assert found["given_without_truth"] == {"pixels": 2, "share": pytest.approx(1 / 3)}


def test_an_error_of_exactly_the_threshold_is_not_bad():
    found = measured([[11.0]], [[10.0]], [[255]])
    assert found["bad_1"] == 0
    assert found["bad_0.5"] == 1


def test_an_empty_estimate_is_all_bad_and_has_no_error():
    found = measured(np.full((2, 2), NAN), np.ones((2, 2)), np.full((2, 2), 255))
    assert found["bad_2"] == found["bad_4"] == 1
    assert found["density"] == found["values"] == 0
    assert np.isnan([found["rmse"], found["bad_2_known"], found["given_occluded"]["share"]]).all()


@given(st.integers(0, 2**32 - 1), st.integers(1, 29), st.booleans())
def test_added_frames_count_as_one_large_frame(seed, cut, masked):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(1, 100, (30, 6))
    estimate = np.where(rng.random((30, 6)) < 0.3, NAN, truth + rng.normal(0, 1.5, (30, 6)))
    truth[rng.random((30, 6)) < 0.1] = NAN
    occlusion = rng.choice(np.array([255, 128, 0], np.uint8), (30, 6)) if masked else None
    whole = StereoErrors.of(estimate, truth, occlusion, 2)
    total = StereoErrors()
    for rows, columns in ((slice(0, cut), 2), (slice(cut, 30), 2), (slice(30, 30), 16)):
        part = None if occlusion is None else occlusion[rows]
        total = total + StereoErrors.of(estimate[rows], truth[rows], part, columns)
    assert total.sums.keys() == whole.sums.keys()
    for name, sums in whole.sums.items():
        np.testing.assert_allclose(total.sums[name], sums, rtol=1e-12)
    assert (total.values, total.without_truth) == (whole.values, whole.without_truth)
    assert total.metrics()["cropped_image"]["leftmost_columns_cropped"] == [2, 16]


def test_without_an_occlusion_mask_the_row_of_a_table_is_that_of_all_pixels():
    pixels = [[10.0, 10.0, NAN, 12.0]], [[10.0, 10.7, 10.0, 10.0]]
    for mask, density in ((None, 0.75), ([[255, 255, 128, 255]], 1.0)):
        assert brief_figures(Score(disparity=measured(*pixels, mask)))[0] == density
