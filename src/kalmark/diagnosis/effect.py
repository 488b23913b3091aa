"""Effect of causes on the shape of a map and on its sigmas."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import pdtrc

from kalmark.arrays import Array, Flags, Index
from kalmark.batch.batch_state import LANDMARKS, POSES
from kalmark.diagnosis import repeated_events
from kalmark.diagnosis.batch_search import Searched
from kalmark.diagnosis.cause_search import Search
from kalmark.diagnosis.linear import Linear
from kalmark.results.batch import filter_only_sensors, filtered_map
from kalmark.results.checked import DOUBTFUL, OK, WRONG, worst_status
from kalmark.results.control_gaps import while_lost
from kalmark.results.gauge import shape_of_points
from kalmark.results.measures import Rigid, rigid, rmse
from kalmark.results.run import Run
from kalmark.slam.relocation_by_fixes import NEEDED

FEW = 0.01  # of landmarks or observations: a mistake about no more than these is weighed by what it does to the map
LIKELY = 0.05  # the probability of so many outliers or marks, or more, up to which they are not by chance
LEAST, MOST_OFF = 0.01, 0.2  # of the map's extent: what its shape may be off by, and what makes it wrong
TOO_SURE = 0.8  # of the batch solution's sigma, below which the filter claims too much
SIGMAS = 3.0  # of its own by which the shape of a doubtful map is off
TINY_M = 1e-12


@dataclass(frozen=True)
class Effect:
    """Effect of the causes on a map: as in `Verdict`; `claimed` is the filter's sigma over what the data allow.

    `robots` has the status of the path of each robot, by the same measure.

    >>> Effect().status, Effect(sigma_factor=1.3).sigma_factor
    ('ok', 1.3)
    """

    status: str = OK
    sigma_factor: float | None = None
    accuracy_m: float | None = None
    shape_accuracy_m: float | None = None
    shift_m: float | None = None
    claimed: float | None = None
    dof: int = 0
    robots: dict[str, str] = field(default_factory=dict)


def is_by_chance(number: int, of: int) -> bool:
    """Return whether so many landmarks or observations, of all, may be marked or left out by chance: a share `FEW` is.

    >>> is_by_chance(0, 3), is_by_chance(4, 300), is_by_chance(8, 300)
    (True, True, False)
    """
    return number == 0 or float(pdtrc(number - 1, FEW * of)) > LIKELY


def effect_of(run: Run, found: Searched) -> Effect:
    """Return the effect of the causes on the shape of a run's map and on its sigmas."""
    rows = list(_shared(run, found.search))
    if not rows:
        return Effect()
    mine, its = (np.array(column) for column in zip(*rows, strict=True))
    d, first, cured = found.batch.state.d, found.search.first, found.search.linear
    places, moved = (state.groups[LANDMARKS][its, :d] for state in (found.batch.state, cured.moved()))
    steady = replace(first, z=cured.z, w=cured.w).moved().groups[LANDMARKS][its, :d]  # the noise as it was stated
    mapped = filtered_map(run)
    lines = np.array([run.landmarks.kinds[k] == "wall" for k in mine])
    angle = np.where(lines, found.batch.state.groups[LANDMARKS][its, -1], np.nan)
    onto, extent = rigid(places, moved), rmse(moved - moved.mean(axis=0))
    robots = dict(_paths(run, found, onto, extent)) if len(rows) > d else {}
    off = _off(onto, places, moved, angle)
    off = max([off, *_off_instead(found.search, places, its, angle)], key=rmse)
    by_steady = rmse(_off(rigid(places, steady), places, steady, angle))
    P = np.array([mapped[run.landmarks.ids[k]][1][:d, :d] for k in mine])
    (stated, bare_stated), (honest, bare_honest) = (_sigmas(each, places, its, ~lines) for each in (first, cured))
    filtered = sigma_of(P)
    shift_m = float(np.sqrt(max(rmse(off) ** 2 - rmse(honest[:, None]) ** 2, 0.0)))
    free = (filtered > 0) & (stated > 0)
    if not free.any():
        return Effect(shift_m=shift_m, robots=robots)
    shift_m = max(shift_m, by_steady)  # of causes that are certain, which no noise explains
    status = status_by_shape(shift_m, extent, float(np.median(filtered[free])))
    ratio, waited = filtered[free] / stated[free], np.isin(run.history.outcome, ("tentative", "deferred")).any()
    same_data = not waited and not filter_only_sensors(run.final_slam())  # what waited is not in the batch solution
    comparable = found.given.segments is None and same_data
    claimed = float(np.median(ratio)) if comparable else None
    twice = repeated_events.repeated_scans(run).any()
    over = 1.0 / claimed if claimed is not None and (claimed < TOO_SURE or twice) else 1.0
    factors = np.hypot(honest[free] / stated[free] * over, shift_m / filtered[free])
    accuracy_m = float(np.median(factors * filtered[free]))
    end = run.history.map_at(len(run.history.t_ns))
    kept = dict(zip(end.ids, end.shape[:, :d, :d], strict=True))
    bare = sigma_of(np.array([kept.get(run.landmarks.ids[k], P[row]) for row, k in enumerate(mine)]))
    larger = np.divide(bare_honest, bare_stated, out=np.ones(len(bare)), where=bare_stated > 0) * over
    shape_m = float(np.median(np.hypot(larger * bare, shift_m)[free]))
    return Effect(
        status, float(np.median(factors)), accuracy_m, shape_m, shift_m, claimed, d * int(free.sum()), robots
    )  # fmt: skip


def shape_without(run: Run, without: Run) -> tuple[str, float]:
    """Return the status of a map by its shape in a run without a cause, and by what that is off, m, beyond its sigma.

    Landmarks without ids are compared with those next to them: two of which one is left were one thing.
    """
    (mine, sigmas), (places, _) = (r.landmarks.positions() for r in (run, without))
    names = [[str(i) for i in r.landmarks.ids] for r in (run, without)]
    if min(len(places), len(mine)) < NEEDED:
        return WRONG if len(mine) else OK, 0.0  # a path alone has no shape of a map
    at = np.array([names[1].index(name) if name in names[1] else -1 for name in names[0]])
    if (run.history.id == "").any():
        if len(run.history.poses) == len(without.history.poses):
            known = ~(while_lost(run.history) | while_lost(without.history))
            mine = rigid(*(r.history.poses[known, : run.history.d] for r in (run, without)))(mine)
        nearest = cKDTree(np.nan_to_num(places)).query(np.nan_to_num(mine))[1]
        at = np.where(np.isin(names[0], run.history.id), at, nearest)
    both = np.isfinite(mine).all(axis=1) & np.isfinite(places[at]).all(axis=1) & (at >= 0)
    both &= np.isin(np.array(names[1])[at], without.history.landmark)  # those of surveys alone are as these are
    if both.sum() < NEEDED:
        return WRONG, 0.0
    mine, twice, places = mine[both], both.sum() - len(np.unique(at[both])), places[at[both]]
    off, sigma = np.linalg.norm(rigid(mine, places)(mine) - places, axis=1), sigma_of(sigmas[both])
    off_m, extent_m = math.sqrt(float(np.mean(off**2))), rmse(places - places.mean(axis=0))
    wrong = twice + int(((off > SIGMAS * sigma) & (off > LEAST * extent_m)).sum())
    status = status_by_shape(off_m, extent_m, float(np.median(sigma)))
    return worst_status(status, DOUBTFUL if wrong > FEW * len(at) else OK), 0.0 if status == OK else off_m


def status_by_shape(off_m: float, extent_m: float, sigma_m: float) -> str:
    """Return the status of a map or a path of this sigma that is off by so much, in a map of this extent."""
    share = off_m / max(extent_m, TINY_M)
    if share <= LEAST or off_m <= SIGMAS * sigma_m:
        return OK
    return DOUBTFUL if share < MOST_OFF else WRONG


def _paths(run: Run, found: Searched, onto: Rigid, extent_m: float) -> Iterator[tuple[str, str]]:
    """Yield the status of the path of each robot, `onto` being the motion of the map when the causes are taken out.

    A mount that is not where it is stated bends no map, but each pose of its robot is off.
    """
    d, nodes, end = found.batch.state.d, found.search.linear.problem.nodes, run.history.map_at(len(run.history.t_ns))
    path, moved = (s.groups[POSES][nodes, :d] for s in (found.batch.state, found.search.linear.moved()))
    off = onto(path) - moved
    for start, sigma_m in zip(run.history.starts, sigma_of(end.robots).tolist(), strict=True):
        mine = found.given.robot == start.robot
        if mine.any():
            yield start.robot, status_by_shape(rmse(off[mine]), extent_m, sigma_m)


def _off(onto: Rigid, places: Array, moved: Array, angle: Array) -> Array:
    """Return by what (K, d) landmarks move beyond a rigid motion of all; lines with normals at an `angle` across."""
    off = onto(places) - moved
    lines = np.isfinite(angle)
    if lines.any():
        n = np.column_stack([np.cos(angle), np.sin(angle)])[lines] @ onto.rotation.T
        off[lines] = np.sum(off[lines] * n, axis=1, keepdims=True) * n
    return off


def _off_instead(search: Search, places: Array, its: Index, angle: Array) -> Iterator[Array]:
    """Yield by what landmarks move with what the log does not distinguish from a cause in its place: either may be."""
    cured = search.linear
    for z, w in search.instead:
        moved = replace(cured, z=cured.z + z, w=cured.w + w).moved().groups[LANDMARKS][its, : places.shape[1]]
        yield _off(rigid(places, moved), places, moved, angle)


def _shared(run: Run, search: Search) -> Iterator[tuple[int, int]]:
    """Yield the numbers of each landmark in the map and in the batch solution."""
    at = {id_: k for k, id_ in enumerate(run.landmarks.ids)}
    return ((at[id_], k) for k, id_ in enumerate(search.linear.problem.ids) if id_ in at)


def _sigmas(linear: Linear, places: Array, its: Index, points: Flags) -> tuple[Array, Array]:
    """Return the sigmas (K,) of the landmarks `its`, at places (K, d): in the world, and of the shape.

    The shape is that of the `points` (K,), of all where there is none.
    """
    d, k, joint = places.shape[1], np.arange(len(its)), linear.reduced.joint()
    dof = len(joint) // len(linear.state.groups[LANDMARKS])
    rows = (its[:, None] * dof + np.arange(d)).ravel()
    P, of = joint[np.ix_(rows, rows)], np.flatnonzero(points if points.any() else ~points)
    return sigma_of(P.reshape(len(k), d, len(k), d)[k, :, k]), sigma_of(shape_of_points(places, P, of))


def sigma_of(P: Array) -> Array:
    """Return the sigmas (K,) of positions with covariances P (K, d, d): the roots of their traces."""
    return np.asarray(np.sqrt(np.maximum(np.trace(P, axis1=1, axis2=2), 0.0)))
