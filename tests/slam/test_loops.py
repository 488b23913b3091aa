"""Relative poses against earlier clones, as scan matching closes loops: optimum of the graph, NEES, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

import kalmark as km
from kalmark.arrays import Array
from kalmark.errors import EventError
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose, inverse
from kalmark.logs import open_log, write_native
from resumed import ends_alike

STEPS, LAP = 40, 20  # two laps
STEP = np.array([0.5, 0.0, 2 * np.pi / LAP])
MATCH = np.array([0.02, 0.02, 0.01])


def robot(keep: int = STEPS, size: int = 3, at: Any = None) -> km.Robot:
    plane = size == 3
    matcher: Any = km.sensors.Odometer2D if plane else km.sensors.Odometer3D
    motion: Any = km.motion.Odometry2D(0.05, 0.05, 0.03) if plane else km.motion.Odometry3D(0.05, 0.05, 0.05, 0.02)
    start = np.zeros(3) if plane else np.array([0.0, 0, 0, 0, 0, 0, 1])
    mount = km.Mount(matcher(0.02, 0.01, keep=keep), at=start if at is None else at)
    return km.Robot("r", motion=motion, start=start, sensors={"matcher": mount})


def change(a: Array, b: Array) -> Array:
    return compose(inverse(a)[0], b)[0]


def events(rng: np.random.Generator, noise: float, at: Array) -> tuple[list[Any], Array]:
    """Return two laps with the poses (STEPS + 1, 3): in the second one each pose is matched with that a lap before."""
    motion_sigma = np.array([0.05, 0.05, 0.03])
    x, log = [np.zeros(3)], [km.Scan(0.0, "r", "matcher")]
    for k in range(1, STEPS + 1):
        x.append(compose(x[-1], STEP + noise * rng.normal(0, motion_sigma))[0])
        log.append(km.Control(float(k), "r", STEP))
        y, ids = [], []
        if k > LAP:
            way = change(compose(x[k - LAP], at)[0], compose(x[k], at)[0])
            y, ids = [way + noise * rng.normal(0, MATCH)], [k - LAP]
        log.append(km.Scan(float(k), "r", "matcher", y, ids=ids or None))
    return log, np.array(x)


def ran(log: list[Any], estimator: Any = None, **keys: Any) -> km.Slam:
    slam = km.Slam(robot(**keys), estimator=estimator)
    for event in log:
        slam.process(event)
    return slam


def test_loops_give_the_optimum_of_the_graph() -> None:
    """With little noise the filter is linear: mean and covariance are those of the least squares over all poses."""
    at = np.array([0.2, -0.1, 0.4])
    log, _ = events(np.random.default_rng(1), 0.02, at)
    loops = [(round(e.t_ns * 1e-9), e.ids[0], e.y[0]) for e in log if isinstance(e, km.Scan) and e.ids]
    assert len(loops) == STEPS - LAP

    def residuals(flat: Array) -> Array:
        x = np.concatenate([np.zeros((1, 3)), flat.reshape(-1, 3)])
        steps = [change(x[k - 1], x[k]) - STEP for k in range(1, STEPS + 1)]
        matched = [change(compose(x[i], at)[0], compose(x[k], at)[0]) - y for k, i, y in loops]
        for each in (*steps, *matched):
            each[2] = wrap(each[2])
        weighted = [each / [0.05, 0.05, 0.03] for each in steps] + [each / MATCH for each in matched]
        return np.concatenate(weighted)

    begin = [np.zeros(3)]
    for _k in range(STEPS):
        begin.append(compose(begin[-1], STEP)[0])
    best = least_squares(residuals, np.concatenate(begin[1:]), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    P = np.linalg.inv(best.jac.T @ best.jac)[-3:, -3:]
    for estimator in (km.estimators.Ekf(), km.estimators.Invariant()):
        slam = ran(log, estimator, at=at)
        d = slam.mean("r") - best.x[-3:]
        d[2] = wrap(d[2])
        assert d @ np.linalg.solve(P, d) < 1e-4
        np.testing.assert_allclose(slam.covariance("r"), P, rtol=0.02, atol=0.01 * float(np.diag(P).min()))


def test_loops_are_consistent_and_better_than_none() -> None:
    at, nees, errors = np.array([0.2, -0.1, 0.4]), [], []
    for seed in range(40):
        log, x = events(np.random.default_rng(seed), 1.0, at)
        for kept in (True, False):
            slam = ran([e for e in log if kept or isinstance(e, km.Control)], at=at)
            d = slam.mean("r") - x[-1]
            d[2] = wrap(d[2])
            errors.append(np.hypot(*d[:2]))
            nees += [d @ np.linalg.solve(slam.covariance("r"), d)] if kept else []
    low, high = chi2.ppf([0.001, 0.999], 3 * len(nees))
    assert low < sum(nees) < high
    assert np.sum(np.square(errors[::2])) < 0.7 * np.sum(np.square(errors[1::2]))


def test_loops_in_space_are_those_of_the_plane() -> None:
    log, _ = events(np.random.default_rng(3), 1.0, np.zeros(3))
    flat = ran(log)
    slam = km.Slam(robot(size=7))
    noise = np.diag([25, 25, 0, 0, 0, 9]) * 1e-4
    for e in log:
        if isinstance(e, km.Control):
            slam.process(km.Control(t_ns=e.t_ns, robot="r", u=[*e.u[:2], 0, 0, 0, e.u[2]], cov=noise))
        else:
            y = [[*row[:2], 0, 0, 0, row[2]] for row in e.y]
            slam.process(km.Scan(t_ns=e.t_ns, robot="r", sensor="matcher", y=y, ids=e.ids))
    x, q = slam.mean("r"), flat.mean("r")
    np.testing.assert_allclose(x[:3], [*q[:2], 0], atol=1e-6)
    np.testing.assert_allclose(2 * np.arctan2(x[5], x[6]), wrap(q[2]), atol=1e-6)
    keep = np.ix_([0, 1, 5], [0, 1, 5])
    np.testing.assert_allclose(slam.covariance("r")[keep], flat.covariance("r"), rtol=1e-5)


def test_a_run_with_loops_that_is_written_read_and_resumed_is_the_same(tmp_path: Path) -> None:
    log, _ = events(np.random.default_rng(4), 1.0, np.zeros(3))
    log = [e for e in log if not (isinstance(e, km.Scan) and not len(e.y) and not e.t_ns)]  # no robot at the start
    columns = ("dx_m", "dy_m", "dtheta_rad")
    told: Any = {"control_columns": {"r": columns}, "sensor_columns": {("r", "matcher"): columns}}
    write_native(km.Log("log", ("r",), log, **told), tmp_path)
    again = open_log(tmp_path, ids="hidden")  # a time is no landmark
    ends_alike([km.Slam(robot()), km.Slam(robot())], log, again.events, 80, tmp_path / "map.kmk")
    foreseeing = [km.Slam(robot(keep=0)), km.Slam(robot(keep=0))]
    for slam in foreseeing:
        slam.prepare_for(log)
    ends_alike(foreseeing, log, again.events, 80, tmp_path / "map.kmk")


def test_only_the_last_poses_are_kept_and_a_scan_may_count_from_several() -> None:
    slam = km.Slam(robot(keep=3))
    for k in range(5):
        slam.process(km.Control(float(k), "r", STEP))
        slam.process(km.Scan(float(k), "r", "matcher"))
    assert [clone.t_ns for clone in slam.state.clones.clones.values()] == [2 * 10**9, 3 * 10**9, 4 * 10**9]
    slam.process(km.Control(5.0, "r", STEP))
    three = compose(STEP, compose(STEP, STEP)[0])[0]
    report = slam.process(km.Scan(5.0, "r", "matcher", [STEP, STEP, three], ids=["1.0", None, "2.0"]))
    old, last, loop = report.observations
    assert (old.outcome, old.reason) == ("ignored", "no pose of the time of its id is kept")
    assert last.d2 < 1e-20 and loop.d2 < 1e-20 and np.isnan(report.z[0]).all() and np.isfinite(report.z[1:]).all()
    assert [clone.t_ns for clone in slam.state.clones.clones.values()] == [3 * 10**9, 4 * 10**9, 5 * 10**9]
    assert slam.process(km.Scan(5.0, "r", "matcher", [three], ids=[3])).observations[0].outcome == "rejected"
    assert len(slam.state.clones.clones) == 3


@pytest.mark.parametrize(
    ("keep", "name", "said"),
    [
        (9, "kitchen", "id 'kitchen', expected the time in s of an earlier scan"),
        (9, "2", "'matcher' was read at that time already, expected one reading"),
        (1, "1", "id '1', expected none: 'matcher' measures its robot"),
    ],
)
def test_what_is_no_earlier_pose_is_refused_and_changes_nothing(keep: int, name: str, said: str) -> None:
    slam = km.Slam(robot(keep=keep))
    slam.process(km.Scan(1.0, "r", "matcher"))
    before = slam.covariance("r")
    with pytest.raises(EventError, match=said):
        slam.process(km.Scan(2.0, "r", "matcher", [STEP], ids=[name]))
    np.testing.assert_array_equal(slam.covariance("r"), before)
