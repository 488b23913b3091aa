"""Which landmark was that?  By the identity the log gives, or by the nearest compatible neighbour.

An association answers for each observation of a scan with a landmark's id, `NEW`, or None (leave it alone), and why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.slam.events import Id

Array = npt.NDArray[np.float64]

Gate = float | str


class New:
    """The answer for an observation of something that is not in the map yet."""


NEW = New()
Decision = tuple[Id | New | None, str]


class Query(Protocol):
    """What an association may ask about a scan."""

    ids: tuple[Id | None, ...]

    def candidates(self) -> list[Id]:
        """Return the landmarks this sensor could have seen."""

    def distances(self, candidates: list[Id]) -> Array:
        """Return the squared Mahalanobis distances (K, L) of the observations from the candidates."""

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
class NearestNeighbour:
    """Take the nearest landmark inside an individual gate, each at most once in a scan; ids are used where given.

    Beyond `new_gate` from every landmark an observation is a new one; between the two it is left alone.
    """

    gate: float = 0.99
    new_gate: float = 0.99999

    def __post_init__(self) -> None:
        for name in ("gate", "new_gate"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise ModelError(f"NearestNeighbour: {name} is {value!r}, expected a probability between 0 and 1")

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        return chi2_gate(self.gate, m)

    def associate(self, query: Query) -> list[Decision]:
        """Pair greedily, the closest pair first."""
        answers: list[Decision] = [(i, "") if i is not None else (NEW, "no landmark near") for i in query.ids]
        open_ = [k for k, i in enumerate(query.ids) if i is None]
        named = {i for i in query.ids if i is not None}
        candidates = [c for c in query.candidates() if c not in named]
        if not open_ or not candidates:
            return answers
        d2 = query.distances(candidates)[open_]
        d2[np.isnan(d2)] = np.inf
        near, far = chi2_gate(self.gate, query.dof()), chi2_gate(self.new_gate, query.dof())
        taken: set[int] = set()
        for row in np.argsort(d2.min(axis=1), kind="stable"):
            column = int(np.argmin(d2[row]))
            nearest, name = float(d2[row, column]), candidates[column]
            if nearest > far:
                continue
            if nearest > near:
                answers[open_[row]] = (None, f"between {name!r} and a new landmark: d2 {nearest:.1f}")
            elif column in taken:
                answers[open_[row]] = (None, f"its nearest landmark {name!r} is taken by a nearer observation")
            else:
                taken.add(column)
                answers[open_[row]] = (name, "")
        return answers
