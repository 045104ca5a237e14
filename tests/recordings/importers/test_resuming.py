"""An interrupted import is continued by the same command, and gives the bytes of one that was not interrupted."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from recordings.importers import recording
from recordings.importers.files import read_bytes
from recordings.mcap.file import McapFile
from recordings.mcap.resumable import ResumableWriter
from tests.conftest import patch, roverflow, slow
from tests.limits import file_size_limited
from tests.recordings.sample_log import model

PAIRS = 6
ROOT = Path(__file__).parents[3]
# A process that gets a signal when it reads its n-th image.
CHILD = """
import os, sys
from flow.cli.__main__ import program
from recordings.importers import recording
reads, read = [], recording.read_bytes
last, number = map(int, sys.argv[1:3])

def interrupted(path):
    reads.append(path)
    if len(reads) == last:
        os.kill(os.getpid(), number)
    return read(path)

recording.read_bytes = interrupted
sys.argv[1:3] = []
sys.exit(program())
"""


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A folder with pairs of images and the log of an uninterrupted import. Noise fills a chunk with each image."""
    home, random = tmp_path_factory.mktemp("source"), np.random.default_rng(5)
    (home / "pairs").mkdir()
    for number in range(PAIRS):
        for side in ("left", "right"):
            pixels = random.integers(0, 255, (240, 320), np.uint8)
            assert cv2.imwrite(str(home / "pairs" / f"{number}-{side}.png"), pixels)
    camera = {"fx": 200.0, "cx": 160.0, "cy": 120.0, "baseline": 0.2}
    (home / "camera.yaml").write_text(yaml.safe_dump(camera))
    assert roverflow(*importing(home, home / "whole.mcap")) == 0
    return home


def importing(source, out, pitch_down=15):
    given = "--calibration", source / "camera.yaml", "--pitch-down", pitch_down, "--height", 0.9
    return "import", "images", source / "pairs", out, *given


def ended(source, out, last, number):
    """The output of an import whose process gets a signal at its `last` image."""
    command = [sys.executable, "-c", CHILD, str(last), str(int(number)), *map(str, importing(source, out))]
    child = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert child.returncode == (-number if number == signal.SIGKILL else 130), child.stderr
    return child.stdout


def check_whole(source, out):
    """The import leaves the log of an uninterrupted one, and no other file."""
    assert roverflow(*importing(source, out)) == 0
    assert out.read_bytes() == (source / "whole.mcap").read_bytes()
    assert [path.name for path in out.parent.iterdir()] == ["out.mcap"]


@pytest.fixture
def logged(monkeypatch):
    """The names of the image files that are read for the log."""
    found = []
    monkeypatch.setattr(recording, "read_bytes", lambda path: found.append(path.name) or read_bytes(path))
    return found


@pytest.fixture
def interrupted(source, tmp_path, monkeypatch, capsys):
    """The unfinished log of an import that was interrupted at its fourth pair."""
    found = []

    def until_the_fourth(path):
        found.append(path)
        if len(found) > 6:
            raise KeyboardInterrupt
        return read_bytes(path)

    with monkeypatch.context() as patch:
        patch.setattr(recording, "read_bytes", until_the_fourth)
        assert roverflow(*importing(source, tmp_path / "out.mcap")) == 130
    capsys.readouterr()
    (left,) = tmp_path.iterdir()
    return left


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, *slow(signal.SIGINT)])
def test_the_import_of_a_process_that_was_ended_is_continued(source, tmp_path, number, capsys, logged):
    out = tmp_path / "out.mcap"
    printed = ended(source, out, 8, number)
    if number != signal.SIGKILL:
        assert f"{out}: not complete; run the same command again to continue the import" in printed
    (left,) = tmp_path.iterdir()
    assert left.suffix == ".partial"
    check_whole(source, out)
    assert f"{out}: continues the interrupted import after 3 frames" in capsys.readouterr().out
    assert {name[0] for name in logged} == {"3", "4", "5"}  # the others are not read again


def test_the_import_that_a_full_disk_ended_is_continued(source, tmp_path, capsys):
    out = tmp_path / "out.mcap"
    with file_size_limited((source / "whole.mcap").stat().st_size // 2):
        assert roverflow(*importing(source, out)) == 1
    (left,) = tmp_path.iterdir()
    assert f"what was written is in {left}, and the same command continues it" in capsys.readouterr().err
    check_whole(source, out)
    assert "continues the interrupted import after" in capsys.readouterr().out


def test_wherever_the_log_was_cut_or_damaged_the_result_is_the_same(source, interrupted):
    whole, out = (source / "whole.mcap").read_bytes(), interrupted.with_name("out.mcap")
    places = np.random.default_rng(1).integers(0, len(whole), 12).tolist()
    for place in [0, 1, 60, 500, *places, len(whole) - 30, len(whole)]:
        zeros = bytes(min(4096, len(whole) - place))  # a block that never reached the disk
        for content in (whole[:place], whole[:place] + zeros + whole[place + len(zeros) :]):
            interrupted.write_bytes(content)
            check_whole(source, out)


def test_a_chunk_of_wrong_length_costs_only_its_own_images(source, interrupted, logged):
    with McapFile(interrupted) as log:
        (right,) = (number for number, channel in log.channels.items() if channel.topic.startswith("/stereo/right/im"))
        second = np.flatnonzero(log.timeline.channels == right)[1]
        (chunk,) = (chunk for chunk in log.index.chunks if second in chunk.places)
    patch(interrupted, chunk.offset + 7, b"\1")  # of the length, which is now beyond the end of the log
    check_whole(source, interrupted.with_name("out.mcap"))
    assert [name for name in logged if name[0] in "012"] == ["1-right.png"]


def test_an_import_that_is_killed_again_loses_nothing_of_the_first_one(source, tmp_path, capsys, logged):
    out = tmp_path / "out.mcap"
    ends = (1, signal.SIGTERM), (8, signal.SIGKILL), (1, signal.SIGTERM), (4, signal.SIGTERM), (1, signal.SIGKILL)
    for count, (last, number) in enumerate(ends):  # the images read before it: none, 3 pairs, none, 1 more, none
        ended(source, out, last, number)
        assert any(tmp_path.iterdir()) == (count > 0)  # a log of nothing is not kept
    check_whole(source, out)
    assert f"{out}: continues the interrupted import after 4 frames" in capsys.readouterr().out
    assert {name[0] for name in logged} == {"4", "5"}


def test_the_smaller_log_that_a_kill_during_copying_left_is_replaced(source, interrupted):
    shutil.copy(interrupted, interrupted.with_suffix(".before"))
    os.truncate(interrupted, interrupted.stat().st_size // 2)
    check_whole(source, interrupted.with_name("out.mcap"))


def test_only_the_images_of_an_import_with_other_options_are_copied(source, interrupted, logged):
    out, fresh = interrupted.with_name("out.mcap"), interrupted.with_name("fresh.mcap")
    assert roverflow(*importing(source, out, pitch_down=20)) == 0
    assert {name[0] for name in logged} == {"3", "4", "5"}
    assert roverflow(*importing(source, fresh, pitch_down=20)) == 0
    assert out.read_bytes() == fresh.read_bytes()
    assert sorted(path.name for path in out.parent.iterdir()) == ["fresh.mcap", "out.mcap"]


def test_an_import_with_other_stamps_is_not_continued(source, interrupted, said):
    out, fresh = interrupted.with_name("out.mcap"), interrupted.with_name("fresh.mcap")
    assert roverflow(*importing(source, fresh), "--rate", 20) == 0
    text = said(0, *importing(source, out), "--rate", 20).out
    assert f"{out}: an interrupted import of other images is not continued" in text
    assert out.read_bytes() == fresh.read_bytes()


def test_an_import_for_another_size_of_images_is_not_continued(source):
    pairs = [recording.ImagePair(1, source / "pairs" / "0-left.png", source / "pairs" / "0-right.png")]
    of = [recording.ImportedRecording((model(width=size),) * 2, True, pairs, []) for size in (320, 640)]
    assert recording._mark(of[0]) != recording._mark(of[1])


def test_an_import_of_an_image_that_changed_is_not_continued(source, interrupted, capsys):
    image = source / "pairs" / "0-left.png"
    state = image.stat()
    try:
        os.utime(image, ns=(state.st_atime_ns, state.st_mtime_ns + 1))
        check_whole(source, interrupted.with_name("out.mcap"))
    finally:
        os.utime(image, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert "is not continued" in capsys.readouterr().out


def test_two_imports_of_one_log_do_not_mix(source, interrupted, said, capsys):
    out = interrupted.with_name("out.mcap")
    mark = interrupted.name.removeprefix("out.mcap.import-").removesuffix(".partial")
    with ResumableWriter(out, mark) as other:
        assert "is being written by another import" in said(1, *importing(source, out)).err
        other.abort()
    check_whole(source, out)
    assert "continues the interrupted import after 3 frames" in capsys.readouterr().out
