"""The tilt of a log without orientations: estimated, or read from accelerations or poses where a setting says so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Severity
from recordings import McapSource
from recordings.discovery.roles import TiltKind
from recordings.errors import LogError
from recordings.inertial.up_estimator import UpEstimator
from recordings.inventory.text import format_description
from recordings.ros2.cdr import make
from recordings.ros2.tilt_from_msg import AccelerationField, acceleration_of
from recordings.ros2.to_msg import header, imu, odometry, quaternion, raw_imu, transform_message
from recordings.source.settings import LogSettings, TimeOffsets
from recordings.source.tilt_reading import TiltReading, estimated_tilts
from stages.data import Pose, Tilt, Transform
from tests.conftest import rewrite, slow, write_messages
from tests.recordings.inertial.drive import Drive, drive
from tests.recordings.sample_log import TRANSFORMS, inventory_of, missing_in, stereo_rows

IMU = "/imu0"
Messages = Callable[[int, int, np.ndarray, np.ndarray], dict[str, Any]]  # number, stamp, rate, force -> by topic


def kalibr(number: int, stamp: int, rate: np.ndarray, force: np.ndarray) -> dict[str, Any]:
    """An Imu as kalibr's bags have it: the quaternion and its covariance are 0."""
    message = raw_imu(stamp, "imu_link", rate, force)
    message.orientation_covariance[0] = 0.0
    return {IMU: message}


def written(path: Path, driven: Drive, messages: Messages = kalibr, *transforms: Transform) -> Path:
    """A log of a drive with five frames."""
    start = int(driven.stamps[0])
    logged = [(start, "/tf_static", transform_message([(t, start) for t in (*TRANSFORMS, *transforms)]))]
    for number, sample in enumerate(zip(driven.stamps.tolist(), driven.rates, driven.forces, strict=True)):
        stamp = sample[0]
        logged += [(stamp, topic, message) for topic, message in messages(number, *sample).items()]
        if number % (len(driven.stamps) // 5) == 9:
            logged += stereo_rows(stamp, number)
    return write_messages(path, logged)


def read(path: Path, source: McapSource | None = None, **bounds: float) -> tuple[list[Tilt], list[str], str]:
    """The tilts of a log, the losses of the inclinometer, and the note about it."""
    with (source or McapSource()).open(path, **bounds) as log:
        assert "inclinometer" not in log.missing
        events = list(log.events())
        assert [time for time, _, _ in events] == sorted(time for time, _, _ in events)
        items = [item for _, stream, item in events if stream == "inclinometer"]
        note = log.notes().get("inclinometer", "")
    return [i for i in items if isinstance(i, Tilt)], [str(i) for i in items if not isinstance(i, Tilt)], note


def missing(path: Path, **settings: Any) -> str:
    """Why a log lacks the tilt."""
    return missing_in(path, **settings)["inclinometer"]


def absent(number: int, stamp: int, rate: np.ndarray, force: np.ndarray) -> dict[str, Any]:
    return {IMU: raw_imu(stamp, "imu_link", rate, force)}


def default(number: int, stamp: int, rate: np.ndarray, force: np.ndarray) -> dict[str, Any]:
    message = kalibr(number, stamp, rate, force)[IMU]
    message.orientation = quaternion(np.array([0.0, 0.0, 0.0, 1.0]))
    return {IMU: message}


def heading(number: int, stamp: int, rate: np.ndarray, force: np.ndarray) -> dict[str, Any]:
    message = kalibr(number, stamp, rate, force)[IMU]
    message.orientation = quaternion(Rotation.from_euler("z", number / 1000).as_quat())
    return {IMU: message}


@pytest.mark.parametrize(("messages", "why"), [
    (kalibr, "is not a rotation: [0.0, 0.0, 0.0, 0.0]"),
    (absent, "the Imu marks its orientation as absent"),
    (default, "it is 1 in every message"),
    (heading, "its roll and pitch are 0 in every message"),
])  # fmt: skip
def test_up_is_estimated_where_an_imu_has_no_orientation(tmp_path, messages, why):
    driven = drive(seconds=12)
    path = written(tmp_path / "log.mcap", driven, messages)
    tilts, lost, note = read(path)
    assert (len(tilts), lost) == (len(driven.stamps), [])
    assert np.sqrt(np.mean(driven.errors(tilts) ** 2)) < 0.3
    assert all(0 < tilt.sigma < np.radians(1) and tilt.frame_id == "imu_link" for tilt in tilts)
    assert note.startswith(f"the tilt is estimated from the accelerations and rates on {IMU}, because its orientation")
    assert why in note
    assert "at rest for 4 of 12 s; gravity is 9.79 m/s2, as on Earth" in note
    shown = format_description(inventory_of(path, max_gap=10**8))
    assert f"note: inclinometer: the tilt is estimated from the accelerations and rates on {IMU}" in shown


@pytest.mark.parametrize(("late", "logged_late"), [(0, 0), (2_000_000_000, 0), (2_000_000_000, 2_000_000_000)])
def test_a_part_of_a_log_has_the_estimates_around_it_by_corrected_stamps(tmp_path, late, logged_late):
    driven = drive(seconds=40)
    path = written(tmp_path / "log.mcap", driven, lambda number, stamp, *values: kalibr(number, stamp + late, *values))
    path = rewrite(path, tmp_path / "late.mcap", time=lambda topic, time: time + logged_late * (topic == IMU))
    source = McapSource(time_offset=TimeOffsets(inclinometer=-late))
    tilts, _, _ = read(path, source, start=16, end=17)
    times = (np.array([tilt.stamp for tilt in tilts]) - driven.stamps[0]) / 1e9
    assert (times[0], times[-1]) == (pytest.approx(15, abs=0.02), pytest.approx(18, abs=0.02))
    assert driven.errors(tilts).max() < 0.6


def test_a_part_of_a_log_has_the_estimates_of_the_whole_log(tmp_path):
    path = written(tmp_path / "log.mcap", drive(seconds=40))
    whole, part = ({tilt.stamp: tilt for tilt in read(path, **bounds)[0]} for bounds in ({}, {"start": 24, "end": 25}))
    assert len(part) == 300
    assert all(np.array_equal(tilt.up, whole[stamp].up) for stamp, tilt in part.items())
    assert all(tilt.sigma == whole[stamp].sigma for stamp, tilt in part.items())


def test_a_part_after_stamps_have_jumped_back_is_estimated_from_those_after(tmp_path):
    driven = drive(seconds=60)
    back = int(driven.stamps[2000])
    path = written(
        tmp_path / "log.mcap", driven,
        lambda number, stamp, *values: kalibr(number, stamp - 3600 * 10**9 * (stamp > back), *values),
    )  # fmt: skip
    assert len(read(path, start=48, end=49)[0]) == 300


def test_a_broken_sample_is_lost_alone_and_so_is_a_wrong_stamp(tmp_path):
    driven = drive(seconds=12)

    def broken(number, stamp, rate, force):
        ahead = {300: 3600 * 10**9, 400: -(10**9)}.get(number, 0)
        return kalibr(number, stamp + ahead, rate, force * (np.nan if number == 500 else 1))

    tilts, lost, _ = read(written(tmp_path / "log.mcap", driven, broken))
    assert len(tilts) == len(driven.stamps) - 3
    assert ["'linear_acceleration' contains" in sentence for sentence in lost] == [False, False, True]
    assert "is 3600.0 s ahead of the one before" in lost[0]
    assert "does not follow" in lost[1]
    assert driven.errors(tilts).max() < 0.6


def test_samples_recorded_twice_are_no_loss(tmp_path):
    driven = drive(seconds=6)
    once = written(tmp_path / "once.mcap", driven)
    repeated = rewrite(once, tmp_path / "log.mcap", order=lambda messages: [m for m in messages for _ in range(2)])
    tilts, lost, _ = read(repeated)
    assert lost == []
    assert [tilt.stamp for tilt in tilts] == driven.stamps.tolist()


def test_samples_of_another_sensor_on_the_topic_are_lost(tmp_path):
    driven = drive(seconds=12)
    turn = Rotation.from_euler("y", 20, degrees=True)

    def mixed(number, stamp, rate, force):
        if number % 2:
            return kalibr(number, stamp, rate, force)
        return {IMU: raw_imu(stamp, "rear_link", turn.apply(rate), turn.apply(force))}

    path = written(tmp_path / "log.mcap", driven, lambda number, *sample: mixed(number + 1, *sample))
    with McapSource().open(path) as log:
        events = [(time, item) for time, stream, item in log.events() if stream == "inclinometer"]
    tilts = {time: item for time, item in events if isinstance(item, Tilt)}
    assert driven.errors(list(tilts.values())).max() < 0.6
    assert all(time == tilt.stamp for time, tilt in tilts.items())  # losses do not delay them
    assert len(events) - len(tilts) == len(driven.stamps) // 2
    why = "its frame is 'rear_link', but the mount is that of 'imu_link'"
    assert all(str(item).endswith(why) for _, item in events if not isinstance(item, Tilt))
    damage = inventory_of(path)["damage"]
    assert len(damage) == 1
    assert why in damage[0]

    def opposed(number, stamp, rate, force):
        return {IMU: raw_imu(stamp, ("imu_link", "rear_link")[number % 2], rate, force * (-1) ** number)}

    why = missing(written(tmp_path / "opposed.mcap", drive(seconds=4), opposed))
    assert f"{IMU} contains messages of several sensors (in the frames 'imu_link', 'rear_link')" in why


@pytest.mark.parametrize(("gravity", "unit"), [(9.81, None), (1.62, ""), (1.0, ", and its unit is m/s2, not g")])
def test_a_gravity_that_the_accelerations_contradict_is_a_fault(tmp_path, gravity, unit):
    with McapSource(gravity=gravity).open(written(tmp_path / "log.mcap", drive(seconds=12))) as log:
        assert len(list(log.events())) > 1000
        found = log.faults().get("inclinometer")
    if unit is None:
        assert found is None
        return
    assert (found.severity, found.about) == (Severity.FAULT, "tilt")
    assert found.sentence.startswith(f"Gravity is 9.79 m/s2 by the accelerations on {IMU}, ")
    assert f"'gravity' of the source is {gravity:g}{unit}. Correct it, or leave it out." in found.sentence


def test_accelerations_in_g_are_a_fault_beside_a_right_gravity(tmp_path):
    path = written(tmp_path / "log.mcap", drive(seconds=12), lambda n, t, rate, force: kalibr(n, t, rate, force / 9.81))
    with McapSource(gravity=9.81).open(path) as log:
        assert len(list(log.events())) > 1000
        found = log.faults()["inclinometer"]
    assert found.sentence.startswith(f"Gravity is 1.00 by the accelerations on {IMU}: they are in g, so ")
    assert "Convert them to m/s2" in found.sentence
    assert "'gravity'" not in found.sentence


def test_a_bias_of_the_accelerometer_contradicts_gravity_in_the_note_and_the_fault_or_in_neither():
    reading = TiltReading(TiltKind.ESTIMATE, IMU, IMU)
    for measured, contradicts in ((1.70, False), (1.90, True)):
        made = UpEstimator("imu_link", 0.05, gravity=1.62, seconds=10.0, measured_gravity=measured)
        assert ("but 'gravity' of the source is 1.62" in reading.note(made, LogSettings())) == contradicts
        assert (reading.fault(made) is not None) == contradicts


def split(number, stamp, rate, force):
    """Accelerations and rates on two topics, of two frames, as of a RealSense."""
    gyroscope = Rotation.from_euler("z", -90, degrees=True).apply(rate)
    rates = raw_imu(stamp, "gyro_link", gyroscope, np.zeros(3))
    accelerations = raw_imu(stamp + 2_000_000, "imu_link", np.zeros(3), force)
    return {"/camera/gyro/sample": rates} | ({"/camera/accel/sample": accelerations} if number % 2 else {})


def test_tilts_and_losses_do_not_wait_for_the_end_of_a_log_of_losses():
    driven, second = drive(seconds=8), 10**9
    end = int(driven.stamps[-1])
    logged = [(sample.stamp, sample) for sample in driven.samples()]
    logged += [(end + number * second, LogError("broken")) for number in range(1, 1000)]
    rest = iter(logged)
    made = estimated_tilts(TiltReading(TiltKind.ESTIMATE, IMU, IMU), rest, UpEstimator("imu_link", 0.05))
    first = [next(made) for _ in range(801)]
    assert [time for time, _ in first] == [*driven.stamps.tolist(), end + second]
    assert next(rest)[0] < end + 150 * second
    assert sum(1 for _ in made) == 997  # without the one above


@pytest.mark.parametrize(("rates", "wrong"), [
    (lambda rate: rate, False),
    (np.degrees, True),
    (lambda rate: rate[[1, 0, 2]], True),
    *slow((lambda rate: -rate, True), (lambda rate: rate * [1, -1, 1], True)),
], ids=["sound", "degrees", "exchanged", "sign", "left-handed"])  # fmt: skip
def test_rates_that_contradict_the_accelerations_are_a_fault(tmp_path, rates, wrong):
    path = written(tmp_path / "log.mcap", drive(seconds=20), lambda n, t, rate, force: kalibr(n, t, rates(rate), force))
    with McapSource().open(path) as log:
        assert log.faults() == {}
        assert len(list(log.events(["inclinometer"]))) == 2000
        found = log.faults()
    assert bool(found) == wrong
    if wrong:
        assert (found["inclinometer"].severity, found["inclinometer"].about) == (Severity.FAULT, "tilt")
        assert "Check the axes, the signs and the unit (rad/s)" in found["inclinometer"].sentence


def test_an_estimate_may_be_preferred_to_the_orientation(tmp_path):
    driven = drive(seconds=8)

    def oriented(number, stamp, rate, force):
        message = kalibr(number, stamp, rate, force)[IMU]
        message.orientation = quaternion(Rotation.from_euler("x", 40 + number % 2, degrees=True).as_quat())
        return {IMU: message}

    path = written(tmp_path / "log.mcap", driven, oriented)
    assert driven.errors(read(path)[0]).mean() > 30
    assert driven.errors(read(path, McapSource(gyroscope=IMU))[0]).mean() < 0.3


def test_accelerations_without_gravity_are_no_tilt(tmp_path):
    driven = drive(seconds=4, rest=1)
    driven.forces[:] -= 9.81 * driven.up
    why = missing(written(tmp_path / "log.mcap", driven))
    assert "/imu0 contains no orientation" in why
    assert "its accelerations contain no gravity" in why


def test_a_gyroscope_needs_accelerations(tmp_path):
    turn = Rotation.from_euler("x", 10, degrees=True).as_quat()

    def beside(number, stamp, rate, force):
        """An inclinometer, and an Imu of rates only."""
        fields = {"header": header(stamp, "imu_link"), "quaternion": quaternion(turn)}
        tilt = make("geometry_msgs/msg/QuaternionStamped", **fields)
        return {"/tilt": tilt, IMU: raw_imu(stamp, "imu_link", rate, 0 * force)}

    path = written(tmp_path / "log.mcap", drive(seconds=2), beside)
    assert read(path)[2] == ""
    assert "/imu0 has no accelerations to go with the rates" in missing(path, gyroscope=IMU)


def test_accelerations_need_no_covariance():
    vector = SimpleNamespace(x=0, y=1, z=9.8)
    assert acceleration_of(SimpleNamespace(linear_acceleration=vector)) == (0, 1, 9.8)
    marked = SimpleNamespace(linear_acceleration=vector, linear_acceleration_covariance=[-1] + 8 * [0])
    assert acceleration_of(marked) is None


@pytest.mark.parametrize(("field", "sign"), [("vector", -1), ("vector.x vector.y vector.z", -1)])
def test_an_inclinometer_may_log_three_accelerations(tmp_path, field, sign):
    driven = drive(seconds=6)

    def accelerations(number, stamp, rate, force):
        x, y, z = (sign * force).tolist()
        vector = make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        logged = make("geometry_msgs/msg/Vector3Stamped", header=header(stamp, "imu_link"), vector=vector)
        return {"/inclinometer": logged}

    path = written(tmp_path / "log.mcap", driven, accelerations)
    assert (
        "whose numbers have no defined meaning; set 'pitch', 'roll' (each field, unit, sign) and 'tilt_model'"
        in missing(path)
    )
    tilts, _, note = read(path, McapSource(accelerations=AccelerationField(field, sign)))
    assert driven.errors(tilts[:400]).max() < 0.5
    assert "the direction of the acceleration on /inclinometer, right only at rest" in note
    assert "has no field 'angles.x'" in missing(path, accelerations=AccelerationField("angles"))


@pytest.mark.parametrize("named", [{}, {"gyroscope": IMU}, {"inclinometer": IMU}])
def test_an_imu_with_negated_accelerations_is_found_by_their_field(tmp_path, named):
    driven = drive(seconds=6)
    path = written(tmp_path / "log.mcap", driven, lambda number, t, rate, force: kalibr(number, t, rate, -force))
    tilts, lost, note = read(path, McapSource(accelerations=AccelerationField("linear_acceleration", -1), **named))
    assert (len(tilts), lost) == (len(driven.stamps), [])
    assert driven.errors(tilts).max() < 0.6
    assert note.startswith(f"the tilt is estimated from the accelerations and rates on {IMU}; at rest")
    assert "has no field 'vector.x'" in missing(path, accelerations=AccelerationField("vector"), **named)


def test_an_imu_without_rates_gives_the_direction_of_each_acceleration(tmp_path):
    driven = drive(seconds=6)
    path = written(tmp_path / "log.mcap", driven, lambda n, t, rate, force: kalibr(n, t, np.zeros(3), force))
    tilts, _, note = read(path)
    assert driven.errors(tilts[:400]).max() < 0.5
    assert "right only at rest" in note


@pytest.mark.parametrize(("variance", "noted"), [(0.2, False), (1e6, True)])
def test_a_covariance_that_states_an_unknown_tilt_is_noted(tmp_path, variance, noted):
    up = Rotation.from_euler("ZYX", [80, 4, -7], degrees=True).as_quat()

    def unsure(number, stamp, rate, force):
        return {IMU: imu(stamp, "imu_link", up, variance * np.eye(3))}

    tilts, _, note = read(written(tmp_path / "log.mcap", drive(seconds=3), unsure))
    assert tilts[-1].sigma == pytest.approx(min(np.sqrt(variance), np.pi / 2))
    assert ("states that roll and pitch are unknown" in note) == noted


def test_poses_in_an_upright_frame_are_tilts_where_a_setting_says_so(tmp_path):
    driven = drive(seconds=3)
    turn = Rotation.from_euler("ZYX", [80, 4, -7], degrees=True)

    def poses(number, stamp, rate, force):
        pose = Pose(stamp, [0, 0, 0], turn.as_quat(), "odom", "base_link")
        at = Transform("odom", "base_link", turn.as_matrix(), np.zeros(3))
        return {"/odom": odometry(pose), "/tf": transform_message([(at, stamp)])}

    path = written(tmp_path / "log.mcap", driven, poses)
    assert "the log has no tilt" in missing(path)
    for source in (McapSource(upright_frame="odom"), McapSource(upright_frame="/odom", inclinometer="/tf")):
        tilts, lost, note = read(path, source)
        assert (len(tilts), lost) == (len(driven.stamps), [])
        np.testing.assert_allclose(tilts[0].up, turn.inv().apply([0, 0, 1]), atol=1e-12)
        assert "whose frame 'odom' has z up" in note
    with McapSource(upright_frame="odom").open(path) as log:  # these poses place the rover too
        assert sum(isinstance(item, Pose) for _, _, item in log.events()) == len(driven.stamps)
    _, lost, _ = read(path, McapSource(upright_frame="map"))
    assert "its frame is 'odom', but 'upright_frame' of the source is 'map'" in lost[0]
