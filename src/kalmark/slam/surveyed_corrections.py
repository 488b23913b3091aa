"""Corrections by surveyed landmarks, which are gated, so that one that stands elsewhere does not pull the map."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.filter.estimators import Correction, Estimator, Update
from kalmark.geometry.angles import wrap
from kalmark.geometry.gaussian import gate
from kalmark.slam import elsewhere
from kalmark.slam.locating import can_be_summed, is_doubted
from kalmark.slam.policy import Policy
from kalmark.slam.state import State
from kalmark.tracks.linearity import turn_holds
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.survey_checks import SURVEYED

ELSEWHERE = "its observations do not fit its survey, those of other landmarks do: it is mapped again"
WIDER = 2.0  # times what a robot that was elsewhere has moved by
DOUBLED = 20  # times at most that a robot is moved by one scan, each time farther


def gate_of(state: State, scan: ScanContext, policy: Policy) -> float:
    """Return the gate of observations of surveyed landmarks; infinite while no turn of their robot is linear."""
    least = policy.association.threshold(scan.channel.dof, gate(SURVEYED, scan.channel.dof))
    if least == math.inf:
        return least
    dof, is_summed = scan.channel.pose_dof, can_be_summed(scan.channel)
    return least if is_summed or turn_holds(state.map.covariance([scan.robot])[:dof, :dof]) else math.inf


def is_tried(state: State, robot: str, names: Sequence[Any]) -> bool:
    """Return whether a scan tests surveys: those on trial, or landmarks that did not fit before."""
    trial = state.surveys.trial.keys()
    return bool(state.surveys.misfitting.get(robot)) or (bool(trial) and not trial.isdisjoint(names))


def correct_by_surveys(
    state: State, scan: ScanContext, names: Sequence[Any], update: Update, least: float,
    estimator: Estimator, approach: Callable[[Sequence[int], float], bool],
) -> Correction:  # fmt: skip
    """Correct by observations.  Those of surveyed landmarks beyond the gate `least` are rejected.

    They are used if the evidence is that the robot, not the survey, is wrong, unless the association's gate rejects
    them.  `approach` corrects beforehand by those that are far from their expectation, within a gate, if there are any.
    """
    if least == math.inf:
        return state.correct(update, scan.event, estimator)
    done = elsewhere.correct(state, scan, names, update._replace(gate=min(update.gate, least)), estimator)
    trial, known = state.surveys.trial, state.tracks.known
    beyond = np.flatnonzero(~done.fused & ~np.isnan(done.d2)).tolist()
    tried = [name in trial or name in known for name in names]
    fitting = [
        names[k] for k in np.flatnonzero(done.fused & (done.d2 <= least)).tolist() if state.is_surveyed(names[k])
    ]
    lost = state.surveys.judge(scan.event.robot, fitting, [names[k] for k in beyond if tried[k]])
    if scan.locates or ((lost or state.surveys.contradict()) and is_doubted(state, scan)):
        lost = False
    most = min(update.gate, elsewhere.limit_of(state, scan))
    out = np.array([k for k in beyond if (lost or not tried[k]) and done.d2[k] <= most], dtype=np.int64)
    if not len(out):
        return done
    before = state.map.mean(scan.robot)
    for _ in range(DOUBLED if lost else 1):
        if not approach(out.tolist(), math.inf):
            break
        if lost:
            _widen(state, scan, before)
    rest = update._replace(slots=update.slots[out], y=update.y[out], R=update.R[out])
    again, fused = state.correct(rest, scan.event, estimator), done.fused.copy()
    fused[out] = again.fused
    if lost:
        _widen(state, scan, before)
    return done._replace(fused=fused)


def _widen(state: State, scan: ScanContext, before: Array) -> None:
    """Add to the covariance of a robot the squares of `WIDER` times the change of its state since `before`.

    One correction moves a robot that is elsewhere by what its covariance allows: too little.  With the change added
    each time, the next correction moves it farther, at most `DOUBLED` times.
    """
    after, d, dof = state.map.mean(scan.robot), scan.dimensions, scan.channel.pose_dof
    turn = after[2] - before[2] if d == 2 else 2.0 * math.acos(min(1.0, abs(float(after[3:7] @ before[3:7]))))
    sigmas = np.repeat([np.linalg.norm(after[:d] - before[:d]), abs(wrap(float(turn)))], [d, dof - d])
    pose = len(scan.channel.at)
    sigmas = np.append(sigmas, np.abs(after[pose:] - before[pose:]))  # of a velocity, which a jump is none of
    state.map.predict(state.map.index(scan.robot), np.eye(len(sigmas)), np.diag((WIDER * sigmas) ** 2))
