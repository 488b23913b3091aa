"""The compressed map: an exact EKF whose ordinary step does not grow with the map.  docs/compressed.md.

Blocks observed now or lately are active.  They are in a small dense map, which any estimator corrects as it stands.
For each block that was inactive before, the dense map also holds *auxiliary states* s, zero at first, with

    P_As = Phi,   P_ss = -Psi,   x_s = theta,      Phi = 1, Psi = 0, theta = 0 at the last full update.

Prediction, correction and transport treat them like any other scalars, which is all that an inactive block B needs:
x_B = x0_B + P0_BA theta, P_BA = P0_BA Phi', P_BB = P0_BB - P0_BA Psi P0_AB.  A block enters by being augmented from
the auxiliary states.  When the dense map has grown too large, a full update writes all back.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.filter import kernels
from kalmark.filter.compressed import immediate
from kalmark.filter.compressed.drift import Drift
from kalmark.filter.compressed.full_update import FullUpdate, Interval, Workspace
from kalmark.filter.compressed.immediate import Displacements, ImmediateCorrections, Points, transport_mean
from kalmark.filter.compressed.inactive_search import InactiveSearch
from kalmark.filter.compressed.joint_reads import carried_along, joint_marginal, split_active
from kalmark.filter.compressed.schedule import PREFAULT, SLICE, Schedule
from kalmark.filter.compressed.storage import PANEL, Triangle
from kalmark.filter.layout import P_AT, P_SIZE, X_AT, X_SIZE, Layout, State, concatenate_tables
from kalmark.filter.map import AT_ONCE, NO_SLOTS, Marginal, Pairs, StochasticMap
from kalmark.filter.nearest_blocks import Sorts, distances, near_places
from kalmark.filter.nearest_of_each import Asked, Nearest, Seen, nearest_landmarks
from kalmark.geometry.spaces import RHO, Rn, Space, Table

NO_ROWS, NO_NUMBERS = np.zeros(0, dtype=np.int64), np.zeros(0)
ALL = 1e300  # multiplications: all the work that is left
SEARCHED = 8  # inactive blocks to be read for each place: they have moved since the tree was made

scalars = lru_cache(maxsize=64)(Rn)


class CompressedMap(Layout):
    """The joint Gaussian of all blocks, of which a few are active and the others inactive.

    A block keeps its slot.  `index` and `predict` take rows of the active map: an index is valid until the next
    correction.  `most` limits the rows of the active map, auxiliary states included; by default a compression interval
    ends when its corrections have cost more than its full update.
    """

    averages = False

    def __init__(self, storage: Triangle | None = None, most: int | None = None) -> None:
        self.active = StochasticMap()
        self.storage = storage or Triangle()
        self.most = most
        self.interval = 0  # number of full updates
        self._at: Index = np.full(64, -1)  # slot in the active map, -1 if inactive
        self._slot_of: Index = np.full(64, -1)  # by slots in the active map, -1 for auxiliary states
        self._job: FullUpdate | None = None
        self._workspace = Workspace(self.storage.prefault)
        self._anchored: set[int] = set()  # blocks with inverse distances
        super().__init__()
        self._begin()

    def _begin(self) -> None:
        """Begin a compression interval: nothing is active."""
        self.interval += 1
        self.active.reset()
        self._at[:] = self._slot_of[:] = -1
        self.entered: dict[int, int] = {}  # slots in the active map by slot
        self.auxiliary: dict[int, int] = {}  # slots of auxiliary states in the active map, by slot: in the order of A0
        self.A0: Index = NO_ROWS  # rows of the storage that have auxiliary states,
        self._s: Index = NO_ROWS  # the rows of these in the active map,
        self._s_x: Index = NO_ROWS  # and their numbers, first without and then with those of the clones
        self._displaced_x: Index = NO_ROWS
        self.departed: list[tuple[int, Space]] = []  # removed blocks that still have auxiliary states
        self.displaced: dict[int, Array] = {}  # the part of each robot's corrections in these states and the clones
        self._turns: dict[tuple[int, int], Index] = {}  # and the rows of the turn of the world in them
        self.drift, self.schedule, self._points = Drift(), Schedule(self.most), Points()
        self._immediate, self._before = ImmediateCorrections(), NO_NUMBERS
        self._search = InactiveSearch()

    @classmethod
    def of_blocks(
        cls, spaces: Iterable[Space], free: Iterable[Any], storage: Triangle | None, most: int | None
    ) -> CompressedMap:
        """Return a map of blocks at zero, of which those in `free` are removed."""
        m = cls(storage, most)
        for space in spaces:
            m._place(space, np.zeros(space.size))
        for slot in free:
            m._vacate(m.removed(slot))
        return m

    @classmethod
    def from_dense(
        cls, dense: StochasticMap, storage: Triangle | None = None, most: int | None = None
    ) -> CompressedMap:
        """Return a dense map as a compressed one; slots stay what they are."""
        spaces = dense.shapes()
        m = cls.of_blocks(spaces, dense.free(), storage, most)
        rows, old = (np.concatenate([each.rows(i) for i in range(len(spaces))]) for each in (m, dense))
        m.storage.put(rows, rows, kernels.submatrix(dense.P, old))
        m.x[: m.x_n], m.x_first[: m.x_n], m.axes = dense.x[: m.x_n], dense.x_first[: m.x_n], dense.axes
        return m

    # ------------------------------------------------------------------ reading
    def index(self, slot: int) -> Index:
        """Return the rows of a block in the active map, which it enters if need be."""
        self._enter([slot])
        return self.active.rows(self.entered[slot])

    def mean(self, slot: int) -> Array:
        """Return a copy of a block's mean."""
        at = self.entered.get(slot)
        return self.active.mean(at) if at is not None else self._inactive(np.array([slot]))[1][0]

    def first(self, slot: int) -> Array:
        """Return a copy of a block's first estimate, of a robot its last predicted one."""
        at = self.entered.get(slot)
        return self.active.first(at) if at is not None else self.x_first[self.numbers(slot)].copy()

    def means(self, slots: Index, d: int) -> Array:
        """Return the first d numbers (K, d) of blocks."""
        inactive, out = self._at[slots] < 0, np.empty((len(slots), d))
        out[~inactive] = self.active.means(self._at[slots[~inactive]], d)
        if inactive.any():
            slots, found, moved = slots[inactive], list[Array](), self._displacements()
            for i in range(0, len(slots), AT_ONCE):
                blocks, atoms, numbers, rows = self._laid_out(slots[i : i + AT_ONCE])
                x = transport_mean(atoms, self.x[numbers], self._read(rows, self.A0), *moved)[0]
                found.append(x[blocks[:, :1] + np.arange(d)])
            out[inactive] = np.concatenate(found)
        return out

    def covariance(self, slots: Sequence[int]) -> Array:
        """Return the joint covariance of blocks, in the order given.  A query does not activate a block."""
        m, first, _, here = self.marginal(slots[0], -1, np.array(slots[1:], dtype=np.int64))
        return m.covariance([first, *here.tolist()])

    def marginal(self, robot: int, mount: int, slots: Index) -> Marginal:
        """Return a dense map of these blocks, the active one if all are there.  A query does not activate a block."""
        m = self.active
        own, inactive, here = split_active(self._at, np.concatenate([[robot, mount], slots]))
        if not len(inactive):
            return Marginal(m, int(self._at[robot]), self.entered.get(mount, -1), self._at[slots])
        active = m.x, m.P, m.blocks[own], m.atoms, self._extra_rows()
        tables: tuple[Any, ...] = (*active, *self._kept(inactive), *self._displacements())
        return Marginal(
            StochasticMap.of(*joint_marginal(*tables), self.axes, self.inverse_depths, self.dependent),
            int(here[0]),
            int(here[1]),
            here[2:],
        )

    def pairs(self, sorts: Sorts, robot: int, mount: int, p: Array, nearest: int, farther: float) -> Pairs:
        """Return the wanted blocks near p (K, 2 or 3); inactive ones by their means when the interval began."""
        slots, limit = self._near_active(sorts, p, nearest, farther)
        inactive = self._search.near(self, self._at, sorts, p, limit, max(SEARCHED, nearest))
        slots, d = np.concatenate([slots, inactive]) if len(inactive) else slots, p.shape[1]
        read = self.marginal(robot, mount, slots) if len(inactive) <= AT_ONCE else None
        places = self.means(slots, d) if read is None else read.map.means(read.slots, d)
        return Pairs.of(slots, places, read, p, nearest, farther)

    def nearest(self, model: Any, scan: Seen, asked: Asked) -> Nearest | None:
        """Return the only wanted block that each observation can be of; None where more is needed to decide that.

        Only active blocks are read: it is not clear where an inactive one may be nearer.
        """
        robot, mount, d, y, R = scan
        if robot not in self.entered or (mount >= 0 and mount not in self.entered):
            return None
        m, own = self.active, (self.entered[robot], self.entered.get(mount, -1), d, y, R)
        clear, found = nearest_landmarks(model, m.whole, own, self._slot_of[: len(m.blocks)], asked)
        if not clear:
            return None
        sorts, p, *_ = asked
        mine, covariance = Nearest(*found), partial(self._at_first, p.shape[1])
        old = np.array([slot if slot in self.auxiliary else -1 for slot in mine.at.tolist()])  # new: bounds nothing
        return mine if self._search.none_nearer(self, self._at, sorts, p, mine, old, covariance) else None

    def _at_first(self, d: int, slots: Index) -> Array:
        """Return the covariance (N d, N d) of the first d numbers of blocks as it was when the interval began."""
        if self._job is not None:
            self._job.know(slots)
        rows = (self.blocks[slots, P_AT][:, None] + np.arange(d)).ravel()
        return self._read(rows, rows)

    def around(self, sorts: Sorts, p: Array, count: int) -> Index:
        """Return the slots (N,) of the wanted blocks nearest to p (2 or 3,), nearest first.

        Inactive ones are taken to be where the last full update left them.
        """
        slots, limit = self._near_active(sorts, p[None], count, math.inf)
        inactive = self._search.near(self, self._at, sorts, p[None], limit, count)
        places = np.concatenate([self.means(slots, len(p)), self.stored(inactive, len(p))])
        gaps = distances(p[None], places)[0]
        return np.concatenate([slots, inactive])[np.argsort(gaps, kind="stable")[:count]]

    def _near_active(self, sorts: Sorts, p: Array, nearest: int, farther: float) -> tuple[Index, Array]:
        m = self.active
        return near_places(p, m.x, m.blocks, self._slot_of[: len(m.blocks)], sorts, nearest, farther)

    def _inactive(self, slots: Index) -> tuple[Table, tuple[Array, Array, Array, Array]]:
        """Return the blocks (K, 6) of inactive ones, laid out one after the other, and these as they are now."""
        blocks, atoms, x, C = self._kept(slots)
        return blocks, carried_along(atoms, x, C, *self._displacements())

    def _kept(self, slots: Index) -> tuple[Table, Table, Array, Array]:
        """Return the tables of inactive blocks, laid out one after the other, and their stored means and covariances.

        The covariances are those with the auxiliary states and, behind that, their own.
        """
        blocks, atoms, numbers, rows = self._laid_out(slots)
        return blocks, atoms, self.x[numbers], self._read(rows, np.concatenate([self.A0, rows]))

    def _laid_out(self, slots: Index) -> tuple[Table, Table, Index, Index]:
        """Return the tables of inactive blocks, laid out one after the other, their numbers and rows, to be read."""
        if self._job is not None:
            self._job.know(slots)
        return concatenate_tables(self.blocks[slots], self.atoms)

    def _read(self, rows: Index, columns: Index) -> Array:
        return self.storage.get(rows, columns) if self._job is None else self._job.read(rows, columns)

    def _extra_rows(self) -> Index:
        """Return the rows of the active map that inactive blocks depend on: auxiliary states and all turns."""
        return np.concatenate([self._s, self._immediate.rows, *(self._turn_rows(robot) for robot in self.displaced)])

    @property
    def _axes(self) -> int:
        """The axes of the turns in this interval: those of its immediate corrections, or of all blocks."""
        return self._immediate.axes or self.axes

    def _turn_rows(self, robot: int) -> Index:
        """Return the rows of what turns the world with a robot: of its orientation, or its whole pose."""
        rows = self._turns.get((robot, self._axes))
        if rows is None:
            last = int(self.active.blocks[self.entered[robot], P_AT]) + (3 if self._axes == 1 else 6)
            rows = self._turns[robot, self._axes] = np.arange(last - self._axes, last)
        return rows

    def _by_robot(self) -> tuple[Array, Array]:
        """Return the parts (A0, R) and (T, R) that each robot's corrections have in auxiliary states and clones."""
        displaced = list(self.displaced.values()) or [self.active.x[self._s_x]]
        D = displaced[0][:, None] if len(displaced) == 1 else np.column_stack(displaced)
        return D[: len(self.A0)], D[len(self.A0) :]

    def _displacements(self) -> Displacements:
        """Return what has displaced inactive blocks; without transport nothing turns."""
        return self._immediate.displacements(*self._by_robot(), self._axes if self.displaced else 0, self._origins())

    def _origins(self) -> Array:
        """Return where the robots are (R, 3)."""
        m, robots = self.active, [self.entered[robot] for robot in self.displaced]
        return np.concatenate([m.x[m.numbers(at)][:3] for at in robots] or [np.zeros(3)]).reshape(-1, 3)

    # ------------------------------------------------------------------ growing and shrinking
    def add(self, space: Space, mean: Any, cov: Any = None) -> int:
        """Add a block that is independent of all others (`cov` None: known exactly); return its slot.

        An index from before holds no longer.
        """
        if self._full(self._progress()):
            self.full_update()
        mean = np.asarray(mean, dtype=np.float64)
        slot = self._place(space, mean)
        self.activate(slot, self.active.add(space, mean, cov))
        return slot

    def augment(self, space: Space, mean: Array, index: Index, G: Array, Q: Array) -> int:
        """Add a block computed from the rows `index`: P_Lx = G P_x, P_LL = G P G' + Q.  [S] (35)-(38)."""
        slot = self._place(space, mean)
        self.activate(slot, self.active.augment(space, mean, index, G, Q))
        if self._full(self._progress()):
            self.full_update()
        return slot

    def remove(self, slot: int) -> None:
        """Marginalise a block out; its slot is free for another of its shape, once it has no auxiliary state."""
        if slot in self.entered:
            at = self.entered.pop(slot)
            self.active.remove(at)
            self._at[slot] = self._slot_of[at] = -1
            self.drift.forget(slot)
            self._points.reset()
        space = self.spaces[slot]
        assert space is not None
        if slot in self.auxiliary:
            self.depart(slot, space)
        else:
            self._vacate(slot)

    def depart(self, slot: int, space: Space) -> None:
        """Remove an inactive block whose auxiliary state is still needed."""
        self._vacate(slot)
        self._free[space.kinds].remove(slot)
        self.departed.append((slot, space))

    def _place(self, space: Space, mean: Array) -> int:
        slot = super()._place(space, mean)
        if RHO in space.kinds:
            self._anchored.add(slot)
        return slot

    def _vacate(self, slot: int) -> None:
        super()._vacate(slot)
        self._anchored.discard(slot)

    def activate(self, slot: int, at: int) -> None:
        """Take a block of the active map as that of a slot."""
        self.entered[slot] = self._at[slot] = at
        self._slot_of = _reaching(self._slot_of, at)
        self._slot_of[at] = slot
        self.active.axes = self.axes
        self._points.reset()

    def _first_row(self, dof: int) -> int:
        """Return where the rows of a new block begin: no block lies in two panels.  Raises MapError if none fits."""
        first = self.n if self.n % PANEL + dof <= PANEL else (self.n // PANEL + 1) * PANEL
        self.storage.reserve(first + dof)
        return first

    def _reserve(self, size: int) -> None:
        super()._reserve(size)
        self._at = _reaching(self._at, len(self.blocks))

    # ------------------------------------------------------------------ moving
    def predict(self, index: Index, F: Array, Q: Array) -> None:
        """P <- F P F' + Q, F and Q acting on the rows `index` alone.  [S] (15)-(17)."""
        self.active.predict(index, F, Q)

    def set_predicted(self, slot: int, mean: Array) -> None:
        """Write a block's mean after a motion."""
        self._enter([slot])
        self.active.set_predicted(self.entered[slot], mean)
        self.take_as_moving(slot)

    def movable(self, robot: int, added: Sequence[int]) -> Marginal:
        """Return the active map, which the robot and the blocks `added` to its control enter, and their slots there."""
        self._enter([robot, *added])
        self.take_as_moving(robot)
        return Marginal(self.active, self.entered[robot], -1, self._at[list(added)] if added else NO_SLOTS)

    # ------------------------------------------------------------------ correcting
    def opened(self, robot: int, mount: int, slots: Index, transports: bool) -> Marginal:
        """Return the dense map on which a scan of these blocks is fused, and their slots there: all have entered.

        So have all inverse distances where a correction transports: theirs is more than the rotation of the world.
        """
        head = [robot] if mount < 0 else [robot, mount]
        self._enter([*(self._anchored if transports else ()), *head, *slots.tolist()])
        at = self._at[slots]
        if not self.schedule.begun:
            observed = self.active.blocks[[self.entered[robot], *at], P_SIZE].sum()
            self.schedule.begin(self.active.n, int(observed))
        self._before = self.active.x.copy()
        return Marginal(self.active, self.entered[robot], self.entered.get(mount, -1), at)

    def finish_correction(self, robot: int, transports: bool) -> None:
        """Complete the correction of what `opened` returned: correct inactive blocks if need be, go on with a job."""
        m = self.active
        if transports and len(self.A0):
            s, before = m.x[self._displaced_x], self.displaced.get(robot, 0.0)
            others = [displaced for other, displaced in self.displaced.items() if other != robot]
            self.displaced[robot] = now = s - sum(others) if others else s
            some = len(self.entered) < self.used
            if some and (self._far(robot, s) or self._points.parted(m, self.entered[robot], self._before)):
                self.correct_all(robot, now - before)
            if len(self._immediate.rows) >= immediate.most_clone_rows(self.n):
                self._advance(SLICE)
                if self._job is None:
                    self.full_update()
        self.schedule.count(m.n)
        used, progress = m.prepare() or self.storage.prefault.some(), self._progress()
        if (job := self._job) is not None:
            self._advance(self.schedule.due(progress, job.spent, job.work) - PREFAULT * used)
        if self._full(progress):  # now, since the next correction begins with the work of a new interval
            self.full_update()

    def _enter(self, slots: Sequence[int]) -> None:
        """Make blocks active: augment them from the auxiliary states, and give them some of their own.  O(active^2)."""
        slots = [slot for slot in dict.fromkeys(slots) if slot not in self.entered]
        if not slots:
            return
        m, spaces = self.active, [space for slot in slots if (space := self.spaces[slot]) is not None]
        blocks, (x, G, Q, x_left) = self._inactive(np.array(slots))
        numbers = [slice(first, first + size) for first, size in blocks[:, [X_AT, X_SIZE]].tolist()]
        found = m.extend(spaces, [x[where] for where in numbers], self._extra_rows(), G, Q)
        for slot, at in zip(slots, found, strict=True):
            m.x_first[m.numbers(at)] = self.x_first[self.numbers(slot)]
            self.activate(slot, at)
        sizes = [space.dof for space in spaces]
        states = m.extend(
            [scalars(d) for d in sizes], [np.zeros(d) for d in sizes], NO_ROWS, G[:, :0], np.zeros_like(Q)
        )
        rows, s = (np.concatenate([m.rows(at) for at in some]) for some in (found, states))
        m.P[np.maximum(rows, s), np.minimum(rows, s)] = 1.0
        for name, displaced in self.displaced.items():
            self.displaced[name] = np.insert(displaced, len(self.A0), np.zeros(len(s)))
        self.attach(slots, states)
        variances = np.diag(Q)
        for slot, where, first, d in zip(slots, numbers, blocks[:, P_AT].tolist(), sizes, strict=True):
            self.watch(slot, x_left[where], variances[first : first + d])

    def attach(self, slots: Sequence[int], states: Sequence[int]) -> None:
        """Take blocks of the active map as the auxiliary states of slots."""
        self.auxiliary.update(zip(slots, states, strict=True))
        where = [self.active.numbers(at) for at in states]
        self.A0 = np.concatenate([self.A0, *(self.rows(slot) for slot in slots)])
        self._s = np.concatenate([self._s, *(self.active.rows(at) for at in states)])
        self._s_x = np.concatenate([self._s_x, *(np.arange(at.start, at.stop) for at in where)])
        self._displaced_x = np.concatenate([self._s_x, self._immediate.numbers])

    def watch(self, slot: int, left: Array, variances: Array) -> None:
        """Watch how far an active block goes from the mean at which its inactive error coordinates were left.

        `variances` are those stored.
        """
        space, at = self.spaces[slot], self.entered.get(slot)
        if space is not None and at is not None:
            here = self.active.numbers(at).start, int(self.active.rows(at)[0])
            self.drift.watch(slot, space, *here, left, variances)

    def take_as_moving(self, slot: int) -> None:
        """Take note that an active block moves by itself."""
        if slot in self.drift.standing:
            self.drift.moves(slot, self.rows(slot)[: 2 if self.axes == 1 else 3])

    def _far(self, robot: int, s: Array) -> bool:
        """Return whether inactive blocks are too far from where their error coordinates were left.

        s is the mean of auxiliary states and clones.
        """
        last = self._immediate.last.get(robot)
        if last is None:
            return True
        m = self.active
        return self.drift.is_beyond(m.P, m.x, s, len(self.A0), last, self.n, self._read_with)

    def _read_with(self, rows: Index, first: int) -> Array:
        """Return the stored covariance of rows with those that have auxiliary states, from the `first` of these on."""
        return self._read(rows, self.A0[first:])

    def correct_all(self, robot: int, displaced: Array) -> None:
        """Apply the last correction to all inactive blocks as a dense filter does.

        `robot` displaced auxiliary states and clones by it.  The robots' orientations are cloned as they are now: with
        these the error coordinates of inactive blocks have turned.
        """
        robots, count = list(self.displaced), len(self.A0)
        numbers = [self.active.numbers(self.entered[r]) for r in robots]
        moved = {r: (self._before[at], self.active.x[at]) for r, at in zip(robots, numbers, strict=True)}
        S, U = (D.copy() for D in self._by_robot())
        S[:, robots.index(robot)] -= displaced[:count]
        U[:, robots.index(robot)] -= displaced[count:]
        turns = immediate.world_turns(robot, moved, self._axes)
        self._immediate.add(robots.index(robot), S, U, displaced[:count], displaced[count:], *turns, self._origins())
        k = self._immediate.clone(self.active, {r: self._turn_rows(r) for r in robots})
        self._displaced_x = np.concatenate([self._s_x, self._immediate.numbers])
        self.displaced = {r: np.concatenate([D, np.zeros(k)]) for r, D in self.displaced.items()}
        self.drift.leave(self.active.x, self.active.x[self._s_x])

    # ------------------------------------------------------------------ full updates
    def _progress(self) -> float:
        return self.schedule.progress(self.active.n, len(self.A0), self.n)

    def _full(self, progress: float) -> bool:
        return bool(self.entered) and progress > (1.0 if self._job is None else 2.0)

    def finish(self) -> None:
        """Finish a full update that is under way and free its memory.  A saved map begins from here."""
        self._advance(ALL)
        if self._immediate:
            self.full_update()
            self._advance(ALL)
        self.storage.prefault.clear()
        self._workspace = Workspace(self.storage.prefault)

    def _advance(self, work: float) -> None:
        if self._job is not None:
            self._job.advance(work)
            self._job = None if self._job.done else self._job

    def full_update(self) -> None:
        """End the compression interval: all blocks become inactive, updated by a job that is done in slices."""
        self._advance(ALL)
        m, slots = self.active, list(self.entered)
        A = np.concatenate([NO_ROWS, *(self.rows(slot) for slot in slots)])
        here = np.concatenate([NO_ROWS, *(m.rows(self.entered[slot]) for slot in slots)])
        turns = np.concatenate([self._immediate.rows, *(self._turn_rows(r) for r in self.displaced)])
        index = np.concatenate([here, turns, self._s])
        P = self._workspace.array("P", (len(index), len(index)))
        kernels.copy_submatrix(m.P, index, P)
        n, t = len(here), len(here) + len(turns)
        blocks = -P[t:, t:], P[:n, t:], P[:n, :n], P[n:t, t:], P[n:t, :n], P[n:t, n:t]
        interval = Interval(self.A0, A, *blocks, self._displacements())
        self._job = FullUpdate(self, self.storage, interval, self._workspace)
        for slot in slots:
            at = self.entered[slot]
            self.x[self.numbers(slot)], self.x_first[self.numbers(slot)] = m.mean(at), m.first(at)
        for slot, space in self.departed:
            self._free.setdefault(space.kinds, []).append(slot)
        self._begin()

    # ------------------------------------------------------------------ files
    def _vacant(self) -> dict[int, Space]:
        return super()._vacant() | {slot: Space("removed", space.kinds) for slot, space in self.departed}

    def state(self) -> State:
        """Return the description of the map for a file, a full update finished first."""
        self.finish()
        return super().state() | {
            "postponed": {
                "most": self.most,
                "numbers": self.storage.like.dtype.name,
                "limit_bytes": self.storage.limit_bytes,
                "active": self.active.state(),
                "owners": [[slot, at] for slot, at in self.entered.items()],
                "shadows": [[slot, at] for slot, at in self.auxiliary.items()],
                "gone": [[slot, space.name, list(space.kinds)] for slot, space in self.departed],
                "moved": list(self.displaced),
                "moving": list(self.drift.moving),
                "costs": [self.schedule.begun, self.schedule.paid],
            }
        }

    def arrays(self) -> Iterator[tuple[str, Array]]:
        """Return the arrays for a file by name."""
        yield from super().arrays()
        yield "P", np.concatenate([self.storage.panels[i // PANEL][i % PANEL, : i + 1] for i in range(self.n)])
        for name, array in self.active.arrays():
            yield f"active_{name}", array
        for i, displaced in enumerate(self.displaced.values()):
            yield f"moved{i}", displaced


def _reaching(slots: Index, slot: int) -> Index:
    """Return slots by slots that reach to a slot: twice as many, -1, if need be."""
    return slots if slot < len(slots) else np.concatenate([slots, np.full(max(slot, len(slots)), -1)])
