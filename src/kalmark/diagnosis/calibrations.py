"""The calibrations of a configuration that a log shows to be off, each beside all that the log may have instead."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.stats import norm

from kalmark.arrays import Array
from kalmark.batch.data import BatchInput
from kalmark.config.tree import KeyPath
from kalmark.diagnosis import causes
from kalmark.diagnosis.batch_search import sensors_of
from kalmark.diagnosis.causes import LEAST_GAIN, Finding
from kalmark.diagnosis.error_columns import HEIGHT, MOST_SCALE, Column, columns_of, rates_of, stacked
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.tunable_keys import Keys
from kalmark.results.run import Run

ALPHA = 0.01  # of right configurations of which anything is changed
KNOWN_TO = {"": MOST_SCALE, "m": 0.1}  # scales and places of mounts beforehand: what is more is no error


def calibrations(
    run: Run, linear: Linear, given: BatchInput, keys: Keys, sure: set[KeyPath]
) -> tuple[list[Finding], dict[KeyPath, str]]:
    """Return the calibrations that are off; the ones that the log cannot distinguish from another error name that.

    All systematic errors are estimated together, so that one that the log does not determine has a large sigma.
    Those that it determines are estimated again without scales, which are not linear.
    """
    columns = [c for c in columns_of(linear, sensors_of(run), rates_of(linear, given.t_ns)) if c.name != HEIGHT]
    paths = [keys.calibration(run, column) for column in columns]
    joined: dict[Any, Column] = {}
    for column, path in zip(columns, paths, strict=True):
        key = path or (column.name, *column.of)
        old = joined.get(key)
        joined[key] = column if old is None else column._replace(Z=old.Z + column.Z, W=old.W + column.W)
    names, columns = [*joined], [*joined.values()]
    if not columns:
        return [], {}
    s, sigma, alone = _together(linear, columns)
    level = float(norm.isf(ALPHA / 2 / max(sum(path is not None for path in {*paths}), 1)))
    chosen, alike = [], {}
    for k, (key, column) in enumerate(zip(names, columns, strict=True)):
        if key not in paths:
            continue
        if key in sure or (_shows(s[k], sigma[k], level) and abs(s[k]) < column.most):
            chosen.append(k)
        elif _shows(*alone[k], level):
            alike[key] = f"the log does not distinguish it from other systematic errors (alone {alone[k][0]:+.3g})"
    beside = [k for k, c in enumerate(columns) if names[k] not in paths and c.unit]
    s, sigma, _ = _together(linear, [columns[k] for k in chosen + beside]) if chosen else (s, sigma, alone)
    found = [
        Finding(columns[k].name, names[k], 0.0, 0.0, float(s[n]), float(sigma[n]), columns[k].unit)
        for n, k in enumerate(chosen)
    ]
    return found, alike


def _together(linear: Linear, columns: list[Column]) -> tuple[Array, Array, list[tuple[float, float]]]:
    """Return the systematic errors s (K,), all estimated at once, and their sigmas (K,); and each as if alone.

    The sigmas are by stretches of the run where these vary more than the noise (`causes.systematic`).
    """
    g, I, left = linear.scores_of(*stacked(columns))
    prior = [KNOWN_TO.get(column.unit, np.inf) if column.name != "range_offset" else np.inf for column in columns]
    I = I + np.diag(np.array(prior) ** -2.0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(I), 1e-300))
    C = scale[:, None] * np.linalg.pinv(I * np.outer(scale, scale), rcond=1e-12, hermitian=True) * scale
    s = C @ g
    P = causes.stretches(linear, left, s)
    sigma = np.sqrt(np.maximum(np.diag(C), np.diag(C @ P @ P.T @ C)))
    alone = {(f.name, *f.of): (f.value, f.sigma) for f in causes.systematic(linear, columns)}
    return s, sigma, [alone.get((c.name, *c.of), (0.0, math.inf)) for c in columns]


def _shows(s: float, sigma: float, level: float) -> bool:
    """Return whether a systematic error is other than zero."""
    return abs(s) > level * sigma and 0.5 * (s / sigma) ** 2 > LEAST_GAIN
