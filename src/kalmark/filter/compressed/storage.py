"""A large symmetric matrix in panels: the lower triangle of the stored covariance, growing without a pause.

A panel is PANEL rows, as long as its last row.  A new panel moves nothing that is there; the matrix takes n^2 / 2
numbers.  Kept in float32 it takes half of that; all arithmetic is in float64 all the same.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.errors import MapError
from kalmark.filter.kernels import subtract_product
from kalmark.filter.prefault import Prefault

Stored = npt.NDArray[Any]  # float64 or float32

PANEL = 128
UPDATE = 16_000  # bytes a row that a full update may need while it is under way


def _pointer(address: int) -> Any:
    """Return an address as a pointer."""
    return ctypes.c_void_p(int(address))


@intrinsic  # type: ignore[untyped-decorator]
def _compiled_pointer(_: Any, address: Any) -> Any:

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), generate


@overload(_pointer, strict=False)  # type: ignore[untyped-decorator]
def _pointer_form(address: Any) -> Any:
    return lambda address: _compiled_pointer(address)  # noqa: PLW0108 - numba compares the arguments


@compiled
def gather(addresses: Index, like: Stored, rows: Index, columns: Index) -> Array:
    """Return the elements (M, N) of `rows` (M,) and `columns` (N,) of the panels at `addresses`, of type `like`."""
    C = np.empty((len(rows), len(columns)))
    for a in range(len(rows)):  # row by row as they are stored, or those that are mirrored would wait for memory
        i = rows[a]
        own = carray(_pointer(addresses[i // PANEL]), (PANEL, (i // PANEL + 1) * PANEL), like.dtype)
        for b in range(len(columns)):
            if columns[b] <= i:
                C[a, b] = own[i % PANEL, columns[b]]
    for b in range(len(columns)):
        j = columns[b]
        own = carray(_pointer(addresses[j // PANEL]), (PANEL, (j // PANEL + 1) * PANEL), like.dtype)
        for a in range(len(rows)):
            if rows[a] < j:
                C[a, b] = own[j % PANEL, rows[a]]
    return C


@compiled
def diagonal(addresses: Index, like: Stored, rows: Index) -> Array:
    """Return the elements [i, i] of `rows` (N,) of the panels at `addresses`, of type `like`."""
    d = np.empty(len(rows))
    for a in range(len(rows)):
        k = rows[a] // PANEL
        d[a] = carray(_pointer(addresses[k]), (PANEL, (k + 1) * PANEL), like.dtype)[rows[a] - k * PANEL, rows[a]]
    return d


@compiled
def scatter(addresses: Index, like: Stored, rows: Index, columns: Index, C: Array) -> None:
    """Write the elements C (M, N) of `rows` (M,) and `columns` (N,), those above the diagonal to their mirror."""
    for a in range(len(rows)):
        for b in range(len(columns)):
            i, j = max(rows[a], columns[b]), min(rows[a], columns[b])
            k = i // PANEL
            panel = carray(_pointer(addresses[k]), (PANEL, (k + 1) * PANEL), like.dtype)
            panel[i - k * PANEL, j] = C[a, b]


@compiled
def subtract(panel: Stored, L: Array, R: Array, first: int, last: int, widths: Index) -> None:
    """Subtract L R[first:last]' from panel[:, first:last], in place; panel (p, n), L (p, k), R (n, k).

    Only the first widths[j] columns of L and R count in the j-th tile of PANEL columns of the panel.
    """
    for start in range(first, last, PANEL):
        end, width = min(start + PANEL, last), widths[start // PANEL]
        if panel.itemsize == 8:
            r, c = R.ctypes.data + start * R.strides[0], panel.ctypes.data + start * panel.itemsize
            subtract_product(c, panel.shape[1], L.ctypes.data, len(L), r, end - start, width, L.shape[1], False)
        else:
            product = np.ascontiguousarray(L[:, :width]) @ np.ascontiguousarray(R[start:end, :width]).T
            for i in range(len(L)):
                for j in range(end - start):
                    panel[i, start + j] -= product[i, j]


class Triangle:
    """The symmetric matrix: read and written by rows and columns, updated panel by panel.

    `limit_bytes` is the memory it may take; without it, what the machine has left.
    """

    def __init__(self, dtype: Any = np.float64, limit_bytes: int | None = None) -> None:
        self.like: Stored = np.empty(0, dtype=dtype)
        self.panels: list[Stored] = []
        self.addresses: Index = np.zeros(16, dtype=np.int64)
        self.limit_bytes = limit_bytes
        self.prefault = Prefault()

    @property
    def nbytes(self) -> int:
        """The memory taken."""
        return sum(panel.nbytes for panel in self.panels)

    def reserve(self, n: int) -> None:
        """Make room for n rows; raise MapError, before anything has changed, where they would not fit."""
        while len(self.panels) * PANEL < n:
            k = len(self.panels)
            self._refuse_too_much(k)
            if k == len(self.addresses):
                self.addresses = np.concatenate([self.addresses, np.zeros(k, dtype=np.int64)])
            panel = np.zeros((PANEL, (k + 1) * PANEL), dtype=self.like.dtype)
            self.panels.append(panel)
            self.prefault.add(panel, 0, panel.size)
            self.addresses[k] = panel.ctypes.data

    def _refuse_too_much(self, k: int) -> None:
        more = PANEL * PANEL * (k + 1) * self.like.itemsize
        if self.limit_bytes is not None:
            left = self.limit_bytes - self.nbytes
        elif k % 4 or more < 1 << 20:  # the question costs more than a small panel
            return
        else:
            left = available_bytes() - 4 * more - UPDATE * k * PANEL
        if more > left:
            raise MapError(
                f"the map is full: {k * PANEL} rows take {self.nbytes / 2**30:.1f} GiB, "
                f"expected memory for {PANEL} more ({more / 2**20:.0f} MiB)"
            )

    def get(self, rows: Index, columns: Index) -> Array:
        """Return the elements [rows][:, columns]."""
        return gather(self.addresses, self.like, rows, columns)

    def diagonal(self, rows: Index) -> Array:
        """Return the elements [i, i] of rows i."""
        return diagonal(self.addresses, self.like, rows)

    def put(self, rows: Index, columns: Index, C: Array) -> None:
        """Write the elements [rows][:, columns] and their mirror images."""
        scatter(self.addresses, self.like, rows, columns, C)


def available_bytes() -> int:
    """Return the memory that is left: the machine's, or that of the group the process is confined to."""
    try:
        found = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        left = int(found["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        try:
            left = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (ValueError, OSError, AttributeError):
            return 1 << 62
    try:
        group = Path("/sys/fs/cgroup")
        left = min(left, int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        pass
    return left
