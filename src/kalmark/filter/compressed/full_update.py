"""The full update of a compressed map: inactive blocks get all corrections of an interval.  docs/compressed.md.

It is a job that can be done in slices, panel by panel from the first.  Until a panel is done, a read of its elements is
corrected by what is still to come; so a slice may have any length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import compiled
from kalmark.filter.compressed import ranks
from kalmark.filter.compressed.immediate import Displacements, transport_mean
from kalmark.filter.compressed.storage import PANEL, Stored, Triangle, subtract
from kalmark.filter.layout import P_AT, P_SIZE, Layout, concatenate_tables
from kalmark.filter.prefault import Prefault

ROWS = 8  # of the active blocks, to write at once
WRITING = 60  # multiplications that take as long as to write a number there
GATHERING = 400  # and as to gather a number from the storage
TOUCHING = 20  # and as to read and write a number of a tile
NO_WIDTHS = np.zeros(0, dtype=np.int64)
MORE = 1.5  # times the memory that a full update has needed: the next one may


@compiled
def fill_rows(panel: Stored, begin: int, end: int, A: Index, where: Index, V: Array, P_AA: Array) -> None:
    """Write the covariances of the active blocks into the rows begin..end of the matrix, all of one panel."""
    first = begin // PANEL * PANEL
    for i in range(begin, end):
        row, own = panel[i - first], where[i]
        if own >= 0:
            for k in range(i // PANEL + 1):
                for j in range(k * PANEL, min(i + 1, (k + 1) * PANEL)):
                    row[j] = V[k, own, j - k * PANEL]
        for c in range(len(A)):
            if A[c] <= i:
                row[A[c]] = V[i // PANEL, c, i % PANEL] if own < 0 else P_AA[own, c]


@compiled
def keep(R: Array, V: Array, rows: Index, w: Array, a: Array, W: Array, P_AB: Array) -> None:
    """Write w and a (N, T), W (N, q) and P_AB (A, N) of so many rows into R and V."""
    T, q = w.shape[1], W.shape[1]
    for k in range(len(rows)):
        row = R[rows[k]]
        for c in range(T):
            row[c], row[T + c] = w[k, c], a[k, c]
        for c in range(q):
            row[2 * T + c] = W[k, c]
    for c in range(len(P_AB)):
        for k in range(len(rows)):
            V[rows[k] // PANEL, c, rows[k] % PANEL] = P_AB[c, k]


@compiled
def signed_factor(R: Array, q: int) -> Array:
    """Return the left factor L of rows R = [w, a, W], W (N, q): L R' = W W' - w a' - a w'."""
    m = (R.shape[1] - q) // 2
    return np.hstack((-R[:, m : 2 * m], -R[:, :m], R[:, 2 * m :]))


@compiled
def update_elements(
    C: Array, rows: Index, columns: Index, done: tuple[int, int], where: Index, R: Array, V: Array, P_AA: Array, q: int
) -> None:  # fmt: skip
    """Bring elements [rows][:, columns] that were read before their panel was done up to date."""
    panel, column = done
    to_come = signed_factor(R[rows], q) @ R[columns].T  # of active rows anything
    for a in range(len(rows)):
        for b in range(len(columns)):
            i, j = max(rows[a], columns[b]), min(rows[a], columns[b])
            if i // PANEL < panel:
                continue
            if where[i] >= 0:
                C[a, b] = P_AA[where[i], where[j]] if where[j] >= 0 else V[j // PANEL, where[i], j % PANEL]
            elif where[j] >= 0:
                C[a, b] = V[i // PANEL, where[j], i % PANEL]
            elif i // PANEL > panel or j >= column:
                C[a, b] -= to_come[a, b]


@dataclass(frozen=True)
class Interval:
    """The result of a compression interval: its rows A0 of the storage and those, A, of its active blocks at the end.

    `Psi` (A0, A0), `Phi` (A, A0) and P_AA as in docs/compressed.md; likewise of the robots' turns, cloned and of now,
    `Phi_T` (T, A0), P_TA and P_TT; and what displaced inactive blocks.
    """

    A0: Index
    A: Index
    Psi: Array
    Phi: Array
    P_AA: Array
    Phi_T: Array
    P_TA: Array
    P_TT: Array
    displacements: Displacements


class Workspace:
    """Memory that one full update leaves to the next: its page faults take longer than all else."""

    def __init__(self, prefault: Prefault) -> None:
        self.prefault = prefault
        self.share = 1.0  # of the columns that a tile of the last full update needed on average
        self._numbers: dict[str, Array] = {}
        self._used: dict[str, int] = {}  # of these, or soon

    def array(self, name: str, shape: tuple[int, ...]) -> Array:
        """Return an array of that shape, holding anything."""
        size, kept = math.prod(shape), self._numbers.get(name)
        if kept is None or len(kept) < size:
            kept = self._numbers[name] = np.empty(4 * size)  # what is not used takes no memory
            self._used[name] = 0
        used, more = max(size, self._used[name]), min(int(MORE * size), len(kept))
        if more > used:
            self.prefault.add(kept, used, more)
            self._used[name] = more
        return kept[:size].reshape(shape)


class FullUpdate:
    """P_BB <- P_BB - W W', P_AB, P_AA and the means, in slices."""

    def __init__(self, map_: Layout, storage: Triangle, interval: Interval, workspace: Workspace) -> None:
        self.map, self.storage, self.interval, self.workspace = map_, storage, interval, workspace
        self.x_before, self.n = map_.x[: map_.x_n].copy(), map_.n
        self.where: Index = np.full(self.n, -1)
        self.where[interval.A] = np.arange(len(interval.A))
        self.known = self.where >= 0
        self.inactive = _in_use(map_, self.n) & (self.where < 0)
        self.L = _root(interval.Psi, storage.diagonal(interval.A0))
        self.rotated = self.n < ranks.FEWEST
        self.q, self.turns = self.L.shape[1], 2 * len(interval.P_TT)
        panels, columns = range(0, self.n, PANEL), self.turns + self.q
        self.R = workspace.array("R", (self.n, columns))
        self.V = workspace.array("V", (len(panels), len(interval.A), PANEL))  # one panel's after the other
        self.rests = np.zeros((len(panels), -(-self.q // ranks.STEP)))
        gaps = np.flatnonzero(~self.inactive & (self.where < 0))
        self.R[gaps] = 0.0
        self.V[gaps // PANEL, :, gaps % PANEL] = 0.0
        self.panel = self.column = self.row = 0
        self.widths, self.costs = NO_WIDTHS, NO_WIDTHS  # of the tiles of the panel; costs are sums
        self.aside = PANEL * len(interval.A0) * (len(interval.A) + self.q + GATHERING)  # to update a panel
        cost = PANEL * (self.turns + workspace.share * self.q + TOUCHING)  # of a column of a panel, in multiplications
        self.work = float(sum(cost * min(k + PANEL, self.n) + self.aside for k in panels))
        self.work += WRITING * int(interval.A.sum())
        self.spent = 0.0
        self._wide = self._tiles = 0  # all widths and all tiles so far

    @property
    def done(self) -> bool:
        """True if nothing is left to do."""
        return self.panel * PANEL >= self.n

    def advance(self, work: float) -> None:
        """Do so much work, in multiplications, at least one step; a panel that needs more is updated later."""
        if work <= 0:
            return
        begun, until = self.spent, self.spent + work
        while self.spent < until and not self.done:
            if self.column == 0 and self.spent > begun and self.spent + self.aside > until:
                return
            self.spent += self._step(until - self.spent)

    def _step(self, work: float) -> int:
        """Update some tiles of a panel or, when it is done, write some rows of the active blocks; return the work."""
        first = self.panel * PANEL
        last = min(first + PANEL, self.n)
        panel = self.storage.panels[self.panel]
        if self.column == last or not self.inactive[first:last].any():
            begin, self.row = self.row, min(self.row + ROWS, last)
            fill_rows(panel, begin, self.row, self.interval.A, self.where, self.V, self.interval.P_AA)
            if self.row == last:
                self._next_panel()
            return WRITING * last * int((self.where[begin : self.row] >= 0).sum())
        if self.column == 0:
            if self._compute_more(first, last):
                return self.aside
            self._find_widths()
        begun = self.column // PANEL
        before = int(self.costs[begun - 1]) if begun else 0
        end = max(begun + 1, int(np.searchsorted(self.costs, before + work, side="right")))
        start, self.column = self.column, min(last, end * PANEL)
        if self.R.shape[1]:
            L = signed_factor(self.R[first:last], self.q)
            subtract(panel[: last - first], L, self.R, start, self.column, self.turns + self.widths)
        return int(self.costs[end - 1]) - before

    def _find_widths(self) -> None:
        self.widths = ranks.widths_of(self.rests, self.panel, self.q, ranks.EXACT)
        self.costs = np.cumsum(PANEL * PANEL * (self.turns + self.widths + TOUCHING))
        self._wide, self._tiles = self._wide + int(self.widths.sum()), self._tiles + len(self.widths)

    def _next_panel(self) -> None:
        self.panel, self.column = self.panel + 1, 0
        if self.done and self._tiles:
            self.workspace.share = self._wide / (self._tiles * max(1, self.q))

    def read(self, rows: Index, columns: Index) -> Array:
        """Return elements as they will be when all is done; all rows must be known."""
        C = self.storage.get(rows, columns)
        if not self.done:
            done = self.panel, self.column
            update_elements(C, rows, columns, done, self.where, self.R, self.V, self.interval.P_AA, self.q)
        return C

    def know(self, slots: Index) -> None:
        """Bring the means of blocks (K,) up to date and make their elements readable."""
        rows = self.map.blocks[slots, P_AT]
        here = rows < self.n
        unknown = slots[here][~self.known[rows[here]]]
        if len(unknown):
            self._compute(unknown)

    def _compute_more(self, first: int, last: int) -> bool:
        """Enter the inactive blocks among the rows first..last; return whether any were missing."""
        slots = np.arange(*np.searchsorted(self.map.blocks[:, P_AT], [first, last]))
        unknown = slots[~self.known[self.map.blocks[slots, P_AT]]]
        if len(unknown):
            self._compute(unknown)
        return len(unknown) > 0

    def _compute(self, slots: Index) -> None:
        """Work out the means of some blocks, their rows of R = [w, a, W], and their covariances V with A."""
        if not self.rotated:
            self._rotate()
        p = self.interval
        _, atoms, numbers, rows = concatenate_tables(self.map.blocks[slots], self.map.atoms)
        G = self.storage.get(rows, p.A0)
        x, _, a = transport_mean(atoms, self.x_before[numbers], G, *p.displacements)
        W, w = G @ self.L, G @ p.Phi_T.T + a @ (0.5 * p.P_TT)
        keep(self.R, self.V, rows, w, a, W, p.Phi @ G.T + p.P_TA.T @ a.T)
        ranks.add_rests(self.rests, rows // PANEL, W, self.storage.diagonal(rows))
        self.known[rows] = True
        self.map.x[numbers] = x

    def _rotate(self) -> None:
        """Make far rows short, by a sample of the inactive blocks as they are stored."""
        self.rotated, inactive = True, np.flatnonzero(self.inactive)
        if len(inactive) < ranks.SAMPLE or self.q <= ranks.ROUGH:
            return
        rows = inactive[np.linspace(0, len(inactive) - 1, ranks.SAMPLE).astype(np.int64)]
        variances = self.storage.diagonal(rows)
        rows, variances = rows[variances > 0.0], variances[variances > 0.0]
        W = self.storage.get(rows, self.interval.A0) @ self.L / np.sqrt(variances)[:, None]
        self.L = ranks.rotate_factor(self.L, W)


def _in_use(map_: Layout, n: int) -> Flags:
    """Return which of the rows belong to blocks: none lies in two panels, which leaves some over."""
    first, sizes = map_.blocks[:, P_AT], map_.blocks[:, P_SIZE]
    edges = np.bincount(first, minlength=n + 1) - np.bincount(first + sizes, minlength=n + 1)
    return np.cumsum(edges[:n]) > 0


def _root(Psi: Array, variances: Array) -> Array:
    """Return L (n, rank) with L L' = Psi, by pivoted Cholesky of Psi in units of the blocks' sigmas."""
    from scipy.linalg.lapack import dpstrf

    sigma = np.sqrt(np.maximum(variances, 0.0))
    scaled = Psi * sigma[:, None] * sigma
    if not len(Psi) or not scaled.any():
        return np.zeros((len(Psi), 0))
    c, pivots, rank, _ = dpstrf(scaled, lower=1, tol=1e-15 * scaled.diagonal().max())
    L = np.zeros((len(Psi), rank))
    L[pivots - 1] = np.tril(c)[:, :rank]
    known = sigma > 0
    L[known] /= sigma[known, None]
    return L
