"""Polar points: started by sensors whose bearings are so poor that what they see is an arc.  [S] 2.3.5."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from differences import derivative
from kalmark.campaign import run_campaign
from kalmark.errors import ModelError
from kalmark.models.landmarks import Point2D, Polar2D
from kalmark.simulate import load_world, simulate

POLAR = Polar2D()
START = np.array([1.0, -2.0, 0.7])
L = np.array([0.5, -0.4, 2.1, 3.2])
SONAR = km.presets.SONAR.sensor


def robot(**sensors: Any) -> km.Robot:
    motion = km.motion.Odometry2D(0.01, 0.01, 0.005)
    mounts = {name: km.Mount(sensor, at=(0.1, 0.0, 0.2)) for name, sensor in sensors.items()}
    return km.Robot("robot", motion, start=START, cov=np.diag([0.1, 0.1, 0.2]) ** 2, sensors=mounts)


def events(steps: int = 60) -> list[Any]:
    return list(simulate(load_world("sonar", [f"steps={steps}"]), seed=2).events)


def run(slam: km.Slam, some: list[Any]) -> km.Slam:
    for event in some:
        slam.process(event)
    return slam


def test_the_jacobians_of_a_polar_point_are_those_of_differences() -> None:
    v, V_T, V_l = (a[0] for a in POLAR.seen_from(START, L[None]))
    np.testing.assert_allclose(V_T, derivative(lambda T: POLAR.seen_from(T, L[None])[0][0], START), atol=1e-8)
    np.testing.assert_allclose(V_l, derivative(lambda l: POLAR.seen_from(START, l[None])[0][0], L), atol=1e-8)
    np.testing.assert_allclose(
        POLAR.to_point(L[None])[1][0], derivative(lambda l: POLAR.to_point(l[None])[0][0], L), atol=1e-8
    )
    l, L_T, L_v = (a[0] for a in POLAR.from_view(START, v[None]))
    np.testing.assert_allclose(POLAR.to_point(l[None])[0], POLAR.to_point(L[None])[0], atol=1e-12)
    np.testing.assert_allclose(L_T, derivative(lambda T: POLAR.from_view(T, v[None])[0][0], START), atol=1e-8)
    np.testing.assert_allclose(L_v, derivative(lambda w: POLAR.from_view(START, w[None])[0][0], v), atol=1e-8)


def test_a_sensor_of_wide_bearings_starts_polar_points_and_others_see_them() -> None:
    slam = km.Slam([robot(sonar=SONAR, laser=km.presets.LASER.sensor)])
    slam.process(km.Scan(t_s=0.0, robot="robot", sensor="sonar", y=[[3.0, 0.1]], ids=[1]))
    slam.process(km.Scan(t_s=0.0, robot="robot", sensor="laser", y=[[2.0, 0.1]], ids=[2]))
    assert slam.landmark_model(1) == POLAR
    assert slam.landmark_model(2) == Point2D()
    seen = slam.process(km.Scan(t_s=0.1, robot="robot", sensor="laser", y=[[3.0, 0.15]], ids=[1]))
    assert seen.observations[0].outcome == "associated"
    seen = slam.process(km.Scan(t_s=0.1, robot="robot", sensor="sonar", y=[[2.0, 0.0]], ids=[2]))
    assert seen.observations[0].outcome == "associated"


def test_an_arc_that_has_become_short_is_made_a_point() -> None:
    mount = km.Mount(SONAR, at=(0.1, 0.0, 0.2))
    slam = km.Slam([km.Robot("robot", km.motion.Odometry2D(), start=START, sensors={"sonar": mount})])
    scans = 0
    while slam.landmark_model(1) != Point2D() and scans < 10_000:
        slam.process(km.Scan(t_s=0.1 * scans, robot="robot", sensor="sonar", y=[[3.0, 0.1]], ids=[1]))
        scans += 1
    sigma_rad = (
        np.pi / 180 * 55 / np.sqrt(12 * scans)
    )  # the arc is 3 m sigma^2 / 2 off its tangent, in sigmas of a range
    np.testing.assert_allclose(1.5 * sigma_rad**2 / (0.04 / np.sqrt(scans)), 0.03, rtol=0.01)


def test_a_sonar_is_consistent_with_polar_points_and_not_with_euclidean_ones() -> None:
    runs = 12
    anees = {}
    for kind in ("polar", "point"):
        world = load_world("sonar", ["steps=80", f"filter.landmarks={{type: {kind}}}"])
        figures = run_campaign(world, runs, jobs=1, progress=False).summary()["estimators"]["invariant"]
        anees[kind] = figures["pose_anees"], figures["landmarks_anees"]
    assert anees["polar"][0] < chi2.ppf(0.99, 3 * runs) / runs
    assert anees["polar"][1] < chi2.ppf(0.99, 2 * runs) / runs
    assert anees["point"][1] > 2 * anees["polar"][1]


def test_turning_the_world_turns_polar_points() -> None:
    turn, some = 1.1, events(30)
    here = run(km.Slam([robot(sonar=SONAR)]), some)
    space = here.robots["robot"].motion.space
    turned = km.Robot("robot", here.robots["robot"].motion, start=space.rotated(START, turn),
                      cov=np.diag([0.1, 0.1, 0.2]) ** 2, sensors=here.robots["robot"].sensors)  # fmt: skip
    there = run(km.Slam([turned]), some)
    names = here.landmarks().ids
    assert [here.landmark_model(name) for name in names].count(POLAR) > 2
    for name in ("robot", *names):
        model = space if name == "robot" else here.landmark_model(name).space  # type: ignore[union-attr]
        np.testing.assert_allclose(model.minus(model.rotated(here.mean(name), turn), there.mean(name)), 0, atol=1e-6)


def test_the_postponed_map_and_a_saved_one_have_the_same_polar_points(tmp_path: Path) -> None:
    some = events()
    dense, postponed = (run(km.Slam([robot(sonar=SONAR)], map=map_), some) for map_ in ("dense", "postponed"))
    half = run(km.Slam([robot(sonar=SONAR)], map="dense"), some[:50])
    half.save(tmp_path / "map.kmk")
    resumed = run(km.Slam.load(tmp_path / "map.kmk"), some[50:])
    names = ["robot", *dense.landmarks().ids]
    np.testing.assert_array_equal(resumed.covariance(*names), dense.covariance(*names))
    np.testing.assert_allclose(postponed.covariance(*names), dense.covariance(*names), atol=1e-8)


@pytest.mark.parametrize("sensor", [km.sensors.Range(), km.sensors.Bearing(), km.sensors.Position2D()])
def test_polar_points_are_for_ranges_with_bearings(sensor: Any) -> None:
    with pytest.raises(ModelError, match=r"polar.*expected|expected.*polar"):
        km.Slam([robot(s=sensor)], landmarks=POLAR)
