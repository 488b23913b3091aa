"""Ids that do not mean one place: on two things, exchanged, of a thing that was moved or that moves.

A filter with a gate leaves out observations that do not fit its path.  Those of one id are given another name, and the
log is filtered again: it is likelier if they are of a place of its own.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import rel_entr

from kalmark.arrays import Array, Flags
from kalmark.diagnosis.mistakes import Mistake, with_value
from kalmark.diagnosis.trials import AT_ONCE, FITS, SURELY, Fit, Trials, fit_of_run, likelihood_gain, log_from
from kalmark.events import Event, Scan
from kalmark.geometry.gaussian import gate
from kalmark.logs.log import Log
from kalmark.models.observe import linearize
from kalmark.results.control_gaps import while_lost
from kalmark.results.history import History, Ints, Texts, texts
from kalmark.results.run import Run
from kalmark.slam.slam import Slam
from kalmark.slam.tentative import ELSEWHERE as BEGUN_AGAIN
from kalmark.tracks.channel import Channel, ObservationModel

GATE = 0.9999  # with which a log that does not fit is filtered again
LEAST = 8  # observations of an id that do not fit: it may mean another place
OFF = 6.0  # d2 per degree of freedom of an observation that does not fit
MOST = 0.5  # of the ids that were seen meanwhile: more of them are not moved, the robot is
SHARE = 0.1  # of the observations of an id that are of another place, or of a place after it was left
SAME = 0.25  # of the distance to the next landmark, within which two places are one
OUTLIERS, TWICE, MOVED, MISPLACED = "outliers", "wrong_ids", "moving_landmark", "misplaced_landmark"  # the causes
PRIOR = "landmark_prior"
MOVES, TWO, GONE, OFF_SURVEY = "moves", "on two things", "moved", "off its survey"
TEXTS = {  # of one, and of several
    MOVES: ("landmark {} moves", "landmarks {} move"),
    TWO: ("id {} is on two things", "ids {} are on two things each"),
    GONE: ("landmark {} is elsewhere: moved", "landmarks {} are elsewhere: moved"),
    OFF_SURVEY: ("landmark {} is not where its survey has it", "landmarks {} are not where their surveys have them"),
}
ANOTHER = ", and fit another one far more often than by chance"
SECOND = " (2)"  # after an id, of what does not fit it
CURE, OWN_ID = f"--set association.gate={GATE}", "give each thing an id of its own, and a thing that is moved a new one"
CURES = {PRIOR: "correct their places in the file of the survey, or leave them out"}


def gated(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a configuration that leaves out what is far off where its id is: the same one if it does not go by ids."""
    if (config.get("association") or {}).get("type") != "identity":
        return config
    return with_value(config, ("association", "gate"), GATE)


class Filtered(NamedTuple):
    """A log, or a part of it, and the run through a filter that it gave."""

    run: Run
    log: Log


def find_wrong_ids(run: Run, log: Log, now: Fit, trials: Trials) -> tuple[Mistake, Filtered] | None:
    """Return the fault of ids that name more than one place, or of single wrong observations, and the run without them.

    Of a log of more than `AT_ONCE` observations that is the part about the first that do not fit.
    """
    config, far = gated(run.config), _first_off(run.history, now)
    if far is None:
        return None
    whole = len(now.values) <= AT_ONCE
    if not whole:
        config, log, now = _part(run, log, now, far)
    as_it_is = whole and config == run.config
    if not trials.pays("wrong ids", (1 if as_it_is else 2) * trials.work_of(log.events)):
        return None
    first = run if as_it_is else trials.filter(config, log, log.events)
    if first is None:
        return None
    before, h = fit_of_run(first), first.history
    out = _elsewhere(h) & ~h.associated_elsewhere()[h.step]
    new = np.flatnonzero(first.history.outcome == "new") if len(before.values) == len(now.values) else None
    gain, mean = likelihood_gain(now, before, new), max(before.mean, 1.0)
    cure = CURE if gain > SURELY * mean else OWN_ID  # a gate helps no more where all of this is left out already
    found, wrong, more = _places_of_ids(config, log, first, out, trials)
    if not out.any():
        return None
    rest = np.flatnonzero(out & ~np.isin(first.history.id, wrong))
    of_others = _of_others(first, rest) if len(rest) >= LEAST else 0.0
    mixed = of_others > SURELY * mean
    gain += more + (of_others if mixed else 0.0)
    by_itself = before.mean < FITS and -math.log(1.0 - GATE) * float(out.sum()) > SURELY * mean
    if gain < SURELY * mean and not by_itself:  # the filter may have left it out, which chance does seldom
        return None
    if found is not None and not mixed:
        return found[0]._replace(cure=CURES.get(found[0].name, cure), gain=max(gain, 0.0)), Filtered(found[1], log)
    evidence = f"{out.mean():.1%} of the observations are far off where their landmark is"
    name, cure, told = (TWICE, cure, ANOTHER) if mixed else (OUTLIERS, CURE, "")
    without = first if found is None else found[1]
    since_s = first.history.at_s(first.history.step[out][0])
    return Mistake(name, evidence + told, cure, config, None, gain, since_s), Filtered(without, log)


def _part(run: Run, log: Log, now: Fit, far: int) -> tuple[Mapping[str, Any], Log, Fit]:
    """Return `AT_ONCE` observations of a log about one that is far off: configuration, log and their fit."""
    h, last = run.history, len(now.values) - 1
    begin = h.step[max(min(far - AT_ONCE // 2, last - AT_ONCE), 0)]
    end = h.step[min(np.searchsorted(h.step, begin) + AT_ONCE, last)]
    config, part = log_from(run, log, int(np.searchsorted(h.step, begin)))
    part = replace(part, events=[e for e in part.events if e.t_ns <= h.t_ns[end]])
    within = (h.t_ns[h.step] >= h.t_ns[begin]) & (h.t_ns[h.step] <= h.t_ns[end])
    return gated(config), part, Fit(*(column[within] for column in now))


def _first_off(h: History, now: Fit) -> int | None:
    """Return the first observation that does not fit, None unless many of one id do not, or many are far off."""
    named = h.id != ""
    off = np.flatnonzero(named & (now.values > OFF))
    number = np.unique(h.id[off], return_counts=True)[1]
    if number.max(initial=0) >= LEAST or (now.values[off] > 2.0 * OFF).sum() >= LEAST:
        return int(off[0])
    return None


def _of_others(first: Run, rows: Ints) -> float:
    """Return the log-likelihood ratio of rejected against fitting observations to fit another landmark than their own.

    That is the logarithm of a likelihood ratio.  How often chance does it depends on how landmarks are crowded.
    """
    fit = np.flatnonzero((first.history.outcome == "associated") & (first.history.id != ""))
    usual = fit[np.linspace(0, len(fit) - 1, min(len(fit), len(rows))).astype(np.int64)]
    (k, n), (others, number) = ((int(of.sum()), len(of)) for of in (_fit_others(first, r) for r in (rows, usual)))
    p, chance = k / n, (others + 1) / (number + 2)
    return float(rel_entr(p, chance) + rel_entr(1.0 - p, 1.0 - chance)) * n if p > chance else 0.0


def _fit_others(first: Run, rows: Ints) -> Flags:
    """Return which observations (N,) fit another landmark than their own.

    Robots are where the run had them then, landmarks where it has them in the end.
    """
    h, slam, fit = first.history, first.final_slam(), np.zeros(len(rows), dtype=np.bool_)
    state, places = slam.state, {key: _places(slam, channel) for key, channel in slam.state.channels.items()}
    for i, k in enumerate(rows.tolist()):
        key = str(h.robot[h.step[k]]), str(h.sensor[k])
        if key not in places:  # a sensor of the state
            continue
        channel = state.channels[key]
        head = channel.head(state.map, state.moving[key[0]].slot)
        head[: len(channel.at)] = h.poses[h.step[k]]
        y = h.y[k, : len(channel.sensor.columns)]
        for model, names, l in places[key]:
            z = linearize(model.model, head, l, np.tile(y, (len(l), 1)))[1]
            Z = h.Z[k, : z.shape[1], : z.shape[1]]
            if np.isfinite(Z).all():
                d2 = np.sum(z * np.linalg.solve(Z, z.T).T, axis=1)
                fit[i] |= bool(((d2 < gate(GATE, len(Z))) & (names != h.id[k])).any())
    return fit


def _places(slam: Slam, channel: Channel) -> list[tuple[ObservationModel, Texts, Array]]:
    """Return names (K,) and numbers (K, n) of the landmarks that a sensor can observe, by their models."""
    table, of_kind = slam.landmarks(exactly_known=True), defaultdict[str, list[int]](list)
    for k, kind in enumerate(table.kinds):
        of_kind[kind].append(k)
    models = [(channel.models[kind], rows) for kind, rows in of_kind.items() if kind in channel.models]
    return [(model, texts([table.ids[k] for k in at]), np.array([table.means[k] for k in at])) for model, at in models]


def _places_of_ids(
    config: Mapping[str, Any], log: Log, first: Run, out: Flags, trials: Trials
) -> tuple[tuple[Mistake, Run] | None, list[str], float]:
    """Return that ids mean other places, the log filtered with names for these, which, and how much likelier it is."""
    h, d = first.history, first.history.d
    surveys = {str(prior.landmark): prior.mean[:d] for prior in h.priors}
    names, inverse, number = np.unique(h.id, return_inverse=True, return_counts=True)
    number_out, surveyed = np.bincount(inverse, out), np.isin(names, [*surveys])
    wrong = (number_out > 0) & (number_out >= SHARE * number) & (surveyed | (number_out >= LEAST))
    rows = wrong[inverse] & out
    if not 0 < wrong.sum() <= MOST * len({*h.id[np.argmax(rows) :].tolist()} - {""}):
        return None, [], 0.0
    every = wrong[inverse] & (out | surveyed[inverse])  # of a survey that is off all observations are elsewhere
    parts = [rows] if (rows == every).all() else [rows, every]
    runs = [trials.filter(config, log, _renamed(log, first, np.flatnonzero(part), _other)) for part in parts]
    tried = [(likelihood_gain(fit_of_run(first), fit_of_run(run)), run) for run in runs if run is not None]
    gain, again = max(tried, key=lambda of: of[0], default=(0.0, first))
    then = fit_of_run(again)
    if again is first or then.mean > FITS:
        return None, [], 0.0
    told = _meanings(again, then.values, surveys, names[wrong].tolist())
    if not told:
        return None, [], 0.0
    row = min(_in_order(again.history, name)[-1][1].min() for name in told)
    since_s = again.history.at_s(again.history.step[row])
    cause = PRIOR if {*told.values()} == {OFF_SURVEY} else MOVED if {*told.values()} <= {MOVES, GONE} else TWICE
    mistake = Mistake(cause, f"from t={since_s:.1f} s on {_together(told)}", CURE, config, None, 0.0, since_s)
    return (mistake, again), [*told], gain


def _meanings(again: Run, values: Array, surveys: Mapping[str, Array], wrong: list[str]) -> dict[str, str]:
    """Return the meanings of ids in a run with names for both of their places; none of surveys that are right.

    Its observations fit with d2 per degree of freedom `values` (O,).
    """
    h, (means, P), d = again.history, again.landmarks.positions(), again.history.d
    at = {str(name): k for k, name in enumerate(again.landmarks.ids)}
    places = {name: means[k] for name, k in at.items()}
    told = {name: _told(h, values, places, name) for name in wrong}
    for name in [name for name in wrong if name in surveys and not (h.id == name).any()]:
        k = at.get(_other(name))
        off = np.zeros(d) if k is None else means[k] - surveys[name]
        if k is None or off @ np.linalg.solve(P[k], off) < gate(GATE, d):
            del told[name]
        elif told[name] != MOVES:
            told[name] = OFF_SURVEY
    return told


def _elsewhere(h: History) -> Flags:
    """Return which observations (O,) do not fit where their ids are at the end; these may have been begun again there.

    Those of a robot that is elsewhere do not count.
    """
    out = (h.outcome == "rejected") & (h.id != "") & ~while_lost(h)[h.step]
    for change in (c for c in h.changes if c.reason == BEGUN_AGAIN):
        out ^= (h.id == str(change.landmark)) & (h.step <= change.step)
    return np.asarray(out)


def _renamed(log: Log, run: Run, rows: Ints, name: Callable[[str], str]) -> list[Event]:
    """Return the events of a log in which the observations of some rows of a run have other names."""
    h = run.history
    keys = {(h.t_ns[h.step[k]], h.robot[h.step[k]], h.sensor[k], h.index[k]) for k in rows.tolist()}

    def renamed_event(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None:
            return e
        mine = [(e.t_ns, e.robot, e.sensor, k) in keys for k in range(len(e.ids))]
        ids = [name(str(i)) if other else i for i, other in zip(e.ids, mine, strict=True)]
        return replace(e, ids=tuple(ids)) if any(mine) else e

    return [*map(renamed_event, log.events)]


def _other(name: str) -> str:
    return name + SECOND


def _in_order(h: History, name: str) -> list[tuple[str, Ints]]:
    """Return an id and its other name, and the rows of both, those that were seen first before the others.

    It is one of both where no observation has the other one.
    """
    rows = [(of, np.flatnonzero(h.id == of)) for of in (name, _other(name))]
    return sorted(((of, mine) for of, mine in rows if len(mine)), key=lambda one: int(one[1][0]))


def _told(h: History, values: Array, places: Mapping[str, Array], name: str) -> str:
    """Return the meaning of an id in a run with names for both of its places, with `values` as in `_meanings`.

    A thing that moves does not fit one place, nor two.
    """
    *before, (later, new) = _in_order(h, name)
    old = before[0][1] if before else new[:0]
    fits = h.outcome != "rejected"
    if later not in places or any(len(rows) >= LEAST and np.median(values[rows]) > FITS for rows in (old, new)):
        return MOVES
    if fits[old[old > new.min()]].sum() > SHARE * len(old):
        return TWO
    others = {of: p for of, p in places.items() if of not in (name, _other(name)) and np.isfinite(p).all()}
    if len(others) < 2:
        return GONE
    every = cKDTree(np.array([*others.values()]))
    near = SAME * float(np.median(every.query(every.data, k=2)[0][:, 1]))
    away, k = every.query(places[later])
    return f"what is called {name} is where {[*others][k].removesuffix(SECOND)} was" if away < near else GONE


def _together(told: Mapping[str, str]) -> str:
    """Return a sentence about ids, those of one meaning together."""
    names = {meaning: [name for name, of in told.items() if of == meaning] for meaning in told.values()}
    return "; ".join(
        TEXTS[of][len(mine) > 1].format(", ".join(mine)) if of in TEXTS else of for of, mine in names.items()
    )
