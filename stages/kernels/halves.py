"""Two functions, one after the other or at once on two threads: how the matcher shares a frame between two cores."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

AtOnce = Callable[[Callable[[], Any], Callable[[], Any]], tuple[Any, Any]]


def in_turn(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
    """Both results, of the two functions called one after the other."""
    return one(), other()


@contextmanager
def pairs(threads: int) -> Iterator[AtOnce]:
    """What calls two functions and gives both results: at once if there are 2 threads or more, else in turn."""
    if threads < 2:
        yield in_turn
        return
    with ThreadPoolExecutor(1) as second:

        def at_once(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
            elsewhere = second.submit(other)
            try:
                here = one()
            finally:
                there = elsewhere.result()
            return here, there

        yield at_once
