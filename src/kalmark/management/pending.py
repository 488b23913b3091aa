"""Deferred initialisation: the steps that a method of starting landmarks late returns.

All methods are one idea: measurements made from cloned poses, pending until a test passes.  They differ in the solver:
where bearings intersect (`delayed`), where ranges meet (`trilateration`), which of several directions a range has
(`hypotheses`), which of two poses a tag has (`ambiguous_tags`).  A method reads and returns steps, which
`slam.starting` applies.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from kalmark.arrays import Array
from kalmark.tracks.channel import Parts
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Pending

OTHERS = "another sensor's ranges of it are being kept"


class HypothesisCorrection(NamedTuple):
    """The correction of one hypothesis alone (Schmidt's filter): P <- F P F' + Q on the rows of the parts."""

    slot: int
    parts: Parts
    F: Array
    Q: Array
    mean: Array


class Step(NamedTuple):
    """The outcome of an observation of a pending landmark, and the actions that follow, in this order.

    `pending` is what is known of it after the step, None where that stays as it is.  `corrections` of hypotheses,
    hypotheses to be `added`; with `keep`, the measurement is kept with a clone of the pose.  `removed` are slots of
    hypotheses.  With `start`, the landmark enters the map, from so many `measurements`.  A step without a reason and
    without a start is followed by `solve`.
    """

    outcome: str
    reason: str
    pending: Pending | None = None
    corrections: tuple[HypothesisCorrection, ...] = ()
    added: tuple[Start, ...] = ()
    keep: bool = False
    removed: tuple[int, ...] = ()
    start: Start | None = None
    measurements: int = 1


@runtime_checkable
class Initialization(Protocol):
    """A way to start a landmark with an id from measurements of which one alone does not determine it.

    >>> isinstance(km.initialization.Trilateration(), Initialization)
    True
    """

    def observe(self, scan: ScanContext, k: int, pending: Pending) -> Step:
        """Return what the k-th observation of a scan does to what is pending of its landmark."""

    def solve(self, scan: ScanContext, pending: Pending) -> Step:
        """Return whether the landmark can start now, after the first step has been done."""
