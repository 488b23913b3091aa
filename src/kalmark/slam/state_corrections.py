"""Corrections by what is measured of a robot alone: fixes, and readings of its sensors of the state."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import MapError
from kalmark.events import Event, Fix, Scan
from kalmark.filter.estimators import Correction
from kalmark.geometry.spaces import Space
from kalmark.report import JudgedScan, Observation, Report, outcomes_of
from kalmark.slam import moves, relocation_by_fixes
from kalmark.slam.checks import refuse_bad_fix
from kalmark.slam.held_readings import record_repeated_reading
from kalmark.slam.pose_hypothesis import PoseHypothesis, write_robot
from kalmark.slam.reader import StateReader
from kalmark.slam.state import State


def correct_by_reading(state: State, event: Scan, reader: StateReader) -> Report:
    """Correct by what a sensor measures of its own robot; leave a clone where its next readings count from here."""
    key, R, report = (event.robot, event.sensor), reader.noise(event), Report(event, event.y)
    begins, ids = reader.begins_ns(event), event.ids or [None] * len(event.y)
    state.t_ns = event.t_ns
    report.gaps = moves.advance(state, event.robot)
    if not len(event.y) and reader.keep == 1:
        return report
    if not reader.counts and state.repeats(key, event.t_ns, event.y):
        return record_repeated_reading(report, ids, R.shape[1], event.robot)
    other = state.pose_hypotheses.get(event.robot)
    sum_ = state.sums.get(event.robot)
    others = [*([] if other is None else [other]), *([] if sum_ is None else sum_.all())]
    reader.drift(event.t_ns, state.map, *(each.map for each in others))
    clones = {state.clones.clones[number].t_ns: number for number in state.clones.of(key)}
    found = list[Observation]()
    report.blank(R.shape[1])
    for k, from_ns in enumerate(begins):
        is_loop, since_s = reader.is_loop(event, k), 0.0 if from_ns is None else (event.t_ns - from_ns) * 1e-9
        if reader.counts and from_ns not in clones:
            why = "no pose of the time of its id is kept" if is_loop else "the first reading: none to count from"
            found.append(Observation(k, None, "ignored", event.robot, None, why))
            continue
        clone = state.clones[clones[from_ns]] if from_ns in clones else -1
        update = reader.update(state.map, state.moving[event.robot], clone, event, k, R[k : k + 1], since_s)
        estimator = reader.estimator(state.estimator, is_loop)
        fits = other is not None and not reader.counts and other.correct(estimator, update)
        if sum_ is not None and not reader.counts:
            sum_.correct(estimator, update)
        done = state.correct(update, event, estimator)
        done = done._replace(e=done.e[:, : event.width])
        report.fill([k], done)
        found += outcomes_of(JudgedScan([k], ids, [event.robot], done, reader.gate))
        if done.fused[0] and not is_loop:
            reader.take(event.y[k : k + 1], done.Z, since_s)
        if reader.is_position:
            report.replaced = _record_position(state, event.robot, event.y[0], R[0], done, fits)
    report.observations = found
    if reader.counts:
        kept: list[int] = []
        with suppress(MapError):  # it is full: the next reading is the first again
            if reader.kept({event.t_ns: -1}, event.t_ns):
                clones[event.t_ns] = state.clone(key, event.t_ns)
            kept = reader.kept(clones, event.t_ns)
        for slot in state.clones.refer(key, kept):
            state.map.remove(slot)
    return report


def correct_by_rest(state: State, event: Event) -> Observation | None:
    """Correct by a velocity of zero where a robot is detected to stand at the end of an event."""
    key = event.robot, state.standing[event.robot]
    reader = state.readers[key]
    assert reader.standing is not None
    stands = reader.standing.take(event, lambda *sensor: state.readers[sensor].constants(state.map))
    if stands and reader.t_ns != event.t_ns:
        zero = Scan(t_ns=event.t_ns, robot=key[0], sensor=key[1], y=np.zeros((1, len(reader.sensor.columns))))
        return correct_by_reading(state, zero, reader).observations[0]
    if stands is False:
        for slot in state.clones.refer(key, ()):  # from where a robot that moves now was
            state.map.remove(slot)
    return None


def fix(state: State, event: Fix) -> Report:
    """Correct by a position from outside, the reading of an antenna; place a lost robot again where fixes agree."""
    antenna = state.antennas[event.robot]
    refuse_bad_fix(event, len(antenna.sensor.columns))
    reading = Scan(None, event.robot, "", event.y[None], [event.robot], event.cov[None], t_ns=event.t_ns)
    report = correct_by_reading(state, reading, antenna)
    report.event = event
    return report


def _record_position(state: State, name: str, y: Array, R: Array, done: Correction, fits: bool) -> float:
    """Take note whether a position y (d,) of noise R (d, d) fitted; return how far, m, it moved the robot, 0 if not.

    Where none has determined yet where the map is, the first that agree do.  Later they may be wrong: then the robot
    moves if they fit a second hypothesis for long.  `fits`: whether this one does.
    """
    moving, other = state.moving[name], state.pose_hypotheses.get(name)
    if done.fused[0]:
        moving.left_out.clear()
        state.pose_hypotheses.pop(name, None)
        state.placed += 1
        return 0.0
    assert state.t_ns is not None
    del moving.left_out[: len(moving.left_out) + 1 - relocation_by_fixes.KEPT]
    moving.left_out.append(relocation_by_fixes.RejectedFix(y, R, done.e[0, : len(y)]))
    size, dof = moving.motion.space.pose.size, moving.motion.space.pose.dof
    mean = state.map.mean(moving.slot)
    found = relocation_by_fixes.pose_by_fixes(
        mean[:size], state.map.covariance([moving.slot])[:dof, :dof], moving.left_out
    )
    if state.placed < relocation_by_fixes.NEEDED and found is not None:
        blocks = _blocks(state)
        if len(state.robots) == 1 and all(relocation_by_fixes.can_move(space) for _, space in blocks):
            _move(state, blocks, found.shift)
        else:
            write_robot(state.map, moving, found.pose, found.cov)
    elif other is not None and fits and other.explains(state.t_ns):
        write_robot(state.map, moving, other.map.mean(moving.slot), other.map.covariance([moving.slot]))
    else:
        _doubt(state, name, found, done, R, fits)
        return 0.0
    state.placed = relocation_by_fixes.NEEDED
    state.clones.forget_current(name)
    state.pose_hypotheses.clear()
    moving.left_out.clear()
    return float(np.linalg.norm(state.map.mean(moving.slot)[: len(y)] - mean[: len(y)]))


def _doubt(
    state: State, name: str, found: relocation_by_fixes.Relocation | None, done: Correction, R: Array, fits: bool
) -> None:
    """Keep the second hypothesis for a position that was left out, or begin another if that does not fit either.

    It begins where the last ones place the robot, if they agree, else with the robot less certain.
    """
    other = state.pose_hypotheses.get(name)
    if other is not None:
        other.misses = 0 if fits else other.misses + 1
        if not other.failed:
            return
    assert state.t_ns is not None
    other = state.pose_hypotheses[name] = PoseHypothesis.of(state.map, state.moving[name], state.blocks, state.t_ns)
    if found is None:
        other.widen(done.z[0], done.Z[0], R)
    else:
        write_robot(other.map, other.moving, found.pose, found.cov)


def _blocks(state: State) -> list[tuple[int, Space]]:
    """Return the slots and spaces of all that a motion of the world moves: robots, clones of their poses, landmarks."""
    return [
        *((moving.slot, moving.motion.space) for moving in state.moving.values()),
        *((clone.slot, state.robots[clone.robot].motion.space.pose) for clone in state.clones.clones.values()),
        *((state.tracks.slots[name], track.model.space) for name, track in state.tracks.confirmed.items()),
    ]


def _move(state: State, blocks: list[tuple[int, Space]], shift: relocation_by_fixes.Shift) -> None:
    """Move the whole map; its covariance becomes P + G C G', C of the motion.  Once in a run: O(n^3)."""
    found = [relocation_by_fixes.shift_block(space, state.map.mean(slot), shift) for slot, space in blocks]
    G = np.concatenate([G_block for _, G_block in found])
    state.move_blocks([slot for slot, _ in blocks], np.eye(len(G)), G @ shift.cov @ G.T, [mean for mean, _ in found])
