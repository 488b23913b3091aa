"""How likely each matching of a scan with landmarks is: what an association chooses from, draws from or averages over.

A matching of c pairs has the likelihood N(v; 0, Z) of its joint innovation, linearised where the scan itself would be,
times the density of what is not in the map for each observation that it leaves without a pair: that of the landmarks
near it.  What share of a scan is in the map has a prior Beta(1/2 + a, 1/2 + b): Jeffreys', rather all or nothing of it,
and the `experience` of a observations that lately were and b that were not.
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

Experience = tuple[float, float]

WELL_KNOWN = math.log(16.0)  # |Z| / |R| up to which the robot knows where a landmark is
SLACK = 1  # pairs that a matching may have less than the largest
KEEP = 200  # matchings to look at


class Posterior(NamedTuple):
    """Matchings (N, K), each the number of the landmark paired with each observation, -1 for none; their weights (N,).

    The likeliest comes first.  `chance` bounds how many matchings as good as that one are expected among things that
    stand anywhere; `elsewhere` is how many there are that have at most a pair less and are of another pose: in rows of
    landmarks, these tell what chance does.  `finished` tells whether the search was.
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

    def why(self, row: int, names: Sequence[object]) -> str:
        """Return what an observation may be, for a reason."""
        shares = {c: float(self.weights[self.pairs[:, row] == c].sum()) for c in self.pairs[:, row].tolist()}
        likely = sorted(shares.items(), key=lambda one: -one[1])[:3]
        said = ", ".join(f"{'none' if c < 0 else repr(names[c])} {share:.2f}" for c, share in likely)
        return f"ambiguous: {said}" + ("" if self.finished else ", and the search was not finished")


def expected_in_gate(d2: Array, gate: float, p: int) -> Array:
    """Return how many landmarks there are to each observation in a volume as large as its gate.  d2 is (K, L)."""
    known = np.isfinite(d2)
    reach = np.maximum(np.where(known, d2, 0.0).max(axis=1, initial=0.0), gate)
    return np.asarray(known.sum(axis=1) * (gate / reach) ** (p / 2))


def agreeing(
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
    together: Candidates, open_: Index, d2: Array, near: Flags, p: int, gate: float, most: int, experience: Experience
) -> Posterior:
    """Return what is known of the matchings of the observations `open_` with the landmarks.

    d2 (K, L) are the squared distances of all pairs, `near` those that may be; `gate` is the probability with which a
    right matching is let through.  At most so many trials are made.
    """
    found, finished = agreeing(together, open_, d2, near, gate, most)
    pairs = np.vstack([found, np.full((1, len(d2)), -1)])
    density = _log_density(together, open_, d2, near, p)
    scores = np.array([_score(together, open_, one, density, p, gate, experience) for one in pairs])
    best = int(np.argmax(scores))
    without = np.tile(pairs[best], (len(d2), 1))  # each of its pairs may be one by chance
    np.fill_diagonal(without, -1)
    without = without[pairs[best] >= 0]
    scores = np.concatenate([scores, [_score(together, open_, one, density, p, gate, experience) for one in without]])
    pairs = np.concatenate([pairs, without])
    likely = np.argsort(-scores, kind="stable")
    weights = np.exp(scores[likely] - scores[likely[0]])
    first = pairs[likely[0]]
    count = int((first >= 0).sum())
    ratio = scores[likely[0]] - _log_share(count, len(d2), experience)  # of likelihoods: has the mean 1 by chance
    chance = math.comb(len(d2), count) * math.exp(-ratio) if count else math.inf
    alike = ((found == first) & (found >= 0)).sum(axis=1)
    elsewhere = int(((alike < p) & ((found >= 0).sum(axis=1) >= count - 1)).sum())
    return Posterior(pairs[likely], weights / weights.sum(), chance, elsewhere, finished)


def _score(
    together: Candidates, open_: Index, pairs: Index, density: Array, p: int, gate: float, experience: Experience
) -> float:
    """Return the logarithm of how likely a matching (K,) is, up to a constant."""
    rows = np.flatnonzero(pairs >= 0)
    if not len(rows):
        return _log_share(0, len(pairs), experience)
    d2, log_det = together.fit(open_[rows], pairs[rows])
    if not d2 <= chi2_gate(gate, p * len(rows)):
        return -np.inf
    known = _log_share(len(rows), len(pairs), experience)
    return float(known - 0.5 * (d2 + log_det + len(rows) * p * np.log(2 * np.pi)) - density[rows].sum())


def _log_share(count: int, of: int, experience: Experience) -> float:
    """Return the logarithm of how likely it is that just these `count` of all are in the map, up to a constant."""
    a, b = experience
    return math.lgamma(count + a + 0.5) + math.lgamma(of - count + b + 0.5)


def added(together: Candidates, open_: Index, pairs: Index, row: int, columns: Index) -> float:
    """Return the least that a pair of the observation `row` adds to the d2 of a matching (K,)."""
    rows = np.flatnonzero(pairs >= 0)
    before = together.fit(open_[rows], pairs[rows])[0]
    rows = np.append(rows, row)
    free = columns[~np.isin(columns, pairs)]
    d2 = [together.fit(open_[rows], np.append(pairs[rows[:-1]], column))[0] for column in free.tolist()]
    return min(d2, default=np.inf) - before


def _log_density(together: Candidates, open_: Index, d2: Array, near: Flags, p: int) -> Array:
    """Return the logarithm of the density of landmarks about each observation, in its units."""
    from scipy.special import gammaln

    log_ball = 0.5 * p * np.log(np.pi) - gammaln(0.5 * p + 1)
    density = np.zeros(len(d2))
    for row in np.flatnonzero(near.any(axis=1)).tolist():
        _, log_det = together.fit(open_[row : row + 1], np.argmin(d2[row], keepdims=True))
        known = d2[row][np.isfinite(d2[row])]
        reach = max(known.max(), chi2_gate(0.99, p))
        density[row] = np.log(len(known)) - log_ball - 0.5 * p * np.log(reach) - 0.5 * log_det
    return density
