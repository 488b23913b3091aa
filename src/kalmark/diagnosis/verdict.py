"""The verdict on the map of a run: its status, its accuracy and the causes of misfit, without any truth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import pdtrc

from kalmark.arrays import Array, Flags, Index
from kalmark.batch.batch_state import LANDMARKS, POSES
from kalmark.diagnosis import doubled_landmarks, repeated_events
from kalmark.diagnosis.batch_search import MORE, WORST, Searched, associated, misfits, search_causes
from kalmark.diagnosis.blind import blind
from kalmark.diagnosis.cause_search import SHARE, Search, joined
from kalmark.diagnosis.cause_texts import finding_text, odd_control_text
from kalmark.diagnosis.causes import JUMPS, LEAST_GAIN, TIMES, Finding
from kalmark.diagnosis.gross_mistakes import gross, misfits_from, started_at
from kalmark.diagnosis.jumps import LISTED, Controls, merge_jumps
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.lost import find_lost_robots, unchecked_ends
from kalmark.diagnosis.mistakes import LATE, Mistake
from kalmark.diagnosis.onsets import without_onset
from kalmark.diagnosis.single_ids import MISPLACED, MOVED, OUTLIERS
from kalmark.diagnosis.state_readings import SIGMA, fit_of_readings, reasons
from kalmark.diagnosis.trials import (
    AT_ONCE,
    FITS,
    LOST,
    MOST,
    SOLVED,
    Fit,
    Trials,
    fit_of_run,
    is_configured,
    likelihood_gain,
    with_cure,
)
from kalmark.diagnosis.trials import MISFIT as MISFITS_ALL
from kalmark.errors import KalmarkError
from kalmark.logs.log import Log
from kalmark.report import ELSEWHERE as CARRIED
from kalmark.results.batch import filter_only_sensors, filtered_map
from kalmark.results.checked import DOUBTFUL, OK, UNCHECKED, WRONG, worst_status
from kalmark.results.control_gaps import KINDS, carried_line, controls_left_out, is_reported, stayed_lost, while_lost
from kalmark.results.figure_texts import count, figure
from kalmark.results.gauge import shape_of_points
from kalmark.results.history import RelocatedRobot
from kalmark.results.measures import Rigid, rigid, rmse
from kalmark.results.run import Run
from kalmark.results.verdict_text import INNOVATIONS, NO_BATCH, NO_LANDMARKS, NO_MAP
from kalmark.results.warnings import NO_ID, TOO_SMALL, placements, signs, window_warnings, words_of
from kalmark.results.wrong_starts import restarts
from kalmark.slam.elsewhere import ODDS
from kalmark.slam.relocation_by_fixes import NEEDED
from kalmark.slam.surveyed_corrections import ELSEWHERE
from kalmark.slam.tentative import ELSEWHERE as BEGUN_AGAIN

__all__ = ["Cause", "Effect", "Verdict", "diagnose"]

SEEN = 3  # observations a landmark, of a map that is looked into as a whole at the end of a run
LEAST, MOST_OFF = 0.01, 0.2  # of the map's extent: what its shape may be off by, and what makes it wrong
FEW = 0.01  # of landmarks or observations: a mistake about no more than these is weighed by what it does to the map
TRIED, ROUNDS = 2, 3  # errors that are tried, and rounds in which the size of one is found
LIKELY = 0.05  # the probability of so many marks, or more, up to which they are not by chance
SIGMAS = 3.0  # of its own by which the shape of a doubtful map is off
TOO_SURE = 0.8  # of the batch solution's sigma, below which the filter claims too much
TINY_M = 1e-12
SURELY = 50.0  # the score of a systematic error of 10 sigma: what it does to associations comes after it
LEAST_S = 5.0  # for which a robot is lost at the end
STOPPED_S = 1.0  # after a gap in the controls, within which a place is mapped again because of it
MOST_PAIRS = 0.7  # of a repeat, of which one landmark was seen first before a gap, and the other one after it
AGAIN = "the log filtered again without the mistake"  # what a verdict was made of
JUMP = "odometry_jump"  # the cause of controls that state a motion that did not take place
MISFITTING = "from some time on the observations do not fit"
COPIES = "copies"  # the cause that events come twice
MISFIT = "misfit"  # the cause of innovations that do not fit, without an explanation
SEVERITY = dict.fromkeys((*JUMPS, "map_repeats", "lost"), WRONG) | {COPIES: OK}  # the others: doubtful
LEAST_SHARE = 0.3  # of the observations without ids that are of landmarks, in a map that determines the pose


@dataclass(frozen=True)
class Cause:
    """Cause of errors in a run, its begin (s of the log), evidence and cure.

    `score` is the logarithm of the likelihood ratio against a run without it.  A noise that is stated too large is
    `harmless`: the map is as good as it would be, and better than it claims.

    >>> cause = Cause("range_scale", since_s=0.0, score=41.0, evidence="ranges are 4 % too long", cure="scale: 1.04")
    >>> f"{cause.evidence}; cure: {cause.cure}"
    'ranges are 4 % too long; cure: scale: 1.04'
    """

    name: str
    since_s: float
    score: float
    evidence: str
    cure: str = ""
    harmless: bool = False


@dataclass(frozen=True, eq=False)
class Verdict:
    """Judgement of a map: `map` is ok, unchecked, doubtful or wrong, by the `causes`, the likeliest first.

    `robots` is the same of the path of each robot: at best what the map is.
    `sigma_factor` is what the filter's sigmas are to be multiplied by, `accuracy_m` the sigma of a landmark's position
    after it in the world and `shape_accuracy_m` that without the motion of the world that the start leaves open
    (`kalmark.results.gauge`), all the median over landmarks; `shift_m` is by how much the shape of the map changes
    without the causes.  `checked` names the data behind all this, `left_out` the searches that were not made, as they
    take too long for a brief verdict; `search` has the details.

    >>> from kalmark.diagnosis.verdict import Cause
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


def diagnose(run: Run, most: int = AT_ONCE, *, brief: bool = False, progress: bool = False) -> Verdict:
    """Return the verdict on a run, from about so many of its observations; it is kept in the run's summary.

    It reads the log without its truth (`blind`).  A `brief` one has a fiftieth of the work for searches that filter the
    log again (`kalmark.diagnosis.trials`): `left_out` of the verdict names those that it cannot pay.  With `progress`,
    standard error shows a bar.  Raises KalmarkError if the log of the run cannot be read again.

    >>> from kalmark.config import build_slam
    >>> from kalmark.simulate import load_world, simulate
    >>> world = load_world("cloister", ["steps=60"])
    >>> log = simulate(world)
    >>> run = km.record(build_slam(world.config(), log), log, progress=False)
    >>> verdict = diagnose(run)
    >>> verdict.map, [cause.name for cause in verdict.causes if not cause.harmless]
    ('ok', [])
    """
    run.run_plugins()
    seen, log = blind(run)
    trials = Trials.of(log, brief, progress)
    found = _of_causes(seen, log, most, trials)
    if trials.left_out:
        found = _with_left_out(seen, found, trials)
    causes = [replace(cause, cure="") if is_configured(run.config, cause.cure) else cause for cause in found.causes]
    verdict = _with_signs(seen, replace(found, causes=tuple(causes)))
    if not run.summary:
        run.evaluate()
    summary = run.summary
    summary["verdict"] = verdict.as_dict()
    first = next((cause.name for cause in verdict.causes if not cause.harmless), "noise")
    if first not in ("noise", MISFIT, UNCHECKED) and not first.endswith(("_sigma", "_noise")):
        summary["warnings"] = [w.replace(TOO_SMALL, f"see {first} in the verdict") for w in summary["warnings"]]
    return verdict


def _with_left_out(run: Run, verdict: Verdict, trials: Trials) -> Verdict:
    """Return a verdict that names the searches which the budget did not pay: no map is ok that then does not fit."""
    now, causes = fit_of_run(run), verdict.causes
    misfit = now.mean > MISFITS_ALL or misfits_from(now) is not None
    if verdict.map == OK and misfit and not all(trials.left_out.values()):
        line = next(iter((*window_warnings(run), *_all_misfit(run))), MISFITTING)
        verdict = replace(verdict, map=DOUBTFUL, causes=(Cause(MISFIT, begin_s(run), 0.0, line), *causes))
    return replace(verdict, left_out=tuple(what + since for what, since in trials.left_out.items()))


def _of_causes(run: Run, log: Log, most: int, trials: Trials) -> Verdict:
    """Return the verdict by what is found in the log: what explains most is taken out, and the rest is judged so."""
    off, explained = readings_off(run, log, trials)
    first = _structural(run, log, off)
    alarmed = any(not cause.harmless for cause in first)
    found = None if explained else gross(run, log, trials, alarmed)
    if found is None:
        return _with_cure(run, log, _judged(run, log, first, most, trials), alarmed, most, trials)
    mistake, without = found
    cause = _of_mistake(mistake)
    if mistake.of:
        error = Finding(mistake.name, mistake.of, mistake.gain, 0.0, mistake.value, unit=mistake.unit)
        verdict = _with_cure(run, log, _judged(run, log, first, most, trials), alarmed, most, trials, error)
        tried = len(run.history.d2) <= AT_ONCE and _cure_of(error) not in trials.left_out
        if tried or mistake.name in [c.name for c in verdict.causes]:
            return verdict
        return replace(verdict, map=worst_status(verdict.map, DOUBTFUL), causes=(cause, *verdict.causes))
    if without is None:
        return Verdict(WRONG, (cause, *(c for c in first if c.name in (COPIES, "gap") or c in off)), AGAIN)
    verdict = _judged(run, log, first, most, trials)
    cured = _with_cure(run, log, verdict, alarmed, most, trials, least=mistake.gain)
    others = verdict.search is not None and OUTLIERS not in [c.name for c in verdict.causes]
    untried = max((f.gain for f in _steady(verdict.search) if not _own_cure(run, f)), default=0.0)
    if cured is not verdict or untried > mistake.gain or (mistake.name == OUTLIERS and others):  # it explains more
        return cured
    bent, off_m = _bent(run, without.run)
    rest = _judged(*without, _structural(*without, off), most, trials)
    shift_m = max(rest.shift_m or 0.0, off_m)
    return replace(rest, map=worst_status(bent, rest.map), causes=(cause, *rest.causes), shift_m=shift_m)


def _with_cure(
    run: Run, log: Log, verdict: Verdict, alarmed: bool, most: int, trials: Trials, *also: Finding,
    least: float = 0.0,
) -> Verdict:  # fmt: skip
    """Return a verdict in which the small errors with which the log is likeliest are taken out by their cures.

    That is done one after the other, and what is left of one belongs to it: so far away the problem was not linear.
    """
    suspects = _suspects(verdict.search, TRIED)
    doubted = alarmed or worst_status(verdict.map, *verdict.robots.values()) != OK
    doubted |= fit_of_run(run).mean > MISFITS_ALL or bool(also)
    if len(run.history.d2) > AT_ONCE:
        trials.left_out |= {f"cures (tried in logs of up to {AT_ONCE} observations)": ""} if doubted else {}
        return verdict
    if not doubted and not any(f.name == LATE or f.begins for f in suspects):  # whose sizes are so far from linear
        return verdict
    tried: Iterable[Finding] = chain(also, suspects, _of_less_certain_controls(run, log, most, trials))
    taken, at, rest, partly = dict[tuple[str, ...], Finding](), (run, log), verdict, False
    for _ in range(ROUNDS):
        gain, without, changed, one = _likeliest_cure(*at, tried, trials)
        if one is None or gain < LEAST_GAIN:
            break
        have = [taken[key]] if (key := (one.name, *one.of, str(one.since_s))) in taken else []
        taken[key] = joined([*have, replace(one, gain=gain, noise=1.0, errors=1.0)])  # of other observations
        partly = without is at[0]
        if partly:
            break
        at = without, changed
        rest = _judged(*at, _structural(*at, []), most, trials)
        names, other = [f.name for f in taken.values()], SHARE * sum(f.gain for f in taken.values())
        tried = [f for f in _suspects(rest.search, 1) if f.name in names or f.gain > other]
        if fit_of_run(without).mean > MISFITS_ALL:
            tried = chain(tried, _of_less_certain_controls(*at, most, trials))
    if not taken or sum(one.gain for one in taken.values()) < least:
        return verdict
    causes = [_cause(run, f, log) for f in sorted(taken.values(), key=lambda f: -f.gain)]
    left = [c for c in rest.causes if c.name not in [f.name for f in taken.values()]]
    worst = {c.name for c in verdict.causes[: 0 if partly else 1]}
    before = [c for c in left if c.name in worst and not c.harmless][:1]  # is not explained
    after = (c for c in left if c not in before)
    status = worst_status(verdict.map, _bent(run, at[0])[0], DOUBTFUL if partly else OK)
    return replace(verdict, map=status, causes=(*before, *causes, *after))


def _likeliest_cure(
    run: Run, log: Log, tried: Iterable[Finding], trials: Trials
) -> tuple[float, Run, Log, Finding | None]:
    """Return the cure with which the log of a run is likeliest, as `without_error`.

    After one with which a log fits that did not, only other sizes of that error are tried.
    """
    best: tuple[float, Run, Log, Finding | None] = 0.0, run, log, None
    fitted, named = fit_of_run(run).mean < FITS, ""
    for finding in tried:
        if named in ("", finding.name):
            best = max(best, without_error(run, log, finding, trials), key=lambda of: of[0])
        if not fitted and best[3] is not None and fit_of_run(best[1]).mean < FITS:
            named = best[3].name
    return best


def _of_less_certain_controls(run: Run, log: Log, most: int, trials: Trials) -> Iterator[Finding]:
    """Yield the systematic errors that a search finds by associations of less certain controls."""
    wide = associated(run, log, trials)
    if wide is not run:
        with suppress(KalmarkError, np.linalg.LinAlgError):
            search = search_causes(wide, log, most, max(AT_ONCE, MORE * most), trials).search
            yield from [f for f in _steady(search) if f.unit != TIMES][:TRIED]


def _suspects(search: Search | None, most: int) -> list[Finding]:
    """Return the likeliest errors of a search that are tried: those that are certain, and one that may explain more."""
    sure = _steady(search)[:most]
    may_be = search.suspects[:1] if search else []
    return sure + [f for f in may_be if all(f.gain > one.gain for one in sure)]


def _steady(search: Search | None) -> list[Finding]:
    """Return the systematic errors and larger noise that a search found, the one that explains most first."""
    found = search.found if search else ()
    steady = (f for f in found if f.is_steady or f.begins or (f.unit == TIMES and not f.overstated))
    return sorted(steady, key=lambda f: -f.gain)


def _cure_of(finding: Finding) -> str:
    """Return the words for the trial of the cure of a finding."""
    return f"the cure of {finding.name}"


def _own_cure(run: Run, finding: Finding) -> str:
    """Return the line that cures a finding, without those of others that explain as much."""
    return finding_text(replace(finding, alike=()), run.config)[1]


def without_error(run: Run, log: Log, finding: Finding, trials: Trials) -> tuple[float, Run, Log, Finding]:
    """Return by how much likelier the log of a run is with the cure of a finding, its run and log with it, and that.

    Where the budget pays for the first part of the log alone, run and log are as they are.
    """
    if finding.begins:
        changed = without_onset(run, log, finding)
        made = None if changed is None else (run.config, changed, list(changed.events))
    else:
        made = with_cure(run.config, log, _own_cure(run, finding))
    if made is None:
        return 0.0, run, log, finding
    config, changed, every = made
    events = trials.payable(_cure_of(finding), run, every, 1, 1)
    after = trials.filter(config, changed, events) if events else None
    if after is None:
        return 0.0, run, log, finding
    now, then = fit_of_run(run), fit_of_run(after)
    if len(events) == len(every):
        return likelihood_gain(now, then), after, changed, finding
    return likelihood_gain(Fit(*(column[: len(then.values)] for column in now)), then), run, log, finding


def _bent(run: Run, without: Run) -> tuple[str, float]:
    """Return the status of a map by its shape in a run without a cause, and by what that is off, m, beyond its sigma.

    Landmarks without ids are compared with those next to them: two of which one is left were one thing.
    """
    (mine, sigmas), (places, _) = (r.landmarks.positions() for r in (run, without))
    names = [[str(i) for i in r.landmarks.ids] for r in (run, without)]
    if len(places) < NEEDED or len(mine) < NEEDED:
        return WRONG, 0.0
    at = np.array([names[1].index(name) if name in names[1] else -1 for name in names[0]])
    if (run.history.id == "").any():
        if len(run.history.poses) == len(without.history.poses):
            known = ~(while_lost(run.history) | while_lost(without.history))
            mine = rigid(*(r.history.poses[known, : run.history.d] for r in (run, without)))(mine)
        nearest = cKDTree(np.nan_to_num(places)).query(np.nan_to_num(mine))[1]
        at = np.where(np.isin(names[0], run.history.id), at, nearest)
    both = np.isfinite(mine).all(axis=1) & np.isfinite(places[at]).all(axis=1) & (at >= 0)
    both &= np.isin(np.array(names[1])[at], without.history.landmark)  # those of surveys alone are as these are
    if both.sum() < NEEDED:
        return WRONG, 0.0
    mine, twice, places = mine[both], both.sum() - len(np.unique(at[both])), places[at[both]]
    off, sigma = np.linalg.norm(rigid(mine, places)(mine) - places, axis=1), _sigma(sigmas[both])
    off_m, extent_m = math.sqrt(float(np.mean(off**2))), rmse(places - places.mean(axis=0))
    wrong = twice + int(((off > SIGMAS * sigma) & (off > LEAST * extent_m)).sum())
    status = _status(off_m, extent_m, float(np.median(sigma)))
    return worst_status(status, DOUBTFUL if wrong > FEW * len(at) else OK), 0.0 if status == OK else off_m


def _with_signs(run: Run, verdict: Verdict) -> Verdict:
    """Return a verdict that no warning of the run contradicts, with the status of each robot's path.

    A path is at best what the map is, and a robot whose observations do not fit maps.  Where nothing is mapped, or all
    of it was known, the path is what is judged.
    """
    found, at_end = signs(run, run.summary), [*unchecked_ends(run)]
    misfit = (sign.status for _, sign in at_end if sign.status != UNCHECKED)
    status = worst_status(verdict.map, *(sign.status for sign in found), *misfit)
    robots = {
        name: worst_status(
            status,
            verdict.robots.get(name, OK),
            *(s.status for of, s in at_end if of == name),
            *(DOUBTFUL for _ in run.history.carried(name)),
        )
        for name in run.history.robots
    }
    if not {*run.landmarks.ids} - {*run.landmarks.exact}:
        status = worst_status(status, *robots.values())
    told = [s for s in (*found, *(s for _, s in at_end)) if worst_status(verdict.map, s.status) != verdict.map]
    more = [Cause(s.status if s.status == UNCHECKED else MISFIT, begin_s(run), 0.0, s.line) for s in told]
    return replace(verdict, map=status, causes=(*verdict.causes, *more), robots=robots)


def _of_mistake(mistake: Mistake) -> Cause:
    return Cause(mistake.name, mistake.since_s, mistake.gain, mistake.evidence, mistake.cure)


def status_of(causes: Iterable[Cause]) -> str:
    """Return the best status of a map with causes that its shape does not show."""
    return worst_status(*(SEVERITY.get(cause.name, DOUBTFUL) for cause in causes if not cause.harmless))


def _judged(run: Run, log: Log, first: list[Cause], most: int, trials: Trials) -> Verdict:
    """Return the verdict by the batch solution, by the innovations alone where there is none."""
    limit = max(AT_ONCE, MORE * most)
    if len(run.landmarks) <= most // SEEN and any(not cause.harmless for cause in first):
        every = min(max(most, AT_ONCE), len(run.history.d2))  # its reason may show in all of the log only
        most = max(most, every) if trials.pays(f"a batch solution of {every} observations", SOLVED * every) else most
    try:
        return _by_batch(run, log, first, search_causes(run, log, most, limit, trials))
    except (KalmarkError, np.linalg.LinAlgError):
        found = [Cause(MISFIT, begin_s(run), 0.0, line) for line in (*window_warnings(run), *_all_misfit(run))]
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
    causes.sort(key=lambda c: c.harmless)
    checked = f"batch solution of {len(found.given.associations.landmark)} observations"
    figures = effect.sigma_factor, effect.accuracy_m, effect.shape_accuracy_m, effect.shift_m
    return Verdict(status, tuple(causes), checked, *figures, effect.robots, found.search)


def _found(run: Run, log: Log, first: list[Cause], found: Searched, effect: Effect) -> list[Cause]:
    """Return the causes that a search found, and controls that jump: between segments it looks for no jumps."""
    causes = causes_of(run, found.search, effect.accuracy_m or 0.0, log)
    if found.given.segments is not None and not any(cause.name in JUMPS for cause in causes):
        causes += odd_controls(run, log)
    if not any(cause.name == COPIES for cause in first):  # then that makes the filter overconfident
        causes += _too_sure(run, effect)
    return sorted(causes, key=lambda cause: -cause.score)


def _all_misfit(run: Run) -> Iterator[str]:
    """Yield the cause that the observations do not fit in the whole run, or that none was used."""
    outcome = run.history.outcome
    if len(outcome) and not np.isin(outcome, ("associated", "new")).any():
        yield f"none of the {len(outcome)} observations was used"
    mean = fit_of_run(run).mean
    if MISFITS_ALL < mean < np.inf:
        yield f"d2 per degree of freedom is {figure(mean, 2)} over all observations, where 1 is expected"


def begin_s(run: Run) -> float:
    """Return the time of the first scan in the log."""
    return float(run.history.t_ns[0]) * 1e-9 if len(run.history.t_ns) else 0.0


# ------------------------------------------------------------------ the causes
def causes_of(run: Run, search: Search, accuracy_m: float = 0.0, log: Log | None = None) -> list[Cause]:
    """Return the causes that a search found; a landmark that moves by less than the map's accuracy does not matter.

    A noise that is stated too large has no cure where its errors last: with it the filter would be overconfident.
    """
    again = restarts(run.history)  # their starts were made uncertain for the batch solution
    matter = [f for f in search.found if f.moved_m is None or f.moved_m >= accuracy_m]
    matter = [f for f in matter if not (_is_of_gap(run, f) or (f.name == "start" and again))]
    lasting = {f.of for f in matter if f.name == "correlated_noise"}
    causes = [(f, _cause(run, f, log)) for f in merge_jumps(matter, begin_s(run))]
    return [replace(c, cure="") if f.overstated and f.of in lasting else c for f, c in causes]


def _is_of_gap(run: Run, finding: Finding) -> bool:
    """Return whether a finding is an error of controls while there was none: then the gap is named."""
    since_s = begin_s(run) + (finding.since_s or 0.0)
    until_s = begin_s(run) + finding.until_s if finding.begins else since_s
    mine = (gap for gap in run.summary.get("gaps", ()) if (gap["robot"], gap["kind"] in KINDS) == (finding.of[0], True))
    within = any(gap["start_s"] <= since_s and until_s <= gap["end_s"] for gap in mine)
    return within and finding.W is not None and bool(finding.W.any())


def _increments_s(run: Run, robot: str) -> float:
    """Return the interval of the increments of a robot, s, 0 if its controls are velocities."""
    controls = run.history.controls.get(robot)
    if controls is None or controls.number < 2 or run.final_slam().robots[robot].motion.held:
        return 0.0
    return (controls.last_ns - controls.first_ns) * 1e-9 / (controls.number - 1)


def _cause(run: Run, finding: Finding, log: Log | None) -> Cause:
    since_s, harmless = begin_s(run) + (finding.since_s or 0.0), finding.overstated
    odd = _controls(run, log, finding.of[0]).odd(since_s) if finding.name in JUMPS and log is not None else None
    name, told = finding.name, finding_text(finding, run.config)
    cut = (run.config.get("log") or {}).get("increments") == "cut"
    if name == LATE and not cut and 0.0 < finding.value < _increments_s(run, finding.of[0]):
        more = "a scan between two increments counts at the end of the first, which may be why"
        told = f"{told[0]}; {more}", told[1]
    if odd is not None:
        name, told = JUMP, odd_control_text(finding, odd)
    if finding.begins:
        end_s = begin_s(run) + finding.until_s
        told = f"from t={since_s:.1f} {'s on' if end_s == math.inf else f'to {end_s:.1f} s'} {told[0]}", ""
    return Cause(name, since_s, finding.gain, *told, harmless)


def _controls(run: Run, log: Log, robot: str) -> Controls:
    return Controls(log, tuple(run.final_slam().robots[robot].motion.columns), robot)


def odd_controls(run: Run, log: Log) -> Iterator[Cause]:
    """Yield the controls of each robot that jump themselves, by innovations: scans do not fit right after them.

    The score is half of the chi-square of these scans.
    """
    h, (chi2, worst) = run.history, misfits(run)
    for robot in dict.fromkeys(h.robot.tolist()):
        bad = [k for k in worst.tolist() if h.robot[k] == robot][:WORST]
        controls = _controls(run, log, robot)
        odd = {o.t_s: (o, k) for k in bad if (o := controls.odd(h.t_ns[k] * 1e-9)) is not None}
        if odd:
            most, _ = max(odd.values(), key=lambda of: of[0].times)
            at = [f"{t_s:.1f}" for t_s in sorted(odd) if t_s != most.t_s]
            finding = Finding(JUMP, (robot, "", *at), 0.0, 0.0, 0.0)
            score = 0.5 * float(sum(chi2[k] for _, k in odd.values()))
            yield Cause(JUMP, min(odd), score, *odd_control_text(finding, most))


def is_misplaced_survey(run: Run, finding: Finding) -> bool:
    """Return whether a finding is a surveyed landmark that the map has elsewhere than its observations."""
    names = [str(id_) for id_ in run.landmarks.ids]
    if finding.name != "landmark_prior" or finding.at is None or finding.of[0] not in names:
        return False
    k, d = names.index(finding.of[0]), len(finding.at)
    off, P = run.landmarks.means[k][:d] - finding.at, run.landmarks.covariances[k][:d, :d]
    return bool(np.linalg.norm(off) > SIGMAS * np.hypot(finding.sigma, np.sqrt(np.trace(P))))


def _structural(run: Run, log: Log, off: list[Cause]) -> list[Cause]:
    """Return the causes that residuals cannot show: a place that is mapped twice still fits its data."""
    if not run.summary:
        run.evaluate()
    return [
        *find_kidnaps(run, log),
        *gaps(run),
        *_carried(run, log),
        *cause_of_repeats(run.summary),
        *split_landmarks(run),
        *unseen_landmarks(run),
        *_remapped_landmarks(run),
        *fits_nothing(run),
        *off,
        *abandoned_surveys(run),
        *_started_elsewhere(run),
        *_placed_elsewhere(run),
        *_lost(run),
        *_copied(run, log),
    ]


def _started_elsewhere(run: Run) -> Iterator[Cause]:
    """Yield the robots that started elsewhere than stated; the map was moved onto their fixes, which does no harm."""
    for start in run.history.starts:
        restart = restarts(run.history).get(start.robot)
        if restart is not None:
            _, evidence, cure = started_at(run.config, start, restart.onto, restart.agreed, restart.variance)
            evidence += f"; the map was moved onto them at t={restart.t_ns * 1e-9:.1f} s"
            first = run.history.fixes[: restart.fixes]
            score = 0.5 * sum(float(fix.z @ np.linalg.solve(fix.Z, fix.z)) for fix in first)
            yield Cause("start", start.t_ns * 1e-9, score, evidence, cure, True)


def _placed_elsewhere(run: Run) -> Iterator[Cause]:
    """Yield the times when readings that agree moved a robot that others had placed: one of both is wrong."""
    for mine in placements(run.history):
        first, of = mine[0], words_of(mine)
        if first.before < NEEDED and len(mine) == 1:
            yield Cause("start", first.t_ns * 1e-9, 0.0, f"{of}, as few had fitted before", "", True)
        else:
            evidence = (
                f"{of}, from t={first.t_ns * 1e-9:.1f} s on: it was lost, or they jumped, as those of receivers do"
            )
            cure = "leave their rows out where they jump, or state more noise for them"
            yield Cause(MISFIT, first.t_ns * 1e-9, _left_out_until(run, mine), evidence, cure)


def _lost(run: Run) -> Iterator[Cause]:
    """Yield the robots that nothing places any more at the end of the run."""
    for one in find_lost_robots(run):
        evidence = f"the last {one.number} {one.of} of {one.robot}, from t={one.since_s:.1f} s on, were left out: "
        evidence += "the path or these measurements are wrong"
        cure = "compare its controls with these from then on, or state more noise"
        yield Cause("lost", one.since_s, 0.5 * MOST * one.number, evidence, cure)
    state, end_s = run.final_slam().state, float(run.history.t_ns.max(initial=0)) * 1e-9
    for robot, of in state.evidence.items():
        since_s, number = max(of.since_ns * 1e-9, begin_s(run)), count(len(of.missed), "landmark")
        lasts = end_s - since_s >= LEAST_S and not state.moving[robot].held.is_adrift
        if of.ratio <= -math.log(ODDS) and lasts:
            evidence = f"{robot} does not see {number} where it should from t={since_s:.1f} s on: it is elsewhere"
            cure = "look for a motion at that time that the controls do not contain"
            yield Cause("lost", since_s, -of.ratio, evidence, cure)


def _left_out_until(run: Run, placed: Sequence[RelocatedRobot]) -> float:
    """Return half of the chi-square of the readings that moved a robot: those left out in a row until it was moved."""
    h, now, score = run.history, fit_of_run(run), 0.0
    of = (h.robot[h.step] == placed[0].robot) & (h.sensor == placed[0].sensor)
    for one in placed:
        mine = np.flatnonzero(of & (h.t_ns[h.step] <= one.t_ns))
        used = np.flatnonzero(h.outcome[mine] != "rejected")
        rows = mine[used[-1] + 1 if len(used) else 0 :]
        score += 0.5 * float(np.minimum(h.d2[rows], MOST * now.dof[rows]).sum())
    return score


def _remapped_landmarks(run: Run) -> Iterator[Cause]:
    """Yield the landmarks that were begun again elsewhere: moved, or begun by an outlier.  It does no harm."""
    h = run.history
    for change in (c for c in h.changes if c.reason == BEGUN_AGAIN):
        rows = np.flatnonzero((h.id == change.landmark) & (h.step <= change.step))
        now_s, begun_s = (float(h.t_ns[step]) * 1e-9 for step in (change.step, h.step[rows].min(initial=change.step)))
        score, cure = 0.5 * MOST * len(rows), f"leave out its first observation, at t={begun_s:.1f} s"
        if (h.outcome[rows] != "rejected").sum() > 1:  # there, too, observations agreed
            told = f"landmark {change.landmark} was moved by t={now_s:.1f} s: from then on it is mapped there"
            yield Cause(MOVED, now_s, score, told, "", True)
            continue
        told = f"landmark {change.landmark} was begun by an outlier: from later observations it was begun again"
        yield Cause(MISPLACED, begun_s, score, told, cure, True)


def fits_nothing(run: Run) -> Iterator[Cause]:
    """Yield the cause that most observations without an id are of no landmark: the map does not determine the pose."""
    h, now = run.history, fit_of_run(run)
    mine = (h.id == "") & (h.reason != NO_ID) & ~h.of_own
    share = float(np.mean(now.values[mine] < LOST)) if mine.any() else 1.0
    if share < LEAST_SHARE:
        evidence = f"{share:.0%} of the {int(mine.sum())} observations without an id are of a landmark in the map"
        cure = "the scans contradict the controls: look at mounts, signs and units of both, and their times"
        yield Cause(MISFIT, begin_s(run), 0.5 * LOST * float(mine.sum()), f"only {evidence}", cure)


def readings_off(run: Run, log: Log, trials: Trials) -> tuple[list[Cause], bool]:
    """Return the faults of sensors of the state, those that still do not fit, and whether that explains the run.

    They are further off than their noise and that of the pose allow.  More noise explains nothing with certainty.
    """
    now = fit_of_readings(run)
    if not now.off() and (not now.sensors() or len(run.landmarks) or fit_of_run(run).mean < MISFITS_ALL):
        return [], False
    found, after = reasons(run, log, trials)
    causes = [replace(_of_mistake(cause), since_s=begin_s(run)) for cause in found]
    left = {*after.off()} if found and after is not None else {*now.off()}
    for robot, sensor in (of for of in now.off() if of in left):
        mine = now.of((robot, sensor))
        dof, mean = int(now.fit.dof[mine].sum()), now.mean((robot, sensor))
        score, of = 0.5 * dof * (mean - 1.0 - float(np.log(mean))), f"{len(mine)} readings of {sensor} of {robot}"
        evidence = f"d2 per degree of freedom is {figure(mean, 2)} over {of}, where 1 is expected"
        cure = "state more noise for it, or look for what lasts: a bias, a delay, its mount, a wrong start"
        causes.append(Cause(MISFIT, begin_s(run), score, evidence, cure))
    fits = after is not None and not left and fit_of_run(after.run).mean < FITS
    return causes, bool(found) and found[0].name != SIGMA and fits


def _copied(run: Run, log: Log) -> list[Cause]:
    """Return the streams of the log that come twice."""
    found = []
    for robot, sensor, number, of, since_s, noticed in repeated_events.copies(run, log):
        what = f"scans of {robot}.{sensor}" if sensor else f"fixes of {robot}" if noticed else f"controls of {robot}"
        evidence = f"{number} of {of} {what} repeat the one before to the last bit: "
        if noticed:
            evidence += "they are no new measurements, and were left out"
            found.append(Cause(COPIES, since_s, float(number), evidence, "give each measurement once", True))
            continue
        evidence += "the log has them twice"
        harmless = not sensor and run.final_slam().robots[robot].motion.held  # the same velocity goes on
        found.append(Cause(COPIES, since_s, float(number), evidence, "leave out every second of them", harmless))
    return found


def abandoned_surveys(run: Run) -> list[Cause]:
    """Return the surveyed landmarks that the filter found elsewhere and mapped again, which does no harm."""
    h, found, now = run.history, [], {str(id_): k for k, id_ in enumerate(run.landmarks.ids)}
    surveys = {prior.landmark: prior for prior in h.priors}
    for change in (c for c in h.changes if c.reason == ELSEWHERE and c.landmark in surveys and c.landmark in now):
        prior, k, d = surveys[change.landmark], now[change.landmark], h.d
        mean, P = run.landmarks.means[k][:d], run.landmarks.covariances[k][:d, :d] + prior.covariance[:d, :d]
        off, at = mean - prior.mean[:d], ", ".join(figure(float(x)) for x in mean)
        chi2 = float(off @ np.linalg.pinv(P) @ off)
        evidence = (
            f"landmark {change.landmark} is {figure(float(np.linalg.norm(off)))} m from its survey"
            f" ({figure(float(np.sqrt(chi2)), 2)} sigma): the filter left its survey out and mapped it at ({at}) m"
        )
        cure = f"correct {change.landmark} in the file of the survey, or leave it out"
        found.append(Cause("landmark_prior", float(h.t_ns[change.step]) * 1e-9, 0.5 * chi2, evidence, cure, True))
    return found


def gaps(run: Run) -> list[Cause]:
    """Return the gaps in the controls; one that was bridged, and after which the pose was known, is harmless.

    Not if a place that was mapped before it is mapped again after it: then the robot was lost.
    """
    summary, found = run.summary, []
    stops = [gap for gap in summary.get("gaps", ()) if gap["kind"] in KINDS]
    for gap in (gap for gap in stops if gap["action"] == "ignore" or is_reported(gap)):
        lasts, bridged = gap["end_s"] - gap["start_s"], gap["action"] == "widen" and gap["known_s"] is not None
        anew = any(_mapped_again(run, part, gap["start_s"]) for part in summary.get("repeats", ()))
        cure = f"--set robots.{gap['robot']}.gaps=widen" if gap["action"] == "ignore" else ""
        again = f", which was bridged: it was localized again at t={gap['known_s']:.1f} s" if bridged else ""
        told = ", and it was not localized again" if stayed_lost(gap) else again
        told = ", and places are mapped again after it" if anew else told
        evidence = f"the control of {gap['robot']} stops for {figure(lasts)} s{told}"
        cure = cure or ("--set upkeep.repeats=merge" if anew else "")
        found.append(Cause("gap", gap["start_s"], lasts, evidence, cure, bridged and not anew))
    return found + [Cause(JUMP, begin_s, 0.0, line, "", True) for begin_s, line in controls_left_out(summary)]


def _carried(run: Run, log: Log) -> Iterator[Cause]:
    """Yield the robots that were elsewhere and found: from the start, by a control, or carried.  It does no harm."""
    for gap in run.summary.get("gaps", ()):
        if gap["kind"] == CARRIED:
            since_s, told = gap["start_s"], (carried_line(gap), "")
            odd = _controls(run, log, gap["robot"]).odd(since_s, gap["end_s"] - since_s)
            name = "start" if since_s <= begin_s(run) else "kidnapped"
            if odd is not None:
                name, since_s, told = (
                    JUMP,
                    odd.t_s,
                    odd_control_text(Finding(JUMP, (gap["robot"], ""), 0.0, 0.0, 0.0), odd),
                )
            yield Cause(name, since_s, math.log(ODDS), *told, True)


def _mapped_again(run: Run, part: dict[str, Any], t_s: float) -> bool:
    """Return whether most of a repeat's older landmarks were seen first before a time, and the newer ones after it."""
    h = run.history
    names, first = np.unique(h.landmark, return_index=True)
    at = dict(zip(names.tolist(), (h.t_ns[h.step[first]] * 1e-9).tolist(), strict=True))
    before = [(at.get(a, np.inf) < t_s) & (at.get(b, -np.inf) >= t_s) for a, b in part["landmarks"]]
    return float(np.mean(before)) > MOST_PAIRS


def cause_of_repeats(summary: dict[str, Any]) -> list[Cause]:
    """Return the parts of the map that agree, as if one place were mapped twice, as one cause: the largest of them."""
    parts = sorted(summary.get("repeats", ()), key=lambda part: -len(part["landmarks"]))
    if not parts:
        return []
    number, shift = len(parts[0]["landmarks"]), figure(float(np.linalg.norm(parts[0]["shift_m"])))
    more = f"; {count(len(parts) - 1, 'more such part')}" if len(parts) > 1 else ""
    evidence = f"{number} landmarks repeat {number} others {shift} m away: one place is mapped twice{more}"
    since_s, score = min(part["start_s"] or 0.0 for part in parts), sum(part["score"] for part in parts)
    return [Cause("map_repeats", since_s, score, evidence, "--set upkeep.repeats=merge")]


def find_kidnaps(run: Run, log: Log) -> Iterator[Cause]:
    """Yield the kidnapped robots: their earlier landmarks vanish at once, and the landmarks in view are new.

    Chance does not do that, or the place is in the map already.  Not if its controls had stopped: then it may have
    driven.  With a control that is far larger than all others it is its odometry that jumps.
    """
    h, repeat = run.history, next(iter(run.summary.get("repeats", ())), None)
    stops = [(gap["robot"], gap["start_s"], gap["end_s"] + STOPPED_S) for gap in run.summary.get("gaps", ())]
    moments = [
        m
        for m in doubled_landmarks.vanished_landmarks(run)
        if not any(m.robot == r and a <= m.t_s <= b for r, a, b in stops)
    ]
    far_m, again = float(np.linalg.norm(repeat["shift_m"])) if repeat else 0.0, list[doubled_landmarks.Moment]()
    if repeat and far_m > doubled_landmarks.landmark_spacing(run):
        last = int(np.searchsorted(h.t_ns, round((repeat["start_s"] or 0.0) * 1e9)))
        again = [moment for moment in moments if last - doubled_landmarks.NEAR_SCANS <= moment.step <= last]
    first = max(again or moments, key=lambda moment: (moment.score, moment.number), default=None)
    if first is None or not (again or first.score > 0.0):
        return
    far, others = (f" by {figure(far_m)} m", "them again") if again else ("", "others")
    told = f"it sees none of the {first.number} landmarks that it saw just before, and maps {others}"
    evidence = f"{first.robot} was elsewhere{far} from t={first.t_s:.1f} s on: {told}"
    score = max(first.score, repeat["score"] if repeat and again else 0.0)
    odd = _controls(run, log, first.robot).odd(first.t_s)
    if odd is not None:
        yield Cause(JUMP, odd.t_s, score, *odd_control_text(Finding(JUMP, (first.robot, ""), 0.0, 0.0, 0.0), odd))
        return
    yield Cause("kidnapped", first.t_s, score, evidence)


def split_landmarks(run: Run) -> Iterator[Cause]:
    """Yield that things are in the map twice, side by side: their landmarks are seen in turn, never together."""
    pairs = doubled_landmarks.find_split_landmarks(run)
    if pairs:
        number, mapped = len({pair.name for pair in pairs}), len(run.landmarks)
        first = ", ".join(f"{pair.name} and {pair.other}" for pair in pairs[:LISTED])
        told = "seen in turn and never together with their neighbours, so they are the same things"
        evidence = f"{number} of {mapped} landmarks are {told} ({first}{', ...' if len(pairs) > LISTED else ''})"
        cure = "a noise that is stated too small splits landmarks: state more"
        yield Cause(
            "split_landmarks", begin_s(run), sum(p.score for p in pairs), evidence, cure, number <= FEW * mapped
        )


def unseen_landmarks(run: Run) -> Iterator[Cause]:
    """Yield that landmarks are not seen again where they should be: they are in the map twice, or nowhere.

    Of landmarks that are there a share `FEW` is marked by chance.  With ids, the times are counted
    at which landmarks came into view as before.
    """
    marks, h, found = run.landmarks, run.history, doubled_landmarks.unseen_counts(run)
    names = [name for name in marks.ids if name in marks.unseen]
    by_chance = float(pdtrc(len(names) - 1, FEW * len(marks))) > LIKELY if names else True
    if names:
        where = dict(zip(marks.ids, marks.positions()[0].tolist(), strict=True))
        some = ", ".join(f"{name} at ({', '.join(f'{x:.1f}' for x in where[name])}) m" for name in names[:LISTED])
        some += ", ..." * (len(names) > LISTED)
        evidence = f"{len(names)} of {len(marks)} landmarks were not seen again where they should be: {some}"
        first = h.t_ns[h.step[np.isin(h.landmark, [str(name) for name in names])]].min(initial=h.t_ns[-1])
        score = -sum(marks.log_odds[name] for name in names)
        cure = "they moved, or are in the map twice: --set upkeep.gone=remove takes them out"
        yield Cause("unseen_landmarks", float(first) * 1e-9, score, evidence, cure, by_chance)
    if found is not None and by_chance:
        evidence = f"in {found.unseen} of {found.number} times a landmark came into view as before it was not seen"
        cure = "things are in the map twice, or came and went: look at the errors of the controls, and at what moves"
        yield Cause("unseen_landmarks", found.since_s, found.score, evidence, cure)


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


# ------------------------------------------------------------------ what they do to the map
@dataclass(frozen=True)
class Effect:
    """Effect of the causes on a map: as in `Verdict`; `claimed` is the filter's sigma over what the data allow.

    `robots` has the status of the path of each robot, by the same measure.

    >>> Effect().status, Effect(sigma_factor=1.3).sigma_factor
    ('ok', 1.3)
    """

    status: str = OK
    sigma_factor: float | None = None
    accuracy_m: float | None = None
    shape_accuracy_m: float | None = None
    shift_m: float | None = None
    claimed: float | None = None
    dof: int = 0
    robots: dict[str, str] = field(default_factory=dict)


def effect_of(run: Run, found: Searched) -> Effect:
    """Return the effect of the causes on the shape of a run's map and on its sigmas."""
    rows = list(_shared(run, found.search))
    if not rows:
        return Effect()
    mine, its = (np.array(column) for column in zip(*rows, strict=True))
    d, first, cured = found.batch.state.d, found.search.first, found.search.linear
    places, moved = (state.groups[LANDMARKS][its, :d] for state in (found.batch.state, cured.moved()))
    steady = replace(first, z=cured.z, w=cured.w).moved().groups[LANDMARKS][its, :d]  # the noise as it was stated
    mapped = filtered_map(run)
    lines = np.array([run.landmarks.kinds[k] == "wall" for k in mine])
    angle = np.where(lines, found.batch.state.groups[LANDMARKS][its, -1], np.nan)
    onto, extent = rigid(places, moved), rmse(moved - moved.mean(axis=0))
    robots = dict(_paths(run, found, onto, extent)) if len(rows) > d else {}
    off = _off(onto, places, moved, angle)
    off = max([off, *_off_instead(found.search, places, its, angle)], key=rmse)
    by_steady = rmse(_off(rigid(places, steady), places, steady, angle))
    P = np.array([mapped[run.landmarks.ids[k]][1][:d, :d] for k in mine])
    (stated, bare_stated), (honest, bare_honest) = (_sigmas(each, places, its, ~lines) for each in (first, cured))
    filtered = _sigma(P)
    shift_m = float(np.sqrt(max(rmse(off) ** 2 - rmse(honest[:, None]) ** 2, 0.0)))
    free = (filtered > 0) & (stated > 0)
    if not free.any():
        return Effect(shift_m=shift_m, robots=robots)
    status = _status(shift_m, extent, float(np.median(filtered[free])))
    shift_m = max(shift_m, by_steady)  # of causes that are certain, which no noise explains: reported, but no alarm
    ratio, waited = filtered[free] / stated[free], np.isin(run.history.outcome, ("tentative", "deferred")).any()
    same_data = not waited and not filter_only_sensors(run.final_slam())  # what waited is not in the batch solution
    comparable = found.given.segments is None and same_data
    claimed = float(np.median(ratio)) if comparable else None
    twice = repeated_events.repeated_scans(run).any()
    over = 1.0 / claimed if claimed is not None and (claimed < TOO_SURE or twice) else 1.0
    factors = np.hypot(honest[free] / stated[free] * over, shift_m / filtered[free])
    accuracy_m = float(np.median(factors * filtered[free]))
    end = run.history.map_at(len(run.history.t_ns))
    kept = dict(zip(end.ids, end.shape[:, :d, :d], strict=True))
    bare = _sigma(np.array([kept.get(run.landmarks.ids[k], P[row]) for row, k in enumerate(mine)]))
    larger = np.divide(bare_honest, bare_stated, out=np.ones(len(bare)), where=bare_stated > 0) * over
    shape_m = float(np.median(np.hypot(larger * bare, shift_m)[free]))
    return Effect(
        status, float(np.median(factors)), accuracy_m, shape_m, shift_m, claimed, d * int(free.sum()), robots
    )  # fmt: skip


def _status(off_m: float, extent_m: float, sigma_m: float) -> str:
    """Return the status of a map or a path of this sigma that is off by so much, in a map of this extent."""
    share = off_m / max(extent_m, TINY_M)
    if share <= LEAST or off_m <= SIGMAS * sigma_m:
        return OK
    return DOUBTFUL if share < MOST_OFF else WRONG


def _paths(run: Run, found: Searched, onto: Rigid, extent_m: float) -> Iterator[tuple[str, str]]:
    """Yield the status of the path of each robot, `onto` being the motion of the map when the causes are taken out.

    A mount that is not where it is stated bends no map, but each pose of its robot is off.
    """
    d, nodes, end = found.batch.state.d, found.search.linear.problem.nodes, run.history.map_at(len(run.history.t_ns))
    path, moved = (s.groups[POSES][nodes, :d] for s in (found.batch.state, found.search.linear.moved()))
    off = onto(path) - moved
    for start, sigma_m in zip(run.history.starts, _sigma(end.robots).tolist(), strict=True):
        mine = found.given.robot == start.robot
        if mine.any():
            yield start.robot, _status(rmse(off[mine]), extent_m, sigma_m)


def _off(onto: Rigid, places: Array, moved: Array, angle: Array) -> Array:
    """Return by what (K, d) landmarks move beyond a rigid motion of all; lines with normals at an `angle` across."""
    off = onto(places) - moved
    lines = np.isfinite(angle)
    if lines.any():
        n = np.column_stack([np.cos(angle), np.sin(angle)])[lines] @ onto.rotation.T
        off[lines] = np.sum(off[lines] * n, axis=1, keepdims=True) * n
    return off


def _off_instead(search: Search, places: Array, its: Index, angle: Array) -> Iterator[Array]:
    """Yield by what landmarks move with what the log does not distinguish from a cause in its place: either may be."""
    cured = search.linear
    for z, w in search.instead:
        moved = replace(cured, z=cured.z + z, w=cured.w + w).moved().groups[LANDMARKS][its, : places.shape[1]]
        yield _off(rigid(places, moved), places, moved, angle)


def _shared(run: Run, search: Search) -> Iterator[tuple[int, int]]:
    """Yield the numbers of each landmark in the map and in the batch solution."""
    at = {id_: k for k, id_ in enumerate(run.landmarks.ids)}
    return ((at[id_], k) for k, id_ in enumerate(search.linear.problem.ids) if id_ in at)


def _sigmas(linear: Linear, places: Array, its: Index, points: Flags) -> tuple[Array, Array]:
    """Return the sigmas (K,) of the landmarks `its`, at places (K, d): in the world, and of the shape.

    The shape is that of the `points` (K,), of all where there is none.
    """
    d, k, joint = places.shape[1], np.arange(len(its)), linear.reduced.joint()
    dof = len(joint) // len(linear.state.groups[LANDMARKS])
    rows = (its[:, None] * dof + np.arange(d)).ravel()
    P, of = joint[np.ix_(rows, rows)], np.flatnonzero(points if points.any() else ~points)
    return _sigma(P.reshape(len(k), d, len(k), d)[k, :, k]), _sigma(shape_of_points(places, P, of))


def _sigma(P: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.trace(P, axis1=1, axis2=2), 0.0)))
