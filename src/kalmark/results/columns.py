"""Rows of named tuples as named arrays and back: how ``history.npz`` keeps what is few.

Vectors and matrices of several sizes are padded with NaN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeVar, get_type_hints

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Texts = npt.NDArray[np.str_]
Flags = npt.NDArray[np.bool_]
Arrays = dict[str, npt.NDArray[Any]]
Named = Mapping[str, npt.NDArray[Any]]
Vector = Annotated[Array, 1]
Matrix = Annotated[Array, 2]
Names = tuple[str, ...]
Size = tuple[float, float]
R = TypeVar("R", bound=tuple[Any, ...])

TYPES: dict[Any, Any] = {int: np.int64, bool: np.bool_, float: np.float64, str: np.str_}


def columns(prefix: str, cls: type[R], rows: Sequence[R], joined: bool = False) -> Arrays:
    """Return the fields of named tuples as arrays "prefix_field".

    With `joined` their texts are one array "prefix", the texts of a row on lines, names of a tuple with commas between.
    """
    named: Arrays = {}
    lines: list[list[str]] = [[] for _ in rows]
    for k, (name, hint) in enumerate(get_type_hints(cls, include_extras=True).items()):
        values = [row[k] for row in rows]
        if joined and hint in (str, Names):
            for line, value in zip(lines, values, strict=True):
                line.append(value if hint is str else ",".join(value))
        elif hint in TYPES:
            named[f"{prefix}_{name}"] = np.array(values, dtype=TYPES[hint])
        else:
            named[f"{prefix}_{name}"] = padded_all([np.asarray(v, dtype=np.float64) for v in values], _dimensions(hint))
    return named | ({prefix: texts(["\n".join(line) for line in lines])} if joined else {})


def rows_of(prefix: str, cls: type[R], named: Named, joined: bool = False) -> tuple[R, ...]:
    """Return the rows that `columns` gave; none where the arrays are not there."""
    hints = get_type_hints(cls, include_extras=True)
    keys = [prefix if joined and hint in (str, Names) else f"{prefix}_{name}" for name, hint in hints.items()]
    if not all(key in named for key in keys):
        return ()
    fields: list[list[Any]] = []
    line = 0
    for key, hint in zip(keys, hints.values(), strict=True):
        values: list[Any] = named[key].tolist() if hint in (*TYPES, Names) else [_cut(value) for value in named[key]]
        if joined and hint in (str, Names):
            values = [text.split("\n")[line] for text in values]
            line += 1
        if hint == Names:
            values = [tuple(text.split(",")) for text in values]
        fields.append([tuple(value.tolist()) for value in values] if hint == Size else values)
    return tuple(cls(*row) for row in zip(*fields, strict=True))


def _dimensions(hint: Any) -> int:
    return 1 if hint == Size else int(hint.__metadata__[0])


def texts(values: list[Any]) -> Texts:
    """Return ids or names as an array of texts (N,), "" for None."""
    return np.array(["" if value is None else str(value) for value in values], dtype=np.str_)


def padded(blocks: list[Array], counts: list[int], width: int, matrices: bool = False) -> Array:
    """Stack blocks (K, m) or (K, m, m) of several sizes m, K by `counts`, padded with NaN; an empty one is all NaN."""
    out = np.full((sum(counts), width, width) if matrices else (sum(counts), width), np.nan)
    at = 0
    for block, count in zip(blocks, counts, strict=True):
        if len(block) == count and block.size:
            out[(slice(at, at + count), *(slice(m) for m in block.shape[1:]))] = block
        at += count
    return out


def padded_all(values: Sequence[Array], dimensions: int = 1) -> Array:
    """Stack vectors or matrices of several sizes to (N, n) or (N, n, n), padded with NaN."""
    shape = [max(sizes) for sizes in zip(*(value.shape for value in values), strict=True)] or [2] * dimensions
    out = np.full((len(values), *shape), np.nan)
    for k, value in enumerate(values):
        out[k][tuple(slice(m) for m in value.shape)] = value
    return out


def _cut(value: Array) -> Array:
    """Return a vector or a matrix without the NaN it was padded with."""
    known = ~np.isnan(value)
    return value[known] if value.ndim == 1 else value[np.ix_(known.any(axis=1), known.any(axis=0))]
