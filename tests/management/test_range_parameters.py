"""Scale and bias of a range as a part of the map: Jacobians, consistency, files, what a run says of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ModelError
from kalmark.models.observe import PythonView, linearize, linearize_chain, sensor_address, sensor_at, view_of
from kalmark.models.pointwise import jacobian
from kalmark.results.filter_description import calibrated_mounts
from kalmark.results.self_calibration import mount_figures

AT = np.array([0.3, -0.2, 0.4])
UNKNOWN = {"sigma_scale": 0.1, "sigma_bias_m": 0.3}
SENSORS = [km.sensors.Range(**UNKNOWN), km.sensors.RangeBearing(**UNKNOWN), km.sensors.RangeBearingSignature(**UNKNOWN)]


def views(sensor: Any) -> tuple[Any, Any]:
    numbers = 3 if "signature" in sensor.columns else 2
    kind = km.landmarks.PointSignature2D() if numbers == 3 else km.landmarks.Point2D()
    return view_of(sensor, kind, AT), PythonView(sensor, kind, AT, np.array(sensor.angular))


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
def test_scale_and_bias_have_the_jacobians_of_differences_compiled_and_in_python(sensor: Any) -> None:
    compiled, plain = views(sensor)
    rng = np.random.default_rng(1)
    m = len(sensor.columns)
    for _ in range(100):
        head = np.concatenate([rng.normal(size=3) * [20, 20, 2], AT + rng.normal(size=3) * 0.1, [0.93, 0.4]])
        l = head[None, :2] + rng.normal(size=(1, 2)) * 10
        if m == 3:
            l = np.hstack([l, [[2.0]]])
        y = np.zeros((1, m))
        e, z, E_h, E_l = linearize(compiled, head, l, y)
        numeric = jacobian(lambda h, l=l, y=y: plain.linearize(h, l, y)[0][0], head, sensor.angular)
        np.testing.assert_allclose(E_h[0], numeric, rtol=1e-6, atol=1e-6 * (1 + np.abs(numeric).max()))
        for one, other in zip(plain.linearize(head, l, y), (e, z, E_h, E_l), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)
        for one, other in zip(linearize_chain.py_func(compiled, head, l, y), (e, z, E_h, E_l), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)
        assert sensor_at(compiled, head, sensor_address())[1].shape == (2, 8)


@pytest.mark.parametrize("sensor", [km.sensors.RangeBearing, km.sensors.RangeBearingSignature])
def test_a_sensor_with_a_scale_undoes_its_measurement(sensor: Any) -> None:
    scaled = sensor(scale=1.07, bias_m=-0.2)
    y = np.array([[5.0, 0.3, 1.0][: len(scaled.columns)]])
    v, V_y = scaled.invert(y)
    np.testing.assert_allclose(scaled.expect(v)[0], y, atol=1e-12)
    np.testing.assert_allclose(scaled.expect(v)[1][0] @ V_y[0], np.eye(len(y[0])), atol=1e-12)


def run(seed: int, sensor: Any, estimator: Any = None, steps: int = 120) -> tuple[km.Slam, float, float, np.ndarray]:
    """Drive a circle among ten landmarks whose ranges are 6 % long and .3 m more; return truth beside the filter."""
    rng = np.random.default_rng(seed)
    scale, bias = 1 + 0.06 * rng.normal(), 0.3 * rng.normal()
    true = km.sensors.RangeBearing(scale=scale, bias_m=bias)
    motion = km.motion.Odometry2D(sigma_x_m=0.01, sigma_y_m=0.005, sigma_theta_rad=0.005)
    slam = km.Slam([km.Robot("r", motion, sensors={"s": km.Mount(sensor, at=AT)})], estimator=estimator)
    angle, away = rng.uniform(0, 2 * np.pi, 10), rng.uniform(8, 14, 10)  # around the circle of 6 m
    lm = np.column_stack([away * np.cos(angle), 6 + away * np.sin(angle)])
    r = np.zeros(3)
    for k in range(steps):
        u = np.array([0.3, 0.0, 0.05])
        slam.process(km.Control(t_s=float(k), robot="r", u=u + rng.normal(size=3) * [0.01, 0.005, 0.005]))
        r, _, _ = motion.move(r, u, 1.0)
        T, _, _ = km.geometry.compose(r, AT)
        v, _, _ = km.landmarks.Point2D().seen_from(T, lm)
        y = true.expect(v)[0] + rng.normal(size=(10, 2)) * [0.1, 0.02]
        slam.process(km.Scan(t_s=float(k), robot="r", sensor="s", y=y, ids=list(range(10))))
    return slam, scale, bias, r


def test_scale_and_bias_of_a_laser_are_estimated_consistently() -> None:
    d2 = []
    for seed in range(40):
        slam, scale, bias, _ = run(seed, km.sensors.RangeBearing(sigma_scale=0.06, sigma_bias_m=0.3), steps=60)
        d = slam.mean("r.s")[3:] - np.array([1, bias]) / scale
        d2.append(d @ np.linalg.solve(slam.covariance("r.s")[3:, 3:], d))
    assert 1.2 < np.mean(d2) < 3.0  # 2 for a consistent filter; its mean over 40 runs has a sigma of .32
    assert np.sqrt(slam.covariance("r.s")[3, 3]) < 0.02  # of .06
    np.testing.assert_array_equal(slam.mean("r.s")[:3], AT)  # the mount itself is known


def test_parameters_in_the_map_resume_bit_for_bit_and_are_told_of(tmp_path: Path) -> None:
    slam, *_ = run(1, km.sensors.RangeBearing(**UNKNOWN), steps=20)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    scan = km.Scan(t_s=19.0, robot="r", sensor="s", y=[[7.0, 0.1]], ids=[3])
    for each in (slam, again):
        each.process(scan)
    np.testing.assert_array_equal(again.mean("r.s"), slam.mean("r.s"))
    np.testing.assert_array_equal(again.covariance("r", "r.s", 3), slam.covariance("r", "r.s", 3))
    figures = mount_figures(calibrated_mounts(slam)[0])
    assert figures["scale"] == pytest.approx(1 / slam.mean("r.s")[3], rel=1e-15)
    assert figures["bias_m"] == pytest.approx(slam.mean("r.s")[4] / slam.mean("r.s")[3], rel=1e-15)
    assert {row["unit"] for row in figures["directions"]} == {"", "m"}
    sigmas = np.sqrt(np.diag(slam.covariance("r.s")))
    assert [figures["sigma_x_m"], figures["sigma_y_m"]] == pytest.approx(sigmas[:2].tolist(), rel=1e-12)


def test_a_scale_is_not_estimated_with_an_exact_prior_and_never_zero() -> None:
    slam, *_ = run(1, km.sensors.RangeBearing(scale=1.069), steps=3)
    assert "r.s" not in slam.tracks.slots
    with pytest.raises(ModelError, match=r"scale is 0\.0, expected a positive number"):
        km.sensors.Range(scale=0.0)
    with pytest.raises(ModelError, match="sigma_scale is -1"):
        km.sensors.Range(sigma_scale=-1.0)
