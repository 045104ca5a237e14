"""The tilt that is estimated from accelerations and rates on two topics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings import McapSource
from recordings.inventory.text import format_description
from recordings.ros2.tilt_from_msg import AccelerationField
from recordings.ros2.to_msg import raw_imu
from recordings.source.settings import TimeOffsets
from stages.data import Transform
from tests.conftest import rewrite
from tests.recordings.inertial.drive import drive
from tests.recordings.sample_log import inventory_of, missing_in
from tests.recordings.source.test_tilt_reading import missing, read, written


def split(number, stamp, rate, force):
    """Accelerations and rates on two topics, of two frames, as of a RealSense."""
    gyroscope = Rotation.from_euler("z", -90, degrees=True).apply(rate)
    rates = raw_imu(stamp, "gyro_link", gyroscope, np.zeros(3))
    accelerations = raw_imu(stamp + 2_000_000, "imu_link", np.zeros(3), force)
    return {"/camera/gyro/sample": rates} | ({"/camera/accel/sample": accelerations} if number % 2 else {})


GYRO = Transform("imu_link", "gyro_link", Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.zeros(3))


def test_accelerations_and_rates_may_come_on_two_topics(tmp_path):
    driven = drive(seconds=15)
    path = written(tmp_path / "log.mcap", driven, split, GYRO)
    tilts, lost, note = read(path)
    assert lost == []
    assert np.sqrt(np.mean(driven.errors(tilts) ** 2)) < 0.3
    assert "the accelerations on /camera/accel/sample and the rates on /camera/gyro/sample" in note
    unjoined = written(tmp_path / "unjoined.mcap", driven, split)
    assert "joins the accelerometer ('imu_link', /camera/accel/sample) and the gyroscope" in missing(unjoined)

    def second(*sample):
        return split(*sample) | {"/drill": raw_imu(sample[1], "drill", sample[2], np.zeros(3))}

    named = written(tmp_path / "three.mcap", drive(seconds=2), second, GYRO)
    assert read(named)[2].count("/camera/gyro/sample") == 1  # the one of the same name

    def unnamed(*sample):
        found = split(*sample)
        accelerations = {"/board": found["/camera/accel/sample"]} if "/camera/accel/sample" in found else {}
        return accelerations | dict.fromkeys(("/one", "/two"), found["/camera/gyro/sample"])

    several = written(tmp_path / "several.mcap", drive(seconds=2), unnamed, GYRO)
    with McapSource().open(several) as log:
        assert "rates that may go with the accelerations of /board (/one, /two)" in log.missing["inclinometer"]
        offered = [remedy.settings for remedy in log.resolution.remedies["inclinometer"]]
    assert offered == [{"gyroscope": "/one"}, {"gyroscope": "/two"}]
    assert all("inclinometer" not in missing_in(several, **settings) for settings in offered)
    assert "gyroscope' is set to /left/image_rect" in missing(named, gyroscope="/left/image_rect")


def test_rates_of_another_gyroscope_on_the_topic_are_lost(tmp_path):
    driven = drive(seconds=4)

    def mixed(number, *sample):
        found = split(number, *sample)
        if number % 4 == 1:
            found["/camera/gyro/sample"].header.frame_id = "other_link"
        return found

    tilts, lost, _ = read(written(tmp_path / "log.mcap", driven, mixed, GYRO))
    assert (len(tilts), len(lost)) == (300, 100)
    assert all("its frame is 'other_link', but the rates are those of 'gyro_link'" in sentence for sentence in lost)


@pytest.mark.parametrize("late", ["accel", "gyro"])
def test_rates_and_accelerations_may_be_logged_at_other_times(tmp_path, late):
    driven = drive(seconds=15)
    soon = written(tmp_path / "soon.mcap", driven, split, GYRO)
    path = rewrite(soon, tmp_path / "log.mcap", time=lambda topic, time: time + 2 * 10**9 * (late in topic))
    tilts, lost, note = read(path)
    assert (len(tilts), lost) == (len(driven.stamps), [])
    assert np.sqrt(np.mean(driven.errors(tilts) ** 2)) < 0.3
    when, by = ("later", 2.002) if late == "gyro" else ("earlier", -1.998)
    setting = f"if a clock is wrong, --set source.time_offset.gyroscope={by}s corrects the rates"
    assert f"rates are logged 2.00 s {when} after their stamps than accelerations: {setting}" in note
    assert "corrects the rates" not in read(soon)[2]
    described = inventory_of(path)
    assert (described["frames"]["with_tilt"], described["damage"]) == (5, [])
    waiting = "tilts arrive in the log 2.0 s later than images of the same stamp; if no clock is wrong, --set tilt.pat"
    assert (waiting in format_description(described)) == (late == "gyro")


def test_rates_that_are_logged_too_late_are_lost_and_info_foresees_it(tmp_path):
    driven = drive(seconds=15)
    soon, since = written(tmp_path / "soon.mcap", driven, split, GYRO), int(driven.stamps[900])
    late = lambda topic, time: time + 4 * 10**9 * ("gyro" in topic and time >= since)  # noqa: E731
    path = rewrite(soon, tmp_path / "log.mcap", time=late)
    tilts, lost, _ = read(path)
    assert (len(tilts), len(lost)) == (900, 600)
    assert f"/camera/gyro/sample at {since + 4 * 10**9} ns: its stamp {since} ns is 4.0 s behind" in lost[0]
    described = inventory_of(path)
    assert described["damage"][0].startswith("600 similar, first: /camera/gyro/sample at ")
    assert described["frames"]["with_tilt"] == 3


@pytest.mark.parametrize("behind", [1_000_000_000_000, -5_000_000_000])
def test_rates_with_stamps_of_another_clock_are_refused_with_the_setting(tmp_path, behind):
    driven = drive(seconds=6)

    def apart(number, stamp, rate, force):
        sample = split(number, stamp, rate, force)
        return sample | {"/camera/gyro/sample": split(number, stamp - behind, rate, force)["/camera/gyro/sample"]}

    path = written(tmp_path / "log.mcap", driven, apart, GYRO)
    why = missing(path)
    assert "(/camera/accel/sample) and the rates (/camera/gyro/sample) are of clocks that differ by" in why
    assert f"--set source.time_offset.gyroscope={behind / 1e9 + 0.002:.3f}s corrects the rates" in why
    tilts, lost, note = read(path, McapSource(time_offset=TimeOffsets(gyroscope=behind)))
    assert (len(tilts), lost) == (len(driven.stamps), [])
    assert driven.errors(tilts).max() < 0.6
    assert "corrects the rates" not in note


def test_a_part_is_estimated_from_the_beginning_whatever_the_clock_of_the_rates(tmp_path):
    driven, behind = drive(seconds=26), 1000 * 10**9

    def apart(number, stamp, rate, force):
        rates = split(number, stamp - behind, rate, force)["/camera/gyro/sample"]
        return split(number, stamp, rate, force) | {"/camera/gyro/sample": rates}

    path = written(tmp_path / "together.mcap", driven, apart, GYRO)
    log = rewrite(path, tmp_path / "log.mcap", time=lambda topic, time: time + 3_000_000 * ("accel" in topic))
    source = McapSource(time_offset=TimeOffsets(gyroscope=behind))
    whole = {tilt.stamp: tilt for tilt in read(log, source)[0]}
    for start in (24.008, 24.01, 24.012):
        with source.open(log) as opened:
            opened.narrow(start, start + 0.1)
            part = [item for _, stream, item in opened.events() if stream == "inclinometer"]
        assert part
        assert all(np.array_equal(tilt.up, whole[tilt.stamp].up) for tilt in part)


def test_the_accelerations_of_the_setting_are_not_those_of_a_gyroscope(tmp_path):
    driven = drive(seconds=4)
    path = written(tmp_path / "log.mcap", driven, split, GYRO)
    tilts, _, note = read(path, McapSource(accelerations=AccelerationField("linear_acceleration")))
    assert "the accelerations on /camera/accel/sample and the rates on /camera/gyro/sample" in note
    assert driven.errors(tilts).max() < 0.6
