"""Stages: `help()` shows the meaning of every parameter, and inputs that do not belong together are refused."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import stages
from flow.config.reference import stage_reference
from flow.contracts import StageError
from stages import CameraModel, StereoCamera, StereoFrame
from stages.stage import Stage
from tests.stages.builders import cloud_of, disparity_of
from tests.stages.running import Running

NAMED = {name: getattr(stages, name) for name in dir(stages)}
KINDS = {name: kind for name, kind in NAMED.items() if isinstance(kind, type) and issubclass(kind, Stage)}


@pytest.mark.parametrize("name", sorted(KINDS))
def test_help_shows_the_meaning_of_every_parameter(name):
    (found,) = stage_reference(name)
    text = KINDS[name].__doc__
    assert text.count("\nParameters\n----------\n") == bool(found.parameters)
    for item in found.parameters:
        unit = f" : {item.unit}" if item.unit else ""
        inside = "." in item.name  # of a value such as the rover, which has its own help
        assert inside or f"\n{item.name}{unit}\n    {item.meaning}" in text


IMAGE = np.zeros((60, 80), np.uint8)
MODEL = CameraModel(80, 60, np.eye(3), np.zeros(5), np.eye(3), np.eye(3, 4))
FRAME = StereoFrame(7, IMAGE, IMAGE, StereoCamera(200, 200, 40, 30, 0.2, 80, 60))
RAW = replace(FRAME, camera=replace(FRAME.camera, raw=(MODEL, MODEL)))


def disparity(height=60, width=80, stamp=7):
    return disparity_of(np.ones((height, width)), stamp=stamp)


OF_FRAME_AND_DISPARITY = stages.Refine(), stages.RefinePaper(), stages.Reproject()
JOIN = "join the disparity with the rectified frame"
ANYTHING = (
    (stages.Rectify(), 1), (stages.Clean(), 1), (stages.MeasureNoise(), 1), (Running(stages.MapRegion()), 1),
    (Running(stages.CheckMatches()), 1), (stages.LeftRightCheck(), 2), (stages.Upsample(), 2),
    (Running(stages.CheckTilt()), 3), (Running(stages.PoseFilter()), 3),
)  # fmt: skip
NO_FRAME = "the frame must be a stages.StereoFrame, not a"
TIMES = "frame of 7 ns, disparity of 8 ns: join data"


@pytest.mark.parametrize(("stage", "inputs", "message"), [
    *((stage, (FRAME, disparity(30)), rf"{type(stage).__name__}: .* \(30, 80\), .*{JOIN}")
      for stage in OF_FRAME_AND_DISPARITY),
    *((stage, (RAW, disparity()), rf"put stages\.Rectify before stages\.{type(stage).__name__}")
      for stage in OF_FRAME_AND_DISPARITY),
    *((stage, (cloud_of(np.zeros((0, 3)), frame_id="cam"),), f"{type(stage).__name__}: .* 'cam', not 'level'; put")
      for stage in (stages.Voxelise(), stages.VoxelGrid())),
    (stages.Match(), (IMAGE, IMAGE), f"Match: {NO_FRAME} ndarray"),
    (stages.Refine(), (disparity(), FRAME), f"Refine: {NO_FRAME} Disparity"),
    (stages.Refine(), (FRAME, IMAGE), r"Refine: the disparity must be a stages\.Disparity, not a ndarray"),
    (stages.Match(), (FRAME, IMAGE), r"Match: the prior must be a stages\.Disparity, not a ndarray"),
    (stages.Voxelise(), (IMAGE,), r"Voxelise: the cloud must be a stages\.PointCloud, not a ndarray"),
    (stages.Level(), (cloud_of(np.ones((1, 3)), frame_id="cam"), [0, -1, 0]), "Level: the tilt must be a stages"),
    (stages.Level(), (disparity(), None), "Level: the cloud must be a stages"),
    *((stage, (IMAGE,), rf"{type(stage).__name__}: the elevation must be a stages\.ElevationMap, not a ndarray")
      for stage in (stages.TerrainFeatures(), stages.Binarise())),
    *((stage, (IMAGE,) * inputs, r"\w+: the \w+ must be a stages\.\w+, not a ndarray")
      for stage, inputs in ANYTHING),
    *((stage, (FRAME, disparity(stamp=8)), f"{type(stage).__name__}: {TIMES}") for stage in OF_FRAME_AND_DISPARITY[:2]),
    (Running(stages.VisualOdometry()), (FRAME, disparity(30)), JOIN),
    (stages.Upsample(), (FRAME, disparity(40, 66)), r"Upsample: .*\(40, 66\)"),
    (stages.Upsample(), (FRAME, disparity(30, 40, stamp=8)), f"Upsample: {TIMES}"),
    (stages.LeftRightCheck(), (disparity(), disparity(30)), "LeftRightCheck: .* at the same size"),
    (stages.LeftRightCheck(), (disparity(), disparity(stamp=8)),
     "LeftRightCheck: disparity of 7 ns, backward of 8 ns: join data"),
])  # fmt: skip
def test_inputs_that_do_not_belong_together_are_refused(stage, inputs, message):
    with pytest.raises(ValueError, match=message):
        stage(*inputs)


@pytest.mark.parametrize(("make", "call"), [
    (lambda: stages.Match(FRAME), "Match takes parameters; use Match()(frame)"),
    (lambda: stages.Match(frame=FRAME), "Match takes parameters; use Match()(frame)"),
    (lambda: stages.Halve(FRAME), "Halve takes parameters; use Halve()(frame)"),
    (lambda: stages.Upsample(FRAME, disparity()), "Upsample takes parameters; use Upsample()(frame, disparity)"),
    (lambda: stages.MapRegion(FRAME), "MapRegion takes parameters; use MapRegion()(region, state=state)"),
])  # fmt: skip
def test_a_stage_that_gets_its_input_as_a_parameter_says_how_to_call_it(make, call):
    with pytest.raises(StageError) as raised:
        make()
    assert str(raised.value) == call


@dataclass(frozen=True)
class Colder(stages.MeasureNoise):
    """A stage made from another, with data as a parameter and an input of another type."""

    warm: stages.ImageNoise | None = None

    def __call__(self, image: np.ndarray) -> stages.ImageNoise:
        return super().__call__(replace(FRAME, left=image))


def test_a_stage_made_from_another_may_have_data_as_a_parameter_and_other_inputs():
    noise = stages.MeasureNoise()(FRAME)
    assert np.array_equal(Colder(warm=noise)(IMAGE).sigma, noise.sigma)
    with pytest.raises(StageError, match=r"use Colder\(\)\(image\)"):
        Colder(FRAME)
