"""One record a landmark: everything that is known of it beside its Gaussian, and the names of all blocks of the map."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.models.protocols import Landmark, Segmented
from kalmark.tracks.channel import EUCLIDEAN, ROBOT, Channel, ObservationModel
from kalmark.tracks.classes import LogClasses
from kalmark.tracks.clones import Measurement
from kalmark.tracks.known_landmarks import KnownLandmarks
from kalmark.tracks.looks import SECTORS, SIDE, Looks

Late = tuple[int, str, str, int]  # an earlier observation: time, robot, sensor, number in its scan
ChannelKey = tuple[str, str]  # robot, sensor

FORGETTING = 0.9  # forgetting factor of the count of observations, from one scan to the next
RECENT = 12  # landmarks observed most recently, beside those of the last scan


class Status(Enum):
    """Stage of a landmark: no block yet, a block that corrects nothing, or a landmark of the map."""

    PENDING = "pending"
    TENTATIVE = "tentative"
    CONFIRMED = "confirmed"


@dataclass(frozen=True, eq=False)
class Pending:
    """Measurements from cloned poses that may be of one landmark, until a test of an initialiser passes.

    `mean` and `cov` are its Gaussian in the frame of the sensor of the first measurement, `missed` counts the cloned
    poses in a row from which it was in view and not observed ([T] 2).  Of ranges, none is kept nearer to the one before
    than `spacing_m`.  `hypotheses` are slots of blocks, with the logarithms of their weights after `used` measurements.
    `poses` (2, 7) are those that a tag may have, the first better by the chi-square `evidence`, as of the time `t_ns`.
    """

    channel: ChannelKey
    name: Id | None = None
    measurements: tuple[Measurement, ...] = ()
    mean: Array | None = None
    cov: Array | None = None
    missed: int = 0
    spacing_m: float = 0.0
    hypotheses: tuple[int, ...] = ()
    log_weights: tuple[float, ...] = ()
    used: int = 0
    poses: Array | None = None
    evidence: float = 0.0
    t_ns: int = 0

    def restored(self) -> None:
        """Check the arrays of a file.  Raises MapError."""
        arrays = [array for array in (self.mean, self.cov, self.poses) if array is not None]
        if (self.poses is not None and self.poses.shape != (2, 7)) or not all(np.isfinite(a).all() for a in arrays):
            raise MapError(f"the pending arrays of {self.name!r} are {arrays}, expected finite numbers, and two poses")
        if len(self.log_weights) != len(self.hypotheses):
            raise MapError(f"{self.name!r} has {len(self.log_weights)} weights of {len(self.hypotheses)} hypotheses")


@dataclass
class Track:
    """The record of one landmark.

    `slot` is its block, -1 while it has none.  `observations` counts those that were used.  `searched` and `found`
    count the scans in which it was expected and observed; `hits` of `chances` are these of a tentative one, `unseen`
    the scans since it was last observed.  `seen` are the looks (`looks.py`) that saw it again, `absent` those before
    the last of them that should have and did not, `missed` those since; `reach` (SECTORS,) is how far
    away the first ones were, by the direction from it, `beyond` (12,) the misses from farther away by side.
    `covisible` landmarks were observed in one scan with it.  `compared` counts after how many observations, and after
    how many changes of the map, it was last compared with others.  `extent` (2,) are the abscissas of the segment
    observed of a line, `size_m` is the measured size of a tag.  `first` is the observation that started it, and
    `measurements` are kept with clones until it is confirmed; `pending` is what is known before it has a block.
    `entered` counts the changes of the map before it came into it.  `begun` are time and robot of the observation that
    began it, `last` those of the last one that was used, (0, "") of one that was given.  A tentative one may be where
    observations `of` a landmark have it that do not fit that: then `log_odds` are those that it is right, and
    `covisible` are the landmarks entered before it that fitted meanwhile.  `classes` are the log-likelihoods of the
    classes that it may be of.
    """

    id: Id
    model: Landmark
    slot: int = -1
    status: Status = Status.CONFIRMED
    observations: int = 0
    searched: int = 1
    found: int = 1
    hits: int = 1
    chances: int = 1
    unseen: int = -1
    log_odds: float | None = None
    seen: int = 0
    absent: float = 0.0
    missed: float = 0.0
    reach: Array = field(default_factory=lambda: np.zeros(SECTORS))
    beyond: Array = field(default_factory=lambda: np.zeros(SECTORS // SIDE))
    covisible: set[Id] = field(default_factory=set)
    compared: tuple[int, int] = (0, -1)
    extent: Array | None = None
    size_m: float | None = None
    first: Late | None = None
    pending: Pending | None = None
    measurements: list[Measurement] = field(default_factory=list)
    of: Id | None = None
    entered: int = 0
    begun: tuple[int, str] = (0, "")
    last: tuple[int, str] = (0, "")
    classes: LogClasses = field(default_factory=dict)

    def restored(self) -> None:
        """Check the counts and the extent of a file.  Raises MapError."""
        counts = (self.observations, self.searched, self.found, self.hits, self.chances, self.seen)
        shapes = (self.reach.shape, self.beyond.shape) == ((SECTORS,), (SECTORS // SIDE,)) and (
            self.extent is None or self.extent.shape == (2,)
        )
        if min(counts) < 0 or not shapes:
            raise MapError(f"{self.id!r} has the counts {counts}, the reach {self.reach} and the extent {self.extent}")


def _looks_invented(name: Id) -> bool:
    return type(name) is str and name[:1] == "u" and name[1:].isdecimal()


class Tracks:
    """The tracks by status, and the names, slots and kinds of all blocks of the map.

    `slots` has robots, mounts and biases, too; `names` are the landmarks by slot.  `sorts` has the words by which a
    `Channel` finds its observation models: a landmark's kind, or ROBOT.  `recent` are the landmarks observed last,
    `last_scan` those of the last scan; `changes` counts landmarks that have come or gone,
    `searched` those until the map was last searched for repeats.  `candidates` are pending
    measurements without a landmark, by channel.  `reserved` are ids of the log or of a survey that look like invented
    names: u1, u2, ...  `experience` counts observations without ids that were of landmarks just seen.
    `known` are the landmarks that are known exactly, outside the map.  `looks` of each sensor and `looked`, how many,
    decide whether landmarks exist, with the Beta density `detection` of their detection probabilities.
    """

    confirmed: dict[Id, Track]
    tentative: dict[Id, Track]
    pending: dict[Id, Track]
    candidates: dict[ChannelKey, list[Pending]]
    slots: dict[Id, int]
    recent: list[Id]
    last_scan: list[Id]
    changes: int
    searched: int
    unnamed: int
    reserved: set[Id]
    experience: float
    known: KnownLandmarks
    looks: dict[ChannelKey, Looks]
    looked: int
    detection: tuple[float, float]

    def __init__(self, robots: Iterable[str]) -> None:
        self.robots = tuple(robots)
        self.confirmed, self.tentative, self.pending, self.candidates = {}, {}, {}, {}
        self.slots, self.recent, self.last_scan, self.reserved = {}, [], [], set()
        self.changes = self.searched = self.unnamed = self.looked = 0
        self.experience, self.known, self.looks, self.detection = 0.0, KnownLandmarks(), {}, (0.5, 0.5)
        self.names: dict[int, Id] = {}
        self.sorts: dict[Id, str] = {}
        self._sort_at: Index = np.full(64, -1)  # by slot: the number of a landmark's kind in `_numbers`, -1 for none
        self._numbers: dict[str, int] = {}
        self._wanted: dict[frozenset[str], Flags] = {}

    # ------------------------------------------------------------------ blocks
    def enter_block(self, name: str, slot: int, *, robot: bool = False) -> None:
        """Enter a robot, a mount or a bias."""
        self.slots[name] = slot
        if robot:
            self.sorts[name] = ROBOT

    def slot(self, name: Id) -> int:
        """Return the slot of a block.  Raises MapError if there is none of that name."""
        slot = self.slots.get(name) if isinstance(name, Hashable) else None
        if slot is None:
            robots, count = ", ".join(map(repr, self.robots)), len(self.confirmed)
            raise MapError(f"{name!r} is not in the map, expected {robots} or one of its {count} landmarks")
        return slot

    def slots_of(self, names: Sequence[Any]) -> Index:
        """Return the slots (K,) of blocks that are in the map."""
        return np.fromiter(map(self.slots.__getitem__, names), np.int64, len(names))

    def number(self) -> None:
        """Compute what follows from the tracks and the slots of a file."""
        self.names, self.sorts = {}, {name: ROBOT for name in self.robots}
        changes = self.changes
        for track in self.confirmed.values():
            self.enter(track)
        self.changes = changes

    # ------------------------------------------------------------------ landmarks
    def confirm(self, track: Track, observations: int = 1) -> None:
        """Make a landmark of the map of a track that has a block."""
        track.status, track.observations, track.entered = Status.CONFIRMED, observations, self.changes
        if isinstance(track.model, Segmented) and track.extent is None:
            track.extent = np.array(track.model.first_ends)
        self.enter(track)

    def enter(self, track: Track) -> None:
        """Enter a landmark of the map under its slot and its kind."""
        name, slot, kind = track.id, track.slot, track.model.kind
        self.confirmed[name], self.slots[name], self.names[slot], self.sorts[name] = track, slot, name, kind
        self._reach(slot)
        self._sort_at[slot] = self._numbers.setdefault(kind, len(self._numbers))
        self.changes += 1

    def replace(self, track: Track, slot: int, model: Landmark) -> None:
        """Give a landmark another block and another model."""
        self._leave(track)
        track.slot, track.model = slot, model
        self.enter(track)

    def remove(self, name: Id) -> None:
        """Strike out a landmark."""
        track = self.confirmed.pop(name)
        self._leave(track)
        del self.slots[name], self.sorts[name]
        self.changes += 1
        self.last_scan = []
        for other in track.covisible:
            if other in self.confirmed:
                self.confirmed[other].covisible.discard(name)

    def merge(self, kept: Track, gone: Track) -> None:
        """Let one track have what is known of another, which is to be removed: they are one landmark."""
        kept.observations += gone.observations
        kept.seen, kept.absent = kept.seen + gone.seen, kept.absent + gone.absent
        kept.missed, kept.last = min(kept.missed, gone.missed), max(kept.last, gone.last)
        kept.reach, kept.beyond = np.maximum(kept.reach, gone.reach), kept.beyond + gone.beyond
        for name in list(gone.covisible):
            if name in self.confirmed:
                self.confirmed[name].covisible.add(kept.id)
        kept.covisible |= gone.covisible
        for name, log_p in gone.classes.items():
            kept.classes[name] = kept.classes.get(name, 0.0) + log_p

    def count(self, names: Iterable[Any], used: Iterable[bool], by: tuple[int, str]) -> None:
        """Count observations that were used, `by` a robot at a time, at their landmarks; robots are not counted."""
        for track, fused in zip(map(self.confirmed.get, names), used, strict=False):
            if fused and track:
                track.observations += 1
                track.last = by

    def note_scan(self, names: list[Id]) -> None:
        """Note the landmarks that were observed in one scan: they are covisible, and so different ones."""
        if names != self.last_scan:
            for name in names:
                self.confirmed[name].covisible.update(names)
            self.recent = [name for name in self.recent if name not in names][-RECENT:] + names
            self.last_scan = names

    def count_reobserved(self, again: float) -> None:
        """Count the observations of a scan that were of landmarks just seen, with a forgetting factor."""
        if again > 0:
            self.experience = FORGETTING * self.experience + again

    def waiting(self) -> Iterator[Pending]:
        """Return all that is pending: of landmarks with ids, and candidates."""
        yield from (track.pending for track in self.pending.values() if track.pending is not None)
        for candidates in self.candidates.values():
            yield from candidates

    def _leave(self, track: Track) -> None:
        if self.names.pop(track.slot, None) is not None:
            self._sort_at[track.slot] = -1

    # ------------------------------------------------------------------ names
    def new_name(self) -> str:
        """Return a name for a landmark that has none: u1, u2, ..."""
        while True:
            self.unnamed += 1
            name = f"u{self.unnamed}"
            taken = name in self.slots or name in self.tentative or name in self.reserved or name in self.known
            if not taken:
                return name

    def reserve(self, ids: Iterable[Id | None]) -> None:
        """Keep in mind that names were given by the log or a survey, so that they are not invented."""
        self.reserved.update(name for name in ids if name is not None and _looks_invented(name))

    def rename_tentative(self, ids: Iterable[Id | None]) -> None:
        """Give other names to tentative landmarks whose name the log, or a survey, gives to another one."""
        for name in [name for name in self.tentative if name in self.slots or name in ids]:
            track = self.tentative.pop(name)
            track.id = self.new_name()
            self.tentative[track.id] = track

    def is_invented(self, name: Id) -> bool:
        """Return whether a landmark's name was made here, as it has no id."""
        return _looks_invented(name) and name not in self.reserved

    # ------------------------------------------------------------------ by channel
    def sorts_of(self, kinds: frozenset[str], count: int) -> tuple[Index, Flags]:
        """Return the sort (count or more,) of the landmark on each slot, and which sorts (S + 1,) are of some kinds.

        The last of both are of no landmark, so that a slot or a sort of -1 is none.
        """
        self._reach(count)
        wanted = self._wanted.get(kinds)
        if wanted is None or len(wanted) <= len(self._numbers):
            wanted = self._wanted[kinds] = np.array([*(sort in kinds for sort in self._numbers), False])
        return self._sort_at, wanted

    def only_model(self, channel: Channel) -> ObservationModel | None:
        """Return the model by which a sensor observes all landmarks of the map; None if they are of several kinds."""
        return channel.models.get(next(iter(self._numbers))) if len(self._numbers) == 1 else None

    def _reach(self, slot: int) -> None:
        while slot + 1 >= len(self._sort_at):
            self._sort_at = np.concatenate([self._sort_at, np.full(len(self._sort_at), -1)])

    def observable(self, channel: Channel) -> list[Id]:
        """Return the landmarks of the kinds that a sensor can observe."""
        return [name for name, track in self.confirmed.items() if track.model.kind in channel.models]

    def by_model(
        self, channel: Channel, names: Sequence[Any], robot: str = ""
    ) -> list[tuple[ObservationModel, list[int]]]:
        """Return the indices of names grouped by observation model, points of known depth first.

        Left out are names that a sensor of this robot does not observe in the map, itself among them.
        """
        return self._by_model(channel, names, list(map(self.sorts.get, names)), robot)

    def known_by_model(self, channel: Channel, names: Sequence[Any]) -> list[tuple[ObservationModel, list[int]]]:
        """Return the same of names known exactly; all others are left out."""
        return self._by_model(channel, names, list(map(self.known.kind, names)), "")

    def any_by_model(self, channel: Channel, names: Sequence[Any]) -> list[tuple[ObservationModel, list[int]]]:
        """Return the same of names in the map or known exactly."""
        sort = self.sort if len(self.known) else self.sorts.get
        return self._by_model(channel, names, list(map(sort, names)), "")

    def sort(self, name: Any) -> str | None:
        """Return the kind of a landmark, in the map or known exactly, ROBOT of a robot, None of none."""
        return self.sorts.get(name) or self.known.kind(name)

    def _by_model(
        self, channel: Channel, names: Sequence[Any], sorts: list[str | None], robot: str
    ) -> list[tuple[ObservationModel, list[int]]]:
        at = list(range(len(names)))
        if robot in names:
            at = [i for i in at if names[i] != robot]
        elif len(set(sorts)) == 1:
            sort = sorts[0]
            return [(channel.models[sort], at)] if sort in channel.models else []
        groups: dict[int, tuple[ObservationModel, list[int]]] = {}
        for i in at:
            if (sort := sorts[i]) in channel.models:
                model = channel.models[sort]
                groups.setdefault(id(model), (model, []))[1].append(i)
        return sorted(groups.values(), key=lambda group: group[0].landmark.kind not in EUCLIDEAN)
