"""How far position fixes are from the estimate: their innovations over time, for the page of a report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.results.inputs import UsedFix
from kalmark.results.picture import Picture, stretches_of
from kalmark.results.thinned import significant, thin

if TYPE_CHECKING:
    from kalmark.results.run import Run


def fix_series(run: Run, picture: Picture) -> list[dict[str, Any]]:
    """Return each robot's innovations of fixes and their sigmas in m; times in seconds since the first step."""
    fixes, t_ns = run.history.inputs.fixes, run.history.t_ns
    begin = int(t_ns[0]) if len(t_ns) else 0
    out = []
    for robot in picture.paths:
        mine = [fix for fix in fixes if fix.robot == robot]
        if mine:
            out.append({"name": robot, "colour": picture.colour(robot), **_innovations(mine, begin)})
    return out


def _innovations(fixes: list[UsedFix], begin_ns: int) -> dict[str, Any]:
    """Return the curves of a robot's fixes, thinned, and those of them that were rejected, by themselves."""
    t_ns, used = np.array([fix.t_ns for fix in fixes]), np.array([fix.used for fix in fixes])
    t, z = (t_ns - begin_ns) * 1e-9, np.array([fix.z for fix in fixes])
    sigma = np.sqrt(np.maximum([np.diagonal(fix.Z) for fix in fixes], 0.0))
    rows, bad = thin(len(fixes)), np.flatnonzero(~used)
    bad = bad[thin(len(bad))]
    return {
        "t": significant(t[rows], 7),
        "z": [significant(column) for column in z[rows].T],
        "sigma": [significant(column) for column in sigma[rows].T],
        "gaps": (np.flatnonzero(np.diff(stretches_of(t_ns)[rows])) + 1).tolist(),
        "rejected": {"t": significant(t[bad], 7), "z": [significant(column) for column in z[bad].T]},
    }
