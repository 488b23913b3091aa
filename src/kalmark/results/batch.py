"""The distance of a filter from the maximum likelihood of the same data: the entry `batch` of ``summary.json``.

The strongest check of a filter on data without truth.  A consistent filter ends with the same map as the batch solution
to a fraction of its sigma, and with the same sigma; one that is not claims a smaller sigma than the optimum has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.batch.batch_state import LANDMARKS, POSES, BatchState
from kalmark.batch.data import Associations, BatchInput, BatchReplay, Known, replay_events
from kalmark.batch.problem import Problem
from kalmark.batch.reassociation import ROUNDS, Reassociated, reassociate
from kalmark.batch.solver import Batch, optimum
from kalmark.errors import KalmarkError
from kalmark.events import Event, Id, Scan
from kalmark.geometry.frames3d import from_frame, minus
from kalmark.geometry.pose_frames import moved_with
from kalmark.geometry.spaces import SCALAR, VECTOR, VECTOR3
from kalmark.logs.progress import track
from kalmark.models.landmarks import Point2D, Point3D, Tag, Wall2D
from kalmark.models.protocols import Landmark, OfState, SeesVelocity, measures_blocks
from kalmark.models.sensors import TagCorners
from kalmark.models.tags import corners
from kalmark.results.figure_texts import Figures
from kalmark.results.filter_description import mounts_of
from kalmark.results.history import History, RobotStart, as_id, ints
from kalmark.results.landmark_table import refuse_other_than_points
from kalmark.results.measures import nees, pose_error, rigid, rmse
from kalmark.results.wrong_starts import Restart, restarts
from kalmark.slam.surveyed_corrections import ELSEWHERE
from kalmark.slam.tentative import ELSEWHERE as BEGUN_AGAIN

MOST_REJECTED = 0.2  # of the fixes
STRETCHES = 10  # of a robot's path, each with its difference from the batch solution

if TYPE_CHECKING:
    from kalmark.logs.log import Log, SensorKey
    from kalmark.results.recording import Recording
    from kalmark.slam.slam import Slam


def batch_entry(run: Recording, log: Log | Iterable[Event] | None = None) -> Figures:
    """Return the entry `batch` of a run's summary: `compare_with_filter`, or of a run that saw tags `compare_tags`.

    The association of observations without ids in the log is decided again (`second_opinion`).  The log
    is read again unless it is given or not needed.
    """
    if not np.isnan(run.history.left_px).all():
        problem = tag_problem(run)
        return compare_tags(run, problem, optimum(problem))
    log = log_of_run(run) if log is None else log
    walls = any(isinstance(track.model, Wall2D) for track in run.final_slam().tracks.confirmed.values())
    if walls or not unknown(run).any():
        return compare_with_filter(run, solve_batch(run, log))
    found, differences = second_opinion(run, log)
    return compare_with_filter(run, found.batch, found.merged) | differences


def unknown(run: Recording) -> Flags:
    """Return which observations (O,) a filter had to associate: those without ids in the log."""
    return (run.history.id == "") & (run.history.outcome != "ignored")


def second_opinion(run: Recording, log: Log | Iterable[Event]) -> tuple[Reassociated, Figures]:
    """Find the batch solution of a run whose log does not give all associations, which are decided again at it.

    Begins at the associations of the filter; see `kalmark.batch.reassociation`.  Second are the figures of how these
    differ from the filter's: observations `changed` are of another landmark, those `added` of one where the filter had
    none, those `left_out` the reverse; a landmark that was merged with another counts as that.  Landmarks `split` are
    made of observations that the filter gave to others, those `found` of those that it gave to none.  Raises
    KalmarkError as `solve_batch`.
    """
    open_ = unknown(run)
    rows = np.flatnonzero(run.history.fused | open_)
    given = batch_input(run, rows=rows)
    numbers = track(range(1, ROUNDS + 1), "second opinion: round of association")
    found = reassociate(BatchReplay.of(given, log), open_[rows], numbers)
    changed = added = left_out = 0
    made_of: dict[Id, list[bool]] = {name: [] for name in found.new}
    for before, after in zip(given.associations.landmark, found.landmark, strict=True):
        old = None if before is None else found.merged.get(before, before)
        changed += old is not None and after is not None and old != after
        added += old is None and after is not None
        left_out += old is not None and after is None
        if after in made_of:
            made_of[after].append(old is not None)
    split = sum(2 * sum(had) > len(had) for had in made_of.values())
    return found, {
        "observations": len(rows),
        "observations_changed": changed,
        "observations_added": added,
        "observations_left_out": left_out,
        "landmarks_merged": len(found.merged),
        "landmarks_split": split,
        "landmarks_found": len(found.new) - split,
        "association_rounds": found.rounds,
        "association_settled": found.settled,
    }


def solve_batch(
    run: Recording,
    log: Log | Iterable[Event],
    *,
    known: Known | None = None,
    initial: BatchState | None = None,
    iterations: int = 100,
    progress: bool = True,
) -> Batch:
    """Find the maximum-likelihood path and map of a run's data: O(steps) and O(landmarks^3) an iteration.

    `log` is what the run was made from.  Starts from the filter's solution, or from `initial`.  `known` gives the
    landmarks that were in the map before the log, id: (mean, covariance or None for exactly).  Fixes that the
    filter rejected are left out.
    Raises KalmarkError if something is not determined, or if it does not converge within `iterations`.
    """
    problem = replay_events(batch_input(run, known), log)
    steps = track(range(1, iterations + 1), "batch solution: iteration", show=progress)
    return optimum(problem, initial, iterations=steps)


def batch_input(run: Recording, known: Known | None = None, rows: Index | None = None) -> BatchInput:
    """Return the input of the batch solution of a run: of the observations exactly those that the filter used.

    With `rows` of the history these are read; those that the filter did not use are of no landmark.
    """
    again = restarts(run.history)
    begun = max((restart.fixes for restart in again.values()), default=0)  # fixes that the map was moved onto fit
    rejected = frozenset(k for k, fix in enumerate(run.history.fixes) if not fix.used and k >= begun)
    if len(rejected) > MOST_REJECTED * len(run.history.fixes):
        what = f"the filter rejected {len(rejected)} of {len(run.history.fixes)} fixes"
        raise KalmarkError(f"batch solution: {what}, expected a run that used most")
    history, slam = run.history, run.final_slam()
    refuse_other_than_points(slam, "batch solution", walls=True)
    robots = slam.robots
    landmarks = filtered_map(run)
    ids = {str(id_): id_ for id_ in landmarks} | {name: name for name in robots}
    placed = history.fused & ~history.associated_elsewhere()[history.step]
    again_begun = [change for change in history.changes if change.reason == BEGUN_AGAIN]
    for change in again_begun:
        placed &= (history.landmark != change.landmark) | (history.step > change.step)
    gone = {change.landmark for change in history.changes if change.reason == ELSEWHERE} - {*ids}  # not mapped again
    fused = np.flatnonzero(placed & ~np.isin(history.landmark, [*gone]))
    rows = _of_places(history, slam, fused if rows is None else rows)
    fused = _of_places(history, slam, fused)
    names = {row: ids.get(name, as_id(name)) for row, name in zip(fused, _in_the_end(history, fused), strict=True)}
    first = np.flatnonzero(history.fused & (history.outcome != "associated"))  # by a robot that was elsewhere, too
    started = {ids.get(name, as_id(name)) for name in _in_the_end(history, first)}
    started |= {ids.get(change.landmark, as_id(change.landmark)) for change in again_begun}
    beforehand = {ids.get(str(name), name): prior for name, prior in {**_surveyed(history), **(known or {})}.items()}
    for name in dict.fromkeys(names.values()):
        if name not in started and name not in beforehand and name not in robots:
            mean, covariance = landmarks.get(name, (None, np.ones(1)))
            if covariance.any():
                if str(name) in {prior.landmark for prior in history.priors}:
                    raise KalmarkError(f"batch solution: landmark {str(name)!r} was surveyed, expected a point")
                what = f"landmark {str(name)!r} was in the map beforehand"
                raise KalmarkError(f"batch solution: {what}, expected its mean and covariance in `known`")
            beforehand[name] = (mean, None)
    return BatchInput(
        robots=robots,
        landmark=_point(slam),
        t_ns=history.t_ns,
        robot=history.robot,
        poses=_moved(history, again),
        associations=Associations(
            history.step[rows],
            history.sensor[rows],
            history.index[rows],
            [names.get(row) for row in rows],
            history.e[rows],
        ),
        landmarks=landmarks,
        known=beforehand,
        starts={start.robot: _start(start, again.get(start.robot)) for start in history.starts},
        fixes=len(run.history.fixes),
        left_out=rejected,
        between=_between(history, slam, np.flatnonzero(placed)),
        merged={name: ids.get(into, as_id(into)) for name, into in _merged(history).items()},
        carried={name: tuple(gap.start_ns for gap in history.carried(name)) for name in robots},
    )


def _moved(history: History, again: Mapping[str, Restart]) -> Array:
    """Return the poses (S, .) of a run, those before the map or the robot was moved to where it is, moved with it."""
    poses = history.poses.copy()
    for robot, restart in again.items():
        before = (history.robot == robot) & (history.t_ns <= restart.t_ns)  # a fix follows the scans of its time
        poses[before] = restart.onto.poses(poses[before])
    for gap in history.carried():
        lost = np.flatnonzero(history.between(gap.robot, gap.start_ns, gap.end_ns))
        found = np.searchsorted(history.t_ns, gap.end_ns)
        before = poses[lost].copy()
        for step, pose in zip(lost, before, strict=True):
            poses[step] = moved_with(pose, before[-1], poses[found])
    return poses


def _start(start: RobotStart, again: Restart | None) -> tuple[Array, Array]:
    """Return mean and covariance of a robot at its start; a start that was wrong has no information."""
    if again is None:
        return start.mean, start.covariance
    mean, cov, d = start.mean.copy(), start.covariance.copy(), len(again.onto.shift)
    size, place = (3, [0, 1, 2]) if d == 2 else (7, [0, 1, 2, 5])  # position and heading
    mean[:size] = again.onto.poses(mean[None, :size])[0]
    cov[place, :] = cov[:, place] = 0.0
    cov[place, place] = [max(again.moved_m, 1.0) ** 2] * d + [1.0]
    return mean, cov


def filtered_map(run: Recording) -> dict[Id, tuple[Array, Array]]:
    """Return mean and covariance of the landmarks of a run as the filter has them: a wall is not its ends."""
    slam, table = run.final_slam(), run.landmarks
    found = dict(zip(table.ids, zip(table.means, table.covariances, strict=True), strict=True))
    walls = [track.id for track in slam.tracks.confirmed.values() if isinstance(track.model, Wall2D)]
    return found | {name: (slam.mean(name), slam.covariance(name)) for name in walls}


def _surveyed(history: History) -> Known:
    """Return the points that were surveyed with a covariance, and were not found to be elsewhere."""
    gone = {change.landmark for change in history.changes if change.reason == ELSEWHERE}
    points = [
        prior
        for prior in history.priors
        if len(prior.mean) == len(prior.covariance) == history.d
        and prior.covariance.any()
        and prior.landmark not in gone
    ]
    return {as_id(prior.landmark): (prior.mean, prior.covariance) for prior in points}


def filter_only_sensors(slam: Slam) -> set[SensorKey]:
    """Return the sensors (robot, name) whose readings no batch solution has: of the state, and of range rates."""
    return {key for key, mount in mounts_of(slam.robots).items() if isinstance(mount.sensor, SeesVelocity | OfState)}


def _of_places(history: History, slam: Slam, rows: Index) -> Index:
    """Return those rows of the history that measure positions of landmarks or other robots from a pose alone.

    Readings of the state do not, nor do range rates.
    """
    others = filter_only_sensors(slam)
    if not others:
        return rows
    keys = zip(history.robot[history.step[rows]].tolist(), history.sensor[rows].tolist(), strict=True)
    return rows[np.array([key not in others for key in keys], dtype=np.bool_)]


def _in_the_end(history: History, rows: Index) -> list[str]:
    """Return the landmarks of observations as they are called in the end, after merges."""
    now = _merged(history)
    return [now.get(name, name) for name in history.landmark[rows].tolist()]


def _merged(history: History) -> dict[str, str]:
    """Return how landmarks that were merged are called in the end."""
    now: dict[str, str] = {}
    for change in history.changes:
        if change.what == "merged":
            now = {one: change.into if other == change.landmark else other for one, other in now.items()}
            now[change.landmark] = change.into
    return now


def _between(history: History, slam: Slam, rows: Index) -> frozenset[tuple[int, str, str, int]]:
    """Return those rows of the history that are of sensors of blocks: time in ns, robot, sensor and number."""
    of = {key for key, mount in mounts_of(slam.robots).items() if measures_blocks(mount.sensor)}
    if not of:
        return frozenset()
    steps = history.step[rows]
    keys = (history.t_ns[steps], history.robot[steps], history.sensor[rows], history.index[rows])
    return frozenset(key for key in zip(*(part.tolist() for part in keys), strict=True) if key[1:3] in of)


def _point(slam: Slam) -> Landmark:
    """Return what the landmarks of a map are in the batch solution: tags, or points with the numbers that all have.

    Where some are walls all have their three numbers (`Given.seen_by`).
    """
    space = any(robot.motion.space.axes > 1 for robot in slam.robots.values())
    models = {track.model.space.kinds: track.model for track in slam.tracks.confirmed.values()}
    models |= {of.model.space.kinds: of.model for of in slam.tracks.known.of_kind.values()}
    wall = next((model for model in models.values() if isinstance(model, Wall2D)), None)
    if wall is not None:
        return wall
    if models and all(isinstance(model, Tag) for model in models.values()):
        return Tag()
    kinds, model = next(iter(models.items()), ((), None))
    if (
        model is not None
        and len(models) == 1
        and kinds[0] == (VECTOR3 if space else VECTOR)
        and {*kinds[1:]} == {SCALAR}
    ):
        return model
    return Point3D() if space else Point2D()


def tag_problem(run: Recording) -> Problem:
    """Return the corners of tags that a run used, which are in its history, without the motion: bundle adjustment.

    Mounts that the filter calibrates may move.  Raises KalmarkError if no corners of a tag in the map were seen.
    """
    history, slam = run.history, run.final_slam()
    cameras = {key: mount for key, mount in mounts_of(slam.robots).items() if isinstance(mount.sensor, TagCorners)}
    ids = {str(id_): id_ for id_ in slam.landmarks().ids}
    rows = np.flatnonzero(history.fused & np.isin(history.landmark, list(ids)))
    rows = rows[[(history.robot[history.step[row]], history.sensor[row]) in cameras for row in rows]]
    if not len(rows):
        raise KalmarkError("tags: no camera saw the corners of a tag in the map, expected observations of TagCorners")
    steps, first, scan = np.unique(history.step[rows], return_index=True, return_inverse=True)
    names, index = [ids[name] for name in history.landmark[rows].tolist()], np.arange(len(rows)) - first[scan]
    t_ns, robot, sensor = history.t_ns[steps], history.robot[steps], history.sensor[rows]
    given = BatchInput(
        robots=slam.robots,
        landmark=Tag(),
        t_ns=t_ns,
        robot=robot,
        poses=history.poses[steps],
        associations=Associations(scan, sensor, index, names, history.e[rows]),
        landmarks={id_: (slam.mean(id_), slam.covariance(id_)) for id_ in dict.fromkeys(names)},
        motion=False,
        mounts={key: slam.mean(".".join(key)) for key, mount in cameras.items() if mount.cov is not None},
    )
    y = np.split(history.y[rows, :9], first[1:])
    scans = zip(t_ns.tolist(), robot.tolist(), sensor[first].tolist(), y, strict=True)
    return replay_events(given, (Scan(t_ns=t, robot=name, sensor=camera, y=seen) for t, name, camera, seen in scans))


def compare_with_filter(run: Recording, batch: Batch, merged: Mapping[Id, Id] | None = None) -> Figures:
    """Return the distances of the filter's map and path from the optimum of the same data.

    `merged` maps landmarks of the filter to those of the batch solution that they were merged into.

    `sigma_ratio`: median over landmarks of the filter's sigma over the batch's (1: consistent, below: overconfident).
    `map_difference_m`: RMS over landmarks of the distance between the two.  `map_difference_sigma`: the largest
    such distance over the batch's sigma of that landmark, `map_difference_filter_sigma`: over the filter's own.
    `path_ratio`: with truth, the filter's raw position RMSE over the batch's, which uses later data, else None.
    `path_difference_m`: RMS over steps of the distance.  `path_difference_sigma`: RMS over steps and coordinates of the
    difference of the poses in the filter's own sigmas, at most 1 of a consistent filter, whose difference from the
    batch solution has the covariance P_filter - P_batch; `pose_differences` is that over time, a robot and stretch a
    row.
    """
    at, same, mine = {id_: j for j, id_ in enumerate(batch.ids)}, merged or {}, filtered_map(run)
    rows = [(id_, at[same.get(id_, id_)]) for id_ in mine if same.get(id_, id_) in at]
    d, sigma = batch.state.d, batch.sigma()[ints([j for _, j in rows])]
    distance = np.array([np.linalg.norm(mine[k][0][:d] - batch.means[j][:d]) for k, j in rows])
    filtered = np.array([np.sqrt(np.trace(mine[k][1][:d, :d])) for k, _ in rows])
    free, path, truth = sigma > 0, run.history.mean[:, :d], run.truth.poses_in_map()
    known = np.isfinite(truth).all(axis=1)
    errors = [_or_none(rmse, poses[known, :d] - truth[known, :d]) for poses in (path, batch.poses)]
    return {
        "sigma_ratio": _or_none(np.median, filtered[free] / sigma[free]),
        "map_difference_m": _or_none(rmse, distance[:, None]),
        "map_difference_sigma": _or_none(np.max, distance[free] / sigma[free]),
        "map_difference_filter_sigma": _or_none(np.max, distance[filtered > 0] / filtered[filtered > 0]),
        "path_ratio": errors[0] / errors[1] if errors[0] is not None and errors[1] else None,
        "path_difference_m": _or_none(rmse, path - batch.poses[:, :d]),
        **_over_time(run, batch),
        "landmarks": len(rows),
        "iterations": batch.iterations,
        "chi2_per_dof": batch.chi2 / batch.dof if batch.dof > 0 else None,
    }


def _over_time(run: Recording, batch: Batch) -> Figures:
    """Return the differences of the poses in sigmas of the filter: of all, and of each robot over time."""
    history = run.history
    e = pose_error(history.poses, batch.poses, run.coordinates)
    per_dof = nees(e, history.pose_covariances) / e.shape[1]
    rows = []
    for robot in history.robots:
        mine = np.flatnonzero((history.robot == robot) & np.isfinite(per_dof))
        for part in np.array_split(mine, min(STRETCHES, len(mine))) if len(mine) else ():
            first, last = (float(history.t_ns[k]) * 1e-9 for k in (part[0], part[-1]))
            sigmas = float(np.sqrt(per_dof[part].mean()))
            rows.append({"robot": robot, "start_s": first, "end_s": last, "sigmas": sigmas})
    known = per_dof[np.isfinite(per_dof)]
    return {
        "path_difference_sigma": float(np.sqrt(known.mean())) if len(known) else None,
        "pose_differences": rows,
    }


def compare_tags(run: Recording, problem: Problem, batch: Batch) -> Figures:
    """Return the RMS of the corners, and how far apart path and map are when the tags' corners are aligned rigidly.

    The filter's path is as it was then, with the map and the mounts that the run ended with.  `median_px`: of the
    corners' distances.  `sigma_ratio`: median over the tags of the filter's sigma of position over the batch's, which
    does not use the motion: expect it below 1 where tags are seen briefly.
    """
    states, slam = (batch.state, problem.start), run.final_slam()
    left, filter_left = (np.concatenate([z for _, z in problem.left(state)]) for state in states)
    size = {name: float(y[8]) for name, y in zip(run.history.landmark.tolist(), run.history.y, strict=True)}
    tags, filtered = batch.means, problem.start.groups[LANDMARKS]
    places = [
        np.concatenate([from_frame(l, corners(size[str(id_)]))[0] for l, id_ in zip(rows, batch.ids, strict=True)])
        for rows in (tags, filtered)
    ]
    onto = rigid(*places)
    apart = np.array([minus(a, b) for a, b in zip(filtered, onto.poses(tags), strict=True)])
    path = problem.start.groups[POSES] - onto.poses(batch.state.groups[POSES])
    sigma = np.sqrt([np.trace(slam.covariance(id_)[:3, :3]) for id_ in batch.ids])
    distance, filter_distance = (np.hypot(x[:, ::2], x[:, 1::2]) for x in (left, filter_left))
    return {
        "rms_px": float(np.sqrt(np.mean(distance**2))),
        "median_px": float(np.median(distance)),
        "filter_rms_px": float(np.sqrt(np.mean(filter_distance**2))),
        "filter_median_px": float(np.median(filter_distance)),
        "map_difference_m": rmse(apart[:, :3]),
        "map_difference_deg": float(np.degrees(rmse(apart[:, 3:]))),
        "path_difference_m": rmse(path[:, :3]),
        "sigma_ratio": float(np.median(sigma / batch.sigma())),
        "tags": len(batch.ids),
        "sightings": len(left),
        "iterations": batch.iterations,
    }


def log_of_run(run: Recording) -> Iterable[Event]:
    """Return the log a run was made from, read again by its configuration if the run does not hold it."""
    if run.source is not None:
        return run.source
    from kalmark.config.opening import open_config_log
    from kalmark.config.schema import Config

    what = "batch solution: the run"
    if run.log.path is None:
        raise KalmarkError(f"{what} does not name the log it was made from, expected the log itself")
    run.run_plugins()
    try:
        config = Config.model_validate({"log": run.config.get("log", {})})
    except ValueError as error:
        raise KalmarkError(f"{what}'s configuration does not determine how to read its log: {error}") from None
    return open_config_log(config, run.log.path)


def _or_none(figure: Callable[[Array], Any], values: Array) -> float | None:
    return float(figure(values)) if len(values) else None
