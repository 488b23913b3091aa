"""The posterior of the matchings of a scan with landmarks: an association takes the best, draws, or averages over it.

A matching of c pairs has the likelihood N(v; 0, Z) of its joint innovation, linearised where the scan itself would be,
times the density of what is not in the map for each observation that it leaves without a pair: that of the landmarks
near it (`geometry/landmark_density.py`).  The shares of a scan that are of landmarks just seen, of other landmarks of
the map, and of no landmark have the prior Dirichlet(1/2 + a, 1/2, 1/2): Jeffreys' prior, which favours shares near 0
and 1, and a observations of landmarks just seen in the last scans, the `experience`.  The share of the other landmarks
among all that are not just seen has the prior Beta(1/2, 1/2) for every a.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.association.matchings import matchings
from kalmark.association.query import Candidates
from kalmark.geometry.gaussian import gate as chi2_gate

WELL_KNOWN = math.log(16.0)  # |Z| / |R| up to which the relative position of a landmark is well known
SLACK = 1  # pairs that a matching may have less than the largest
KEEP = 200  # matchings that are kept


class Posterior(NamedTuple):
    """Matchings (N, K), each the number of the landmark paired with each observation, -1 for none; their weights (N,).

    The likeliest comes first.  `chance` bounds how many matchings as good as that one are expected among things that
    stand anywhere; `elsewhere` is how many there are that have at most a pair less and are of another pose: in rows of
    landmarks, these show how many are expected by chance.  `finished`: whether the search was.
    """

    pairs: Index
    weights: Array
    chance: float
    elsewhere: int
    finished: bool

    def shares(self) -> Array:
        """Return of each observation's pair in the likeliest matching how likely it is (K,)."""
        return self.weights @ (self.pairs == self.pairs[0])

    def none(self) -> Array:
        """Return how likely each observation is of no landmark (K,)."""
        return self.weights @ (self.pairs < 0)

    def again(self, just: Flags) -> float:
        """Return how many observations are expected to be of landmarks `just` (K, L) seen."""
        return float(self.weights @ [_count_just_seen(one, just).sum() for one in self.pairs])

    def why(self, row: int, names: Sequence[object]) -> str:
        """Return what an observation may be, for a reason."""
        shares = {c: float(self.weights[self.pairs[:, row] == c].sum()) for c in self.pairs[:, row].tolist()}
        likely = sorted(shares.items(), key=lambda one: -one[1])[:3]
        shown = ", ".join(f"{'none' if c < 0 else repr(names[c])} {share:.2f}" for c, share in likely)
        return f"ambiguous: {shown}" + ("" if self.finished else ", and the search was not finished")


def expected_in_gate(d2: Array, gate: float, p: int) -> Array:
    """Return how many landmarks there are to each observation in a volume as large as its gate.  d2 is (K, L)."""
    known = np.isfinite(d2)
    reach = np.maximum(np.where(known, d2, 0.0).max(axis=1, initial=0.0), gate)
    return np.asarray(known.sum(axis=1) * (gate / reach) ** (p / 2))


def consistent_matchings(
    together: Candidates, open_: Index, d2: Array, near: Flags, gate: float, most: int
) -> tuple[Index, bool]:  # fmt: skip
    """Return the largest matchings (N, K) whose pairs agree with each other, and whether the search was finished."""
    order = np.argsort(near.sum(axis=1), kind="stable")
    candidates = [np.flatnonzero(near[row]) for row in order]
    candidates = [c[np.argsort(d2[row, c])] for row, c in zip(order, candidates, strict=True)]
    first, columns = np.cumsum([0, *(len(c) for c in candidates)]), np.concatenate(candidates)
    v, V, l, C = together.places()
    rows = open_[order]
    places = np.ascontiguousarray(v[rows]), np.ascontiguousarray(V[rows]), l, C
    found, finished = matchings(first, columns, places, chi2_gate(gate, 1), SLACK, most, KEEP)
    pairs = np.full((len(found), len(d2)), -1)
    pairs[:, order] = np.where(found >= 0, columns[found], -1) if len(columns) else -1
    return pairs, finished


def posterior(
    together: Candidates, open_: Index, d2: Array, near: Flags, just: Flags, p: int, gate: float, most: int,
    experience: float,
) -> Posterior:  # fmt: skip
    """Return the posterior of the matchings of the observations `open_` with the landmarks.

    d2 (K, L) are the squared distances of all pairs, `near` those that may be, `just` those of landmarks just seen;
    `gate` is the probability with which a right matching is let through.  At most so many trials are made.
    """
    found, finished = consistent_matchings(together, open_, d2, near, gate, most)
    pairs = np.vstack([found, np.full((1, len(d2)), -1)])
    density = together.log_density(open_)

    def likelihood(one: Index) -> float:
        return _log_likelihood(together, open_, one, density, p, gate)

    def share(one: Index) -> float:
        again, pairs = int(_count_just_seen(one, just).sum()), int((one >= 0).sum())
        return sum(math.lgamma(n + 0.5) for n in (again + experience, pairs - again, len(one) - pairs))

    scores = np.array([likelihood(one) + share(one) for one in pairs])
    best = int(np.argmax(scores))
    without = np.tile(pairs[best], (len(d2), 1))  # each of its pairs may be one by chance
    np.fill_diagonal(without, -1)
    without = without[pairs[best] >= 0]
    scores = np.concatenate([scores, [likelihood(one) + share(one) for one in without]])
    pairs = np.concatenate([pairs, without])
    likely = np.argsort(-scores, kind="stable")
    weights = np.exp(scores[likely] - scores[likely[0]])
    first = pairs[likely[0]]
    count = int((first >= 0).sum())
    again = _count_just_seen(first, just)
    others = count - int(again.sum())
    ratio = likelihood(first) - (likelihood(np.where(again, first, -1)) if others else 0.0)  # has the mean 1 by chance
    chance = math.comb(len(d2) - count + (others or count), others or count) * math.exp(-ratio) if count else math.inf
    alike = ((found == first) & (found >= 0)).sum(axis=1)
    elsewhere = int(((alike < p) & ((found >= 0).sum(axis=1) >= count - 1)).sum())
    return Posterior(pairs[likely], weights / weights.sum(), chance, elsewhere, finished)


def _count_just_seen(pairs: Index, just: Flags) -> Flags:
    """Return which observations a matching (K,) pairs with landmarks just seen, `just` (K, L)."""
    return np.asarray((pairs >= 0) & just[np.arange(len(pairs)), pairs])


def _log_likelihood(together: Candidates, open_: Index, pairs: Index, density: Array, p: int, gate: float) -> float:
    """Return the logarithm of how likely the observations are by a matching (K,), over that of no pair at all."""
    rows = np.flatnonzero(pairs >= 0)
    if not len(rows):
        return 0.0
    d2, log_det = together.fit(open_[rows], pairs[rows])
    if not d2 <= chi2_gate(gate, p * len(rows)):
        return -np.inf
    return float(-0.5 * (d2 + log_det + len(rows) * p * np.log(2 * np.pi)) - density[rows].sum())


def least_increase(together: Candidates, open_: Index, pairs: Index, row: int, columns: Index) -> float:
    """Return the least that a pair of the observation `row` adds to the d2 of a matching (K,)."""
    rows = np.flatnonzero(pairs >= 0)
    before = together.fit(open_[rows], pairs[rows])[0]
    rows = np.append(rows, row)
    free = columns[~np.isin(columns, pairs)]
    d2 = [together.fit(open_[rows], np.append(pairs[rows[:-1]], column))[0] for column in free.tolist()]
    return min(d2, default=np.inf) - before
