"""Corrections of a log that a configuration asks for: factors of its columns, and times of its sensors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import Control, Event, Fix, Raw, sort_key
from kalmark.logs.log import Log
from kalmark.logs.source import quantity, spelling_hint

TIME = "t_s"

Path_ = tuple[str, ...]


def correct_log(log: Log, factors: Mapping[str, Any] | None, shift_s: Mapping[str, Any] | None) -> Log:
    """Return a log with its columns times `factors` and the scans of its sensors `shift_s` seconds later.

    Both may be nested by robot and sensor: ``{range_m: .001}`` is for all sensors, ``{laser: {range_m: .001}}`` for
    one.  The factor of ``t_s`` is that of all times.  Raises LogError for what the log does not have.
    """
    by, shifts = dict(_flat(factors or {}, "factors")), dict(_flat(shift_s or {}, "shift_s"))
    if not by and not shifts:
        return log
    if any(value == 0 for value in by.values()):
        raise LogError("log option factors has a 0, expected factors that are not zero")
    sensors: dict[Path_, tuple[str, ...]] = {path: names for path, names in log.sensor_columns.items()}
    columns = {(robot,): names for robot, names in log.control_columns.items()} | sensors
    _refuse_idle("factors", by, [(*path, name) for path, names in columns.items() for name in names] + [(TIME,)])
    _refuse_idle("shift_s", shifts, list(sensors))
    of = {path: np.array([_product(by, (*path, name)) for name in names]) for path, names in columns.items()}
    late = {path: math.fsum(s for name, s in shifts.items() if {*name} <= {*path}) for path in sensors}
    times = by.get((TIME,), 1.0)
    events = [_event(event, of, late, times) for event in log]
    truth = {robot: replace(path, t_ns=_scaled(path.t_ns, times)) for robot, path in log.truth.items()}
    gps = {robot: replace(path, t_ns=_scaled(path.t_ns, times)) for robot, path in log.gps.items()}
    return replace(log, events=sorted(events, key=sort_key), truth=truth, gps=gps)


def _flat(values: Mapping[str, Any], option: str, path: Path_ = ()) -> Iterator[tuple[Path_, float]]:
    """Yield the numbers of a nested mapping with their paths."""
    for name, value in values.items():
        here = (*path, str(name))
        if isinstance(value, Mapping):
            yield from _flat(value, option, here)
        else:
            yield here, quantity(value, ".".join((option, *here)))


def _refuse_idle(option: str, given: Mapping[Path_, float], known: list[Path_]) -> None:
    """Refuse a path that is of nothing in the log.  Raises LogError."""
    for path in given:
        if not any(path[-1] in of[-1:] + (of if option == "shift_s" else ()) and {*path} <= {*of} for of in known):
            names = [*dict.fromkeys(of[-1] for of in known)]
            raise LogError(
                f"log option {option}.{'.'.join(path)} is of nothing in this log, expected robots and sensors of the "
                f"log and one of {', '.join(names) or 'none'}{spelling_hint(path[-1], names)}"
            )


def _product(factors: Mapping[Path_, float], path: Path_) -> float:
    """Return the factor of a column: the product of all that are of it."""
    mine = (value for name, value in factors.items() if name[-1] == path[-1] and {*name} <= {*path})
    return float(np.prod([1.0, *mine]))


def _event(event: Event, factors: Mapping[Path_, Array], late: Mapping[Path_, float], times: float) -> Event:
    t_ns = event.t_ns if times == 1.0 else round(event.t_ns * times)
    if isinstance(event, Fix):
        return replace(event, t_ns=t_ns)
    path = (event.robot,) if isinstance(event, Control) else (event.robot, event.sensor)
    t_ns += round(late.get(path, 0.0) * 1e9)
    if isinstance(event, Raw):
        return replace(event, t_ns=t_ns)
    by = factors.get(path, np.ones(1))
    cov = None if event.cov is None else event.cov * np.outer(by, by)
    if isinstance(event, Control):
        return replace(event, t_ns=t_ns, u=event.u * by, cov=cov)
    return replace(event, t_ns=t_ns, y=event.y * by if len(event.y) else event.y, cov=cov)


def _scaled(t_ns: Any, times: float) -> Any:
    return t_ns if times == 1.0 else np.round(t_ns * times).astype(np.int64)
