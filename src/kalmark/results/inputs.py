"""What a run was fed beside its scans: when each robot was controlled, and every position fix it used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from kalmark.results.columns import Arrays, Matrix, Named, Vector, columns, rows_of, texts


class Controlled(NamedTuple):
    """A robot's controls: how many, and the times (ns) of the first and the last."""

    number: int
    first_ns: int
    last_ns: int


class UsedFix(NamedTuple):
    """A fix that the filter was given: y (d,), innovation z (d,) and its covariance Z (d, d), d = 2 or 3.

    `used`: not rejected.
    """

    t_ns: int
    robot: str
    used: bool
    y: Vector
    z: Vector
    Z: Matrix


@dataclass(frozen=True, eq=False)
class Inputs:
    """The controls of each robot that had any, and the fixes in the order they came."""

    controls: dict[str, Controlled] = field(default_factory=dict)
    fixes: tuple[UsedFix, ...] = ()

    def arrays(self) -> Arrays:
        """Return everything as named arrays for ``history.npz``."""
        spans = np.array(list(self.controls.values()), dtype=np.int64).reshape(-1, 3)
        named: Arrays = {"control_robot": texts(list(self.controls)), "control_span": spans}
        return named | columns("used_fix", UsedFix, self.fixes)

    @classmethod
    def from_arrays(cls, named: Named) -> Inputs:
        """Return the inputs that `arrays` gave, none if the run was saved without."""
        if "control_robot" not in named:
            return cls()
        spans = zip(named["control_robot"].tolist(), named["control_span"].tolist(), strict=True)
        return cls({robot: Controlled(*span) for robot, span in spans}, rows_of("used_fix", UsedFix, named))
