"""Soft association: a scan corrects the map by the mean over all matchings, each weighted by its likelihood.  [F]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association.protocol import Decision, Mixture
from kalmark.errors import EventError
from kalmark.events import Id, Scan, label_of_event
from kalmark.filter.estimators import Averaging, Estimator, Update
from kalmark.filter.map import Map
from kalmark.report import Observation
from kalmark.tracks.scan import ScanContext

MOST = 20  # matchings
WORTH = 1e-3  # of the likeliest one's weight


def refuse_averaging(map_: Map, estimator: Estimator, event: Scan) -> None:
    """Refuse, before anything has changed, a scan whose matchings the map or the estimator cannot average over."""
    if not map_.averages:
        raise EventError(f"{label_of_event(event)}: averaging over matchings needs `map: dense`, this one is postponed")
    if not isinstance(estimator, Averaging):
        what = type(estimator).__name__
        raise EventError(
            f"{label_of_event(event)}: averaging over matchings needs an estimator with `average`, {what} has none"
        )


class Average(NamedTuple):
    """The mean over N matchings of the observations `rows` with the landmarks `names`.

    `pairs` (N, K) are numbers of `names`, -1 for none, of the weights (N,); `update` has all names and observations.
    """

    rows: Index
    names: list[Id]
    pairs: Index
    weights: Array
    update: Update


def average(scan: ScanContext, decisions: Sequence[Decision]) -> Average | None:
    """Return the likely matchings among the decisions, None if there are none or all are of nothing in the map."""
    mixture = next((decision for decision, _ in decisions if isinstance(decision, Mixture)), None)
    if mixture is None:
        return None
    pairs, weights = mixture.pairs[:MOST], mixture.weights[:MOST]
    likely = weights >= WORTH * weights[0]
    pairs, weights = pairs[likely], weights[likely] / weights[likely].sum()
    columns = np.unique(pairs[pairs >= 0])
    names = [mixture.names[c] for c in columns.tolist()]
    if not names:
        return None
    slots, model = scan.tracks.slots_of(names), scan.channel.models[scan.tracks.sorts[names[0]]]
    numbers = np.where(pairs >= 0, np.searchsorted(columns, pairs), -1)
    likeliest = np.maximum(numbers[np.argmax(numbers >= 0, axis=0), np.arange(len(mixture.rows))], 0)
    R = np.ascontiguousarray(scan.noise(model, slots[likeliest], mixture.rows))
    y = scan.y[mixture.rows]
    update = Update(model.model, scan.robot, scan.channel.second(scan.robot), slots, model.d, y, R)
    return Average(mixture.rows, names, numbers, weights, update)


def outcomes(found: Average, decisions: Sequence[Decision], d2: Array) -> list[Observation]:
    """Return what became of the observations that were averaged over, the likeliest landmark first; d2 is (K,)."""
    observations = []
    for i, k in enumerate(found.rows.tolist()):
        if not isinstance(decisions[k][0], Mixture):
            continue  # it is rather of something else
        of = found.pairs[:, i]
        shares = {found.names[c]: float(found.weights[of == c].sum()) for c in set(of.tolist()) if c >= 0}
        likely = sorted(shares.items(), key=lambda share: -share[1])
        own = None if np.isnan(d2[i]) else float(d2[i])
        why = "averaged: " + ", ".join(f"{name!r} {share:.2f}" for name, share in likely)
        reason = why if len(likely) > 1 else ""
        observations.append(Observation(k, None, "associated", likely[0][0], own, reason, tuple(likely)))
    return observations
