"""Walls of which more is known: their segments grow, and two whose segments join and whose lines agree are one.

Unlike points, two walls may be one though they were observed in one scan: as the pieces of it on both sides of what
hides the rest.  So the places are no evidence against it, and the lines must agree all the more: the difference of two
lines, an angle and a distance, is compared with what two walls of the map differ by at random.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.association.wall_segments import gap
from kalmark.events import Id
from kalmark.filter.map import Map
from kalmark.geometry.gaussian import gate
from kalmark.geometry.spaces import SCALAR, Space
from kalmark.management.merge import EQUAL_M, EVERY, GATE, Merge, Pair
from kalmark.tracks.channel import Channel
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Track, Tracks

DIFFERENCE = Space("difference of walls", (SCALAR, SCALAR))  # which no motion of the world changes
TINY_M = 1e-9
TURNED_RAD = 0.3  # walls at a larger angle are not compared: they meet in a corner


def extend_extents(scan: ScanContext, tracks: Sequence[Track], rows: Sequence[int]) -> list[Array | None]:
    """Return the abscissas (2,) of what is known of some walls after the observations `rows` of them.

    None, of a surveyed wall, stands for its whole line.
    """
    if not len(tracks):
        return []
    model: Any = tracks[0].model
    l = scan.map.means(np.array([track.slot for track in tracks]), model.space.size)
    more = model.abscissas(scan.pose(), l, scan.channel.sensor.invert(scan.y[[*rows]])[0])
    pairs = zip(tracks, more, strict=True)
    return [_hull(t.extent, m) if t.extent is not None and model.extend else t.extent for t, m in pairs]


def first_extent(scan: ScanContext, track: Track, k: int) -> Array:
    """Return the abscissas (2,) of the segment by which an observation started a wall."""
    model: Any = track.model
    l, v = scan.map.mean(track.slot)[None], scan.channel.sensor.invert(scan.y[k : k + 1])[0]
    t: Array = model.abscissas(scan.pose(), l, v)[0]
    return t


def _hull(one: Array, other: Array) -> Array:
    return np.array([min(one[0], other[0]), max(one[1], other[1])])


def find_coincident_wall(
    map_: Map, tracks: Tracks, channel: Channel, observed: Sequence[Id], odds: float
) -> Merge | None:
    """Return a wall of those observed with another one that is the same, and the log ratio of that; None at the end.

    Their segments join, and that their lines agree as they do is so many times likelier, `odds`, than by chance.
    """
    walls = [t for t in tracks.confirmed.values() if t.model.kind in channel.kinds and t.extent is not None]
    counts = {name: tracks.confirmed[name].observations for name in observed if name in tracks.confirmed}
    due = {name for name, count in counts.items() if count % EVERY == 0 or count < EVERY}
    mine = [i for i, track in enumerate(walls) if track.id in due]
    if len(walls) < 2 or not mine:
        return None
    model: Any = walls[0].model
    l = map_.means(np.array([track.slot for track in walls]), model.space.size)
    t = np.array([track.extent for track in walls])
    ends = model.endpoints(l, t)[0]
    along = ends[:, 1] - ends[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1), TINY_M)[:, None]
    extent = float(np.linalg.norm(np.ptp(ends.reshape(-1, 2), axis=0)))
    chance = math.log(len(walls) / (math.pi * max(extent, 1.0)))
    for i in mine:
        others = np.sort((ends - l[i, :2]) @ along[i], axis=1)  # abscissas on this one
        across = np.abs(along[:, 0] * along[i, 1] - along[:, 1] * along[i, 0])
        near = (gap(others, t[i : i + 1]) <= model.join_m) & (across < math.sin(TURNED_RAD))
        for j in np.flatnonzero(near).tolist():
            if j == i or not any(tracks.is_invented(walls[k].id) for k in (i, j)):  # two ids are two walls
                continue
            ratio = _log_ratio(map_, walls[i], walls[j], _between(t[i], others[j]), chance)
            if ratio >= math.log(odds):
                return Merge([(walls[i].id, walls[j].id)], ratio)
    return None


def _between(one: Array, other: Array) -> float:
    """Return the middle of where two intervals (2,) overlap, or of the gap between them."""
    return 0.5 * float(max(one[0], other[0]) + min(one[1], other[1]))


def _log_ratio(map_: Map, one: Track, other: Track, at: float, chance: float) -> float:
    """Return the log-likelihood ratio of two walls that are one; -inf outside the gate."""
    z, Z, _ = _difference(map_, one, other, at)
    d2 = float(z @ np.linalg.solve(Z, z))
    if d2 > gate(GATE, len(z)):
        return -math.inf
    return -0.5 * d2 - 0.5 * float(np.linalg.slogdet(2 * math.pi * Z)[1]) - chance


def _difference(map_: Map, one: Track, other: Track, at: float) -> tuple[Array, Array, Array]:
    """Return the difference z (2,) of two walls at an abscissa of the first, its covariance and its Jacobian."""
    model: Any = one.model
    z, *G = model.difference(map_.mean(one.slot), map_.mean(other.slot), at)
    J = np.hstack(G)
    return z, J @ map_.covariance([one.slot, other.slot]) @ J.T + EQUAL_M**2 * np.eye(len(z)), J


def difference(map_: Map, tracks: Tracks, pair: Pair) -> Start:
    """Return the difference of two walls as a block, to be observed as zero."""
    one, other = (tracks.confirmed[name] for name in pair)
    z, _, J = _difference(map_, one, other, _between(*(_extent_on(map_, one, each) for each in (one, other))))
    parts = tuple((track.slot, track.model.space.dof) for track in (one, other))
    return Start(DIFFERENCE, z, parts, J, np.zeros((len(z), len(z))))


def _extent_on(map_: Map, wall: Track, other: Track) -> Array:
    """Return the abscissas (2,), in order, on a wall of the ends of another."""
    assert other.extent is not None
    if wall is other:
        return other.extent
    model: Any = wall.model
    base = model.endpoints(map_.mean(wall.slot)[None], np.array([[0.0, 1.0]]))[0][0]
    ends = model.endpoints(map_.mean(other.slot)[None], other.extent[None])[0][0]
    return np.sort((ends - base[0]) @ (base[1] - base[0]))


def united_extent(map_: Map, kept: Track, gone: Track) -> Array:
    """Return the abscissas (2,) of a wall that has taken in another one, on the line of the first."""
    assert kept.extent is not None
    return _hull(kept.extent, _extent_on(map_, kept, gone))
