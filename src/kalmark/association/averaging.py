"""Soft association: a scan corrects the map by the mean over all matchings, each weighted by how likely it is.  [F]."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.association.protocol import Decision, Mixture
from kalmark.errors import EventError
from kalmark.events import Scan, when
from kalmark.filter.estimators import Map
from kalmark.filter.map import StochasticMap
from kalmark.report import Observation

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]

MOST = 20  # matchings
WORTH = 1e-3  # of the likeliest one's weight


def refuse_postponed(map_: Map, event: Scan) -> None:
    """Refuse, before anything has changed, to average over the matchings of a scan of a postponed map."""
    if not isinstance(map_, StochasticMap):
        raise EventError(f"{when(event)}: averaging over matchings needs `map: dense`, this one is postponed")


def average(slam: Slam, event: Scan, view: View, decisions: Sequence[Decision], R: Array) -> Iterator[Observation]:
    """Correct by the matchings among the decisions; return what became of observations likely to be in the map."""
    mixture = next((decision for decision, _ in decisions if isinstance(decision, Mixture)), None)
    if mixture is None:
        return
    rows, pairs, weights = mixture.rows, mixture.pairs[:MOST], mixture.weights[:MOST]
    worth = weights >= WORTH * weights[0]
    pairs, weights = pairs[worth], weights[worth] / weights[worth].sum()
    columns = np.unique(pairs[pairs >= 0])
    names = [mixture.names[c] for c in columns.tolist()]
    if not names:
        return
    slots, robot = slam.members.slots_of(names), slam.members.slots[event.robot]
    assert isinstance(slam.map, StochasticMap)  # `refuse_postponed` saw to it
    look = view.looks[slam.members.sorts[names[0]]]
    numbers = np.where(pairs >= 0, np.searchsorted(columns, pairs), -1)
    likeliest = np.maximum(numbers[np.argmax(numbers >= 0, axis=0), np.arange(len(rows))], 0)
    noise = view.noise(slam.map, robot, look, slots[likeliest], R[rows], event)
    scan = (slots, look.d, event.y[rows], np.ascontiguousarray(noise))
    d2, healthy = slam.estimator.average(slam.map, look.view, robot, view.mount, *scan, numbers, weights)
    slam.refuse_sick(healthy, event)
    for i, k in enumerate(rows.tolist()):
        if not isinstance(decisions[k][0], Mixture):
            continue  # it is rather of something else
        shares = {names[c]: float(weights[numbers[:, i] == c].sum()) for c in set(numbers[:, i].tolist()) if c >= 0}
        likely = sorted(shares.items(), key=lambda share: -share[1])
        slam.members.count([likely[0][0]])
        own = None if np.isnan(d2[i]) else float(d2[i])
        why = "averaged: " + ", ".join(f"{name!r} {share:.2f}" for name, share in likely)
        yield Observation(k, None, "associated", likely[0][0], own, why if len(likely) > 1 else "", tuple(likely))
