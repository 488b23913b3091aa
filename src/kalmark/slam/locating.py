"""A robot that may be anywhere, put where its scan fits the map: at a global start, and after a gap."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from kalmark.arrays import Array
from kalmark.association.global_start import Located, is_lost, located
from kalmark.association.query import Query
from kalmark.association.relocalization import relocalized as found_again
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


def relocalized(state: State, scan: ScanContext, query: Query) -> Query:
    """Move a robot whose heading a gap has left unknown to where its scan fits; return what to ask then."""
    held = state.moving[scan.event.robot].held
    if not held.is_adrift:
        return query
    if len(scan.pose()) != 3 or state.map.covariance([scan.robot])[2, 2] < HEADING_RAD**2:
        held.recovered()
        return query
    T = None
    with suppress(np.linalg.LinAlgError):
        T = found_again(query)
    if T is None:
        return query
    _put(state, scan, T)
    return Query(scan)


def placed_again(state: State, channel: Channel, name: str, T: Array, cov: Array) -> None:
    """Put a robot of space where its sensor is at T (7,), with the covariance (6, 6), wherever it was."""
    slot = state.moving[name].slot
    r = state.map.mean(slot)
    to_robot = frames3d.compose(frames3d.inverse(channel.pose(state.map, slot))[0], r[:7])[0]
    state.map.predict(state.map.index(slot)[:6], np.zeros((6, 6)), cov)
    state.map.set_predicted(slot, np.append(frames3d.compose(T, to_robot)[0], r[7:]))
    state.clones.moved(name)


def _put(state: State, scan: ScanContext, T: Array) -> None:
    """Move a robot of the plane so that the sensor of a scan is at T (3,).

    Its mean alone: the covariance says that it may be there.
    """
    r = state.map.mean(scan.robot)
    pose = compose(T, compose(inverse(scan.pose())[0], r[:3])[0])[0]
    state.map.set_predicted(scan.robot, np.append(pose, r[3:]))
