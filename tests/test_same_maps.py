"""One traverse in any container gives the same results, bit by bit."""

from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tests.conftest import SMALL, roverflow
from tests.recordings.containers.forms import rows_of, write_bag, write_rosbag2


def split_without_metadata(log: Path, out: Path) -> Path:
    (write_rosbag2(rows_of(log), out, parts=11) / "metadata.yaml").unlink()
    return out


FORMS: dict[str, Callable[[Path, Path], Path]] = {
    "split": lambda log, out: write_rosbag2(rows_of(log), out, parts=3),
    "split without metadata": split_without_metadata,
    "split and compressed": lambda log, out: write_rosbag2(rows_of(log), out, parts=2, mode=CompressionMode.FILE),
    "db3": lambda log, out: write_rosbag2(rows_of(log), out, StoragePlugin.SQLITE3, parts=2),
    "ROS 1 bag": lambda log, out: write_bag(
        [row for row in rows_of(log) if not row[0].startswith("/truth")], out.with_suffix(".bag")
    ),
}


def results(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        return [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(file).iter_messages()]


@pytest.fixture(scope="module")
def expected(traverse: Path, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, int, bytes]]:
    out = tmp_path_factory.mktemp("expected") / "out.mcap"
    assert roverflow("run", traverse, "-p", "fast", *SMALL, "-o", out, "--no-rrd") == 0
    return results(out)


@pytest.mark.parametrize("form", FORMS)
def test_a_traverse_in_another_container_gives_the_same_results(traverse, expected, tmp_path, form):
    log = FORMS[form](traverse, tmp_path / "log.1")
    assert roverflow("info", log, "-p", "fast") == 0
    assert roverflow("run", log, "-p", "fast", *SMALL, "--no-rrd") == 0
    assert results(tmp_path / ("log-nav.mcap" if log.is_file() else "log.1-nav.mcap")) == expected


def test_the_files_of_a_recording_may_be_named_one_by_one(traverse, expected, tmp_path):
    folder = write_rosbag2(rows_of(traverse), tmp_path / "bag", parts=3)
    files = sorted(folder.glob("*.mcap"))
    assert roverflow("run", *files, "-p", "fast", *SMALL, "--no-rrd") == 0
    assert results(folder / "bag_0-nav.mcap") == expected
    assert roverflow("run", folder, "-p", "fast", *SMALL, "--no-rrd", "-o", folder / "bag_0-nav.mcap") == 0
