"""What the tests of map management share."""

from __future__ import annotations

import math

import pytest


@pytest.fixture
def never_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no robot be found by its landmarks."""
    monkeypatch.setattr("kalmark.slam.elsewhere.ODDS", math.inf)
