"""Who is in the map: robots, landmarks and mounts by name, the block and the kind of each, how often it was seen."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.management.doubts import Doubts
from kalmark.management.initialization import Unlocated
from kalmark.management.tentative import Tentative
from kalmark.models.protocols import Landmark
from kalmark.tracks.robot import Robot
from kalmark.tracks.scene import EUCLIDEAN, ROBOT, Look, View

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

FADES = 0.9  # of what was learnt, from one scan to the next


def _as_if_made_up(name: Id) -> bool:
    return type(name) is str and name[:1] == "u" and name[1:].isdecimal()


class Members:
    """The names of the map's blocks: `slots` of all of them, `kinds` of the landmarks alone, and their `names` by slot.

    `sorts` has the words by which a `View` finds its `looks`: a landmark's kind, or ROBOT.
    Of a landmark, `seen` counts the observations that were used, `searched` the scans in which it was looked for and
    found, `together` is what was seen in one scan with it; `lately` are those seen last, `last_seen` those of the last
    scan, and `looked` says how often one had been seen when it was last asked which others it
    may be, and after how many `changes`: landmarks that have come or gone.
    `ends` are the abscissas (2,) of the segments seen of lines, `doubts` and `tentative` what waits to become a
    landmark: without a block, and with one; `unlocated` what is known of those whose ranges do not tell yet where they
    are, `here` the last place kept.
    `theirs` are ids of the log or of a survey that look like the names made up for what has none: u1, u2, ...
    """

    def __init__(self, robots: Mapping[str, Robot]) -> None:
        self.robots = robots
        self.slots: dict[Id, int] = {}
        self.names: dict[int, Id] = {}
        self.kinds: dict[Id, Landmark] = {}
        self._sort_at: Index = np.full(64, -1)  # by slot: of the landmark there, a number in `_sorts`, -1 for none
        self._sorts: dict[str, int] = {}
        self._wanted: dict[frozenset[str], Flags] = {}
        self.sorts: dict[Id, str] = {}
        self.seen: dict[Id, int] = {}
        self.searched: dict[Id, list[int]] = {}
        self.ends: dict[Id, Array] = {}
        self.doubts = Doubts()
        self.tentative: dict[Id, Tentative] = {}
        self.together: dict[Id, set[Id]] = {}
        self.lately: list[Id] = []
        self.last_seen: list[Id] = []
        self.looked: dict[Id, tuple[int, int]] = {}
        self.changes = 0
        self.existence: dict[Id, tuple[float, int]] = {}
        self.unlocated: dict[Id, Unlocated] = {}
        self.here: tuple[str, str, int, int] | None = None  # robot, sensor, time: the block of where it was
        self.unnamed = 0
        self.theirs: set[Id] = set()
        self.experience = [0.0, 0.0]  # observations without ids that were lately of landmarks of the map, and were not

    def slot(self, name: Id) -> int:
        """Return the slot of a block.  Raises MapError if there is none of that name."""
        slot = self.slots.get(name) if isinstance(name, Hashable) else None
        if slot is None:
            robots, count = ", ".join(map(repr, self.robots)), len(self.kinds)
            raise MapError(f"{name!r} is not in the map, expected {robots} or one of its {count} landmarks")
        return slot

    def slots_of(self, names: Sequence[Any]) -> Index:
        """Return the slots (K,) of blocks that are in the map."""
        return np.fromiter(map(self.slots.__getitem__, names), np.int64, len(names))

    def place(self, name: Id, slot: int, kind: Landmark) -> None:
        """Enter a landmark, or give one another slot and kind."""
        self._leave(name)
        self.slots[name], self.kinds[name] = slot, kind
        self._take(name, slot)

    def _take(self, name: Id, slot: int) -> None:
        kind = self.kinds[name].kind
        self.names[slot], self.sorts[name] = name, kind
        self._reach(slot)
        self.changes += 1
        self._sort_at[slot] = self._sorts.setdefault(kind, len(self._sorts))

    def _leave(self, name: Id) -> None:
        slot = self.slots.get(name)
        if slot is not None and self.names.pop(slot, None) is not None:
            self._sort_at[slot] = -1

    def _reach(self, slot: int) -> None:
        while slot + 1 >= len(self._sort_at):
            self._sort_at = np.concatenate([self._sort_at, np.full(len(self._sort_at), -1)])

    def sorts_of(self, kinds: frozenset[str], count: int) -> tuple[Index, Flags]:
        """Return the sort of the landmark on each of `count` slots, or more, and which sorts are of some kinds.

        The last of both are of no landmark, so that a slot or a sort of -1 is none.
        """
        self._reach(count)
        wanted = self._wanted.get(kinds)
        if wanted is None or len(wanted) <= len(self._sorts):
            wanted = self._wanted[kinds] = np.array([*(sort in kinds for sort in self._sorts), False])
        return self._sort_at, wanted

    def start(self, name: Id, slot: int, kind: Landmark) -> None:
        """Enter a landmark that a sensor has just seen for the first time."""
        self.place(name, slot, kind)
        self.seen[name] = 1
        if hasattr(kind, "first_ends"):
            self.ends[name] = np.array(kind.first_ends)

    def place_robot(self, name: str, slot: int) -> None:
        """Enter a robot."""
        self.slots[name], self.sorts[name] = slot, ROBOT

    def enter(self, slots: dict[Id, int], kinds: dict[Id, Landmark]) -> None:
        """Enter all blocks and all landmarks of a map at once."""
        self.slots, self.kinds = slots, kinds
        self.names, self.sorts = {}, {}
        for name in kinds:
            if name in slots:
                self._take(name, slots[name])
        self.sorts |= dict.fromkeys(self.robots, ROBOT)

    def count(self, names: Iterable[Any]) -> None:
        """Count an observation that was used of each of some landmarks or robots."""
        seen = self.seen
        for name in names:
            seen[name] = seen.get(name, 0) + 1

    def learn(self, known: float, unknown: float) -> None:
        """Remember how much of a scan was in the map, the less so the longer ago."""
        if known + unknown > 0:
            self.experience = [FADES * self.experience[0] + known, FADES * self.experience[1] + unknown]

    def forget(self, name: Id) -> None:
        """Strike out a landmark."""
        self._leave(name)
        self.changes += 1
        self.last_seen = []
        for other in self.together.get(name, ()):
            if other != name:
                self.together[other].discard(name)
        for table in (
            self.slots,
            self.kinds,
            self.sorts,
            self.seen,
            self.searched,
            self.ends,
            self.together,
            self.looked,
            self.existence,
        ):
            table.pop(name, None)

    def new_name(self) -> str:
        """Return a name for a landmark that has none: u1, u2, ..."""
        while True:
            self.unnamed += 1
            name = f"u{self.unnamed}"
            if name not in self.slots and name not in self.tentative and name not in self.theirs:
                return name

    def reserve(self, ids: Iterable[Id | None]) -> None:
        """Keep in mind that names were given by the log or a survey, so that they are not made up."""
        self.theirs.update(name for name in ids if name is not None and _as_if_made_up(name))

    def made_up(self, name: Id) -> bool:
        """Return whether a landmark's name was made up, for want of an id."""
        return _as_if_made_up(name) and name not in self.theirs

    def in_reach(self, view: View) -> list[Id]:
        """Return the landmarks that a sensor could see."""
        return [name for name, kind in self.kinds.items() if kind.kind in view.looks]

    def known_to(self, view: View, robot: str, names: Sequence[Any]) -> list[int]:
        """Return the indices of those names that a sensor of this robot can observe in the map."""
        sorts = list(map(self.sorts.get, names))
        if view.looks.keys() >= set(sorts) and robot not in names:
            return list(range(len(names)))
        return [i for i, sort in enumerate(sorts) if sort in view.looks and names[i] != robot]

    def by_look(self, view: View, names: Sequence[Id]) -> list[tuple[Look, list[int]]]:
        """Return the indices of names grouped by how a sensor looks at them, points of known depth first."""
        sorts = list(map(self.sorts.__getitem__, names))
        if len(set(sorts)) == 1:
            return [(view.looks[sorts[0]], list(range(len(names))))]
        groups: dict[int, tuple[Look, list[int]]] = {}
        for i, look in enumerate(view.looks[sort] for sort in sorts):
            groups.setdefault(id(look), (look, []))[1].append(i)
        return sorted(groups.values(), key=lambda group: group[0].landmark.kind not in EUCLIDEAN)
