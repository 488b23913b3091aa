"""Which landmark was that?  By the identity the log gives, or by what fits: each for itself, together, or jointly.

What an association may ask and answer is in `decisions`; a user's own one needs no more than `Association` says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from kalmark.association.gated import GlobalAssignment, JointCompatibility, NearestNeighbour
from kalmark.association.protocol import ANEW, DEFERRED, NEW, Association, Decision, Query
from kalmark.association.weighing import Automatic, Averaged, Cliques, Sampled
from kalmark.errors import ModelError
from kalmark.geometry.gaussian import gate as chi2_gate

__all__ = [
    "ANEW", "DEFERRED", "NEW", "Association", "Automatic", "Averaged", "ByIdentity", "Cliques", "Decision",
    "GlobalAssignment", "JointCompatibility", "NearestNeighbour", "Query", "Sampled",
]  # fmt: skip

Gate = float | str


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
