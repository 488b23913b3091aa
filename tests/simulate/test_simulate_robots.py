"""Simulated logs: the noise is what was asked for, and the same seed gives the same numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.events import Control, Scan
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose, scan_many, to_frame_many
from kalmark.logs.log import Log
from kalmark.simulate import load_world, simulate
from kalmark.simulate.robots import simulation
from kalmark.simulate.routes import Wander, aim
from kalmark.simulate.sights import gaussian


def controls(log: Log, robot: str) -> np.ndarray:
    return np.array([e.u for e in log if isinstance(e, Control) and e.robot == robot])


def scans(log: Log) -> list[Scan]:
    return [e for e in log if isinstance(e, Scan)]


def residuals(log: Log, mount: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """Return measured minus true (range, bearing, true range), one row an observation."""
    rows = []
    for s in scans(log):
        T, *_ = compose(log.truth[s.robot].at(s.t_ns), np.array(mount, dtype=float))
        points = np.array([log.landmarks[i] for i in s.ids])
        y, _ = scan_many(to_frame_many(T, points)[0])
        rows.append(np.column_stack([s.y[:, 0] - y[:, 0], wrap(s.y[:, 1] - y[:, 1]), y[:, 0]]))
    return np.concatenate(rows)


def assert_sigma(sample: np.ndarray, sigma: float) -> None:
    n = len(sample)
    assert abs(sample.mean()) < 4 * sigma / math.sqrt(n)
    assert abs(sample.std() / sigma - 1) < 4 / math.sqrt(2 * n)


def test_noise_on_the_control_leaves_the_robot_exact_and_disturbs_the_estimator() -> None:
    log = simulate(load_world("cloister"), 3)
    steps = np.diff(log.truth["robot"].poses, axis=0)
    assert np.abs(np.linalg.norm(steps[:, :2], axis=1) - 0.1).max() < 1e-12
    assert np.abs(wrap(steps[:, 2]) - 0.05).max() < 1e-12
    u = controls(log, "robot")
    assert_sigma(u[:, 0] - 0.1, 0.01)
    assert_sigma(u[:, 2] - 0.05, 0.02)
    assert not u[:, 1].any()


def test_noise_on_the_robot_disturbs_the_truth_and_leaves_the_control_exact() -> None:
    log = simulate(load_world("cloister", ["noise_on=robot"]), 3)
    assert (controls(log, "robot") == [0.1, 0.0, 0.05]).all()
    assert_sigma(wrap(np.diff(log.truth["robot"].poses[:, 2])) - 0.05, 0.02)


def test_a_held_control_acts_from_the_beginning_of_its_step() -> None:
    log = simulate(
        load_world(
            "random_field", ["steps=50", "robots.rover.motion={type: unicycle, sigma_v_mps: 0, sigma_w_radps: 0}"]
        ),
        3,
    )
    motion_times = [e.t_ns for e in log if isinstance(e, Control)]
    assert motion_times == [k * 200_000_000 for k in range(50)]
    pose = log.truth["rover"].poses[0]
    from kalmark.models.motion import Unicycle

    for u in controls(log, "rover"):
        pose, *_ = Unicycle().move(pose, u, 0.2)
    assert np.abs(pose - log.truth["rover"].poses[-1]).max() < 1e-9


def test_measurement_residuals_have_the_sensors_noise() -> None:
    cloister = residuals(simulate(load_world("cloister", ["steps=300"]), 4))
    assert_sigma(cloister[:, 0], 0.1)
    assert_sigma(cloister[:, 1], math.radians(1))
    loop = residuals(simulate(load_world("loop_b"), 4))
    assert_sigma(loop[:, 0] / loop[:, 2], 0.1)
    assert_sigma(loop[:, 1], math.radians(10))
    assert loop[:, 2].min() >= 1 and loop[:, 2].max() <= 5


def test_a_mounted_sensor_measures_from_its_mount_within_its_field_of_view() -> None:
    log = simulate(
        load_world("random_field", ["steps=600", "robots.rover.sensors.lidar.mount={x_m: 0.3, theta_rad: 0.5}"]), 5
    )
    z = residuals(log, (0.3, 0, 0.5))
    assert_sigma(z[:, 0], 0.1)
    assert_sigma(z[:, 1], 0.02)
    assert max(np.abs(s.y[:, 1]).max() for s in scans(log)) < math.pi / 2 + 0.1


def test_a_diffusion_disturbs_the_robot_with_the_square_root_of_time() -> None:
    exact = [f"robots.robot.motion.sigma_{name}=0" for name in ("x_m", "theta_rad")]
    wild = "robots.robot.motion.sigma_across_m_per_sqrt_s=0.2"
    log = simulate(load_world("cloister", [*exact, wild, "dt_s=0.25"]), 6)
    poses = log.truth["robot"].poses
    steps = np.array([to_frame_many(a, b[None, :2])[0][0] for a, b in pairwise(poses)])
    across = steps[:, 1] * math.cos(0.05) - (steps[:, 0] - 0.1) * math.sin(0.05)
    assert_sigma(across, 0.2 * math.sqrt(0.25))


def test_one_new_landmark_a_step_as_in_the_guide() -> None:
    log = simulate(load_world("cloister", ["steps=50"]), 7)
    seen: set[object] = set()
    for k, s in enumerate(scans(log)):
        new = set(s.ids) - seen
        assert len(new) == (1 if k < 36 else 0) and seen <= set(s.ids)
        assert list(s.ids) == sorted(s.ids)
        seen |= new
    orders = [tuple(s.ids) for s in scans(simulate(load_world("cloister", ["steps=50"]), 8))]
    assert orders != [tuple(s.ids) for s in scans(log)]


def test_at_most_so_many_landmarks_a_scan_and_these_the_nearest() -> None:
    whole = simulate(load_world("cloister", ["steps=30", "new_per_step=null"]), 7)
    few = simulate(load_world("cloister", ["steps=30", "new_per_step=null", "max_per_scan=6"]), 7)
    assert {len(s.ids) for s in scans(whole)} == {36}
    assert {len(s.ids) for s in scans(few)} == {6}
    pose = few.truth["robot"].at(scans(few)[9].t_ns)
    distance = {i: math.dist(pose[:2], l) for i, l in few.landmarks.items()}
    assert set(scans(few)[9].ids) == set(sorted(distance, key=distance.get)[:6])


def test_withheld_ids_leave_everything_else_as_it_was() -> None:
    told, withheld = (simulate(load_world("cloister", ["steps=30", f"ids={ids}"]), 7) for ids in ("true", "false"))
    assert all(s.ids is None for s in scans(withheld))
    assert all((a.y == b.y).all() for a, b in zip(scans(told), scans(withheld), strict=True))


def test_robots_see_each_other_by_name() -> None:
    log = simulate(load_world("two_robots"), 2)
    met = [s for s in scans(log) if s.robot == "alpha" and "beta" in s.ids]
    assert len(met) > 20
    for s in met:
        y, _ = scan_many(to_frame_many(log.truth["alpha"].at(s.t_ns), log.truth["beta"].at(s.t_ns)[None, :2])[0])
        z = s.y[s.ids.index("beta")] - y[0]
        assert abs(z[0]) < 5 * 0.1 and abs(wrap(z[1])) < 5 * 0.02


def test_a_signature_sensor_measures_a_signature_of_its_own_for_each_landmark() -> None:
    sensor = "robots.robot.sensors.lidar={type: range_bearing_signature, sigma_signature: 0.01}"
    world = load_world("cloister", ["steps=60", sensor, "filter={association: {type: nearest}}"])
    assert world.config().landmarks.type == "point_signature"
    by_id: dict[object, list[float]] = {}
    for s in scans(simulate(world, 2)):
        for i, y in zip(s.ids, s.y, strict=True):
            by_id.setdefault(i, []).append(y[2])
    assert max(np.ptp(v) for v in by_id.values()) < 0.1
    assert np.ptp([v[0] for v in by_id.values()]) > 3


def test_a_start_with_a_covariance_is_drawn_from_it() -> None:
    start = "robots.robot.start={x_m: 1.0, y_m: -2.0, sigma_xy_m: 0.5, sigma_theta_rad: 0.1}"
    world = load_world("cloister", ["steps=1", start])
    starts = np.array([simulate(world, seed).truth["robot"].poses[0] for seed in range(400)])
    assert_sigma(starts[:, 0] - 1.0, 0.5)
    assert_sigma(starts[:, 1] + 2.0, 0.5)
    assert_sigma(starts[:, 2], 0.1)


def test_the_same_seed_gives_the_same_log_and_another_seed_another() -> None:
    world = load_world("loop_c", ["steps=100"])
    one, same, other = (simulate(world, seed) for seed in (1, 1, 2))
    assert all((a.y == b.y).all() and a.ids == b.ids for a, b in zip(scans(one), scans(same), strict=True))
    assert (controls(one, "robot") == controls(same, "robot")).all()
    assert (controls(one, "robot") != controls(other, "robot"))[:, [0, 2]].all()
    assert (one.landmarks[1] != other.landmarks[1]).all()


def test_a_covariance_with_correlation_is_drawn_as_given() -> None:
    cov = np.array([[2.0, 1.2, 0.0], [1.2, 1.0, 0.0], [0.0, 0.0, 0.0]])
    rng = np.random.default_rng(0)
    sample = np.array([gaussian(cov, rng) for _ in range(4000)])
    assert np.abs(np.cov(sample.T) - cov).max() < 0.2
    assert np.abs(sample[:, 2]).max() < 1e-12


def test_a_simulated_log_is_written_and_read_back(tmp_path: Path) -> None:
    from kalmark.logs import open_log, write_native

    log = simulate(load_world("two_robots", ["steps=40"]), 2)
    write_native(log, tmp_path / "log")
    back = open_log(tmp_path / "log")
    assert len(back) == len(log)
    assert all(a.t_ns == b.t_ns and type(a) is type(b) for a, b in zip(log, back, strict=True))
    assert all((a.y == b.y).all() and a.ids == b.ids for a, b in zip(scans(log), scans(back), strict=True))
    assert (back.truth["beta"].poses == log.truth["beta"].poses).all()


def test_a_constant_route_stops_as_often_and_as_long_as_it_says() -> None:
    world = load_world("stop_and_go", ["steps=600", "robots.rover.route.ramp_s=0.0"])
    ((_, states),) = simulation(world, seed=1).states.items()
    way = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1)
    stood = way < 1e-12
    assert [*stood[:150]] == [False] * 150
    assert [*stood[150:300]] == [True] * 150
    assert not stood[300:450].any()


def test_a_constant_route_accelerates_evenly_after_a_stop_and_before_the_next() -> None:
    drive = load_world(
        "stop_and_go", ["robots.rover.route={type: constant, u: [0.5, 0.1], drive_s: 1.0, stop_s: 0.2, ramp_s: 0.4}"]
    )
    told = drive.robots["rover"].route.course(24, 0.1, np.zeros((2, 2)), np.random.default_rng(0))[0]
    np.testing.assert_allclose(
        told[:12, 0], 0.5 * np.array([0.125, 0.375, 0.625, 0.875, 1, 1, 0.875, 0.625, 0.375, 0.125, 0, 0])
    )
    np.testing.assert_allclose(told[:, 1], told[:, 0] / 5)
    np.testing.assert_allclose(told[12:], told[:12])


def test_a_robot_with_one_place_to_go_to_does_not_ask_for_others_again_and_again() -> None:
    asked = []

    class Counted(Wander):
        def places(self, area: np.ndarray, rng: np.random.Generator) -> Any:
            for place in super().places(area, rng):
                asked.append(place)
                yield place

    area = np.array([[2.0, 3.0], [2.0, 3.0]])  # of one landmark
    _, ahead, (_, turn_radius_m) = Counted(turn_radius_m=8.0).course(10, 0.1, area, np.random.default_rng(0))
    target = next(ahead)
    for _ in range(10):
        target = aim(target, ahead, 2 * turn_radius_m, np.array([1.0, 3.0, 0.2]))
    assert len(asked) <= 11
