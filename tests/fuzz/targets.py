"""What is fuzzed: valid files, how they are changed, and the part of the program that reads them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from types import SimpleNamespace

import cv2
import numpy as np
import yaml
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin

from flow.cli.main import parser
from flow.config.loader import load
from flow.config.templates import SHIPPED
from recordings import McapSource
from recordings.calibration.formats import read_calibration
from recordings.containers.finding import find_files
from recordings.errors import LogError
from recordings.importers.images import import_images
from recordings.importers.rig import Rig, read_rig
from recordings.ros2.image_from_msg import pixels_of
from recordings.source.joints import read_joints
from recordings.video.decoder import VideoDecoder
from tests.conftest import rewrite
from tests.fuzz import folders
from tests.fuzz.mutations import Mutate, mutated_bytes, mutated_messages, mutated_schemas, mutated_text
from tests.recordings.calibration import test_calibration_files as calibrations
from tests.recordings.containers.forms import rows_of, without_index, write_bag, write_rosbag2
from tests.recordings.encodings.rewritten import WRITERS
from tests.recordings.sample_log import LAYOUTS, picture, write_sample
from tests.recordings.video.encoder import Encoder

MAST = "pan: {parent: base_link, child: mast, xyz: [0, 0, 1.2], rpy: [0, 0.1, 0], axis: [0, 0, 1]}\n"
CALIBRATION = "fx: 20\nfy: 21.5\ncx: 11\ncy: 7\nbaseline: 0.25\nwidth: 24\n"
RIG = "height: 1.2 m\npitch_down: 10 deg\nroll: 0 deg\nfx: 500 px\nbaseline: 0.2 m\nbody_axes: flu\nworld_up: z\n"

Seeds = Callable[[Path], Sequence[bytes]]


@dataclass(frozen=True)
class Target:
    """Files that are changed and read. seeds: makes valid ones in a folder; ending: of their names."""

    seeds: Seeds
    mutate: Mutate
    read: Callable[[Path], object]
    ending: str

    def case(self, name: str, number: int, seeds: Sequence[bytes], folder: Path) -> Callable[[], object]:
        """The work of a numbered case; it also writes its file into the folder."""
        chance = Random(f"{name}:{number}")
        path = folder / f"{name}-{number}{self.ending}"

        def work() -> object:
            path.write_bytes(self.mutate(chance, chance.choice(seeds)))
            os.environ["TMPDIR"] = str(folder)
            return self.read(path)

        return work


def read_log(path: Path) -> None:
    """Read a log as `info` and as a run does."""
    read_info(path)
    read_events(path)


def read_info(path: Path) -> None:
    """Describe a log."""
    options = parser().parse_args(["info", str(path)])
    options.command(options)


def read_events(path: Path, source: McapSource | None = None) -> None:
    """Read all items of a log; a lost one is an error with a sentence."""
    with (source or McapSource()).open(path) as log:
        for _, _, item in log.events():
            if isinstance(item, Exception) and not (isinstance(item, LogError) and str(item).strip()):
                raise item
        log.notes()
        log.faults()


def _read_metadata(path: Path) -> None:
    folder = path.with_suffix("")
    folder.mkdir()
    path.rename(folder / "metadata.yaml")
    for number in range(2):
        (folder / f"bag_{number}.mcap").touch()
    find_files(folder)


def _read_image(path: Path) -> None:
    pixels_of(SimpleNamespace(format="jpeg", data=np.frombuffer(path.read_bytes(), np.uint8)))


def _read_video(path: Path) -> None:
    """Decode a video whose messages are all as long as the first states."""
    content = path.read_bytes()
    decode, size = VideoDecoder(1_000_000), max(len(content) // 6, 1)
    for start in range(0, len(content), size):
        data = np.frombuffer(content[start : start + size], np.uint8)
        try:
            decode(SimpleNamespace(video_format=("h264", "h265")[content[0] % 2], data=data))
        except LogError:
            decode.skip()


def _read_calibration(path: Path) -> None:
    read_calibration([path])
    log = path.with_suffix(".mcap")
    write_sample(log)
    read_events(log, McapSource(calibration=(str(path),)))


def _read_rig(path: Path) -> None:
    read_rig(path, list(Rig.__dataclass_fields__))


def _read_images_calibration(path: Path) -> None:
    import_images([path], [path], path, path.with_suffix(".mcap"), pitch_down=0.0, height=1.0)


def _layouts(folder: Path) -> list[bytes]:
    sample, layouts = write_sample(folder / "sample.mcap"), dict(LAYOUTS)
    layouts["no crcs"] |= {"compression": CompressionType.NONE, "chunk_size": 2000}
    return [rewrite(sample, folder / f"{name}.mcap", **layout).read_bytes() for name, layout in layouts.items()]


def _encodings(folder: Path) -> list[bytes]:
    sample = write_sample(folder / "sample.mcap")
    return [sample.read_bytes()] + [
        write(sample, folder / name).read_bytes() for name, write in WRITERS.items() if name.endswith(".mcap")
    ]


def _databases(folder: Path) -> list[bytes]:
    bag = write_rosbag2(rows_of(write_sample(folder / "sample.mcap")), folder / "db3", StoragePlugin.SQLITE3)
    return [path.read_bytes() for path in bag.glob("*.db3")]


def _bags(folder: Path) -> list[bytes]:
    rows = rows_of(write_sample(folder / "sample.mcap"))
    compressions = (None, BagWriter.CompressionFormat.LZ4, BagWriter.CompressionFormat.BZ2)
    paths = [write_bag(rows, folder / f"{number}.bag", kind) for number, kind in enumerate(compressions)]
    whole = [path.read_bytes() for path in paths]
    return whole + [without_index(path).read_bytes() for path in paths]


def _images(folder: Path) -> list[bytes]:
    colours, found = picture(0), list[bytes]()
    for ending, pixels in ((".png", colours), (".jpg", colours), (".png", colours[..., 0]), (".jpg", colours[..., 0]),
                           (".png", colours.astype(np.uint16) * 200), (".tiff", colours), (".bmp", colours),
                           (".webp", colours), (".pgm", colours[..., 0])):  # fmt: skip
        found.append(cv2.imencode(ending, pixels)[1].tobytes())
    found.append(cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes())
    return found


def _videos(folder: Path) -> list[bytes]:
    encode = Encoder("h264")
    gray = np.random.default_rng(0).integers(0, 256, (64, 96), np.uint8)
    return [b"".join(encode(np.roll(gray, number)) for number in range(6))]


def _calibrations(folder: Path) -> list[bytes]:
    pair = {side: calibrations.camera_info(side, shift) for side, shift in (("left", 0.0), ("right", -5.0))}
    paths = calibrations.kalibr(folder) + calibrations.opencv(folder) + calibrations.euroc(folder)
    return [path.read_bytes() for path in paths] + [yaml.safe_dump(pair).encode()]


def _metadata(folder: Path) -> list[bytes]:
    rows = rows_of(write_sample(folder / "sample.mcap"))
    return [(write_rosbag2(rows, folder / "bag", parts=2) / "metadata.yaml").read_bytes()]


def _pipelines(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(SHIPPED.glob("*.yaml"))]


TARGETS = {
    "mcap": Target(_layouts, mutated_bytes, read_log, ".mcap"),
    "db3": Target(_databases, mutated_bytes, read_log, ".db3"),
    "bag": Target(_bags, mutated_bytes, read_log, ".bag"),
    "messages": Target(_encodings, mutated_messages, read_log, ".mcap"),
    "schemas": Target(_encodings, mutated_schemas, read_log, ".mcap"),
    "images": Target(_images, mutated_bytes, _read_image, ".png"),
    "video": Target(_videos, mutated_bytes, _read_video, ".h264"),
    "pipelines": Target(_pipelines, mutated_text, lambda path: load(str(path)), ".yaml"),
    "calibrations": Target(_calibrations, mutated_text, _read_calibration, ".yaml"),
    "joints": Target(lambda folder: [MAST.encode()], mutated_text, read_joints, ".yaml"),
    "rigs": Target(lambda folder: [RIG.encode()], mutated_text, _read_rig, ".yaml"),
    "images calibration": Target(lambda _: [CALIBRATION.encode()], mutated_text, _read_images_calibration, ".yaml"),
    "folders": Target(folders.seeds, folders.mutated, folders.read, ".folder"),
    "metadata": Target(_metadata, mutated_text, _read_metadata, ".yaml"),
}
