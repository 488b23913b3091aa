"""Corrections by what is measured of a robot alone: fixes, and readings of its sensors of the state."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from kalmark.errors import MapError
from kalmark.events import Event, Fix, Scan
from kalmark.filter.estimators import Update
from kalmark.geometry.spaces import SE2, SE3, Space
from kalmark.models.observe import fix_view
from kalmark.report import Judged, Observation, Report, outcomes_of
from kalmark.slam import moves, replacing
from kalmark.slam.checks import refuse_bad_fix
from kalmark.slam.motion import Moving
from kalmark.slam.reader import Reader
from kalmark.slam.state import State

ORIGIN = {3: np.zeros(3), 7: np.array([0.0, 0, 0, 0, 0, 0, 1])}
FIX_GATES = {2: 18.42, 3: 21.11}  # squared distances that .9999 of good fixes stay within


def read(state: State, event: Scan, reader: Reader) -> Report:
    """Correct by what a sensor measures of its own robot; leave a clone where its next readings count from here."""
    key, R, report = (event.robot, event.sensor), reader.noise(event), Report(event, event.y)
    begins = reader.begins_ns(event)
    state.t_ns = event.t_ns
    report.gaps = moves.advance(state, event.robot)
    if not len(event.y) and reader.keep == 1:
        return report
    reader.drift(state.map, event.t_ns)
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
        done = state.corrected(update, event, reader.estimator(state.estimator, is_loop))
        done = done._replace(e=done.e[:, : event.width])
        report.fill([k], done)
        found += outcomes_of(Judged([k], [None] * len(event.y), [event.robot], done, reader.gate))
        if done.fused[0] and not is_loop:
            reader.take(event.y[k : k + 1], done.Z, since_s)
        if reader.is_position:
            position = replacing.LeftOut(event.y[0], R[0], done.e[0])
            report.replaced = _believed(state, event.robot, position, done.fused[0])
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


def stood(state: State, event: Event) -> Observation | None:
    """Correct by a velocity of zero where a robot is noticed to stand at the end of an event."""
    key = event.robot, state.standing[event.robot]
    reader = state.readers[key]
    assert reader.standing is not None
    stands = reader.standing.take(event, lambda *sensor: state.readers[sensor].constants(state.map))
    if stands and reader.t_ns != event.t_ns:
        zero = Scan(t_ns=event.t_ns, robot=key[0], sensor=key[1], y=np.zeros((1, len(reader.sensor.columns))))
        return read(state, zero, reader).observations[0]
    if stands is False:
        for slot in state.clones.refer(key, ()):  # from where a robot that moves now was
            state.map.remove(slot)
    return None


def fix(state: State, event: Fix) -> Report:
    """Correct by a position from outside; place a robot again where fixes that agree say that it is lost."""
    pose, size = (3, 2) if state.robots[event.robot].motion.space.axes == 1 else (7, 3)
    refuse_bad_fix(event, size)
    state.t_ns = event.t_ns
    gaps = moves.advance(state, event.robot)
    slot, report = state.moving[event.robot].slot, Report(event, event.y.reshape(1, size))
    report.gaps = gaps
    gate, R = state.settings.association.threshold(size, FIX_GATES[size]), event.cov.reshape(1, size, size)
    update = Update(fix_view(ORIGIN[pose]), slot, -1, np.array([slot]), 0, report.y, R, gate)
    done = state.corrected(update, event, state.estimator.for_fixes())
    report.e, report.z, report.Z = done.e, done.z, done.Z
    report.judged = (Judged([0], [event.robot], [event.robot], done, gate),)
    report.replaced = _believed(state, event.robot, replacing.LeftOut(event.y, event.cov, done.e[0]), done.fused[0])
    return report


def _believed(state: State, name: str, position: replacing.LeftOut, fused: bool) -> float:
    """Keep a measured position that was left out; return how far, m, the robot is moved if these agree, 0 if not."""
    left_out = state.moving[name].left_out
    if fused:
        left_out.clear()
        state.placed += 1
        return 0.0
    del left_out[: len(left_out) + 1 - replacing.KEPT]
    left_out.append(position)
    return _replace(state, name)


def _replace(state: State, name: str) -> float:
    """Move a robot to where its fixes place it, if they agree; return how far, m, 0 where they do not."""
    moving = state.moving[name]
    space = moving.motion.space
    size, dof = (3, 3) if space.axes == 1 else (7, 6)
    mean = state.map.mean(moving.slot)
    found = replacing.replaced(mean[:size], state.map.covariance([moving.slot])[:dof, :dof], moving.left_out)
    if found is None:
        return 0.0
    blocks = _blocks(state)
    if (
        state.placed < replacing.NEEDED
        and len(state.robots) == 1
        and all(replacing.can_move(space) for _, space in blocks)
    ):
        _move(state, blocks, found.shift)
    else:
        _put(state, moving, found)
    state.placed = replacing.NEEDED
    state.clones.moved(name)
    moving.left_out.clear()
    d = len(found.shift.t)
    return float(np.linalg.norm(found.pose[:d] - mean[:d]))


def _put(state: State, moving: Moving, found: replacing.Replaced) -> None:
    """Move a robot alone."""
    mean, dof = state.map.mean(moving.slot), len(found.cov)
    state.map.predict(state.map.index(moving.slot)[:dof], np.zeros((dof, dof)), found.cov)
    state.map.set_predicted(moving.slot, np.concatenate([found.pose, mean[len(found.pose) :]]))


def _blocks(state: State) -> list[tuple[int, Space]]:
    """Return the slots and spaces of all that a motion of the world moves: robots, clones of their poses, landmarks."""
    poses = {name: SE2 if robot.motion.space.axes == 1 else SE3 for name, robot in state.robots.items()}
    return [
        *((moving.slot, moving.motion.space) for moving in state.moving.values()),
        *((clone.slot, poses[clone.robot]) for clone in state.clones.clones.values()),
        *((state.tracks.slots[name], track.model.space) for name, track in state.tracks.confirmed.items()),
    ]


def _move(state: State, blocks: list[tuple[int, Space]], shift: replacing.Shift) -> None:
    """Move the whole map; its covariance becomes P + G C G', C of the motion.  Once in a run: O(n^3)."""
    found = [replacing.moved(space, state.map.mean(slot), shift) for slot, space in blocks]
    rows = state.rows(tuple((slot, space.dof) for slot, space in blocks))
    G = np.concatenate([G_block for _, G_block in found])
    state.map.predict(rows, np.eye(len(rows)), G @ shift.cov @ G.T)
    for (slot, _), (mean, _) in zip(blocks, found, strict=True):
        state.map.set_predicted(slot, mean)
