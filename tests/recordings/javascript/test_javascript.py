"""Foxglove's readers in JavaScript and Python's find the same values in a result log, field by field."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder

from tests.conftest import SMALL, roverflow

HERE = Path(__file__).parent


def fields(value, path, found):
    """Path -> what a field contains, as read.mjs prints it."""
    if isinstance(value, bool | int | float):
        found[path] = finite(value)
    elif isinstance(value, str):
        found[path] = value
    elif isinstance(value, bytes | bytearray | memoryview) or not (hasattr(value, "ListFields") or slots(value)):
        items = np.frombuffer(value, np.uint8) if isinstance(value, bytes | bytearray | memoryview) else list(value)
        if len(items) == 0 or isinstance(items[0], bool | int | float | np.number):
            numbers = np.asarray(items, np.float64)
            known = numbers[np.isfinite(numbers)]
            ends = [finite(numbers[place]) if len(numbers) else 0 for place in (0, -1)]
            found[path] = [len(numbers), float(known.sum()), *ends]
        else:
            for place, item in enumerate(items):
                fields(item, f"{path}/{place}", found)
    elif hasattr(value, "ListFields"):
        for field, item in value.ListFields():
            fields(item, f"{path}/{field.name}", found)
    else:
        for name in slots(value):
            fields(getattr(value, name), f"{path}/{name}", found)
    return found


def slots(value):
    return [name for name in getattr(value, "__slots__", ()) if not name.startswith("_")]


def finite(value):
    return float(value) if np.isfinite(value) else None


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """The folder of read.mjs with its packages."""
    if shutil.which("npm") is None:
        pytest.skip("needs node and npm")
    folder = tmp_path_factory.mktemp("javascript")
    for name in ("package.json", "read.mjs"):
        shutil.copy(HERE / name, folder)
    subprocess.run(["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts"], cwd=folder, check=True)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["ros2", "foxglove"])
def test_javascript_reads_what_python_reads(profile, reader, traverse, tmp_path):
    out = tmp_path / "out.mcap"
    viewers = ("--set", "McapSink.viewers=true")
    assert roverflow("run", traverse, *SMALL, *viewers, "-o", out, "--no-rrd", "--profile", profile) == 0
    lines = subprocess.run(["node", "read.mjs", out], cwd=reader, check=True, capture_output=True, text=True).stdout
    found = [json.loads(line) for line in lines.splitlines()]
    with out.open("rb") as file:
        log = make_reader(file, decoder_factories=[Ros2Decoder(), ProtobufDecoder()])
        expected = [
            [channel.topic, str(message.log_time), fields(decoded, "", {})]
            for _, channel, message, decoded in log.iter_decoded_messages()
        ]
    assert len(found) == len(expected) > 30
    for one, other in zip(sorted(found, key=repr_of), sorted(expected, key=repr_of), strict=True):
        assert one[:2] == other[:2]
        assert one[2].keys() == other[2].keys()
        for path, value in other[2].items():
            assert same(one[2][path], value), (one[0], path)


def same(one, other):
    """Whether both are equal; sums may be rounded."""
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other if isinstance(one, str | None) else one == pytest.approx(other, rel=1e-9)


def repr_of(row):
    return row[0], row[1], sorted(row[2])
