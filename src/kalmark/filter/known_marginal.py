"""Joint marginals with landmarks known exactly, as a small map of a query.

Landmarks known exactly have no block in the map.  An association compares with the few near ones as with any others:
here they are blocks whose covariance is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from kalmark.arrays import Array
from kalmark.filter import kernels
from kalmark.filter.layout import concatenate_tables
from kalmark.filter.map import Marginal, StochasticMap
from kalmark.geometry.spaces import Space


def append_known(read: Marginal, spaces: Sequence[Space], means: Sequence[Array]) -> Marginal:
    """Return a joint marginal with blocks known exactly behind its own; their slots come last."""
    m, robot, mount, slots = read
    head = [robot] if mount < 0 else [robot, mount]
    blocks, atoms, numbers, rows = concatenate_tables(m.blocks[np.concatenate([head, slots]).astype(np.int64)], m.atoms)
    n, x_n, own = len(rows), len(numbers), len(blocks)
    sizes, dofs = [space.size for space in spaces], [space.dof for space in spaces]
    x_at, p_at = [*accumulate(sizes, initial=x_n)], [*accumulate(dofs, initial=n)]
    atom_at = [*accumulate((len(space.kinds) for space in spaces), initial=len(atoms))]
    added = np.array(
        [
            (x, space.size, p, space.dof, a, len(space.kinds))
            for space, x, p, a in zip(spaces, x_at[:-1], p_at[:-1], atom_at[:-1], strict=True)
        ],
        dtype=np.int64,
    ).reshape(-1, 6)
    tables = [space.atoms + np.array([0, x, p]) for space, x, p in zip(spaces, x_at[:-1], p_at[:-1], strict=True)]
    P = np.zeros((p_at[-1], p_at[-1]))
    P[:n, :n] = kernels.submatrix(m.P, rows)
    small = StochasticMap.of(
        np.concatenate([m.x[numbers], *means]), P, np.concatenate([blocks, added]), np.concatenate([atoms, *tables]),
        m.axes, m.inverse_depths, m.dependent,
    )  # fmt: skip
    first = len(head)
    return Marginal(small, 0, 1 if mount >= 0 else -1, np.arange(first, own + len(spaces)))
