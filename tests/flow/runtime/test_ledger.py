"""The ledger says the same of equal runs, and of an exception what it says or where it broke down."""

from itertools import permutations

import numpy as np
import pytest

from flow.contracts import Loss, LossReason
from flow.runtime.ledger import Ledger, failure
from stages import Match


def said_of(call):
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        call()
    return failure(caught.value)


def refuse():
    raise ValueError(
        "the image is too dark; take another"  # a line below the `raise`
    )


def test_a_refusal_says_what_it_says():
    assert said_of(refuse) == "the image is too dark; take another"


def test_so_does_a_refusal_by_a_stage_of_ours_that_another_is_made_of():
    assert said_of(lambda: Match(disparities=-1)).startswith("Match.disparities must be")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: np.zeros(3).reshape(2), "ValueError: cannot reshape array of size 3 into shape (2,)"),
        (lambda: np.linalg.inv(np.zeros((2, 2))), "LinAlgError: Singular matrix"),  # raised in a file of NumPy's
        (lambda: int("nix"), "ValueError: invalid literal for int() with base 10: 'nix'"),
    ],
)
def test_an_operation_that_breaks_down_is_named_with_file_and_line(call, said):
    line = call.__code__.co_firstlineno
    assert said_of(call) == f"{said} (test_ledger.py, line {line}; --debug shows the way there)"


def test_equal_runs_give_equal_ledgers_whatever_fails_first():
    where = [(0, "match", "right"), (1, "match", "left"), (1, "match", "right"), (1, "refine", "left")]
    entries = [Loss(stream, stamp, stage, LossReason.FAILED, "no") for stamp, stage, stream in where]
    for order in permutations(entries):
        ledger = Ledger()
        for entry in order:
            ledger.add(entry)
        assert list(ledger.entries) == entries
