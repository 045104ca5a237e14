"""What the size of a log costs: `info`, the memory of a run, and reading the tilts, of a small and of a large log.

Run as `python -m tests.bench.large_log [--gigabytes 5]`; it writes that much and two fifths of it into a temporary
folder. The logs contain raw stereo of 1280x960 and an Imu, interleaved in chunks without compression. A run takes each
twentieth frame, but reads every message. Times are wall times of a whole command, imports included.
"""

from __future__ import annotations

import argparse
import json
import struct
import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from recordings.simulator import Simulation, write_log
from recordings.source.mcap_source import McapSource
from tests.bench.pipeline import roverflow

FRAMES, FRAMES_PER_SECOND, CHUNK_BYTES = 20, 2, 4 << 20
SMALL = 500_000_000  # bytes: as many frames in flight as in a large log
STAMP = struct.Struct("<iI")  # of a header, behind the 4 bytes before a message
IMU_COPIES = 10  # messages written for each of the simulated Imu, 5 ms apart: 200 Hz
IMU_PERIOD = 5_000_000


def main(arguments: list[str] | None = None) -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser("python -m tests.bench.large_log", description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=5.0, help="size of the large log (5)")
    large = int(1e9 * parser.parse_args(arguments).gigabytes)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_log(Simulation(frames=FRAMES, width=1280, height=960), folder / "once.mcap")
        logs = {size: _repeated(folder / "once.mcap", size, folder / f"{size}.mcap") for size in (SMALL, large)}
        for size, log in logs.items():
            seconds, summary = roverflow("info", log), folder / "summary.json"
            roverflow("run", log, "-o", folder / "out.mcap", "--every", 20, "--summary", summary)
            memory = json.loads(summary.read_text())["peak_memory_mb"]
            print(f"{size / 1e9:5.2f} GB: info {seconds:5.2f} s; a run's peak memory {memory:.0f} MB")
        part = _repeated(folder / "once.mcap", 2 * large // 5, folder / "part.mcap")
        for _ in range(2):  # the first one imports
            begun = time.perf_counter()
            with McapSource().open(part) as opened:
                count = sum(1 for _ in opened.events({"inclinometer"}))
            seconds = time.perf_counter() - begun
        print(f"{part.stat().st_size / 1e9:5.2f} GB: {count} tilts read in {seconds:.2f} s")


def _repeated(log: Path, size: int, out: Path) -> Path:
    """The messages of a log, again and again with later stamps, until the file has `size` bytes."""
    with log.open("rb") as file:
        found = [item for item in make_reader(file).iter_messages() if not item[1].topic.startswith("/truth")]
    period = FRAMES * 1_000_000_000 // FRAMES_PER_SECOND
    end = found[0][2].log_time + period
    found = [item for item in found if item[2].log_time < end]
    with out.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="bench")
        channels = {}
        for schema, channel, _ in found:
            if channel.topic not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, kind)
        turn = 0
        while file.tell() < size:
            for schema, channel, message in found:
                if turn and channel.topic == "/tf_static":
                    continue
                for copy in range(IMU_COPIES if schema.name == "sensor_msgs/msg/Imu" else 1):
                    later = turn * period + copy * IMU_PERIOD
                    data = message.data if channel.topic == "/tf_static" else _later(message.data, later)
                    at = message.log_time + later
                    writer.add_message(channels[channel.topic], log_time=at, publish_time=at, data=data)
            turn += 1
        writer.finish()
    return out


def _later(data: bytes, by: int) -> bytes:
    """A message with a header, with its stamp later by some ns."""
    seconds, rest = STAMP.unpack_from(data, 4)
    seconds, rest = divmod(seconds * 1_000_000_000 + rest + by, 1_000_000_000)
    return data[:4] + STAMP.pack(seconds, rest) + data[4 + STAMP.size :]


if __name__ == "__main__":
    main()
