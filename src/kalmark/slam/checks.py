"""The boundary: what a covariance and a scan must be before they are let in."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import EventError
from kalmark.models.protocols import Sensor
from kalmark.slam.events import Scan

Array = npt.NDArray[np.float64]


def covariance(value: Any, size: int, what: str, *, definite: bool) -> Array:
    """Return a (size, size) covariance, refusing one that is asymmetric or not positive (semi)definite."""
    cov = np.asarray(value, dtype=np.float64)
    if cov.shape != (size, size):
        raise EventError(f"{what} has shape {cov.shape}, expected ({size}, {size})")
    _refuse_indefinite(cov[None], what, definite)
    return cov


def _refuse_indefinite(covs: Array, what: str, definite: bool) -> None:
    if not np.isfinite(covs).all():
        raise EventError(f"{what} holds {covs[~np.isfinite(covs)][0]}, expected finite numbers")
    scale = np.abs(covs).max(axis=(1, 2), initial=0.0)
    skew = np.abs(covs - covs.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)
    if (skew > 1e-9 * scale).any():
        raise EventError(f"{what} is {covs[np.argmax(skew)].tolist()}, expected a symmetric matrix")
    lowest = np.linalg.eigvalsh(covs).min(axis=1)
    bad = lowest <= 0 if definite else lowest < -1e-9 * scale
    if bad.any():
        i = int(np.argmax(bad))
        kind = "positive definite" if definite else "positive semidefinite"
        raise EventError(f"{what} has the eigenvalue {lowest[i]:.3g}, expected a {kind} matrix")


def measurements(event: Scan, sensor: Sensor) -> Array:
    """Return the noise R (K, m, m) of a scan, refusing measurements its sensor cannot have made."""
    m, count = len(sensor.columns), len(event.y)
    if count == 0:
        return np.zeros((0, m, m))
    if event.y.shape[1] != m:
        raise EventError(
            f"scan at t={event.t_s:.9g} s: y has {event.y.shape[1]} columns, expected {m}: {', '.join(sensor.columns)}"
        )
    check = getattr(sensor, "check", None)
    if check is not None:
        try:
            check(event.y)
        except EventError as error:
            raise EventError(f"scan at t={event.t_s:.9g} s: {error}") from None
    if event.cov is None:
        return sensor.noise(event.y)
    what = f"scan at t={event.t_s:.9g} s: cov"
    if event.cov.shape not in ((m, m), (count, m, m)):
        raise EventError(f"{what} has shape {event.cov.shape}, expected ({m}, {m}) or ({count}, {m}, {m})")
    R = np.ascontiguousarray(np.broadcast_to(event.cov, (count, m, m)))
    _refuse_indefinite(R, what, definite=True)
    return R
