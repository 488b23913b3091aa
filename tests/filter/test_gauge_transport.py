"""Blocks that turn in a correction, and their rotation: units that others observe, lever arms beside landmarks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.filter import gauge_transport
from kalmark.geometry.frames import compose
from kalmark.geometry.frames3d import compose as compose3
from kalmark.geometry.rotations import exp, matrix
from kalmark.geometry.spaces import SE2, SE3, Space, generator, generator_plane, mount_space, retract, retract_plane

DT_S, REST_S = 0.02, 2.0
UNIT = km.motion.Inertial(
    gyroscope_noise_density_rad_per_sqrt_s=1e-4, gyroscope_random_walk_radps_per_sqrt_s=1e-5,
    accelerometer_noise_density_mps_per_sqrt_s=1e-3, accelerometer_random_walk_mps2_per_sqrt_s=1e-4,
)  # fmt: skip
AT, AT16 = np.eye(7)[6], np.eye(16)[6]


def rotated(yaw_rad: float) -> np.ndarray:
    """Return the quaternion of a heading."""
    return np.array([0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)])


def information(slam: km.Slam, names: list[Any]) -> np.ndarray:
    """Return the information about shifts of the world, and turns about its vertical, of all these blocks."""
    parts = []
    for name in names:
        space = slam.map.spaces[slam.slot(name)]
        assert space is not None
        moves, places = space.generator(slam.mean(name))[:, -1:], 3 if space.axes == 3 else 2
        parts.append(np.column_stack([np.eye(space.dof, places), moves]) if space.world else np.zeros((space.dof, 3)))
    N = np.concatenate(parts)
    return np.asarray(N.T @ np.linalg.solve(slam.covariance(*names), N))


@pytest.mark.parametrize("kind", ["dense", "postponed"])
def test_units_that_see_each_other_and_landmarks_learn_nothing_of_position_and_heading(kind: str) -> None:
    """Their headings change by half a radian, each by another angle."""
    cov = np.diag([4.0] * 3 + [1e-4, 1e-4, 0.3] + [0.01] * 3 + [1e-6] * 3 + [1e-3] * 3)
    rng = np.random.default_rng(1)
    laser = km.Mount(km.sensors.RangeBearing3D(0.05, 0.005, 0.005), at=AT)
    starts = {"a": np.zeros(16), "b": np.array([3.0, 1, 0, 0, 0, 0, 1, 1, 0, 0, *[0.0] * 6])}
    starts["a"][6] = 1.0
    slam = km.Slam([km.Robot(n, UNIT, x, {"laser": laser}, cov) for n, x in starts.items()], map=kind)
    truth = {n: UNIT.space.plus(x, rng.normal(0, np.sqrt(np.diag(cov)))) for n, x in starts.items()}
    points = {1: np.array([6.0, 2, 1]), 2: np.array([1.0, 7, -1]), 3: np.array([-4.0, 3, 2])}
    first = None
    for i in range(60):
        for n, x in truth.items():
            u = np.array([0.0, 0, 0.2, 0.5, 0, 9.81])
            truth[n] = UNIT.move(x, u - x[10:], DT_S)[0]
            slam.process(km.Control(t_s=DT_S * i, robot=n, u=u))
        if i % 10 == 9:
            for n, x in truth.items():
                seen = points if n == "b" or i > 30 else {"b": truth["b"][:3]}
                p = np.array([matrix(x[3:7]).T @ (l[:3] - x[:3]) for l in seen.values()])
                y = np.column_stack(
                    [np.linalg.norm(p, axis=1), np.arctan2(p[:, 1], p[:, 0]), np.arctan2(p[:, 2], np.hypot(*p.T[:2]))]
                )
                slam.process(km.Scan(t_s=DT_S * (i + 1), robot=n, sensor="laser", y=y, ids=list(seen)))
            names = ["a", "b", *slam.landmarks().ids]
            first = information(slam, names) if first is None else first
    root = np.linalg.inv(np.linalg.cholesky(first))
    gained = np.linalg.eigvalsh(root @ information(slam, names) @ root.T)
    assert max(abs(slam.mean(n)[5]) for n in "ab") > 0.1
    assert 1 - 1e-3 < gained[0] < gained[-1] < 1 + 1e-6


def driven(seed: int, kind: str, seconds: float = 20.0) -> float:
    """Return the NEES (15) of a unit at the end of a drive, from a rest with an unknown heading, that a tower sees."""
    rng = np.random.default_rng(seed)
    x = np.zeros(16)
    x[:3], x[3:7] = rng.normal(0, 1, 3), rotated(rng.normal(0, 0.5))
    cov = np.diag([1.0] * 3 + [0.0, 0.0, 0.25] + [0.0] * 3 + [1e-6] * 3 + [9e-4] * 3)
    count, n = round(REST_S / DT_S), round(seconds / DT_S)
    u = np.tile([0.0, 0, 0, 0, 0, 9.81], (n, 1))
    for i in range(count, n):
        v, w = 0.8 * min(DT_S * (i - count), 6.0), 0.3 * math.sin(0.5 * DT_S * (i - count))
        u[i, 2], u[i, 3], u[i, 4] = w, 0.8 * (v < 4.8), w * v
    walk = rng.normal(0, UNIT.densities[6:] * math.sqrt(DT_S), (n, 6))
    biases = rng.normal(0, np.repeat([1e-3, 0.03], 3)) + np.cumsum(walk, axis=0)
    read = u + biases + rng.normal(0, UNIT.densities[:6] / math.sqrt(DT_S), u.shape)
    rest = km.motion.start_at_rest(UNIT, DT_S * np.arange(n), read, AT16, cov)
    unit = km.Robot("unit", UNIT, rest.start, cov=rest.cov, rests_until_ns=round(rest.until_s * 1e9))
    eye = km.Mount(km.sensors.Position3D(0.3, 0.3, 0.3), at=AT)
    slam = km.Slam([unit, km.Robot("tower", km.motion.Odometry3D(), AT, {"eye": eye})], map=kind)
    for i in range(n):
        x[10:] = biases[i]
        slam.process(km.Control(t_s=DT_S * i, robot="unit", u=read[i]))
        if i and i % 10 == 0:
            y = x[:3] + rng.normal(0, 0.3, 3)
            slam.process(km.Scan(t_s=DT_S * i, robot="tower", sensor="eye", y=y[None], ids=["unit"]))
        d = UNIT.space.minus(slam.mean("unit"), x)
        x = UNIT.move(x, u[i] + x[10:], DT_S)[0]
    return float(d @ np.linalg.solve(slam.covariance("unit"), d))


@pytest.mark.parametrize("kind", ["dense", "postponed"])
def test_a_heading_that_a_tower_finds_leaves_a_unit_as_sure_as_it_may_be(kind: str) -> None:
    """Its errors turn with its own heading, not with that of the tower, which is known."""
    found = [driven(seed, kind) for seed in range(12)]
    low, high = chi2.ppf([0.0005, 0.9995], 15 * len(found))
    assert low < sum(found) < high, (sum(found) / len(found), found)


@pytest.mark.parametrize("cov", [None, 1e-6 * np.eye(3)], ids=["exactly", "to 1 mm"])
def test_a_heading_that_one_scan_of_known_landmarks_finds_leaves_biases_as_sure_as_they_may_be(cov: Any) -> None:
    """Errors of tilt, which a bias of the force makes at rest, turn in each iteration as in the correction."""
    places, found = np.array([[10.0, 2, 1], [-6, 8, -2], [3, -9, 2]]), []
    laser = km.Mount(km.sensors.RangeBearing3D(0.01, 3e-4, 3e-4), at=AT)
    prior = np.diag([1e-4] * 3 + [0.0, 0.0, 0.25] + [0.0] * 3 + [1e-6] * 3 + [9e-4] * 3)
    for seed in range(12):
        rng, x = np.random.default_rng(seed), AT16.copy()
        x[3:7], x[:3], x[10:] = (
            rotated(rng.normal(0, 0.5)),
            rng.normal(0, 0.01, 3),
            rng.normal(0, [1e-3] * 3 + [0.03] * 3),
        )
        read = np.array([0.0, 0, 0, 0, 0, 9.81]) + x[10:] + rng.normal(0, UNIT.densities[:6] / DT_S**0.5, (100, 6))
        rest = km.motion.start_at_rest(UNIT, DT_S * np.arange(100), read, AT16, prior)
        until_ns = round(rest.until_s * 1e9)
        slam = km.Slam(km.Robot("unit", UNIT, rest.start, {"laser": laser}, rest.cov, rests_until_ns=until_ns))
        for i, place in enumerate(places):
            slam.add_landmark(i, mean=place, cov=cov)
        slam.process(km.Control(0.0, "unit", read[0]))
        p = (places - x[:3]) @ matrix(x[3:7])
        y = np.column_stack(
            [np.linalg.norm(p, axis=1), np.arctan2(*p.T[1::-1]), np.arctan2(p[:, 2], np.hypot(*p.T[:2]))]
        )
        slam.process(km.Scan(DT_S, "unit", "laser", y + rng.normal(0, [0.01, 3e-4, 3e-4], y.shape), [0, 1, 2]))
        d = UNIT.space.minus(slam.mean("unit"), x)
        found.append(float(d @ np.linalg.solve(slam.covariance("unit"), d)))
    low, high = chi2.ppf([0.0005, 0.9995], 15 * len(found))
    assert low < sum(found) < high, (sum(found) / len(found), found)


@pytest.mark.parametrize("beside", ["nothing", "landmarks"])
def test_a_heading_is_found_with_a_lever_arm_that_is_not_known(beside: str) -> None:
    """Landmarks lean on the arm as their robot does, and turn with it."""
    motion, found = km.motion.Odometry2D(0.01, 0.01, 0.005), []
    sigmas = np.array([3.0, 3.0, 0.35, 0.5, 0.5])
    places = np.array([[8.0, 5], [-6, 7], [3, -9], [12, -2]])
    sensors = {"gps": km.Mount(km.sensors.Gps2D(0.1), cov=np.diag([0.25, 0.25, 0]))}
    if beside == "landmarks":
        sensors["laser"] = km.Mount(km.sensors.RangeBearing(0.05, 0.01))
    for seed in range(20):
        rng = np.random.default_rng(seed)
        off, u = rng.normal(0, sigmas), np.zeros(3)
        x, arm = off[:3].copy(), np.array([*off[3:], 0.0])
        slam = km.Slam(km.Robot("r", motion, sensors=sensors, cov=np.diag(sigmas[:3] ** 2)))
        for k in range(80):
            if k >= 20:
                u[:] = min(0.1, 0.004 * (k - 19)), 0.0, 0.02
                slam.process(km.Control(0.1 * k, "r", u))
                x = motion.move(x, u + rng.normal(0, [0.01, 0.01, 0.005]), 0.1)[0]
            slam.process(km.Scan(0.1 * k, "r", "gps", [compose(x, arm)[0][:2] + rng.normal(0, 0.1, 2)]))
            if beside == "landmarks":
                d = places - x[:2]
                y = np.column_stack([np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0]) - x[2]])
                slam.process(km.Scan(0.1 * k, "r", "laser", y + rng.normal(0, [0.05, 0.01], y.shape), [0, 1, 2, 3]))
        e = np.append(motion.space.minus(slam.mean("r"), x), slam.mean("r.gps")[:2] - arm[:2])
        P = slam.covariance("r", "r.gps")[:5, :5]
        found.append(float(e @ np.linalg.solve(P, e)))
    low, high = chi2.ppf([0.0005, 0.9995], 5 * len(found))
    most = high if beside == "nothing" else 1.5 * high  # what is left: docs/invariant.md
    assert low < sum(found) < most, (sum(found) / len(found), found)


@pytest.mark.parametrize("plane", [True, False], ids=["plane", "space"])
def test_a_correction_along_what_a_robot_and_its_mount_leave_open_moves_no_sensor(plane: bool) -> None:
    """Neither the mean nor, by differences, what the covariance says is open: however far the correction goes."""
    pose, chain, t = (SE2, compose, 1) if plane else (SE3, compose3, 3)
    rng, n, k = np.random.default_rng(5), pose.size, pose.dof
    space = Space("robot and mount", (*pose.kinds, *mount_space(n).kinds))
    q, q_s = (np.array([a]) if plane else exp(np.full(3, a) * [1, -2, 0.5]) for a in (0.7, 0.4))
    x = np.array([*rng.normal(size=k - t), *q, *rng.normal(size=k - t), *q_s])

    def jacobian(x: np.ndarray) -> np.ndarray:
        """Return that of the sensor's pose in robot and mount, by differences."""
        steps = 1e-6 * np.eye(2 * k)
        ends = [[chain(*np.split(space.plus(x, s * step), [n]))[0] for s in (1, -1)] for step in steps]
        return np.array([pose.minus(plus, minus) / 2e-6 for plus, minus in ends]).T

    H = jacobian(x)
    N = np.vstack([-np.linalg.solve(H[:, :k], H[:, k:]), np.eye(k)])
    P = N @ np.diag(rng.uniform(0.01, 0.04, k)) @ N.T + 1e-10 * np.eye(2 * k)
    d, after, moved = N @ rng.normal(0, 0.3, k), x.copy(), retract_plane if plane else retract
    rows = gauge_transport.turning_rows(space.atoms, (n, 2 * n, t, 2 * k, 0, 0), H)
    R, turn = gauge_transport.rotation_at(x, 0, t), gauge_transport.gauge(x, d, rows, t)
    L = gauge_transport.regression_on_units(P[rows[0]], rows[0], space.atoms, rows, t, R, False)
    E, W, d_lean = gauge_transport.turn_matrices(turn, d, rows, t)
    moved(space.atoms, after, d, turn)
    gauge_transport.carry(space.atoms, after, L, W, d_lean)
    np.testing.assert_allclose(chain(*np.split(after, [n]))[0], chain(*np.split(x, [n]))[0], atol=1e-6)
    then, now = ((generator_plane if plane else generator)(space.atoms, at, 2 * k, t, x[:3]) for at in (x, after))
    A = np.eye(2 * k)
    R_now = gauge_transport.rotation_at(after, 0, t)
    A[:, rows[0]] += gauge_transport.displacement_columns(
        space.atoms, now, then, L, E, d_lean, rows, rows[0], R, R_now, 0
    )
    np.testing.assert_allclose(jacobian(after) @ A @ N, 0.0, atol=1e-6)
    assert np.abs(jacobian(after) @ N).max() > 0.1
