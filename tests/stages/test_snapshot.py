"""The state of a stage can be saved halfway through a run and restored: the results have the same bits."""

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

import stages
from flow.runtime.graph import has_state
from recordings.simulator import Simulation
from recordings.simulator.ground_truth import true_disparity
from stages import CheckMatches, CheckTilt, Fuse, FuseRegion, Level, MapRegion, PoseFilter, Reproject, VisualOdometry
from stages.data import Mount, StereoFrame, Tilt
from stages.stage import restore, snapshot
from tests.stages.builders import disparity_of
from tests.stages.localisation.drive import Drive, readings
from tests.stages.running import Running

FRAMES = 4


@pytest.fixture(scope="module")
def inputs():
    """Stage -> what each of some frames gives it."""
    simulation, drive = Simulation(frames=FRAMES, width=320, height=240, relief_cells=512, seed=5), Drive(2, 6.0)
    given, fuse = {VisualOdometry: [], FuseRegion: [], MapRegion: []}, Running(FuseRegion())
    left = simulation.mounts[0]
    for index in range(FRAMES):
        truth, stamp = simulation.frame(index), simulation.stamp(index)
        frame = StereoFrame(stamp, *truth.images, simulation.camera)
        disparity = replace(true_disparity(simulation, stamp, truth), camera=simulation.camera)
        given[VisualOdometry].append((frame, disparity))
        base, mount = simulation.base_at(stamp), Mount(stamp, left.rotation.T, left)
        cloud = Level()(Reproject()(frame, disparity), Tilt(stamp, base.rotation[2]), mount)
        given[FuseRegion].append((cloud, simulation.odometry[5 + 5 * index], mount))
        given[MapRegion].append((fuse(*given[FuseRegion][-1]),))
    upright = [(*reading, Mount(0, drive.mount)) for reading in readings(drive)]
    nothing = disparity_of(np.full((8, 8), np.nan))
    given[Fuse] = given[FuseRegion]
    return given | {PoseFilter: upright, CheckTilt: upright, CheckMatches: [(nothing,)] * FRAMES}


def same(one, other):
    """Whether two data, or what is in them, have the same bits."""
    if is_dataclass(one):
        return type(one) is type(other) and all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if hasattr(one, "items"):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return one == other or (one != one and other != other)


KINDS = [VisualOdometry, PoseFilter, CheckTilt, CheckMatches, Fuse, FuseRegion, MapRegion]


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_in_two_parts_is_the_whole_run(inputs, kind):
    frames, stage = inputs[kind], MapRegion(step=5.0) if kind is MapRegion else kind()
    half, whole, first, fresh = len(frames) // 2 + 1, stage.start(), stage.start(), stage.start()
    wanted = [stage(*given, state=whole) for given in frames]
    found = [stage(*given, state=first) for given in frames[:half]]
    saved = snapshot(stage, first)
    stage(*frames[half], state=first)  # changes nothing that was saved
    second = restore(stage, saved)
    found += [stage(*given, state=second) for given in frames[half:]]
    assert all(map(same, wanted, found))
    assert kind is MapRegion or stage.finding(second) == stage.finding(whole)
    forgotten = [stage(*given, state=fresh) for given in frames[half:]]
    assert not all(map(same, wanted[half:], forgotten)) or snapshot(stage, whole) != snapshot(stage, fresh)


def test_every_stage_with_state_is_tried_above():
    assert {kind for name in dir(stages) if has_state(kind := getattr(stages, name))} == set(KINDS)


def test_a_snapshot_of_another_stage_is_refused():
    with pytest.raises(ValueError, match="a snapshot of PoseFilter is not one of CheckTilt"):
        restore(CheckTilt(), snapshot(PoseFilter(), PoseFilter().start()))
