"""Counters of wheels that ran over between two readings: increments that are wrong by a power of two of their steps."""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import fixed_seconds
from kalmark.logs.log import Log
from kalmark.logs.table_columns import WHEELS

BITS = (16, 32)
FAR = 100  # times the median of the increments: what is farther is none of a wheel
LEAST = 1e-4  # of the median: a smaller difference between two increments is of rounding, and no step of the counter
OFF = 0.2  # of a step: increments are whole numbers of steps up to this


def refuse_overflow(log: Log) -> None:
    """Refuse increments of wheels across an overflow of their counter.  Raises LogError with the number to add."""
    for robot, columns in log.control_columns.items():
        controls = log.controls_of(robot)
        if columns != WHEELS or not controls:
            continue
        for name, values in zip(columns, np.array([control.u for control in controls]).T, strict=True):
            for k, bits, step in overflows(values)[:1]:
                more = -np.sign(values[k]) * 2.0**bits * step
                raise LogError(
                    f"{log.path or log.name}: {name} of {robot} at t={fixed_seconds(controls[k].t_ns)} s is "
                    f"{values[k]:.7g}: a counter of {bits} bits, whose steps are {step:.6g} rad, ran over, expected "
                    f"{values[k] + more:.6g}: add {more:.7g}"
                )


def overflows(values: Array) -> list[tuple[int, int, float]]:
    """Return which increments (N,) are across an overflow, of how many bits, and the counter's step (rad)."""
    size = np.abs(values)
    usual = float(np.median(size[size > 0])) if size.any() else 0.0
    far = np.flatnonzero(size > FAR * usual)
    near = np.sort(size[size <= FAR * usual])
    apart = np.diff(near, prepend=0.0)
    apart = apart[apart > LEAST * usual]
    if not len(far) or not len(apart):
        return []
    counts = np.round(near / apart.min())
    step = float(near @ counts / (counts @ counts))
    if np.abs(near / step - counts).max() > OFF:
        return []
    return [
        (int(k), bits, step) for k in far for bits in BITS if abs(size[k] / step - 2.0**bits) <= 2 * near[-1] / step
    ]
