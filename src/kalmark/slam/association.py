"""Which landmark was that?  By the identity the log gives, or by what fits: each for itself, together, or jointly.

An association answers for each observation of a scan with a landmark's id, `NEW`, or None (leave it alone), and why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from kalmark.errors import ModelError
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.slam.events import Id
from kalmark.slam.joint import best_matching

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

FORBIDDEN = 1e6  # times the gate: a pair outside

Gate = float | str


class New:
    """The answer for an observation of something that is not in the map yet."""


NEW = New()
Decision = tuple[Id | New | None, str]


class Query(Protocol):
    """What an association may ask about a scan."""

    ids: tuple[Id | None, ...]

    def candidates(self, nearest: int = 4, farther: float = 10.0) -> list[Id]:
        """Return the landmarks this sensor could have seen: of each place the nearest ones, none so much farther."""

    def distances(self, candidates: list[Id]) -> Array:
        """Return the squared Mahalanobis distances (K, L) of the observations from the candidates."""

    def jointly(self, rows: Index, names: list[Id]) -> tuple[Array, Array]:
        """Return the innovations z (M, p) of pairs of an observation and a landmark, and their Z (M p, M p)."""

    def dof(self) -> int:
        """Return the size m of one measurement."""


class Association(Protocol):
    """Decides which landmark each observation of a scan belongs to."""

    def threshold(self, m: int, default: float) -> float:
        """Return the squared Mahalanobis distance up to which a pair is fused."""

    def associate(self, query: Query) -> list[Decision]:
        """Return a landmark's id, NEW or None for each observation, and the reason."""


def _checked(gate: Gate, where: str) -> None:
    if gate in ("default", "off") or (isinstance(gate, int | float) and 0 < gate < 1):
        return
    raise ModelError(f"{where}: gate is {gate!r}, expected a probability between 0 and 1, 'off' or 'default'")


def _threshold(gate: Gate, m: int, default: float) -> float:
    if gate == "default":
        return default
    return math.inf if gate == "off" else chi2_gate(float(gate), m)


@dataclass(frozen=True)
class ByIdentity:
    """Trust the ids of the log; an id that is not in the map yet is a new landmark.

    `gate` is the probability with which a right pair is let through; "off" fuses all; "default" is the estimator's own:
    the guide's 3 sigma for `Ekf`, off for the others.
    """

    gate: Gate = "default"

    def __post_init__(self) -> None:
        _checked(self.gate, "ByIdentity")

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        return _threshold(self.gate, m, default)

    def associate(self, query: Query) -> list[Decision]:
        """Answer with the ids as they are; the slam knows which are new."""
        return [(i, "") if i is not None else (None, "no id in the log") for i in query.ids]


@dataclass(frozen=True)
class _Gated:
    """Pairs of observations and landmarks inside an individual gate; ids are used where given.

    Beyond `new_gate` from every landmark an observation is a new one; what is nearer than that and stays without a pair
    is left alone.
    """

    gate: float = 0.99
    new_gate: float = 0.99999

    nearest: ClassVar[int] = 4  # candidates for an observation,
    farther: ClassVar[float] = 10.0  # none so many times as far as the nearest

    def __post_init__(self) -> None:
        for name in ("gate", "new_gate"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise ModelError(f"{type(self).__name__}: {name} is {value!r}, expected a probability between 0 and 1")

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        return chi2_gate(self.gate, m)

    def associate(self, query: Query) -> list[Decision]:
        """Answer with the ids where there are, with the pairs of `match` elsewhere."""
        answers: list[Decision] = [(i, "") if i is not None else (NEW, "no landmark near") for i in query.ids]
        open_ = np.array([k for k, i in enumerate(query.ids) if i is None], dtype=np.int64)
        named = {i for i in query.ids if i is not None}
        names = [c for c in query.candidates(self.nearest, self.farther) if c not in named] if len(open_) else []
        if not names:
            return answers
        d2 = query.distances(names)[open_]
        d2[np.isnan(d2)] = np.inf
        gate, far = chi2_gate(self.gate, query.dof()), chi2_gate(self.new_gate, query.dof())
        pairs, reasons = self.match(query, open_, names, d2, gate)
        for row, k in enumerate(open_.tolist()):
            least = int(np.argmin(d2[row]))
            if pairs[row] >= 0:
                answers[k] = (names[pairs[row]], "")
            elif d2[row, least] <= gate:
                answers[k] = (None, reasons.get(row, f"its nearest landmark {names[least]!r} is another observation's"))
            elif d2[row, least] <= far:
                answers[k] = (None, f"between {names[least]!r} and a new landmark: d2 {d2[row, least]:.1f}")
        return answers

    def match(
        self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float
    ) -> tuple[Index, dict[int, str]]:
        """Return the number of the name paired with each row of d2 (K, L), -1 for none, and why none where one fits."""
        raise NotImplementedError


@dataclass(frozen=True)
class NearestNeighbour(_Gated):
    """Take the nearest landmark inside an individual gate, each at most once in a scan, the closest pair first."""

    def match(
        self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float
    ) -> tuple[Index, dict[int, str]]:
        """Pair greedily; an observation whose nearest landmark is taken gets none."""
        pairs, reasons, taken = np.full(len(d2), -1), {}, set()
        for row in np.argsort(d2.min(axis=1), kind="stable").tolist():
            column = int(np.argmin(d2[row]))
            if column in taken:
                reasons[row] = f"its nearest landmark {names[column]!r} is taken by a nearer observation"
            elif d2[row, column] <= gate:
                taken.add(column)
                pairs[row] = column
        return pairs, reasons


@dataclass(frozen=True)
class GlobalAssignment(_Gated):
    """Take the pairs whose squared distances add up to the least, one without a pair counting as the gate.

    Bipartite matching: an observation gives way to another if that makes the whole better.
    """

    def match(
        self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float
    ) -> tuple[Index, dict[int, str]]:
        """Pair by the linear assignment of the whole scan."""
        count = len(names)
        cost = np.full((len(d2), count + len(d2)), gate)
        cost[:, :count] = np.where(d2 <= gate, d2, FORBIDDEN * gate)
        columns = linear_sum_assignment(cost)[1]
        return np.where(columns < count, columns, -1), {}


@dataclass(frozen=True)
class JointCompatibility(_Gated):
    """Take the largest set of pairs that fit together: JCBB.  Neira and Tardos 2001.

    The error of the pose is common to all observations of a scan, and only a joint test knows.  At most `most_nodes` of
    the search are looked at; what is best by then is taken.
    """

    most_nodes: int = 20_000

    nearest: ClassVar[int] = 16
    farther: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most_nodes < 1:
            raise ModelError(f"JointCompatibility: most_nodes is {self.most_nodes}, expected at least 1")

    def match(
        self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float
    ) -> tuple[Index, dict[int, str]]:
        """Pair by branch and bound, the observations with the fewest candidates first."""
        order = np.argsort((d2 <= gate).sum(axis=1), kind="stable")
        fitting = [np.flatnonzero(d2[row] <= gate) for row in order]
        fitting = [columns[np.argsort(d2[row, columns])] for row, columns in zip(order, fitting, strict=True)]
        first, columns = np.cumsum([0, *(len(c) for c in fitting)]), np.concatenate(fitting)
        pairs = np.full(len(d2), -1)
        if not len(columns):
            return pairs, {}
        z, Z = query.jointly(np.repeat(open_[order], np.diff(first)), [names[c] for c in columns.tolist()])
        gates = np.array([0.0, *(chi2_gate(self.gate, z.shape[1] * (n + 1)) for n in range(len(d2)))])
        chosen, finished = best_matching(first, columns, z, Z, gates, self.most_nodes)
        pairs[order] = np.where(chosen >= 0, columns[chosen], -1)
        why = "it does not fit with the others" + ("" if finished else f", as far as {self.most_nodes} nodes tell")
        return pairs, dict.fromkeys(range(len(d2)), why)
