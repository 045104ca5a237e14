"""Fixtures of several test files: a short simulated traverse, and logs cut out of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings
from mcap.reader import make_reader
from mcap.writer import Writer

from flow.cli.main import main

settings.register_profile("untimed", deadline=None)  # the first example may compile a kernel
settings.load_profile("untimed")

FRAMES = 4
SMALL = ("--set", "disparities=64")


@pytest.fixture(scope="session")
def traverse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated log of four small frames, with ground truth."""
    from recordings.simulator import Simulation, write_log

    path = tmp_path_factory.mktemp("traverse") / "traverse.mcap"
    write_log(Simulation(frames=FRAMES, width=320, height=240), path)
    return path


@pytest.fixture(scope="session")
def result(traverse: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The traverse, run through the default pipeline; its recording and its summary are beside it."""
    out = tmp_path_factory.mktemp("result") / "out.mcap"
    assert roverflow("run", traverse, *SMALL, "-o", out, "--summary", out.with_suffix(".json")) == 0
    return out


def roverflow(*arguments: object) -> int:
    """What the command line makes of these arguments."""
    return main([str(argument) for argument in arguments])


def rewrite(source: Path, out: Path, change: Callable[[str, int, bytes], bytes | None]) -> Path:
    """Copy a log message by message; `change(topic, index in topic, data)` gives the data to write, None to drop it."""
    with source.open("rb") as stream, out.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        counts: dict[str, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            index = counts.get(channel.topic, 0)
            counts[channel.topic] = index + 1
            data = change(channel.topic, index, message.data)
            if data is None or schema is None:
                continue
            if channel.topic not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return out
