"""Corrections by observations of landmarks: in the map, known exactly, or by means over matchings.  [S] (26)-(30)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.association.averaging import average, outcomes
from kalmark.association.protocol import Decision, Mixture
from kalmark.filter.estimators import Averaging, Correction, Update
from kalmark.geometry.gaussian import gate
from kalmark.management import ambiguous_tags, measured_depths
from kalmark.management.attention import select_observations
from kalmark.report import INDEFINITE, JudgedScan, Observation
from kalmark.slam import elsewhere, surveyed_corrections, tentative
from kalmark.slam.policy import Policy
from kalmark.slam.state import State
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.survey_checks import SURVEYED


def correct(state: State, scan: ScanContext, policy: Policy, groups: list[tuple[ObservationModel, list[int]]],
    decisions: Sequence[Decision],
) -> tuple[list[JudgedScan], list[Observation]]:  # fmt: skip
    """Fuse observations of landmarks in the map, the groups of those of one type at once.  [S] (26)-(30)."""
    report, most = scan.report, policy.attention.updates
    found: list[Observation] = []
    judged: list[JudgedScan] = []
    if most is not None and sum(len(rows) for _, rows in groups) > most:
        groups, out = select_observations(scan, policy.attention, groups, decisions)
        why = f"not among the {most} of most information"
        found += [Observation(k, scan.ids[k], "ignored", decisions[k][0], None, why) for k in out]  # type: ignore[arg-type]
    if policy.attention.sequential:
        groups = [(model, [k]) for model, rows in groups for k in rows]
    if not len(report.e) and (len(groups) != 1 or len(groups[0][1]) < len(scan.y)):
        report.blank(scan.channel.dof)
    for model, rows in groups:
        if not rows:
            continue
        names: list[Any] = [decisions[k][0] for k in rows]
        on_trial = surveyed_corrections.is_tried(state, scan.event.robot, names)
        least = surveyed_corrections.gate_of(state, scan, policy) if on_trial else math.inf
        slots = state.tracks.slots_of(names)
        approach = partial(_approach, state, scan, model, slots, rows, None)
        if scan.channel.approaches:
            approach(range(len(rows)), least)
        update = scan.update(model, slots, rows)
        done = (
            surveyed_corrections.correct_by_surveys(state, scan, names, update, least, state.estimator, approach)
            if on_trial
            else elsewhere.correct(state, scan, names, update)
        )
        report.fill(rows, done)
        judged.append(JudgedScan(rows, scan.ids, names, done, min(scan.channel.gate, least)))
        if policy.contests and scan.event.ids is not None:
            misfits = (
                elsewhere.misfits(state, scan, done)
                if scan.channel.robust is None
                else _outliers(scan, model, slots, rows, update, done)
            )
            tentative.contest(state, scan, model, judged[-1], misfits, policy.upkeep.odds)
        state.tracks.count(names, done.fused.tolist(), (scan.event.t_ns, scan.event.robot))
        scan.add_reports(names, rows, done.fused.tolist())
    return judged, found + _average(state, scan, decisions) if policy.averages else found


def correct_by_known(state: State, scan: ScanContext, policy: Policy, decisions: Sequence[Decision]
) -> list[JudgedScan]:  # fmt: skip
    """Correct by observations of landmarks known exactly, as by fixes.  docs/localization.md."""
    report, known, m = scan.report, state.tracks.known, scan.y.shape[1]
    groups = state.tracks.known_by_model(scan.channel, [name for name, _ in decisions])
    if policy.attention.sequential:
        groups = [(model, [k]) for model, rows in groups for k in rows]
    if groups and len(groups[0][1]) < len(scan.y):
        report.blank(scan.channel.dof)
    least = surveyed_corrections.gate_of(state, scan, policy) if groups else math.inf
    judged = []
    for model, rows in groups:
        names: list[Any] = [decisions[k][0] for k in rows]
        l, estimator = known.means(names, model.d), state.estimator.for_fixes()
        approach = partial(_approach, state, scan, model.exactly, np.full(len(rows), scan.robot), rows, l)
        approach(range(len(rows)), least)
        done = surveyed_corrections.correct_by_surveys(
            state, scan, names, scan.known_update(model, l, rows), least, estimator, approach
        )
        done = done._replace(e=done.e[:, :m])
        report.fill(rows, done)
        known.count(names, done.fused.tolist())
        judged.append(JudgedScan(rows, scan.ids, names, done, min(scan.channel.gate, least)))
    return judged


def _outliers(
    scan: ScanContext, model: ObservationModel, slots: Index, rows: list[int], update: Update, done: Correction
) -> Flags:  # fmt: skip
    """Return which observations (K,) do not fit by their own noise, where outliers count less."""
    Z = done.Z - update.R + scan.noise(model, slots, rows)
    regular: Flags = np.asarray(np.isfinite(Z).all(axis=(1, 2)), dtype=np.bool_)
    z, Z = np.where(regular[:, None], done.z, 0.0), np.where(regular[:, None, None], Z, np.eye(Z.shape[1]))
    d2 = np.sum(z * np.linalg.solve(Z, z[..., None])[..., 0], axis=1)
    return np.asarray(~regular | (d2 > gate(SURVEYED, scan.channel.dof)))


def _approach(
    state: State, scan: ScanContext, model: ObservationModel, slots: Index, rows: list[int], known: Array | None,
    some: Sequence[int], least: float,
) -> bool:  # fmt: skip
    """Correct by those of `some` observations that are far from what is expected; return whether any are.

    They are tags, or have a depth that was measured: `ambiguous_tags`, `measured_depths`.
    `slots` (K,) and `rows` are of all of them, as are the numbers (K, n) of landmarks `known` exactly; `some` are the
    numbers of those that are meant, `least` is the gate.
    """
    at = list(some)
    mine, of, exactly = [rows[i] for i in at], slots[at], None if known is None else known[at]
    found = (
        [ambiguous_tags.correct_by_tag_poses(scan, model, of, mine, exactly)] if scan.channel.far is not None else []
    )
    found += (
        [measured_depths.correct_by_inverse_ranges(scan, model, of, mine)]
        if scan.channel.depths and known is None
        else []
    )
    estimator, used = state.estimator if known is None else state.estimator.for_fixes(), False
    for near in found:
        used |= near is not None and bool(
            estimator.correct(state.map, near._replace(gate=min(near.gate, least))).fused.any()
        )
    return used


def _average(state: State, scan: ScanContext, decisions: Sequence[Decision]) -> list[Observation]:
    """Correct by the mean over the matchings among the decisions.  [F]."""
    found = average(scan, decisions)
    if found is None:
        return []
    assert isinstance(state.estimator, Averaging)
    d2, valid = state.estimator.average(state.map, found.update, found.pairs, found.weights)
    if not valid:
        state.refuse_lost(scan.event)
        rows = [k for k in found.rows.tolist() if isinstance(decisions[k][0], Mixture)]
        return [Observation(k, None, "rejected", None, None, INDEFINITE) for k in rows]
    of_these = outcomes(found, decisions, d2)
    by = scan.event.t_ns, scan.event.robot
    state.tracks.count([o.landmark for o in of_these], [o.outcome == "associated" for o in of_these], by)
    return of_these
