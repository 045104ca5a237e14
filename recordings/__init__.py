"""Where data comes in and goes out: logs, recordings, data sets, the simulator. The only place for file formats."""

from __future__ import annotations

from lazy_loader import attach_stub

# The names are those of __init__.pyi, imported on first use: reading a log should not wait for the viewer's library.
__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
