"""What a sensor should measure of each landmark, asked without a scan."""

from __future__ import annotations

import zipfile
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError
from kalmark.geometry.frames import compose
from kalmark.geometry.gaussian import ellipse, ellipses
from kalmark.models.pointwise import jacobian
from kalmark.report import Expectations

RNG = np.random.default_rng(3)
PLACES = {1: (3.0, 0.5), 2: (-2.0, 1.0), 3: (2.0, -2.0), 4: (20.0, 0.0), 5: (4.0, 3.0)}
LASER = km.sensors.RangeBearing(0.1, 0.02, range_max_m=8.0, fov_rad=np.radians(200.0))
AT = (0.3, 0.1, 0.2)


def mapped(laser: Any = LASER, mount_cov: Any = None, **of_slam: Any) -> km.Slam:
    """Return a filter that has observed the places, from its start."""
    laser = km.Mount(laser, at=AT, cov=mount_cov)
    cov = np.diag([0.1, 0.2, 0.05]) ** 2
    rover = km.Robot("rover", km.motion.Odometry2D(0.01, 0.01, 0.01), (0.1, 0.2, 0.3), {"laser": laser}, cov=cov)
    slam = km.Slam([rover], **of_slam)
    T = compose(np.array([0.1, 0.2, 0.3]), np.array(AT))[0]
    y = km.geometry.observe(T, np.array([*PLACES.values()]))[0]
    slam.process(km.Scan(t_s=0.0, robot="rover", sensor="laser", y=y[:, : len(laser.sensor.columns)], ids=[*PLACES]))
    slam.process(km.Control(t_s=0.1, robot="rover", u=(0.1, 0.0, 0.05)))
    return slam


@pytest.mark.parametrize("map_type", ["dense", "postponed"])
@pytest.mark.parametrize("mount_cov", [None, np.diag([0.01, 0.01, 0.01])])
def test_expectations_are_those_of_the_correction(map_type: str, mount_cov: Any) -> None:
    slam = mapped(mount_cov=mount_cov, map=map_type)
    found = slam.expect("rover", "laser")
    y = found.e + RNG.normal(size=found.e.shape) * 0.01
    report = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="laser", y=y, ids=found.names))
    assert found.e == pytest.approx(report.e, abs=1e-12)
    assert pytest.approx(report.Z, abs=1e-12) == found.Z


def test_view_and_reasons() -> None:
    found = mapped().expect("rover", "laser", [1, 2, 4])
    assert found.in_view.tolist() == [True, False, False]
    assert found.why[0] == ""
    assert "off the axis" in found.why[1]
    assert found.why[2].endswith("farther than 8 m")
    assert found.row(4) == 2
    with pytest.raises(MapError, match="3 is not among the 3"):
        found.row(3)


def test_jacobians_against_differences() -> None:
    slam = mapped()
    found, r = slam.expect("rover", "laser"), slam.mean("rover")

    def expected(numbers: Any, l: Any) -> Any:
        return km.geometry.observe(compose(numbers[:3], numbers[3:])[0], np.array([l]))[0][0]

    for i, name in enumerate(found.names):
        l = slam.mean(name)
        E = jacobian(lambda x, l=l: expected(x, l), np.concatenate([r, AT]), (False, True))
        assert found.E_r[i] == pytest.approx(E[:, :3], abs=1e-6)
        assert found.E_s[i] == pytest.approx(E[:, 3:], abs=1e-6)
        E_l = jacobian(lambda x: expected(np.concatenate([r, AT]), x), l, (False, True))
        assert found.E_l[i] == pytest.approx(E_l, abs=1e-6)


def test_an_own_sensor_and_noise_that_grows_with_the_range() -> None:
    own = km.pointwise(lambda v: [np.hypot(v[0], v[1]), np.arctan2(v[1], v[0])], np.diag([0.01, 0.0004]),
                       inverse=lambda y: [y[0] * np.cos(y[1]), y[0] * np.sin(y[1])], angular=(False, True))  # fmt: skip
    for laser in (own, km.sensors.RangeBearing(0.05, 0.02, sigma_range_rel=0.1)):
        slam = mapped(laser)
        found = slam.expect("rover", "laser")
        assert found.in_view.all()
        report = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="laser", y=found.e, ids=found.names))
        assert pytest.approx(report.Z, abs=1e-10) == found.Z


def test_ellipses_are_those_of_the_guide() -> None:
    found = mapped().expect("rover", "laser")
    for contour, e, Z in zip(found.ellipses(3.0, 16), found.e, found.Z, strict=True):
        axes = np.linalg.cholesky(Z)
        assert np.linalg.norm(np.linalg.solve(axes, (contour - e).T), axis=0) == pytest.approx(3.0)
        assert np.linalg.norm(np.linalg.solve(axes, (ellipse(e, Z, 3.0) - e).T), axis=0) == pytest.approx(3.0)
    assert np.isnan(ellipses(np.full((1, 2), np.nan), np.eye(2)[None])).all()
    with pytest.raises(MapError, match="expected two columns"):
        found.ellipses(axes=(0, 2))


def test_asking_changes_nothing(tmp_path: Any) -> None:
    slam = mapped(map="postponed")
    slam.save(tmp_path / "before.kmk")
    slam.expect("rover", "laser")
    slam.save(tmp_path / "after.kmk")
    before, after = (zipfile.ZipFile(tmp_path / f"{name}.kmk") for name in ("before", "after"))
    assert before.namelist() == after.namelist()
    assert all(before.read(name) == after.read(name) for name in before.namelist())


def test_odd_questions_are_refused() -> None:
    slam = mapped(mount_cov=np.eye(3) * 0.01)
    for args, words in (
        (("rover", "sonar"), "has no sensor 'sonar', expected one of: 'rover' 'laser'"),
        (("rover", "laser", [7]), "7 is not in the map"),
        (("rover", "laser", ["rover.laser"]), "mount or a control's bias"),
    ):
        with pytest.raises(MapError, match=words):
            slam.expect(*args)  # type: ignore[arg-type]
    assert slam.expect("rover", "laser", ["rover"]).why == ("a robot does not observe itself",)
    assert len(slam.expect("rover", "laser", [])) == 0


def test_what_is_in_view_may_be_asked_before_each_scan() -> None:
    slam = mapped()
    asked: list[Expectations] = []
    slam.before_scan = lambda robot, sensor: asked.append(slam.expect(robot, sensor, in_view=True))
    before = slam.expect("rover", "laser")
    slam.process(km.Scan(t_s=0.1, robot="rover", sensor="laser", y=before.e[:1], ids=before.names[:1]))
    assert asked[0].names == (1, 3, 5)
    rows = [before.row(name) for name in asked[0].names]
    assert pytest.approx(before.Z[rows], abs=1e-15) == asked[0].Z
