"""The sample log, and what is read of it while it is whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.recordings.sample_log import items_of, write_sample


@pytest.fixture(scope="session")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("log") / "sample.mcap")


@pytest.fixture(scope="session")
def whole(sample: Path) -> list[tuple[int, str, Any]]:
    return items_of(sample)
