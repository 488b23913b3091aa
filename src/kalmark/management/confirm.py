"""Tentative tracks: m-of-n confirmation of landmarks that were observed too seldom to be accepted.

A tentative landmark is a block of the map, initialised as any landmark is, so that its covariance with the pose is
right however long it takes; but no observation of it corrects anything until it is confirmed.  Its measurements may be
kept with clones of the poses they were made from (`Upkeep.keep_poses`); when it is confirmed, they are fused from
there.  No association compares with it: an observation is compared with tentative landmarks when it is of no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.association.gated import assign
from kalmark.association.posterior import WELL_KNOWN
from kalmark.association.protocol import Association, new_gate
from kalmark.association.query import log_volume_ratio
from kalmark.association.wall_segments import disjoint_from_walls
from kalmark.events import Id
from kalmark.filter.estimators import Estimator
from kalmark.filter.map import Map
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import SCALAR, Space
from kalmark.models.observe import linearize
from kalmark.models.protocols import Visible
from kalmark.report import Observation
from kalmark.tracks.channel import Channel
from kalmark.tracks.clones import Measurement
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Track

NEAREST = 4  # tentative landmarks an observation is compared with
OUT_OF_VIEW = 20  # times `within` scans without an observation, in view or not: dropped


class Match(NamedTuple):
    """The k-th observation is of a tentative landmark."""

    k: int
    name: Id
    d2: float


def match_tentative(
    scan: ScanContext, association: Association, rows: list[int], lost: Flags
) -> tuple[list[Match], list[Observation]]:
    """Compare the observations `rows` with the tentative landmarks; return the pairs, and what is to be left alone.

    `lost` (K,) are observations of a robot whose pose is unknown.
    """
    kinds, tentative = scan.channel.models, scan.tracks.tentative.items()
    names = [name for name, track in tentative if track.model.kind in kinds and track.of is None]
    if not rows or not names:
        return [], []
    d2 = _distances(scan, rows, names, lost)
    gate = scan.channel.gate if np.isfinite(scan.channel.gate) else chi2_gate(0.99, scan.channel.dof)
    far = max(gate, chi2_gate(new_gate(association), scan.channel.dof))
    matches, others = [], []
    for i, (k, column) in enumerate(zip(rows, assign(d2, gate).tolist(), strict=True)):
        least = int(np.argmin(d2[i]))
        if column >= 0:
            matches.append(Match(k, names[column], float(d2[i, column])))
        elif d2[i, least] <= far:
            why = f"between {names[least]!r}, which is tentative, and a new one: d2 {d2[i, least]:.1f}"
            if d2[i, least] <= gate:
                why = f"its nearest tentative landmark {names[least]!r} is another observation's"
            others.append(Observation(k, None, "ignored", None, float(d2[i, least]), why))
    return matches, others


def tentative_in_view(scan: ScanContext, names: Sequence[Id]) -> list[Id]:
    """Return which of the tentative landmarks the sensor should observe; all if its model has no field of view."""
    if not isinstance(scan.channel.sensor, Visible):
        return list(names)
    tentative, found = scan.tracks.tentative, list[Id]()
    for kind in dict.fromkeys(tentative[name].model.kind for name in names):
        mine = [name for name in names if tentative[name].model.kind == kind]
        slots, extents = [tentative[name].slot for name in mine], [tentative[name].extent for name in mine]
        visible = scan.channel.in_view(scan.map, scan.robot, scan.channel.models[kind], slots, extents)
        found += [mine[i] for i in visible.tolist()]
    return found


def measurement_difference(
    map_: Map, estimator: Estimator, channel: Channel, clone: int, track: Track, m: Measurement
) -> tuple[Start, Array]:
    """Return e - y of a measurement as a block, to be observed as zero with the noise R (p, p); and R.

    `clone` is the slot of the pose from which it was made.  The clone itself is no robot to the map.
    """
    slots, model = np.array([track.slot]), channel.models[track.model.kind]
    R = channel.noise(map_, clone, model, slots, m.R[None], m.own_noise)[0]
    l = map_.means(slots, model.d)
    _, z, E_h, E_l = linearize(model.model, channel.observer(map_, clone), l, m.y[None])
    G = np.concatenate([estimator.pose_jacobian(map_, clone, E_h[0]), E_l[0]], axis=1)
    parts = (*channel.parts(map_, clone), (track.slot, E_l.shape[2]))
    p = len(z[0])
    return Start(Space("residual", (SCALAR,) * p), -z[0], parts, G, np.zeros((p, p))), R


def _distances(scan: ScanContext, rows: Sequence[int], names: Sequence[Id], lost: Flags) -> Array:
    """Return d2 (K, L) of observations from tentative landmarks, inf where they are not among the nearest.

    A `lost` observation is compared only with landmarks of well-known relative position.
    """
    tracks = [scan.tracks.tentative[name] for name in names]
    near = np.ones((len(rows), len(names)), dtype=np.bool_)
    places = scan.channel.places(scan.map, scan.robot, scan.y[list(rows)]) if len(names) > NEAREST else None
    if places is not None:
        here = scan.map.means(np.array([t.slot for t in tracks]), places.shape[1])
        gaps = np.linalg.norm(places[:, None] - here, axis=2)
        near = gaps <= np.partition(gaps, NEAREST - 1, axis=1)[:, NEAREST - 1 : NEAREST]
    d2 = np.full(near.shape, np.inf)
    for kind in dict.fromkeys(t.model.kind for t in tracks):
        i, j = np.nonzero(near & np.array([t.model.kind == kind for t in tracks]))
        if len(i):
            slots, model = np.array([tracks[n].slot for n in j.tolist()]), scan.channel.models[kind]
            Z, d2[i, j], R = scan.predict(model, slots, np.asarray(rows)[i])
            if scan.channel.joins:
                others = disjoint_from_walls(
                    scan, model.landmark, [tracks[n] for n in j.tolist()], np.asarray(rows)[i], d2[i, j]
                )
                d2[i, j] = np.where(others, np.inf, d2[i, j])
            d2[i, j] = np.where(lost[i] & (log_volume_ratio(Z, R) > WELL_KNOWN), np.inf, d2[i, j])
    d2[np.isnan(d2)] = np.inf
    return d2 + scan.class_distances(names, tentative=True)[0][list(rows)]
