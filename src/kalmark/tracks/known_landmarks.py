"""Landmarks known exactly: outside the map, so that neither a step nor the memory depends on how many there are.

Those of one kind are rows of one array.  The few near a place are found in a tree that is built once.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.filter.nearest_blocks import has_place
from kalmark.geometry.landmark_density import NEIGHBOURS, log_density
from kalmark.models.protocols import Landmark, Segmented, place_of

if TYPE_CHECKING:
    from kalmark.tracks.channel import ObservationModel

FEWEST = 16  # rows of a new array


class Known:
    """The landmarks of one kind: `names` in order, their `values` (N, n), and how often each was used."""

    model: Landmark
    names: list[Id]
    _l: Array
    _counts: Index

    def __init__(self, model: Landmark) -> None:
        self.model, self.names = model, []
        self._l, self._counts = np.zeros((FEWEST, model.space.size)), np.zeros(FEWEST, dtype=np.int64)
        self._forget()

    def restored(self) -> None:
        """Check the arrays of a file.  Raises MapError."""
        rows = len(self._counts)
        if rows < max(len(self.names), 1) or self._l.shape != (rows, self.model.space.size):
            raise MapError(f"the values of {len(self.names)} known landmarks are {self._l.shape}")
        self._forget()

    def _forget(self) -> None:
        """Clear what was computed of all of them."""
        self._tree: Any = None
        self._places: Array | None = None
        self._sorted: tuple[float, Array, Index] | None = None
        self._density: float | None = None

    @property
    def values(self) -> Array:
        """Their numbers (N, n)."""
        return self._l[: len(self.names)]

    @property
    def counts(self) -> Index:
        """Number of used observations of each (N,)."""
        return self._counts[: len(self.names)]

    def add(self, name: Id, mean: Array) -> int:
        """Add one; return its row."""
        row = len(self.names)
        if row == len(self._l):
            self._l = np.concatenate([self._l, np.zeros_like(self._l)])
            self._counts = np.concatenate([self._counts, np.zeros_like(self._counts)])
        self.names.append(name)
        self._l[row], self._counts[row] = mean, 0
        self._forget()
        return row

    def remove(self, row: int) -> None:
        """Remove one: the last takes its row."""
        last = len(self.names) - 1
        self.names[row], self._l[row], self._counts[row] = self.names[last], self._l[last], self._counts[last]
        self.names.pop()
        self._forget()

    def places(self) -> Array:
        """Return where they are (N, 2 or 3), NaN where their model has no position."""
        if self._places is None:
            placed = place_of(self.model, self.values) if len(self.names) else None
            d = 2 if self.model.space.world == "plane" else 3
            self._places = np.full((len(self.names), d), np.nan) if placed is None else placed[0][:, :d]
        return self._places

    def tree(self) -> Any:
        """Return the tree of their places."""
        if self._tree is None:
            from scipy.spatial import cKDTree

            self._tree = cKDTree(self.places())
        return self._tree

    def pairs(self, low: float, high: float, most: int) -> Index:
        """Return the rows (M, 2) of landmarks that are so far apart; those up to a distance are found once.

        Of a map with more than `most` pairs within `high`, none.
        """
        if self._sorted is None or self._sorted[0] < high:
            reach = 1.25 * high
            if self.tree().count_neighbors(self.tree(), reach) > 2 * most + len(self.names):
                return np.zeros((0, 2), dtype=np.int64)
            rows = self.tree().query_pairs(reach, output_type="ndarray")
            apart = np.linalg.norm(self.places()[rows[:, 0]] - self.places()[rows[:, 1]], axis=1)
            order = np.argsort(apart, kind="stable")
            self._sorted = reach, apart[order], rows[order]
        _, apart, rows = self._sorted
        first, last = np.searchsorted(apart, (low, high))
        found: Index = rows[first:last]
        return found

    def density(self) -> float:
        """Return how many landmarks of the plane there are per m^2 about one of them: the median."""
        if self._density is None:
            gaps = self.tree().query(self.places(), k=min(NEIGHBOURS + 1, len(self.names)))[0]
            others = gaps.reshape(len(self.names), -1)[:, 1:]
            self._density = float(np.exp(np.median(log_density(others, np.inf, 2))))
        return self._density

    def gaps(self, p: Array, count: int) -> Array:
        """Return the distances (C,) of the `count` landmarks nearest to that at p (2 or 3,), the least first."""
        if len(self.names) < 2:
            return np.zeros(0)
        found: Array = self.tree().query(p, k=min(count + 1, len(self.names)))[0][1:]
        return found

    def within(self, p: Array, reach: float) -> list[int]:
        """Return the rows of those within so many m of p (2 or 3,), in order; of kinds without a place all."""
        if not np.isfinite(reach) or not has_place(self.model.space):
            return [*range(len(self.names))]
        return sorted(self.tree().query_ball_point(p, reach)) if self.names else []

    def nearest(self, p: Array, count: int) -> Index:
        """Return the rows (R,) of those that are among the `count` nearest of any place p (K, 2 or 3)."""
        if not len(self.names) or not len(p) or not has_place(self.model.space):
            return np.zeros(0, dtype=np.int64)
        _, rows = self.tree().query(p[np.isfinite(p).all(axis=1)], k=min(count, len(self.names)))
        return np.unique(np.atleast_1d(rows)).astype(np.int64)


class KnownLandmarks:
    """All landmarks known exactly, by name; `changes` counts those that have come or gone."""

    of_kind: dict[str, Known]
    changes: int

    def __init__(self) -> None:
        self.of_kind, self.changes = {}, 0
        self.restored()

    def restored(self) -> None:
        """Find the rows of all names.  Raises MapError where one is there twice."""
        self._at = {name: (kind, row) for kind, of in self.of_kind.items() for row, name in enumerate(of.names)}
        if len(self._at) < sum(len(of.names) for of in self.of_kind.values()):
            raise MapError("a landmark known exactly is there twice, expected each name once")

    def __len__(self) -> int:
        return len(self._at)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, Hashable) and name in self._at

    def __iter__(self) -> Iterator[Id]:
        return iter(self._at)

    def add(self, name: Id, model: Landmark, mean: Array) -> None:
        """Add a landmark of a new name."""
        self._at[name] = model.kind, self.of_kind.setdefault(model.kind, Known(model)).add(name, mean)
        self.changes += 1

    def remove(self, name: Id) -> None:
        """Remove a landmark."""
        kind, row = self._at.pop(name)
        of = self.of_kind[kind]
        of.remove(row)
        if row < len(of.names):
            self._at[of.names[row]] = kind, row
        self.changes += 1

    def kind(self, name: Any) -> str | None:
        """Return the kind of a landmark, None if it is not among them."""
        at = self._at.get(name)
        return None if at is None else at[0]

    def model(self, name: Id) -> Landmark:
        """Return the model of a landmark."""
        return self.of_kind[self._at[name][0]].model

    def mean(self, name: Id) -> Array:
        """Return a copy of the numbers (n,) of a landmark."""
        kind, row = self._at[name]
        return self.of_kind[kind].values[row].copy()

    def means(self, names: Iterable[Id], d: int) -> Array:
        """Return the first d numbers (K, d) of landmarks, which may be of several kinds."""
        return np.array([self.mean(name)[:d] for name in names])

    def observations(self, name: Id) -> int:
        """Return how many observations of a landmark were used."""
        kind, row = self._at[name]
        return int(self.of_kind[kind].counts[row])

    def count(self, names: Iterable[Id], used: Iterable[bool]) -> None:
        """Count the observations that were used, each at its landmark."""
        for name, fused in zip(names, used, strict=True):
            if fused:
                kind, row = self._at[name]
                self.of_kind[kind].counts[row] += 1

    def extent(self, name: Id) -> Array | None:
        """Return the abscissas (2,) of the ends of a line, None of what is no line."""
        model = self.model(name)
        return np.array(model.first_ends, dtype=np.float64) if isinstance(model, Segmented) else None

    def near(self, models: dict[str, ObservationModel], p: Array, count: int) -> list[Id]:
        """Return those that a sensor of these models observes, the `count` nearest to each place p (K, 2 or 3)."""
        of = [known for kind, known in self.of_kind.items() if kind in models]
        return [known.names[row] for known in of for row in known.nearest(p, count).tolist()]
