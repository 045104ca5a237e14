"""`source.time_offset` corrects the stamps of one stream against the left images."""

import pytest

from recordings import McapSource
from recordings.inventory.description import describe
from recordings.inventory.text import format_description
from recordings.ros2.to_msg import imu
from recordings.source.settings import TimeOffsets
from tests.conftest import write_messages
from tests.recordings.sample_log import (
    PERIOD,
    RIGHT,
    START,
    TILT,
    UNSTAMPED,
    Edit,
    changed,
    dropped,
    essences,
    inventory_of,
    items_of,
    losses_in,
    stamps_in,
    tilt_quaternion,
    write_sample,
)  # fmt: skip

LATE = 30_000_000  # ns
TOPICS = {"right": RIGHT, "inclinometer": TILT, "odometry": "/odom"}


def later(topic: str, by: int = LATE) -> Edit:
    """An edit for `write_sample`: later stamps."""
    return changed(topic, {"header.stamp.nanosec": lambda time: time + by})


@pytest.mark.parametrize("stream", TOPICS)
def test_an_offset_undoes_a_constant_latency_and_keeps_log_times(sample, tmp_path, stream):
    late = write_sample(tmp_path / "late.mcap", later(TOPICS[stream]))
    whole = essences(items_of(sample))
    assert essences(items_of(late)) != whole
    assert essences(items_of(late, McapSource(time_offset=TimeOffsets(**{stream: -LATE})))) == whole


@pytest.mark.parametrize(("name", "value"), [("time_offset", 1.0), ("time_offset", {"right": 5}), ("pitch", "data.1")])
def test_a_group_of_settings_of_another_type_is_refused(name, value):
    with pytest.raises(ValueError, match=rf"McapSource\.{name} must be of (TimeOffsets|AngleField), not "):
        McapSource(**{name: value})


def test_messages_without_a_stamp_are_moved_from_their_log_times(sample, tmp_path):
    path = write_sample(tmp_path / "log.mcap", changed(TILT, UNSTAMPED))
    assert essences(items_of(path)) == essences(items_of(sample))
    moved = items_of(path, McapSource(time_offset=TimeOffsets(inclinometer=LATE)))
    assert stamps_in(moved, "inclinometer") == [stamp + LATE for stamp in stamps_in(items_of(sample), "inclinometer")]


def test_a_lost_message_stays_a_loss(tmp_path):
    path = write_sample(tmp_path / "log.mcap", changed(TILT, {"orientation.x": 5.0}, [3]))
    source = McapSource(time_offset=TimeOffsets(inclinometer=LATE))
    assert losses_in(items_of(path, source)) == losses_in(items_of(path))


def test_a_range_has_both_images_of_a_frame_by_corrected_stamps(tmp_path):
    late = write_sample(tmp_path / "late.mcap", later(RIGHT, PERIOD))
    events = items_of(late, McapSource(time_offset=TimeOffsets(right=-PERIOD)), start=0.1, end=0.3)
    assert stamps_in(events, "left") == stamps_in(events, "right")
    assert len(stamps_in(events)) == 2


@pytest.mark.parametrize("logged_late", [0, 2_000_000_000])
def test_a_range_has_the_tilts_around_it_by_corrected_stamps(tmp_path, logged_late):
    images, late = write_sample(tmp_path / "images.mcap", dropped(TILT)), 2_000_000_000
    times = range(START - 5_000_000_000, START + 5_000_000_000, PERIOD)
    rows = [(time + logged_late, TILT, imu(time + late, "imu_link", tilt_quaternion(0))) for time in times]
    tilts = write_messages(tmp_path / "tilts.mcap", rows)
    source = McapSource(time_offset=TimeOffsets(inclinometer=-late))
    start = 5.1 - logged_late / 1e9
    events = items_of([images, tilts], source, start=start, end=start + 0.2)
    inside = {stamp - START for stamp in stamps_in(events, "inclinometer")}
    assert inside == {*range(-900_000_000, 1_300_000_000, PERIOD)}


def test_info_counts_pairs_and_tilts_by_corrected_stamps(tmp_path):
    late = write_sample(tmp_path / "late.mcap", later(RIGHT), dropped(TILT, numbers=[1, 2, 3]), later(TILT))
    assert [inventory_of(late)["frames"][name] for name in ("pairs", "with_tilt")] == [0, 0]
    with McapSource(time_offset=TimeOffsets(right=-LATE, inclinometer=-LATE)).open(late) as log:
        frames = describe(log, max_gap_of=lambda intervals: 4 * PERIOD)["frames"]
    assert [frames[name] for name in ("pairs", "with_tilt")] == [5, 5]


@pytest.mark.parametrize("seconds", [100, -37])
def test_info_names_the_offset_of_another_clock(tmp_path, seconds):
    path = write_sample(tmp_path / "log.mcap", changed(TILT, {"header.stamp.sec": lambda stamp: stamp + seconds}))
    setting = f"--set source.time_offset.inclinometer={-seconds}.000s corrects the tilts"
    text = format_description(inventory_of(path))
    assert f"doubtful: the stamps of tilts and images are of clocks that differ by {abs(seconds):.1f} s" in text
    assert setting in text
    assert "tilt.patience" not in text
    for given in (-seconds, -seconds + 5):
        with McapSource(time_offset=TimeOffsets(inclinometer=given * 1_000_000_000)).open(path) as log:
            text = format_description(describe(log, max_gap_of=lambda intervals: 2 * PERIOD))
        assert (setting in text) == (given != -seconds)


@pytest.mark.parametrize("seconds", [100, -37])
def test_a_log_notes_the_offset_of_poses_of_another_clock(sample, tmp_path, seconds):
    path = write_sample(tmp_path / "log.mcap", changed("/odom", {"header.stamp.sec": lambda stamp: stamp + seconds}))
    for given, named in ((0, True), (-seconds + 5, True), (-seconds, False)):
        with McapSource(time_offset=TimeOffsets(odometry=given * 1_000_000_000)).open(path) as log:
            note = log.notes().get("odometry", "")
        assert (f"--set source.time_offset.odometry={-seconds}.000s corrects the poses" in note) == named
        assert (f"clocks that differ by {abs(seconds + given):.1f} s" in note) == named
    with McapSource().open(sample) as log:
        assert "odometry" not in log.notes()
