"""A map known beforehand, from a ``landmarks.csv``: that of a survey, of a log's truth, or of the folder of a run."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from itertools import combinations_with_replacement
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import Id
from kalmark.logs.geodesy import Globe
from kalmark.logs.log import Names
from kalmark.logs.source import Request, raise_refusal
from kalmark.logs.table import Refused, Row, read_table
from kalmark.logs.table_columns import POSE3, POSITION

TAG = POSE3
PLACES = (*POSITION, "signature", *POSE3[3:])
KINDS = {POSITION[:2], (*POSITION[:2], "signature"), POSITION, TAG}


class KnownLandmark(NamedTuple):
    """A landmark of a known map: its place (n,), and the covariance of its error, None of one known exactly.

    `columns` name the numbers of its place: in the plane the third may be a height or a signature.
    """

    id: Id
    mean: Array
    cov: Array | None = None
    columns: Names = ()


def read_known(path: Path, exact: bool = False, origin: Array | None = None) -> list[KnownLandmark]:
    """Return the landmarks of a ``landmarks.csv``: id, x_m, y_m[, z_m][, signature | qx, qy, qz, qw], cov_xx, ...

    Those with a `mark`, which a run did not see again, are left out.  Those with empty columns of the covariance, or
    with none, are known exactly; with `exact` all are.  Places on the globe, lat_deg, lon_deg[, height_m], are counted
    from the `origin` of the log (3,).  Raises LogError naming file and line.
    """
    found: dict[Id, KnownLandmark] = {}

    def take(row: Row) -> None:
        if "mark" in row.table.index and row.text("mark"):
            return
        name, names = row.new_id(found), tuple(n for n in PLACES if n in row.table.index and row.text(n))
        if names not in KINDS:
            raise Refused(f"{', '.join(names) or 'no place'}, expected the place of a point or the pose of a tag")
        mean = np.array(row.numbers(names))
        found[name] = KnownLandmark(name, mean, None if exact else _covariance(row, names), names)

    globe = Globe(origin)
    allowed = ("kind", "observations", "class", "class_p", "known", "log_odds", "mark", *PLACES[2:])
    table = read_table(path, ("id", "x_m", "y_m"), allowed=allowed, globe=globe)
    if table.globe is not None and origin is None:
        raise LogError(f"{path}: lat_deg and lon_deg, but the log has no origin on the globe, expected log.origin")
    table.each(Request(None, raise_refusal, []), take, timed=False)
    return [*found.values()]


def errors_of(names: Collection[str]) -> list[str]:
    """Return the components of the error of a place with these columns; that of a quaternion is a rotation vector."""
    straight = ["s" if name == "signature" else name.removesuffix("_m") for name in names if not name.startswith("q")]
    return straight + ["rx", "ry", "rz"] * ("qw" in names)


def cov_names(names: Collection[str]) -> list[str]:
    """Return the columns of the upper triangle of the covariance of that error, row by row."""
    return [f"cov_{a}{b}" for a, b in combinations_with_replacement(errors_of(names), 2)]


def from_triangle(values: Sequence[float]) -> Array:
    """Return the symmetric matrix (n, n) with this upper triangle, row by row."""
    size = (math.isqrt(8 * len(values) + 1) - 1) // 2
    whole, rows = np.empty((size, size)), np.triu_indices(size)
    whole[rows] = whole.T[rows] = values
    return whole


def _covariance(row: Row, names: Names) -> Array | None:
    """Return the covariance of a landmark's error, None if its columns are empty or zero."""
    columns = cov_names(names)
    given = [column for column in columns if column in row.table.index and row.text(column)]
    if not given:
        return None
    if given != columns:
        missing = next(column for column in columns if column not in given)
        raise Refused(f"{missing} is empty, expected all of {', '.join(columns)}, or none")
    cov = from_triangle(row.numbers(tuple(columns)))
    return cov if cov.any() else None
