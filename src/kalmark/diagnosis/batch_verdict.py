"""The verdict by the batch solution, or by the innovations alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from kalmark.diagnosis.batch_search import MORE, Searched, search_causes
from kalmark.diagnosis.cause_search import Search
from kalmark.diagnosis.causes import JUMPS, LEAST_GAIN
from kalmark.diagnosis.effect import TOO_SURE, Effect, effect_of
from kalmark.diagnosis.named_causes import (
    COPIES,
    MISFIT,
    OF_MAP,
    Cause,
    all_misfit,
    begin_s,
    causes_of,
    is_misplaced_survey,
    odd_controls,
    status_of,
)
from kalmark.diagnosis.single_ids import OUTLIERS
from kalmark.diagnosis.trials import AT_ONCE, SOLVED, Trials
from kalmark.errors import KalmarkError
from kalmark.logs.log import Log
from kalmark.results.checked import DOUBTFUL, OK, worst_status
from kalmark.results.figure_texts import figure
from kalmark.results.run import Run
from kalmark.results.verdict_text import INNOVATIONS, NO_BATCH, NO_LANDMARKS, NO_MAP
from kalmark.results.warnings import window_warnings

SEEN = 3  # observations a landmark, of a map that is looked into as a whole at the end of a run


@dataclass(frozen=True, eq=False)
class Verdict:
    """Judgement of a map: `map` is ok, unchecked, doubtful or wrong, by the `causes`, the likeliest first.

    `robots` is the same of the path of each robot: at best what the map is.
    `sigma_factor` is what the filter's sigmas are to be multiplied by, `accuracy_m` the sigma of a landmark's position
    after it in the world and `shape_accuracy_m` that without the motion of the world that the start leaves open
    (`kalmark.results.gauge`), all the median over landmarks; `shift_m` is by how much the shape of the map changes
    without the causes.  `checked` names the data behind all this, `left_out` the searches that were not made, as they
    take too long for a brief verdict; `search` has the details.

    >>> from kalmark.diagnosis.verdict import Cause, Verdict
    >>> verdict = Verdict("doubtful", (Cause("range_scale", 0.0, 41.0, "ranges too long"),), checked="900 ranges")
    >>> verdict.as_dict()["map"], [cause["name"] for cause in verdict.as_dict()["causes"]]
    ('doubtful', ['range_scale'])
    """

    map: str
    causes: tuple[Cause, ...]
    checked: str
    sigma_factor: float | None = None
    accuracy_m: float | None = None
    shape_accuracy_m: float | None = None
    shift_m: float | None = None
    robots: dict[str, str] = field(default_factory=dict)
    search: Search | None = field(default=None, repr=False)
    left_out: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict as it is in ``summary.json``."""
        keys = "map", "robots", "sigma_factor", "accuracy_m", "shape_accuracy_m", "shift_m", "checked"
        figures = {key: getattr(self, key) for key in keys} | {"left_out": [*self.left_out]}
        return figures | {"causes": [vars(cause) for cause in self.causes]}


def judged(run: Run, log: Log, first: list[Cause], most: int, trials: Trials) -> Verdict:
    """Return the verdict by the batch solution, by the innovations alone where there is none."""
    limit = max(AT_ONCE, MORE * most)
    if len(run.landmarks) <= most // SEEN and any(not cause.harmless for cause in first):
        every = min(max(most, AT_ONCE), len(run.history.d2))  # its reason may show in all of the log only
        most = max(most, every) if trials.pays(f"a batch solution of {every} observations", SOLVED * every) else most
    try:
        return _by_batch(run, log, first, search_causes(run, log, most, limit, trials))
    except (KalmarkError, np.linalg.LinAlgError):
        found = [Cause(MISFIT, begin_s(run), 0.0, line) for line in (*window_warnings(run), *all_misfit(run))]
    status = worst_status(status_of(first), DOUBTFUL if found else OK)
    found = [*first, *(odd_controls(run, log) if found else ()), *found]
    none = NO_LANDMARKS if run.history.localizes else NO_MAP
    why = NO_BATCH if len(run.landmarks) else none
    return Verdict(status, tuple(found), f"{INNOVATIONS}, no batch solution: {why}")


def _by_batch(run: Run, log: Log, first: list[Cause], found: Searched) -> Verdict:
    """Return the verdict by a search in the batch problem, and by the causes that it cannot show, `first`."""
    effect = effect_of(run, found)
    moved = [f for f in found.search.found if is_misplaced_survey(run, f)]
    status = worst_status(effect.status, status_of(first), DOUBTFUL if moved else OK)
    causes = [*first, *(c for c in _found(run, log, first, found, effect) if c not in first)]
    causes.sort(key=lambda c: (c.harmless, c not in first or c.name in OF_MAP, -c.score))
    checked = f"batch solution of {len(found.given.associations.landmark)} observations"
    figures = effect.sigma_factor, effect.accuracy_m, effect.shape_accuracy_m, effect.shift_m
    return Verdict(status, tuple(causes), checked, *figures, effect.robots, found.search)


def _found(run: Run, log: Log, first: list[Cause], found: Searched, effect: Effect) -> list[Cause]:
    """Return the causes that a search found, and controls that jump: between segments it looks for no jumps.

    Outliers do no harm to a map that is the same without them.
    """
    causes = causes_of(run, found.search, effect.accuracy_m or 0.0, log)
    if found.given.segments is not None and not any(cause.name in JUMPS for cause in causes):
        causes += odd_controls(run, log)
    if not any(cause.name == COPIES for cause in first):  # then that makes the filter overconfident
        causes += _too_sure(run, effect)
    fine = effect.status == OK
    return [replace(cause, harmless=True) if cause.name == OUTLIERS and fine else cause for cause in causes]


def _too_sure(run: Run, effect: Effect) -> Iterator[Cause]:
    """Yield the cause `overconfident` if the filter's sigmas are below those of the batch solution."""
    if effect.claimed is None:
        return
    score = 0.5 * effect.dof * float(effect.claimed**-2 - 1.0 + 2.0 * np.log(effect.claimed))
    if effect.claimed >= TOO_SURE or score < LEAST_GAIN:
        return
    share = figure(effect.claimed, 2)
    evidence = f"the filter's sigmas are {share} of what the same data allow: its linearisation, not the noise"
    cure = "" if run.estimator == "invariant" else "--set estimator.type=invariant"
    yield Cause("estimator", begin_s(run), score, evidence, cure)
