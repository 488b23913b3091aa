"""A map known beforehand, from a ``landmarks.csv``: that of a survey, of a log's truth, or of the folder of a run."""

from __future__ import annotations

from itertools import combinations_with_replacement
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import Id
from kalmark.logs.geodesy import Globe
from kalmark.logs.source import Request, raise_refusal
from kalmark.logs.table import Refused, Row, read_table

PLACES = ("x_m", "y_m", "z_m", "signature", "qx", "qy", "qz", "qw")
HIGH = PLACES[:3]
TAG = (*HIGH, *PLACES[4:])
KINDS = {PLACES[:2], (*PLACES[:2], "signature"), HIGH, TAG}
LETTERS = {"x_m": "x", "y_m": "y", "z_m": "z", "signature": "s"}
TURNS = ("rx", "ry", "rz")  # of a pose's error, after its position


class KnownLandmark(NamedTuple):
    """A landmark of a known map: its place (n,), and the covariance of its error, None of one known exactly.

    `columns` name the numbers of its place: in the plane the third may be a height or a signature.
    """

    id: Id
    mean: Array
    cov: Array | None = None
    columns: tuple[str, ...] = ()


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

    allowed, globe = ("kind", "observations", "known", "log_odds", "mark", *PLACES[2:]), Globe(origin)
    table = read_table(path, ("id", "x_m", "y_m"), allowed=allowed, globe=globe)
    if table.globe is not None and origin is None:
        raise LogError(f"{path}: lat_deg and lon_deg, but the log has no origin on the globe, expected log.origin")
    table.each(Request(None, raise_refusal, []), take, timed=False)
    return [*found.values()]


def _covariance(row: Row, names: tuple[str, ...]) -> Array | None:
    """Return the covariance of a landmark's error, None if its columns are empty or zero."""
    letters = [LETTERS[name] for name in names if name in LETTERS] + [*TURNS] * ("qw" in names)
    cov = np.zeros((len(letters), len(letters)))
    pairs = list(combinations_with_replacement(range(len(letters)), 2))
    columns = [f"cov_{letters[i]}{letters[j]}" for i, j in pairs]
    given = [column for column in columns if column in row.table.index and row.text(column)]
    if not given:
        return None
    if given != columns:
        missing = next(column for column in columns if column not in given)
        raise Refused(f"{missing} is empty, expected all of {', '.join(columns)}, or none")
    for (i, j), value in zip(pairs, row.numbers(tuple(columns)), strict=True):
        cov[i, j] = cov[j, i] = value
    return cov if cov.any() else None
