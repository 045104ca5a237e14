"""Two functions, one after the other or at once on two threads: how a kernel shares a frame between two cores."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

AtOnce = Callable[[Callable[[], Any], Callable[[], Any]], tuple[Any, Any]]


class _Others:
    """The threads of second halves: kept, for one takes a tenth of a millisecond to start."""

    def __init__(self) -> None:
        self.renew()
        os.register_at_fork(after_in_child=self.renew)  # the threads stay behind

    def renew(self) -> None:
        """Begin anew, without threads."""
        self.pool = ThreadPoolExecutor(thread_name_prefix="half")


_others = _Others()


def in_turn(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
    """Both results, of the two functions called one after the other."""
    return one(), other()


def at_once(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
    """Both results, of the two functions called at once.

    Whatever happens, neither runs any more when this is through: they may work in memory that others are waiting for.
    `other` must not call this in its turn, or all threads could come to wait for one that is free.
    """
    elsewhere = _others.pool.submit(other)
    try:
        here = one()
        return here, elsewhere.result()
    finally:
        while not elsewhere.done():  # after a failure, or an interrupt
            wait([elsewhere])


def shared_by(threads: int) -> AtOnce:
    """What calls two functions and gives both results: at once if there are 2 threads or more, else in turn."""
    return in_turn if threads < 2 else at_once


def by_halves(both: AtOnce, rows: int, work: Callable[[int, int], Any]) -> tuple[Any, Any]:
    """Both results of `work(first, end)`, of the upper and of the lower half of so many rows."""
    middle = rows // 2
    return both(lambda: work(0, middle), lambda: work(middle, rows))
