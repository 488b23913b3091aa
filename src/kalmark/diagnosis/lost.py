"""Robots that are lost at the end of a run: nothing fits that says where they are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from kalmark.results.run import Run
from kalmark.slam.alternative import LASTS_S
from kalmark.slam.replacing import NEEDED


class Lost(NamedTuple):
    """Of a robot a number of positions, all from a time on, s, and who measured them, were left out to the end."""

    robot: str
    since_s: float
    number: int
    of: str


def lost(run: Run) -> Iterator[Lost]:
    """Yield the robots whose positions were all left out for the last half minute or more, without a landmark in it."""
    h, state = run.history, run.final_slam().state
    robots, t_ns, used = h.robot[h.step], h.t_ns[h.step], np.isin(h.outcome, ("associated", "new"))
    for name in state.robots:
        placing = [key[1] for key, reader in state.readers.items() if key[0] == name and reader.is_position]
        mine = (robots == name) & h.of_own & np.isin(h.sensor, placing)
        fixes = [fix for fix in h.fixes if fix.robot == name]
        located = [*t_ns[(robots == name) & used & (mine | ~h.of_own)], *(fix.t_ns for fix in fixes if fix.used)]
        last_ns = max(located, default=-np.inf)
        out = mine & (t_ns > last_ns)
        times = sorted([*t_ns[out].tolist(), *(fix.t_ns for fix in fixes if fix.t_ns > last_ns)])
        if len(times) >= NEEDED and (times[-1] - times[0]) * 1e-9 >= LASTS_S:
            sensors = ", ".join(np.unique(h.sensor[out]).tolist())
            yield Lost(name, times[0] * 1e-9, len(times), f"readings of {sensors}" if sensors else "fixes")
