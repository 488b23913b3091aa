"""Associations decided again at the batch solution, for observations without ids in the log.

The filter decided each association by the data until then.  At the optimum every pose depends on the whole log: each
observation is compared again with the landmarks near it, landmarks that coincide are merged, repeated observations that
fit none become a landmark, and the optimum of these associations is found; until nothing changes.  This is iterated
conditional maximisation (Besag 1986) of the likelihood over associations and states: it never trades one hypothesis
against another, so it can end in another maximum than the best.  Derivation of the optimum: docs/batch.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from kalmark.arrays import Array, Flags
from kalmark.association.gated import assign
from kalmark.batch.batch_state import LANDMARKS, Ints
from kalmark.batch.data import BatchReplay
from kalmark.batch.solver import Batch, optimum
from kalmark.events import Id
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.models.observe import innovations_and_jacobians, inverse_expectation, view_of
from kalmark.models.protocols import FullSensor

GATE, NEW_GATE = 0.99, 0.99999  # as of the filter: an observation is of a landmark within one, of a new one beyond both
NEAREST = 4  # landmarks that an observation is compared with
SIGHTINGS = 5  # of a new landmark, in as many scans
ODDS = 100.0  # against chance, at which two landmarks are one
TOGETHER, WITHIN = 0.1, 0.5  # of a landmark's observations: in a scan with the other one, and within its gate
ROUNDS = 12
NEAR = 1e-2  # of the map's size, is a step at which a round ends; the last one ends at the optimum
FAR = 1e9  # d2 of what is no candidate


@dataclass(frozen=True, eq=False)
class Reassociated:
    """The optimum with its own associations: the `landmark` (O,) of each observation, None for none.

    `merged` maps a landmark to the one it was merged into, `new` are those that the filter did not have.  Not `settled`
    if the last of the `rounds` still changed something.
    """

    batch: Batch
    landmark: list[Id | None]
    merged: dict[Id, Id]
    new: list[Id]
    rounds: int
    settled: bool


def reassociate(replay: BatchReplay, may_change: Flags, numbers: Iterable[int] = range(1, ROUNDS + 1)) -> Reassociated:
    """Decide again which landmark the observations (O,) are of that `may_change`, beginning at those of the replay.

    Takes a round a number of `numbers` until nothing changes, each of O(observations log landmarks) beside the optimum.
    Raises KalmarkError as `optimum` does.
    """
    names, merged, new = list(replay.given.associations.landmark), dict[Id, Id](), list[Id]()
    problem = replay.problem()
    batch = optimum(problem, tolerance=NEAR)
    rounds, settled, iterations = 0, False, batch.iterations
    for _ in numbers:
        rounds += 1
        look = _Observations(replay, batch, may_change)
        decided = look.decided(names)
        places = look.unexplained(decided)
        for place, rows in places:
            new.append(f"batch {len(new) + 1}")
            look.landmarks[new[-1]] = place
            for row in rows:
                decided[row] = new[-1]
        same = dict(find_coincident(batch, decided, look, new))
        merged = {one: same.get(other, other) for one, other in merged.items()} | same
        decided = [same.get(name, name) if name is not None else None for name in decided]
        settled = decided == names
        if settled:
            break
        names = decided
        known = {name: (place, np.zeros((0, 0))) for name, place in look.landmarks.items()}
        replay = replay.reassociated(names, batch.poses, known)
        problem = replay.problem()
        batch = optimum(problem, tolerance=NEAR)
        iterations += batch.iterations
    batch = optimum(problem, batch.state)
    batch = replace(batch, iterations=iterations + batch.iterations)
    merged = {one: other for one, other in merged.items() if one not in new}
    new = [name for name in new if name in batch.ids]
    return Reassociated(batch, names, merged, new, rounds, settled)


class _Seen(NamedTuple):
    """Observations (K,): numbers, the landmarks near them (K, n), their d2 (K, n), places (K, .), covariances."""

    row: Ints
    near: Ints
    d2: Array
    place: Array
    covariance: Array


class _Observations:
    """The observations from the poses of a solution."""

    def __init__(self, replay: BatchReplay, batch: Batch, may_change: Flags) -> None:
        self.scan, self.ids = replay.given.associations.scan, batch.ids
        self.landmarks: dict[Id, Array] = dict(zip(batch.ids, batch.means, strict=True))
        self.seen = [
            seen for key in replay.observed if key[2] == LANDMARKS for seen in _seen(replay, batch, key, may_change)
        ]
        self.open = np.zeros(len(may_change), dtype=np.bool_)
        for seen in self.seen:
            self.open[seen.row] = True
        self.dof = replay.given.landmark.space.dof
        d2 = np.concatenate([np.zeros(0), *(seen.d2[:, 0] for seen in self.seen)])
        usual = chi2_gate(0.5, self.dof)
        # of those that fit a landmark at all: noise that is stated too small must not make new landmarks
        some = d2[d2 < chi2_gate(NEW_GATE, self.dof)]
        self.factor = max(1.0, float(np.median(some)) / usual) if len(some) else 1.0

    def decided(self, names: Sequence[Id | None]) -> list[Id | None]:
        """Return the landmark of each observation: of each scan the assignment of least sum of d2 within the gate.

        That is the nearest of each, but for scans in which two have the same or another observation holds it.
        """
        decided, gate = list(names), self.factor * chi2_gate(GATE, self.dof)
        held: dict[int, set[Id]] = {}
        for row in np.flatnonzero(~self.open).tolist():
            name = names[row]
            if name is not None:
                held.setdefault(int(self.scan[row]), set()).add(name)
        for seen in self.seen:
            scans, within, nearest = self.scan[seen.row], seen.d2[:, 0] <= gate, seen.near[:, 0]
            for row, k, near in zip(seen.row.tolist(), nearest.tolist(), within.tolist(), strict=True):
                decided[row] = self.ids[k] if near else None
            pairs, number = np.unique((scans * len(self.ids) + nearest)[within], return_counts=True)
            order = np.flatnonzero(np.isin(scans, [*held, *(pairs[number > 1] // len(self.ids)).tolist()]))
            order = order[np.argsort(scans[order], kind="stable")]
            ends = np.flatnonzero(np.diff(scans[order])) + 1
            for part in np.split(order, ends) if len(order) else ():
                near, taken = seen.near[part], held.get(int(self.scan[seen.row[part[0]]]), set())
                some = [k for k in np.unique(near).tolist() if self.ids[k] not in taken]
                d2 = np.full((len(part), len(some)), FAR)
                for column, k in enumerate(some):
                    here = near == k
                    d2[here.any(axis=1), column] = seen.d2[part][here]
                taken_by = assign(d2, gate) if some else np.full(len(part), -1)
                for row, pair in zip(seen.row[part].tolist(), taken_by.tolist(), strict=True):
                    decided[row] = self.ids[some[pair]] if pair >= 0 else None
        return decided

    def within(self, names: Sequence[Id | None], at: Mapping[Id, int]) -> Array:
        """Return how many observations of each landmark are within the gate of each other one, (m, m)."""
        gate = self.factor * chi2_gate(GATE, self.dof)
        total = np.zeros((len(self.ids),) * 2)
        for seen in self.seen:
            mine = np.array([at.get(names[row], -1) for row in seen.row.tolist()])
            one, column = np.nonzero((seen.d2 < gate) & (mine >= 0)[:, None])
            np.add.at(total, (mine[one], seen.near[one, column]), 1.0)
        return total

    def unexplained(self, decided: Sequence[Id | None]) -> list[tuple[Array, list[int]]]:
        """Return the places that observations of no landmark repeat, and which: far from all, in as many scans."""
        far, gate = self.factor * chi2_gate(NEW_GATE, self.dof), self.factor * chi2_gate(GATE, self.dof)
        found = []
        for seen in self.seen:
            free = np.array([decided[row] is None for row in seen.row.tolist()], dtype=np.bool_)
            mine = np.flatnonzero(free & (seen.d2[:, 0] > far))
            if len(mine) < SIGHTINGS:
                continue
            place, P = seen.place[mine], seen.covariance[mine]
            reach = math.sqrt(gate) * 2.0 * math.sqrt(float(np.quantile(np.trace(P, axis1=1, axis2=2), 0.9)))
            one, two = cKDTree(place).query_pairs(reach, output_type="ndarray").T
            z, Z = place[one] - place[two], P[one] + P[two]
            close = np.einsum("ki,ki->k", z, np.linalg.solve(Z, z[:, :, None])[:, :, 0]) < gate
            links = sp.coo_array((np.ones(int(close.sum())), (one[close], two[close])), shape=(len(mine),) * 2)
            part = connected_components(links, directed=False)[1]
            for k in np.flatnonzero(np.bincount(part) >= SIGHTINGS).tolist():
                of = mine[part == k]
                scans, first = np.unique(self.scan[seen.row[of]], return_index=True)
                if len(scans) >= SIGHTINGS:
                    W = np.linalg.inv(seen.covariance[of])
                    mean = np.linalg.solve(W.sum(axis=0), np.einsum("kij,kj->i", W, seen.place[of]))
                    found.append((mean, seen.row[of[first]].tolist()))
        return found


def _seen(replay: BatchReplay, batch: Batch, key: tuple[str, str, int], may_change: Flags) -> list[_Seen]:
    """Return the observations of one sensor that may change, if they determine places."""
    given, (robot, sensor, _) = replay.given, key
    mount = given.robots[robot].sensors[sensor]
    rows = [one for one in replay.observed[key] if may_change[one.row]]
    if not rows or not isinstance(mount.sensor, FullSensor) or not len(batch.ids):
        return []
    at, poses = np.array(mount.at, dtype=np.float64), batch.state.groups[0]
    node, y, R = (np.array([one[c] for one in rows]) for c in (0, 2, 3))
    order = np.argsort(node, kind="stable")
    node, y, R, row = node[order], y[order], R[order], np.array([one.row for one in rows])[order]
    place, L = [], []
    for part in np.split(np.arange(len(node)), np.flatnonzero(np.diff(node)) + 1):
        l, _, _, L_y, _ = inverse_expectation(poses[node[part[0]]], at, mount.sensor, given.landmark, y[part])
        place.append(l)
        L.append(L_y)
    places, L_y = np.concatenate(place), np.concatenate(L)
    d, number = batch.state.d, min(NEAREST, len(batch.ids))
    near = cKDTree(batch.means[:, :d]).query(places[:, :d], k=np.arange(1, number + 1))[1]
    view, d2 = view_of(mount.sensor, given.landmark, at), np.empty(near.shape)
    R_inverse = np.linalg.inv(R)
    for column in range(number):
        z, _ = innovations_and_jacobians(view, poses[node], batch.means[near[:, column]], y)
        d2[:, column] = np.nan_to_num(np.einsum("ki,kij,kj->k", z, R_inverse, z), nan=FAR)
    by = np.argsort(d2, axis=1)
    near, d2 = np.take_along_axis(near, by, axis=1), np.take_along_axis(d2, by, axis=1)
    return [_Seen(row, near, d2, places, L_y @ R @ L_y.swapaxes(1, 2))]


def find_coincident(
    batch: Batch, names: Sequence[Id | None], look: _Observations, new: Sequence[Id]
) -> list[tuple[Id, Id]]:
    """Return pairs of landmarks that are one; each landmark is in one pair at most.

    The first is the new one, or that of fewer observations.

    Two that are rarely seen in one scan are one if the observations of either are within the gate of the other: with
    each observation given to the nearer of both, their difference shows in its own sigmas, though there is none.  Or
    if their difference is within the gate, and likelier of one landmark than of two by chance.
    """
    ids, d = batch.ids, batch.state.d
    at = {name: k for k, name in enumerate(ids)}
    rows = [(int(look.scan[row]), at[name]) for row, name in enumerate(names) if name in at]
    if len(ids) < 2 or not rows:
        return []
    scans, which = (np.array(column) for column in zip(*rows, strict=True))
    seen = sp.csr_array((np.ones(len(rows)), (scans, which)), shape=(int(scans.max()) + 1, len(ids)))
    number = np.bincount(which, minlength=len(ids))
    together = (seen.T @ seen).toarray() > TOGETHER * np.minimum.outer(number, number)
    means, dof = batch.means[:, :d], batch.means.shape[1]
    one, two = np.triu_indices(len(ids), 1)
    apart = ~together[one, two] & (number[one] > 0) & (number[two] > 0)
    one, two = one[apart], two[apart]
    blocks = batch.joint.reshape(len(ids), dof, len(ids), dof)[:, :d, :, :d]

    def block(a: Ints, b: Ints) -> Array:
        return np.asarray(blocks[a, :, b, :])

    z = means[one] - means[two]
    Z = block(one, one) + block(two, two) - block(one, two) - block(two, one)
    free = np.linalg.eigvalsh(Z)[:, 0] > 0
    one, two, z, Z = one[free], two[free], z[free], Z[free]
    d2 = np.einsum("ki,ki->k", z, np.linalg.solve(Z, z[:, :, None])[:, :, 0])
    density = len(ids) / max(float(np.prod(np.ptp(means, axis=0))), 1e-12)
    ratio = -0.5 * (d2 + np.linalg.slogdet(2.0 * np.pi * Z)[1]) - math.log(density)
    ratio[d2 > chi2_gate(GATE, d)] = -np.inf
    share = look.within(names, at) / np.maximum(number, 1)[:, None]
    alike = np.maximum(share[one, two], share[two, one])
    ratio = np.where(alike > WITHIN, FAR * alike, ratio)
    pairs, used = [], set[int]()
    for k in np.argsort(-ratio, kind="stable").tolist():
        a, b = sorted((int(one[k]), int(two[k])), key=lambda i: (ids[i] not in new, int(number[i])))
        if ratio[k] < math.log(ODDS):
            break
        if not {a, b} & used:
            used |= {a, b}
            pairs.append((ids[a], ids[b]))
    return pairs
