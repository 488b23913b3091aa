"""Causes of errors in a run as a verdict names them, with their evidence and cures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from kalmark.diagnosis.batch_search import WORST, misfits
from kalmark.diagnosis.cause_search import Search
from kalmark.diagnosis.cause_texts import finding_text, odd_control_text
from kalmark.diagnosis.causes import JUMPS, Finding
from kalmark.diagnosis.effect import SIGMAS
from kalmark.diagnosis.error_columns import DRIFT, LATE
from kalmark.diagnosis.jumps import Controls, merge_jumps
from kalmark.diagnosis.mistakes import Mistake
from kalmark.diagnosis.trials import MISFIT as MISFITS_ALL
from kalmark.diagnosis.trials import fit_of_run
from kalmark.logs.log import Log
from kalmark.results.checked import DOUBTFUL, OK, WRONG, worst_status
from kalmark.results.control_gaps import KINDS
from kalmark.results.figure_texts import figure
from kalmark.results.run import Run
from kalmark.results.wrong_starts import restarts

JUMP = "odometry_jump"  # the cause of controls that state a motion that did not take place
COPIES = "copies"  # the cause that events come twice
MISFIT = "misfit"  # the cause of innovations that do not fit, without an explanation
OF_MAP = "map_repeats", "unseen_landmarks", "split_landmarks", "lost"  # other causes may explain them
SEVERITY = dict.fromkeys((*JUMPS, "map_repeats", "lost"), WRONG) | {COPIES: OK}  # the others: doubtful


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


def status_of(causes: Iterable[Cause]) -> str:
    """Return the best status of a map with causes that its shape does not show."""
    return worst_status(*(SEVERITY.get(cause.name, DOUBTFUL) for cause in causes if not cause.harmless))


def begin_s(run: Run) -> float:
    """Return the time of the first scan in the log."""
    return run.history.at_s(0) if len(run.history.t_ns) else 0.0


def cause_of_mistake(mistake: Mistake) -> Cause:
    """Return a mistake as a cause."""
    return Cause(mistake.name, mistake.since_s, mistake.gain, mistake.evidence, mistake.cure)


def all_misfit(run: Run) -> Iterator[str]:
    """Yield the cause that the observations do not fit in the whole run, or that none was used."""
    outcome = run.history.outcome
    if len(outcome) and not np.isin(outcome, ("associated", "new")).any():
        yield f"none of the {len(outcome)} observations was used"
    mean = fit_of_run(run).mean
    if MISFITS_ALL < mean < np.inf:
        yield f"d2 per degree of freedom is {figure(mean, 2)} over all observations, where 1 is expected"


def causes_of(run: Run, search: Search, accuracy_m: float = 0.0, log: Log | None = None) -> list[Cause]:
    """Return the causes that a search found; a landmark that moves by less than the map's accuracy does not matter.

    A noise that is stated too large has no cure where its errors last: with it the filter would be overconfident.
    """
    again = restarts(run.history)  # their starts were made uncertain for the batch solution
    matter = [f for f in search.found if f.moved_m is None or f.moved_m >= accuracy_m]
    matter = [f for f in matter if not (_is_of_gap(run, f) or (f.name == "start" and again))]
    lasting = {f.of for f in matter if f.name == "correlated_noise"}
    causes = [(f, cause_of(run, f, log)) for f in merge_jumps(matter, begin_s(run))]
    return [replace(c, cure="") if f.overstated and f.of in lasting else c for f, c in causes]


def _is_of_gap(run: Run, finding: Finding) -> bool:
    """Return whether a finding is an error of controls while there was none: then the gap is named."""
    since_s = begin_s(run) + (finding.since_s or 0.0)
    until_s = begin_s(run) + finding.until_s if finding.begins else since_s
    mine = (gap for gap in run.summary.get("gaps", ()) if gap["kind"] in KINDS and gap["robot"] in finding.of[:1])
    within = any(gap["start_s"] <= since_s and until_s <= gap["end_s"] for gap in mine)
    return within and finding.W is not None and bool(finding.W.any())


def _increments_s(run: Run, robot: str) -> float:
    """Return the interval of the increments of a robot, s, 0 if its controls are velocities."""
    controls = run.history.controls.get(robot)
    if controls is None or controls.number < 2 or run.final_slam().robots[robot].motion.held:
        return 0.0
    return (controls.last_ns - controls.first_ns) * 1e-9 / (controls.number - 1)


def cause_of(run: Run, finding: Finding, log: Log | None) -> Cause:
    """Return a finding as a cause; a jump of a control that is far larger than all others is one of the odometry."""
    since_s, harmless = begin_s(run) + (finding.since_s or 0.0), finding.overstated
    odd = (
        controls_of(run, log, finding.of[0]).odd(since_s)
        if finding.name in JUMPS and finding.at is not None and log is not None
        else None
    )
    name, told = finding.name, finding_text(finding, run.config)
    cut = (run.config.get("log") or {}).get("increments") == "cut"
    if name == LATE and finding.unit != DRIFT and not cut and 0.0 < finding.value < _increments_s(run, finding.of[0]):
        more = "a scan between two increments counts at the end of the first, which may be why"
        told = f"{told[0]}; {more}", told[1]
    if odd is not None:
        name, told = JUMP, odd_control_text(finding.of[0], odd, finding.of[2:])
    if finding.begins:
        end_s = begin_s(run) + finding.until_s
        told = f"from t={since_s:.1f} {'s on' if end_s == math.inf else f'to {end_s:.1f} s'} {told[0]}", ""
    return Cause(name, since_s, finding.gain, *told, harmless)


def controls_of(run: Run, log: Log, robot: str) -> Controls:
    """Return the controls of a robot in a log."""
    return Controls(log, tuple(run.final_slam().robots[robot].motion.columns), robot)


def odd_controls(run: Run, log: Log) -> Iterator[Cause]:
    """Yield the controls of each robot that jump themselves, by innovations: scans do not fit right after them.

    The score is half of the chi-square of these scans.
    """
    h, (chi2, worst) = run.history, misfits(run)
    for robot in dict.fromkeys(h.robot.tolist()):
        bad = [k for k in worst.tolist() if h.robot[k] == robot][:WORST]
        controls = controls_of(run, log, robot)
        odd = {o.t_s: (o, k) for k in bad if (o := controls.odd(h.at_s(k))) is not None}
        if odd:
            most, _ = max(odd.values(), key=lambda of: of[0].times)
            at = [f"{t_s:.1f}" for t_s in sorted(odd) if t_s != most.t_s]
            score = 0.5 * float(sum(chi2[k] for _, k in odd.values()))
            yield Cause(JUMP, min(odd), score, *odd_control_text(robot, most, at))


def is_misplaced_survey(run: Run, finding: Finding) -> bool:
    """Return whether a finding is a surveyed landmark that the map has elsewhere than its observations."""
    names = [str(id_) for id_ in run.landmarks.ids]
    if finding.name != "landmark_prior" or finding.at is None or finding.of[0] not in names:
        return False
    k, d = names.index(finding.of[0]), len(finding.at)
    off, P = run.landmarks.means[k][:d] - finding.at, run.landmarks.covariances[k][:d, :d]
    return bool(np.linalg.norm(off) > SIGMAS * np.hypot(finding.sigma, np.sqrt(np.trace(P))))
