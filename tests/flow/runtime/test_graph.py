"""What a stage returns is what its annotation says."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flow.contracts import unaliased
from flow.runtime.graph import misfit
from tests.flow.toys import Couple


@pytest.mark.parametrize(("value", "kind", "why"), [
    ({"a": 1.0, "b": "x"}, dict[str, float], "str, not float, as 'b'"),
    (Couple(1, [2.0, "x"]), Couple, "list, not float, as 'value'"), (Couple(1, None), Couple, ""),
    ((1.0, "x"), tuple[float, ...], "str, not float, as 1"),
    (["x"], list[float] | tuple[str], "str, not float, as 0"),
    (np.zeros(2), NDArray[np.uint8], "an array of float64, not of uint8"),
    (np.zeros(2, bool), NDArray[np.uint8], "an array of bool, not of uint8"),
    ({"a": np.zeros(2)}, Mapping[str, NDArray[np.int64]], "an array of float64, not of int64, as 'a'"),
    ((1.0, 2, 3), tuple[float, int], "3 values, not 2"), ((1.0,), tuple[float, int], "1 value, not 2"),
    ((1.0, 2.0, 3.0), Sequence[float], ""), ((1.0, "x"), Sequence[float], "str, not float, as 1"),
    (np.zeros(2), NDArray[np.float32], ""), (np.float32(1), float, ""), ((1, "x"), tuple[int, str], ""),
    ({"a": 3}, Mapping[str, float | None], ""), (np.zeros(2), NDArray[Any], ""), ({"a": object()}, dict[str, Any], ""),
])  # fmt: skip
def test_a_result_fits_its_annotation_with_all_that_is_in_it(value, kind, why):
    assert misfit(value, unaliased(kind)) == why
