"""Threads in a kernel: how one frame is shared between two cores, with the same bits as on one.

A stage passes its `threads` to `shared_by`, which returns a function that calls two functions: one after the other, or
on two threads. `by_bands` applies that to bands of rows. Compiled code releases Python's lock, so both threads run.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

BANDS = 8  # of rows: few enough to cost nothing, enough that neither thread waits long for the other
Fork = Callable[[Callable[[], Any], Callable[[], Any]], tuple[Any, Any]]


class _Others:
    """The pool of second threads. It is kept, because a thread takes a tenth of a millisecond to start."""

    def __init__(self) -> None:
        self.renew()
        os.register_at_fork(after_in_child=self.renew)  # threads do not survive a fork

    def renew(self) -> None:
        """Replace the pool by an empty one: a forked process does not inherit threads."""
        self.pool = ThreadPoolExecutor(thread_name_prefix="second")


_others = _Others()


def in_turn(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
    """Call two functions one after the other; return both results."""
    return one(), other()


def at_once(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
    """Call two functions on two threads; return both results.

    Both have ended when this returns or raises, because they may work in shared memory. `other` must not call
    `at_once` itself: all threads of the pool could wait for a free one.
    """
    elsewhere = _others.pool.submit(other)
    try:
        here = one()
        return here, elsewhere.result()
    finally:
        while not elsewhere.done():  # after a failure, or an interrupt
            wait([elsewhere])


def shared_by(threads: int) -> Fork:
    """The function that calls two functions: `at_once` for 2 threads or more, else `in_turn`."""
    return in_turn if threads < 2 else at_once


def by_bands(run_both: Fork, rows: int, work: Callable[[int, int], Any]) -> None:
    """Call `work(first, end)` once for all rows: in bands, which free threads take in turn, or in one call.

    One call is made on one thread.
    """
    count = 1 if run_both is in_turn else BANDS
    cuts = [rows * i // count for i in range(count + 1)]
    bands = iter([(first, end) for first, end in itertools.pairwise(cuts) if first < end])

    def take() -> None:
        for first, end in bands:
            work(first, end)

    run_both(take, take)
