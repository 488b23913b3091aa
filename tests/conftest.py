"""Fixtures that find the real logs and recordings, or skip with a reason."""

from __future__ import annotations

import gc
import math
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("patient", deadline=None)  # a first call may compile
settings.load_profile("patient")

gc.set_threshold(100_000)  # a tenth of the time of the tests was the garbage collector's


def pytest_collection_finish() -> None:
    """Let the garbage collector leave the modules of all tests alone."""
    gc.freeze()


def _finder(variable: str) -> Callable[[str], Path]:
    def find(relative: str = ".") -> Path:
        folder = os.environ.get(variable)
        if not folder:
            pytest.skip(f"{variable} is not set: the real data is not here")
        path = Path(folder) / relative
        assert path.exists(), f"{variable} is set, but {path} is missing"
        return path

    return find


@pytest.fixture(scope="session")
def data() -> Callable[[str], Path]:
    """Return the path of a file or folder of the real logs."""
    return _finder("KALMARK_DATA")


@pytest.fixture(scope="session")
def oracle() -> Callable[[str], Path]:
    """Return the path of a recording made with another program."""
    return _finder("KALMARK_ORACLE")


@pytest.fixture
def never_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no robot be found by its landmarks."""
    monkeypatch.setattr("kalmark.slam.elsewhere.ODDS", math.inf)
