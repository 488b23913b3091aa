"""Landmarks that were in view of a scan and were not measured, in the history of a run.  [TB] Obs.vis.

Expectations are computed before a scan is used, for some scans and so many landmarks of each: memory and time are
bounded, a few landmarks a scan.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.report import Expectations, Report
from kalmark.results.history import columns_of, ints, padded_all, texts

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

SCANS, LANDMARKS = 500, 32  # at most so many scans of a run, and of each so many landmarks
LOOKED_AT = 200  # landmarks of the map that are examined, a scan: with a larger map, not at every scan
KNOWN = ("associated", "new", "rejected")


class ExpectationRecorder:
    """Context that records the expected landmarks in view before scans of a filter.

    The scans in `shown` are always among these.
    """

    def __init__(self, slam: Slam, scans: int, shown: Iterable[int] = ()) -> None:
        self._slam, self._at = slam, set(np.linspace(0, max(scans - 1, 0), min(scans, SCANS)).round().astype(int))
        self._shown = set(shown)
        self._scans = self._spent = self._saved = 0
        self._asked: Expectations | None = None
        self._kept: list[tuple[int, Expectations, list[int]]] = []

    def __enter__(self) -> None:
        self._slam.before_scan = self._ask

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:  # fmt: skip
        self._slam.before_scan = None

    def _ask(self, robot: str, sensor: str) -> None:
        self._asked, count = None, len(self._slam.tracks.confirmed)
        self._saved = min(self._saved + LOOKED_AT, max(count, LOOKED_AT))
        affords = self._saved >= count
        if self._scans in self._at and (affords or self._scans in self._shown):
            self._saved -= count if affords else 0
            start = time.perf_counter_ns()
            self._asked = self._slam.expect(robot, sensor, in_view=True)
            self._spent = time.perf_counter_ns() - start
        self._scans += 1

    def spent_ns(self) -> int:
        """Return the time (ns) that it spent on the last event."""
        spent, self._spent = self._spent, 0
        return spent

    def keep(self, step: int, report: Report) -> None:
        """Keep of a scan the landmarks in view that it has not measured."""
        asked, self._asked = self._asked, None
        if asked is None or not len(asked):
            return
        seen = {o.landmark for o in report.observations if o.outcome in KNOWN}
        rows = [i for i, name in enumerate(asked.names) if name not in seen]
        if len(rows) > LANDMARKS:
            size = np.linalg.slogdet(asked.Z[rows])[1]
            rows = [rows[i] for i in sorted(np.argsort(size, kind="stable")[:LANDMARKS].tolist())]
        if rows:
            self._kept.append((step, asked, rows))

    def columns(self, m: int, p: int) -> dict[str, Any]:
        """Return fields of a history whose measurements have up to m numbers, their innovations p."""
        each = [(step, asked, i) for step, asked, rows in self._kept for i in rows]
        e = padded_all([np.full(m, np.nan), *(asked.e[i] for _, asked, i in each)])[1:]
        Z = padded_all([np.full((p, p), np.nan), *(asked.Z[i] for _, asked, i in each)], 2)[1:]
        named = columns_of(
            [(step, asked.sensor, asked.names[i], asked.kinds[i]) for step, asked, i in each],
            unmeasured_step=ints, unmeasured_sensor=texts, unmeasured_landmark=texts, unmeasured_kind=texts,
        )  # fmt: skip
        return named | {"unmeasured_e": e, "unmeasured_Z": Z}
