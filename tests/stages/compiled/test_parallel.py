"""Two functions, or bands of rows, at once: all of it or the first failure, nothing left running, in any thread and any
process."""

import multiprocessing
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from stages.compiled.parallel import BANDS, at_once, by_bands, in_turn, shared_by


def test_both_results_come_back_and_from_two_threads_if_there_are_two():
    for threads in (1, 2, 3):
        one, other = shared_by(threads)(threading.get_ident, threading.get_ident)
        assert one == threading.get_ident()
        assert (one == other) == (threads == 1)


@pytest.mark.parametrize("both", [in_turn, at_once])
def test_a_failure_of_either_is_raised(both):
    def fail():
        raise ValueError("the half failed")

    for halves in ((fail, int), (int, fail), (fail, fail)):
        with pytest.raises(ValueError, match="the half failed"):
            both(*halves)


def test_after_a_failure_no_other_function_is_left_running():
    ended = []

    def fail():
        raise KeyboardInterrupt

    def work():
        time.sleep(0.05)
        ended.append(True)

    with pytest.raises(KeyboardInterrupt):
        at_once(fail, work)
    assert ended == [True]


def test_many_threads_may_ask_at_once():
    with ThreadPoolExecutor(24) as callers:
        results = list(callers.map(lambda i: at_once(lambda: i, lambda: -i), range(500)))
    assert results == [(i, -i) for i in range(500)]


@pytest.mark.parametrize("both", [in_turn, at_once])
@pytest.mark.parametrize("rows", [1, BANDS - 1, BANDS, 1000])
def test_bands_contain_every_row_once_and_none_is_empty(both, rows):
    taken = []
    by_bands(both, rows, lambda first, end: taken.append(range(first, end)))
    assert sorted(row for band in taken for row in band) == list(range(rows))
    assert len(taken) == (1 if both is in_turn else min(rows, BANDS))


def test_the_other_thread_takes_the_bands_of_a_busy_one():
    slow, done = threading.Event(), []

    def work(first, end):
        if first == 0:
            assert slow.wait(timeout=20)
        done.append(first)
        if len(done) == BANDS - 1:
            slow.set()

    by_bands(at_once, BANDS, work)
    assert done[-1] == 0


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    assert at_once(int, int) == (0, 0)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(at_once, (int, int)).get(timeout=20) == (0, 0)
