"""Walls of the plane: how they look, what a laser measures of them, and how they grow, join and stay apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from differences import derivative
from kalmark.errors import EventError, ModelError
from kalmark.geometry.frames import compose
from kalmark.models.model_check import check_model
from kalmark.models.observe import expectation, linearize, view_of
from kalmark.simulate import World, simulate

WALL, SENSOR = km.landmarks.Wall2D(), km.sensors.Wall()
T, L = np.array([1.0, -2.0, 0.7]), np.array([3.0, 1.0, 0.4])
V = np.array([2.0, 0.3, -1.5, 2.5])


def seen(T: Any, ends: Any, sensor: Any = SENSOR) -> Any:
    """Return what a sensor at T measures, without noise, of walls (K, 4)."""
    ends = np.reshape(np.asarray(ends, dtype=np.float64), (-1, 4))
    inside, y = sensor.sees_segments(np.asarray(T, dtype=np.float64), ends[:, :2], ends[:, 2:])
    return y[inside]


def slam_of(estimator: Any = None, at: Any = (0.0, 0.0, 0.0), **of_slam: Any) -> km.Slam:
    mount = km.Mount(SENSOR, at=at, upkeep=km.Upkeep(confirm=1))
    start = np.diag([0.05, 0.05, 0.02]) ** 2
    robot = km.Robot("robot", km.motion.Odometry2D(0.05, 0.05, 0.02), cov=start, sensors={"laser": mount})
    return km.Slam([robot], of_slam.pop("association", km.association.NearestNeighbour()), estimator, **of_slam)


def look(slam: km.Slam, t_s: float, T: Any, ends: Any, **scan: Any) -> Any:
    return slam.process(km.Scan(t_s=t_s, robot="robot", sensor="laser", y=seen(T, ends), **scan))


@pytest.mark.parametrize("model", [WALL, SENSOR])
def test_the_jacobians_of_walls_pass_the_check(model: Any) -> None:
    assert all(finding.ok for finding in check_model(model, np.random.default_rng(0)))


def test_the_jacobians_of_walls_are_those_of_differences() -> None:
    _, V_T, V_l = (a[0] for a in WALL.seen_from(T, L[None]))
    np.testing.assert_allclose(V_T, derivative(lambda x: WALL.seen_from(x, L[None])[0][0], T), atol=1e-8)
    np.testing.assert_allclose(V_l, derivative(lambda x: WALL.seen_from(T, x[None])[0][0], L), atol=1e-8)
    l, L_T, L_v = (a[0] for a in WALL.from_view(T, V[None]))
    np.testing.assert_allclose(L_T, derivative(lambda x: WALL.from_view(x, V[None])[0][0], T), atol=1e-8)
    np.testing.assert_allclose(L_v, derivative(lambda x: WALL.from_view(T, x[None])[0][0], V), atol=1e-8)
    np.testing.assert_allclose(WALL.seen_from(T, l[None])[0][0], V[:2], atol=1e-12)
    np.testing.assert_allclose(WALL.abscissas(T, l[None], V[None])[0], [-2.0, 2.0], atol=1e-12)
    t = np.array([-1.0, 3.0])
    P_l = WALL.endpoints(L[None], t[None])[1][0]
    for end in range(2):
        numeric = derivative(lambda x, end=end: WALL.endpoints(x[None], t[None])[0][0, end], L)  # type: ignore[misc]
        np.testing.assert_allclose(P_l[end], numeric, atol=1e-8)
    for turn in (0.1, np.pi + 0.1):  # the same line, told from either side
        other = np.array([2.0, 4.0, L[2] + turn])
        _, Z_a, Z_b = WALL.difference(L, other, 0.7)
        np.testing.assert_allclose(Z_a, derivative(lambda x, b=other: WALL.difference(x, b, 0.7)[0], L), atol=1e-8)  # type: ignore[misc]
        np.testing.assert_allclose(Z_b, derivative(lambda x: WALL.difference(L, x, 0.7)[0], other), atol=1e-8)


def test_the_compiled_observation_is_the_chain_rule() -> None:
    mount = np.array([0.2, -0.1, 0.3])
    y = np.array([[1.5, 0.2, -1.0, 2.0]])
    view = view_of(SENSOR, WALL, mount)
    assert isinstance(view, tuple)
    e, z, E_h, E_l = linearize(view, np.concatenate([T, mount]), L[None], y)
    told, E_r, E_s, E_l2 = expectation(T, mount, SENSOR, WALL, L[None])
    sign = np.sign(e[0, 0] * told[0, 0])
    flip = np.diag([sign, 1.0])
    np.testing.assert_allclose(flip @ E_h[0], np.hstack([E_r[0], E_s[0]]), atol=1e-12)
    np.testing.assert_allclose(flip @ E_l[0], E_l2[0], atol=1e-12)
    numeric = derivative(lambda h: -linearize(view, h, L[None], y)[1][0], np.concatenate([T, mount]))
    np.testing.assert_allclose(E_h[0], numeric, atol=1e-8)
    assert z.shape == (1, 2)


@pytest.mark.parametrize("across", [-0.01, 0.01])
def test_a_line_through_the_sensor_may_be_measured_on_either_side(across: float) -> None:
    l = np.array([[5.0, 0.02, 0.5 * np.pi]])  # 2 cm to the left of a robot that looks along it
    here = np.array([0.0, across, 0.0])
    right = linearize(view_of(SENSOR, WALL, np.zeros(3)), here, l, np.array([[0.015, -0.5 * np.pi, -6.0, -4.0]]))
    left = linearize(view_of(SENSOR, WALL, np.zeros(3)), here, l, np.array([[0.015, 0.5 * np.pi, 4.0, 6.0]]))
    np.testing.assert_allclose(left[1][0], [0.015 - 0.02 + across, 0.0], atol=1e-12)
    np.testing.assert_allclose(right[1][0], [0.015 + 0.02 - across, 0.0], atol=1e-12)  # the other way round
    np.testing.assert_allclose(left[2][0, 0], -right[2][0, 0], atol=1e-12)


def test_what_is_seen_of_a_wall_ends_with_range_and_field_of_view() -> None:
    wall = [2.0, -5.0, 2.0, 5.0]
    np.testing.assert_allclose(seen((0, 0, 0), wall), [[2.0, 0.0, -5.0, 5.0]], atol=1e-12)
    np.testing.assert_allclose(seen((0, 0, 0), wall[2:] + wall[:2]), [[2.0, 0.0, -5.0, 5.0]], atol=1e-12)
    np.testing.assert_allclose(np.abs(seen((0, 0, np.pi), wall)), [[2.0, np.pi, 5.0, 5.0]], atol=1e-12)
    near = km.sensors.Wall(range_max_m=4.0)
    np.testing.assert_allclose(seen((0, 0, 0), wall, near), [[2.0, 0.0, -np.sqrt(12), np.sqrt(12)]], atol=1e-12)
    narrow = km.sensors.Wall(fov_rad=0.5 * np.pi)
    np.testing.assert_allclose(seen((0, 0, 0), wall, narrow), [[2.0, 0.0, -2.0, 2.0]], atol=1e-12)
    np.testing.assert_allclose(seen((0, 0, 0.5 * np.pi), wall, narrow), [[2.0, -0.5 * np.pi, 2.0, 5.0]], atol=1e-9)
    assert len(seen((0, 0, np.pi), wall, narrow)) == 0


def test_a_run_turned_and_shifted_gives_the_same_estimate_turned_and_shifted() -> None:
    world = World.model_validate(ROOM)
    events = list(simulate(world, seed=3))
    runs = []
    for start in (np.array([0.0, 0.0, 0.0]), np.array([400.0, -250.0, 2.1])):
        cov = np.diag([0.1, 0.1, 0.05]) ** 2
        c, s = np.cos(start[2]), np.sin(start[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        mount = km.Mount(SENSOR, at=(0.2, 0.0, 0.0))
        robot = km.Robot("robot", km.motion.Odometry2D(0.01, 0.01, 0.01), start=start, cov=turn @ cov @ turn.T,
                         sensors={"laser": mount})  # fmt: skip
        slam = km.Slam([robot])
        for event in events:
            slam.process(event)
        runs.append((slam, start, turn))
    (one, _, _), (other, T, turn) = runs
    for name in ("robot", *one.tracks.confirmed):
        x = compose(T, one.mean(name))[0]
        d = other.mean(name) - x
        d[2] = np.angle(np.exp(1j * d[2]))
        np.testing.assert_allclose(d, 0.0, atol=1e-8)
        np.testing.assert_allclose(other.covariance(name), turn @ one.covariance(name) @ turn.T, atol=1e-8)


ROOM = {
    "world": {"type": "list", "walls_m": [[-4, -3, 5, -3], [5, -3, 5, 4], [5, 4, -4, 4], [-4, 4, -4, -3]]},
    "robots": {
        "robot": {
            "route": {"type": "constant", "u": [0.1, 0.0, 0.06]},
            "motion": {"type": "odometry_2d", "sigma_x_m": 0.01, "sigma_y_m": 0.01, "sigma_theta_rad": 0.01},
            "sensors": {"laser": {"type": "wall", "mount": {"x_m": 0.2}}},
        }
    },
    "steps": 150,
    "noise_on": "robot",
}


def test_a_standing_robot_learns_nothing_of_its_heading_from_walls() -> None:
    walls = [[-4, -3, 5, -3], [5, -3, 5, 4], [5, 4, -4, 4]]
    sigmas = []
    for estimator in (km.estimators.Invariant(), km.estimators.Ekf()):
        rng = np.random.default_rng(1)
        mount = km.Mount(SENSOR)
        cov = np.diag([0.5, 0.5, np.radians(20)]) ** 2
        robot = km.Robot("robot", km.motion.Odometry2D(), cov=cov, sensors={"laser": mount})
        slam = km.Slam([robot], estimator=estimator)
        for k in range(200):
            y = seen((0, 0, 0), walls)
            y[:, :2] += rng.normal(size=(3, 2)) * [0.02, 0.01]
            slam.process(km.Scan(t_s=k, robot="robot", sensor="laser", y=y, ids=[1, 2, 3]))
        sigmas.append(np.degrees(np.sqrt(slam.covariance("robot")[2, 2])))
    assert sigmas[0] == pytest.approx(20.0, abs=1e-6)
    assert sigmas[1] < 19.9


def test_two_walls_with_a_door_between_them_stay_two() -> None:
    slam = slam_of()
    corridor = [[-6, 2, -0.6, 2], [0.6, 2, 6, 2]]
    for k in range(5):
        look(slam, k, (0, 0, 0), corridor)
    assert len(slam.tracks.confirmed) == 2
    ends = np.sort([np.sort(slam.segment(name)[0][:, 0]) for name in slam.tracks.confirmed], axis=0)
    np.testing.assert_allclose(ends, [[-6, -0.6], [0.6, 6]], atol=0.05)


def test_pieces_of_a_wall_become_one_when_their_segments_join() -> None:
    slam = slam_of()
    for k in range(5):
        look(slam, k, (0, 0, 0), [[-6, 2, -1, 2], [1, 2, 6, 2]])
    assert len(slam.tracks.confirmed) == 2
    merged = [m for k in range(5, 12) for m in look(slam, k, (0, 0, 0), [[-1.5, 2, 1.5, 2]]).merged]
    assert len(slam.tracks.confirmed) == 1
    assert merged[0][:2] == ("u2", "u1")
    assert "merged into 'u1'" in merged[0][2]
    np.testing.assert_allclose(np.sort(slam.segment("u1")[0][:, 0]), [-6, 6], atol=0.05)
    assert slam.segment("u1")[1].shape == (2, 2, 2)


def test_walls_that_join_but_do_not_agree_stay_two() -> None:
    slam = slam_of()
    for k in range(12):
        look(slam, k, (0, 0, 0), [[-6, 2.0, 0.2, 2.0], [0, 2.4, 6, 2.4]])
    assert len(slam.tracks.confirmed) == 2


def test_walls_with_two_ids_are_two() -> None:
    slam = slam_of()
    for k in range(6):
        look(slam, k, (0, 0, 0), [[-6, 2, 0, 2], [0, 2, 6, 2]], ids=["west", "east"])
    assert {*slam.tracks.confirmed} == {"west", "east"}


def test_a_map_of_walls_is_saved_and_resumed(tmp_path: Path) -> None:
    slam = slam_of()
    for k in range(4):
        look(slam, k, (0, 0, 0), [[-6, 2, -1, 2], [1, 2, 6, 2], [-7, -3, -7, 3]])
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    for each in (slam, again):
        look(each, 9.0, (0, 0, 0), [[-1.5, 2, 1.5, 2]])
    for name in slam.tracks.confirmed:
        np.testing.assert_array_equal(slam.mean(name), again.mean(name))
        np.testing.assert_array_equal(slam.segment(name)[0], again.segment(name)[0])


@pytest.mark.parametrize(
    ("y", "expected"),
    [([-1.0, 0, 0, 1], "distance_m is -1.0, expected at least 0"), ([1.0, 0, 2, 1], "right_m is 2.0, expected less")],
)
def test_segments_that_no_sensor_measures_are_refused(y: Any, expected: str) -> None:
    with pytest.raises(EventError, match=expected):
        slam_of().process(km.Scan(t_s=0, robot="robot", sensor="laser", y=[y]))


def test_a_sensor_of_points_does_not_see_walls() -> None:
    for sensor in (km.sensors.RangeBearing(), km.sensors.RangeBearingSignature()):
        robot = km.Robot("robot", km.motion.Odometry2D(), sensors={"laser": km.Mount(sensor, landmark=WALL)})
        with pytest.raises(ModelError, match="does not see walls"):
            km.Slam([robot])


def test_a_wall_seen_from_a_mount_is_where_it_is() -> None:
    slam = slam_of(at=(0.3, 0.1, 0.5))
    look(slam, 0.0, (0.3, 0.1, 0.5), [[-6, 2, 6, 2]])
    p, P = slam.segment("u1")
    np.testing.assert_allclose(p, [[6, 2], [-6, 2]], atol=1e-9)
    assert (np.linalg.eigvalsh(P) > 0).all()
