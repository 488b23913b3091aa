"""What each observation was compared with, where it seemed to come from, and what became of landmarks later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from kalmark.results.columns import Array, Arrays, Ints, Named, Texts, columns, rows_of, texts

if TYPE_CHECKING:
    from kalmark.report import Report

KEYS = {key: f"candidate_{key}" for key in ("row", "landmark", "d2", "place")} | {"seen_at": "seen_at"}
KEYS |= {f"share_{key}": f"share_{key}" for key in ("row", "landmark", "weight")}  # fields, as in ``history.npz``


class Change(NamedTuple):
    """What became of a landmark after the scan of a step: it was "removed", or "merged" with the one it is now."""

    step: int
    landmark: str
    what: str
    into: str
    reason: str


def _none(*shape: int) -> Array:
    return np.full(shape, np.nan)


@dataclass(frozen=True, eq=False)
class Decisions:
    """Observations without an id (rows `row` of the history): the landmarks each was compared with before the scan.

    `landmark` (C,), `d2` (C,) and `place` (C, d), where that landmark was in the map; `seen_at` (O, d) is where each
    observation seemed to come from, NaN where its sensor does not tell.  The observations `share_row` (W,) were
    averaged over landmarks `share_landmark`, of these weights.
    """

    row: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmark: Texts = field(default_factory=lambda: np.empty(0, dtype=np.str_))
    d2: Array = field(default_factory=lambda: _none(0))
    place: Array = field(default_factory=lambda: _none(0, 2))
    seen_at: Array = field(default_factory=lambda: _none(0, 2))
    changes: tuple[Change, ...] = ()
    share_row: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    share_landmark: Texts = field(default_factory=lambda: np.empty(0, dtype=np.str_))
    share_weight: Array = field(default_factory=lambda: _none(0))

    @classmethod
    def of(cls, reports: Sequence[Report], d: int) -> Decisions:
        """Return what the reports of a run's scans say, in a plane (d = 2) or in space."""
        first = np.cumsum([0, *(len(r.observations) for r in reports)])
        seen = [(start + c.index, c) for start, r in zip(first, reports, strict=False) for c in r.candidates]
        seen_at = _none(int(first[-1]), d)
        for start, end, report in zip(first, first[1:], reports, strict=False):
            if len(report.seen_at):
                seen_at[start:end] = report.seen_at
        shares = [
            (start + k, str(name), weight)
            for start, report in zip(first, reports, strict=False)
            for k, o in enumerate(report.observations)
            for name, weight in o.shares
        ]
        changes = [
            change
            for step, report in enumerate(reports)
            for change in (
                *(Change(step, str(gone), "merged", str(kept), why) for gone, kept, why in report.merged),
                *(Change(step, str(gone), "removed", "", why) for gone, why in report.removed),
            )
        ]
        return cls(
            np.array([row for row, _ in seen], dtype=np.int64),
            texts([c.landmark for _, c in seen]),
            np.array([c.d2 for _, c in seen], dtype=np.float64),
            np.array([c.place for _, c in seen], dtype=np.float64).reshape(-1, d),
            seen_at,
            tuple(changes),
            np.array([row for row, _, _ in shares], dtype=np.int64),
            texts([name for _, name, _ in shares]),
            np.array([weight for _, _, weight in shares], dtype=np.float64),
        )

    def arrays(self) -> Arrays:
        """Return everything as named arrays for ``history.npz``."""
        return columns("change", Change, self.changes) | {key: getattr(self, field) for field, key in KEYS.items()}

    @classmethod
    def from_arrays(cls, named: Named) -> Decisions:
        """Return what `arrays` gave, nothing if the run was saved without."""
        if "candidate_row" not in named:
            return cls(seen_at=_none(len(named["landmark"]), 2))
        given = {field: named[key] for field, key in KEYS.items() if key in named}
        return cls(**given, changes=rows_of("change", Change, named))
