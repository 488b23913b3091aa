"""Robots that stand: rates of detection and of false alarms, and the effect on pose and covariance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.errors import ModelError
from kalmark.geometry.spaces import SE2
from kalmark.slam.rests import Standing

STEP_S = 0.1
BIAS = 0.02


def sensors(zero: Any = None) -> dict[str, Any]:
    found: dict[str, Any] = {
        "gyro": km.Mount(km.sensors.Gyro2D(0.005, sigma_bias_radps=0.03)),
        "wheels": km.Mount(km.sensors.Speed(0.02)),
        "lidar": km.Mount(km.sensors.RangeBearing(0.1, 0.03, range_max_m=6.0)),
    }
    return found | ({"still": km.Mount(zero)} if zero is not None else {})


def stop_and_go(seed: int, motion: Any, steps: int = 300) -> tuple[list[Any], list[Array], list[bool]]:
    """Return events of a robot that stands for five of every ten seconds, its poses, and when it stood."""
    rng, x, found = np.random.default_rng(seed), np.zeros(3), list[Any]()
    posts = np.random.default_rng(7).uniform(-3, 12, (12, 2))
    move, poses, stood = km.motion.Unicycle(), [np.zeros(3)], [True]
    found.append(km.Scan(0.0, "r", "gyro", [[0.2 + BIAS + rng.normal(0, 0.005)]]))
    for k in range(steps):
        t_s, still = k * STEP_S, (k // 50) % 2 == 1
        u = np.zeros(2) if still else np.array([0.5, 0.2])
        if motion.columns == ("v_mps", "w_radps"):
            found.append(km.Control(t_s, "r", u + rng.normal(0, [motion.sigma_v_mps, motion.sigma_w_radps])))
        x = move.move(x, u, STEP_S)[0]
        t_s += STEP_S
        found.append(km.Scan(t_s, "r", "gyro", [[u[1] + BIAS + rng.normal(0, 0.005)]]))
        found.append(km.Scan(t_s, "r", "wheels", [[u[0] + rng.normal(0, 0.02)]]))
        if k % 10 == 9:
            p = km.geometry.frames.to_frame_many(x, posts)[0]
            near = np.flatnonzero(np.linalg.norm(p, axis=1) < 6.0)
            y = np.column_stack([np.linalg.norm(p, axis=1), np.arctan2(p[:, 1], p[:, 0])])[near]
            if len(near):
                found.append(km.Scan(t_s, "r", "lidar", y + rng.normal(0, [0.1, 0.03], y.shape), near.tolist()))
        poses.append(x)
        stood.append(still)
    return found, poses, stood


COASTING = km.motion.ConstantTurnRate(sigma_v_mps_per_sqrt_s=1.6, sigma_w_radps_per_sqrt_s=0.6)
MOTIONS: list[Any] = [
    km.motion.SlippingUnicycle(0.1, 0.1, sigma_slip_per_sqrt_s=0.02), km.motion.Unicycle(0.1, 0.1), COASTING,
]  # fmt: skip


def ran(motion: Any, log: list[Any], zero: Any, estimator: Any = None) -> tuple[km.Slam, int]:
    """Return the end of a run, and how many windows of standing were noticed and used."""
    cov = np.diag([0.0, 0.0, 0.0, 0.25, 0.25]) if motion is COASTING else None
    slam, noticed = km.Slam(km.Robot("r", motion=motion, sensors=sensors(zero), cov=cov), estimator=estimator), 0
    for event in log:
        report = slam.process(event)
        noticed += report.standing is not None and report.standing.outcome == "associated"
    return slam, noticed


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda m: type(m).__name__)
def test_poses_of_a_robot_that_stops_are_better_known_and_as_wrong_as_is_said(motion: Any) -> None:
    nees, sigmas, noticed = [], np.zeros(2), 0
    for seed in range(12):
        log, poses, _ = stop_and_go(seed, motion, 200)
        for i, zero in enumerate((None, km.sensors.ZeroVelocity2D())):
            slam, count = ran(motion, log, zero)
            P = slam.covariance("r")[:3, :3]
            sigmas[i] += np.sqrt(np.trace(P[:2, :2]))
            noticed += count
        d = SE2.minus(slam.mean("r")[:3], poses[-1])
        nees.append(d @ np.linalg.solve(P, d))
    assert 1.3 < np.mean(nees) < 5.6  # 99.7 % of the mean of 12 chi-squares of 3 are within 1.5 and 5.3
    assert sigmas[1] < 0.99 * sigmas[0]
    assert noticed >= 12 * 6  # of ten windows; where poses have no velocity the first of a stop only marks the place


def test_a_window_of_a_robot_that_stands_is_noticed_and_one_of_the_slowest_motion_seldom() -> None:
    """Of 4000 windows, 400 of a fast robot: of so slow a one at most the stated share, but for three sigmas."""
    zero = km.sensors.ZeroVelocity2D(1.0, false_alarm=0.01, slowest_mps=0.05, slowest_radps=0.05)
    robot = km.Robot("r", motion=km.motion.ConstantTurnRate(), sensors=sensors(zero))
    rng, found = np.random.default_rng(0), {}
    for v, w in ((0.0, 0.0), (0.05, 0.0), (0.0, 0.05), (0.5, 0.0)):
        standing, count = Standing(zero, robot), 0
        for k in range(40001 if v < 0.5 else 4001):
            t = 0.1 * k
            count += standing.take(km.Scan(t, "r", "gyro", [[w + rng.normal(0, 0.005)]]), lambda *_: None) is True
            count += standing.take(km.Scan(t, "r", "wheels", [[v + rng.normal(0, 0.02)]]), lambda *_: None) is True
        found[v, w] = count
    assert found[0.0, 0.0] > 3980
    assert found[0.05, 0.0] <= 40 + 19
    assert found[0.0, 0.05] == 0  # the gyroscope is so good that its own limit decides
    assert found[0.5, 0.0] == 0


def test_a_robot_that_turns_by_its_unknown_bias_is_not_said_to_stand() -> None:
    """A gyroscope of unknown bias refutes no turn: nothing is noticed until the bias is known."""
    zero = km.sensors.ZeroVelocity2D()
    slam, noticed = ran(COASTING, [], zero)
    for k in range(100):
        assert slam.process(km.Scan(0.1 * k, "r", "gyro", [[0.0]])).standing is None
        assert slam.process(km.Scan(0.1 * k, "r", "wheels", [[0.0]])).standing is None
    assert noticed == 0


def test_controls_that_say_it_already_are_left_as_they_are() -> None:
    """Wheel increments of zero move nothing and have no noise: pose and covariance stay."""
    motion = km.motion.DifferentialDrive()
    slam = km.Slam(km.Robot("r", motion=motion, sensors=sensors(km.sensors.ZeroVelocity2D()), cov=0.01 * np.eye(3)))
    before, P, noticed = slam.mean("r"), slam.covariance("r"), 0
    slam.process(km.Scan(0.0, "r", "gyro", [[0.0]]))
    for k in range(1, 61):
        slam.process(km.Control(0.1 * k, "r", [0.0, 0.0]))
        noticed += slam.process(km.Scan(0.1 * k, "r", "gyro", [[0.0]])).standing is not None
        noticed += slam.process(km.Scan(0.1 * k, "r", "wheels", [[0.0]])).standing is not None
    assert noticed >= 4
    np.testing.assert_allclose(slam.mean("r"), before, atol=1e-12)
    np.testing.assert_allclose(slam.covariance("r"), P, rtol=1e-9, atol=1e-14)


def test_a_run_that_is_resumed_within_a_window_ends_bit_for_bit_where_it_would_have(tmp_path: Path) -> None:
    motion, zero = MOTIONS[0], km.sensors.ZeroVelocity2D()
    log, _, _ = stop_and_go(1, motion, 100)
    whole, _ = ran(motion, log, zero)
    first, _ = ran(motion, log[:235], zero)
    first.save(tmp_path / "map.kmk")
    second = km.Slam.load(tmp_path / "map.kmk")
    for event in log[235:]:
        second.process(event)
    np.testing.assert_array_equal(second.mean("r"), whole.mean("r"))
    np.testing.assert_array_equal(second.covariance("r", "r.gyro"), whole.covariance("r", "r.gyro"))


def test_a_reading_of_zero_velocity_in_a_log_is_one_like_any_other() -> None:
    slam = km.Slam(km.Robot("r", motion=COASTING, start=(0, 0, 0, 0.5, 0), cov=np.diag([0, 0, 0, 1.0, 1.0]),
                            sensors=sensors(km.sensors.ZeroVelocity2D())))  # fmt: skip
    assert slam.process(km.Scan(0.0, "r", "still", [[0.0, 0.0, 0.0]])).observations[0].outcome == "associated"
    np.testing.assert_allclose(slam.mean("r")[3:], 0.0, atol=1e-4)


def test_a_robot_of_which_nothing_tells_that_it_stands_is_refused() -> None:
    zero = {"still": km.Mount(km.sensors.ZeroVelocity2D())}
    with pytest.raises(ModelError, match="robot 'r': ZeroVelocity2D has no input of speed and turn rate, expected"):
        km.Slam(km.Robot("r", motion=km.motion.ConstantVelocity(), sensors=zero))
    with pytest.raises(ModelError, match="robot 'r' has two ZeroVelocity2D, expected one"):
        km.Slam(km.Robot("r", motion=km.motion.Unicycle(), sensors=zero | {"too": zero["still"]}))
