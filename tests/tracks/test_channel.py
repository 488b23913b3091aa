"""A channel and a scan against the textbook: the sensor's pose, innovations, Z and d2 by differences, new landmarks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.filter.map import StochasticMap
from kalmark.geometry import POINT2, SE2
from kalmark.geometry.spaces import mount_space
from kalmark.tracks.channel import Channel, default_landmark, huber_length, landmarks_in_frame
from kalmark.tracks.clones import Clones
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Track, Tracks

POINT, RAY = km.landmarks.Point2D(), km.landmarks.InverseDepth2D()
ROBOT, MOUNT = np.array([1.0, 2.0, math.pi / 2]), np.array([0.5, 0.0, 0.0])  # the sensor is at (1, 2.5), looks along y
LANDMARKS = np.array([[1.0, 6.5], [-2.0, 6.5]])  # 4 m ahead, and 5 m off to the left
STEP = 1e-6
R = np.diag([0.1, 0.02]) ** 2


def random_covariance(size: int, scale: float) -> np.ndarray:
    A = scale * np.random.default_rng(size).normal(size=(size, size + 2))
    return A @ A.T


P_ROBOT, P_LANDMARK = random_covariance(3, 0.1), random_covariance(2, 0.2)


def map_of(mount: bool = False) -> StochasticMap:
    """Return a map of a robot on slot 0, of two landmarks on 1 and 2, and of a mount on 3."""
    m = StochasticMap()
    m.add(SE2, ROBOT, P_ROBOT)
    for l in LANDMARKS:
        m.add(POINT2, l, P_LANDMARK)
    if mount:
        m.add(SE2, MOUNT, 0.01 * np.eye(3))
    return m


def channel_of(sensor: Any = None, mount: int = -1, landmark: Any = POINT) -> Channel:
    sensor = sensor or km.sensors.RangeBearing(0.1, 0.02)
    return Channel(sensor, MOUNT, mount, landmark, lambda dof: float(chi2.ppf(0.99, dof)), [landmark])


def observed(robot: np.ndarray, l: np.ndarray, mount: np.ndarray = MOUNT) -> np.ndarray:
    """Return range and bearing (2,) of a landmark."""
    T = robot[:2] + km.geometry.rotation(robot[2]) @ mount[:2]
    d = l - T
    return np.array([math.hypot(*d), math.atan2(d[1], d[0]) - robot[2] - mount[2]])


def derivative(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, plus: Any = np.add) -> np.ndarray:
    """Return the Jacobian of a function by central differences."""
    size = len(x)
    steps = [(function(plus(x, h)) - function(plus(x, -h))) / (2 * STEP) for h in STEP * np.eye(size)]
    return np.stack(steps, axis=1)


def test_the_sensor_is_where_its_mount_is_on_the_robot() -> None:
    m, channel = map_of(mount=True), channel_of()
    np.testing.assert_allclose(channel.pose(m, 0), [1.0, 2.5, math.pi / 2], atol=1e-12)
    np.testing.assert_array_equal(channel.observer(m, 0), ROBOT)
    assert (channel.second(0), channel.parts(m, 0)) == (-1, ((0, 3),))
    mounted = channel_of(mount=3)
    np.testing.assert_array_equal(mounted.observer(m, 0), [*ROBOT, *MOUNT])
    assert (mounted.second(0), mounted.parts(m, 0)) == (3, ((0, 3), (3, 3)))
    np.testing.assert_allclose(mounted.pose(m, 0), channel.pose(m, 0))


def test_measurements_seem_to_come_from_where_range_and_bearing_point() -> None:
    places = channel_of().places(map_of(), 0, np.array([[4.0, 0.0], [5.0, math.atan2(3.0, 4.0)]]))
    np.testing.assert_allclose(places, LANDMARKS, atol=1e-12)
    assert channel_of(km.sensors.Range(0.1)).places(map_of(), 0, np.array([[4.0]])) is None


def test_innovations_their_covariance_and_d2_are_those_of_the_textbook() -> None:
    """Z = E_r P_r E_r' + E_l P_l E_l' + R, d2 = z' Z^-1 z."""
    m, channel = map_of(), channel_of()
    y = np.array([[4.3, 0.05], [4.9, 0.7]])
    model, slots = channel.models["point"], np.array([1, 2])
    z = channel.innovations(m, 0, model, slots, y)
    Z, d2 = channel.predict(m, 0, model, slots, y, np.tile(R, (2, 1, 1)))
    for k, l in enumerate(LANDMARKS):
        expected = y[k] - observed(ROBOT, l)
        E_r, E_l = derivative(lambda r: observed(r, l), ROBOT, SE2.plus), derivative(lambda l: observed(ROBOT, l), l)
        right = E_r @ P_ROBOT @ E_r.T + E_l @ P_LANDMARK @ E_l.T + R
        np.testing.assert_allclose(z[k], expected, atol=1e-12)
        np.testing.assert_allclose(Z[k], right, rtol=1e-6)
        assert d2[k] == pytest.approx(expected @ np.linalg.solve(right, expected), rel=1e-6)


def test_the_distance_from_a_landmark_known_exactly_has_no_part_of_the_landmark() -> None:
    m, channel = map_of(), channel_of()
    y, l = np.array([[4.3, 0.05]]), LANDMARKS[:1]
    exactly = channel.models["point"].exactly
    Z, d2 = exactly.predict(*m.marginal(0, -1, np.array([0])), np.concatenate([y, l], axis=1), R[None])
    E_r, z = derivative(lambda r: observed(r, l[0]), ROBOT, SE2.plus), y[0] - observed(ROBOT, l[0])
    right = E_r @ P_ROBOT @ E_r.T + R
    np.testing.assert_allclose(Z[0], right, rtol=1e-6)
    assert d2[0] == pytest.approx(z @ np.linalg.solve(right, z), rel=1e-6)


def test_an_innovation_of_a_bearing_goes_the_short_way_round() -> None:
    m = map_of()
    m.add(POINT2, [1.01, -3.0], P_LANDMARK)  # behind it
    z = channel_of().innovations(m, 0, channel_of().models["point"], np.array([3]), np.array([[5.5, 3.1]]))
    assert z[0, 1] == pytest.approx(3.1 - math.pi - math.atan2(0.01, 5.5), abs=1e-9)


@pytest.mark.parametrize("mount", [-1, 3])
def test_a_landmark_starts_where_its_measurement_points_with_the_noise_of_that(mount: int) -> None:
    m, channel, y = map_of(mount=True), channel_of(mount=mount), np.array([[4.0, 0.4]])
    l, L_h, Q = channel.landmark_of(m, 0, y, R, False)

    def started(observer: np.ndarray, y: np.ndarray) -> np.ndarray:
        robot, mount = observer[:3], observer[3:] if len(observer) > 3 else MOUNT
        T = robot[:2] + km.geometry.rotation(robot[2]) @ mount[:2]
        a = robot[2] + mount[2] + y[1]
        return T + y[0] * np.array([math.cos(a), math.sin(a)])

    def plus(observer: np.ndarray, step: np.ndarray) -> np.ndarray:
        poses = zip(observer.reshape(-1, 3), step.reshape(-1, 3), strict=True)
        return np.concatenate([SE2.plus(*pose) for pose in poses])

    observer = channel.observer(m, 0)
    np.testing.assert_allclose(l, started(observer, y[0]), atol=1e-12)
    np.testing.assert_allclose(L_h, derivative(lambda x: started(x, y[0]), observer, plus), atol=1e-6)
    L_y = derivative(lambda y: started(observer, y), y[0])
    np.testing.assert_allclose(Q, L_y @ R @ L_y.T, rtol=1e-6, atol=1e-10)


def test_a_landmark_starts_where_the_mount_was_the_lag_ago_with_the_jacobian_in_the_lag() -> None:
    m, channel, y = StochasticMap(), channel_of(mount=1), np.array([[4.0, 0.4]])
    channel = Channel(channel.sensor, MOUNT, 1, POINT, lambda dof: 9.0, [POINT], lags=True)
    lag_s, v, w, before = 0.2, 0.8, 0.5, np.array([-0.16, 0.01, -0.1])  # before: the robot `lag_s` ago, from now
    channel.past[:] = [lag_s, v, 0.0, w, *before]
    m.add(SE2, ROBOT, P_ROBOT)
    m.add(mount_space(3, 1), [*MOUNT, 0.25], 0.01 * np.eye(4))

    def started(observer: np.ndarray) -> np.ndarray:
        a = w * (lag_s - observer[6])
        moved = np.array([v * math.sin(a) / w, v * (1.0 - math.cos(a)) / w, a])
        place, heading = np.zeros(2), 0.0
        for pose in (observer[:3], before, moved, observer[3:6]):
            place, heading = place + km.geometry.rotation(heading) @ pose[:2], heading + pose[2]
        return place + y[0, 0] * np.array([math.cos(heading + y[0, 1]), math.sin(heading + y[0, 1])])

    def plus(x: np.ndarray, h: np.ndarray) -> np.ndarray:
        return np.concatenate([SE2.plus(x[:3], h[:3]), SE2.plus(x[3:6], h[3:6]), x[6:] + h[6:]])

    l, L_h, _ = channel.landmark_of(m, 0, y, R, False)
    observer = channel.observer(m, 0)
    np.testing.assert_allclose(l, started(observer), atol=1e-12)
    np.testing.assert_allclose(L_h, derivative(started, observer, plus), atol=1e-6)


def test_a_ray_whose_inverse_distance_is_given_starts_there() -> None:
    m, channel, y = map_of(), channel_of(km.sensors.Bearing(0.02), landmark=RAY), np.array([[0.4]])
    channel.rho["a"] = 0.25
    starts = {id_: channel.landmark_of(m, 0, y, R[1:, 1:], False, 0, id_)[0] for id_ in ("a", "b", None)}
    assert [float(starts[id_][3]) for id_ in starts] == [0.25, RAY.prior_rho_per_m, RAY.prior_rho_per_m]


def test_a_sensor_of_depths_observes_rays_by_their_points_and_no_others_do() -> None:
    for sensor, landmark, others, right in (
        (km.sensors.RangeBearing(), POINT, [RAY], (True, True)),
        (km.sensors.RangeBearing(), POINT, [], (False, False)),
        (km.sensors.RangeBearingSignature(), km.landmarks.PointSignature2D(), [RAY], (False, False)),
        (km.sensors.Wall(), km.landmarks.Wall2D(), [RAY], (False, False)),
    ):
        channel = Channel(sensor, MOUNT, -1, landmark, lambda dof: 9.0, [landmark, *others])
        assert (RAY.kind in channel.kinds, channel.depths) == right, sensor


def test_noise_that_grows_with_the_range_is_that_of_where_the_landmark_is() -> None:
    sensor = km.sensors.RangeBearing(0.1, 0.02, sigma_range_rel=0.05)
    m, channel, slots = map_of(), channel_of(sensor), np.array([1, 2])
    model, given = channel.models["point"], np.tile(R, (2, 1, 1))
    right = [sensor.noise(np.array([[r, 0.0]]))[0] for r in (4.0, 5.0)]
    np.testing.assert_allclose(channel.noise(m, 0, model, slots, given, False), right)
    assert channel.noise(m, 0, model, slots, given, True) is given, "it came with the scan"
    assert channel_of().noise(m, 0, model, slots, given, False) is given, "it is the same everywhere"


def test_in_view_is_what_the_limits_of_the_sensor_have() -> None:
    m, slots = map_of(), [1, 2]
    for sensor, right in (
        (km.sensors.RangeBearing(0.1, 0.02, range_max_m=4.5), [0]),
        (km.sensors.RangeBearing(0.1, 0.02, range_min_m=4.5), [1]),
        (km.sensors.RangeBearing(0.1, 0.02, fov_rad=0.5), [0]),
        (km.sensors.RangeBearing(0.1, 0.02, fov_rad=2.0), [0, 1]),
    ):
        channel = channel_of(sensor)
        assert channel.in_view(m, 0, channel.models["point"], slots, [None, None]).tolist() == right


def test_a_ray_is_as_long_as_its_landmark_is_far() -> None:
    ray = np.array([[1.0, 2.5, 0.5, 0.25]])  # from its anchor 4 m along .5 rad
    end = ray[0, :2] + 4.0 * np.array([math.cos(0.5), math.sin(0.5)])
    T = np.array([3.0, 1.0, 0.3])
    np.testing.assert_allclose(landmarks_in_frame(RAY, T, ray), km.geometry.to_frame(T, end[None])[0], atol=1e-9)


def test_a_sensor_starts_landmarks_of_what_it_finds() -> None:
    plane = np.zeros(3)
    for sensor, at_once, delayed in (
        (km.sensors.RangeBearing(), "Point2D", "Point2D"),
        (km.sensors.Bearing(), "InverseDepth2D", "Point2D"),
        (km.sensors.RangeBearingSignature(), "PointSignature2D", "PointSignature2D"),
        (km.sensors.Wall(), "Wall2D", "Wall2D"),
    ):
        kinds = [type(default_landmark(sensor, plane, False, later)).__name__ for later in (False, True)]
        assert kinds == [at_once, delayed]


@pytest.mark.parametrize("dof", [1, 2, 3])
def test_95_percent_of_right_observations_count_in_full_for_huber(dof: int) -> None:
    assert huber_length(dof) ** 2 == pytest.approx(chi2.ppf(0.95, dof))


def context() -> ScanContext:
    """Return a scan of three observations, the second one of the first landmark."""
    m, tracks, channel = map_of(), Tracks(["r"]), channel_of()
    tracks.enter_block("r", 0, robot=True)
    for slot in (1, 2):
        tracks.confirm(Track(slot, POINT, slot))
    event = km.Scan(1.0, "r", "s", np.array([[9.0, 0.1], [4.3, 0.05], [5.0, 0.4]]))
    noise = np.array([k * R for k in (1.0, 2.0, 3.0)])
    report = km.Report(event, event.y)
    return ScanContext(m, tracks, Clones(), km.estimators.Ekf(), channel, 0, event, (None,) * 3, noise, report)


def test_a_scan_predicts_and_corrects_by_the_rows_that_are_asked_for() -> None:
    scan, slots = context(), np.array([1])
    model = scan.channel.models["point"]
    Z, d2, noise = scan.predict(model, slots, [1])
    right = scan.channel.predict(scan.map, 0, model, slots, scan.y[1:2], 2 * R[None])
    np.testing.assert_array_equal(Z, right[0])
    np.testing.assert_array_equal(d2, right[1])
    np.testing.assert_array_equal(noise, [2 * R])
    update = scan.update(model, slots, [1])
    np.testing.assert_array_equal(update.y, scan.y[1:2])
    np.testing.assert_array_equal(update.R, [2 * R])
    known = scan.known_update(model, LANDMARKS, [0, 2])
    np.testing.assert_array_equal(known.y, np.column_stack([scan.y[[0, 2]], LANDMARKS]))
    np.testing.assert_array_equal(known.R, [R, 3 * R])


def test_a_start_is_added_with_the_jacobian_in_the_robot_and_the_noise_of_its_row() -> None:
    scan = context()
    start, (l, L_h, Q) = scan.start_of(2), scan.channel.landmark_of(scan.map, 0, scan.y[2:], 3 * R, False)
    assert (start.space, start.parts, start.is_finite) == (POINT2, ((0, 3),), True)
    for one, right in ((start.mean, l), (start.G, L_h), (start.Q, Q)):
        np.testing.assert_allclose(one, right, atol=1e-12)
    for broken in (
        start._replace(mean=l * np.nan),
        start._replace(G=np.full_like(L_h, np.inf)),
        start._replace(Q=Q * np.nan),
    ):
        assert isinstance(broken, Start) and not broken.is_finite
