"""Workspaces are shared by best fit, so that small calls do not take large memory from large calls."""

from stages.compiled.workspace import Workspaces


def test_a_large_call_beside_a_small_one_takes_the_large_memory_again():
    pool = Workspaces()
    with pool.one() as first, pool.one() as second:
        first.reserve(1000)
        second.reserve(10)
    for _ in range(3):
        with pool.one() as small:
            small.reserve(10)
            with pool.one() as large:
                large.reserve(1000)
                assert (small.whole.size, large.whole.size) == (10, 1000)


def test_memory_grows_where_nothing_fits():
    pool = Workspaces()
    with pool.one() as space:
        space.reserve(100)
        space.reserve(200)
        assert space.bytes(136).size == 136
