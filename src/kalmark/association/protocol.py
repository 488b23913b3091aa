"""What an association may ask about a scan and what it may answer.

It answers for each observation with a landmark's id, `NEW`, `ANEW`, `DEFERRED`, a `Mixture` of landmarks, or None
(leave it alone), and why.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from kalmark.association.posterior import Posterior, Together
from kalmark.events import Id

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

HELD_BACK, FRESH, MIXED, STRANGE = -2, -3, -4, -5  # in the place of a pair: DEFERRED, NEW, a Mixture, ANEW


class New:
    """The answer for an observation of something that is not in the map yet: `NEW`.

    `ANEW` is that of a robot that is lost, for what it has not just seen: in the map or not, it may be mapped anew.
    """


class Deferred:
    """The answer for an observation that cannot be told yet."""


class Mixture:
    """The answer for observations that are averaged over: their numbers `rows` (K,), and the matchings of all of them.

    `pairs` (N, K) are numbers of `names`, -1 for none, of the weights (N,), the likeliest first.
    """

    def __init__(self, rows: Index, names: list[Id], found: Posterior) -> None:
        self.rows, self.names, self.pairs, self.weights = rows, names, found.pairs, found.weights


NEW, ANEW, DEFERRED = New(), New(), Deferred()
Decision = tuple[Id | New | Deferred | Mixture | None, str]


class Query(Protocol):
    """What an association may ask about a scan."""

    ids: tuple[Id | None, ...]

    def candidates(self, nearest: int = 4, farther: float = 10.0) -> list[Id]:
        """Return the landmarks this sensor could have seen: of each place the nearest ones, none so much farther."""

    def distances(self, candidates: list[Id]) -> Array:
        """Return the squared Mahalanobis distances (K, L) of the observations from the candidates."""

    def jointly(self, rows: Index, names: list[Id]) -> tuple[Array, Array]:
        """Return the innovations z (M, p) of pairs of an observation and a landmark, and their Z (M p, M p)."""

    def together(self, names: list[Id]) -> Together | None:
        """Return landmarks to be asked about jointly, None where that cannot be."""

    def dof(self) -> int:
        """Return the size m of one measurement."""

    def experience(self) -> tuple[float, float]:
        """Return how many of the last observations without ids were of landmarks of the map, and how many were not."""

    def learn(self, known: float, unknown: float) -> None:
        """Remember how many observations without ids are likely of landmarks of the map, and how many are not."""

    def key(self) -> tuple[int, ...]:
        """Return numbers, at least 0, that tell this scan from all others."""


class Matched(NamedTuple):
    """The number of the landmark paired with each observation (K,), or -1 for none and its like; some with reasons.

    `mixed` are the matchings to average over for those that are MIXED, `known` (K,) how likely each observation is of a
    landmark of the map, nan where that cannot be said; None where only pairs tell.
    """

    pairs: Index
    reasons: dict[int, str]
    mixed: Posterior | None = None
    known: Array | None = None


class Association(Protocol):
    """Decides which landmark each observation of a scan belongs to."""

    def threshold(self, m: int, default: float) -> float:
        """Return the squared Mahalanobis distance up to which a pair is fused."""

    def associate(self, query: Query) -> list[Decision]:
        """Return a landmark's id, NEW or None for each observation, and the reason."""
