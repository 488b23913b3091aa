"""Which landmark of a map is which of the true ones, where nothing but their positions can tell."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.events import Id
from kalmark.results.columns import Array
from kalmark.results.landmarks import MapLandmarks
from kalmark.results.recording import Recording
from kalmark.results.shapes import EUCLIDEAN, LINE

LEAST = 3  # matched pairs


def no_ids(run: Recording) -> bool:
    """Return whether a run's landmarks can be matched to the true ones by their positions alone."""
    history, true = run.history, {str(i) for i in run.truth.landmarks}
    told = (history.id != "") & ~np.isin(history.id, history.robots)
    return (
        not (told | (history.true_id != "")).any()
        and bool(true)
        and len(run.landmarks) > 0
        and true.isdisjoint(map(str, run.landmarks.ids))
    )


def by_position(landmarks: MapLandmarks, true: dict[Id, Array]) -> dict[Id, Id]:
    """Return the true landmark of each point of a map that has one: the nearest to each other, both in the map's frame.

    A pair counts if it is closer than half the way from the true landmark to the next true one: every error is below
    that by construction.  Nothing if less than half of the map has a pair: by chance, in another frame, a fifth has.
    """
    from scipy.spatial import cKDTree

    means = landmarks.positions()[0]
    d = means.shape[1]
    points = {i: l[:d] for i, l in true.items() if len(l) != LINE}
    mine = [k for k, kind in enumerate(landmarks.kinds) if kind in EUCLIDEAN and len(landmarks.means[k]) != LINE]
    if not mine or len(points) < 2:
        return {}
    names, there, here = [*points], np.array([*points.values()]), means[mine]
    known: Any = cKDTree(there)
    mapped: Any = cKDTree(here)
    free = known.query(there, k=2)[0][:, 1] / 2
    (gap, nearest), back = known.query(here), mapped.query(there)[1]
    pairs = {
        landmarks.ids[mine[k]]: names[i] for k, i in enumerate(nearest.tolist()) if back[i] == k and gap[k] < free[i]
    }
    return pairs if len(pairs) >= max(LEAST, len(landmarks) / 2) else {}
