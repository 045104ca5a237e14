"""Several files are one log: the same messages as from one file, whatever the container."""

import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from recordings import McapSource
from recordings.containers.opening import open_recording
from recordings.errors import LogError
from tests.conftest import slow
from tests.recordings.containers.forms import rows_of, write_rosbag2
from tests.recordings.sample_log import PERIOD, START, essences, inventory_of, items_of

PLUGINS = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]


def read(given, **bounds):
    return essences(items_of(given, **bounds))


@pytest.mark.parametrize(("plugin", "mode"), [
    (StoragePlugin.MCAP, CompressionMode.NONE), (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    (StoragePlugin.MCAP, CompressionMode.FILE),
    *slow(
        (StoragePlugin.SQLITE3, CompressionMode.NONE), (StoragePlugin.MCAP, CompressionMode.MESSAGE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
    ),
])  # fmt: skip
def test_a_split_recording_is_the_same_log_as_one_file(sample, whole, tmp_path, plugin, mode):
    folder = write_rosbag2(rows_of(sample), tmp_path / "bag", plugin, 11, mode)
    assert read(folder) == essences(whole)
    (folder / "metadata.yaml").write_text("!!timestamp x: 1")  # which the parser fails on
    assert read(folder) == essences(whole)
    (folder / "metadata.yaml").unlink()  # as a recorder leaves it that was stopped
    assert read(folder) == essences(whole)
    if mode != CompressionMode.FILE:
        assert set(read(sorted(folder.iterdir(), reverse=True))) == set(essences(whole))


@pytest.mark.parametrize("plugin", PLUGINS)
def test_calibration_and_transforms_before_the_start_are_found_in_other_files(sample, whole, tmp_path, plugin):
    rows = rows_of(sample)
    kept = [row for number, row in enumerate(rows) if not row[0].endswith("camera_info") or number < len(rows) // 5]
    events = read(write_rosbag2(kept, tmp_path / "bag", plugin, 5), start=0.25)
    images = [(stream, item) for _, stream, item in events if stream in ("left", "right")]
    expected = [(s, item) for time, s, item in essences(whole) if time > START + 2.5 * PERIOD]
    assert images == [(stream, item) for stream, item in expected if stream in ("left", "right")]


def test_files_of_several_recorders_are_merged_by_log_time(sample, whole, tmp_path):
    rows = rows_of(sample)
    cameras = write_rosbag2([row for row in rows if row[0].startswith("/stereo")], tmp_path / "cameras")
    others = write_rosbag2(
        [row for row in rows if not row[0].startswith("/stereo")], tmp_path / "others", StoragePlugin.SQLITE3
    )
    found = read([others, cameras])
    assert [time for time, _, _ in found] == [time for time, _, _ in essences(whole)]
    assert sorted(found[1:]) == sorted(essences(whole)[1:])


def test_a_missing_file_of_a_recording_is_in_the_ledger(sample, tmp_path):
    folder = write_rosbag2(rows_of(sample), tmp_path / "bag", parts=3)
    (folder / "bag_1.mcap").unlink()
    sentence = f"bag_1.mcap is missing in {folder}, although metadata.yaml lists it"
    *_, (_, stream, lost) = read(folder)
    assert (stream, str(lost)) == ("log", f"bag: {sentence}")
    gap = "1 of 3 stereo pairs in a gap of the tilts, over 0.2 s long; a run loses the tilt there"
    assert inventory_of(folder)["damage"] == [sentence, gap]


def test_damage_names_its_file(sample, tmp_path):
    folder = write_rosbag2(rows_of(sample), tmp_path / "bag", parts=3)
    (folder / "bag_2.mcap").write_bytes((folder / "bag_2.mcap").read_bytes()[:5000])
    (damage,) = inventory_of(folder)["damage"]
    assert damage.startswith("bag_2.mcap: the log is truncated or damaged at byte ")


@pytest.mark.parametrize("keep", ["metadata.yaml", "the numbers alone"])
def test_a_file_given_alone_names_its_siblings(sample, tmp_path, keep):
    folder = write_rosbag2(rows_of(sample), tmp_path / "bag", parts=12)
    if keep != "metadata.yaml":
        (folder / "metadata.yaml").unlink()
    (tmp_path / "bag" / "bag_2-nav.mcap").write_bytes(sample.read_bytes())  # a result beside the log
    with McapSource().open(folder / "bag_2.mcap") as log:
        part = f"bag_2.mcap is file 3 of 12 of a recording (bag_0.mcap to bag_11.mcap); give the folder {folder}"
        assert log.missing["mount"].endswith(f"({part} to read all of them)")
    alone = tmp_path / "bag_7.mcap"
    alone.write_bytes((folder / "bag_2.mcap").read_bytes())
    with open_recording(alone) as log:
        assert log.part == ""


def test_a_clock_set_back_between_files_is_found(sample, whole, tmp_path):
    rows = rows_of(sample)
    late = [(*row[:2], row[2] - 50 * PERIOD, row[3]) for row in rows if row[2] >= START + 3 * PERIOD]
    folder = tmp_path / "bag"
    folder.mkdir()
    for number, part in enumerate([[row for row in rows if row[2] < START + 3 * PERIOD], late]):
        own = write_rosbag2(part, tmp_path / f"part{number}")
        (own / f"part{number}_0.mcap").rename(folder / f"bag_{number}.mcap")
    assert read(folder) == essences(whole)


@pytest.mark.parametrize(("names", "sentence"), [
    ([], "contains no recording (no .mcap, .db3, .bag file); give a log or its folder"),
    (["notes.txt"], "contains no recording (no .mcap, .db3, .bag file); give a log or its folder"),
    (["one/metadata.yaml"], "contains no recording (no .mcap, .db3, .bag file); its folders one are recordings"),
    (["a.mcap", "b_1.mcap"], "contains several recordings (a.mcap, b_1.mcap); give the files of one"),
])  # fmt: skip
def test_a_folder_without_one_recording_is_refused(tmp_path, names, sentence):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(LogError) as refused:
        open_recording(tmp_path)
    assert str(refused.value).startswith(f"{tmp_path} {sentence}")


def test_a_compressed_file_alone_is_refused_with_the_remedy(sample, whole, tmp_path):
    path = tmp_path / "bag_0.mcap.zstd"
    path.write_bytes(zstandard.compress(sample.read_bytes()))
    with pytest.raises(
        LogError, match=r"compressed as a whole; give the folder of the recording, or unpack"
    ) as refused:
        open_recording(path)
    assert read(tmp_path) == essences(whole)
    command = shlex.split(str(refused.value).split("`")[1])
    assert command == ["zstd", "-d", str(path)]
    if shutil.which("zstd"):
        subprocess.run([*command, "-q"], check=True)
        path.unlink()
        assert read(path.with_suffix("")) == essences(whole)


def test_a_bomb_is_not_unpacked(tmp_path):
    path = tmp_path / "bag_0.mcap.zstd"
    path.write_bytes(zstandard.compress(np.zeros(1 << 28, np.uint8).tobytes()))
    with pytest.raises(LogError, match="unpacks to more than 200 times its size"):
        open_recording(tmp_path)


def test_a_cut_compressed_file_is_read_to_its_end(sample, whole, tmp_path):
    folder = write_rosbag2(rows_of(sample), tmp_path / "bag", parts=1, mode=CompressionMode.FILE)
    (file,) = folder.glob("*.zstd")
    packed = zstandard.ZstdCompressor(level=1).compressobj()
    content = zstandard.ZstdDecompressor().stream_reader(file.read_bytes()).read()
    blocks = [packed.compress(block) + packed.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for block in
              (content[place : place + 2000] for place in range(0, len(content), 2000))]  # fmt: skip
    file.write_bytes(b"".join(blocks[: len(blocks) // 2]))
    *events, (_, stream, lost) = read(folder)
    assert (stream, type(lost)) == ("log", LogError)
    assert events == essences(whole)[: len(events)]
    assert len(events) > len(whole) // 4


def test_what_was_unpacked_is_deleted(sample, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    Path(tmp_path / "temporary").mkdir()
    folder = write_rosbag2(rows_of(sample), tmp_path / "bag", parts=2, mode=CompressionMode.FILE)
    with open_recording(folder):
        assert len(list((tmp_path / "temporary").iterdir())) == 2
    assert list((tmp_path / "temporary").iterdir()) == []


def test_no_file_is_refused():
    with pytest.raises(LogError, match="the list of files is empty; give a log"):
        open_recording([])
