"""Equal runs have equal ledgers; an exception is shown by its sentence, or by its type, file and line."""

from itertools import permutations

import numpy as np
import pytest

from flow.contracts import Loss, LossReason, StageError
from flow.runtime.ledger import Ledger, failure
from stages import StereoCamera, StereoFrame


def sentence_of(call):
    with pytest.raises(Exception) as caught:  # noqa: PT011
        call()
    return failure(caught.value)


def refuse():
    raise StageError("the image is too dark; take another")


def test_a_stage_error_is_shown_as_it_is():
    assert sentence_of(refuse) == "the image is too dark; take another"


def test_a_stage_error_of_a_called_library_is_shown_as_it_is():
    camera = StereoCamera(fx=1.0, fy=1.0, cx=1.0, cy=1.0, baseline=0.1, width=2, height=2)
    assert sentence_of(lambda: StereoFrame(0, np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint8), camera)) == (
        "StereoFrame: left is (2, 2), right is (2, 3)"
    )


@pytest.mark.parametrize(("call", "sentence"), [
    (lambda: np.zeros(3).reshape(2), "ValueError: cannot reshape array of size 3 into shape (2,)"),
    (lambda: np.linalg.inv(np.zeros((2, 2))), "LinAlgError: Singular matrix"),  # raised in a file of NumPy's
    (lambda: int("nix"), "ValueError: invalid literal for int() with base 10: 'nix'"),
    (lambda: {}["left"], "KeyError: 'left'"),
    (lambda: exec("raise OSError('two\\n lines')"), "OSError: two lines"),
])  # fmt: skip
def test_any_other_exception_is_named_with_the_stage_s_file_and_line(call, sentence):
    line = call.__code__.co_firstlineno
    assert sentence_of(call) == f"{sentence} (test_ledger.py, line {line}; --debug shows the traceback)"


def test_equal_runs_give_equal_ledgers_whatever_fails_first():
    where = [(0, "match", "right"), (1, "match", "left"), (1, "match", "right"), (1, "refine", "left")]
    entries = [Loss(stream, stamp, stage, LossReason.FAILED, "no") for stamp, stage, stream in where]
    for order in permutations(entries):
        ledger = Ledger()
        for entry in order:
            ledger.add(entry)
        assert list(ledger.entries) == entries
