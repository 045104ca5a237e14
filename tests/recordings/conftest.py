"""The sample log, the items of the undamaged log, and a rerun recording."""

from pathlib import Path
from typing import Any

import pytest

from tests.conftest import SMALL, roverflow
from tests.recordings.sample_log import items_of, write_sample
from tests.recordings.sinks.recorded_scene import START, STEP, Record, record_of, scene


@pytest.fixture(scope="session")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("log") / "sample.mcap")


@pytest.fixture(scope="session")
def whole(sample: Path) -> list[tuple[int, str, Any]]:
    return items_of(sample)


@pytest.fixture(scope="session")
def both(traverse: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of the traverse that also contains its inputs."""
    out = tmp_path_factory.mktemp("both") / "out.mcap"
    assert roverflow("run", traverse, *SMALL, "-o", out, "--no-rrd", "--with-inputs") == 0
    return out


@pytest.fixture(scope="session")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rerun recording of three whole frames."""
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    return record_of(path, [Record(START + n * STEP, scene(START + n * STEP)) for n in range(3)])
