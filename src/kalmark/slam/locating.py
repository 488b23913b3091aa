"""A robot that may be anywhere, put where its scan fits the map: at a global start, and after a gap."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from kalmark.arrays import Array
from kalmark.association.global_start import Located, is_lost, located
from kalmark.association.protocol import Decision
from kalmark.association.query import Query
from kalmark.association.relocalization import relocalized
from kalmark.events import Id
from kalmark.geometry import frames3d
from kalmark.geometry.frames import compose, inverse
from kalmark.slam.state import State
from kalmark.tracks.channel import Channel
from kalmark.tracks.scan import ScanContext

HEADING_RAD = 0.3  # a sigma above which a correction is not linearised at the prediction


def started(state: State, scan: ScanContext, query: Query) -> Located | None:
    """Move a robot that may be anywhere in a known map to where its scan fits; None of a robot that may not."""
    if not state.tracks.known:
        return None
    pose, dof = state.map.mean(scan.robot)[: len(scan.channel.at)], scan.channel.pose_dof
    if not is_lost(pose, state.map.covariance([scan.robot])[:dof, :dof], state.tracks):
        return None
    found = located(query)
    if found.T is not None:
        _put(state, scan, found.T)
    return found


def decided(
    state: State, scan: ScanContext, query: Query, decide: Callable[[Query], Sequence[Decision]]
) -> tuple[Query, Sequence[Decision]]:
    """Return what was asked and the decisions on a scan; a robot adrift is moved first.

    It is moved to where its scan fits, and stays there if the association recognises a landmark from there.
    """
    T = _fitting(state, scan, query)
    if T is None:
        return query, decide(query)
    before = state.map.mean(scan.robot)
    _put(state, scan, T)
    moved = Query(scan)
    decisions = decide(moved)
    if not any(name in state.tracks.confirmed or name in state.tracks.known for name, _ in decisions):
        state.map.set_predicted(scan.robot, before)
        moved = Query(scan)
        decisions = decide(moved)
    return moved, decisions


def _fitting(state: State, scan: ScanContext, query: Query) -> Array | None:
    """Return where the sensor (3,) of a robot adrift is; None of others, or if its scan fits nowhere."""
    held = state.moving[scan.event.robot].held
    if held.is_adrift and (len(scan.pose()) != 3 or state.map.covariance([scan.robot])[2, 2] < HEADING_RAD**2):
        held.recovered()
    scan.adrift = held.is_adrift
    if scan.adrift:
        with suppress(np.linalg.LinAlgError):
            return relocalized(query)
    return None


def placed_again(state: State, channel: Channel, name: str, T: Array, cov: Array) -> None:
    """Put a robot of space where its sensor is at T (7,), with the covariance (6, 6), wherever it was."""
    slot = state.moving[name].slot
    r = state.map.mean(slot)
    to_robot = frames3d.compose(frames3d.inverse(channel.pose(state.map, slot))[0], r[:7])[0]
    state.map.predict(state.map.index(slot)[:6], np.zeros((6, 6)), cov)
    state.map.set_predicted(slot, np.append(frames3d.compose(T, to_robot)[0], r[7:]))
    state.clones.moved(name)


def widened(state: State, name: str, landmarks: Sequence[Id], factor: float) -> None:
    """Multiply the joint covariance of a robot and of landmarks by a factor: they have drifted by more than it says."""
    slots = [state.moving[name].slot, *state.tracks.slots_of(landmarks).tolist()]
    rows = np.concatenate([state.map.index(slot) for slot in slots])
    state.map.predict(rows, math.sqrt(factor) * np.eye(len(rows)), np.zeros((len(rows), len(rows))))


def _put(state: State, scan: ScanContext, T: Array) -> None:
    """Move a robot of the plane so that the sensor of a scan is at T (3,).

    Its mean alone: the covariance says that it may be there.
    """
    r = state.map.mean(scan.robot)
    pose = compose(T, compose(inverse(scan.pose())[0], r[:3])[0])[0]
    state.map.set_predicted(scan.robot, np.append(pose, r[3:]))
