"""What an association may ask about a scan and what it may answer.

It answers for each observation with a landmark's id, `NEW`, `REMAP`, `DEFERRED`, a `Mixture` of landmarks, or None
(leave it alone), and why.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from kalmark.association.posterior import Posterior, Together
from kalmark.events import Id

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Answer(Enum):
    """What an association may answer instead of a landmark; the values stand in the place of a pair's number.

    NONE: leave the observation alone.  DEFERRED: it cannot be decided yet.  NEW: it is not in the map.  MIXTURE: it is
    averaged over several landmarks.  REMAP: the robot is lost; what it observes may be mapped again until it
    relocalises.
    """

    NONE = -1
    DEFERRED = -2
    NEW = -3
    MIXTURE = -4
    REMAP = -5


NEW, REMAP, DEFERRED = Answer.NEW, Answer.REMAP, Answer.DEFERRED


class Mixture:
    """The answer for observations that are averaged over: their numbers `rows` (K,), and the matchings of all of them.

    `pairs` (N, K) are numbers of `names`, -1 for none, of the weights (N,), the likeliest first.
    """

    def __init__(self, rows: Index, names: list[Id], found: Posterior) -> None:
        self.rows, self.names, self.pairs, self.weights = rows, names, found.pairs, found.weights


Decision = tuple[Id | Answer | Mixture | None, str]


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
    """The number of the landmark paired with each observation (K,), or the value of an `Answer`; some with reasons.

    `mixed` are the matchings to average over, `known` (K,) the probability that each observation is of a landmark of
    the map, nan where it is unknown; None: only the pairs are known.
    """

    pairs: Index
    reasons: dict[int, str]
    mixed: Posterior | None = None
    known: Array | None = None


@runtime_checkable
class Association(Protocol):
    """Decides which landmark each observation of a scan belongs to."""

    def threshold(self, m: int, default: float) -> float:
        """Return the squared Mahalanobis distance up to which a pair is fused."""

    def associate(self, query: Query) -> list[Decision]:
        """Return a landmark's id, an `Answer`, a `Mixture` or None for each observation, and the reason."""


@runtime_checkable
class WeighsMatchings(Protocol):
    """An association that may weigh matchings of the whole scan, and so says itself what is ambiguous."""

    @property
    def weighs(self) -> bool:
        """Whether it does."""


@runtime_checkable
class AveragesMatchings(Protocol):
    """An association that may answer with a `Mixture`; the estimator then has to be able to average."""

    @property
    def averages(self) -> bool:
        """Whether it does."""


@runtime_checkable
class GatesNew(Protocol):
    """An association with the probability with which an observation of a known landmark is not taken for a new one."""

    @property
    def new_gate(self) -> float:
        """The probability."""


def weighs(association: Association) -> bool:
    """Return whether an association weighs matchings; one that does not say so does not."""
    return isinstance(association, WeighsMatchings) and association.weighs


def averages(association: Association) -> bool:
    """Return whether an association averages over matchings; one that does not say so does not."""
    return isinstance(association, AveragesMatchings) and association.averages


def new_gate(association: Association) -> float:
    """Return the probability of the gate beyond which an observation is of a new landmark, by default 0.99999."""
    return association.new_gate if isinstance(association, GatesNew) else 0.99999
