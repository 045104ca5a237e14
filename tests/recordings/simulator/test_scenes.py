"""What the simulated cameras see: classes of ground, contrast, noise, and the faults of lens, sensor and drive."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flow.cli.commands import simulate
from flow.cli.commands.simulate import FIELDS, OPTIONS
from recordings.mcap.file import iter_decoded
from recordings.ros2.image_from_msg import pixels_of
from recordings.simulator import Simulation, camera, write_log
from recordings.simulator.scenes import SCENES, defaults_of
from recordings.simulator.texture import TerrainClass, ground_look
from tests.conftest import slow

CALM = Simulation(
    scene="mixed", frames=2, rate=1.0, width=480, height=360, relief_cells=256, color=False, noise=0.0, seed=3
)  # fmt: skip
SAND = replace(CALM, width=640, height=480, sand=1.0, dust=0.0, bedrock=0.0, abundance=0.0, ripples=0.0, slope=0.0)
MID_GRAY_LIGHT = 0.5**1.5 / camera.EXPOSURE


def detail(picture: np.ndarray) -> np.ndarray:
    """What a picture has at the scale of a few pixels, gray levels."""
    gray = picture.astype(np.float32)
    return np.asarray(gray - cv2.GaussianBlur(gray, (0, 0), 3))


@pytest.mark.parametrize("contrast", [2.0, *slow(1.0, 6.0)])
def test_sand_has_the_set_contrast_at_every_distance(contrast):
    truth = replace(SAND, sand_contrast=contrast).frame(0)
    picture = truth.images[0]
    at_mid_gray = detail(picture) * 127.5 / np.maximum(picture, 1)
    for near, far, tolerance in ((1, 2, 0.15), (2, 4, 0.15), (4, 8, 0.25)):
        ring = (truth.terrain_class == TerrainClass.SAND) & (truth.depth >= near) & (truth.depth < far)
        rounding = 1 / 12 * np.mean((127.5 / picture[ring]) ** 2)
        assert np.sqrt(np.var(at_mid_gray[ring]) - rounding) == pytest.approx(contrast, rel=tolerance)


@pytest.mark.parametrize(("width", "height"), [(800, 600), *slow((1280, 960))])
def test_gravel_and_rock_have_several_times_the_contrast_of_sand_and_dust(width, height):
    truth = replace(CALM, width=width, height=height).frame(0)
    near, spread = truth.depth < 5, {}
    for kind in (TerrainClass.SAND, TerrainClass.DUST, TerrainClass.GRAVEL, TerrainClass.ROCK):
        inside = cv2.erode((truth.terrain_class == kind).astype(np.uint8), np.ones((9, 9))) > 0
        spread[kind] = float(np.median(np.abs(detail(truth.images[0])[inside & near])) * 1.48)
    assert 8 < spread[TerrainClass.GRAVEL] < 15
    assert 6 < spread[TerrainClass.ROCK] < 15
    assert spread[TerrainClass.SAND] < 3
    assert spread[TerrainClass.DUST] < spread[TerrainClass.SAND]


@pytest.mark.parametrize(
    ("sand", "dust", "bedrock"), [(0.5, 0.2, 0.1), *slow((0.1, 0.0, 0.9), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))]
)
def test_the_ground_has_the_set_shares_of_sand_dust_and_bedrock(sand, dust, bedrock):
    ground = Simulation(scene="mixed", sand=sand, dust=dust, bedrock=bedrock, gravel_contrast=12.0).texture
    ground = ground._replace(drifts=0.0)  # else thin sand where the gravel scene has it
    places = np.random.default_rng(1).uniform(0, 400, (4000, 2))
    kinds = np.bincount([ground_look(ground, x, y, 0.01, 0.01, 1.0, 0.0)[3] for x, y in places], minlength=5) / 4000
    expected = [0.0, sand, 1 - sand - dust - bedrock, dust, bedrock]
    np.testing.assert_allclose(kinds, expected, atol=0.06)


def test_rocks_are_rock_and_no_surface_is_sky():
    truth = CALM.frame(0)
    assert (truth.terrain_class[truth.surface >= 0] == TerrainClass.ROCK).all()
    assert ((truth.terrain_class == TerrainClass.SKY) == np.isinf(truth.depth)).all()


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("noise", [0.5, 1.5, 4.0])
def test_the_gray_image_has_the_set_noise_at_mid_gray(color, noise):
    radiance = np.full((400, 400, 3), MID_GRAY_LIGHT, np.float32)
    pair = [
        camera.expose(radiance, 1.0, 0.5, 0.0, noise, np.random.default_rng(seed), color).astype(np.float64)
        for seed in (1, 2)
    ]
    first, second = (picture @ camera.LUMA if color else picture for picture in pair)
    rounding = 1 / 12 * (camera.LUMA_NOISE**2 if color else 1)
    assert first.mean() == pytest.approx(127.5, abs=0.2)
    assert np.sqrt(np.var(first - second) / 2 - rounding) == pytest.approx(noise, rel=0.02)


def test_light_has_more_noise_than_dark():
    def spread(light):
        flat = np.full((200, 200, 3), light * MID_GRAY_LIGHT, np.float32)
        return np.std(camera.expose(flat, 1.0, 0.0, 0.0, 4.0, np.random.default_rng(1), color=False).astype(float))

    assert spread(0.05) < 0.8 * spread(1.0)
    assert spread(2.5) > 1.2 * spread(1.0)


def test_corners_lose_the_set_share_of_light():
    flat = np.full((100, 140, 3), 0.5, np.float32)
    picture = camera.expose(flat, 1.0, 0.0, 0.4, 0.0, np.random.default_rng(1), color=False)
    linear = (picture / 255.0) ** 1.5
    assert linear[0, 0] / linear[50, 70] == pytest.approx(0.6, abs=0.01)


def test_the_right_image_gets_the_set_share_of_light_more():
    dark = replace(CALM, brightness=0.5, blur=0.0, vignetting=0.0)
    plain, bright = (
        replace(dark, exposure_difference=share).frame(0).images[1].astype(float) ** 1.5 for share in (0.0, 0.15)
    )
    assert bright.sum() / plain.sum() == pytest.approx(1.15 / 1.0, abs=0.005)


def test_the_right_image_is_too_low_by_the_set_rows():
    sharp = replace(CALM, blur=0.0, vignetting=0.0)
    plain, low = (replace(sharp, row_offset=rows).frame(0) for rows in (0.0, 2.0))
    np.testing.assert_array_equal(plain.images[0], low.images[0])
    difference = np.abs(low.images[1][2:].astype(int) - plain.images[1][:-2])
    assert np.mean(difference > 1) < 1e-3
    np.testing.assert_array_equal(plain.seen[:-2], low.seen[:-2])
    assert (low.seen[-2:] < 255).all()  # their places in the right image are below it
    np.testing.assert_array_equal(plain.seen[-2:] > 0, low.seen[-2:] > 0)


def test_motion_blur_is_the_mean_of_the_images_during_the_exposure():
    moving = replace(CALM, width=240, height=180, speed=2.0, exposure_time=0.03, blur=0.0, vignetting=0.0)
    stamp, half = moving.stamp(0), 15_000_000
    with ThreadPoolExecutor(2) as pool:
        poses = [moving.base_at(stamp + round(t * half)).after(moving.mounts[0]) for t in np.linspace(-1, 1, 17)]
        mean = np.mean([moving._render(pose, pool)[3] for pose in poses], axis=0, dtype=np.float32)
    expected = camera.expose(mean, 1.0, 0.0, 0.0, 0.0, np.random.default_rng(1), color=False).astype(float)
    blurred = moving.frame(0)
    sharp = replace(moving, exposure_time=0.0).frame(0)
    near = blurred.depth < 3
    error, without = (
        np.sqrt(np.mean((truth.images[0].astype(float) - expected)[near] ** 2)) for truth in (blurred, sharp)
    )
    assert error < 0.35 * without
    np.testing.assert_array_equal(blurred.depth, sharp.depth)


@pytest.mark.parametrize("color", [True, False])
def test_jpeg_images_are_logged_as_they_are_seen(tmp_path: Path, color):
    compressed = replace(CALM, frames=1, width=160, height=120, color=color, jpeg=60)
    write_log(compressed, tmp_path / "log.mcap")
    written = iter_decoded(tmp_path / "log.mcap")
    images = {topic: pixels_of(message) for topic, _, message in written if topic.endswith("/compressed")}
    name = "image_rect_color" if color else "image_rect"
    for side, seen in zip(("left", "right"), compressed.frame(0).images, strict=True):
        np.testing.assert_array_equal(images[f"/stereo/{side}/{name}/compressed"], seen)
    raw = replace(compressed, jpeg=None).frame(0).images[0].astype(float)
    assert 0.5 < np.std(raw - images[f"/stereo/left/{name}/compressed"]) < 10


@pytest.mark.parametrize("scene", SCENES)
def test_a_set_parameter_wins_over_its_scene(scene):
    simulation = Simulation(scene=scene, noise=7.0)
    assert simulation.noise == 7.0
    assert simulation.sun_elevation == defaults_of(scene)["sun_elevation"]
    assert scene in OPTIONS["scene"][1]
    bare = Simulation(scene=scene, sand=1.0)
    assert (bare.dust, bare.bedrock) == (0.0, 0.0)


def test_an_unknown_scene_or_too_much_ground_is_refused(tmp_path, refused):
    out = tmp_path / "log.mcap"
    assert f"--scene must be one of {', '.join(SCENES)}, not sea" in refused("simulate", out, "--scene", "sea")
    why = refused("simulate", out, "--sand", 80, "--bedrock", 30)
    assert "--sand must be at most 100 % with dust and bedrock, not 110 %" in why


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_sets_its_field(option, tmp_path, monkeypatch, said):
    given = {"scene": "dusk", "frames": 3, "seed": 4, "jpeg": 50, "imu": "raw"}.get(option, 0.4)
    value = given * {"DEG": math.pi / 180, "PERCENT": 0.01, "MS": 0.001}.get(OPTIONS[option][0], 1)
    made = list[Simulation]()
    monkeypatch.setattr(simulate, "simulate", lambda out, **settings: made.append(Simulation(**settings)))
    said(0, "simulate", tmp_path / "log.mcap", f"--{option.replace('_', '-')}", given)
    assert getattr(made[0], FIELDS.get(option, option)) == value
