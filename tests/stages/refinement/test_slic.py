"""Superpixels: connected, deterministic, and as good as scikit-image's at explaining the image."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from skimage import data, measure, segmentation

from stages.compiled.parallel import in_turn
from stages.matching.kernels.resample import halved
from stages.refinement.kernels import slic


@pytest.fixture(scope="module")
def photo():
    return np.ascontiguousarray(data.astronaut()[:400, 50:450])


def explained_variance(image, labels):
    pixels, flat = image.reshape(-1, 3).astype(float), labels.ravel()
    counts = np.bincount(flat)
    means = np.stack([np.bincount(flat, channel) / np.maximum(counts, 1) for channel in pixels.T], axis=1)
    return ((means[flat] - pixels.mean(0)) ** 2).sum() / ((pixels - pixels.mean(0)) ** 2).sum()


def boundary_recall(image, labels, reach=2):
    edges = np.hypot(*np.gradient(ndimage.gaussian_filter(image.mean(axis=2), 1)))
    strong = edges > np.percentile(edges, 95)
    near = ndimage.binary_dilation(segmentation.find_boundaries(labels), iterations=reach)
    return near[strong].mean()


def test_explains_the_image_as_well_as_scikit_image(photo):
    ours, count = slic.superpixels(photo, 600)
    theirs = segmentation.slic(photo, n_segments=600, compactness=10, start_label=0)
    assert explained_variance(photo, ours) > explained_variance(photo, theirs) - 0.01
    assert boundary_recall(photo, ours) > boundary_recall(photo, theirs) - 0.02
    assert 480 <= count <= 720


def test_superpixels_of_a_wide_image_are_those_of_its_half(photo):
    width = slic.MIN_HALVED_WIDTH + 1
    wide = cv2.resize(photo, (width, 301))
    labels, count = slic.superpixels(wide, 900)
    expected, total = slic.superpixels(halved(wide[:300, : width - 1]), 900)
    assert count == total
    assert np.array_equal(labels, np.pad(expected.repeat(2, axis=0).repeat(2, axis=1), ((0, 1), (0, 1)), mode="edge"))


@given(st.integers(1, 30), st.integers(1, 30), st.integers(1, 4), st.integers(0, 8), st.integers(0, 2**31))
def test_components_are_numbered_as_a_flood_fill_does(height, width, kinds, smallest, seed):
    labels = np.random.default_rng(seed).integers(0, kinds, (height, width), dtype=np.int32)
    expected, total = slic.connect_reference(labels, smallest)
    assert slic.connect(labels, smallest, np.empty((3, labels.size), np.int32)) == total
    assert np.array_equal(labels, expected)


@pytest.mark.parametrize("channels", [3, 1])
def test_assignment_is_the_nearest_of_nine_centres(photo, channels):
    image = photo[:90, :131] if channels == 3 else photo[:90, :131, 1]
    colour, rows, cols = slic._colours(image), 6, 9
    centres = slic._grid_centres(colour, rows, cols)
    labels = slic._labels(colour, centres, (rows, cols), 0.4**0.5)
    expected = slic.assign_reference(colour, centres, rows, cols, 0.4)
    assert (labels == expected).mean() > 0.999  # float32 may break a tie differently


def test_an_image_may_lie_in_memory_in_any_order(photo):
    for image in (photo, photo[..., 1]):
        turned = np.rot90(image)
        assert np.array_equal(slic.superpixels(turned, 200)[0], slic.superpixels(turned.copy(), 200)[0])


def test_a_step_moves_each_centre_to_the_mean_of_what_is_nearest_to_it(photo):
    image = photo[:90, :131]
    colour, rows, cols = slic._colours(image), 6, 9
    centres = slic._grid_centres(colour, rows, cols)
    labels = slic.assign_reference(colour, centres, rows, cols, 0.4).ravel()
    lab = colour.reshape(-1, 3).T * np.array([[100 / 255], [1], [1]])
    values = [*lab, *np.mgrid[:90, :131].reshape(2, -1)]
    means = np.stack([np.bincount(labels, v, rows * cols) for v in values], axis=1)
    means /= np.bincount(labels, minlength=rows * cols)[:, None]
    slic._move_centres(colour, centres, (rows, cols), 0.4**0.5, in_turn)
    assert centres == pytest.approx(means, abs=0.05)


def test_settled_centres_explain_the_image_better_than_a_grid(photo, monkeypatch):
    found = []
    for moves in (4, 0):
        monkeypatch.setattr(slic, "ITERATIONS", moves)
        found.append(explained_variance(photo, slic.superpixels(photo, 600)[0]))
    settled, grid = found
    assert settled > grid + 0.002


@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 400), st.integers(0, 2**31))
def test_any_image_and_count_gives_connected_labels_on_two_threads_too(height, width, count, seed):
    shape = (height, width, 3) if seed % 2 else (height, width)
    image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    labels, total = slic.superpixels(image, count)
    pieces = measure.label(labels, connectivity=1, background=-1).max()
    assert pieces == total == labels.max() + 1 == len(np.unique(labels))
    assert labels.min() == 0
    assert np.array_equal(labels, slic.superpixels(image, count, threads=2)[0])
