"""Soft association: a scan corrects the map by the mean over all matchings, each weighted by how likely it is.  [F]."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.errors import EventError
from kalmark.filter.map import StochasticMap
from kalmark.slam.decisions import Decision, Mixture
from kalmark.slam.events import Scan, when
from kalmark.slam.report import Observation

if TYPE_CHECKING:
    from kalmark.slam.scene import View
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]

MOST = 20  # matchings
WORTH = 1e-3  # of the likeliest one's weight


def average(slam: Slam, event: Scan, view: View, decisions: Sequence[Decision], R: Array) -> Iterator[Observation]:
    """Correct by the matchings among the decisions; return what became of observations likely to be in the map."""
    mixture = next((decision for decision, _ in decisions if isinstance(decision, Mixture)), None)
    if mixture is None:
        return
    if not isinstance(slam.map, StochasticMap):
        raise EventError(f"{when(event)}: averaging over matchings needs `map: dense`, this one is postponed")
    rows, pairs, weights = mixture.rows, mixture.pairs[:MOST], mixture.weights[:MOST]
    worth = weights >= WORTH * weights[0]
    pairs, weights = pairs[worth], weights[worth] / weights[worth].sum()
    columns = np.unique(pairs[pairs >= 0])
    names = [mixture.names[c] for c in columns.tolist()]
    if not names:
        return
    slots, robot = slam.members.slots_of(names), slam.members.slots[event.robot]
    look = view.looks[slam.members.sorts[names[0]]]
    y, noise = event.y[rows], view.noise(slam.map, robot, look, slots[:1].repeat(len(rows)), R[rows], event)
    numbers = np.where(pairs >= 0, np.searchsorted(columns, pairs), -1)
    scan = (slots, look.d, y, np.ascontiguousarray(noise))
    d2, healthy = slam.estimator.average(slam.map, look.view, robot, view.mount, *scan, numbers, weights)
    slam.refuse_sick(healthy, event)
    for i, k in enumerate(rows.tolist()):
        shares = {names[c]: float(weights[numbers[:, i] == c].sum()) for c in set(numbers[:, i].tolist()) if c >= 0}
        if not isinstance(decisions[k][0], Mixture):
            continue  # it is rather of something else
        likely = sorted(shares.items(), key=lambda share: -share[1])
        slam.members.count(likely[0][0])
        own = None if np.isnan(d2[i]) else float(d2[i])
        why = "averaged: " + ", ".join(f"{name!r} {share:.2f}" for name, share in likely)
        yield Observation(k, None, "associated", likely[0][0], own, why if len(likely) > 1 else "", tuple(likely))
