"""The boundary: what models, covariances and events must be before they are let in."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import EventError, KalmarkError, ModelError
from kalmark.events import MOST, Control, Fix, Scan, finite, label_of_event, refuse_huge, short_text
from kalmark.filter import kernels
from kalmark.models.protocols import Motion, OwnNoise, Sensor, coasts, innovation_size
from kalmark.tracks.classes import Classes

MOST_OBSERVATIONS = 5000  # of one scan: a map of as many takes 2 GB, and a scan of all of them half a minute
ROUNDING = 1e-3  # of a correlation
SEMIDEFINITE = 1e-9  # in units of its own sigmas, by which rounding may take an eigenvalue below zero


def check_covariance(
    value: Any, size: int, what: str, *, definite: bool, error: type[KalmarkError] = EventError
) -> Array:
    """Return a copy of a (size, size) covariance; raise `error` if it is asymmetric or not positive (semi)definite."""
    cov = finite(value, what, MOST["m"] ** 2, error)
    if cov.shape != (size, size):
        raise error(f"{what} has shape {cov.shape}, expected ({size}, {size})")
    _refuse_indefinite(cov[None], what, definite, error)
    return cov


def instance(value: Any, protocol: type, what: str, expected: str) -> None:
    """Raise ModelError if `value` is not of that protocol or class, or is a class itself instead of one of its kind."""
    if isinstance(value, type):
        raise ModelError(f"{what} is the class {value.__name__}, expected an instance: {value.__name__}(...)")
    if not isinstance(value, protocol):
        raise ModelError(f"{what} is {short_text(value)}, expected {expected}")


def require_methods(value: Any, methods: tuple[str, ...], what: str, expected: str) -> None:
    """Raise ModelError if `value` lacks one of these methods, or is a class itself instead of one of its kind."""
    instance(value, object, what, expected)
    if not all(callable(getattr(value, method, None)) for method in methods):
        raise ModelError(f"{what} is {short_text(value)}, expected {expected}")


def refuse_odd_association(value: Any, what: str) -> None:
    """Refuse what does not decide which landmark was seen."""
    expected = "an object like km.association.Automatic(), with threshold and associate"
    require_methods(value, ("threshold", "associate"), what, expected)


def _refuse_indefinite(covs: Array, what: str, definite: bool, error: type[KalmarkError] = EventError) -> None:
    """Refuse finite matrices (K, m, m) that are not covariances."""
    scale = np.abs(covs).max(axis=(1, 2), initial=0.0)
    with np.errstate(over="ignore"):
        skewed = np.abs(covs - covs.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0) > 1e-9 * scale
    if skewed.any():
        raise error(f"{what} is {short_text(covs[np.argmax(skewed)].tolist())}, expected a symmetric matrix")
    variances = np.diagonal(covs, axis1=1, axis2=2)
    sigma = np.sqrt(np.maximum(variances, kernels.LEAST_VARIANCE))  # in units of these: no large variance hides another
    lowest = np.linalg.eigvalsh(covs / sigma[:, :, None] / sigma[:, None, :]).min(axis=1)
    lowest[(variances < -kernels.LEAST_VARIANCE).any(axis=1)] = -np.inf
    bad = ~(lowest > 0) if definite else ~(lowest >= -SEMIDEFINITE)
    if bad.any():
        kind = "positive definite" if definite else "positive semidefinite"
        own = np.linalg.eigvalsh(covs[np.argmax(bad)]).min()
        raise error(f"{what} has the eigenvalue {min(own, 0.0):.3g}, expected a {kind} matrix")


def fault_of(P: Array) -> str:
    """Return what is wrong with a covariance (n, n) of the map, "" if nothing is but the rounding of its numbers."""
    if not np.isfinite(P).all():
        return "is not finite"
    sigma = np.sqrt(np.maximum(P.diagonal(), kernels.LEAST_VARIANCE))
    lowest = float(np.linalg.eigvalsh(P / sigma / sigma[:, None])[0])
    return (
        f"is not positive semidefinite: in its own sigmas it has the eigenvalue {lowest:.3g}"
        if lowest < -ROUNDING
        else ""
    )


def check_numbers(value: Any, size: int, what: str, error: type[KalmarkError]) -> Array:
    """Return a copy of (size,) finite numbers; raise `error` if it is anything else."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{what} is {short_text(value)}, expected {size} finite numbers") from None
    if array.shape != (size,) or not np.isfinite(array).all():
        raise error(f"{what} is {short_text(array.tolist())}, expected {size} finite numbers")
    return finite(array, what, error=error)


SMALLEST_BOUND = min(MOST.values())


@lru_cache(maxsize=256)
def _are_covariances(numbers: bytes, shape: tuple[int, int, int], definite: bool) -> bool:
    """Return whether some numbers are certainly covariances (K, m, m); most sensors repeat theirs."""
    covs = np.frombuffer(numbers).reshape(shape).copy()  # as an event has them: numba compiles per kind of array
    return kernels.are_covariances(covs, (-0.1 if definite else 0.1) * SEMIDEFINITE)


def _refuse_bad_noise(event: Control | Scan, covs: Array, columns: tuple[str, ...], *, definite: bool) -> None:
    """Refuse the covariances (K, m, m) of an event that are none, or have sigmas larger than means anything."""
    if not _are_covariances(covs.tobytes(), covs.shape, definite):
        _refuse_indefinite(covs, f"{label_of_event(event)}: cov", definite)
    if event.largest_cov > SMALLEST_BOUND**2 and covs.shape[-1] == len(columns):
        sigmas = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
        refuse_huge(sigmas, tuple(f"sigma_{column}" for column in columns), f"{label_of_event(event)}: cov")


def refuse_bad_control(event: Control, motion: Motion) -> None:
    """Refuse a control that is not of a motion's components, a part of one that is no increment, and bad noise."""
    columns, m = motion.columns, len(motion.columns)
    if event.share != 1.0 and (motion.held or coasts(motion)):
        rates = f"expected 1: the controls {', '.join(columns)} are no increments of a pose, and only these have parts"
        raise EventError(f"{label_of_event(event)}: share is {event.share:g}, {rates}")
    if event.u.shape != (m,):
        raise EventError(f"{label_of_event(event)}: u has shape {event.u.shape}, expected ({', '.join(columns)})")
    if event.largest > SMALLEST_BOUND:
        refuse_huge(event.u, columns, label_of_event(event))
    if event.cov is not None:
        if event.cov.shape != (m, m):
            raise EventError(f"{label_of_event(event)}: cov has shape {event.cov.shape}, expected ({m}, {m})")
        _refuse_bad_noise(event, event.cov[None], columns, definite=False)
    more = event.uneven
    if more is not None and (event.share == 1.0 or more.shape != (m,) or (more < 0.0).any()):
        wanted = f"{m} variances, of a part of an increment: share below 1"
        raise EventError(f"{label_of_event(event)}: uneven is {short_text(more.tolist())}, expected {wanted}")


def refuse_bad_fix(event: Fix, size: int) -> None:
    """Refuse a fix that is not a position (size,) with its covariance."""
    if event.y.shape != (size,):
        expected = "x and y in m" if size == 2 else "x, y and z in m"
        raise EventError(f"{label_of_event(event)}: y has shape {event.y.shape}, expected ({size},): {expected}")
    check_covariance(event.cov, size, f"{label_of_event(event)}: cov", definite=True)


def refuse_other_classes(event: Scan, classes: Classes) -> None:
    """Refuse classes that a sensor does not report."""
    other = {*(event.classes or ())} - {*classes.names, None}
    if other:
        wanted = " or ".join([", ".join(classes.names[:-1]), classes.names[-1]])
        raise EventError(f"{label_of_event(event)}: class is {short_text(min(map(str, other)))}, expected {wanted}")


def measurements(event: Scan, sensor: Sensor, check: Callable[[Array], None] | None = None) -> Array:
    """Return the noise R (K, p, p) of a scan's innovations, refusing measurements its sensor cannot have made.

    `check` is the sensor's own, if it has one.
    """
    m, count = len(sensor.columns), len(event.y)
    if event.width != m and (count or event.width):
        expected = f"expected {m}: {', '.join(sensor.columns)}"
        raise EventError(f"{label_of_event(event)}: y has {event.width} columns, {expected}")
    if count > MOST_OBSERVATIONS:
        raise EventError(
            f"{label_of_event(event)}: {count} observations, expected at most {MOST_OBSERVATIONS} in one scan"
        )
    if count and event.largest > SMALLEST_BOUND:
        refuse_huge(event.y, sensor.columns, label_of_event(event))
    if check is not None and count:
        try:
            check(event.y)
        except EventError as error:
            raise EventError(f"{label_of_event(event)}: {event.robot}.{event.sensor}, {error}") from None
    if event.cov is None and not count:
        return np.zeros((0, m, m))
    p = innovation_size(sensor)
    if event.cov is None:
        R = np.asarray(sensor.noise(event.y), np.float64)  # one of whole numbers would be compiled for, too
        if R.shape != (count, p, p) and not isinstance(sensor, OwnNoise):
            wrong = f"noise of {count} measurements has shape {R.shape}, expected ({count}, {p}, {p})"
            raise EventError(f"{label_of_event(event)}: {event.robot}.{event.sensor}, {type(sensor).__name__}: {wrong}")
        return R
    if event.cov.shape not in ((p, p), (count, p, p)):
        expected = f"expected ({p}, {p}) or ({count}, {p}, {p})"
        raise EventError(f"{label_of_event(event)}: cov has shape {event.cov.shape}, {expected}")
    each = event.cov if event.cov.ndim == 3 else event.cov[None]
    _refuse_bad_noise(event, each, sensor.columns, definite=True)
    # written out: one that cannot be written, or has another order, would be compiled for, too
    covs = each if len(each) == count else np.repeat(each, count, axis=0)
    return sensor.noise_from(event.y, covs) if isinstance(sensor, OwnNoise) else covs
