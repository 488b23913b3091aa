"""Stand-ins of what an association is handed: positions (K, 2) in the plane, the robot's position error common to all.

An observation at v of a landmark at l has the innovation z = v - l, and all of a scan Z = S x 11' + I x R.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index


class Points:
    """Observations v (K, 2) of landmarks l (L, 2): the common variance S and the noise R of each, in m^2."""

    def __init__(self, v: Any, l: Any, S: float = 0.25, R: float = 1e-4, density: float = 0.05) -> None:
        self.v, self.l, self.S, self.R, self.density = np.array(v, float), np.array(l, float), S, R, density

    def innovation(self, rows: Any, columns: Any) -> tuple[Array, Array]:
        """Return z (M, 2) and Z (2 M, 2 M) of pairs."""
        common = np.tile(self.S * np.eye(2), (len(rows), len(rows)))
        return self.v[rows] - self.l[columns], common + self.R * np.eye(2 * len(rows))

    def fit(self, rows: Any, columns: Any) -> tuple[float, float]:
        """Return the joint d2 and log |Z| of pairs."""
        z, Z = self.innovation(rows, columns)
        return (
            (float(z.ravel() @ np.linalg.solve(Z, z.ravel())), float(np.linalg.slogdet(Z)[1])) if len(z) else (0.0, 0.0)
        )

    def distances(self) -> Array:
        """Return the squared distance (K, L) of each pair by itself."""
        return np.array([[self.fit([k], [l])[0] for l in range(len(self.l))] for k in range(len(self.v))])

    def places(self) -> tuple[Array, Array, Array, Array]:
        """Return the observations, the landmarks, and covariances of both."""
        return self.v, np.tile(self.R * np.eye(2), (len(self.v), 1, 1)), self.l, 1e-12 * np.eye(2 * len(self.l))

    def log_density(self, rows: Any) -> Array:
        """Return the logarithm of the density of landmarks."""
        return np.full(len(rows), np.log(self.density))

    def log_volume_ratio(self, rows: Any, columns: Any) -> Array:
        """Return log |Z| / |R| of each pair."""
        return np.full(len(rows), 2.0 * np.log((self.S + self.R) / self.R))


class Asked:
    """A query that answers from `Points`, with ids of observations and names of landmarks."""

    def __init__(self, points: Points, names: list[Any], ids: Any = None, adrift: bool = False) -> None:
        self.points, self.names, self.y = points, names, points.v
        self.ids = (None,) * len(points.v) if ids is None else ids
        tracks = SimpleNamespace(confirmed=names, known=())
        self.scan = SimpleNamespace(adrift=adrift, dimensions=2, tracks=tracks)
        self.reobserved = self.time = 0.0

    def dof(self) -> int:
        """Return the size of an innovation."""
        return 2

    def key(self) -> tuple[int, ...]:
        """Return the number of the scan."""
        return (int(self.time),)

    def experience(self) -> float:
        """Return that no observation was of landmarks just seen."""
        return 0.0

    def count_reobserved(self, again: float) -> None:
        """Keep the count."""
        self.reobserved = again

    def nearest(self, nearest: int, farther: float, gate: float) -> None:
        """Return that the other questions have to be asked."""

    def candidates(self, nearest: int = 4, farther: float = 10.0) -> list[Any]:
        """Return all landmarks."""
        return [*self.names]

    def distances(self, candidates: list[Any]) -> Array:
        """Return d2 (K, L) from these landmarks."""
        return self.points.distances()[:, [self.names.index(name) for name in candidates]]

    def class_distances(self, names: list[Any]) -> Array:
        """Return that no class is reported."""
        return np.zeros((len(self.y), len(names)))

    def jointly(self, rows: Index, names: list[Any]) -> tuple[Array, Array]:
        """Return z (M, 2) and Z (2 M, 2 M) of pairs."""
        return self.points.innovation(rows, [self.names.index(name) for name in names])

    def together(self, names: list[Any]) -> Points:
        """Return the landmarks of these names."""
        of = self.points
        return Points(of.v, of.l[[self.names.index(name) for name in names]], of.S, of.R, of.density)
