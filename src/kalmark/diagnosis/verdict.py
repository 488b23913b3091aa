"""The verdict on the map of a run: its status, its accuracy and the causes of misfit, without any truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import takewhile

from kalmark.diagnosis.batch_verdict import Verdict, judged
from kalmark.diagnosis.blind import blind
from kalmark.diagnosis.causes import MOST_OUTLIERS, Finding
from kalmark.diagnosis.cures import CURES, own_cure, steady_errors, with_cures
from kalmark.diagnosis.effect import Effect, shape_without
from kalmark.diagnosis.gross_mistakes import first_misfit, gross, likeliest, misfits_from
from kalmark.diagnosis.lost import unchecked_ends
from kalmark.diagnosis.mistakes import Mistake
from kalmark.diagnosis.named_causes import COPIES, MISFIT, Cause, all_misfit, begin_s, cause_of_mistake
from kalmark.diagnosis.single_ids import MISPLACED, MOVED, OUTLIERS, find_wrong_ids
from kalmark.diagnosis.structural_causes import readings_off, structural_causes, unfitting_measurements
from kalmark.diagnosis.trials import AT_ONCE, FITS, Trials, detecting, fit_of_run, is_configured
from kalmark.diagnosis.trials import MISFIT as MISFITS_ALL
from kalmark.logs.log import Log
from kalmark.results.checked import DOUBTFUL, OK, UNCHECKED, WRONG, worst_status
from kalmark.results.run import Run
from kalmark.results.warnings import TOO_SMALL, signs, window_warnings

__all__ = ["Cause", "Effect", "Verdict", "diagnose"]
OF_OUTLIERS = MISFIT, OUTLIERS, MISPLACED, MOVED  # causes that observations which fit nothing explain


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
    trials = Trials.of(log, brief, progress, detecting(seen))
    found = _of_causes(seen, log, most, trials)
    if trials.left_out:
        found = _with_left_out(seen, found, trials)
    causes = [replace(cause, cure="") if is_configured(run.config, cause.cure) else cause for cause in found.causes]
    verdict = _with_outliers(seen, _with_signs(seen, replace(found, causes=tuple(causes))))
    if not run.summary:
        run.evaluate()
    summary = run.summary
    summary["verdict"] = verdict.as_dict()
    first = next((cause.name for cause in verdict.causes if not cause.harmless), "noise")
    if first not in ("noise", MISFIT, UNCHECKED) and not first.endswith(("_sigma", "_noise")):
        summary["warnings"] = [w.replace(TOO_SMALL, f"see {first} in the verdict") for w in summary["warnings"]]
    return verdict


def _with_outliers(run: Run, verdict: Verdict) -> Verdict:
    """Return a verdict in which observations that fit nothing are a cause, if no other one explains them.

    Where all others fit, they explain a misfit, and landmarks that began with one.  Harmless causes are the last, of
    these outliers, but for a misfit that has no others: they may explain it.
    """
    causes, fused, fine = verdict.causes, run.history.fused, verdict.map == OK
    if all(cause.name in OF_OUTLIERS and (cause.harmless or not cause.score) for cause in causes):
        alone = (~fused).sum() < MOST_OUTLIERS * len(fused) and fit_of_run(run).values[fused].mean() < FITS
        found = unfitting_measurements(run) if fine or alone else []
        kept = [cause for cause in causes if not found or cause.name not in (MISFIT, OUTLIERS)]
        causes = *(replace(cause, harmless=fine) for cause in found), *kept
    alone = all(cause.harmless for cause in causes if cause.name != MISFIT)
    causes = (*sorted(causes, key=lambda c: c.harmless and c.name == OUTLIERS),)
    return replace(verdict, causes=(*sorted(causes, key=lambda c: c.name == MISFIT if alone else c.harmless),))


def _with_left_out(run: Run, verdict: Verdict, trials: Trials) -> Verdict:
    """Return a verdict that names the searches which the budget did not pay: no map is ok that then does not fit."""
    now, causes = fit_of_run(run), verdict.causes
    misfit = now.mean > MISFITS_ALL or misfits_from(now) is not None
    if verdict.map == OK and misfit and not all(trials.left_out.values()):
        if all(cause.harmless for cause in causes):
            line = next(
                iter((*window_warnings(run), *all_misfit(run))), "from some time on the observations do not fit"
            )
            causes = (Cause(MISFIT, begin_s(run), 0.0, line), *causes)
        verdict = replace(verdict, map=DOUBTFUL, causes=causes)
    return replace(verdict, left_out=tuple(what + since for what, since in trials.left_out.items()))


def _of_causes(run: Run, log: Log, most: int, trials: Trials) -> Verdict:
    """Return the verdict by what is found in the log: what explains most is taken out, and the rest is judged so."""
    off, explained = readings_off(run, log, trials)
    first = structural_causes(run, log, off)
    alarmed = any(not cause.harmless for cause in first) or bool(run.history.carried())
    found = None if explained else gross(run, log, trials, alarmed)
    if found is None:
        verdict = judged(run, log, first, most, trials)
        noisy = any(cause.name.endswith("_sigma") and not cause.harmless for cause in verdict.causes)
        alone = likeliest(run, log, trials, first_misfit(run)) if noisy and not alarmed else None
        if alone is None:
            return with_cures(run, log, verdict, alarmed, most, trials)[0]
        found = alone, None
    mistake, without = found
    cause = cause_of_mistake(mistake)
    if mistake.of:
        error = Finding(mistake.name, mistake.of, mistake.gain, 0.0, mistake.value, unit=mistake.unit)
        verdict, _ = with_cures(run, log, judged(run, log, first, most, trials), alarmed, most, trials, error)
        if CURES not in trials.left_out or mistake.name in [c.name for c in verdict.causes]:
            return verdict
        return replace(verdict, map=worst_status(verdict.map, DOUBTFUL), causes=(cause, *verdict.causes))
    if without is None:
        return Verdict(
            WRONG,
            (cause, *(c for c in first if c.name in (COPIES, "gap") or c in off)),
            "log filtered again without the mistake",
        )
    verdict = judged(run, log, first, most, trials)
    cured, after = with_cures(run, log, verdict, alarmed, most, trials, least=mistake.gain)
    others = verdict.search is not None and OUTLIERS not in [c.name for c in verdict.causes]
    untried = max((f.gain for f in steady_errors(verdict.search) if not own_cure(run, f)), default=0.0)
    if after is not None:  # they explain more, but perhaps not all of it
        left = find_wrong_ids(*after, fit_of_run(after.run), trials)
        if left is None or left[0].name in [c.name for c in cured.causes]:
            return cured
        return _with_mistake(cured, left[0], shape_without(after.run, left[1].run)[0])
    if untried > mistake.gain or (mistake.name == OUTLIERS and others):  # it explains more
        return cured
    status, off_m = shape_without(run, without.run)
    rest = judged(*without, structural_causes(*without, off), most, trials)
    causes = replace(cause, harmless=cause.name == OUTLIERS and status == OK), *rest.causes
    return replace(rest, map=worst_status(status, rest.map), causes=causes, shift_m=max(rest.shift_m or 0.0, off_m))


def _with_mistake(verdict: Verdict, mistake: Mistake, status: str) -> Verdict:
    """Return a verdict with a mistake behind the causes that explain more; without it the map has the status."""
    cause = replace(cause_of_mistake(mistake), harmless=mistake.name == OUTLIERS and status == OK)
    first = [*takewhile(lambda one: one.score > mistake.gain, verdict.causes)]
    causes = *first, cause, *verdict.causes[len(first) :]
    return replace(verdict, map=worst_status(verdict.map, status), causes=causes)


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
