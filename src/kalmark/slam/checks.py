"""The boundary: what a model, a covariance and a scan must be before they are let in."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import EventError, KalmarkError, ModelError
from kalmark.models.protocols import Sensor
from kalmark.slam.events import Scan, finite, seconds, shown

Array = npt.NDArray[np.float64]


def covariance(value: Any, size: int, what: str, *, definite: bool, error: type[KalmarkError] = EventError) -> Array:
    """Return a copy of a (size, size) covariance; raise `error` if it is asymmetric or not positive (semi)definite."""
    cov = finite(value, what, error)
    if cov.shape != (size, size):
        raise error(f"{what} has shape {cov.shape}, expected ({size}, {size})")
    _refuse_indefinite(cov[None], what, definite, error)
    return cov


def instance(value: Any, protocol: type, what: str, expected: str) -> None:
    """Raise ModelError if `value` is not of that protocol or class, or is a class itself instead of one of its kind."""
    if isinstance(value, type):
        raise ModelError(f"{what} is the class {value.__name__}, expected an instance: {value.__name__}(...)")
    if not isinstance(value, protocol):
        raise ModelError(f"{what} is {shown(value)}, expected {expected}")


def _refuse_indefinite(covs: Array, what: str, definite: bool, error: type[KalmarkError] = EventError) -> None:
    """Refuse finite matrices (K, m, m) that are not covariances."""
    scale = np.abs(covs).max(axis=(1, 2), initial=0.0)
    with np.errstate(over="ignore"):
        skewed = np.abs(covs - covs.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0) > 1e-9 * scale
    if skewed.any():
        raise error(f"{what} is {shown(covs[np.argmax(skewed)].tolist())}, expected a symmetric matrix")
    lowest = np.linalg.eigvalsh(covs).min(axis=1)
    bad = ~(lowest > 0) if definite else ~(lowest >= -1e-9 * scale)
    if bad.any():
        kind = "positive definite" if definite else "positive semidefinite"
        raise error(f"{what} has the eigenvalue {lowest[np.argmax(bad)]:.3g}, expected a {kind} matrix")


def measurements(event: Scan, sensor: Sensor) -> Array:
    """Return the noise R (K, p, p) of a scan's innovations, refusing measurements its sensor cannot have made."""
    m, count = len(sensor.columns), len(event.y)
    if event.width != m and (count or event.width):
        expected = f"expected {m}: {', '.join(sensor.columns)}"
        raise EventError(f"scan at t={seconds(event.t_ns)} s: y has {event.width} columns, {expected}")
    check = getattr(sensor, "check", None)
    if check is not None and count:
        try:
            check(event.y)
        except EventError as error:
            raise EventError(f"scan at t={seconds(event.t_ns)} s: {error}") from None
    if event.cov is None:
        return sensor.noise(event.y) if count else np.zeros((0, m, m))
    what, p = f"scan at t={seconds(event.t_ns)} s: cov", getattr(sensor, "cov_size", m)
    if event.cov.shape not in ((p, p), (count, p, p)):
        raise EventError(f"{what} has shape {event.cov.shape}, expected ({p}, {p}) or ({count}, {p}, {p})")
    _refuse_indefinite(event.cov.reshape(-1, p, p), what, definite=True)
    covs = np.ascontiguousarray(np.broadcast_to(event.cov, (count, p, p)))
    return sensor.noise_from(event.y, covs) if hasattr(sensor, "noise_from") else covs
