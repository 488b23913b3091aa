"""Calls by address: from compiled code and from Python, what comes back and what goes wrong."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from kalmark import compiled
from kalmark.compiled import address_of, by_address, signature_of
from kalmark.filter.corrections import gauge

SUM = signature_of("f8(f8[::1])")
call = by_address(SUM)


@numba.njit
def positive_sum(a: np.ndarray) -> float:
    if a[0] < 0:
        raise ValueError("negative")
    return a.sum()


@numba.njit
def twice(address: int, a: np.ndarray) -> float:
    return 2 * call(address, (a,))


@numba.njit
def count(a: np.ndarray) -> int:
    return len(a)


def test_compiled_code_and_python_call_the_same_function_and_get_its_errors() -> None:
    address = address_of(positive_sum, SUM)
    assert twice(address, np.ones(3)) == 6.0
    assert call(address, (np.ones(3),)) == 3.0
    for caller in (lambda a: twice(address, a), lambda a: call(address, (a,))):
        with pytest.raises(ValueError, match="negative"):
            caller(-np.ones(3))


def test_a_function_that_returns_something_else_has_no_address_to_be_called_by() -> None:
    with pytest.raises(TypeError, match="returns int64, expected float64"):
        address_of(count, SUM)


def test_what_is_compiled_ahead_is_asked_for_once_in_a_cache_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited, asked = [], []

    class Started:
        def __init__(self, command: list[str], **_: object) -> None:
            asked.append(command[-2:])

        def wait(self) -> None:
            waited.append(True)

    monkeypatch.setattr(compiled.subprocess, "Popen", Started)
    monkeypatch.setattr(compiled, "cache_folder", lambda part: str(tmp_path / part))
    monkeypatch.setattr(compiled.os, "cpu_count", lambda: 2)
    for _ in range(2):
        compiled.ahead({positive_sum: "f8[::1]"})
    assert asked == [[f"{__name__}:compiled_positive_sum", "f8[::1]"]]
    for _ in range(2):
        compiled.caught_up(count)
        compiled.caught_up(positive_sum)
    assert waited == [True]


def test_functions_are_compiled_by_their_names_and_the_mark_goes_where_that_fails(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    mark.touch()
    compiled.compile_jobs(str(mark), "kalmark.filter.corrections:gauge", "f8[::1], f8[::1], i8, i8")
    assert gauge.overloads and mark.exists()
    with pytest.raises(AttributeError):
        compiled.compile_jobs(str(mark), "kalmark.filter.corrections:no_such_function", "f8")
    assert not mark.exists()
