"""One simulated traverse in every container and encoding gives the same maps."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from flow.cli.main import main
from recordings.mcap.file import iter_decoded
from recordings.mcap.writer import Ros2Writer
from recordings.ros2.from_msg import read_grid_map
from recordings.simulator import Simulation, write_log
from tests.conftest import slow
from tests.recordings.containers.forms import rows_of, write_rosbag2
from tests.recordings.encodings.rewritten import WRITERS
from tests.recordings.video.encoder import video_log


def folder(source: Path, out: Path) -> Path:
    """A rosbag2 folder of three MCAP files."""
    return write_rosbag2(rows_of(source), out, StoragePlugin.MCAP, parts=3)


def folder_without_metadata(source: Path, out: Path) -> Path:
    """The same as a recorder leaves it that was stopped."""
    (folder(source, out) / "metadata.yaml").unlink()
    return out


def databases(source: Path, out: Path) -> Path:
    """A rosbag2 folder of two SQLite files."""
    return write_rosbag2(rows_of(source), out, StoragePlugin.SQLITE3, parts=2)


def compressed(source: Path, out: Path) -> Path:
    """A rosbag2 folder whose two files are compressed."""
    return write_rosbag2(rows_of(source), out, parts=2, mode=CompressionMode.FILE)


FORMS: dict[str, Callable[[Path, Path], Path]] = {
    **WRITERS, "split": folder, "stopped": folder_without_metadata, "db3": databases, "compressed": compressed,
}  # fmt: skip
QUICK = ("ros1.mcap", "split", "db3")


def results_of(log: Path | Sequence[Path], out: Path) -> dict[tuple[str, int], bytes]:
    """The results of a run by topic and time."""
    out.parent.mkdir()
    words = [
        "run",
        *([log] if isinstance(log, Path) else log),
        "-p",
        "fast",
        "-o",
        out,
        "--no-rrd",
        "--set",
        "disparities=64",
    ]
    assert main([str(word) for word in words]) == 0
    return {(topic, time): data for topic, _, time, data in rows_of(out)}


def heights_of(log: Path) -> dict[tuple[int, int], float]:
    """The elevations of the last map of a result log by the place of the cell."""
    *_, (_, _, last) = iter_decoded(log, ["/nav/elevation_map"])
    terrain = read_grid_map(last)
    row, column = (round(place / terrain.resolution) for place in terrain.origin[::-1])
    elevation = terrain.layers["elevation"]
    return {(row + i, column + j): float(elevation[i, j]) for i, j in np.argwhere(np.isfinite(elevation)).tolist()}


@pytest.fixture(scope="module")
def traverse(tmp_path_factory):
    """A simulated log without ground truth, and the folder of its results."""
    home = tmp_path_factory.mktemp("traverse")
    simulation = Simulation(scene="gravel", frames=2, width=240, height=180, relief_cells=512, seed=1)
    write_log(simulation, home / "whole.mcap")
    with Ros2Writer(home / "log.mcap") as writer:
        for topic, log_time, message in iter_decoded(home / "whole.mcap"):
            if not topic.startswith("/truth/"):
                writer.write(topic, message, log_time)
    return home / "log.mcap", results_of(home / "log.mcap", home / "results" / "out.mcap")


@pytest.mark.parametrize("name", [*QUICK, *slow(*(name for name in FORMS if name not in QUICK))])
def test_a_log_in_another_form_gives_the_same_maps(traverse, tmp_path, name):
    log, expected = traverse
    found = results_of(FORMS[name](log, tmp_path / name), tmp_path / "results" / "out.mcap")
    assert found.keys() == expected.keys()
    assert [key for key in found if found[key] != expected[key]] == []
    assert any(topic == "/nav/elevation_map" for topic, _ in found)


def test_the_files_of_a_recording_may_be_named_one_by_one(traverse, tmp_path):
    log, expected = traverse
    files = sorted(folder(log, tmp_path / "bag").glob("*.mcap"))
    assert results_of(files, tmp_path / "results" / "out.mcap") == expected


def test_a_log_in_h264_gives_nearly_the_same_maps(traverse, tmp_path):
    log, _ = traverse
    results_of(video_log(log, tmp_path / "log.mcap", "h264"), tmp_path / "results" / "out.mcap")
    exact, found = heights_of(log.parent / "results" / "out.mcap"), heights_of(tmp_path / "results" / "out.mcap")
    both = found.keys() & exact.keys()
    assert len(both) > 0.85 * len(exact)
    assert np.median([abs(found[place] - exact[place]) for place in both]) < 0.005
