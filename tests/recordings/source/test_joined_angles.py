"""Pitch and roll on two topics: each tilt has both angles of one time."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recordings import McapSource
from recordings.errors import LogError
from recordings.inventory.description import describe
from recordings.ros2.cdr import make
from recordings.ros2.tilt_from_msg import AngleField, BareAngles, JoinedAngles, up_of
from recordings.ros2.to_msg import header
from stages.data import Tilt
from tests.conftest import write_messages
from tests.recordings.sample_log import START, TILT, dropped, essences, items_of, missing_in, refused_in, write_sample

FACING = (0.5, -0.5, 0.5, 0.5)
PITCH, ROLL = AngleField("data", "deg", 1, "/pitch"), AngleField("data", "deg", 1, "/roll")
LENGTH = 400_000_000  # ns, of the sample
LATER = 7_000_000  # ns, by which rolls are measured after pitches


def angles_at(stamp: int) -> tuple[float, float]:
    """Pitch and roll at a time, degrees."""
    seconds = (stamp - START) / 1e9
    return 10 + 20 * seconds, 5 - 30 * seconds


def source(**changes: object) -> McapSource:
    settings = {"pitch": PITCH, "roll": ROLL, "tilt_model": "axis", "camera_from_inclinometer": FACING, **changes}
    return McapSource(**settings)


def logged(
    folder: Path, hertz: tuple[int, int] = (20, 20), late: int = 0, bad: int = -1, headed: Collection[str] = ()
) -> list[Path]:
    """The sample without its Imu, and a file of angles. late: pitches are logged so long after their stamps, ns, or 0
    for messages without stamps; bad: number of a roll that is not a number; headed: topics with stamps anyway."""
    rows = []
    for topic, rate, first, delay in (("/pitch", hertz[0], 0, late), ("/roll", hertz[1], LATER, 0)):
        for number, stamp in enumerate(range(START + first, START + LENGTH + 1, 1_000_000_000 // rate)):
            angle = np.nan if (topic, number) == ("/roll", bad) else angles_at(stamp)[topic == "/roll"]
            message = make("std_msgs/msg/Float64", data=angle)
            if late or topic in headed:
                vector = make("geometry_msgs/msg/Vector3", x=angle, y=0.0, z=0.0)
                message = make("geometry_msgs/msg/Vector3Stamped", header=header(stamp, "tilt_link"), vector=vector)
            rows.append((stamp + delay, topic, message))
    return [write_sample(folder / "sample.mcap", dropped(TILT)), write_messages(folder / "angles.mcap", rows)]


@pytest.mark.parametrize("late", [0, 30_000_000])
@pytest.mark.parametrize("hertz", [(20, 20), (100, 20), (20, 100), (50, 30)])
def test_a_tilt_has_the_pitch_at_the_time_of_its_roll(tmp_path, hertz, late):
    field = "vector.x" if late else "data"
    settings = source(pitch=replace(PITCH, field=field), roll=replace(ROLL, field=field))
    events = items_of(logged(tmp_path, hertz, late), settings)
    assert [time for time, _, _ in events] == sorted(time for time, _, _ in events)
    tilts = [item for _, stream, item in events if stream == "inclinometer"]
    assert len(tilts) >= 0.4 * min(hertz) - 1
    stamps = [tilt.stamp for tilt in tilts]
    assert stamps == sorted({*stamps})
    for tilt in tilts:
        np.testing.assert_allclose(tilt.up, up_of(*np.deg2rad(angles_at(tilt.stamp)), "axis"), atol=1e-9)


def test_a_roll_before_both_pitches_or_at_the_time_of_one_is_not_extrapolated():
    joined = JoinedAngles(BareAngles(PITCH, ROLL, "axis"))
    angle = make("std_msgs/msg/Float64", data=3.0)
    joined.add_roll(angle, START)
    assert joined.add_pitch(angle, START).stamp == START
    joined.add_pitch(angle, START + 2)
    joined.add_roll(angle, START + 1)
    assert joined.add_pitch(angle, START + 3) is None


def test_rolls_that_no_pitch_follows_for_3_s_are_lost_together():
    joined, angle = JoinedAngles(BareAngles(PITCH, ROLL, "axis")), make("std_msgs/msg/Float64", data=3.0)
    joined.add_pitch(angle, START)
    for number in range(4):
        joined.add_roll(angle, START + number * 1_000_000_000)
    with pytest.raises(LogError, match=f"no pitch follows the last 5 rolls, since {START} ns"):
        joined.add_roll(angle, START + 3_500_000_000)
    joined.add_roll(angle, START + 4_000_000_000)
    assert joined.add_pitch(angle, START + 5_000_000_000).stamp == START + 4_000_000_000


def test_a_bad_roll_is_lost_alone(tmp_path):
    items = [item for _, stream, item in items_of(logged(tmp_path, bad=3), source()) if stream == "inclinometer"]
    (lost,) = (str(item) for item in items if isinstance(item, Exception))
    assert "/roll at" in lost
    assert "field 'data' contains nan, which is not an angle" in lost
    stamps = [item.stamp for item in items if isinstance(item, Tilt)]
    assert stamps == [START + LATER + number * 50_000_000 for number in range(8) if number != 3]


def test_a_topic_that_the_log_lacks_is_refused(tmp_path):
    paths = logged(tmp_path)
    settings = {"tilt_model": "axis", "camera_from_inclinometer": FACING}
    why = missing_in(paths, pitch=PITCH, roll=replace(ROLL, topic="/rol"), **settings)["inclinometer"]
    assert why == "the bare angles of /rol: /rol has no messages"
    assert (
        "the source's 'pitch.topic' is set to /pich"
        in (refused_in(paths, pitch=replace(PITCH, topic="/pich"), roll=ROLL, **settings)["pitch.topic"])
    )
    with pytest.raises(ValueError, match=r"needs 'pitch\.topic' and 'roll\.topic', or neither"):
        source(roll=replace(ROLL, topic=None))
    with pytest.raises(ValueError, match=r"needs either 'inclinometer', or 'pitch\.topic' and 'roll\.topic'"):
        source(inclinometer="/imu/data")
    assert source(inclinometer="/pitch").angles() is not None


@pytest.mark.parametrize("stamped", ["/pitch", "/roll"])
def test_the_frame_of_a_tilt_is_that_of_the_topic_that_has_one(tmp_path, stamped):
    pitch, roll = (replace(each, field="vector.x" if each.topic == stamped else "data") for each in (PITCH, ROLL))
    items = items_of(logged(tmp_path, headed={stamped}), source(pitch=pitch, roll=roll))
    frames = [item.frame_id for _, stream, item in items if stream == "inclinometer"]
    assert frames == ["tilt_link"] * 8


def test_both_angles_may_name_one_topic(tmp_path):
    paths = logged(tmp_path, headed={"/pitch"})
    one = {"pitch": replace(PITCH, field="vector.x"), "roll": AngleField("vector.y", "deg", 1, "/pitch")}
    apart = {name: replace(angle, topic=None) for name, angle in one.items()}
    named, alone = source(**one), source(inclinometer="/pitch", **apart)
    assert essences(items_of(paths, named)) == essences(items_of(paths, alone))
    with named.open(paths) as log:
        assert describe(log)["why"]["inclinometer"] == "as set"


@pytest.mark.parametrize("verified_bytes", [0, 1 << 30])
def test_info_names_both_topics_and_counts_tilts_without_stamps(tmp_path, monkeypatch, verified_bytes):
    monkeypatch.setattr("recordings.inventory.description.MAX_VERIFIED_BYTES", verified_bytes)
    with source().open(logged(tmp_path)) as log:
        described = describe(log, max_gap_of=lambda intervals: LENGTH)
    assert described["why"]["inclinometer"] == "as set; rolls are on /roll"
    assert described["frames"]["with_tilt"] == (3 if verified_bytes else 5)  # rolls end before the last two images
    assert described["frames"]["tilt_delay_s"] == pytest.approx(0, abs=0.05)
