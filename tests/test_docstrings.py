"""Public functions that take or return arrays state the shapes."""

from __future__ import annotations

import pytest
from structure import SHAPE, of_arrays


def test_public_functions_of_arrays_state_a_shape() -> None:
    missing = [one.place for one in of_arrays() if not one.documented]
    assert not missing, f"no shape such as (K, 3) in the docstrings of {', '.join(missing)}"


@pytest.mark.parametrize(
    "text", ["y (K, 3)", "(n,)", "P (..., n, n)", "(4 (2 n - 5), 2)", "(len(t_ns), 3|7)", "(size,)"]
)
def test_a_shape_is_recognised(text: str) -> None:
    assert SHAPE.search(text)


@pytest.mark.parametrize("text", ["[S] (26)", "[S] (26-30)", "(x, y, theta)"])
def test_other_parentheses_are_no_shape(text: str) -> None:
    assert not SHAPE.search(text)
