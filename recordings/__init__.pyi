from .sinks.mcap_sink import McapSink
from .sinks.rerun_sink import RerunSink
from .source.mcap_source import McapSource

__all__ = ["McapSink", "McapSource", "RerunSink"]
