"""The search for causes of a run: in its batch problem, or a part of it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from kalmark.arrays import Array
from kalmark.batch.batch_state import Ints
from kalmark.batch.data import Associations, BatchInput, replay_events
from kalmark.batch.solver import Batch, optimum
from kalmark.diagnosis import repeated_events
from kalmark.diagnosis.cause_search import Search
from kalmark.diagnosis.error_columns import Where
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.trials import SOLVED, Trials, fit_of_run
from kalmark.errors import KalmarkError
from kalmark.events import Control, Event
from kalmark.logs.log import Log
from kalmark.models.protocols import Calibrated
from kalmark.models.sensors import Wall
from kalmark.results.batch import batch_input
from kalmark.results.measures import truncated_variance
from kalmark.results.run import Run
from kalmark.slam.robot import Mount
from kalmark.slam.slam import Slam

NEAR = 1e-4  # of the map's size, is a step of the batch solution from which the search begins
EVENTS = 4  # times as many as observations are taken
SEGMENT = 30  # successive scans of each robot that are taken together where not all are
MORE = 4  # times as many are taken if the segments do not determine the map, up to `AT_ONCE` at the end of a run
SELDOM, WORST = 1e-6, 20  # scans of a run that fit so badly by chance, and the worst ones that are looked at
LOOKED_INTO = 3  # segments with the worst scans
WIDER = 20.0  # times the noise of its controls with which a run is filtered again that does not fit


class Searched(NamedTuple):
    """A search for causes that is done, and the batch solution that it began at."""

    search: Search
    batch: Batch
    given: BatchInput


def search_causes(run: Run, log: Log, most: int, limit: int, trials: Trials) -> Searched:
    """Search for causes in the batch problem of a run.  Raises KalmarkError if it has none.

    Where `most` observations do not solve it, more are tried, up to a `limit`: all of a long log take minutes.
    """
    every = apply_calibration(run, remove_copies(run, batch_input(run)))
    if not every.associations.landmark:
        raise KalmarkError("no observation was of a landmark in the map")
    given = subsample(run, every, most)
    trials.spend(SOLVED * len(given.associations.landmark))
    try:
        problem = replay_events(given, log)
        batch = optimum(problem, tolerance=NEAR)
    except KalmarkError:
        more = min(MORE * most, len(every.associations.landmark))
        paid = more <= limit and trials.pays(f"a batch solution of {more} observations", SOLVED * more)
        if given is not every and paid:
            return search_causes(run, log, MORE * most, limit, trials)
        raise
    search = Search(Linear.of(problem, batch.state, gated_noise_factors(run)), sensors_of(run), given.t_ns)
    search.run(trials.progress)
    return Searched(search, batch, given)


def associated(run: Run, log: Log, trials: Trials) -> Run:
    """Return a run, or one of less certain controls if in that more observations are of landmarks, and fit better.

    An error of the controls, which are stated too exact, makes a filter take landmarks for new ones, and leave others
    out: then nothing of it is left in the residuals.  The batch problem has the noise that is stated.
    """
    robots, before = run.final_slam().robots, fit_of_run(run)
    paid = trials.pays("associations of less certain controls", trials.work_of(log.events))
    if not run.config.get("robots") or not paid:
        return run

    def widened(e: Event) -> Event:
        if not isinstance(e, Control):
            return e
        N = robots[e.robot].motion.control_noise(e.u / e.share) if e.cov is None else e.cov
        return replace(e, cov=WIDER**2 * N)

    wide = trials.filter(run.config, log, [widened(e) for e in log.events])
    if wide is None or fit_of_run(wide).mean >= before.mean or number_associated(wide) <= number_associated(run):
        return run
    return wide


def number_associated(run: Run) -> int:
    """Return how many observations of a run are of landmarks in its map."""
    return int((run.history.outcome == "associated").sum())


def remove_copies(run: Run, given: BatchInput) -> BatchInput:
    """Return it without the scans that are copies of the one before."""
    twice = np.unique(run.history.step[repeated_events.repeated_scans(run)])
    used = given.associations
    rows = np.flatnonzero(~np.isin(used.scan, twice))
    return given if len(rows) == len(used.scan) else replace(given, associations=_rows(used, rows))


def _rows(used: Associations, rows: Ints) -> Associations:
    names = [used.landmark[k] for k in rows.tolist()]
    return Associations(used.scan[rows], used.sensor[rows], used.index[rows], names, used.e[rows])


def apply_calibration(run: Run, given: BatchInput) -> BatchInput:
    """Return it with the mounts, ranges and controls that calibrate themselves as they were in the end."""
    slam, robots = run.final_slam(), {}
    for name, robot in given.robots.items():
        sensors = {key: _mount_in_map(slam, f"{name}.{key}", mount) for key, mount in robot.sensors.items()}
        robots[name] = replace(robot, sensors=sensors)
    return replace(given, robots=robots, biases={bias.robot: bias.mean for bias in run.history.biases})


def _mount_in_map(slam: Slam, name: str, mount: Mount) -> Mount:
    """Return a mount as it is in the map, if it is there."""
    if mount.block(name) is None:
        return mount
    mean, pose, sensor = slam.mean(name), len(mount.at), mount.sensor
    own, lag_s = mean[pose + mount.lags :], float(mean[pose]) if mount.lags else 0.0
    if isinstance(sensor, Calibrated) and len(own):
        sensor = sensor.with_parameters(own)
    return replace(mount, at=mean[:pose], sensor=sensor, cov=None, lag_s=lag_s, sigma_lag_s=0.0)


def sensors_of(run: Run) -> dict[Where, tuple[str, ...]]:
    """Return the columns that each sensor of a run measures, by robot and sensor; of a wall those that have a noise."""
    robots, found = run.final_slam().robots.values(), {}
    for key, sensor in (((r.name, name), m.sensor) for r in robots for name, m in r.sensors.items()):
        columns = tuple(sensor.columns)
        found[key] = tuple(c for c in columns if f"sigma_{c}" in sensor.sigmas) if isinstance(sensor, Wall) else columns
    return found


def gated_noise_factors(run: Run) -> dict[Where, Array]:
    """Return by what factor (p,) the noise that a sensor's gate leaves is smaller than that of all its observations.

    A gate leaves innovations of covariance k Z (`truncated_variance`).  Their noise then has the covariance
    R - (1 - k) R Z^-1 R; its factor is taken from the diagonals of R and Z.
    """
    h, found = run.history, {}
    for key, channel in run.final_slam().state.channels.items():
        mine = (h.outcome == "associated") & h.made_by(*key)
        k = truncated_variance(channel.gate, channel.dof)
        if k < 1.0 and mine.any():
            share = h.noise[mine] ** 2 / np.diagonal(h.Z[mine], axis1=1, axis2=2)
            share = share[:, np.isfinite(share).any(axis=0)]
            found[key] = np.sqrt(1.0 - (1.0 - k) * np.nanmean(np.minimum(share, 1.0), axis=0))
    return found


def subsample(run: Run, given: BatchInput, most: int) -> BatchInput:
    """Return about `most` of the observations: segments of successive scans, evenly over the run.

    Those with the scans that fit least are among them, if these do not fit by chance: a jump is a single step.
    """
    used, t_ns = given.associations, given.t_ns
    events = len(t_ns) + sum(controls.number for controls in run.history.controls.values())
    share = most / max(len(used.landmark), events / EVENTS, 1)
    if share >= 1.0:
        return given
    segment = SEGMENT * len(given.robots)
    number = max(len(t_ns) // segment, 2)
    even = np.linspace(0, number - 1, max(int(share * number), 2)).astype(np.int64)
    worst = misfits(run)[1]
    with_worst = [*dict.fromkeys(np.minimum(worst // segment, number - 1).tolist())][:LOOKED_INTO]
    first = np.unique([*even, *with_worst]) * segment
    last = np.minimum(first + segment, len(t_ns)) - 1
    begins = np.maximum(first - np.isin(first, worst), 0)  # with the scan before, or there is no step
    last[:-1] = np.minimum(last[:-1], begins[1:] - 1)
    segments = np.stack([t_ns[begins], t_ns[last]], axis=1)
    segments[0, 0] = np.iinfo(np.int64).min  # the motion before the first scan leads from the start to it
    within = np.searchsorted(segments[:, 0], t_ns, side="right") - 1
    kept = (within >= 0) & (t_ns <= segments[within, 1])
    renumbered, rows = np.cumsum(kept) - 1, np.flatnonzero(kept[used.scan])
    some = _rows(used, rows)
    some = replace(some, scan=renumbered[some.scan])
    return replace(
        given, t_ns=t_ns[kept], robot=given.robot[kept], poses=given.poses[kept], associations=some, segments=segments
    )


def misfits(run: Run) -> tuple[Array, Ints]:
    """Return the chi-square (S,) of each scan, and those that do not fit by chance, the worst first."""
    h, now = run.history, fit_of_run(run)
    chi2, dof = (np.bincount(h.step, of, len(h.t_ns)).astype(np.float64) for of in (now.values * now.dof, now.dof))
    bad = np.flatnonzero(chdtrc(np.maximum(dof, 1), chi2) * len(dof) < SELDOM)
    return chi2, bad[np.argsort(-chi2[bad])]
