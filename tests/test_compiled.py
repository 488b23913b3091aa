"""Calls by address: from compiled code and from Python, what comes back and what goes wrong."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from kalmark import compiled
from kalmark.compiled import address_of, by_address, signature_of
from kalmark.filter.corrections import compile_correction, compiled_textbook

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

    def begin() -> None:
        compiled.ahead(positive_sum, compile_correction, "textbook", "none", 1, False)

    monkeypatch.setattr(compiled.subprocess, "Popen", Started)
    monkeypatch.setattr(compiled, "cache_folder", lambda part: str(tmp_path))
    monkeypatch.setattr(compiled.os, "cpu_count", lambda: 2)
    begin()
    begin()  # while it is under way
    ((text, mark),) = asked
    for _ in range(2):
        compiled.caught_up(count)
        compiled.caught_up(positive_sum)
    assert waited == [True]
    compiled.work_ahead(text, mark)
    begin()
    assert len(asked) == 1 and compiled_textbook.overloads


def test_a_job_that_fails_is_not_taken_for_done(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    with pytest.raises(KeyError):
        compiled.work_ahead('["kalmark.filter.corrections", "compile_correction", "no", "none", 1, false]', str(mark))
    assert not mark.exists()
