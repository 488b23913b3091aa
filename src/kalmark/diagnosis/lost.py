"""Robots at the end of a run: those that nothing places, and those that are lost."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Flags
from kalmark.diagnosis.gross_mistakes import MUCH, WINDOW
from kalmark.diagnosis.trials import FITS, fit_of_run
from kalmark.results.checked import DOUBTFUL, UNCHECKED, Sign
from kalmark.results.control_gaps import KNOWN
from kalmark.results.figure_texts import figure
from kalmark.results.run import Run
from kalmark.slam.pose_hypothesis import LASTS_S
from kalmark.slam.relocation_by_fixes import NEEDED


class Lost(NamedTuple):
    """Of a robot a number of positions, all from a time on, s, and who measured them, were left out to the end."""

    robot: str
    since_s: float
    number: int
    of: str


def find_lost_robots(run: Run) -> Iterator[Lost]:
    """Yield the robots whose positions were all left out for the last half minute or more, without a landmark in it."""
    h = run.history
    t_ns = h.t_ns[h.step]
    for name in run.final_slam().state.robots:
        last_ns = located_ns(run, name)
        out = _positions(run, name) & (t_ns > last_ns)
        times = sorted([*t_ns[out].tolist(), *(f.t_ns for f in h.fixes if f.robot == name and f.t_ns > last_ns)])
        if len(times) >= NEEDED and (times[-1] - times[0]) * 1e-9 >= LASTS_S:
            sensors = ", ".join(np.unique(h.sensor[out]).tolist())
            yield Lost(name, times[0] * 1e-9, len(times), f"readings of {sensors}" if sensors else "fixes")


def located_ns(run: Run, name: str) -> float:
    """Return when a robot was last placed by a thing in the map, a reading or a fix, ns; -inf if it never was."""
    h = run.history
    placing = (h.observers == name) & (h.outcome == "associated") & (_positions(run, name) | ~h.of_own)
    times = [*h.t_ns[h.step[placing]].tolist(), *(fix.t_ns for fix in h.fixes if fix.robot == name and fix.used)]
    return max(times, default=-np.inf)


def _positions(run: Run, name: str) -> Flags:
    """Return which observations (O,) are readings of a robot's position."""
    h, readers = run.history, run.final_slam().state.readers
    placing = [key[1] for key, reader in readers.items() if key[0] == name and reader.is_position]
    return np.asarray((h.observers == name) & h.of_own & np.isin(h.sensor, placing))


def unchecked_ends(run: Run) -> Iterator[tuple[str, Sign]]:
    """Yield the robots of which the log does not check where they are at its end, and why.

    Dead reckoning does not matter while the position stays known to what it was, to a factor of `KNOWN`.
    """
    h, now, slam = run.history, fit_of_run(run).values, run.final_slam()
    for name in h.robots:
        steps = np.flatnonzero(h.robot == name)
        times = h.t_ns[steps].tolist()
        if (controls := h.controls.get(name)) is not None:
            times += [controls.first_ns, controls.last_ns]
        first, last, located = min(times, default=0), max(times, default=0), located_ns(run, name)
        blind_s, all_s = (last - max(located, first)) * 1e-9, (last - first) * 1e-9
        if not math.isfinite(located):
            yield name, Sign(f"nothing places {name}: its path is dead reckoning", UNCHECKED)
        elif blind_s >= min(LASTS_S, 0.5 * all_s) > 0.0:
            then = steps[max(int(np.searchsorted(h.t_ns[steps], located, side="right")) - 1, 0)]
            before, after = (float(np.trace(P[: h.d, : h.d])) for P in (h.covariance[then], slam.covariance(name)))
            if KNOWN**2 * after > before:
                what = f"nothing places {name} in its last {figure(blind_s)} s: they are dead reckoning"
                yield name, Sign(what, UNCHECKED)
        mine = np.flatnonzero((h.observers == name) & ~h.of_own)[-WINDOW:]
        if len(mine) == WINDOW and now[mine].mean() > MUCH * FITS:
            d2 = f"d2 per degree of freedom is {figure(float(now[mine].mean()), 2)}"
            yield (
                name,
                Sign(f"the last {WINDOW} observations of {name} do not fit: {d2}, where 1 is expected", DOUBTFUL),
            )
