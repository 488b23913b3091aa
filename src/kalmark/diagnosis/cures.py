"""Small errors are taken out of a log by their cures, one after the other, as long as it gets likelier."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from kalmark.diagnosis.batch_search import MORE, associated, search_causes
from kalmark.diagnosis.batch_verdict import Verdict, judged
from kalmark.diagnosis.cause_search import ALIKE, SHARE, Search, joined
from kalmark.diagnosis.cause_texts import finding_text
from kalmark.diagnosis.causes import LEAST_GAIN, TIMES, Finding
from kalmark.diagnosis.effect import shape_without
from kalmark.diagnosis.error_columns import DRIFT, LATE
from kalmark.diagnosis.named_causes import OF_MAP, begin_s, cause_of
from kalmark.diagnosis.onsets import without_onset
from kalmark.diagnosis.single_ids import Filtered
from kalmark.diagnosis.structural_causes import structural_causes
from kalmark.diagnosis.trials import AT_ONCE, FITS, Fit, Trials, fit_of_run, likelihood_gain, options_of, with_cure
from kalmark.diagnosis.trials import MISFIT as MISFITS_ALL
from kalmark.errors import KalmarkError
from kalmark.logs.log import Log
from kalmark.results.checked import DOUBTFUL, OK, worst_status
from kalmark.results.run import Run

CURES = "cures of small errors"
TRIED, ROUNDS = 2, 3  # errors that are tried, and rounds of what is left without the likeliest
SIZES, SAME = 6, 0.05  # of an error that are tried, and the share by which the last one may change it

Cured = tuple[float, Run, Log, Finding | None]  # the gain of a cure, the run and log with it, and the error


class _Taken(NamedTuple):
    """Errors that are taken out of a log, by name, the run and log without them, and the verdict on that.

    `systematic` is run and log without the systematic errors, the noise as it was stated.  `partly`: the budget paid
    for the last one in the first part of the log alone, and it is in run and log.
    """

    errors: dict[tuple[str, ...], Finding]
    run: Run
    log: Log
    rest: Verdict
    systematic: tuple[Run, Log]
    partly: bool = False

    @property
    def total(self) -> float:
        """The log-likelihood that all of them gain."""
        return sum(one.gain for one in self.errors.values())


def with_cures(
    run: Run, log: Log, verdict: Verdict, alarmed: bool, most: int, trials: Trials, *also: Finding,
    least: float = 0.0,
) -> tuple[Verdict, Filtered | None]:  # fmt: skip
    """Return a verdict in which the small errors with which the log is likeliest are taken out by their cures.

    That is done one after the other, and what is left of one belongs to it: so far away the problem was not linear.
    All together have to gain `least`.  With it comes the log without them, None if none is taken out.
    """
    suspects = _suspects(run, verdict, TRIED)
    doubted = alarmed or worst_status(verdict.map, *verdict.robots.values()) != OK
    doubted |= fit_of_run(run).mean > MISFITS_ALL or bool(also)
    if not doubted and not any(f.name == LATE or f.begins for f in suspects):  # whose sizes are so far from linear
        return verdict, None
    tried = _errors_to_try(run, log, [*also, *suspects], most, trials)
    taken = _taken_out(run, log, verdict, tried, most, trials)
    if not taken.errors or taken.total < least:
        return verdict, None
    found = sorted(taken.errors.values(), key=lambda f: -f.gain)
    left = [c for c in taken.rest.causes if c.name not in [f.name for f in found]]
    first = [c.name for c in verdict.causes[: 0 if taken.partly else 1]]  # goes before them if they do not explain it
    causes = sorted(
        [*(cause_of(run, f, log) for f in found), *left],
        key=lambda c: c not in left or c.harmless or c.name not in first,
    )
    status = worst_status(verdict.map, shape_without(run, taken.run)[0], DOUBTFUL if taken.partly else OK)
    return replace(verdict, map=status, causes=(*causes,)), Filtered(taken.run, taken.log)


def _taken_out(run: Run, log: Log, verdict: Verdict, tried: Iterable[Finding], most: int, trials: Trials) -> _Taken:
    """Take out the likeliest of the errors that are `tried`, then what the log without it shows, in a few rounds.

    A systematic error is taken out of the log with the noise as it was stated: more noise is what is left.
    """
    taken = _Taken({}, run, log, verdict, (run, log))
    for _ in range(ROUNDS):
        best, errors = _likeliest_cure(taken.run, taken.log, tried, trials), taken.errors
        partly, finding = best[1] is taken.run, best[3]
        if finding is not None and finding.unit != TIMES and not partly:
            if taken.run is not taken.systematic[0]:
                best = without_error(*taken.systematic, finding, trials)
                partly = best[1] is taken.systematic[0]
            if finding.name == LATE and not partly:
                best = _of_likeliest_size(*taken.systematic, finding, best, trials)
            errors = {key: one for key, one in errors.items() if one.unit != TIMES}
        gain, without, changed, one = best
        if one is None or gain < LEAST_GAIN:
            break
        key = one.name, *one.of, str(one.since_s)
        have = [errors[key]] if key in errors else []
        now = joined([*have, replace(one, gain=gain, noise=1.0, errors=1.0)])  # of other observations
        if partly:
            return taken._replace(errors=errors | {key: now}, partly=True)
        rest = judged(without, changed, structural_causes(without, changed, []), most, trials)
        systematic = taken.systematic if one.unit == TIMES else (without, changed)
        taken = _Taken(errors | {key: now}, without, changed, rest, systematic)
        names = [name for name, *_ in taken.errors]
        tried = [f for f in _suspects(without, rest, 1) if f.name in names or f.gain > SHARE * taken.total]
        if fit_of_run(without).mean > MISFITS_ALL:
            tried = _errors_to_try(without, changed, tried, most, trials)
    return taken


def _likeliest_cure(run: Run, log: Log, tried: Iterable[Finding], trials: Trials) -> Cured:
    """Return the cure with which the log of a run is likeliest, as `without_error`.

    After one with which a log fits that did not, only other sizes of that error are tried.
    """
    best: Cured = 0.0, run, log, None
    fitted, named = fit_of_run(run).mean < FITS, ""
    for finding in tried:
        if named in ("", finding.name):
            best = max(best, without_error(run, log, finding, trials), key=lambda of: of[0])
        if not fitted and best[3] is not None and fit_of_run(best[1]).mean < FITS:
            named = best[3].name
    return best


def _of_likeliest_size(run: Run, log: Log, finding: Finding, best: Cured, trials: Trials) -> Cured:
    """Return the cure of an error, `best` with the size that was found, of the size with which the log is likeliest.

    It is doubled as long as that gains; then a parabola through three sizes has the next one.
    """
    work, tried = trials.work_of(log.events), {0.0: 0.0, finding.value: best[0]}
    while len(tried) < SIZES and trials.pays(CURES, work):
        size = _next_size(tried)
        if min(abs(size - one) for one in tried) < SAME * abs(size):
            break
        again = without_error(run, log, replace(finding, value=size), trials)
        tried[size] = again[0]
        best = max(best, again, key=lambda of: of[0])
    return best


def _next_size(tried: Mapping[float, float]) -> float:
    """Return the size to try next, of sizes with their gains, all of one sign."""
    sizes = sorted(tried, key=abs)
    k = max(range(len(sizes)), key=lambda k: tried[sizes[k]])
    if k in (0, len(sizes) - 1):
        return 2.0 * sizes[k] if k else 0.5 * sizes[1]
    a, b, c = sizes[k - 1 : k + 2]
    left, right = (tried[b] - tried[a]) / (b - a), (tried[c] - tried[b]) / (c - b)
    return 0.5 * (a + b - left * (c - a) / (right - left))


def _errors_to_try(run: Run, log: Log, suspects: list[Finding], most: int, trials: Trials) -> Iterator[Finding]:
    """Yield suspects, and the systematic errors that a search finds by associations of less certain controls.

    Noise is the last: it takes up any misfit.
    """
    yield from (f for f in suspects if f.unit != TIMES)
    wide = associated(run, log, trials)
    if wide is not run:
        with suppress(KalmarkError, np.linalg.LinAlgError):
            search = search_causes(wide, log, most, max(AT_ONCE, MORE * most), trials).search
            yield from [f for f in steady_errors(search) if f.unit != TIMES][:TRIED]
    yield from (f for f in suspects if f.unit == TIMES)


def _suspects(run: Run, verdict: Verdict, most: int) -> list[Finding]:
    """Return the likeliest errors of a verdict that are tried: those that are certain, and one that may explain more.

    Of an error of the same name, as an offset beside a drift, that is one which explains about as much.  And all
    that the search in the batch problem does not find, and of which a line takes it out: the log without it shows the
    effects of it.  Causes that only the map shows are effects of others.
    """
    search = verdict.search
    found, suspects = (search.found, search.suspects) if search else ([], [])
    known = {*OF_MAP, *(f.name for f in found)}
    told = [
        Finding(c.name, (), c.score, 0.0, 0.0, since_s=c.since_s - begin_s(run), told=(c.evidence, c.cure))
        for c in verdict.causes
        if not c.harmless and c.name not in known and options_of(c.cure)
    ]
    sure = steady_errors(search)[:most]
    largest, have = max((f.gain for f in sure), default=0.0), {f.name: f.of for f in sure}
    may_be = (f for f in suspects if f.gain > (ALIKE if have.get(f.name, f.of) != f.of else 1.0) * largest)
    return [*told, *sure, *islice(may_be, 1)]


def steady_errors(search: Search | None) -> list[Finding]:
    """Return the systematic errors and larger noise that a search found, the one that explains most first."""
    found = search.found if search else ()
    steady = (f for f in found if f.is_steady or f.begins or (f.unit == TIMES and not f.overstated))
    return sorted(steady, key=lambda f: -f.gain)


def own_cure(run: Run, finding: Finding) -> str:
    """Return the line that cures a finding, without those of others that explain as much."""
    return finding_text(replace(finding, alike=()), run.config)[1]


def without_error(run: Run, log: Log, finding: Finding, trials: Trials) -> Cured:
    """Return by how much likelier the log of a run is with the cure of a finding, its run and log with it, and that.

    Where the budget pays for the first part of the log alone, run and log are as they are.
    """
    if finding.begins or finding.unit == DRIFT:
        changed = without_onset(run, log, finding)
        made = None if changed is None else (run.config, changed, list(changed.events))
    else:
        made = with_cure(run.config, log, own_cure(run, finding))
    if made is None:
        return 0.0, run, log, finding
    config, changed, every = made
    events = trials.payable(CURES, run, every, 1, 1)
    after = trials.filter(config, changed, events) if events else None
    if after is None:
        return 0.0, run, log, finding
    now, then = fit_of_run(run), fit_of_run(after)
    if len(events) == len(every):
        return likelihood_gain(now, then), after, changed, finding
    return likelihood_gain(Fit(*(column[: len(then.values)] for column in now)), then), run, log, finding
