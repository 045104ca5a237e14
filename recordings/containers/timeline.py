"""The log times of all messages of a file, in the order in which they are stored.

Ten bytes a message: so the rates, the gaps and the recorder's clock are known without reading any message.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_LOG_TIME = (1 << 63) - 1  # ns; a later log time is damaged

Places = NDArray[np.int64]


@dataclass(frozen=True)
class Timeline:
    """The channel and the log time, ns, of each message. The place of a message is its index here."""

    channels: NDArray[np.integer[Any]]
    log_times: NDArray[np.int64]

    @classmethod
    def of(cls, channels: ArrayLike, log_times: ArrayLike) -> Timeline:
        """The timeline of two lists; a damaged log time becomes -1."""
        times = np.asarray(log_times, np.uint64)  # no copy: there may be millions
        if (damaged := times > MAX_LOG_TIME).any():
            times = np.where(damaged, np.uint64((1 << 64) - 1), times)
        return cls(np.asarray(channels, np.int32), times.view(np.int64))

    def __len__(self) -> int:
        return len(self.log_times)

    @cached_property
    def by_channel(self) -> dict[int, Places]:
        """Channel -> the places of its messages with a valid log time."""
        order = np.argsort(self.channels, kind="stable")
        if (self.log_times < 0).any():
            order = order[self.log_times[order] >= 0]
        parts = np.split(order, np.flatnonzero(np.diff(self.channels[order])) + 1)
        return {int(self.channels[places[0]]): places for places in parts if len(places)}

    @cached_property
    def untimed(self) -> list[int]:
        """The channels of the messages with a damaged log time."""
        return [int(channel) for channel in self.channels[self.log_times < 0]]

    @cached_property
    def _counts(self) -> dict[int, int]:
        channels, counts = np.unique(self.channels, return_counts=True)
        return dict(zip(channels.tolist(), counts.tolist(), strict=True))

    def count(self, channels: set[int]) -> int:
        """The number of messages of some channels, also of those with a damaged log time."""
        return sum(self._counts.get(channel, 0) for channel in channels)

    def times_of(self, channels: set[int]) -> NDArray[np.int64]:
        """The sorted log times of some channels, ns."""
        return np.sort(self.log_times[self.places_of(channels)])

    def places_of(self, channels: set[int]) -> Places:
        """The sorted places of the messages of some channels with a valid log time."""
        places = [self.by_channel[channel] for channel in sorted(channels & self.by_channel.keys())]
        return np.sort(np.concatenate([np.zeros(0, np.int64), *places]))

    def chosen(self, channels: set[int], start: int | None, end: int | None) -> Places:
        """The places of the messages of some channels with start <= log time < end, ns, by log time."""
        found = self.places_of(channels)
        times = self.log_times[found]
        found = found[(times >= (start or 0)) & (times < (MAX_LOG_TIME + 1 if end is None else end))]
        return found[np.argsort(self.log_times[found], kind="stable")]
