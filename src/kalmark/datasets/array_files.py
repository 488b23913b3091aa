"""Arrays from MATLAB and NumPy files with kalmark's errors, and what logs made of them share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from kalmark.arrays import Array
from kalmark.datasets import matlab
from kalmark.datasets.text_logs import file_in
from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan
from kalmark.logs.log import Names, Times


def variables(path: Path) -> set[str]:
    """Return the names of the variables in a MATLAB file, none if it is not one."""
    try:
        return matlab.names(path)
    except (OSError, ValueError):
        return set()


def arrays(path: Path, names: Names) -> dict[str, Array]:
    """Return variables of a MATLAB file as float arrays.  Raises LogError if one is missing or not finite."""
    if not path.is_file():
        raise LogError(f"{path}: no such file, expected a MATLAB file with {', '.join(names)}")
    try:
        content = matlab.load_arrays(path, names)
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: not a complete MATLAB file ({error}), expected one with {', '.join(names)}") from None
    out = {}
    for name in names:
        if name not in content:
            raise LogError(f"{path}: no variable {name}, expected {', '.join(names)}")
        out[name] = content[name]
        if not np.isfinite(out[name]).all():
            row = int(np.argwhere(~np.isfinite(out[name]))[0][0]) + 1
            raise LogError(f"{path}: {name} row {row} is not finite, expected finite numbers")
    return out


def refuse_shapes(path: Path, data: dict[str, Array], shapes: dict[str, tuple[int, ...]]) -> None:
    """Raise LogError if an array has not the shape it should have."""
    for name, shape in shapes.items():
        if data[name].shape != shape:
            raise LogError(f"{path}: {name} has shape {data[name].shape}, expected {shape}")


def times(path: Path, values: Array, refused: str, *, scale: float = 1e9, strictly: bool = True) -> Times:
    """Return times (N,) as integer ns.

    Raises LogError, `refused` with {row} and {before} from 1, if they run backwards or, `strictly`, stand still.
    """
    t_ns = np.rint(values.reshape(-1) * scale).astype(np.int64)
    bad = np.diff(t_ns) < int(strictly)
    if bad.any():
        row = int(np.argmax(bad)) + 2
        raise LogError(f"{path}: {refused.format(row=row, before=row - 1)}")
    return t_ns


def events_of(
    robot: str, sensor: str, t_ns: Times, u: Array, seen: Iterable[tuple[Array, Sequence[int]]]
) -> Iterator[Event]:
    """Yield a control u (N, m), which acts from its time on, and a scan (y, ids) of the same instant for each time."""
    for t, control, (y, ids) in zip(t_ns.tolist(), u, seen, strict=True):
        yield Control(t_ns=t, robot=robot, u=control)
        yield Scan(t_ns=t, robot=robot, sensor=sensor, y=y, ids=ids)


def find_variables(file: str, names: Names, path: Path) -> Path | None:
    """Return the MATLAB file, given it or its folder, if it has all these variables."""
    path = file_in(path, file)
    return path if path.suffix == ".mat" and variables(path) >= set(names) else None
