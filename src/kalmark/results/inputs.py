"""What a run was fed beside its scans: when each robot was controlled, and every position fix it used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


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
    y: Array
    z: Array
    Z: Array


@dataclass(frozen=True, eq=False)
class Inputs:
    """The controls of each robot that had any, and the fixes in the order they came."""

    controls: dict[str, Controlled] = field(default_factory=dict)
    fixes: tuple[UsedFix, ...] = ()

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything as named arrays for ``history.npz``."""
        d = max((len(fix.y) for fix in self.fixes), default=2)
        return {
            "control_robot": np.array(list(self.controls), dtype=np.str_),
            "control_span": np.array(list(self.controls.values()), dtype=np.int64).reshape(-1, 3),
            "used_fix_robot": np.array([fix.robot for fix in self.fixes], dtype=np.str_),
            "used_fix_t_ns": np.array([fix.t_ns for fix in self.fixes], dtype=np.int64),
            "used_fix_used": np.array([fix.used for fix in self.fixes], dtype=np.bool_),
            "used_fix_y": np.array([fix.y for fix in self.fixes], dtype=np.float64).reshape(-1, d),
            "used_fix_z": np.array([fix.z for fix in self.fixes], dtype=np.float64).reshape(-1, d),
            "used_fix_Z": np.array([fix.Z for fix in self.fixes], dtype=np.float64).reshape(-1, d, d),
        }

    @classmethod
    def from_arrays(cls, named: Mapping[str, npt.NDArray[Any]]) -> Inputs:
        """Return the inputs that `arrays` gave, none if the run was saved without."""
        if "control_robot" not in named:
            return cls()
        spans = zip(named["control_robot"].tolist(), named["control_span"].tolist(), strict=True)
        columns = (named["used_fix_" + key] for key in ("t_ns", "robot", "used", "y", "z", "Z"))
        fixes = tuple(
            UsedFix(int(t_ns), str(robot), bool(used), y, z, Z)
            for t_ns, robot, used, y, z, Z in zip(*columns, strict=True)
        )
        return cls({robot: Controlled(*span) for robot, span in spans}, fixes)
