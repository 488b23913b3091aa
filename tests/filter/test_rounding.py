"""A covariance stays one where priors of 1e-5 are beside metres: rounding never makes it indefinite."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter import kernels
from kalmark.geometry import SE3
from kalmark.geometry.rotations import from_euler
from kalmark.slam.checks import fault_of

ESTIMATORS = [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()]
START, START3 = (0.0, -8.0, 0.0), (0.0, -8.0, 0.0, 0.0, 0.0, 0.0, 1.0)
STAND_OFF_M = (0.02, 0.05, 0.2, 0.5, 1.0, 3.0)  # by which some of the surveyed tags stand elsewhere


def test_what_a_variance_keeps_is_more_than_its_rounding() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        v, rest = 10.0 ** rng.uniform(-3, 3), 10.0 ** rng.uniform(-16, -13)
        P, V = np.array([[v * v * (1.0 + rest)]]), np.array([[v]])
        left = Fraction(P[0, 0]) - Fraction(v) ** 2
        kernels.downdate(P, V)
        assert P[0, 0] > 0 and P[0, 0] >= float(left)
        assert P[0, 0] - float(left) < 2.0**-48 * v * v


def test_a_prediction_that_changes_nothing_leaves_every_bit() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(5, 5))
    P = np.tril(A @ A.T)
    before = P.copy()
    kernels.predict(P, 5, np.arange(3), np.eye(3), np.zeros((3, 3)))
    np.testing.assert_array_equal(P, before)


def test_a_far_step_leaves_a_covariance() -> None:
    for far in 10.0 ** np.arange(0, 10):
        P, F = np.diag([1e-8, 1e-8, 1e-10]), np.eye(3)
        for turn in np.linspace(0, 6, 7):
            F[0, 2], F[1, 2] = far * np.cos(turn), far * np.sin(turn)
            kernels.predict(P, 3, np.arange(3), F, np.zeros((3, 3)))
            whole = np.tril(P) + np.tril(P, -1).T
            sigma = np.sqrt(P.diagonal())
            assert np.linalg.eigvalsh(whole / sigma / sigma[:, None])[0] > -1e-15


def plane(estimator: Any, map_: str, sigma_m: float, gate: Any) -> km.Slam:
    sensor, motion = km.sensors.RangeBearing(0.02, 0.005), km.motion.Odometry2D(0.01, 0.01, 0.005)
    cov = np.diag([sigma_m**2, sigma_m**2, 0.1])
    robot = km.Robot("r", motion, START, {"eye": km.Mount(sensor)}, cov=cov)
    return km.Slam(robot, km.association.ByIdentity(gate), estimator, map=map_)


def space(estimator: Any, map_: str, sigma_m: float, gate: Any) -> km.Slam:
    sensor, motion = km.sensors.TagPose(0.02, 0.02), km.motion.Odometry3D(0.01, 0.01, 0.01, 0.005)
    cov = np.diag([sigma_m**2] * 3 + [0.1] * 3)
    robot = km.Robot("r", motion, START3, {"eye": km.Mount(sensor)}, cov=cov)
    return km.Slam(robot, km.association.ByIdentity(gate), estimator, map=map_)


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("in_space", [False, True])
def test_800_s_among_surveyed_tags_of_which_some_stand_elsewhere(in_space: bool, estimator: Any, map_: str) -> None:
    rng, count = np.random.default_rng(5), 60
    slam = (space if in_space else plane)(estimator, map_, 1.0, 0.999)
    place = rng.uniform(-12, 12, (count, 2))
    wrong = rng.choice(count, len(STAND_OFF_M), replace=False)
    said = place.copy()
    angle = rng.uniform(0, 2 * np.pi, len(wrong))
    said[wrong] += np.column_stack([np.cos(angle), np.sin(angle)]) * np.array(STAND_OFF_M)[:, None]
    tags = np.array([[*p, 1.0, *from_euler(rng.uniform(-0.5, 0.5, 3))[0]] for p in place])
    for i in range(count):
        if in_space:
            tag = np.array([*said[i], *tags[i, 2:]])
            slam.add_landmark(i, tag, np.diag([1e-8] * 3 + [1e-10] * 3), km.landmarks.Tag())
        else:
            slam.add_landmark(i, said[i], 1e-8 * np.eye(2))
    pose, seen, refused = np.array([0.0, -8.0, 0.0]), np.zeros(count), np.zeros(count)
    renewed: set[int] = set()  # whose surveys were given up
    for k in range(1600):
        u = np.array([0.12, 0.0, 0.015])  # a circle of 8 m about the middle
        pose += np.array([u[0] * np.cos(pose[2]), u[0] * np.sin(pose[2]), u[2]])
        noisy = u + rng.normal(size=3) * [0.01, 0.01, 0.005]
        slam.process(km.Control(0.5 * k, "r", [*noisy[:2], 0, 0, 0, noisy[2]] if in_space else noisy))
        d = place - pose[:2]
        range_m = np.hypot(*d.T)
        bearing = (np.arctan2(d[:, 1], d[:, 0]) - pose[2] + np.pi) % (2 * np.pi) - np.pi
        ids = np.flatnonzero((range_m > 0.3) & (range_m < 8) & (np.abs(bearing) < 1.2))[:6]
        if not len(ids):
            continue
        y = np.column_stack([range_m, bearing])[ids] + rng.normal(size=(len(ids), 2)) * [0.02, 0.005]
        if in_space:
            at = np.array([pose[0], pose[1], 0.0, *from_euler(np.array([0.0, 0.0, pose[2]]))[0]])
            v = km.landmarks.Tag().seen_from(at, tags[ids])[0]
            y = np.array([SE3.plus(one, 0.02 * rng.normal(size=6)) for one in v])
        report = slam.process(km.Scan(0.5 * k, "r", "eye", y, ids.tolist()))
        for o in report.observations:
            seen[o.id] += 1
            renewed |= {o.id} if o.outcome == "new" else set()
            refused[o.id] += o.outcome == "rejected" or o.id in renewed
            assert o.outcome in ("associated", "new") or o.reason.startswith("outside the gate")
    assert not fault_of(slam.covariance("r"))
    far = wrong[2:]  # by 20 cm and more
    far = far[seen[far] > 0]
    assert len(far) and (refused[far] > 0.9 * seen[far]).all(), "what does not fit is rejected or mapped again"
    assert renewed <= set(wrong.tolist())
    right = np.setdiff1d(np.arange(count), wrong)
    assert refused[right].sum() < 0.05 * seen[right].sum()
    assert np.hypot(*(slam.mean("r")[:2] - pose[:2])) < 0.1


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("world", [plane, space])
def test_a_first_scan_from_anywhere_leaves_a_covariance(world: Any, estimator: Any, map_: str) -> None:
    for sigma_m in (1.0, 1e3, 1e6):
        slam = world(estimator, map_, sigma_m, "off")
        for i in range(6):
            if world is space:
                mean = np.array([2.0 + i, i - 3.0, 1.0, 0, 0, 0, 1])
                slam.add_landmark(i, mean, np.diag([1e-8] * 3 + [1e-10] * 3), km.landmarks.Tag())
            else:
                slam.add_landmark(i, (2.0 + i, i - 3.0), 1e-8 * np.eye(2))
        for k in range(20):
            p = np.array([[2.0 + i, i + 5.0] for i in range(6)])  # from the robot
            if world is space:
                y = np.column_stack([p, np.ones(6), np.zeros((6, 3)), np.ones(6)])
            else:
                y = np.column_stack([np.hypot(*p.T), np.arctan2(p[:, 1], p[:, 0])])
            report = slam.process(km.Scan(float(k), "r", "eye", y, range(6), None))
            assert [o.outcome for o in report.observations] == ["associated"] * 6
            P = slam.covariance("r", *range(6))
            assert (P.diagonal() > 0).all() and not fault_of(P)


def test_covariances_that_elimination_accepts_have_no_negative_eigenvalue_and_are_symmetric() -> None:
    rng, accepted = np.random.default_rng(5), 0
    for margin in (-1e-10, 1e-10):
        for _ in range(400):
            n = int(rng.integers(1, 5))
            Q, last = np.linalg.qr(rng.normal(size=(n, n)))[0], rng.choice([1, -1]) * 10.0 ** rng.uniform(-13, -1)
            S = (Q * np.append(10.0 ** rng.uniform(-2, 0, n - 1), last)) @ Q.T
            S = 0.5 * (S + S.T) + rng.choice([0.0, 1e-6]) * np.triu(rng.normal(size=(n, n)), 1)
            unit = np.sqrt(np.maximum(np.diag(S), 1e-20))
            S, sigma = S / unit / unit[:, None], 10.0 ** rng.uniform(-6, 3, n)
            least, skewed = np.linalg.eigvalsh(S)[0], np.abs(S - S.T).max()
            if kernels.are_covariances((S * sigma * sigma[:, None])[None], margin):
                accepted += 1
                assert least > -margin - 1e-13 and skewed <= 1e-10
            else:  # what is clearly a covariance is accepted
                assert least < 1e-9 or skewed > 0.99e-10
    assert accepted > 200
    none = np.array([[[1.0, 1e-6], [1e-6, 0.0]]])  # nothing is correlated with a variance of zero
    assert not kernels.are_covariances(none, 1e-10)
    assert kernels.are_covariances(np.zeros((1, 2, 2)), 1e-10)
