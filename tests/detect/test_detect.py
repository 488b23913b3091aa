"""Detectors on simulated scans: what is there is found, nothing else, without bias, with covariances that are met."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.detect import Corners, Detections, Reflectors, Trunks, Walls
from kalmark.detect.laser_scan import Laser
from kalmark.geometry.angles import wrap
from laser_worlds import ANGLES, FAR_M, SIGMA_M, LaserWorld, spread


def polar(p: np.ndarray, *more: object) -> np.ndarray:
    """Return range and bearing of points (K, 2), and other columns."""
    return np.column_stack([np.hypot(*p.T), np.arctan2(p[:, 1], p[:, 0]), *more])


def trunks(random: np.random.Generator, far_m: float = 20.0) -> tuple[LaserWorld, np.ndarray]:
    p, radius = spread(random, 10, 3, far_m, np.pi * 0.95), random.uniform(0.1, 0.5, 10)
    return LaserWorld(circles=np.column_stack([p, radius, np.ones(10)])), polar(p, radius)


def reflectors(random: np.random.Generator) -> tuple[LaserWorld, np.ndarray]:
    p = spread(random, 8, 2, 10, np.pi * 0.95)
    posts = np.column_stack([p, np.full(8, 0.05), np.full(8, 5.0)])
    wall = np.array([[15.0, -30.0, 15.0, 30.0]])
    return LaserWorld(posts, wall), polar(p)


def room(random: np.random.Generator) -> tuple[LaserWorld, np.ndarray]:
    turn, wide = random.uniform(-0.2, 0.2), random.uniform(3, 8)
    left, right = wide * random.uniform(0.5, 1.5, 2)
    c, s = math.cos(turn), math.sin(turn)
    corners = np.array([[-5, left], [wide, left], [wide, -right], [-5, -right]]) @ np.array([[c, s], [-s, c]])
    return LaserWorld(walls=np.hstack([corners[:-1], corners[1:]])), polar(corners[1:3], np.full(2, np.pi / 2))


def box(random: np.random.Generator) -> tuple[LaserWorld, np.ndarray]:
    p, turn = random.uniform(3, 6) * np.array([1.0, 0.0]), random.uniform(0.5, 1.07)
    u, v = np.array([math.cos(turn), math.sin(turn)]), np.array([math.sin(turn), -math.cos(turn)])
    walls = np.array([np.r_[p, p + 1.8 * u], np.r_[p, p + 2 * v]])
    return LaserWorld(walls=walls), polar(p[None], [1.5 * np.pi])


def scored(detector: Any, make: Any, scans: int, seed: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return errors, covariances, and the rates of what was missed and of what is not there."""
    random, errors, covs, missed, false, count = np.random.default_rng(seed), [], [], 0, 0, 0
    for _ in range(scans):
        world, truth = make(random)
        found = _look(detector, world, random)
        here, there = (np.stack([y[:, 0] * np.cos(y[:, 1]), y[:, 0] * np.sin(y[:, 1])], 1) for y in (found.y, truth))
        used = set()
        for k, p in enumerate(here):
            d = np.linalg.norm(there - p, axis=1)
            j = int(np.argmin(d)) if len(d) else -1
            if j < 0 or d[j] > 0.5 or j in used:
                false += 1
                continue
            used.add(j)
            e = found.y[k] - truth[j]
            e[1] = wrap(e[1])
            errors.append(e)
            covs.append(found.cov[k])
        missed, count = missed + len(truth) - len(used), count + len(truth)
    return np.array(errors), np.array(covs), missed / count, false / count


def _look(detector: Any, world: LaserWorld, random: np.random.Generator) -> Detections:
    r, light = world.scan(ANGLES, SIGMA_M, random)
    return detector.detect(r, ANGLES, light)


CASES = {
    "trunks to 10 m": (Trunks(range_max_m=80, beams=1), lambda g: trunks(g, 10.0), 0.01),
    "trunks to 20 m": (Trunks(range_max_m=80, beams=1), trunks, 0.01),
    "trunks to 35 m": (Trunks(range_max_m=80, beams=1), lambda g: trunks(g, 35.0), 0.02),
    "reflectors": (Reflectors(range_max_m=80, radius_m=0.05, intensity_min=2), reflectors, 0.01),
    "corners of rooms": (Corners(range_max_m=80), room, 0.02),
    "corners of boxes": (Corners(range_max_m=80), box, 0.02),
}


@pytest.mark.parametrize("name", CASES)
def test_detections_meet_their_covariances_and_nothing_is_made_up(name: str) -> None:
    detector, make, missing = CASES[name]
    e, P, missed, false = scored(detector, make, 150, seed=7)
    sigma = np.sqrt(np.einsum("kii->ki", P))
    assert missed <= missing
    assert false <= 0.02
    assert np.abs(np.mean(e / sigma, axis=0)).max() < 0.45  # a grazed edge makes a trunk .2 sigma thinner
    nees = np.einsum("ki,ki->k", e, np.linalg.solve(P, e[:, :, None])[:, :, 0]) / e.shape[1]
    assert 0.7 < nees.mean() < 1.25
    assert (np.std(e / sigma, axis=0) > 0.75).all()
    assert (np.std(e / sigma, axis=0) < 1.2).all()


def test_walls_meet_their_covariances() -> None:
    random, errors, covs = np.random.default_rng(3), [], []
    for _ in range(100):
        p, n = random.uniform(2, 8), random.uniform(-1, 1)
        c, s = math.cos(n), math.sin(n)
        ends = p * np.array([c, s]) + np.array([[-3], [3]]) * np.array([-s, c])
        r, _ = LaserWorld(walls=ends.reshape(1, 4)).scan(ANGLES, SIGMA_M, random)
        found = Walls(range_max_m=80).detect(r, ANGLES)
        assert len(found) == 1
        assert found.attributes["length_m"][0] > 4
        errors.append(found.y[0, :2] - [p, n])
        assert found.y[0, 3] - found.y[0, 2] == pytest.approx(found.attributes["length_m"][0])
        covs.append(found.cov[0])
    e, P = np.array(errors), np.array(covs)
    nees = np.einsum("ki,ki->k", e, np.linalg.solve(P, e[:, :, None])[:, :, 0]) / 2
    assert 0.7 < nees.mean() < 1.3


def test_a_trunk_behind_another_is_left_out_for_its_edge_is_not_its_own() -> None:
    near, far = [8.0, 0.0, 0.3, 1.0], [14.0, 0.5, 0.4, 1.0]
    r, _ = LaserWorld(circles=np.array([near, far])).scan(ANGLES, SIGMA_M, np.random.default_rng(1))
    found = Trunks(range_max_m=80).detect(r, ANGLES)
    assert found.y[:, 0] == pytest.approx([8.0], abs=0.1)


def test_a_wall_is_no_trunk_and_a_trunk_no_corner() -> None:
    world = LaserWorld(np.array([[10.0, 5.0, 0.5, 1.0]]), np.array([[8.0, -6.0, 8.0, -1.0]]))
    r, _ = world.scan(ANGLES, SIGMA_M, np.random.default_rng(1))
    assert len(Trunks(range_max_m=80).detect(r, ANGLES)) == 1
    assert len(Corners(range_max_m=80).detect(r, ANGLES)) == 0


def test_no_return_may_be_zero_far_infinite_or_left_out() -> None:
    world, _ = trunks(np.random.default_rng(5))
    r, _ = world.scan(ANGLES, SIGMA_M, np.random.default_rng(6))
    detector, far = Trunks(range_max_m=80), r >= FAR_M
    wanted = detector.detect(r, ANGLES)
    for value in (0.0, np.inf, np.nan):
        assert np.array_equal(detector.detect(np.where(far, value, r), ANGLES).y, wanted.y)
    keep = ~far
    keep[[0, -1]] = True
    assert np.allclose(detector.detect(r[keep], ANGLES[keep]).y, wanted.y, atol=1e-9)


def test_what_is_added_stands_in_the_covariance() -> None:
    world, _ = trunks(np.random.default_rng(5))
    r, _ = world.scan(ANGLES, SIGMA_M, np.random.default_rng(6))
    bare = Trunks(range_max_m=80).detect(r, ANGLES)
    more = Trunks(range_max_m=80, sigma_position_m=0.2, sigma_bearing_rad=0.01).detect(r, ANGLES)
    added = np.array([0.04 + 0 * bare.y[:, 0], 0.04 / bare.y[:, 0] ** 2 + 1e-4, 0.04 + 0 * bare.y[:, 0]])
    assert np.allclose(np.einsum("kii->ik", more.cov - bare.cov), added)


@pytest.mark.parametrize(
    ("ranges", "angles", "message"),
    [
        ([1.0, 2.0], [0.0, 0.1], "ranges has shape"),
        ([1.0, 2.0, 3.0], [0.0, 0.1], "angles has shape"),
        ([1.0, -2.0, 3.0], [0.0, 0.1, 0.2], "range 1 is -2.0 m, expected at least 0"),
        ([1.0, 2.0, 3.0], [0.0, 0.2, 0.1], "angle 2 is 0.1 after 0.2 rad, expected increasing angles"),
        ([1.0, 2.0, 3.0], [0.0, 4.0, 8.0], "the angles go from 0 to 8 rad, expected one turn, 2 pi, at most"),
    ],
)
def test_bad_beams_are_refused_with_what_is_wrong(ranges: list, angles: list, message: str) -> None:
    with pytest.raises(km.KalmarkError, match=message):
        Trunks().detect(ranges, angles)


@pytest.mark.parametrize("detector", [Trunks(), Reflectors(), Walls(), Corners()])
@pytest.mark.parametrize("n", [3, 6])
def test_in_a_few_beams_that_are_far_apart_there_is_nothing(detector: Laser, n: int) -> None:
    y = np.column_stack([np.full(n, 3.0), np.arange(n) * np.radians(60), np.full(n, 9.0)])
    assert len(detector.detect(*y.T)) == 0
    sensor = km.sensors.Wall() if type(detector) is Walls else km.sensors.RangeBearing()
    slam = km.Slam(km.Robot("r", km.motion.Odometry2D(), sensors={"laser": km.Mount(sensor, detector=detector)}))
    assert slam.process(km.Scan(1.0, "r", "laser", y)).observations == ()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Trunks(beams="3"), "Trunks: beams is '3', expected a whole number of at least 1"),
        (lambda: Walls(beams=2.5), "Walls: beams is 2.5, expected a whole number of at least 1"),
        (lambda: Trunks(beams=0), "Trunks: beams is 0, expected a whole number of at least 1"),
        (lambda: Trunks(sigma_range_m="fine"), "Trunks: sigma_range_m is 'fine', expected a number"),
        (lambda: Trunks(range_max_m=None), "Trunks: range_max_m is None, expected a number"),
        (lambda: Trunks(range_max_m=math.nan), "Trunks: range_max_m is nan, expected a positive number"),
        (lambda: Corners(gap_m=-0.1), "Corners: gap_m is -0.1, expected a number of at least 0"),
        (lambda: Walls(jump_m=math.inf), "Walls: jump_m is inf, expected a finite number"),
        (lambda: Corners(bend_deg=120), "Corners: bend_deg is 120, expected a number between 0 and 90"),
        (lambda: Reflectors(signature="yes"), "Reflectors: signature is 'yes', expected True or False"),
        (lambda: km.detect.Tags(family=["36h11"]), r"Tags: family is \['36h11'\], expected one of"),
        (lambda: km.detect.Tags(size_m="0.1"), "Tags: size_m is '0.1', expected a number"),
    ],
)
def test_a_parameter_that_a_detector_cannot_have_is_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(km.errors.ModelError, match=message):
        make()


def test_parameters_may_be_numbers_of_numpy_and_limits_infinite() -> None:
    assert Trunks(beams=np.int64(3), sigma_range_m=np.float32(0.1), radius_max_m=math.inf).beams == 3  # type: ignore[arg-type]


def test_reflectors_without_intensities_and_bad_parameters_are_refused() -> None:
    with pytest.raises(km.KalmarkError, match="the beams have no intensities"):
        Reflectors().detect([1.0, 2.0, 3.0], [0.0, 0.1, 0.2])
    with pytest.raises(km.KalmarkError, match="Trunks: roughness_m is -1, expected a positive number"):
        Trunks(roughness_m=-1)
    with pytest.raises(km.KalmarkError, match="Walls: incidence_deg is 0, expected a number between 0 and 90"):
        Walls(incidence_deg=0)
