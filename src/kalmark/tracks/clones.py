"""The window of cloned poses: past poses of robots as blocks of the map, kept as long as a measurement needs them.

A stochastic clone (Roumeliotis and Burdick 2002) is a copy of a robot's pose.  It stays correlated with all else and
takes part in every correction, so that a measurement that was made from it can be used later, exactly.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import MapError

User = tuple[str, str]  # a channel: robot, sensor


@dataclass(frozen=True, eq=False)
class Measurement:
    """The k-th observation y (m,) of a scan, its noise R (p, p), made from a cloned pose.

    `own_noise`: R was given with the scan; else the sensor's model may compute it again at the position of the
    landmark.
    """

    clone: int
    t_ns: int
    robot: str
    sensor: str
    k: int
    y: Array
    R: Array
    own_noise: bool

    def restored(self) -> None:
        """Check the arrays of a file.  Raises MapError."""
        square = self.y.ndim == 1 and self.R.ndim == 2 and self.R.shape[0] == self.R.shape[1]
        if not square or not np.isfinite(self.y).all() or not np.isfinite(self.R).all():
            raise MapError(f"a measurement of {self.robot!r}, {self.sensor!r} is {self.y} with the noise {self.R}")

    @property
    def late(self) -> tuple[int, str, str, int]:
        """Key of the observation in the log: time, robot, sensor and number in its scan."""
        return self.t_ns, self.robot, self.sensor, self.k


@dataclass
class Clone:
    """A cloned pose: its block, of which robot and of when, and which channels refer to it."""

    slot: int
    robot: str
    t_ns: int
    users: set[User]


class Clones:
    """The cloned poses by number, oldest first.  A clone goes when no channel refers to it any more.

    `latest` are the numbers of clones of where robots are, which have not moved since.
    """

    clones: dict[int, Clone]
    latest: dict[str, int]
    numbered: int

    def __init__(self) -> None:
        self.clones, self.latest, self.numbered = {}, {}, 0

    def __getitem__(self, number: int) -> int:
        """Return the slot of a clone."""
        return self.clones[number].slot

    def now(self, robot: str, t_ns: int) -> int | None:
        """Return the number of the clone of a robot's pose at a time, None if there is none."""
        number = self.latest.get(robot)
        clone = None if number is None else self.clones.get(number)
        return number if clone is not None and clone.t_ns == t_ns else None

    def forget_current(self, robot: str) -> None:
        """Forget which clone is the current pose of a robot, after a motion."""
        self.latest.pop(robot, None)

    def enter(self, slot: int, robot: str, t_ns: int) -> int:
        """Enter a clone and return its number."""
        self.numbered += 1
        self.clones[self.numbered] = Clone(slot, robot, t_ns, set())
        self.latest[robot] = self.numbered
        return self.numbered

    def users(self) -> list[User]:
        """Return all channels that refer to a clone, sorted."""
        return sorted({user for clone in self.clones.values() for user in clone.users})

    def of(self, user: User) -> list[int]:
        """Return the numbers of the clones that a channel refers to, oldest first."""
        return [number for number, clone in self.clones.items() if user in clone.users]

    def refer(self, user: User, numbers: Iterable[int]) -> list[int]:
        """Let a channel refer to these clones and to no others; return the slots of clones that are now free."""
        wanted, free = set(numbers), []
        for number, clone in list(self.clones.items()):
            if number in wanted:
                clone.users.add(user)
            else:
                clone.users.discard(user)
            if not clone.users:
                free.append(self.clones.pop(number).slot)
        return free
