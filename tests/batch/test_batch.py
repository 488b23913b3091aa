"""The batch solution: equal to dense least squares, exact on exact data, and what it says of the filters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from batch_dense import Link, Sight, link, optimum
from kalmark.batch import solver
from kalmark.batch.batch_state import POSES, BatchState, plus
from kalmark.batch.data import replay_events
from kalmark.batch.motion_chain import Chain
from kalmark.batch.problem import Rows
from kalmark.batch.solver import Batch
from kalmark.config import build_slam, load_config, open_config_log
from kalmark.diagnosis.batch_search import apply_calibration, subsample
from kalmark.errors import KalmarkError
from kalmark.events import Control, Event, Fix, Scan, sort_key
from kalmark.geometry import V, wrap
from kalmark.geometry.frames import compose
from kalmark.geometry.spaces import POINT2
from kalmark.logs import open_log
from kalmark.logs.native_writer import write_native
from kalmark.results.batch import batch_entry, batch_input, compare_with_filter, solve_batch
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate
from results_world import circle, slam_for

Array = np.ndarray
MOUNT = np.array([0.3, -0.1, 0.2])
LANDMARKS = np.array([[3.0, 1.0], [2.0, -2.0], [-1.0, 3.0], [5.0, 4.0]])
SIGMA = np.array([0.1, 0.03])


def observation(pose: Array, target: Array, rng: np.random.Generator, noise: float = 1.0) -> Array:
    T = compose(pose, MOUNT)[0]
    d = target - T[:2]
    return np.array([np.hypot(*d), wrap(np.arctan2(d[1], d[0]) - T[2])]) + noise * SIGMA * rng.normal(size=2)


def robot(name: str, motion: object, **more: object) -> km.Robot:
    lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=SIGMA[0], sigma_bearing_rad=SIGMA[1]), at=MOUNT)
    return km.Robot(name, motion, sensors={"lidar": lidar}, **more)


def filtered(robots: list[km.Robot], events: list[Event], **more: object) -> Run:
    return record(km.Slam(robots, **more), events, progress=False, pictures=False)


def assert_equal(batch: Batch, dense: tuple[Array, Array, Array, float], nodes: list[int]) -> None:
    poses, points, P, chi2 = dense
    order = np.argsort(np.array(batch.ids, dtype=int))
    assert np.allclose(batch.means[order], points, atol=1e-7)
    assert np.allclose(batch.poses[:, :2], poses[nodes, :2], atol=1e-7)
    assert np.allclose(wrap(batch.poses[:, 2] - poses[nodes, 2]), 0, atol=1e-7)
    blocks = np.array([P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(points))])
    assert np.allclose(batch.covariances[order], blocks, rtol=1e-4, atol=1e-9)
    assert batch.chi2 == pytest.approx(chi2, rel=1e-7)


def odometry_log(steps: int = 12, noise: float = 1.0) -> tuple[list[Event], list[Link], list[Sight], Array]:
    """A robot whose sideways odometry is exact: three coordinates, two errors."""
    rng = np.random.default_rng(3)
    sigma = np.array([0.05, 0.0, 0.04])
    events: list[Event] = []
    links, sights, truth = [Link(-1, np.zeros(3), np.zeros((3, 0)), [])], [], np.zeros(3)
    for k in range(steps):
        u = np.array([0.5, 0.05, 0.3])
        truth = compose(truth, u)[0]
        u = u + noise * sigma * rng.normal(size=3)
        events.append(Control(k + 1.0, "r", u))
        links.append(Link(k, u, np.diag(sigma)[:, [0, 2]], [2 * k, 2 * k + 1]))
        ids = [i for i in range(4) if rng.random() < 0.7 or k == 0]
        y = np.array([observation(truth, LANDMARKS[i], rng, noise) for i in ids]).reshape(-1, 2)
        events.append(Scan(k + 1.0, "r", "lidar", y, ids=ids))
        sights += [Sight(k + 1, i, row, SIGMA, MOUNT) for i, row in zip(ids, y, strict=True)]
    return events, links, sights, truth


ODOMETRY = km.motion.Odometry2D(sigma_x_m=0.05, sigma_y_m=0.0, sigma_theta_rad=0.04)


def test_with_a_singular_motion_noise_and_an_exact_start_it_equals_dense_least_squares() -> None:
    events, links, sights, _ = odometry_log()
    batch = solve_batch(filtered([robot("r", ODOMETRY)], events), events)
    assert_equal(batch, optimum(links, sights, LANDMARKS), list(range(1, 13)))
    assert batch.dof == 2 * len(sights) - 8
    assert batch.relative_step < 1e-9


def test_with_an_uncertain_start_and_fixes_it_equals_dense_least_squares() -> None:
    events, links, sights, truth = odometry_log()
    root = np.linalg.cholesky(np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.02], [0.0, 0.02, 0.1]]))
    start = np.array([0.2, -0.1, 0.1])
    links[0] = Link(-1, start, root, [24, 25, 26])
    fix = Fix(12.0, "r", truth[:2] + np.array([0.05, -0.1]), np.eye(2) * 0.04)
    run = filtered([robot("r", ODOMETRY, start=start, cov=root @ root.T)], [*events, fix])
    batch = solve_batch(run, [*events, fix])
    without = optimum(links, sights, LANDMARKS)
    assert_equal(batch, optimum(links, sights, LANDMARKS, [(12, fix.y, 0.2)]), list(range(1, 13)))
    assert np.abs(batch.means[0] - without[1][batch.ids[0]]).max() > 1e-3


def test_a_held_error_shared_by_the_parts_of_a_split_control_equals_dense_least_squares() -> None:
    rng = np.random.default_rng(5)
    motion = km.motion.Unicycle(sigma_v_mps=0.1, sigma_w_radps=0.08, sigma_theta_rad_per_sqrt_s=0.02)
    N = np.array([0.1, 0.08])
    us = [np.array([1.0, 0.2 + 0.1 * rng.normal()]) for _ in range(8)]
    events: list[Event] = [Control(float(k), "r", u) for k, u in enumerate(us)]
    times = [
        0.3,
        0.7,
        1.5,
        2.5,
        5.0,
        6.1,
        6.2,
        7.9,
    ]  # two scans within one control, one between, whole controls between
    links, sights, nodes = [Link(-1, np.zeros(3), np.zeros((3, 0)), [])], [], []
    before, white, truth = 0.0, 2 * len(us), np.zeros(3)
    for t in times:
        cuts = [before, *[float(c) for c in range(8) if before < c < t], t]
        parts = [(int(a), b - a) for a, b in pairwise(cuts)]
        held = sorted({k for k, _ in parts})

        def motion_of(g: Array, parts: list = parts, held: list = held) -> Array:
            r = np.zeros(3)
            for i, (k, dt) in enumerate(parts):
                j = held.index(k)
                r = motion.move(r, us[k] + N * g[2 * j : 2 * j + 2], dt)[0]
                r[2] += 0.02 * np.sqrt(dt) * g[2 * len(held) + i]
            return r

        errors = [e for k in held for e in (2 * k, 2 * k + 1)] + list(range(white, white + len(parts)))
        white += len(parts)
        links.append(link(len(links) - 1, motion_of, errors))
        truth = compose(truth, motion_of(rng.normal(size=len(errors))))[0]
        y = np.array([observation(truth, l, rng) for l in LANDMARKS])
        events.append(Scan(t, "r", "lidar", y, ids=range(4)))
        sights += [Sight(len(links) - 1, i, row, SIGMA, MOUNT) for i, row in enumerate(y)]
        nodes.append(len(links) - 1)
        before = t
    events.sort(key=sort_key)
    batch = solve_batch(filtered([robot("r", motion)], events), events)
    assert_equal(batch, optimum(links, sights, LANDMARKS), nodes)


def test_robots_that_sight_each_other_equal_dense_least_squares() -> None:
    rng = np.random.default_rng(7)
    sigma = np.array([0.05, 0.04])
    truth = [np.zeros(3), np.array([1.0, 2.0, 0.5])]
    links = [Link(-1, truth[0], np.zeros((3, 0)), []), Link(-1, truth[1], np.zeros((3, 0)), [])]
    events, sights, at, steps, errors = [], [], [0, 1], [], 0
    for k in range(8):
        for i, name in enumerate("ab"):
            u = np.array([0.4, 0.0, 0.2])
            truth[i] = compose(truth[i], u)[0]
            u = u + np.array([0.05, 0.0, 0.04]) * rng.normal(size=3)
            events.append(Control(k + 1.0, name, u))
            links.append(Link(at[i], u, np.diag([sigma[0], 0, sigma[1]])[:, [0, 2]], [errors, errors + 1]))
            at[i], errors = len(links) - 1, errors + 2
        y = [observation(truth[0], l, rng) for l in LANDMARKS[:3]] + [observation(truth[0], truth[1][:2], rng)]
        events.append(Scan(k + 1.0, "a", "lidar", y, ids=[0, 1, 2, "b"]))
        sights += [Sight(at[0], j, row, SIGMA, MOUNT) for j, row in enumerate(y[:3])]
        sights.append(Sight(at[0], -1 - at[1], y[3], SIGMA, MOUNT))
        steps.append(at[0])
    run = filtered([robot("a", ODOMETRY), robot("b", ODOMETRY, start=(1.0, 2.0, 0.5))], events)
    batch = solve_batch(run, events)
    assert_equal(batch, optimum(links, sights, LANDMARKS[:3]), steps)


def test_exact_data_leave_no_residual_and_give_the_truth() -> None:
    events, _, _, truth = odometry_log(noise=0.0)
    batch = solve_batch(filtered([robot("r", ODOMETRY)], events), events)
    assert batch.chi2 < 1e-15
    assert np.allclose(batch.means[np.argsort(batch.ids)], LANDMARKS, atol=1e-9)
    assert np.allclose(batch.poses[-1], truth, atol=1e-9)


def test_the_hessian_is_the_derivative_of_the_gradient() -> None:
    events, *_ = odometry_log()
    problem = replay_events(batch_input(filtered([robot("r", ODOMETRY)], events)), events)
    start = problem.start
    n = len(start.groups[POSES])
    m = 50 * np.random.default_rng(0).normal(size=3 * n)

    def gradient(x: Array) -> Array:
        at = problem.at(BatchState(start.spaces, (x[: 3 * n].reshape(n, 3), x[3 * n :].reshape(-1, 2))))
        return at.J.T @ m - at.H.T @ at.z

    x = np.concatenate([start.groups[POSES].ravel(), start.groups[1].ravel()])
    numerical = np.array([(gradient(x + d) - gradient(x - d)) / 2e-5 for d in 1e-5 * np.eye(len(x))])
    assert np.allclose(problem.hessian(start, m).toarray(), numerical, atol=1e-4)


def test_the_gradient_of_a_robust_factor_is_the_derivative_of_its_sum() -> None:
    """Residuals within and beyond the length of Huber side by side: those within count in full."""
    events, *_ = odometry_log()
    problem = replay_events(batch_input(filtered([robot("r", ODOMETRY)], events)), events)
    factor, start, rng = replace(problem.factors[0], huber=3.0), problem.start, np.random.default_rng(0)
    x = np.concatenate([start.groups[POSES].ravel(), start.groups[1].ravel()])
    n, x = 3 * len(start.groups[POSES]), x + 0.1 * rng.normal(size=len(x))

    def rows(x: Array) -> Rows:
        return factor.rows(BatchState(start.spaces, (x[:n].reshape(-1, 3), x[n:].reshape(-1, 2))))

    lengths = np.linalg.norm(rows(x).z.reshape(len(factor.y), -1), axis=1)
    assert (lengths < 3.0).sum() > 3 < (lengths > 3.0).sum()
    numerical = [(rows(x + d).chi2 - rows(x - d).chi2) / 4e-6 for d in 1e-6 * np.eye(len(x))]
    assert np.allclose(-rows(x).H.T @ rows(x).z, numerical, atol=1e-5)


def test_the_start_of_the_search_does_not_matter_even_turned_by_half_a_radian() -> None:
    log = circle()
    run = record(slam_for(log), log, progress=False, pictures=False)
    batch = solve_batch(run, log)
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    poses = batch.state.groups[POSES]
    poses = np.column_stack([poses[:, :2] @ turn.T, poses[:, 2] + 0.5 * np.linspace(0, 2, len(poses))])
    again = solve_batch(run, log, initial=BatchState(batch.state.spaces, (poses, batch.means @ turn.T)))
    assert np.allclose(again.means, batch.means, atol=1e-8)
    assert again.chi2 == pytest.approx(batch.chi2, abs=1e-6)


def test_the_invariant_filter_ends_with_the_optimal_map_and_sigma_and_the_textbook_filter_does_not() -> None:
    world = load_world("loop_b2", ["steps=500"])
    log = simulate(world, seed=1)
    figures = {}
    for name, estimator in (("invariant", km.estimators.Invariant()), ("ekf", km.estimators.Ekf())):
        slam = build_slam(world.config(), log)
        run = record(km.Slam(slam.robots.values(), estimator=estimator), log, progress=False, pictures=False)
        figures[name] = batch_entry(run, log)
    assert 0.95 < figures["invariant"]["sigma_ratio"] < 1.05
    assert figures["ekf"]["sigma_ratio"] < 0.8
    assert figures["invariant"]["map_difference_sigma"] < 0.5
    assert figures["invariant"]["map_difference_m"] < 0.5 * figures["ekf"]["map_difference_m"]
    assert figures["invariant"]["path_ratio"] > 0.8
    assert figures["invariant"]["chi2_per_dof"] == pytest.approx(1.0, abs=0.15)


def test_an_observation_the_filter_rejected_does_not_count() -> None:
    log = circle()
    events = list(log)
    k = max(i for i, e in enumerate(events) if isinstance(e, Scan) and len(e.y) > 2)
    scan = events[k]
    y = np.array(scan.y)
    y[0, 0] += 3.0
    spoiled = [*events[:k], Scan(t_ns=scan.t_ns, robot="rover", sensor="lidar", y=y, ids=scan.ids), *events[k + 1 :]]
    without = Scan(t_ns=scan.t_ns, robot="rover", sensor="lidar", y=y[1:], ids=scan.ids[1:])
    slam = slam_for(log)
    gated = km.association.ByIdentity(gate=0.9999)
    run = record(km.Slam(slam.robots.values(), association=gated), spoiled, progress=False, pictures=False)
    assert run.evaluate()["rejected"] == 1
    clean = [*events[:k], without, *events[k + 1 :]]
    other = record(km.Slam(slam.robots.values(), association=gated), clean, progress=False, pictures=False)
    assert np.allclose(solve_batch(run, spoiled).means, solve_batch(other, clean).means, atol=1e-9)


def test_landmarks_known_beforehand_are_kept_or_weighed_by_their_covariance() -> None:
    log = circle()
    one, two = record(slam_for(log), log, progress=False, pictures=False).landmarks.ids[:2]
    exact, surveyed = log.landmarks[one], log.landmarks[two] + [0.1, 0.0]
    slam = slam_for(log)
    slam.add_landmark(one, exact)
    run = record(slam, log, progress=False, pictures=False)
    batch = solve_batch(run, log)
    at = batch.ids.index(one)
    assert np.array_equal(batch.means[at], exact) and not batch.covariances[at].any()
    slam = slam_for(log)
    slam.add_landmark(two, surveyed, np.eye(2) * 1e-6)
    run = record(slam, log, progress=False, pictures=False)
    batch, given = solve_batch(run, log), solve_batch(run, log, known={two: (surveyed, np.eye(2) * 1e-6)})
    assert np.array_equal(batch.means, given.means)  # the run has kept the survey
    at = batch.ids.index(two)
    assert np.linalg.norm(batch.means[at] - surveyed) < 0.01
    assert np.trace(batch.covariances[at]) < 2e-6
    half = len(log.events) // 2
    record(slam := slam_for(log), log.events[:half], progress=False, pictures=False)
    rest = record(slam, log.events[half:], progress=False, pictures=False)
    with pytest.raises(KalmarkError, match="was in the map beforehand"):  # with covariances between landmarks
        solve_batch(rest, log.events[half:])


def test_a_range_only_beacon_known_roughly_is_solved_too() -> None:
    rng = np.random.default_rng(2)
    beacon = km.Robot(
        "r",
        ODOMETRY,
        sensors={"lidar": robot("r", ODOMETRY).sensors["lidar"], "radio": km.Mount(km.sensors.Range(0.1))},
    )
    events, *_ = odometry_log()
    truth, out = np.zeros(3), []
    for event in events:
        out.append(event)
        if isinstance(event, Scan):
            truth = compose(truth, np.array([0.5, 0.05, 0.3]))[0]
            d = np.hypot(*(truth[:2] - [4.0, -3.0])) + 0.1 * rng.normal()
            out.append(Scan(event.t_s, "r", "radio", [[d]], ids=["beacon"]))
    slam = km.Slam([beacon])
    prior = (np.array([4.5, -2.5]), np.eye(2))
    slam.add_landmark("beacon", *prior)
    run = record(slam, out, progress=False, pictures=False)
    batch = solve_batch(run, out, known={"beacon": prior})
    k = batch.ids.index("beacon")
    assert np.linalg.norm(batch.means[k] - [4.0, -3.0]) < 3 * batch.sigma()[k] < 1.5
    assert np.array_equal(batch.poses[0], batch.poses[1])  # two scans at one time are one node


def test_another_log_than_that_of_the_run_is_refused() -> None:
    log = circle()
    run = record(slam_for(log), log, progress=False, pictures=False)
    with pytest.raises(KalmarkError, match="expected the log of the run"):
        solve_batch(run, list(log)[:-10])
    nameless = replace(run, source=None)
    with pytest.raises(KalmarkError, match="does not name the log it was made from"):
        batch_entry(nameless)


def test_a_saved_run_finds_its_log_again(tmp_path: Path) -> None:
    columns = {"control_columns": {"rover": ("v_mps", "w_radps")}}
    columns["sensor_columns"] = {("rover", "lidar"): ("range_m", "bearing_rad")}
    write_native(replace(circle(), **columns), tmp_path / "log")
    log = open_log(tmp_path / "log")
    run = record(slam_for(circle()), log, progress=False, pictures=False)
    run.save(tmp_path / "run")
    loaded = Run.load(tmp_path / "run")
    found, wanted = loaded.evaluate(batch=True)["batch"], compare_with_filter(run, solve_batch(run, log))
    for one, other in zip(found.pop("pose_differences"), wanted.pop("pose_differences"), strict=True):
        assert one.pop("robot") == other.pop("robot")
        assert one == pytest.approx(other, rel=1e-6)
    assert found == pytest.approx(wanted, rel=1e-6)


def test_a_search_cut_short_says_how_far_it_came() -> None:
    log = circle()
    run = record(slam_for(log), log, progress=False, pictures=False)
    with pytest.raises(KalmarkError, match=r"the last of 1 steps is .* of the map, expected 1e-09"):
        solve_batch(run, log, iterations=1)


@pytest.mark.parametrize(("seed", "most"), [(0, 600), (7, 10_000)])
def test_ranges_that_fit_badly_settle(seed: int, most: int) -> None:
    """Eight times the noise stated: Gauss-Newton crawls; between segments a heading passes 180 degrees."""
    rng = np.random.default_rng(seed)
    points, x, log = rng.uniform(-60, 60, (8, 2)), np.zeros(3), list[Event]()
    for k in range(400):
        u = np.array([1.5, 0.0, 0.06 * np.sin(k / 25) + 0.02])
        x = compose(x, u)[0]
        log.append(Control(0.5 * (k + 1), "r", u + rng.normal(size=3) * [0.05, 0.0, 0.01]))
        r = np.hypot(*(points - x[:2]).T)
        seen = np.flatnonzero(r < 80)
        y = np.maximum(r[seen] + 2.0 * rng.normal(size=len(seen)), 0.1)
        log.append(Scan(0.5 * (k + 1), "r", "radio", y[:, None], ids=seen.tolist()))
    radio = km.Mount(km.sensors.Range(sigma_range_m=0.25))
    motion = km.motion.Odometry2D(sigma_x_m=0.05, sigma_y_m=0.0, sigma_theta_rad=0.01)
    run = filtered([km.Robot("r", motion, sensors={"radio": radio})], log)
    batch = solver.optimum(replay_events(subsample(run, batch_input(run), most), log), tolerance=1e-4)
    assert batch.iterations < 40


def test_a_landmark_that_is_not_determined_is_refused() -> None:
    looker = km.Robot("r", ODOMETRY, sensors={"eye": km.Mount(km.sensors.Bearing(0.02))})
    slam = km.Slam([looker])
    slam.add_landmark(1, (5.0, 0.0), np.eye(2))
    events = [Scan(0.0, "r", "eye", [[0.0]], ids=[1])]
    run = record(slam, events, progress=False, pictures=False)
    assert solve_batch(run, events, known={1: ((5.0, 0.0), np.eye(2))}).covariances[0][0, 0] == pytest.approx(1.0)
    with pytest.raises(KalmarkError, match="not determined"):
        solve_batch(run, events, known={1: ((5.0, 0.0), np.eye(2) * 1e20)})


def test_without_truth_there_is_no_path_ratio() -> None:
    log = circle(truth=False)
    run = record(slam_for(log), log, progress=False, pictures=False)
    figures = compare_with_filter(run, solve_batch(run, log))
    assert figures["path_ratio"] is None
    assert figures["path_difference_m"] < 0.5
    assert figures["landmarks"] == len(run.landmarks)


def test_turned_steps_are_taken_along_the_exponential() -> None:
    a, d = np.array([0.0, 0.3, -2.5, 1e-9]), np.random.default_rng(0).normal(size=(4, 2))
    moved = plus(POINT2, np.zeros((4, 2)), d, a[:, None])
    assert np.allclose(moved, [V(angle) @ row for angle, row in zip(a, d, strict=True)], atol=1e-14)


@pytest.mark.parametrize(("estimator", "low", "high"), [("invariant", 0.97, 1.03), ("ekf", 0.1, 0.4)])
def test_on_lost_in_the_woods_within_1_m_only_the_invariant_filter_knows_what_it_does_not_know(
    data: Callable[[str], Path], estimator: str, low: float, high: float
) -> None:
    data("lost_in_the_woods/dataset2.mat")
    config = load_config("lost_in_the_woods", ["log.r_max=1.0", "log.to_s=800", f"estimator.type={estimator}"])
    log = open_config_log(config)
    run = record(build_slam(config, log), log, progress=False, pictures=False)
    figures = compare_with_filter(run, solve_batch(run, log, progress=False))
    assert low < figures["sigma_ratio"] < high
    if estimator == "invariant":
        assert figures["map_difference_sigma"] < 0.2


@pytest.mark.parametrize(("name", "used"), [("compass_and_gyro", {"lidar"}), ("radar", set())])
def test_readings_of_the_state_and_range_rates_are_not_in_the_batch_solution(name: str, used: set[str]) -> None:
    world = load_world(name, ["steps=60"])
    log = simulate(world, seed=1)
    run = record(build_slam(world.config(), log), log, progress=False, pictures=False)
    assert set(run.history.sensor.tolist()) > used
    assert set(batch_input(run).associations.sensor.tolist()) == used


def test_the_control_in_force_where_a_segment_begins_moves_its_robot() -> None:
    """A scan between two controls begins a segment: the way until the next control is that of the one before."""
    chain = Chain({"r": km.Robot("r", km.motion.Unicycle())}, {}, {})
    for k, u in enumerate([(1.0, 0.0), (2.0, 0.0), (0.5, 0.0)]):
        chain.take(km.Control(float(k), "r", u))
        if k == 1:
            chain.lose("r")
        chain.node_at("r", round((k + 0.25) * 1e9))
    steps = [node.step[0] for node in chain.nodes]
    assert [node.known for node in chain.nodes] == [True, True, False, True]
    assert steps[-1] == pytest.approx(0.75 * 2.0 + 0.25 * 0.5)


def test_scans_that_are_late_by_a_known_lag_are_solved_at_the_times_of_what_they_show() -> None:
    """The optimum of a late log, its lag known, is as near to the truth as that of the same log on time."""
    over = ["steps=400", "ids=true", "filter.association={type: identity}", "robots.car.sensors.lidar.classes=null"]
    lags = [f"{part}robots.car.sensors.lidar.{key}=0" for part in ("", "filter.") for key in ("lag_s", "sigma_lag_s")]
    off = []
    for late_s in (0.0, 0.07):
        late = [f"robots.car.sensing.lidar.late_s={late_s}", f"filter.robots.car.sensors.lidar.lag_s={late_s}"]
        world = load_world("race_track", [*over, *lags, *late])
        log = simulate(world, 4)
        run = record(build_slam(world.config(), log), log, progress=False)
        problem = replay_events(apply_calibration(run, batch_input(run)), log)
        found = solver.optimum(problem)
        true = np.array([log.landmarks[name] for name in found.ids])
        off.append(float(np.sqrt(np.mean((found.state.groups[1] - true) ** 2))))
    assert off[1] < 1.5 * off[0] + 0.01
    unsure = ["filter.robots.car.sensors.lidar.sigma_lag_s=0.1"]
    slam = build_slam(load_world("race_track", [*over, *lags, *unsure]).config(), log)
    with pytest.raises(KalmarkError, match=r"the lag of 'car.lidar' is in the map, expected lags that are known"):
        replay_events(batch_input(record(slam, log, progress=False)), log)


def test_readings_between_blocks_are_residuals_with_their_jacobians() -> None:
    tape = "robots.alpha.sensors.tape={type: distance, sigma_m: 0.001}"
    between = "robots.alpha.sensing.tape={every: 20, between: [[1, 2], [alpha, beta], [alpha, 10]]}"
    world = load_world("two_robots", ["steps=60", tape, between])
    log = simulate(world, 1)
    run = record(build_slam(world.config(), log), log, progress=False, pictures=False)
    problem = replay_events(batch_input(run), log.events)
    factors = [factor for factor in problem.factors if not factor.sensor[1] and not factor.absolute]
    assert sorted(len(factor.y) for factor in factors) == [3, 3, 3]
    for factor in factors:
        E = factor.term.at(problem.start)[1]
        at = factor.term.jacobian(E, problem.start)
        rng, n = np.random.default_rng(0), problem.start.ends[-1]
        for _ in range(3):
            step = rng.normal(size=n)
            ahead, behind = (factor.term.at(_plainly_moved(problem.start, by * step))[0] for by in (1e-6, -1e-6))
            assert np.allclose(-(ahead - behind).ravel() / 2e-6, at @ step, atol=1e-6)
    batch = solver.optimum(problem)
    assert max(np.abs(factor.term.at(batch.state)[0]).max() for factor in factors) < 0.004
    without = solver.optimum(replace(problem, factors=tuple(f for f in problem.factors if f not in factors)))
    assert max(np.abs(factor.term.at(without.state)[0]).max() for factor in factors) > 0.01


def _plainly_moved(state: BatchState, step: Array) -> BatchState:
    """Return a state after a step, each number by plain plus."""
    no_turn = [np.zeros((len(rows), 0)) for rows in state.groups]
    return BatchState(state.spaces, tuple(map(plus, state.spaces, state.groups, state.parts(step), no_turn)))
