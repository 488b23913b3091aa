"""The postponed map: an exact EKF whose ordinary step does not grow with the map.  docs/postponed.md.

Blocks in view now or lately are active; they live in a small dense map, which any estimator corrects as it stands.  For
each block that came there from the rest, the dense map also holds its *shadow*: numbers s, zero at first, with

    P_As = Phi,   P_ss = -Psi,   x_s = theta,      Phi = 1, Psi = 0, theta = 0 at the last flush.

Predicting, correcting and transporting treat shadows like any other scalars, which is all that a block B at rest needs:
x_B = x0_B + P0_BA theta, P_BA = P0_BA Phi', P_BB = P0_BB - P0_BA Psi P0_AB.  A block enters by being augmented from the
shadows.  When the dense map has grown too large, a flush writes everything back.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.filter import kernels, leap
from kalmark.filter.drift import Drift
from kalmark.filter.flush import Flush, Phase, Room
from kalmark.filter.map import P_AT, Layout, StochasticMap
from kalmark.filter.pace import SLICE, USING, Pace
from kalmark.filter.reading import excerpt, joint, places, resting
from kalmark.filter.storage import PANEL, Triangle
from kalmark.geometry.spaces import RHO, Rn, Space, Table

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

NO_ROWS = np.zeros(0, dtype=np.int64)
scalars = lru_cache(maxsize=64)(Rn)


class PostponedMap(Layout):
    """The joint Gaussian of all blocks, of which a few are active and the others at rest.

    Slots are the same for a whole life.  `index` and `predict` speak of rows of the active map: an index holds until
    the next correction.  `most` limits the rows of the active map, shadows included; by default a phase ends when its
    corrections have cost more than its flush.
    """

    def __init__(self, storage: Triangle | None = None, most: int | None = None) -> None:
        self.active = StochasticMap()
        self.storage = storage or Triangle()
        self.most = most
        self.phase = 0  # number of flushes
        self._at: Index = np.full(64, -1)  # slot in the active map, -1 at rest
        self._slot_of: Index = np.full(64, -1)  # by slots in the active map, -1 for shadows
        self._job: Flush | None = None
        self._room = Room(self.storage.fresh)
        self._anchored: set[int] = set()  # blocks with inverse distances
        super().__init__()
        self._begin()

    def _begin(self) -> None:
        """Begin a phase: nothing is active."""
        self.phase += 1
        self.active.reset()
        self._at[:] = self._slot_of[:] = -1
        self._owners: dict[int, int] = {}  # slots in the active map by slot
        self._A0: Index = NO_ROWS  # rows of the storage that have shadows,
        self._s: Index = NO_ROWS  # their shadows' rows in the active map,
        self._s_x: Index = NO_ROWS  # and their numbers
        self._shadows: dict[int, int] = {}  # slots in the active map, by slot: in the order of A0
        self._gone: list[tuple[int, Space]] = []  # removed, their shadows are still here
        self._moved: dict[int, Array] = {}  # what each robot's corrections made of the shadows and of these turns
        self._turns: dict[tuple[int, int], Index] = {}  # and the rows of what turned the world with them
        self._drift, self._pace, self._points = Drift(), Pace(self.most), leap.Points()
        self._leaps, self._before = leap.Leaps(), dict[int, Array]()

    @classmethod
    def from_dense(cls, dense: StochasticMap, storage: Triangle | None = None, most: int | None = None) -> PostponedMap:
        """Return a dense map as a postponed one; slots stay what they are."""
        m = cls(storage, most)
        removed = {slot: kinds for kinds, slots in dense._free.items() for slot in slots}
        spaces = [Space("removed", removed[i]) if space is None else space for i, space in enumerate(dense.spaces)]
        for space in spaces:
            m._place(space, np.zeros(space.size))
        rows, old = (np.concatenate([each.rows(i) for i in range(len(spaces))]) for each in (m, dense))
        m.storage.put(rows, rows, kernels.submatrix(dense.P, old))
        m.x[: m.x_n], m.x_first[: m.x_n], m.axes = dense.x[: m.x_n], dense.x_first[: m.x_n], dense.axes
        for slot in removed:  # in the order in which they were removed
            m._vacate(slot)
        return m

    # ------------------------------------------------------------------ reading
    def index(self, slot: int) -> Index:
        """Return the rows of a block in the active map, which it enters if need be."""
        self._enter(slot)
        return self.active.rows(self._owners[slot])

    def mean(self, slot: int) -> Array:
        """Return a copy of a block's mean."""
        at = self._owners.get(slot)
        return self.active.mean(at) if at is not None else resting(self, np.array([slot])).x

    def first(self, slot: int) -> Array:
        """Return a copy of a block's first estimate, of a robot its last predicted one."""
        at = self._owners.get(slot)
        return self.active.first(at) if at is not None else self.x_first[self.numbers(slot)].copy()

    def covariance(self, slots: Sequence[int]) -> Array:
        """Return the joint covariance of blocks, in the order given.  Blocks at rest stay there."""
        return joint(self, slots)

    def means(self, slots: Index, d: int) -> Array:
        """Return the first d numbers (K, d) of blocks."""
        rest, out = self.is_at_rest(slots), np.empty((len(slots), d))
        out[~rest] = self.active.means(self._at[slots[~rest]], d)
        if rest.any():
            out[rest] = places(self, slots[rest], d)
        return out

    def awake(self) -> tuple[Array, Table, Index]:
        """Return the means of the active blocks, these, and their slots, -1 for shadows."""
        return self.active.x, self.active.blocks, self._slot_of[: len(self.active.blocks)]

    def is_at_rest(self, slots: Index) -> npt.NDArray[np.bool_]:
        """Tell which blocks (K,) are not active."""
        return self._at[slots] < 0

    def excerpt(self, robot: int, mount: int, slots: Index) -> tuple[StochasticMap, int, int, Index]:
        """Return a dense map to read these blocks from, and their slots there; blocks at rest stay there."""
        return excerpt(self, robot, mount, slots)

    def _resting_rows(self) -> Index:
        """Return the rows of the active map that blocks at rest depend on: the shadows and all turns."""
        return np.concatenate([self._s, self._leaps.rows, *(self._turn_rows(robot) for robot in self._moved)])

    @property
    def _axes(self) -> int:
        """The axes of the turns in this phase: those of its leaps, or of all blocks."""
        return self._leaps.axes or self.axes

    def _turn_rows(self, robot: int) -> Index:
        """Return the rows of what turns the world with a robot: of its orientation, or its whole pose."""
        rows = self._turns.get((robot, self._axes))
        if rows is None:
            last = int(self.active.blocks[self._owners[robot], P_AT]) + (3 if self._axes == 1 else 6)
            rows = self._turns[robot, self._axes] = np.arange(last - self._axes, last)
        return rows

    def _read(self, rows: Index, columns: Index) -> Array:
        return self.storage.get(rows, columns) if self._job is None else self._job.read(rows, columns)

    def _displacements(self) -> tuple[Array, Array]:
        """Return the parts (A0, R) and (T, R) that each robot's corrections have in the shadows and the kept turns."""
        moved = list(self._moved.values()) or [self.active.x[self._s_x]]
        D = moved[0][:, None] if len(moved) == 1 else np.column_stack(moved)
        return D[: len(self._A0)], D[len(self._A0) :]

    def _way(self) -> leap.Way:
        """Return how blocks at rest have come to where they are; without transport nothing turns."""
        return self._leaps.way(*self._displacements(), self._axes if self._moved else 0, self._stand())

    def _stand(self) -> Array:
        """Return where the robots stand (R, 3)."""
        m, robots = self.active, [self._owners[robot] for robot in self._moved]
        return np.concatenate([m.x[m.numbers(at)][:3] for at in robots] or [np.zeros(3)]).reshape(-1, 3)

    # ------------------------------------------------------------------ growing and shrinking
    def add(self, space: Space, mean: Any, cov: Any = None) -> int:
        """Add a block that is independent of all others (`cov` None: known exactly); return its slot.

        An index from before holds no longer.
        """
        if self._full():
            self.flush()
        mean = np.asarray(mean, dtype=np.float64)
        slot = self._place(space, mean)
        self._activate(slot, self.active.add(space, mean, cov))
        return slot

    def augment(self, space: Space, mean: Array, index: Index, G: Array, Q: Array) -> int:
        """Add a block computed from the rows `index`: P_Lx = G P_x, P_LL = G P G' + Q.  [S] (35)-(38)."""
        slot = self._place(space, mean)
        self._activate(slot, self.active.augment(space, mean, index, G, Q))
        if self._full():
            self.flush()
        return slot

    def remove(self, slot: int) -> None:
        """Marginalise a block out; its slot is free for another of its shape, once no shadow of it is left."""
        if slot in self._owners:
            at = self._owners.pop(slot)
            self.active.remove(at)
            self._at[slot] = self._slot_of[at] = -1
            self._drift.forget(slot)
            self._points.look_again()
        space = self.spaces[slot]
        assert space is not None
        self._vacate(slot)
        if slot in self._shadows:
            self._free[space.kinds].remove(slot)
            self._gone.append((slot, space))

    def _place(self, space: Space, mean: Array) -> int:
        slot = super()._place(space, mean)
        if RHO in space.kinds:
            self._anchored.add(slot)
        return slot

    def _vacate(self, slot: int) -> None:
        super()._vacate(slot)
        self._anchored.discard(slot)

    def _activate(self, slot: int, at: int) -> None:
        self._owners[slot] = self._at[slot] = at
        self._slot_of = _reaching(self._slot_of, at)
        self._slot_of[at] = slot
        self.active.axes = self.axes
        self._points.look_again()

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
        self._enter(slot)
        self.active.set_predicted(self._owners[slot], mean)
        if self._drift.stands(slot):
            self.take_as_moving(slot)

    # ------------------------------------------------------------------ correcting
    def opened(self, robot: int, mount: int, slots: Index, transports: bool) -> tuple[StochasticMap, int, int, Index]:
        """Return the dense map on which a scan of these blocks is fused, and their slots there: all have entered.

        So have all inverse distances where a correction transports: theirs is more than the turn of the world.
        """
        if self._full():
            self.flush()
        for slot in self._anchored if transports else ():
            self._enter(slot)
        self._enter(robot)
        if mount >= 0:
            self._enter(mount)
        at = self._at[slots]
        if -1 in at.tolist():
            for slot in slots.tolist():
                self._enter(slot)
            at = self._at[slots]
        self._before = {r: self.active.mean(self._owners[r]) for r in dict.fromkeys((*self._moved, robot))}
        return self.active, self._owners[robot], self._owners.get(mount, -1), at

    def corrected(self, robot: int, transports: bool) -> None:
        """Take note that `robot` has corrected what `opened` returned, transporting its covariance or not."""
        m = self.active
        if transports and len(self._A0):
            s, before = m.x[np.concatenate([self._s_x, self._leaps.numbers])], self._moved.get(robot, 0.0)
            others = [moved for other, moved in self._moved.items() if other != robot]
            self._moved[robot] = now = s - sum(others) if others else s
            rests = len(self._owners) < self.used
            if rests and (self._far(robot) or self._points.parted(m, self._owners[robot], self._before[robot])):
                self.leap(robot, now - before)
            if len(self._leaps.rows) >= leap.most(self.n):
                self._go_on(SLICE)
                if self._job is None:
                    self.flush()
        self._pace.count(m.n)
        used = m.prepare() or self.storage.fresh.use_some()
        if (job := self._job) is not None:
            self._go_on(self._pace.due(self._progress(), job.spent, job.work) - USING * used)

    def _enter(self, slot: int) -> None:
        """Make a block active: augment it from the shadows, and give it a shadow of its own.  O(active^2)."""
        if slot in self._owners:
            return
        space = self.spaces[slot]
        assert space is not None
        now = resting(self, np.array([slot]))
        if len(self._A0):
            at = self.active.augment(space, now.x, self._resting_rows(), now.G, now.Q)
        else:
            at = self.active.add(space, now.x, now.Q)
        self.active.x_first[self.active.numbers(at)] = self.x_first[self.numbers(slot)]
        self._activate(slot, at)
        rows = self.active.rows(at)
        shadow = self.active.add(scalars(len(rows)), np.zeros(len(rows)))
        s = self.active.rows(shadow)
        self.active.P[np.maximum(rows, s), np.minimum(rows, s)] = 1.0
        for name, moved in self._moved.items():
            self._moved[name] = np.insert(moved, len(self._A0), np.zeros(len(s)))
        self.cast_shadow(slot, shadow)
        self.look_after(slot, now.x_left)

    def cast_shadow(self, slot: int, at: int) -> None:
        """Take a block of the active map as the shadow of a slot."""
        self._shadows[slot] = at
        where = self.active.numbers(at)
        self._A0 = np.concatenate([self._A0, self.rows(slot)])
        self._s = np.concatenate([self._s, self.active.rows(at)])
        self._s_x = np.concatenate([self._s_x, np.arange(where.start, where.stop)])

    def look_after(self, slot: int, left: Array) -> None:
        """Watch how far an active block with a shadow goes from where the coordinates of errors at rest were left."""
        space, at = self.spaces[slot], self._owners.get(slot)
        if space is not None and at is not None:
            rows = self.rows(slot)
            variances = np.diag(self._read(rows, rows))
            here = self.active.numbers(at).start, int(self.active.rows(at)[0])
            self._drift.watch(slot, space, *here, left, variances)

    def take_as_moving(self, slot: int) -> None:
        """Take note that an active block moves by itself."""
        self._drift.moves(slot, self.rows(slot)[: 2 if self.axes == 1 else 3])

    def _far(self, robot: int) -> bool:
        """Return whether the rest has moved too far for the coordinates in which its errors were left."""
        if robot not in self._leaps.last:
            return True
        m, (kept, kept_x) = self.active, self._leaps.last[robot]
        s, turn = m.x[self._s_x], self._turn_rows(robot)[-len(kept) :]
        read = lambda rows, i: self._read(rows, self._A0[i:])  # noqa: E731
        return self._drift.is_beyond(m.P, turn, kept, m.x, kept_x, s, self.n, read)

    def leap(self, robot: int, moved: Array) -> None:
        """Apply the last correction, by which `robot` `moved` shadows and turns, to all at rest as a dense filter does.

        The robots' turns are kept as they are now: by these the coordinates of errors at rest have turned.
        """
        robots, count = list(self._moved), len(self._A0)
        went = {r: (self._before[r], self.active.mean(self._owners[r])) for r in robots}
        S, U = (D.copy() for D in self._displacements())
        S[:, robots.index(robot)] -= moved[:count]
        U[:, robots.index(robot)] -= moved[count:]
        how = leap.turns_of(robot, went, self._axes)
        self._leaps.add(robots.index(robot), S, U, moved[:count], moved[count:], *how, self._stand())
        k = self._leaps.keep(self.active, {r: self._turn_rows(r) for r in robots})
        self._moved = {r: np.concatenate([D, np.zeros(k)]) for r, D in self._moved.items()}
        self._drift.leave(self.active.x, self.active.x[self._s_x])

    # ------------------------------------------------------------------ flushing
    def _progress(self) -> float:
        return self._pace.progress(self.active.n, len(self._A0), self.n)

    def _full(self) -> bool:
        return bool(self._owners) and self._progress() > (1.0 if self._job is None else 2.0)

    def finish(self) -> None:
        """Finish a flush that is under way, and give back the memory that it needed.  A saved map begins from here."""
        self._complete()
        if self._leaps:
            self.flush()
            self._complete()
        self.storage.fresh.forget()
        self._room = Room(self.storage.fresh)

    def _go_on(self, work: float) -> None:
        if self._job is not None:
            self._job.advance(work)
            self._job = None if self._job.done else self._job

    def _complete(self) -> None:
        self._go_on(1e300)

    def flush(self) -> None:
        """Bring all blocks to rest."""
        self._complete()
        m, slots = self.active, list(self._owners)
        A = np.concatenate([NO_ROWS, *(self.rows(slot) for slot in slots)])
        here = np.concatenate([NO_ROWS, *(m.rows(self._owners[slot]) for slot in slots)])
        turns = np.concatenate([self._leaps.rows, *(self._turn_rows(r) for r in self._moved)])
        index = np.concatenate([here, turns, self._s])
        P = self._room.array("P", (len(index), len(index)))
        kernels.copy_submatrix(m.P, index, P)
        n, t = len(here), len(here) + len(turns)
        phase = Phase(
            self._A0, A, -P[t:, t:], P[:n, t:], P[:n, :n], P[n:t, t:], P[n:t, :n], P[n:t, n:t], self._way()
        )  # fmt: skip
        self._job = Flush(self, self.storage, phase, self._room)
        for slot in slots:
            at = self._owners[slot]
            self.x[self.numbers(slot)], self.x_first[self.numbers(slot)] = m.mean(at), m.first(at)
        for slot, space in self._gone:
            self._free.setdefault(space.kinds, []).append(slot)
        self._begin()


def _reaching(slots: Index, slot: int) -> Index:
    """Return slots by slots that reach to a slot: twice as many, -1, if need be."""
    return slots if slot < len(slots) else np.concatenate([slots, np.full(max(slot, len(slots)), -1)])
