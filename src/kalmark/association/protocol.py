"""The protocol of an association: its questions about a scan and its answers.

It answers for each observation with a landmark's id, `NEW`, `REMAP`, `DEFERRED`, a `Mixture` of landmarks, or None
(leave it alone), and why.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple, Protocol, runtime_checkable

from kalmark.arrays import Index
from kalmark.association.posterior import Posterior
from kalmark.association.query import Query
from kalmark.events import Id


class Answer(Enum):
    """Decisions of an association other than a landmark; the values stand in the place of a pair's number.

    NONE: leave the observation alone.  DEFERRED: it cannot be decided yet.  NEW: it is not in the map.  MIXTURE: it is
    averaged over several landmarks.  REMAP: the robot is lost; what it observes may be mapped again until it
    relocalises.

    >>> Answer.NEW
    <Answer.NEW: -3>
    >>> [one.name for one in Answer]
    ['NONE', 'DEFERRED', 'NEW', 'MIXTURE', 'REMAP']
    """

    NONE = -1
    DEFERRED = -2
    NEW = -3
    MIXTURE = -4
    REMAP = -5


NEW, REMAP, DEFERRED = Answer.NEW, Answer.REMAP, Answer.DEFERRED
"""An answer in the place of a landmark: see `Answer`."""


class Mixture:
    """The answer for observations that are averaged over: their numbers `rows` (K,), and the matchings of all of them.

    `pairs` (N, K) are numbers of `names`, -1 for none, of the weights (N,), the likeliest first.
    """

    def __init__(self, rows: Index, names: list[Id], found: Posterior) -> None:
        self.rows, self.names, self.pairs, self.weights = rows, names, found.pairs, found.weights


Decision = tuple[Id | Answer | Mixture | None, str]
"""Result of an association for an observation: its landmark, or an answer, or None; and the reason."""


class Matched(NamedTuple):
    """The number of the landmark paired with each observation (K,), or the value of an `Answer`; some with reasons.

    `mixed` are the matchings to average over.
    """

    pairs: Index
    reasons: dict[int, str]
    mixed: Posterior | None = None


@runtime_checkable
class Association(Protocol):
    """Decides which landmark each observation of a scan belongs to.

    >>> isinstance(km.association.Automatic(), Association)
    True
    """

    def threshold(self, m: int, default: float) -> float:
        """Return the squared Mahalanobis distance up to which a pair is fused."""

    def associate(self, query: Query) -> list[Decision]:
        """Return a landmark's id, an `Answer`, a `Mixture` or None for each observation, and the reason."""


@runtime_checkable
class _Weighs(Protocol):
    weighs: bool


@runtime_checkable
class _Averages(Protocol):
    averages: bool


@runtime_checkable
class _GatesNew(Protocol):
    new_gate: float


def weighs(association: Association) -> bool:
    """Return whether an association weighs whole matchings, and so decides itself what is ambiguous; by default not."""
    return isinstance(association, _Weighs) and association.weighs


def averages(association: Association) -> bool:
    """Return whether an association may answer with a `Mixture`, which the estimator has to average; by default not."""
    return isinstance(association, _Averages) and association.averages


def new_gate(association: Association) -> float:
    """Return the probability of the gate beyond which an observation is of a new landmark, by default 0.99999."""
    return association.new_gate if isinstance(association, _GatesNew) else 0.99999
