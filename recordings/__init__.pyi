from .sinks.mcap_sink import McapSink as McapSink
from .sinks.rerun_sink import RerunSink as RerunSink
from .source.mcap_source import McapSource as McapSource
