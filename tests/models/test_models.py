"""Models: every Jacobian against differences, the compiled seam against the written-out one, limits, noise."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ModelError
from kalmark.models.observe import (
    PythonView,
    expectation,
    inverse_expectation,
    linearize,
    view_of,
)
from kalmark.models.pointwise import jacobian

SE2_ANGLES = (False, False, True)
MOTIONS = [km.motion.Odometry2D(), km.motion.Unicycle(), km.motion.Ackermann(), km.motion.Ackermann(1.0, 0.0)]
SENSORS = [
    km.sensors.RangeBearing(),
    km.sensors.Bearing(),
    km.sensors.Range(),
    km.sensors.Position2D(),
    km.sensors.RangeBearingSignature(),
]
PLACING = [s for s in SENSORS if getattr(s, "finds_depth", hasattr(s, "invert"))]
DRAWS = 200


def close(analytic: np.ndarray, numeric: np.ndarray) -> None:
    np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-6 * (1 + np.abs(numeric).max()))


@pytest.mark.parametrize("motion", MOTIONS, ids=repr)
def test_a_motion_has_the_jacobians_of_its_differences(motion: km.motion.Unicycle) -> None:
    rng = np.random.default_rng(1)
    for i in range(DRAWS):
        r = rng.normal(size=3) * [20, 20, 3]
        u = rng.normal(size=len(motion.columns)) * 0.5
        u[i % len(u)] *= 10.0 ** -(i % 9)  # towards both limits of the arc
        _, R_r, R_u = motion.move(r, u, 0.7)
        close(R_r, jacobian(lambda x, u=u: motion.move(x, u, 0.7)[0], r, SE2_ANGLES))
        close(R_u, jacobian(lambda x, r=r: motion.move(r, x, 0.7)[0], u, SE2_ANGLES))


def test_the_unicycles_arc_has_both_its_limits() -> None:
    unicycle, r = km.motion.Unicycle(), np.array([1.0, 2.0, 0.4])
    straight = unicycle.move(r, np.array([2.0, 0.0]), 0.5)[0]
    np.testing.assert_allclose(straight, [1 + np.cos(0.4), 2 + np.sin(0.4), 0.4], atol=1e-15)
    np.testing.assert_allclose(unicycle.move(r, np.array([2.0, 1e-9]), 0.5)[0], straight, atol=1e-8)
    np.testing.assert_allclose(unicycle.move(r, np.array([0.0, 0.6]), 0.5)[0], [1, 2, 0.7], atol=1e-15)
    v, w, dt = 2.0, 0.6, 0.5  # Forsyth: R (sin(theta + dtheta) - sin theta), with R = v / w
    arc = [1 + v / w * (np.sin(0.4 + w * dt) - np.sin(0.4)), 2 - v / w * (np.cos(0.4 + w * dt) - np.cos(0.4)), 0.7]
    np.testing.assert_allclose(unicycle.move(r, np.array([v, w]), dt)[0], arc, atol=1e-14)


def test_ackermann_turns_as_victoria_parks_geometry_says() -> None:
    v, steering, dt = 3.0, 0.2, 1e-6
    moved = km.motion.Ackermann().move(np.zeros(3), np.array([v, steering]), dt)[0] / dt
    v_axle = v / (1 - np.tan(steering) * 0.76 / 2.83)
    np.testing.assert_allclose(moved[[0, 2]], [v_axle, v_axle * np.tan(steering) / 2.83], rtol=1e-6)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
def test_a_sensor_on_its_mount_has_the_jacobians_of_its_differences(sensor: km.sensors.RangeBearing) -> None:
    rng = np.random.default_rng(2)
    landmark = km.landmarks.PointSignature2D() if "signature" in sensor.columns else km.landmarks.Point2D()
    size = landmark.space.size
    for i in range(DRAWS):
        r, mount = rng.normal(size=3) * [20, 20, 3], rng.normal(size=3)
        l = rng.normal(size=(1, size)) * 10.0 ** (1 - i % 4)
        _, E_r, E_s, E_l = expectation(r, mount, sensor, landmark, l)
        close(E_r[0], jacobian(lambda x: expectation(x, mount, sensor, landmark, l)[0][0], r, sensor.angular))
        close(E_s[0], jacobian(lambda x: expectation(r, x, sensor, landmark, l)[0][0], mount, sensor.angular))
        close(E_l[0], jacobian(lambda x: expectation(r, mount, sensor, landmark, x[None])[0][0], l[0], sensor.angular))


@pytest.mark.parametrize(
    "sensor", [s for s in SENSORS if getattr(s, "finds_depth", hasattr(s, "invert"))], ids=lambda s: type(s).__name__
)
def test_a_full_sensor_undoes_its_measurement_and_has_the_jacobians_of_its_differences(
    sensor: km.sensors.RangeBearing,
) -> None:
    rng = np.random.default_rng(3)
    landmark = km.landmarks.PointSignature2D() if "signature" in sensor.columns else km.landmarks.Point2D()
    for _ in range(DRAWS):
        r, mount = rng.normal(size=3) * [20, 20, 3], rng.normal(size=3)
        y = np.abs(rng.normal(size=(1, len(sensor.columns)))) + 0.05
        l, L_r, L_s, L_y, _ = inverse_expectation(r, mount, sensor, landmark, y)
        np.testing.assert_allclose(expectation(r, mount, sensor, landmark, l)[0], y, atol=1e-9)
        close(L_r[0], jacobian(lambda x: inverse_expectation(x, mount, sensor, landmark, y)[0][0], r))
        close(L_s[0], jacobian(lambda x: inverse_expectation(r, x, sensor, landmark, y)[0][0], mount))
        close(L_y[0], jacobian(lambda x: inverse_expectation(r, mount, sensor, landmark, x[None])[0][0], y[0]))


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
def test_the_compiled_seam_equals_the_written_out_one(sensor: km.sensors.RangeBearing) -> None:
    rng = np.random.default_rng(4)
    landmark = km.landmarks.PointSignature2D() if "signature" in sensor.columns else km.landmarks.Point2D()
    r, mount, l = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(6, landmark.space.size))
    e, E_r, _, E_l = expectation(r, mount, sensor, landmark, l)
    view = view_of(sensor, landmark, mount)
    assert isinstance(view, tuple), "built-in models take the compiled way"
    ours_e, _, *Jacobians = linearize(view, r, l, e)
    for ours, written in zip((ours_e, *Jacobians), (e, E_r, E_l), strict=True):
        np.testing.assert_allclose(ours, written, atol=1e-13)
    written_out = PythonView(sensor, landmark, mount, np.array(sensor.angular))
    for ours, plain in zip(linearize(view, r, l, e), written_out.linearize(r, l, e), strict=True):
        np.testing.assert_allclose(ours, plain, atol=1e-13)


@pytest.mark.parametrize("mounted", [False, True])
def test_ranges_and_bearings_of_points_worked_out_equal_the_chain_rule(mounted: bool) -> None:
    rng = np.random.default_rng(6)
    sensor = km.sensors.RangeBearing(scale=1.07, bias_m=-0.2)
    for _ in range(100):
        mount = rng.normal(size=3)
        view, head = view_of(sensor, km.landmarks.Point2D(), mount), rng.normal(size=6 if mounted else 3) * 3.0
        written_out = PythonView(sensor, km.landmarks.Point2D(), mount, np.array(sensor.angular))
        l, y = rng.normal(size=(5, 2)) * 5.0, rng.normal(size=(5, 2)) * 4.0
        for ours, plain in zip(linearize(view, head, l, y), written_out.linearize(head, l, y), strict=True):
            np.testing.assert_allclose(ours, plain, rtol=1e-12, atol=1e-12)


def test_range_noise_grows_with_range() -> None:
    R = km.sensors.RangeBearing(sigma_range_m=0.1, sigma_range_rel=0.08).noise(np.array([[0.0, 0], [5.0, 0]]))
    np.testing.assert_allclose(R[:, 0, 0], [0.01, 0.01 + 0.16])
    assert km.sensors.Range(0.1, sigma_range_rel=0.08).noise(np.array([[5.0]]))[0, 0, 0] == pytest.approx(0.17)


def test_a_sensor_sees_within_its_range_and_field_of_view() -> None:
    sensor = km.sensors.RangeBearing(range_min_m=1, range_max_m=5, fov_rad=np.pi / 2)
    v = np.array([[0.5, 0], [2, 0], [6, 0], [2, 1.9], [2, 2.1], [-2, 0]])
    assert sensor.sees(v).tolist() == [False, True, False, True, False, False]


def test_diffusion_acts_while_the_control_is_not_zero() -> None:
    motion = km.motion.Unicycle(0, 0, sigma_along_m_per_sqrt_s=0.3, sigma_theta_rad_per_sqrt_s=0.1)
    np.testing.assert_allclose(motion.diffusion(np.array([1.0, 0]), 0.5), np.diag([0.045, 0, 0.005]))
    assert motion.diffusion(np.zeros(2), 0.5) is None


@pytest.mark.parametrize("model", [km.motion.Unicycle, km.sensors.RangeBearing])
def test_a_negative_sigma_is_refused(model: type) -> None:
    with pytest.raises(ModelError, match=r"expected a (number of at least 0|positive number)"):
        model(-0.1)


def test_a_pointwise_sensor_equals_the_built_in_one() -> None:
    R = np.diag([0.01, 4e-4])
    mine = km.pointwise(
        lambda v: np.array([np.hypot(*v), np.arctan2(v[1], v[0])]),
        R,
        inverse=lambda y: y[0] * np.array([np.cos(y[1]), np.sin(y[1])]),
        angular=(False, True),
    )
    ours, v = km.sensors.RangeBearing(0.1, 0.02), np.array([[2.0, 1.0], [-3.0, -1e-12]])
    for a, b in zip(mine.expect(v), ours.expect(v), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
    for a, b in zip(mine.invert(ours.expect(v)[0]), ours.invert(ours.expect(v)[0]), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
    np.testing.assert_allclose(mine.noise(v), ours.noise(v))


def test_noise_inside_the_measurement_is_carried_out_by_its_jacobian() -> None:
    sensor = km.pointwise(lambda v, n: np.array([np.hypot(*v) * (1 + n[0])]), [[0.04]], noise_inside=True)
    np.testing.assert_allclose(sensor.noise_at(np.array([[3.0, 4.0]])), [[[25 * 0.04]]], rtol=1e-8)
    np.testing.assert_allclose(sensor.expect(np.array([[3.0, 4.0]]))[0], [[5.0]])
