"""Where data comes in and goes out: logs, recordings, data sets, the simulator. The only place for file formats."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recordings.sinks.mcap_sink import McapSink
    from recordings.sinks.rerun_sink import RerunSink
    from recordings.source.mcap_source import McapSource

__all__ = ["McapSink", "McapSource", "RerunSink"]

_HOMES = {"McapSink": "sinks.mcap_sink", "McapSource": "source.mcap_source", "RerunSink": "sinks.rerun_sink"}


def __getattr__(name: str) -> Any:
    """Import on first use: reading a log should not wait for the viewer's library."""
    if name in _HOMES:
        return getattr(import_module(f"recordings.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'recordings' has no attribute '{name}'")
