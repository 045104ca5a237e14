"""What a sink is given for one frame: the protocol between the runtime and the sinks, which do not know each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol


class Loss(Protocol):
    """One entry of the ledger: what was lost, when (ns), at which stage, and why."""

    @property
    def stream(self) -> str: ...
    @property
    def stamp(self) -> int: ...
    @property
    def stage(self) -> str: ...
    @property
    def reason(self) -> Any: ...
    @property
    def detail(self) -> str: ...


class FrameRecord(Protocol):
    """A frame that is through.

    stamp: ns; items: stream -> data, without what was lost; entries: the losses of this frame; seconds: wall time by
    stage; queues: frames in each stage's inbox.
    """

    @property
    def stamp(self) -> int: ...
    @property
    def items(self) -> Mapping[str, Any]: ...
    @property
    def entries(self) -> Sequence[Loss]: ...
    @property
    def seconds(self) -> Mapping[str, float]: ...
    @property
    def queues(self) -> Mapping[str, int]: ...
