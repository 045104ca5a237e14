"""Two functions, one after the other or at once on two threads: how the matcher shares a frame between two cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

AtOnce = Callable[[Callable[[], Any], Callable[[], Any]], tuple[Any, Any]]
_others = ThreadPoolExecutor(thread_name_prefix="half")  # kept: a thread takes a tenth of a millisecond to start


def in_turn(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
    """Both results, of the two functions called one after the other."""
    return one(), other()


def at_once(one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
    """Both results, of the two functions called at once. `other` must not call this in its turn."""
    elsewhere = _others.submit(other)
    try:
        here = one()
    finally:
        there = elsewhere.result()
    return here, there


def shared_by(threads: int) -> AtOnce:
    """What calls two functions and gives both results: at once if there are 2 threads or more, else in turn."""
    return in_turn if threads < 2 else at_once
