"""The method: plain callables over the data types of `stages.data`."""

from __future__ import annotations

from lazy_loader import attach_stub

# The names of __init__.pyi, each imported on first use: a pipeline should not wait for stages that it does not have.
__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
