"""What happens to a robot: `Control`, `Scan` and `Fix`, the only things that enter the filter.

Logs, the simulator and a live robot all speak these three.  Time is int64 nanoseconds inside, seconds at the edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import EventError

Array = npt.NDArray[np.float64]
Id = int | str


def nanoseconds(t_s: float | None, t_ns: int | None, what: str) -> int:
    """Return the event time in integer nanoseconds, from exactly one of seconds and nanoseconds."""
    if (t_s is None) == (t_ns is None):
        raise EventError(f"{what}: expected exactly one of t_s and t_ns, got t_s={t_s!r} and t_ns={t_ns!r}")
    if t_ns is not None:
        return int(t_ns)
    try:
        return round(float(t_s) * 1e9)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise EventError(f"{what}: t_s is {t_s!r}, expected a finite number of seconds") from None


def finite(value: Any, what: str) -> Array:
    """Return a copy of `value` as a float array, or refuse it if anything in it is not a finite number."""
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise EventError(f"{what} is {value!r}, expected numbers") from None
    flat = array.ravel()
    if not math.isfinite(flat @ flat) and not np.isfinite(flat).all():
        bad = flat[~np.isfinite(flat)][0]
        raise EventError(f"{what} holds {bad}, expected finite numbers")
    return array


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Control:
    """A robot's control: a velocity held from `t_s` on, or an increment that ended at `t_s`.

    `u` has the motion model's shape and units; `cov` (same size, squared) overrides the model's own noise.
    """

    t_ns: int
    robot: str
    u: Array
    cov: Array | None

    def __init__(
        self, t_s: float | None = None, robot: str = "", u: Any = (), cov: Any = None, *, t_ns: int | None = None
    ) -> None:
        set_ = object.__setattr__
        t_ns = nanoseconds(t_s, t_ns, f"control of {robot!r}")
        what = "control of %r at t=%.9g s: " % (robot, t_ns * 1e-9)  # noqa: UP031 - on the hot path
        set_(self, "t_ns", t_ns)
        set_(self, "robot", robot)
        set_(self, "u", finite(u, what + "u"))
        set_(self, "cov", None if cov is None else finite(cov, what + "cov"))

    @property
    def t_s(self) -> float:
        """The time in seconds."""
        return self.t_ns * 1e-9


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Scan:
    """What one sensor of one robot saw at one instant: K observations `y` of shape (K, m).

    `ids` names the landmarks (None, for one or all of them: unknown).  `cov` of shape (m, m) for all or (K, m, m)
    overrides the noise of the sensor model.
    """

    t_ns: int
    robot: str
    sensor: str
    y: Array
    ids: tuple[Id | None, ...] | None
    cov: Array | None

    def __init__(
        self,
        t_s: float | None = None,
        robot: str = "",
        sensor: str = "",
        y: Any = (),
        ids: Any = None,
        cov: Any = None,
        *,
        t_ns: int | None = None,
    ) -> None:
        set_ = object.__setattr__
        t_ns = nanoseconds(t_s, t_ns, f"scan of {robot!r}")
        what = "scan of %r by %r at t=%.9g s: " % (sensor, robot, t_ns * 1e-9)  # noqa: UP031 - on the hot path
        y = finite(y, what + "y")
        if y.size == 0:
            y = y.reshape(0, 0)
        if y.ndim != 2:
            raise EventError(f"{what}y has shape {y.shape}, expected (K, m): one row an observation")
        set_(self, "t_ns", t_ns)
        set_(self, "robot", robot)
        set_(self, "sensor", sensor)
        set_(self, "y", y)
        set_(self, "ids", None if ids is None else checked_ids(ids, len(y), what))
        set_(self, "cov", None if cov is None else finite(cov, what + "cov"))

    @property
    def t_s(self) -> float:
        """The time in seconds."""
        return self.t_ns * 1e-9


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Fix:
    """An absolute position of a robot, `y` = (x, y[, z]) in metres in the map's frame, with covariance `cov`."""

    t_ns: int
    robot: str
    y: Array
    cov: Array

    def __init__(
        self, t_s: float | None = None, robot: str = "", y: Any = (), cov: Any = None, *, t_ns: int | None = None
    ) -> None:
        set_ = object.__setattr__
        t_ns = nanoseconds(t_s, t_ns, f"fix of {robot!r}")
        what = f"fix of {robot!r} at t={t_ns * 1e-9:.9g} s: "
        if cov is None:
            raise EventError(f"{what}cov is missing, expected a covariance in m^2")
        set_(self, "t_ns", t_ns)
        set_(self, "robot", robot)
        set_(self, "y", finite(y, what + "y"))
        set_(self, "cov", finite(cov, what + "cov"))

    @property
    def t_s(self) -> float:
        """The time in seconds."""
        return self.t_ns * 1e-9


Event = Control | Scan | Fix

_RANK = {Control: 0, Scan: 1, Fix: 2}


def checked_ids(ids: Any, count: int, what: str) -> tuple[Id | None, ...]:
    """Return the landmark ids of one scan, refusing a wrong number of them and duplicates."""
    ids = tuple(i.item() if isinstance(i, np.generic) else i for i in ids)
    if len(ids) != count:
        raise EventError(f"{what}{len(ids)} ids for {count} observations, expected one id each")
    known = [i for i in ids if i is not None]
    if len(set(known)) != len(known):
        twice = next(i for i in known if known.count(i) > 1)
        raise EventError(f"{what}id {twice!r} appears twice, expected each landmark once in a scan")
    return ids


def order(event: Event) -> tuple[int, int, str, str]:
    """Sort key of events: time, then Control, Scan, Fix, then robot, then sensor (a stable sort keeps arrival)."""
    return event.t_ns, _RANK[type(event)], event.robot, event.sensor if isinstance(event, Scan) else ""
