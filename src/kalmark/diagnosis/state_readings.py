"""Causes of misfits of a sensor of the state: its noise, its mount, its constants, the signs of its columns.

The log is filtered again with each of them changed, and the likelihoods of all innovations are compared.  A mount or a
constant is put into the map with a sigma as large as the innovations: the filter estimates it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain, compress
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from kalmark.arrays import Array
from kalmark.config.tree import Configuration, robot_section, value_at
from kalmark.diagnosis.cause_texts import log_correction_line
from kalmark.diagnosis.causes import LEAST_GAIN
from kalmark.diagnosis.effect import LIKELY
from kalmark.diagnosis.gross_mistakes import WINDOW
from kalmark.diagnosis.mistakes import Mistake, Where, change_measurements, with_value
from kalmark.diagnosis.trials import (
    FITS,
    MISFIT,
    MOST,
    RACED,
    Fit,
    Trials,
    first_events,
    first_of,
    fit_of_run,
    likelihood_gain,
    log_from,
)
from kalmark.events import Event
from kalmark.geometry.gaussian import quantile
from kalmark.logs.log import Log
from kalmark.logs.progress import track
from kalmark.models.protocols import POSE
from kalmark.models.state_sensors import StateSensor
from kalmark.results.figure_texts import figure
from kalmark.results.history import Ints
from kalmark.results.run import Run
from kalmark.results.self_calibration import mount_figures
from kalmark.results.warnings import CHANCE, NOTICES

SCANS = 800  # of the log are filtered again
READINGS = "sensors of the state"
MOST_CAUSES = 3
CHANGES = 10  # of a sensor, or so
ROUNDS, SAME = 3, 0.1  # in which a noise is found, and the share by which the last may change it
WIDER = 2.0  # times larger is a sigma of a constant than the one that is stated, else it is tried already
SIGMA_SCALE, MOST_SCALE = "sigma_scale", 0.5  # its key, and its sigma where the scale is sought
SCALES = (0.5, 0.7, 0.85, 1.2, 1.4, 2.0)  # of a sensor that has no scale in the map
RATES = ("w_radps", "wx_radps")
SIGMA, SIGN, SCALE, CONSTANT, ARM = "reading_sigma", "reading_sign", "reading_scale", "reading_offset", "mount_position"
SWAPPED = "swapped_columns"
NAMES = (SIGMA, SIGN, SCALE, CONSTANT, ARM, SWAPPED)


Told = Callable[["FilteredRun"], tuple[str, str]]


class FilteredRun(NamedTuple):
    """A run, and the fit of its observations."""

    run: Run
    fit: Fit

    def of(self, where: Where) -> Ints:
        """Return the rows of a sensor that were judged."""
        h = self.run.history
        return np.flatnonzero(h.made_by(*where) & np.isfinite(h.d2))

    def sensors(self) -> list[Where]:
        """Return the sensors of the state that made readings which were judged."""
        h = self.run.history
        return sorted({*compress(h.sensor_keys(), h.of_own & np.isfinite(h.d2))})

    def tried(self) -> list[Where]:
        """Return the configured sensors, without detectors of rest."""
        robots = self.run.final_slam().robots
        built_in = (of for of in self.sensors() if isinstance(robots[of[0]].sensors[of[1]].sensor, StateSensor))
        return [of for of in built_in if self.run.section(*of).get("type") != NOTICES]

    def mean(self, where: Where) -> float:
        """Return d2 per degree of freedom of the readings of a sensor."""
        mine = self.of(where)
        dof = self.fit.dof[mine]
        return float(np.minimum(self.run.history.d2[mine], MOST * dof).sum() / max(dof.sum(), 1))

    def off(self) -> list[Where]:
        """Return the sensors of the state whose readings do not fit: that is no chance."""
        dof = {where: int(self.fit.dof[self.of(where)].sum()) for where in self.sensors()}
        return [of for of, m in dof.items() if self.mean(of) > max(MISFIT, float(quantile(1.0 - CHANCE, m)) / m)]

    def parts_off(self) -> list[int]:
        """Return the rows where parts of the readings of sensors begin that do not fit, which chance seldom explains.

        The part is that of the largest sum of d2 less `MISFIT` (Page 1954).  It is 0 where that is at first: a constant
        that the map takes up shows in the first readings alone.
        """
        found = []
        for mine in map(self.of, self.sensors()):
            dof = self.fit.dof[mine]
            d2 = np.minimum(self.run.history.d2[mine], MOST * dof)
            total = np.append(0.0, np.cumsum(d2 - MISFIT * dof))
            end = int(np.argmax(total - np.minimum.accumulate(total)))
            begin = int(np.argmin(total[: end + 1]))
            part = slice(begin, end)
            if chdtrc(max(dof[part].sum(), 1), d2[part].sum()) * len(mine) ** (1 + (begin > 0)) < LIKELY:
                found.append(int(mine[begin]) * (begin >= WINDOW))
        return found


def filtered_with(trials: Trials, config: Configuration, log: Log, events: list[Event]) -> FilteredRun | None:
    """Return the fit of events under a configuration, None if they are refused."""
    run = trials.filter(config, log, events, shown=False)
    return None if run is None else fit_of_readings(run)


def fit_of_readings(run: Run) -> FilteredRun:
    """Return the fit of the observations of a run."""
    return FilteredRun(run, fit_of_run(run))


class _Sensor:
    """A sensor of the state, and the trials with it: events under a configuration, filtered as they are."""

    def __init__(
        self, engine: Trials, as_it_is: FilteredRun, config: Configuration, log: Log, events: list[Event], of: Where
    ) -> None:
        self.engine, self.as_it_is, self.config, self.log, self.events = engine, as_it_is, config, log, events
        self.where = of
        run = as_it_is.run
        self.sensor: Any = run.final_slam().robots[of[0]].sensors[of[1]].sensor
        self.space = run.history.in_space
        self.path = ("robots", robot_section(config, of[0]), "sensors", of[1])
        self.size = float(np.sqrt(np.nanmax(np.mean(run.history.z[as_it_is.of(of)] ** 2, axis=0))))

    def trials(self) -> Iterator[Mistake | None]:
        """Yield of each what it was, None where the log is not likelier without it, or its readings do not fit."""
        yield self.noise()
        yield from self.constants()
        yield from self.signs()
        yield self.scale()

    def cured(self, name: str, value: float) -> str:
        return f"--set robots.{self.where[0]}.sensors.{self.where[1]}.{name}={figure(value)}"

    def trial(
        self, name: str, config: Configuration, told: Told, by: Array | None = None,
        change: Callable[[Array], Array] | None = None,
    ) -> Mistake | None:  # fmt: skip
        """Return a mistake with its gain, None where the log does not fit without it."""
        if by is not None:
            change = partial(np.multiply, by)
        turned = None if change is None else change_measurements({self.where}, change)
        events = self.events if turned is None else [turned(e) for e in self.events]
        scaled = by is not None and bool((np.abs(by) != 1.0).any())
        after = filtered_with(self.engine, config, self.log, events)
        if after is None:
            return None
        gain = self.gain(after, scaled)
        return Mistake(name, *told(after), config, turned, gain) if gain > LEAST_GAIN else None

    def gain(self, after: FilteredRun, scaled: bool = False) -> float:
        """Return by how much likelier the log is in a second run; nothing where the readings do not fit in it.

        Readings that are scaled do not count themselves: the filter takes the noise of a control for its own, so that
        their likelihood does not depend on their size.
        """
        if after.mean(self.where) > FITS:
            return -math.inf
        but = self.as_it_is.of(self.where) if scaled else None
        return likelihood_gain(self.as_it_is.fit, after.fit, but)

    # ------------------------------------------------------------------ each kind
    def noise(self) -> Mistake | None:
        """Return a trial with more noise than stated: by the factor at which the innovations fit their covariance."""
        keys = [
            k for k in dict.fromkeys(self.sensor.sigmas) if isinstance(value_at(self.config, (*self.path, k)), float)
        ]
        if not keys:
            return None
        now, times, config = self.as_it_is, 1.0, self.config
        for _ in range(ROUNDS):
            mine = now.of(self.where)
            m = int(now.fit.dof[mine].max(initial=1))
            middle = float(np.median(now.run.history.d2[mine])) / float(chdtri(m, 0.5))
            step = math.sqrt(max(middle if times == 1.0 else now.mean(self.where), 1e-6))
            times *= step
            config = self.config
            for k in keys:
                config = with_value(config, (*self.path, k), value_at(self.config, (*self.path, k)) * times)
            found = filtered_with(self.engine, config, self.log, self.events)
            if found is None:
                return None
            now = found
            if abs(step - 1.0) < SAME:
                break
        what = f"readings of {'.'.join(self.where)} fit if their noise is {figure(times, 2)} times as large as stated"
        cure = " ".join(self.cured(k, value_at(config, (*self.path, k))) for k in keys)
        gain = self.gain(now)
        return Mistake(SIGMA, what, cure, config, gain=gain) if gain > LEAST_GAIN else None

    def constants(self) -> Iterator[Mistake | None]:
        """Yield that a constant of it is not as stated, or its mount: each as the filter finds it."""
        constants = [*self.sensor.constants]
        if value_at(self.config, (*self.path, SIGMA_SCALE)) is not None:
            constants.append(("scale", SIGMA_SCALE, ""))
        for key in dict.fromkeys(key for _, key, _ in constants if key):
            names = [name for name, of, _ in constants if of == key]
            sigma = {"scale": MOST_SCALE, "declination_rad": math.pi}.get(names[0], WIDER * self.size)
            if float(value_at(self.config, (*self.path, key)) or 0.0) * WIDER < sigma:
                yield self.in_map(SCALE if names == ["scale"] else CONSTANT, (key,), sigma, names)
        if self.sensor.views == POSE and self.sensor.columns[0] == "x_m":
            key = "sigma_position_m" if self.space else "sigma_xy_m"
            names = ["x_m", "y_m", "z_m"] if self.space else ["x_m", "y_m"]
            sigma = WIDER * self.size
            if float(np.max(value_at(self.config, (*self.path, "mount", key)) or 0.0)) * WIDER < sigma:
                yield self.in_map(ARM, ("mount", key), sigma, names)

    def in_map(
        self, name: str, key: tuple[str, ...], sigma: float, names: list[str], by: Array | None = None,
        also: tuple[str, str] = ("", ""),
    ) -> Mistake | None:  # fmt: skip
        """Return that numbers of a sensor are not as stated, which are put into the map with a sigma."""
        config, path = with_value(self.config, (*self.path, *key), sigma), key[:-1]

        def told(after: FilteredRun) -> tuple[str, str]:
            found = {m.name: mount_figures(m) for m in after.run.history.mounts}[".".join(self.where)]
            old = [float(value_at(self.config, (*self.path, *path, n)) or (n == "scale")) for n in names]
            values = [
                f"{n} {figure(found[n])} ± {figure(found[f'sigma_{n}'], 2)} instead of {figure(o)}"
                for n, o in zip(names, old, strict=True)
            ]
            cures = [self.cured(".".join((*path, n)), found[n]) for n in names]
            what = f"readings of {'.'.join(self.where)} fit with {also[0]}{', '.join(values)}"
            return what, " ".join([*([also[1]] if also[1] else []), *cures])

        return self.trial(name, config, told, by)

    def signs(self) -> Iterator[Mistake | None]:
        """Yield that columns of it have the wrong sign, or that the first two are exchanged."""
        columns, of = tuple(self.sensor.columns), ".".join(self.where)
        for names in dict.fromkeys([*((c,) for c in columns), columns]):
            by = np.array([-1.0 if c in names else 1.0 for c in columns])
            what = f"the sign of {', '.join(names)} changed"
            cure = " ".join(log_correction_line(self.config, "factors", (*self.where, c), -1.0) for c in names)
            if columns == ("heading_rad",):  # clockwise headings count from another direction, too
                key = ("sigma_declination_rad",)
                yield self.in_map(SIGN, key, math.pi, ["declination_rad"], by, (f"{what}, and ", cure))
            else:
                told = f"readings of {of} fit with {what}", cure
                yield self.trial(SIGN, self.config, partial(lambda told, _: told, told), by)
        if columns[:2] == ("x_m", "y_m"):
            order, exchanged = [1, 0, *range(2, len(columns))], f"readings of {of} fit with x_m and y_m exchanged"
            both = exchanged, "exchange the columns x_m and y_m"
            yield self.trial(SWAPPED, self.config, lambda _: both, None, lambda y: y[:, order])

    def scale(self) -> Mistake | None:
        """Return that rates are so many times too large, of a sensor that has no scale: the likeliest of `SCALES`."""
        if self.sensor.columns[0] not in RATES:
            return None

        def tried(by: float) -> Mistake | None:
            what = f"readings of {'.'.join(self.where)} fit if they are multiplied by {figure(by)}"
            cure = " ".join(
                log_correction_line(self.config, "factors", (*self.where, c), by) for c in self.sensor.columns
            )
            factors = np.full(len(self.sensor.columns), by)
            return self.trial(SCALE, self.config, lambda _: (what, cure), factors)

        best: tuple[float, Mistake] | None = None
        step: tuple[float, ...] = SCALES
        for n in range(3):
            some = [(f, m) for f in step if (m := tried(f)) is not None]
            best = max([*some, *([best] if best else [])], key=lambda one: one[1].gain, default=None)
            if best is None:
                return None
            near = 1.0 + 0.2 * 0.5**n
            step = (best[0] / near, best[0] * near)
        return best[1] if best else None


def reasons(run: Run, log: Log, engine: Trials) -> tuple[list[Mistake], FilteredRun | None]:
    """Return the faults of sensors of the state in a run that does not fit, and the fit of the log without them.

    Whatever sensor does not fit, all of them are tried: one that is wrong bends the path that the others see.  Where
    readings fit at first the log is filtered from the first one on that does not.
    """
    if not run.config.get("robots") or run.stopped:
        return [], None
    as_it_is, found = fit_of_readings(run), list[Mistake]()
    number, row = CHANGES * len(as_it_is.tried()), min(as_it_is.parts_off(), default=0)
    config, part = log_from(run, log, row) if row else (dict(run.config), log)
    since_s = run.history.at_s(run.history.step[row])
    events = first_events(run, part, SCANS)
    events = engine.payable(READINGS, run, events, number, number, share=RACED)
    now = filtered_with(engine, config, log, events) if events else None
    further = f"further causes in {READINGS}", number * engine.work_of(events)
    while now is not None and len(found) < MOST_CAUSES and (not found or (now.off() and engine.pays(*further))):
        tried = chain.from_iterable(_Sensor(engine, now, config, log, events, of).trials() for of in now.tried())
        trials = track(tried, "sensors of the state, tried", show=engine.progress)
        first = first_of(sorted(filter(None, trials), key=lambda m: -m.gain))
        if first is None:
            break
        found.append(first._replace(since_s=since_s))
        config, events = dict(first.config), [*map(first.change, events)] if first.change else events
        now = filtered_with(engine, config, log, events)
    if row:  # then no key takes it out
        found = [one._replace(evidence=f"from t={since_s:.1f} s on {one.evidence}", cure="") for one in found]
    return found, now
