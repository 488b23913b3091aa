"""Expected measurements of landmarks, without a scan: nothing is corrected.  [S] 2.4, [TB] Obs.

`feasible_observations` and `find_known_feature` of the guide and `vis`, `exp` and `Jac` of the toolbox are here: which
landmarks are in view, what is expected of them and how uncertain that is.  It is linearised as a correction is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.events import Id
from kalmark.filter.map import AT_ONCE, Map
from kalmark.filter.observed_block import innovation, observed_block
from kalmark.models import protocols
from kalmark.models.observe import linearize, sensor_pose
from kalmark.report import Expectations
from kalmark.tracks.channel import Channel, ObservationModel, landmarks_in_frame
from kalmark.tracks.track import Tracks

QUATERNION_AT = 6  # where the w of a pose is
UNMEASURED = "its size has not been measured"
Group = tuple[
    ObservationModel,
    list[int],
    Array,
    list[Array | None],
    list[float | None],
    Callable[..., "Linearised"],
    Array | Index,
]  # of one model: indices of names, l (K, n), extents, sizes, and what linearises them by their slots (K,) or by l


class Looked(NamedTuple):
    """Landmarks (K,) in view, reasons against the others, and of lines and tags the measurements y (K, m)."""

    in_view: Flags
    why: list[str]
    y: Array


class Linearised(NamedTuple):
    """Of K landmarks: e (K, m), Z (K, p, p), E_h (K, p, h) in pose, mount and parameters, and E_l (K, p, n)."""

    e: Array
    Z: Array
    E_h: Array
    E_l: Array


def expectations(
    map_: Map, tracks: Tracks, channel: Channel, robot: str, sensor: str, names: Sequence[Id] | None = None,
    only_in_view: bool = False,
) -> Expectations:  # fmt: skip
    """Return what a channel of a robot should measure of landmarks (or robots), of all or of those in view alone."""
    slot = tracks.slots[robot]
    if names is None:
        names = [*tracks.confirmed, *(_reached(map_, tracks, channel, slot) if only_in_view else tracks.known)]
    count, m, p = len(names), len(channel.sensor.columns), channel.dof
    in_view = np.zeros(count, dtype=np.bool_)
    why: list[str | None] = [None] * count
    found: list[tuple[Index, Linearised]] = []
    for model, group, l, extents, sizes, linearise, of in _by_model(map_, tracks, channel, robot, names):
        rows, T = np.array(group), channel.pose(map_, slot)
        seen = visible_landmarks(channel, model, T, l, extents, sizes, reasons=not only_in_view)
        for i, reason in zip(group, seen.why, strict=True):
            why[i] = reason
        in_view[rows] = seen.in_view
        chosen = np.flatnonzero(seen.in_view) if only_in_view else np.arange(len(rows))
        for at in range(0, len(chosen), AT_ONCE):  # a joint marginal is dense
            some = chosen[at : at + AT_ONCE]
            found.append((rows[some], linearise(map_, channel, slot, model, of[some], seen.y[some])))
    if channel.sees_velocity:  # of a state, the pose in it, too; a clone is not where the robot is
        twice = 1 if channel.counts else 2
        found = [(rows, part._replace(E_h=_in_pose(part.E_h, channel.pose_dof, twice))) for rows, part in found]
    h, n = (max((getattr(part, key).shape[2] for _, part in found), default=0) for key in ("E_h", "E_l"))
    h, dof = max(h, 2 * channel.pose_dof), channel.pose_dof
    whole = Linearised(*(np.full((count, *shape), np.nan) for shape in ((m,), (p, p), (p, h), (p, n))))
    for rows, part in found:
        for to, array in zip(whole, part, strict=True):
            where: tuple[Any, ...] = (rows, *(slice(size) for size in array.shape[1:]))
            to[where] = array
    for i in np.flatnonzero(in_view & ~np.isfinite(whole.e).all(axis=1)).tolist():
        in_view[i], why[i] = False, "nothing can be expected of it from here"
    asked = np.flatnonzero(in_view).tolist() if only_in_view else list(range(count))
    e, Z, E_h, E_l = (array[asked] for array in whole)
    shown, reasons = tuple(names[i] for i in asked), (why[i] for i in asked)
    texts = (_not_observed(channel, tracks, n, robot) if w is None else w for n, w in zip(shown, reasons, strict=True))
    return Expectations(
        robot, sensor, tuple(channel.sensor.columns), shown, tuple(str(tracks.sort(name)) for name in shown),
        in_view[asked], tuple(texts), e, Z, E_h[:, :, :dof], E_h[:, :, dof : 2 * dof], E_h[:, :, 2 * dof :], E_l,
    )  # fmt: skip


def _by_model(map_: Map, tracks: Tracks, channel: Channel, robot: str, names: Sequence[Id]) -> Iterator[Group]:
    """Yield the named landmarks by their models: those in the map, then those known exactly."""
    for model, group in tracks.by_model(channel, names, robot):
        slots = tracks.slots_of([names[i] for i in group])
        of = [tracks.confirmed.get(names[i]) for i in group]
        extents = [None if track is None else track.extent for track in of]
        sizes = [None if track is None else track.size_m for track in of]
        yield model, group, map_.means(slots, model.d), extents, sizes, linearize_blocks, slots
    for model, group in tracks.known_by_model(channel, names):
        known = [names[i] for i in group]
        l, extents = tracks.known.means(known, model.d), [tracks.known.extent(name) for name in known]
        yield model, group, l, extents, [None] * len(known), linearised_known, l


def _in_pose(E_h: Array, dof: int, times: int) -> Array:
    """Return the Jacobian (K, p, dof) in a robot's pose, with which so many blocks of the columns of E_h begin."""
    E_r: Array = sum((E_h[:, :, k * dof : (k + 1) * dof] for k in range(times)), np.zeros((*E_h.shape[:2], dof)))
    return E_r


def _reached(map_: Map, tracks: Tracks, channel: Channel, robot: int) -> list[Id]:
    """Return the landmarks known exactly that are within reach of a sensor: they may be many."""
    limit, place = protocols.range_limit(channel.sensor), channel.pose(map_, robot)[: channel.dimensions]
    of = [known for kind, known in tracks.known.of_kind.items() if kind in channel.models]
    return [known.names[row] for known in of for row in known.within(place, limit)]


def _not_observed(channel: Channel, tracks: Tracks, name: Id, robot: str) -> str:
    if name == robot:
        return "a robot does not observe itself"
    return f"a {type(channel.sensor).__name__} does not observe a {tracks.sort(name)}"


# ---------------------------------------------------------------------- in view
def visible_landmarks(
    channel: Channel, model: ObservationModel, T: Array, l: Array, extents: Sequence[Array | None],
    sizes: Sequence[float | None], reasons: bool,
) -> Looked:  # fmt: skip
    """Return which landmarks l (K, n) of one kind are in view from the pose T, and measurements to linearise at.

    `extents` (2,) are those of lines, `sizes` in m those of tags; `reasons`: and why the others are not in view.
    """
    sensor: Any = channel.sensor
    columns: tuple[str, ...] = tuple(sensor.columns)
    y = np.zeros((len(l), len(columns)))
    if isinstance(model.landmark, protocols.Segmented):
        t = np.array([model.landmark.first_ends if end is None else end for end in extents])
        p, _ = model.landmark.endpoints(l, t)
        in_view, y = sensor.sees_segments(T, np.ascontiguousarray(p[:, 0]), np.ascontiguousarray(p[:, 1]))
        return Looked(in_view, ["" if seen else "no part of its segment is in view" for seen in in_view], y)
    v = landmarks_in_frame(model.landmark, T, l)
    in_view = protocols.in_view(sensor, v)
    why = [""] * len(v)
    for i in np.flatnonzero(~in_view).tolist() if reasons else ():
        why[i] = _out_of_view(sensor, v[i])
    if "qw" in columns:
        y[:, QUATERNION_AT] = 1.0
    if "size_m" in columns:
        y[:, -1] = [math.nan if size is None else size for size in sizes]
        unmeasured = np.isnan(y[:, -1]).tolist()
        why = [reason or (UNMEASURED if lacks else "") for reason, lacks in zip(why, unmeasured, strict=True)]
        in_view = in_view & ~np.array(unmeasured, dtype=np.bool_)
    return Looked(in_view, why, y)


def _out_of_view(sensor: Any, v: Array) -> str:
    """Return why a sensor does not observe what is at v (d,) in its frame."""
    if (why_unseen := protocols.why_unseen(sensor)) is not None:
        return why_unseen(v)
    d = v[:2] if protocols.world_of(sensor) == "plane" else v[:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = float(np.linalg.norm(d)) / (float(v[3]) if len(v) == 4 else 1.0)
    limit, fov = protocols.range_limit(sensor), protocols.field_of_view(sensor)
    if distance > limit:
        return f"it is {distance:.3g} m away, farther than {limit:g} m"
    off = math.atan2(float(np.linalg.norm(d[1:])), float(d[0]))
    if off > fov / 2:
        return f"it is {math.degrees(off):.3g} deg off the axis of a field of view of {math.degrees(fov):.3g} deg"
    return "it is out of sight"


# ---------------------------------------------------------------------- expectations
def linearize_blocks(
    map_: Map, channel: Channel, robot: int, model: ObservationModel, slots: Index, y: Array
) -> Linearised:
    """Return expectations of blocks of one kind, linearised as a correction would be."""
    m, here, second, at = map_.marginal(robot, channel.second(robot), slots)
    index, _, mean = observed_block(m.x, m.blocks, m.atoms, here, second, at, model.d)
    head = channel.head(map_, robot)
    l = np.ascontiguousarray(mean[len(head) :].reshape(len(slots), model.d))
    e, E_h, E_l, R = expect_at_pose(channel, model, head, l, y)
    seen = E_h if second >= 0 else np.ascontiguousarray(E_h[:, :, : channel.pose_dof])
    Z = innovation(m.P, index, seen, E_l, R, np.zeros((len(e), R.shape[1])))[0]
    return Linearised(e, Z, E_h, E_l)


def linearised_known(
    map_: Map, channel: Channel, robot: int, model: ObservationModel, l: Array, y: Array
) -> Linearised:  # fmt: skip
    """Return expectations of landmarks l (K, n) of one kind that are known exactly."""
    e, E_h, E_l, R = expect_at_pose(channel, model, channel.head(map_, robot), l, y)
    dof, second = channel.pose_dof, channel.second(robot)
    P, seen = map_.covariance([robot])[:dof, :dof], E_h[:, :, :dof]
    if second >= 0:
        whole, own = map_.covariance([robot, second]), len(map_.rows(robot))
        rows = np.r_[0:dof, own : len(whole)]
        P, seen = whole[np.ix_(rows, rows)], E_h
    return Linearised(e, seen @ P @ seen.swapaxes(1, 2) + R, E_h, E_l)


def expect_at_pose(
    channel: Channel, model: ObservationModel, head: Array, l: Array, y: Array
) -> tuple[Array, Array, Array, Array]:
    """Return e (K, m), E_h (K, p, h), E_l (K, p, n) and the noise R (K, p, p) of landmarks l (K, n).

    The Jacobian E_h is in the pose, in the mount and in the parameters that are in the map; of a sensor that sees its
    velocity in the pose and in the robot's state.
    """
    observer = head
    if len(head) == len(channel.at):  # the Jacobian in a mount that is not in the map, too
        head = np.concatenate([head, channel.at])
    e = linearize(model.model, head, l, y)[0]
    if isinstance(model.landmark, protocols.Segmented):
        e = y  # of a line, the part of its segment that is in view
    _, z, E_h, E_l = linearize(model.model, head, l, np.ascontiguousarray(e))
    if channel.noise_at is None:
        R = channel.sensor.noise(e)
    else:
        T = sensor_pose(*channel.split(observer)[:2])[0]
        R = channel.noise_at(model.landmark.seen_from(T, l)[0])
    return e, E_h, E_l, np.array(np.broadcast_to(R, (len(l), z.shape[1], z.shape[1])))
