"""How a kernel shares a frame between two cores: two functions, or bands of rows, in turn or at once."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

from stages.data import Array

BANDS = 8  # of rows: few enough to cost nothing, enough that neither thread waits long for the other
Fork = Callable[[Callable[[], Any], Callable[[], Any]], tuple[Any, Any]]


class _Others:
    """The threads of second functions: kept, for one takes a tenth of a millisecond to start."""

    def __init__(self) -> None:
        self.renew()
        os.register_at_fork(after_in_child=self.renew)  # the threads stay behind

    def renew(self) -> None:
        """Begin anew, without threads."""
        self.pool = ThreadPoolExecutor(thread_name_prefix="second")


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


def shared_by(threads: int) -> Fork:
    """What calls two functions and gives both results: at once if there are 2 threads or more, else in turn."""
    return in_turn if threads < 2 else at_once


def by_bands(both: Fork, rows: int, work: Callable[[int, int], Any]) -> None:
    """Call `work(first, end)` for all rows once: in bands, of which a thread that is free takes the next, or all the
    rows in one call where there is one thread."""
    count = 1 if both is in_turn else BANDS
    cuts = [rows * i // count for i in range(count + 1)]
    bands = iter([(first, end) for first, end in itertools.pairwise(cuts) if first < end])

    def take() -> None:
        for first, end in bands:
            work(first, end)

    both(take, take)


def with_margin(image: Array, first: int, end: int, margin: int) -> tuple[Array, slice]:
    """Rows first to end of an image and `margin` more to either side, where there are; and where in them they are."""
    start = max(first - margin, 0)
    return image[start : end + margin], slice(first - start, end - start)
