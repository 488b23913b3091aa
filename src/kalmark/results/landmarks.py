"""The map a run ends with, and ``landmarks.csv``."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.declare import is_own
from kalmark.errors import KalmarkError, RunError
from kalmark.events import Id
from kalmark.geometry.spaces import SCALAR, VECTOR, VECTOR3
from kalmark.results.columns import padded_all
from kalmark.results.history import as_id
from kalmark.results.shapes import LINE, POINT, TAG, place

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]

_PLANE = {"point_signature": ("x_m", "y_m", "signature")}
_POINT = ("x_m", "y_m", "z_m")
_LINE = (*_POINT, "x2_m", "y2_m", "z2_m")
_TAG = (*_POINT, "qx", "qy", "qz", "qw")
_SPACE = {POINT: _POINT, LINE: _LINE, TAG: _TAG}
_ERRORS = (*_LINE, "rx_rad", "ry_rad", "rz_rad", "signature")  # in the order of their columns


@dataclass(frozen=True)
class MapLandmarks:
    """The landmarks of a map: ids, kinds, places with covariances and how often each was observed.

    The place of a landmark is its position in the plane, its position, endpoints or pose in space, whatever its state
    in the map is (`kalmark.results.shapes`); NaN if its model does not say where it is.
    """

    ids: list[Id]
    kinds: list[str]
    means: list[Array]
    covariances: list[Array]
    observations: list[int]
    in_space: bool = False

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def of(cls, slam: Slam) -> MapLandmarks:
        """Return the places of the landmarks of a filter's map."""
        table = slam.landmarks()
        rows = zip(table.ids, table.means, table.covariances, strict=True)
        in_space = any(robot.motion.space.world == "space" for robot in slam.robots.values())
        d = 3 if in_space else 2
        nowhere = np.full(d, np.nan), np.full((d, d), np.nan)
        places = [place(slam.landmark_model(i), mean, P, slam.segment_ends(i)) or nowhere for i, mean, P in rows]
        return cls(
            list(table.ids),
            list(table.kinds),
            [mean for mean, _ in places],
            [cov for _, cov in places],
            [int(count) for count in table.observations],
            in_space,
        )

    def positions(self) -> tuple[Array, Array]:
        """Return the positions (K, d) and their covariances (K, d, d), of lines their first endpoints."""
        d = 3 if self.in_space else 2
        means = np.array([mean[:d] for mean in self.means]).reshape(-1, d)
        return means, np.array([cov[:d, :d] for cov in self.covariances]).reshape(-1, d, d)

    def places(self) -> tuple[Array, Array]:
        """Return the places (K, n) and covariances (K, q, q), padded with NaN; in the plane the positions alone."""
        if not self.in_space:
            return self.positions()
        return padded_all(self.means), padded_all(self.covariances, 2)

    def to_csv(self) -> str:
        """Return the text of ``landmarks.csv``: id, kind, coordinates, triangle of the covariance, observations."""
        axes = [self._axes(kind, len(mean)) for kind, mean in zip(self.kinds, self.means, strict=True)]
        columns = list(dict.fromkeys(name for names in axes for name in names))
        columns = columns or list(_POINT if self.in_space else _POINT[:2])
        pairs = _pairs({_errors(names) for names in axes} or {_errors(columns)})
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["id", "kind", *columns, *(_cov_name(a, b) for a, b in pairs), "observations"])
        for i, names in enumerate(axes):
            at, row = ({name: j for j, name in enumerate(of)} for of in (names, _errors(names)))
            mean = [repr(float(self.means[i][at[name]])) if name in at else "" for name in columns]
            cov = [repr(float(self.covariances[i][row[a], row[b]])) if {a, b} <= row.keys() else "" for a, b in pairs]
            writer.writerow([self.ids[i], self.kinds[i], *mean, *cov, self.observations[i]])
        return out.getvalue()

    def _axes(self, kind: str, n: int) -> tuple[str, ...]:
        return _SPACE.get(n, _POINT) if self.in_space else _PLANE.get(kind, _POINT)[:n]

    @classmethod
    def read(cls, path: Path) -> MapLandmarks:
        """Read a ``landmarks.csv``.  Raises RunError naming file and line."""
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            table = cls([], [], [], [], [], "z_m" in (rows.fieldnames or ()))
            for number, row in enumerate(rows, start=2):
                try:
                    table._append(row)
                except (KeyError, TypeError, ValueError) as error:
                    raise RunError(f"{path}:{number}: not a row of a landmark table: {error}") from None
        return table

    def _append(self, row: dict[str, str]) -> None:
        names = [name for name in (*_LINE, *_TAG[3:], "signature") if row.get(name)]
        errors = _errors(names)
        cov = np.empty((len(errors), len(errors)))
        for (i, a), (j, b) in combinations_with_replacement(enumerate(errors), 2):
            cov[i, j] = cov[j, i] = float(row[_cov_name(a, b)])
        self.ids.append(as_id(row["id"]))
        self.kinds.append(row["kind"])
        self.means.append(np.array([float(row[name]) for name in names]))
        self.covariances.append(cov)
        self.observations.append(int(row["observations"]))


def refuse_other_than_points(slam: Slam, what: str) -> None:
    """Refuse a map with landmarks of a user's own that are more than points with numbers.  Raises KalmarkError."""
    for track in slam.tracks.confirmed.values():
        first, *others = track.model.space.kinds
        if not is_own(type(track.model)) and (first not in (VECTOR, VECTOR3) or {*others} - {SCALAR}):
            raise KalmarkError(f"{what}: landmark {track.id!r} is a {track.model.kind}, expected points")


def _pairs(errors: set[tuple[str, ...]]) -> list[tuple[str, str]]:
    """Return the pairs of error components that some landmark has the covariance of, in the order of their columns."""
    used = {pair for names in errors for pair in combinations_with_replacement(names, 2)}
    return [pair for pair in combinations_with_replacement(_ERRORS, 2) if pair in used]


def _errors(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the components of the error of what has these columns: a quaternion's is a rotation."""
    turn = ("rx_rad", "ry_rad", "rz_rad") if "qw" in names else ()
    return (*(name for name in names if not name.startswith("q")), *turn)


def _cov_name(a: str, b: str) -> str:
    return "cov_" + "".join(name[0] if name == "signature" else name.partition("_")[0] for name in (a, b))
