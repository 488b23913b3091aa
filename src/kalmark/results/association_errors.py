"""The rate of wrong associations, where the log has ids of landmarks that the filter did not get."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import Any

import numpy as np

from kalmark.events import Id
from kalmark.logs.log import LandmarkPlaces
from kalmark.results.figure_texts import Figures
from kalmark.results.history import History, as_id
from kalmark.results.landmark_table import EUCLIDEAN, MapLandmarks
from kalmark.results.recording import Recording

LEAST = 3  # matched pairs


def names_in_log(history: History) -> dict[str, str]:
    """Return the log's name of each landmark named by the filter: that of most observations fused with it."""
    seen: defaultdict[str, Counter[str]] = defaultdict(Counter)
    mine = history.fused & (history.true_id != "") & (history.id == "")
    for landmark, true in zip(history.landmark[mine].tolist(), history.true_id[mine].tolist(), strict=True):
        seen[landmark][true] += 1
    return {landmark: counts.most_common(1)[0][0] for landmark, counts in seen.items()}


def best_known(history: History, ids: list[Id], observations: list[int]) -> dict[Id, Id]:
    """Return the log's name of each landmark of a map that has one; of several of one name the most seen has it."""
    names = names_in_log(history)
    taken: dict[str, tuple[int, Id]] = {}
    for i, count in zip(ids, observations, strict=True):
        name = names.get(str(i))
        if name is not None and (name not in taken or count > taken[name][0]):
            taken[name] = count, i
    return {i: as_id(name) for name, (_, i) in taken.items()}


def association_figures(history: History, landmarks: list[Id]) -> Figures:
    """Return the figures of an association without ids, {} if the filter got all ids of the log.

    `wrong` counts the fused observations whose id is not that of most of their landmark, of `judged`; `duplicates` are
    the landmarks beyond one for each id; `nameless` observations have no id in the log either (spurious ones, where it
    marks them), and `nameless_fused` counts those of them that were fused all the same.
    """
    hidden = (history.id == "") & (history.true_id != "")
    if not hidden.any():
        return {}
    names, fused = names_in_log(history), history.fused
    judged = fused & hidden
    own = [names[landmark] for landmark in history.landmark[judged].tolist()]
    nameless = history.true_id == ""
    kept = [names[str(i)] for i in landmarks if str(i) in names]
    return {
        "wrong": int(np.sum(history.true_id[judged] != np.array(own, dtype=np.str_))),
        "judged": int(judged.sum()),
        "duplicates": len(kept) - len(set(kept)),
        "nameless": int(nameless.sum()),
        "nameless_fused": int((nameless & fused).sum()),
    }


def no_ids(run: Recording) -> bool:
    """Return whether a run's landmarks can be matched to the true ones by their positions alone."""
    history, true = run.history, {str(i) for i in run.truth.landmarks}
    given = (history.id != "") & ~np.isin(history.id, history.robots) & ~history.of_own
    return (
        not (given | (history.true_id != "")).any()
        and bool(true)
        and len(run.landmarks) > 0
        and true.isdisjoint(map(str, run.landmarks.ids))
    )


def by_position(landmarks: MapLandmarks, true: LandmarkPlaces) -> dict[Id, Id]:
    """Return the true landmark of each point of a map that has one: the nearest to each other, both in the map's frame.

    A pair counts if it is closer than half the way from the true landmark to the next true one: every error is below
    that by construction.  Nothing if less than half of the points have a pair: by chance, in another frame, a fifth.
    """
    from scipy.spatial import cKDTree

    means = landmarks.positions()[0]
    d = means.shape[1]
    points = {i: l[:d] for i, l in true.items() if len(l) != 2 * d}
    mine = [k for k, kind in enumerate(landmarks.kinds) if kind in EUCLIDEAN and len(landmarks.means[k]) != 2 * d]
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
    return pairs if len(pairs) >= max(LEAST, len(mine) / 2) else {}
