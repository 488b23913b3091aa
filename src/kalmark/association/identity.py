"""Association by the ids of the log."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from kalmark.association.protocol import Decision, Query
from kalmark.declare import Within, register
from kalmark.geometry.gaussian import gate as chi2_gate

Gate = float | Literal["off", "default"]


@register("association", "identity")
class ByIdentity:
    """Trust the ids of the log.

    An id that is not in the map yet is a new landmark.

    `gate` is the probability with which a right pair is let through; "off" fuses all; "default" is the estimator's own:
    the guide's 3 sigma for `Ekf`, off for the others.
    """

    gate: Annotated[Gate, Within(gt=0, lt=1), "Refuse observations outside this probability; or off, or default."] = (
        "default"
    )

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        if self.gate == "default":
            return default
        return math.inf if self.gate == "off" else chi2_gate(float(self.gate), m)

    def associate(self, query: Query) -> list[Decision]:
        """Answer with the ids as they are; the slam knows which are new."""
        return [(i, "") if i is not None else (None, "no id in the log") for i in query.ids]
