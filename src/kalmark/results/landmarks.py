"""The map a run ends with, and ``landmarks.csv``."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.errors import RunError
from kalmark.results.history import as_id
from kalmark.slam.events import Id

if TYPE_CHECKING:
    from kalmark.slam.report import LandmarkTable

Array = npt.NDArray[np.float64]

_AXES = {"point_signature": ("x_m", "y_m", "signature")}
_POINT = ("x_m", "y_m", "z_m")


@dataclass(frozen=True)
class MapLandmarks:
    """The landmarks of a map: ids, kinds, means, covariances and how often each was observed."""

    ids: list[Id]
    kinds: list[str]
    means: list[Array]
    covariances: list[Array]
    observations: list[int]

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def of(cls, table: LandmarkTable) -> MapLandmarks:
        """Return a copy of the table that `slam.landmarks()` gives."""
        return cls(
            list(table.ids),
            list(table.kinds),
            [np.array(mean, dtype=np.float64) for mean in table.means],
            [np.array(cov, dtype=np.float64) for cov in table.covariances],
            [int(count) for count in table.observations],
        )

    def positions(self) -> tuple[Array, Array]:
        """Return the positions in the plane (K, 2) and their covariances (K, 2, 2)."""
        means = np.array([mean[:2] for mean in self.means]).reshape(-1, 2)
        return means, np.array([cov[:2, :2] for cov in self.covariances]).reshape(-1, 2, 2)

    def to_csv(self) -> str:
        """Return the text of ``landmarks.csv``: id, kind, coordinates, triangle of the covariance, observations."""
        axes = [_axes(kind, len(mean)) for kind, mean in zip(self.kinds, self.means, strict=True)]
        columns = list(dict.fromkeys(name for names in axes for name in names)) or ["x_m", "y_m"]
        pairs = list(combinations_with_replacement(columns, 2))
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["id", "kind", *columns, *(_cov_name(a, b) for a, b in pairs), "observations"])
        for i, names in enumerate(axes):
            at = {name: j for j, name in enumerate(names)}
            mean = [repr(float(self.means[i][at[name]])) if name in at else "" for name in columns]
            cov = [repr(float(self.covariances[i][at[a], at[b]])) if a in at and b in at else "" for a, b in pairs]
            writer.writerow([self.ids[i], self.kinds[i], *mean, *cov, self.observations[i]])
        return out.getvalue()

    @classmethod
    def read(cls, path: Path) -> MapLandmarks:
        """Read a ``landmarks.csv``.  Raises RunError naming file and line."""
        table = cls([], [], [], [], [])
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            for number, row in enumerate(rows, start=2):
                try:
                    table._append(row)
                except (KeyError, TypeError, ValueError) as error:
                    raise RunError(f"{path}:{number}: not a row of a landmark table: {error}") from None
        return table

    def _append(self, row: dict[str, str]) -> None:
        names = [name for name in (*_POINT, "signature") if row.get(name)]
        cov = np.empty((len(names), len(names)))
        for (i, a), (j, b) in combinations_with_replacement(enumerate(names), 2):
            cov[i, j] = cov[j, i] = float(row[_cov_name(a, b)])
        self.ids.append(as_id(row["id"]))
        self.kinds.append(row["kind"])
        self.means.append(np.array([float(row[name]) for name in names]))
        self.covariances.append(cov)
        self.observations.append(int(row["observations"]))


def _axes(kind: str, d: int) -> tuple[str, ...]:
    return _AXES.get(kind, _POINT)[:d]


def _cov_name(a: str, b: str) -> str:
    return f"cov_{a[0]}{b[0]}"
