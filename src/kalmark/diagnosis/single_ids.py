"""Ids that do not mean one place: on two things, exchanged, of a thing that was moved or that moves.

A filter with a gate leaves out what does not fit its path.  What it leaves out of one id is given another name, and the
log is filtered again: it is likelier if that is a place of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from kalmark.arrays import Array, Flags
from kalmark.diagnosis.mistakes import Mistake, with_value
from kalmark.diagnosis.trials import FITS, SURELY, Fit, filter_events, fit_of_run, likelihood_gain
from kalmark.events import Event, Scan
from kalmark.logs.log import Log
from kalmark.results.history import History, Ints
from kalmark.results.run import Run
from kalmark.slam.tentative import ELSEWHERE as BEGUN_AGAIN

GATE = 0.9999  # with which a log that does not fit is filtered again
LEAST = 8  # sightings of an id that do not fit: it may mean another place
OFF = 6.0  # d2 per degree of freedom of a sighting that does not fit
MOST = 0.5  # of the ids that were seen meanwhile: more of them are not moved, the robot is
SHARE = 0.1  # of the sightings of an id that are of another place, or of a place after it was left
SAME = 0.25  # of the distance to the next landmark, within which two places are one
OUTLIERS, TWICE, MOVED, MISPLACED = "outliers", "wrong_ids", "moving_landmark", "misplaced_landmark"  # the causes
MOVES, TWO, GONE = "moves", "on two things", "moved"
TEXTS = {  # of one, and of several
    MOVES: ("landmark {} moves", "landmarks {} move"),
    TWO: ("id {} is on two things", "ids {} are on two things each"),
    GONE: ("landmark {} is elsewhere: moved", "landmarks {} are elsewhere: moved"),
}
ANOTHER = ", and fit another one far more often than by chance"
SECOND = " (2)"  # after an id, of what does not fit it
CURE, OWN_ID = f"--set association.gate={GATE}", "give each thing an id of its own, and a thing that is moved a new one"


def gated(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a configuration that leaves out what is far off where its id is: the same one if it does not go by ids."""
    if (config.get("association") or {}).get("type") != "identity":
        return config
    return with_value(config, ("association", "gate"), GATE)


def find_wrong_ids(run: Run, log: Log, now: Fit) -> tuple[Mistake, Run] | None:
    """Return that ids do not mean one place each, or single sightings are off, and the log filtered without that."""
    config = gated(run.config)
    if not _are_many_off(run.history, now):
        return None
    first = run if config == run.config else filter_events(config, log, log.events)
    if first is None:
        return None
    before, out = fit_of_run(first), _elsewhere(first.history)
    gain, mean = likelihood_gain(now, before), max(before.mean, 1.0)
    cure = CURE if gain > SURELY * mean else OWN_ID  # a gate helps no more where all of this is left out already
    found, wrong, more = _places_of_ids(config, log, first, out)
    if not out.any():
        return None
    rest = np.flatnonzero(out & ~np.isin(first.history.id, wrong))
    of_others = _of_others(config, log, first, rest) if len(rest) >= LEAST else 0.0
    mixed = of_others > SURELY * mean
    if found is not None and not mixed:
        return (found[0]._replace(cure=cure, gain=gain + more), found[1]) if gain + more > SURELY * mean else None
    gain += more + (of_others if mixed else 0.0)
    by_itself = before.mean < FITS and -math.log(1.0 - GATE) * float(out.sum()) > SURELY * mean
    if gain < SURELY * mean and not by_itself:  # the filter may have left it out, which chance does seldom
        return None
    evidence = f"{out.mean():.1%} of the observations are far off where their landmark is"
    name, cure, told = (TWICE, cure, ANOTHER) if mixed else (OUTLIERS, CURE, "")
    without = first if found is None else found[1]
    since_s = _since_s(first, np.flatnonzero(out))
    return Mistake(name, evidence + told, cure, config, None, gain, since_s), without


def _are_many_off(h: History, now: Fit) -> bool:
    """Return whether so many sightings do not fit, of one id, or far off of any."""
    named = h.id != ""
    number = np.unique(h.id[named & (now.values > OFF)], return_counts=True)[1]
    return bool(number.max(initial=0) >= LEAST or (now.values[named] > 2.0 * OFF).sum() >= LEAST)


def _of_others(config: Mapping[str, Any], log: Log, first: Run, rows: Ints) -> float:
    """Return the logarithm of how much likelier sightings are, each as one of any landmark as likely as of none."""
    config = with_value(config, ("association",), {"type": "auto"})
    hidden = filter_events(config, log, _renamed(log, first, rows, None))
    if hidden is None:
        return -math.inf
    gains = (fit_of_run(hidden).likelihoods - fit_of_run(first).likelihoods)[rows] - math.log(len(first.landmarks))
    gains[hidden.history.outcome[rows] != "associated"] = -np.inf
    return float(np.logaddexp(math.log(0.5), gains + math.log(0.5)).sum())


def _places_of_ids(
    config: Mapping[str, Any], log: Log, first: Run, out: Flags
) -> tuple[tuple[Mistake, Run] | None, list[str], float]:
    """Return that ids mean other places, the log filtered with names for these, which, and how much likelier it is."""
    h = first.history
    wrong, rows = list[str](), np.zeros(len(out), dtype=np.bool_)
    for name in np.unique(h.id[out]).tolist():
        mine = h.id == name
        if (mine & out).sum() >= max(LEAST, SHARE * mine.sum()):
            wrong.append(name)
            rows |= mine & out
    seen = {*h.id[np.argmax(rows) :].tolist()} - {""}
    if not wrong or len(wrong) > MOST * len(seen):
        return None, [], 0.0
    again = filter_events(config, log, _renamed(log, first, np.flatnonzero(rows), _other))
    if again is None:
        return None, [], 0.0
    h, after = again.history, fit_of_run(again)
    if after.mean > FITS:
        return None, [], 0.0
    places = {str(i): p for i, p in zip(again.landmarks.ids, again.landmarks.positions()[0], strict=True)}
    told = {name: _told(h, places, name) for name in wrong}
    since_s = _since_s(again, np.concatenate([_in_order(h, name)[-1][1] for name in wrong]))
    cause = MOVED if {*told.values()} <= {MOVES, GONE} else TWICE
    mistake = Mistake(cause, f"from t={since_s:.1f} s on {_together(told)}", CURE, config, None, 0.0, since_s)
    return (mistake, again), wrong, likelihood_gain(fit_of_run(first), after)


def _since_s(run: Run, rows: Ints) -> float:
    """Return the time of the first of some rows, s of the log."""
    return float(run.history.t_ns[run.history.step[rows.min()]]) * 1e-9


def _elsewhere(h: History) -> Flags:
    """Return which sightings (O,) do not fit where their ids are at the end; these may have been begun again there."""
    out = (h.outcome == "rejected") & (h.id != "")
    for change in (c for c in h.changes if c.reason == BEGUN_AGAIN):
        out ^= (h.id == str(change.landmark)) & (h.step <= change.step)
    return np.asarray(out)


def _renamed(log: Log, run: Run, rows: Ints, name: Callable[[str], str] | None) -> list[Event]:
    """Return the events of a log in which the sightings of some rows of a run have other names, or none."""
    h = run.history
    keys = {(h.t_ns[h.step[k]], h.robot[h.step[k]], h.sensor[k], h.index[k]) for k in rows.tolist()}

    def renamed_event(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None:
            return e
        mine = [(e.t_ns, e.robot, e.sensor, k) in keys for k in range(len(e.ids))]
        ids = [(name and name(str(i))) if other else i for i, other in zip(e.ids, mine, strict=True)]
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y, ids=ids, cov=e.cov) if any(mine) else e

    return [*map(renamed_event, log.events)]


def _other(name: str) -> str:
    return name + SECOND


def _in_order(h: History, name: str) -> list[tuple[str, Ints]]:
    """Return an id and its other name, and the rows of both, those that were seen first before the others.

    It is one of both where no sighting has the other one.
    """
    rows = [(of, np.flatnonzero(h.id == of)) for of in (name, _other(name))]
    return sorted(((of, mine) for of, mine in rows if len(mine)), key=lambda one: int(one[1][0]))


def _told(h: History, places: Mapping[str, Array], name: str) -> str:
    """Return the meaning of an id in a run with names for both of its places."""
    *before, (later, new) = _in_order(h, name)
    old = before[0][1] if before else new[:0]
    fits = h.outcome != "rejected"
    if later not in places or any(len(rows) >= LEAST and fits[rows].mean() < MOST for rows in (old, new)):
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
    """Return what is said of ids, of those of one meaning at once."""
    names = {meaning: [name for name, of in told.items() if of == meaning] for meaning in told.values()}
    return "; ".join(
        TEXTS[of][len(mine) > 1].format(", ".join(mine)) if of in TEXTS else of for of, mine in names.items()
    )
