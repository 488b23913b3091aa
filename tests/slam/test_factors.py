"""Measurements of any blocks of the map: by the formulas, the same in each map and estimator, consistent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.config import build_slam
from kalmark.errors import EventError, KalmarkError, MapError
from kalmark.geometry.rotations import from_euler
from kalmark.logs import write_native
from kalmark.logs.json_lines import event_of_object, line_of_event, mapping_of
from kalmark.simulate import load_world, simulate

ESTIMATORS = [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()]
SIGHT = (0.1, 0.03)
PLACES = np.array([[4.0, 1.0], [2.0, -2.0], [6.0, 3.0]])


def distance(a: Array, b: Array) -> Any:
    return np.linalg.norm(a[:2] - b[:2])


def rover(name: str = "rover", start: Any = (0.0, 0.0, 0.0), cov: Any = None) -> km.Robot:
    lidar = km.Mount(km.sensors.RangeBearing(*SIGHT))
    return km.Robot(name, km.motion.Odometry2D(0.1, 0.05, 0.02), start, {"lidar": lidar}, cov=cov)


def observed(slam: km.Slam, rng: np.random.Generator, pose: Any, robot: str = "rover", t_s: float = 0.0) -> None:
    y = km.geometry.observe(np.array(pose), PLACES)[0] + rng.normal(size=PLACES.shape) * SIGHT
    slam.process(km.Scan(t_s, robot, "lidar", y, ids=[1, 2, 3]))


def mapped(estimator: Any = None, map_: str = "dense", seed: int = 0) -> km.Slam:
    """Return a Slam that has moved and has three landmarks."""
    rng, pose = np.random.default_rng(seed), np.zeros(3)
    slam = km.Slam(rover(), estimator=estimator, map=map_)
    for k in range(4):
        observed(slam, rng, pose, t_s=0.1 * k)
        u = np.array([0.3, 0.0, 0.1])
        pose = km.geometry.compose(pose, u + rng.normal(size=3) * (0.1, 0.05, 0.02))[0]
        slam.process(km.Control(0.1 * k + 0.05, "rover", u))
    return slam


def everything(slam: km.Slam) -> tuple[Array, Array]:
    names = ["rover", 1, 2, 3]
    return np.concatenate([slam.mean(name) for name in names]), slam.covariance(*names)


def test_a_linear_factor_is_the_kalman_correction() -> None:
    slam = mapped(km.estimators.Ekf())
    x, P = everything(slam)
    H = np.zeros((2, 9))
    H[:, 3:5], H[:, 5:7] = -np.eye(2), np.eye(2)
    y, R = np.array([-1.9, -3.1]), np.diag([0.01, 0.02])
    Z = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(Z)
    z = y - H @ x
    seen = slam.fuse([1, 2], lambda a, b: b - a, y, R)
    assert seen.outcome == "associated" and seen.d2 == pytest.approx(z @ np.linalg.solve(Z, z), rel=1e-8)
    np.testing.assert_allclose(everything(slam)[0], x + K @ z, atol=1e-8)
    np.testing.assert_allclose(everything(slam)[1], P - K @ Z @ K.T, atol=1e-9)


def test_a_factor_that_is_not_linear_is_iterated_to_the_minimum_of_its_cost() -> None:
    slam = mapped(km.estimators.Ekf())
    x, P = everything(slam)
    y, sigma = 3.0, 0.001
    slam.fuse([1, 2], distance, y, sigma**2)
    after = everything(slam)[0]

    def cost(x_now: Array) -> float:
        e = (y - distance(x_now[3:5], x_now[5:7])) / sigma
        return float((x_now - x) @ np.linalg.solve(P, x_now - x) + e**2)

    gradient = [(cost(after + d) - cost(after - d)) / 2e-5 for d in 1e-5 * np.eye(9)]
    assert distance(after[3:5], after[5:7]) == pytest.approx(y, abs=0.001)
    np.testing.assert_allclose(gradient, 0.0, atol=0.05)
    assert cost(after) < cost(x) / 100


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_both_maps_give_the_same_and_the_map_is_left_as_it_was(estimator: Any) -> None:
    dense, compressed = mapped(estimator), mapped(estimator, "postponed")
    for slam in (dense, compressed):
        slots = len(slam.map.spaces)
        slam.fuse([1, 3], distance, 2.9, 0.01)
        slam.fuse(["rover", 2], distance, 3.0, 0.01)
        assert len(slam.landmarks()) == 3 and sum(space is not None for space in slam.map.spaces) == 4
        assert len(slam.map.spaces) <= slots + 1
    for one, other in zip(everything(dense), everything(compressed), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_a_map_with_a_surveyed_distance_is_as_far_from_the_truth_as_it_says(estimator: Any) -> None:
    nees, runs = [], 100
    for seed in range(runs):
        slam, rng = mapped(estimator, seed=seed), np.random.default_rng([seed, 1])
        for a, b in ((1, 2), (2, 3)):
            true = distance(PLACES[a - 1], PLACES[b - 1])
            slam.fuse([a, b], distance, true + 0.02 * rng.normal(), 0.02**2)
        e = np.concatenate([slam.mean(k) - PLACES[k - 1] for k in (1, 2, 3)])
        nees.append(e @ np.linalg.solve(slam.covariance(1, 2, 3), e))
    assert 5.2 < np.mean(nees) < 6.8  # 6 expected, 2.3 sigma of the mean of 100


def test_two_robots_measure_each_other() -> None:
    nees = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        true = {"one": np.array([0.0, 0.0, 0.3]), "two": np.array([5.0, 1.0, -3.0])}
        cov = np.diag([0.3, 0.3, 0.05]) ** 2
        starts = {name: pose + rng.normal(size=3) * np.sqrt(np.diag(cov)) for name, pose in true.items()}
        slam = km.Slam([rover(name, start, cov) for name, start in starts.items()])

        def seen_from(a: Array, b: Array) -> Array:
            d = b[:2] - a[:2]
            return np.array([np.hypot(*d), np.arctan2(d[1], d[0]) - a[2]])

        y = seen_from(true["one"], true["two"]) + rng.normal(size=2) * (0.05, 0.01)
        y_back = seen_from(true["two"], true["one"]) + rng.normal(size=2) * (0.05, 0.01)
        R = np.diag([0.05, 0.01]) ** 2
        slam.fuse(["one", "two"], seen_from, y, R, angular=(False, True))
        slam.fuse(["two", "one"], seen_from, y_back + np.array([0.0, 4.0 * np.pi]), R, angular=(False, True))
        e = np.concatenate([slam.mean(name) - true[name] for name in ("one", "two")])
        e[[2, 5]] = km.geometry.wrap(e[[2, 5]])
        nees.append(e @ np.linalg.solve(slam.covariance("one", "two"), e))
        assert np.diag(slam.covariance("two"))[1] < 0.3**2
    assert 5.2 < np.mean(nees) < 6.8


def test_a_gap_that_is_noticed_by_a_factor_is_in_the_next_report_of_its_robot() -> None:
    lidar = {"lidar": km.Mount(km.sensors.RangeBearing(*SIGHT))}
    slam = km.Slam([km.Robot("one", km.motion.Unicycle(), sensors=lidar), rover("two", (5.0, 0.0, 0.0))])
    for k in range(100):
        slam.process(km.Control(0.1 * k, "one", (0.1, 0.0)))
    slam.process(km.Scan(60.0, "two", "lidar", [[1.0, 0.0]], ids=[1]))
    slam.fuse(["one", "two"], distance, 3.0, 4.0)
    (gap,) = slam.process(km.Scan(60.1, "one", "lidar", [[3.0, 0.0]], ids=[2])).gaps
    assert gap.robot == "one" and gap.lasts_s > 45.0


def test_landmarks_that_are_said_to_be_in_one_place_are() -> None:
    slam, rng = mapped(), np.random.default_rng(9)
    y = km.geometry.observe(slam.mean("rover"), PLACES[:1])[0] + rng.normal(size=(1, 2)) * SIGHT
    slam.process(km.Scan(0.4, "rover", "lidar", y, ids=["one again"]))
    apart = np.linalg.norm(slam.mean(1) - slam.mean("one again"))
    slam.fuse([1, "one again"], lambda a, b: a - b, (0.0, 0.0), 1e-8 * np.eye(2))
    assert np.linalg.norm(slam.mean(1) - slam.mean("one again")) < 0.02 * apart
    np.testing.assert_allclose(slam.covariance(1), slam.covariance("one again"), atol=1e-4)


def test_a_landmark_known_exactly_is_a_given_value() -> None:
    slam = mapped()
    slam.add_landmark("mast", (0.0, 5.0))
    before = slam.covariance(2)
    slam.fuse(["mast", 2], lambda a, b: b - a, PLACES[1] - (0.0, 5.0), 1e-4 * np.eye(2))
    assert np.trace(slam.covariance(2)) < 0.1 * np.trace(before)
    np.testing.assert_allclose(slam.mean(2), PLACES[1], atol=0.05)
    np.testing.assert_array_equal(slam.mean("mast"), (0.0, 5.0))


def test_poses_of_space_are_blocks() -> None:
    start, lidar = (
        [0.0, 0, 0, *from_euler(np.array([0.1, 0.2, 0.3]))[0]],
        km.Mount(km.sensors.RangeBearing3D(0.1, 0.01, 0.01)),
    )
    cov = np.diag([0.2, 0.2, 0.2, 0.05, 0.05, 0.05]) ** 2
    drone = km.Robot("drone", km.motion.Odometry3D(0.1, 0.05), start, {"lidar": lidar}, cov=cov)
    slam = km.Slam(drone)
    slam.process(km.Scan(0.0, "drone", "lidar", [[5.0, 0.1, 0.2]], ids=[1]))
    truth = slam.mean("drone")[:3] + np.array([0.1, -0.1, 0.05])
    slam.fuse(["drone"], lambda pose: pose[:3], truth, 1e-6 * np.eye(3))
    np.testing.assert_allclose(slam.mean("drone")[:3], truth, atol=1e-3)
    assert np.linalg.norm(slam.mean("drone")[3:7]) == pytest.approx(1.0)


def test_what_is_outside_the_gate_changes_nothing() -> None:
    slam = mapped()
    before = everything(slam)
    seen = slam.fuse([1, 2], distance, 30.0, 0.01, gate=0.99)
    assert seen.outcome == "rejected" and "outside the gate of 6.63" in seen.reason
    for one, other in zip(everything(slam), before, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda slam: slam.fuse([], distance, 1.0, 1.0), EventError, "expected the names of different"),
        (lambda slam: slam.fuse([1, 1], distance, 1.0, 1.0), EventError, "expected the names of different"),
        (lambda slam: slam.fuse([1, 9], distance, 1.0, 1.0), MapError, "9 is not in the map"),
        (lambda slam: slam.fuse([1, 2], distance, np.nan, 1.0), EventError, "expected finite numbers"),
        (lambda slam: slam.fuse([1, 2], distance, 1.0, -1.0), EventError, "positive definite"),
        (lambda slam: slam.fuse([1, 2], distance, (1.0, 2.0), np.eye(2)), EventError, "expected 2 finite numbers"),
        (lambda slam: slam.fuse([1, 2], lambda a, b: a - b, (1.0, 2.0), np.eye(3)), EventError, "expected (2, 2)"),
        (lambda slam: slam.fuse([1], lambda a: np.inf, 1.0, 1.0), EventError, "expected 1 finite numbers"),
        (lambda slam: slam.fuse([1], lambda a: a, (0, 0), np.eye(2), angular=(True,)), EventError, "2 truth values"),
        (lambda slam: slam.fuse([1], lambda a: a, (0, 0), np.eye(2), gate=0.0), EventError, "a probability above 0"),
        (lambda slam: slam.fuse([1], lambda a: a, (0, 0), np.eye(2), gate="wide"), EventError, "a probability above 0"),
        (lambda slam: slam.fuse("12", distance, 1.0, 1.0), EventError, "landmarks, in a list"),
        (lambda slam: slam.fuse([[1], 2], distance, 1.0, 1.0), EventError, "a name is [1], expected a whole number"),
        (lambda slam: slam.fuse([1, 2], None, 1.0, 1.0), EventError, "expect is None, expected a function"),
        (lambda slam: slam.fuse([1, 2], lambda a, b: None, 1.0, 1.0), EventError, "expected 1 finite numbers"),
        (lambda slam: slam.fuse([1, 2], lambda a, b: [a, 1.0], 1.0, 1.0), EventError, "expected 1 finite numbers"),
        (lambda slam: slam.fuse([1, 2], distance, [], np.eye(0)), EventError, "y is empty"),
        (lambda slam: slam.fuse([1], lambda a: a, (0, 0), np.eye(2), angular=1), EventError, "2 truth values"),
    ],
)
def test_bad_factors_are_refused_and_change_nothing(
    call: Callable[[km.Slam], Any], error: type[KalmarkError], message: str
) -> None:  # fmt: skip
    slam = mapped()
    before = everything(slam)
    with pytest.raises(error) as caught:
        call(slam)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    for one, other in zip(everything(slam), before, strict=True):
        np.testing.assert_array_equal(one, other)


def between(**sensors: Any) -> list[km.Robot]:
    """Return two robots with a lidar and other sensors."""
    mounts = {name: km.Mount(sensor) for name, sensor in sensors.items()}
    mounts["lidar"] = km.Mount(km.sensors.RangeBearing(*SIGHT))
    motion, P = km.motion.Odometry2D(0.1, 0.05, 0.02), 0.01 * np.eye(3)
    return [km.Robot(name, motion, start, mounts, cov=P) for name, start in (("a", (0, 0, 0)), ("b", (0.5, 1, 0.2)))]


def test_a_reading_between_landmarks_or_robots_is_what_fuse_does() -> None:
    by_event, by_call = km.Slam(between(tape=km.sensors.Distance(0.05))), km.Slam(between())
    for slam in (by_event, by_call):
        observed(slam, np.random.default_rng(1), np.zeros(3), robot="a")
    of = [[1, 2], ["a", "b"], [1, "unseen"]]
    report = by_event.process(km.Scan(0.0, "a", "tape", [[3.7], [1.2], [9.0]], of=of))
    expected = distance(by_call.mean(1), by_call.mean(2))
    for names, y in ((of[0], 3.7), (of[1], 1.2)):
        by_call.fuse(names, distance, y, 0.05**2)
    assert [o.outcome for o in report.observations] == ["associated", "associated", "ignored"]
    assert report.e[0] == pytest.approx(expected)
    names = ["a", "b", 1, 2, 3]
    np.testing.assert_allclose(by_event.covariance(*names), by_call.covariance(*names), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(by_event.mean(1), by_call.mean(1), atol=1e-7)


@pytest.mark.parametrize("sensor", ["tape", "lidar"])
@pytest.mark.parametrize("names", [["door"], ["door", "mast", "rover"]])
def test_an_observation_of_blocks_that_its_sensor_does_not_take_is_refused_and_changes_nothing(
    sensor: str, names: list[str]
) -> None:
    tape = km.Mount(km.sensors.Distance())
    rover = km.Robot(
        "rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing()), "tape": tape}
    )
    slam = km.Slam(rover)
    slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=["door", "mast"]))
    y = [[3.9], [3.9]] if sensor == "tape" else [[4.0, 0.3], [2.0, -1.0]]
    before = slam.covariance("rover", "door", "mast")
    with pytest.raises(EventError, match="expected"):
        slam.process(km.Scan(0.1, "rover", sensor, y, of=[["door", "mast"], names]))
    np.testing.assert_array_equal(slam.covariance("rover", "door", "mast"), before)
    for name, mean in {"a": (1.0, 2.0), "b": (3.0, 2.0)}.items():
        slam.add_landmark(name, mean)
    report = slam.process(km.Scan(0.1, "rover", "tape", [[2.0], [3.9]], of=[["a", "b"], ["door", "mast"]]))
    assert [one.outcome for one in report.observations] == ["ignored", "associated"]
    assert "known exactly" in report.observations[0].reason


def test_a_distance_to_a_landmark_of_unknown_depth_is_one_to_its_place() -> None:
    eye = km.Mount(km.sensors.Bearing(0.01))
    rover = km.Robot("r", km.motion.Odometry2D(), sensors={"eye": eye, "tape": km.Mount(km.sensors.Distance(0.01))})
    slam = km.Slam(rover)
    slam.process(km.Scan(0.0, "r", "eye", [[0.0]], ids=[1]))
    assert slam.landmark_model(1).kind == "inverse_depth_2d"  # type: ignore[union-attr]
    slam.process(km.Scan(0.0, "r", "tape", [[3.0]], of=[["r", 1]]))
    np.testing.assert_allclose(slam.place(1)[0], [3.0, 0.0], atol=0.02)


def test_a_sensor_of_one_function_measures_the_state_behind_a_pose() -> None:
    speed = km.factor(lambda r: (r[3:4], np.eye(1, 6, 3)), noise=[0.1**2])
    robot = km.Robot("r", km.motion.ConstantVelocity(), sensors={"speed": km.Mount(speed)}, cov=np.eye(6))
    slam = km.Slam(robot)
    slam.process(km.Scan(0.0, "r", "speed", [[2.0]]))
    assert slam.mean("r")[3] == pytest.approx(2.0 / 1.01)
    assert slam.covariance("r")[3, 3] == pytest.approx(0.01 / 1.01)


def test_readings_between_blocks_are_in_logs_and_lines(tmp_path: Path) -> None:
    scan = km.Scan(0.5, "a", "tape", [[3.0], [1.2]], of=[["door", 2], ["a", "b"]])
    assert event_of_object(mapping_of(line_of_event(scan))).of == scan.of  # type: ignore[union-attr]
    columns = {("a", "tape"): ("distance_m",)}
    write_native(km.Log("log", ("a",), [scan], sensor_columns=columns), tmp_path / "log")
    read = km.open_log(tmp_path / "log").events
    assert [(e.of, e.ids, e.y.tolist()) for e in read] == [(scan.of, None, scan.y.tolist())]  # type: ignore[union-attr]
    table = {"t_s": [0.5], "robot": "a", "sensor": "tape", "of": "door|2", "distance_m": [3.0]}
    assert km.log_from(measurements=table).events[0].of == (("door", 2),)  # type: ignore[union-attr]
    with pytest.raises(EventError, match=r"of is .*, expected a list of the names of different robots"):
        km.Scan(0.5, "a", "tape", [[3.0]], of=[["door", "door"]])


def test_a_world_with_readings_between_blocks_is_mapped_consistently() -> None:
    tape = "robots.alpha.sensors.tape={type: distance, sigma_m: 0.05}"
    world = load_world("two_robots", ["steps=60", tape, "robots.alpha.sensing.tape.between=[[1, 2], [alpha, beta]]"])
    nees = []
    for seed in range(12):
        log = simulate(world, seed)
        slam = build_slam(world.config(), log)
        for event in log.events:
            slam.process(event)
        error = slam.mean("beta") - log.truth["beta"].poses[-1]
        error[2] = km.geometry.wrap(error[2])
        nees.append(error @ np.linalg.solve(slam.covariance("beta"), error))
    assert 1.8 < np.mean(nees) < 4.6  # of 36 degrees of freedom, 99 %
    with pytest.raises(KalmarkError, match="the world has no 'gamma'"):
        simulate(load_world("two_robots", ["steps=1", tape, "robots.alpha.sensing.tape.between=[[1, gamma]]"]))


class Cart(km.motion.Thing):
    """Position and velocity on a rail."""

    state, columns = km.geometry.Rn(2), ("a_mps2",)

    def step(self, x: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        F, B = np.array([[1.0, dt_s], [0.0, 1.0]]), np.array([[dt_s**2 / 2], [dt_s]])
        return F @ x + B @ u, F, B

    def gathered(self, u: Array, dt_s: float) -> Array:
        return 0.1**2 * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])

    def control_noise(self, u: Array) -> Array:
        return np.array([[0.2**2]])


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_a_state_of_numbers_is_filtered_by_the_linear_kalman_filter(estimator: Any) -> None:
    C = np.array([[0.0, 0.0, 0.0, 1.0, 0.0]])
    gauge = km.Mount(km.factor(lambda r: (C @ r, C), noise=[[0.1**2]]))
    P0 = np.diag([0.0, 0.0, 0.0, 1.0, 1.0])
    cart = km.Robot("cart", Cart(), start=(0, 0, 0, 1.0, 0.0), cov=P0, sensors={"gauge": gauge})
    slam, x, P, H = km.Slam(cart, estimator=estimator), np.array([1.0, 0.0]), np.eye(2), C[:, 3:]
    for k in range(6):  # [F] 11.3
        u, y = np.array([0.3 - 0.1 * k]), 1.0 + 0.3 * k
        slam.process(km.Control(0.5 * k, "cart", u))
        slam.process(km.Scan(0.5 * k + 0.5, "cart", "gauge", [[y]]))
        moved, F, B = Cart().step(x, u, 0.5)
        P = F @ P @ F.T + B @ Cart().control_noise(u) @ B.T + Cart().gathered(u, 0.5)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.1**2)
        x, P = moved + K @ (y - H @ moved), P - K @ H @ P
    np.testing.assert_allclose(slam.mean("cart"), [0.0, 0.0, 0.0, *x], atol=1e-10)
    np.testing.assert_allclose(slam.covariance("cart")[3:, 3:], P, atol=1e-10)
