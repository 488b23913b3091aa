"""Figures and counts as people write them."""

from __future__ import annotations

import math


def figure(value: float, digits: int = 3) -> str:
    """Return a value to so many significant digits, without a power of ten where it is large: 110, not 1.1e+02."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if math.isfinite(value) and 10**digits <= abs(value) < 1e9 else text


def count(number: int, one: str, many: str = "") -> str:
    """Return a number with its noun: 1 scan, 2 scans."""
    return f"{number} {one if number == 1 else many or one + 's'}"
