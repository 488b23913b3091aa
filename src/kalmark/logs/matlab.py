"""Arrays from MATLAB files, with kalmark's errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.io

from kalmark.errors import LogError
from kalmark.logs.log import Array


def variables(path: Path) -> set[str]:
    """Return the names of the variables in a MATLAB file, none if it is not one."""
    try:
        return {name for name, *_ in scipy.io.whosmat(path)}
    except Exception:  # whatever a damaged or foreign file makes the reader raise
        return set()


def arrays(path: Path, names: tuple[str, ...]) -> dict[str, Array]:
    """Return variables of a MATLAB file as float arrays.  Raises LogError if one is missing or not finite."""
    if not path.is_file():
        raise LogError(f"{path}: no such file, expected a MATLAB file with {', '.join(names)}")
    try:
        content = scipy.io.loadmat(path, variable_names=names)
    except Exception as error:  # the reader has no common error for damaged files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise LogError(f"{path}: not a complete MATLAB file ({reason}), expected one with {', '.join(names)}") from None
    out = {}
    for name in names:
        if name not in content:
            raise LogError(f"{path}: no variable {name}, expected {', '.join(names)}")
        out[name] = np.asarray(content[name], dtype=np.float64)
        if not np.isfinite(out[name]).all():
            row = int(np.argwhere(~np.isfinite(out[name]))[0][0]) + 1
            raise LogError(f"{path}: {name} row {row} is not finite, expected finite numbers")
    return out


def column(values: Array) -> Array:
    """Return a row or column vector as (N,)."""
    return values.reshape(-1)
