"""A log from tables in memory: frames of pandas or polars, dictionaries of arrays, with the checks of a native log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from kalmark.errors import LogError
from kalmark.events import short_text
from kalmark.logs.formats import request_of, robot_names, select_events
from kalmark.logs.log import Log
from kalmark.logs.native import EVENTS, FILES, log_of_tables
from kalmark.logs.table import CSV, Content


def log_from(
    *,
    controls: Any = None,
    scans: Any = None,
    measurements: Any = None,
    fixes: Any = None,
    truth: Any = None,
    landmarks: Any = None,
    gps: Any = None,
    describes: Mapping[str, Any] | None = None,
    name: str = "log",
    robots: Sequence[str | int] | str | int | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    on_error: Literal["raise", "skip"] = "raise",
    ids: Literal["given", "hidden"] = "given",
) -> Log:
    """Return the log of tables in memory, each with the columns of the file of its name in a native log.

    A table is a frame of pandas or polars, a table of pyarrow, or a mapping of columns to arrays, lists, or to one text
    or number for all rows.  None and NaN are empty cells.  `describes` has the content of a `rig.yaml`.  The other
    arguments are those of `open_log`.  Raises LogError, with table and row (from 1) for a bad one.

    >>> controls = {"t_s": [0.0, 0.1], "robot": ["rover"] * 2, "v_mps": [0.5, 0.5], "w_radps": [0.0, 0.1]}
    >>> km.log_from(controls=controls)
    <Log 'log' of 'rover': 2 events in 0.1 s>
    """
    given = dict(zip(FILES, (controls, scans, fixes, truth, landmarks, gps, measurements), strict=False))
    there = {file: sheet(file.removesuffix(CSV), table) for file, table in given.items() if table is not None}
    if not {*EVENTS} & there.keys():
        raise LogError("log_from: no controls, scans, fixes or measurements, expected at least one of them")
    request = request_of(robot_names(robots), on_error)
    log = log_of_tables(there, request, name, None, dict(describes or {}))
    return select_events(log, request, from_s, to_s, ids)


def sheet(name: str, table: Any) -> Content:
    """Return the content of a table in memory.  Raises LogError."""
    table = table.to_pydict() if hasattr(table, "to_pydict") else table  # pyarrow
    names = list(table) if isinstance(table, Mapping) else list(getattr(table, "columns", ()))
    if not names or not all(isinstance(each, str) for each in names):
        told = f"columns {short_text(names)}" if names else f"a {type(table).__name__}"
        raise LogError(f"{name}: got {told}, expected a frame or a mapping with named columns")
    columns = {each: values(table[each]) for each in names}
    many = max((len(column) for column in columns.values() if isinstance(column, list)), default=1)
    filled = {each: v if isinstance(v, list) else [v] * many for each, v in columns.items()}
    sizes = {each: len(v) for each, v in filled.items()}
    for each, size in sizes.items():
        if size != sizes[names[0]]:
            raise LogError(f"{name}: column {each!r} has {size} values, expected {sizes[names[0]]} as {names[0]!r} has")
    return Content([*filled], name, enumerate(zip(*filled.values(), strict=True), start=1), " row ")


def values(column: Any) -> list[Any] | str | float:
    """Return the values of a column, None for the empty ones; of a text or a number itself."""
    if isinstance(column, str | int | float):
        return column
    if hasattr(column, "isna"):  # pandas, whose own empty values are equal to nothing
        column = column.astype(object).where(column.notna(), None)
    listed = getattr(column, "tolist", None) or getattr(column, "to_list", None)
    found = listed() if listed is not None else column
    try:
        return [None if isinstance(v, float) and math.isnan(v) else v for v in found]
    except TypeError:
        return [found]
