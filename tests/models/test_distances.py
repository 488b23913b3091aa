"""Ranges, strengths and differences of arrival in three dimensions: robots in space, and landmarks at a height."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, load_config
from kalmark.errors import ConfigError, ModelError
from kalmark.geometry.spaces import SE3, mount_space
from kalmark.models.landmarks import PointHeight2D
from kalmark.models.model_check import check_model
from kalmark.models.observe import PythonView, linearize, view_of
from kalmark.models.pointwise import jacobian
from kalmark.results.landmark_table import MapLandmarks
from kalmark.simulate import load_world, simulate

UNKNOWN = {"scale": 1.07, "bias_m": 0.3, "sigma_scale": 0.1, "sigma_bias_m": 0.3}
BEACONS = {
    "a": (-4, -4, 0.2),
    "b": (4, -4, 2.9),
    "c": (4, 4, 0.3),
    "d": (-4, 4, 2.8),
    "e": (0, -4, 1.5),
    "f": (0, 4, 1.7),
}
COV = "cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
HIGH: list[Any] = [
    km.sensors.Range(height_m=0.5, **UNKNOWN), km.sensors.SignalStrength2D(height_m=0.5, sigma_exponent=0.3),
    km.sensors.RangeDifference2D(height_m=0.5),
]  # fmt: skip


@pytest.mark.parametrize("sensor", [km.sensors.Range3D(sigma_range_rel=0.02, **UNKNOWN), *HIGH])
def test_a_check_finds_nothing(sensor: Any) -> None:
    assert all(found.ok for found in check_model(sensor, np.random.default_rng(0)))


@pytest.mark.parametrize("sensor", [km.sensors.Range3D(**UNKNOWN), *HIGH], ids=lambda s: type(s).__name__)
def test_jacobians_are_those_of_differences_and_the_plain_ones(sensor: Any) -> None:
    rng, plane = np.random.default_rng(1), sensor.world == "plane"
    landmark = PointHeight2D() if plane else km.landmarks.Point3D()
    at = np.array([0.3, -0.2, 0.4]) if plane else SE3.plus([0, 0, 0, 0, 0, 0, 1.0], rng.normal(0, 0.3, 6))
    own = np.zeros(0) if isinstance(sensor, km.sensors.RangeDifference2D) else sensor.parameters
    compiled, plain = view_of(sensor, landmark, at), PythonView(sensor, landmark, at, np.array(sensor.angular))
    for _ in range(20):
        r = rng.normal(0, 2, 3) if plane else SE3.plus([0, 0, 0, 0, 0, 0, 1.0], rng.normal(0, 1, 6))
        head, l, y = np.concatenate([r, at, own]), rng.normal(0, 3, (1, 3)), np.zeros((1, 1))
        found = linearize(compiled, head, l, y)
        if len(own):
            for one, other in zip(plain.linearize(head, l, y), found, strict=True):
                np.testing.assert_allclose(one, other, atol=1e-10)
        of_l = jacobian(lambda x, h=head, y=y: linearize(compiled, h, x[None], y)[0][0], l[0], (False,))
        np.testing.assert_allclose(found[3][0], of_l, rtol=1e-5, atol=1e-6)
        space, d = mount_space(len(at), len(own)), 3 if plane else 6
        for j in range(d + len(own)):
            step = 1e-6 * np.eye(d + len(own))[j]
            behind = [space.plus(head[len(at) :], sign * step) for sign in (1, -1)]
            e = [linearize(compiled, np.concatenate([r, b]), l, y)[0][0, 0] for b in behind]
            assert found[2][0, 0, d + j] == pytest.approx((e[0] - e[1]) / 2e-6, abs=1e-5)


def test_the_slant_range_of_a_landmark_at_a_height_is_expected_from_the_sensors_height() -> None:
    sensor, v = km.sensors.Range(height_m=0.4), np.array([[3.0, 0.0, 4.4]])
    e, E_v = sensor.expect(v)
    assert e.tolist() == [[5.0]]
    np.testing.assert_allclose(E_v, [[[0.6, 0.0, 0.8]]])
    assert km.sensors.Range(height_m=-4.0).expect(np.array([[3.0, 0.0]]))[0].tolist() == [[5.0]]
    assert km.sensors.Range(height_m=4.0).distances(np.array([[5.0]])).tolist() == [3.0]
    assert km.sensors.Range3D().expect(np.zeros((1, 3)))[1].tolist() == [[[0.0, 0.0, 0.0]]]


def among_beacons(seed: int) -> tuple[float, float]:
    """Fly among six surveyed beacons whose ranges are 5 % long; return the NEES of the pose, the error of the scale."""
    rng, pose = np.random.default_rng(seed), np.array([2.0, 0, 1, 0, 0, 0, 1])
    motion = km.motion.Velocity3D(*6 * (0.03,))
    mount = km.Mount(km.sensors.Range3D(0.08, sigma_scale=0.05))
    slam = km.Slam(km.Robot("r", motion, start=pose, cov=1e-4 * np.eye(6), sensors={"radio": mount}))
    true = SE3.plus(pose, rng.normal(0, 1e-2, 6))
    scale = 1 + rng.normal(0, 0.05)
    for name, place in BEACONS.items():
        slam.add_landmark(name, place)
    for k in range(1, 151):
        u = np.array([0.8, 0.0, 0.3 * np.cos(0.05 * k), 0.0, 0.0, 0.4])
        true = motion.move(true, u + rng.normal(0, 0.03, 6), 0.1)[0]
        slam.process(km.Control(0.1 * (k - 1), "r", u))
        d = [scale * np.linalg.norm(true[:3] - place) + rng.normal(0, 0.08) for place in BEACONS.values()]
        report = slam.process(km.Scan(0.1 * k, "r", "radio", np.array(d)[:, None], [*BEACONS]))
        assert all(o.outcome == "associated" for o in report.observations)
    error = SE3.minus(slam.mean("r"), true)
    sigma = np.sqrt(slam.covariance("r.radio")[6, 6])
    return float(error @ np.linalg.solve(slam.covariance("r"), error)), (1 / slam.mean("r.radio")[7] - scale) / sigma


def test_ranges_to_surveyed_beacons_tell_pose_and_scale_in_space_as_surely_as_the_filter_says() -> None:
    found = np.array([among_beacons(seed) for seed in range(5)])
    assert 2.8 < found[:, 0].mean() < 10.2  # chi-square of 30 degrees of freedom over 5, 99.9 %
    assert (np.abs(found[:, 1]) < 4).all()


def test_ranges_in_space_correct_landmarks_that_others_began_and_start_none() -> None:
    sensors = {"radio": km.Mount(km.sensors.Range3D(0.05)), "cam": km.Mount(km.sensors.PinHole())}
    slam = km.Slam(km.Robot("r", km.motion.Odometry3D(), sensors=sensors))
    (alone,) = slam.process(km.Scan(0.0, "r", "radio", [[5.0]], [7])).observations
    assert alone.outcome == "ignored"
    assert "Range3D" in alone.reason
    slam.process(km.Scan(0.1, "r", "cam", [[330.0, 250.0]], [7]))
    (used,) = slam.process(km.Scan(0.2, "r", "radio", [[5.0]], [7])).observations
    assert used.outcome == "associated"
    p = slam.landmark_model(7).place(slam.mean(7)[None])[0][0]  # type: ignore[attr-defined]
    assert np.linalg.norm(p) == pytest.approx(5.0, abs=0.1)


def config(folder: Path, text: str, survey: str) -> Path:
    (folder / "map.csv").write_text(survey)
    (folder / "c.yaml").write_text(f"map: {{known: map.csv}}\nrobots: {{each: {{sensors: {{s: {text}}}}}}}\n")
    return folder / "c.yaml"


@pytest.mark.parametrize(
    ("mount", "survey"),
    [
        ("", "id,x_m,y_m,z_m\na,3,0,2.4\nb,0,3,2.4\nc,-3,-3,2.4\n"),
        ("", f"id,x_m,y_m,z_m,{COV}\na,3,0,2.4,1e-4,0,0,1e-4,0,0\nb,0,3,2.4,,,,,,\nc,-3,-3,2.4,,,,,,\n"),
        (", mount: {z_m: -2.4}", "id,x_m,y_m\na,3,0\nb,0,3\nc,-3,-3\n"),
    ],
)  # fmt: skip
def test_the_height_of_beacons_is_that_of_the_survey_or_of_the_mount(mount: str, survey: str, tmp_path: Path) -> None:
    slam = build_slam(load_config(config(tmp_path, "{type: range, sigma_range_m: 0.01" + mount + "}", survey)))
    slam.process(km.Control(0.0, "robot", (0.0, 0.0)))
    d = [np.sqrt(np.hypot(x - 0.3, y - 0.1) ** 2 + 2.4**2) for x, y in ((3, 0), (0, 3), (-3, -3))]
    for k in range(1, 200):
        slam.process(km.Control(0.5 * k, "robot", (0.0, 0.0), cov=1e-2 * np.eye(2)))
        report = slam.process(km.Scan(0.5 * k, "robot", "s", np.array(d)[:, None], ["a", "b", "c"]))
    assert all(o.outcome == "associated" for o in report.observations)
    np.testing.assert_allclose(slam.mean("robot")[:2], [0.3, 0.1], atol=0.02)


def test_a_height_of_what_measures_in_the_plane_is_refused(tmp_path: Path) -> None:
    path = config(tmp_path, "{type: range_bearing, mount: {z_m: 0.5}}", "id,x_m,y_m\na,3,0\n")
    with pytest.raises(ConfigError, match=r"z_m: got 0\.5, expected none: a range_bearing measures in the plane"):
        build_slam(load_config(path))


def test_a_laser_sees_the_place_in_the_plane_of_a_landmark_at_a_height_and_the_table_of_landmarks_keeps_it(
    tmp_path: Path,
) -> None:
    slam = km.Slam(km.Robot("r", km.motion.Unicycle(), sensors={"l": km.Mount(km.sensors.RangeBearing())}))
    slam.add_landmark("a", (3.0, 0.0, 4.0), 1e-4 * np.eye(3))
    slam.add_landmark("b", (0.0, 3.0, 1.0))
    report = slam.process(km.Scan(0.0, "r", "l", [[3.0, 0.0], [3.0, np.pi / 2]], ["a", "b"]))
    np.testing.assert_allclose(report.z, 0.0, atol=1e-12)
    table = MapLandmarks.of(slam)
    (tmp_path / "landmarks.csv").write_text(table.to_csv())
    again = MapLandmarks.read(tmp_path / "landmarks.csv")
    assert not again.in_space
    assert [mean.tolist() for mean in again.means] == [[3.0, 0.0, 4.0], [0.0, 3.0, 1.0]]
    assert again.positions()[0].shape == (2, 2)


def test_ranges_map_unknown_beacons_at_the_height_of_the_mount() -> None:
    rng, x = np.random.default_rng(2), np.zeros(3)
    radio = km.Mount(km.sensors.Range(0.03, height_m=-2.4))
    robot = km.Robot("r", km.motion.Odometry2D(0.01, 0.0, 0.002), sensors={"s": radio})
    slam = km.Slam(robot)
    for k in range(1, 61):
        u = np.array([0.4, 0.0, 0.1])
        x = robot.motion.move(x, u, 1.0)[0]
        slam.process(km.Control(float(k), "r", u))
        d = np.sqrt(np.sum((x[:2] - (3.0, 9.0)) ** 2) + 2.4**2) + rng.normal(0, 0.03)
        slam.process(km.Scan(float(k), "r", "s", [[d]], [5]))
    np.testing.assert_allclose(slam.mean(5), [3.0, 9.0], atol=0.2)
    late = {"landmark": PointHeight2D(), "initialization": km.initialization.Trilateration()}
    odd = km.Robot("r", km.motion.Unicycle(), sensors={"s": km.Mount(km.sensors.Range(), **late)})  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="its landmarks are point_height, expected point"):
        km.Slam(odd)


RADIUS: Any = [
    km.sensors.RangeBearingHeight(height_m=0.5, **UNKNOWN), km.sensors.RangeBearing3D(**UNKNOWN),
    km.sensors.Bearing3D(), km.sensors.RangeBearing(**UNKNOWN), km.sensors.RangeBearingSignature(**UNKNOWN),
    km.sensors.Bearing(),
]  # fmt: skip


@pytest.mark.parametrize("sensor", RADIUS, ids=lambda s: type(s).__name__)
def test_ranges_and_angles_of_plane_and_space_have_their_jacobians_and_inverses(sensor: Any) -> None:
    found = check_model(sensor, np.random.default_rng(0))
    assert {"E_v", "V_y", "expect(invert(y)) = y"} <= {one.what for one in found}
    assert all(one.ok for one in found)


def test_a_robot_of_the_plane_starts_and_corrects_landmarks_at_heights() -> None:
    rng, places = np.random.default_rng(2), np.array([[4.0, 1.0, 2.5], [2.0, -3.0, 1.0], [6.0, 2.0, 0.2]])
    lidar = km.Mount(km.sensors.RangeBearingHeight(0.05, 0.01, 0.01, height_m=0.5))
    slam = km.Slam(km.Robot("r", km.motion.Odometry2D(0.01, 0.0, 0.005), sensors={"lidar": lidar}))
    pose = np.zeros(3)
    for k in range(20):
        T = km.geometry.to_frame(pose, places[:, :2])[0]
        up = places[:, 2] - 0.5
        flat = np.hypot(*T.T)
        y = np.column_stack([np.hypot(flat, up), np.arctan2(T[:, 1], T[:, 0]), np.arctan2(up, flat)])
        slam.process(km.Scan(float(k), "r", "lidar", y + rng.normal(size=y.shape) * (0.05, 0.01, 0.01), ids=[1, 2, 3]))
        u = np.array([0.1, 0.0, 0.02])
        pose = km.geometry.compose(pose, u + rng.normal(size=3) * (0.01, 0.0, 0.005))[0]
        slam.process(km.Control(k + 0.5, "r", u))
    error = np.concatenate([slam.mean(i) for i in (1, 2, 3)]) - places.ravel()
    assert slam.landmark_model(1).kind == "point_height"  # type: ignore[union-attr]
    assert error @ np.linalg.solve(slam.covariance(1, 2, 3), error) < 21.7  # of 9 degrees of freedom, 99 %


def test_directions_in_space_start_rays_that_become_points() -> None:
    place, eye = np.array([5.0, 1.0, 0.5]), km.Mount(km.sensors.Bearing3D(0.005, 0.005))
    slam = km.Slam(km.Robot("d", km.motion.Odometry3D(), sensors={"eye": eye}))
    for k in range(6):
        p = place - [0.0, 0.5 * k, 0.2 * k]
        y = [np.arctan2(p[1], p[0]), np.arctan2(p[2], np.hypot(p[0], p[1]))]
        slam.process(km.Scan(float(k), "d", "eye", [y], ids=["a"]))
        slam.process(km.Control(k + 0.5, "d", [0, 0.5, 0.2, 0, 0, 0]))
    found, P = slam.place("a")
    assert np.linalg.norm(found - place) < 0.05
    assert np.sqrt(np.trace(P)) < 0.2


def test_a_world_of_heights_is_of_a_sensor_that_measures_them(tmp_path: Path) -> None:
    world = tmp_path / "w.yaml"
    text = """
world: {type: list, points_m: [[4, 1, 2.5], [2, -3, 1.0], [6, 2, 0.2]]}
robots:
  robot:
    route: {type: constant, u: [0.5, 0.1]}
    motion: {type: unicycle}
    sensors: {lidar: {type: SENSOR, mount: {z_m: 0.5}}}
steps: 20
dt_s: 0.1
"""
    world.write_text(text.replace("SENSOR", "range_bearing_3d"))
    made = load_world(world)
    log = simulate(made, 1)
    slam = build_slam(made.config(), log)
    for event in log.events:
        slam.process(event)
    assert np.abs(slam.mean(1) - [4.0, 1.0, 2.5]).max() < 0.3
    world.write_text(text.replace("SENSOR, mount: {z_m: 0.5}", "range_bearing"))
    with pytest.raises(ConfigError, match="its landmarks are in space"):
        load_world(world)
