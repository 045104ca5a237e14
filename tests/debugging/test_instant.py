"""`--at`: seconds, times as the viewer shows them, and the cursor of an open viewer."""

import socket
import time
from itertools import product
from operator import itemgetter

import numpy as np
import pytest

from flow.cli.arguments import instant
from flow.cli.debugging.instants import part_of
from flow.cli.debugging.viewer_cursor import without_cursor
from flow.errors import UsageError
from recordings import McapSource
from tests.conftest import SMALL, mcap_rows, roverflow, write_mcap
from tests.recordings.sample_log import LEFT, changed, stamps_in, write_sample
from tests.viewers import viewer


@pytest.fixture(scope="module")
def stamps(traverse):
    with McapSource().open(traverse) as log:
        return stamps_in(log.events(("left",)))


@pytest.mark.parametrize("shown", [
    lambda stamp: str(np.datetime64(stamp, "ns")).replace("T", " "),
    lambda stamp: f"{np.datetime64(stamp, 'ns').astype('datetime64[us]')}Z",
    lambda stamp: str(np.datetime64(stamp, "ns"))[11:23], lambda stamp: f"{stamp} ns",
])  # fmt: skip
def test_a_time_as_the_viewer_shows_it_is_that_of_the_frame(traverse, stamps, shown):
    with McapSource().open(traverse) as log:
        for stamp in stamps:
            part = part_of(log, instant(shown(stamp)), 1, 0)
            with McapSource().open(traverse, start=part.start, end=part.end) as cut:
                assert stamps_in(cut.events(("left",))) == [stamp]


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize("delay", [0.02, 0.3, 0.7])
def test_the_frame_of_a_stamp_is_read_however_late_the_log_has_it(traverse, stamps, tmp_path, delay, joined):
    """joined: whether the log begins with an image."""

    def late(row):
        topic, encoding, schema, log_time, data = row
        return topic, encoding, schema, log_time + round(delay * 1e9) * ("stereo" in topic), data

    rows = sorted(map(late, mcap_rows(traverse)), key=itemgetter(3))
    begin = next(log_time for topic, _, _, log_time, _ in rows if "stereo" in topic) if joined else 0
    log = write_mcap(tmp_path / "late.mcap", [row for row in rows if row[3] >= begin or "static" in row[0]])
    with McapSource().open(log) as opened:
        for (number, stamp), as_seconds in product(enumerate(stamps), (False, True)):
            seconds = (stamp - opened.begin) / 1e9
            part = part_of(opened, seconds if as_seconds else np.datetime64(stamp, "ns"), 1, min(number, 1))
            assert part.at == pytest.approx(seconds, abs=1e-9)
            opened.narrow(part.start, part.end)
            assert stamps_in(opened.events(("left",))) == stamps[max(number - 1, 0) : number + 1]


def test_a_time_of_day_is_that_of_stamps_also_where_they_are_of_another_clock(tmp_path):
    with McapSource().open(write_sample(tmp_path / "log.mcap", changed(LEFT, {"header.stamp.sec": 7}))) as log:
        for shown in ("00:00:07.2", "1970-01-01 00:00:07.2", "7200000000 ns", "0.2"):
            part = part_of(log, instant(shown), 1, 0)
            assert part.stamp == 7_200_000_000
            assert (part.start, part.end) == pytest.approx((0.15, 0.25), abs=1e-4)


def test_other_times_are_refused(traverse, tmp_path, capsys, refused):
    beyond = "9" * 19, "9999-12-31 00:00:00"
    for text in ("yesterday", "2023-13-45 00:00:00", "12:03", "12:75:00", "24:00:00", "-1", *beyond):
        with pytest.raises(SystemExit):
            roverflow("try", traverse, f"--at={text}", *SMALL)
        assert "must be seconds after the log's first message, a time as the viewer shows it" in capsys.readouterr().err
    outside = refused("try", traverse, "--at", "2024-01-01 00:00:00", *SMALL, "-o", tmp_path / "try.rrd")
    assert "--at 2024-01-01T00:00:00.000Z (1704067200000000000 ns) is outside the images of the log, which" in outside


def test_a_time_outside_the_images_is_refused_unless_it_is_a_rounded_one(traverse, stamps):
    with McapSource().open(traverse) as log:
        day = np.datetime64(stamps[-1], "ns")
        for near, stamp in ((0.5, stamps[0]), (1.6, stamps[-1]), (day + np.timedelta64(10, "ms"), stamps[-1])):
            assert part_of(log, near, 1, 0).stamp == stamp
        for outside in (0.1, 2.0, day + np.timedelta64(400, "ms")):
            with pytest.raises(UsageError, match=r"is outside the images of the log, which lie from .* to [^ ]* "):
                part_of(log, outside, 1, 0)
        with pytest.raises(UsageError, match=r"lie from 0\.513 to 1\.513 s$"):
            part_of(log, 2.0, 1, 0)


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def test_without_a_viewer_there_is_no_cursor():
    with pytest.raises(UsageError, match=r"no viewer answers on port [0-9]+ of this machine; open the recording"):
        without_cursor("cursor", free_port())


@pytest.mark.slow
def test_the_cursor_of_an_open_viewer_is_the_instant(result, stamps):
    from rerun.experimental import ViewerClient

    port = free_port()
    words = "--headless", "--bind", "127.0.0.1", "--port", port, result.with_suffix(".rrd")
    with viewer(*words) as opened:
        for _ in range(120):
            time.sleep(0.5)
            if opened.poll() is not None:
                pytest.skip("the viewer has no graphics driver here")
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                if client.get_state().active_recording and not client.get_state().loading:
                    break
            except (OSError, RuntimeError):
                continue
        client.set_time("log clock", timestamp=np.datetime64(stamps[2], "ns"), play_state="paused")
        assert without_cursor("cursor", port) == np.datetime64(stamps[2], "ns")
        client.set_time("frame", sequence=1, play_state="paused")
        with pytest.raises(UsageError, match="choose 'log clock' in its time panel"):
            without_cursor("cursor", port)
