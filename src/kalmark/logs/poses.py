"""Poses as TUM and KITTI have them: read as a path, written from one.

TUM: rows ``t x y z qx qy qz qw`` (s, m), also with commas, a header that may name another order, times in ns, us or
ms, which no clock has in seconds, and positions of NaN where nothing was measured.
KITTI: rows of twelve numbers, [R | t] row by row, without times, which are
one a line in ``NAME_times.txt`` or ``times.txt`` beside the poses.  Poses of the plane are at z = 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal
from functools import partial
from pathlib import Path

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import ROUNDED, fixed_seconds, unit_quaternion
from kalmark.files import write
from kalmark.geometry.rotations import matrix
from kalmark.logs.log import Log, Times, Trajectory, poses_of_size
from kalmark.logs.source import (
    Format,
    Request,
    frame,
    is_number_text,
    nanoseconds_of_text,
    number_of_text,
    read_text,
    text_rows,
    timed_rows,
)
from kalmark.logs.table_columns import POSE3

ROBOT = "robot"
TUM_CELLS, KITTI_CELLS = 8, 12
ENDINGS = (".tum", ".kitti", ".txt", ".csv")
TUM_NAMES = ("x", "y", "z", "w")  # ends of the names in a header
LATEST_S = 2**63 // 10**9


def find(path: Path, cells: int) -> Path | None:
    """Return the file if its first row has so many numbers."""
    if not path.is_file() or path.suffix not in ENDINGS:
        return None
    with path.open("rb") as stream:
        begin = stream.read(8192).decode("utf-8", "replace").splitlines()
    told = [split_cells(line) for line in begin if line.strip() and not line.lstrip().startswith("#")]
    if cells == TUM_CELLS and told[1:] and not any(map(is_float, told[0])):
        told = told[1:]
    return path if told and len(told[0]) == cells and all(map(is_float, told[0])) else None


def split_cells(line: str) -> list[str]:
    """Return the cells of a line: between blanks, commas or semicolons."""
    return line.replace(",", " ").replace(";", " ").split()


def is_float(text: str) -> bool:
    """Return whether a text is a number, NaN among them."""
    return is_number_text(text) or text.lower().lstrip("+-") == "nan"


def plain_text(path: Path, request: Request) -> str:
    """Return the text of a file of TUM with blanks, seconds and the usual order, line by line.  Raises LogError."""
    out, order, gone, unit, begun = list[str](), [*range(TUM_CELLS)], 0, 0, False
    for text in read_text(path).split("\n"):
        line, cells = text, split_cells(text.replace("#", " "))
        if not begun and (line.lstrip().startswith("#") or not any(map(is_float, cells))):
            order = order_in(cells) or order
            out.append("")
            continue
        begun = begun or bool(cells)
        if len(cells) == TUM_CELLS and not line.lstrip().startswith("#"):
            cells = [cells[k] for k in order]
            unmeasured = all(is_float(cell) and not is_number_text(cell) for cell in cells[1:4])
            if not unit and is_number_text(cells[0]):
                unit = next((n for n in (1, 10**3, 10**6, 10**9) if abs(float(cells[0])) < n * LATEST_S), 1)
            if unit > 1 and is_number_text(cells[0]):
                cells[0] = f"{Decimal(cells[0]) / unit:f}"
            gone += unmeasured
            line = "" if unmeasured else " ".join(cells)
        out.append(line)
    if gone:
        request.leave_out(gone, f"{path}: {gone} positions of NaN, which are none")
    return "\n".join(out)


def order_in(header: list[str]) -> list[int] | None:
    """Return the columns of t, x, y, z, qx, qy, qz, qw in a header of eight names; None without a quaternion."""
    names = [name.lower().replace("_", "") for name in header]
    q = [[k for k, name in enumerate(names) if name.endswith(f"q{axis}")] for axis in TUM_NAMES]
    if len(names) != TUM_CELLS or any(len(at) != 1 for at in q):
        return None
    turn = [at[0] for at in q]
    return [*(k for k in range(TUM_CELLS) if k not in turn), *turn]


def read_path(path: Path, request: Request) -> Trajectory:
    """Return the poses of a file of TUM or KITTI.  Raises LogError, with file and line."""
    for entry, reader in ((TUM, tum_rows), (KITTI, kitti_rows)):
        if entry.find(path) is not None:
            found = dict(reader(path, request))
            if not found:
                raise LogError(f"{path}: no pose that can be used, expected {entry.what}")
            return Trajectory.of(found)
    raise LogError(f"{path}: no file of poses, expected {TUM.what}, or {KITTI.what}")


def tum_rows(path: Path, request: Request) -> Iterator[tuple[int, Array]]:
    """Yield times (ns), which increase, and poses (7,)."""
    rows = text_rows(path, plain_text(path, request))
    for line, t_ns, values in timed_rows(path, POSE3, request.refuse, rows, strictly=True):
        try:
            yield t_ns, np.append(values[:3], unit_quaternion(np.array(values[3:]), ValueError))
        except ValueError as error:
            request.refuse(f"{path}:{line}: {error}")


def kitti_rows(path: Path, request: Request, t_ns: Times | None = None) -> Iterator[tuple[int, Array]]:
    """Yield times (ns), which increase, and poses (7,); the times t_ns (N,) are those in the file beside if absent."""
    lines = list(text_rows(path))
    t_ns = kitti_times(path) if t_ns is None else t_ns
    if len(t_ns) != len(lines):
        raise LogError(f"{path}: {len(lines)} poses and {len(t_ns)} times, expected as many")
    for k, (line, cells) in enumerate(lines):
        try:
            M = np.array([number_of_text(cell) for cell in cells]).reshape(3, 4)
        except ValueError:
            request.refuse(f"{path}:{line}: {len(cells)} cells, expected {KITTI_CELLS} finite numbers")
            continue
        R = M[:, :3]
        off = float(np.abs(R @ R.T - np.eye(3)).max())
        if off > ROUNDED or np.linalg.det(R) < 0:
            request.refuse(f"{path}:{line}: the first three columns are no rotation (off by {off:.2g}), expected one")
        elif k and t_ns[k] <= t_ns[k - 1]:
            request.refuse(f"{path}:{line}: its time is not after the one before, expected increasing times")
        else:
            yield int(t_ns[k]), frame(M[:, 3], R)


def times_beside(path: Path) -> Path:
    """Return the file of the times of a file of KITTI."""
    return path.with_name(f"{path.stem}_times.txt")


def kitti_times(path: Path) -> Times:
    """Return the times (N,) ns of a file of KITTI.  Raises LogError."""
    own, shared = times_beside(path), path.with_name("times.txt")
    file = own if own.is_file() else shared
    if not file.is_file():
        raise LogError(f"{path}: KITTI's poses have no times, expected them in {own.name} or {shared.name} beside it")
    out = []
    for line, text in enumerate(read_text(file).split("\n"), 1):
        try:
            out += [nanoseconds_of_text(text.strip())] if text.strip() else []
        except ValueError:
            raise LogError(f"{file}:{line}: {text.strip()!r}, expected a time in s") from None
    return np.array(out, dtype=np.int64)


# ------------------------------------------------------------------ to text
def tum_text(t_ns: Times, poses: Array) -> str:
    """Return a path, poses (N, 3) or (N, 7), as TUM lines: t x y z qx qy qz qw."""
    lines = ["# t_s x_m y_m z_m qx qy qz qw"]
    for t, (x, y, z, *q) in zip(t_ns.tolist(), poses_of_size(poses, 7).tolist(), strict=True):
        lines.append(f"{fixed_seconds(t)} {x:.9f} {y:.9f} {z:.9f} " + " ".join(f"{value:.12f}" for value in q))
    return "\n".join(lines) + "\n"


def write_path(out: Path, t_ns: Times, poses: Array) -> list[Path]:
    """Write a path as TUM, or as KITTI with its times beside it, by the file's ending; return the files."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".tum":
        write(out, tum_text(t_ns, poses))
        return [out]
    lines = []
    for pose in poses_of_size(poses, 7):
        M = np.column_stack([matrix(np.ascontiguousarray(pose[3:])), pose[:3]])
        lines.append(" ".join(f"{value:.12g}" for value in M.ravel()))
    write(times_beside(out), "".join(f"{fixed_seconds(int(t))}\n" for t in t_ns))
    write(out, "\n".join(lines) + "\n")
    return [out, times_beside(out)]


# ------------------------------------------------------------------ as logs: truth alone
def read(path: Path, request: Request) -> Log:
    """Return a log that has true poses only."""
    kind = "tum" if TUM.find(path) is not None else "kitti"
    return Log(path.stem, (ROBOT,), [], kind, path, truth={ROBOT: read_path(path, request)}, skipped=request.skipped)


TUM = Format(
    "tum", "poses as TUM has them, rows t x y z qx qy qz qw", partial(find, cells=TUM_CELLS), read, general=True
)
KITTI = Format(
    "kitti", "poses as KITTI has them, rows of 12 numbers", partial(find, cells=KITTI_CELLS), read, general=True
)
