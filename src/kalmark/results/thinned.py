"""Numbers of a report as plain lists for JSON, few enough and short enough for a page."""

from __future__ import annotations

import math
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from kalmark.results.history import Array, Ints

POINTS = 2000


def xy(points: Array) -> dict[str, Any]:
    """Return points (N, 2 or 3) to a tenth of a millimetre."""
    return {axis: rounded(column, 4) for axis, column in zip("xyz", points.T, strict=False)}


def gaussians(means: Array, covariances: Array) -> dict[str, Any]:
    """Return means (N, d) and covariances (N, d, d) column by column: x, y, pxx, pxy, pyy, in space more."""
    pairs = combinations_with_replacement(range(means.shape[1]), 2)
    return xy(means) | {f"p{'xyz'[i]}{'xyz'[j]}": significant(covariances[:, i, j]) for i, j in pairs}


def thin(count: int) -> Ints:
    """Return at most about 2,000 evenly spread indices, the last one among them."""
    stride = max(1, -(-count // POINTS))
    indices = np.arange(0, count, stride)
    return np.append(indices, count - 1) if count and indices[-1] != count - 1 else indices


def rounded(values: Array, digits: int) -> list[float | None]:
    """Return values to so many decimals, None for NaN and infinity."""
    return [value if math.isfinite(value) else None for value in np.round(values, digits).tolist()]


def significant(values: Array, digits: int = 4) -> list[float | None]:
    """Return values to so many significant digits, None for NaN and infinity."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values.tolist()]
