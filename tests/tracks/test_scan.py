"""A scan with the map it is compared with: rows, the block behind the pose, robust weights, classes, sizes by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.filter.map import StochasticMap
from kalmark.geometry import POINT2, SE2
from kalmark.tracks.channel import Channel
from kalmark.tracks.clones import Clones
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Status, Track, Tracks

POINT = km.landmarks.Point2D()
ROBOT, AT = np.array([1.0, 2.0, 0.5 * math.pi]), np.zeros(3)
LANDMARKS = np.array([[1.0, 6.0], [-2.0, 6.0]])  # 4 m ahead, 5 m off to the left
EXACT = np.array([[4.0, 0.0], [5.0, math.atan2(3.0, 4.0)]])
OUT = np.array([[0.3, 0.08], [0.1, 0.0]])  # 3 and 4 sigmas, and 1
R = np.diag([0.1, 0.02]) ** 2


def scan_of(
    y: Any, sensor: Any = None, cov: Any = None, mount: bool = False, sure: bool = True, **of: Any
) -> ScanContext:
    """Return a scan of a robot on slot 0, of landmarks "a" and "b" on 1 and 2, with a mount on 3 that is estimated.

    `sure`: all but the mount is known exactly.  `of` are arguments of the channel, and `classes` of the scan, too.
    """
    m, tracks, scale = StochasticMap(), Tracks(["r"]), 0.0 if sure else 0.01
    tracks.enter_block("r", m.add(SE2, ROBOT, scale * np.eye(3)), robot=True)
    for name, l in zip("ab", LANDMARKS, strict=True):
        tracks.enter(Track(name, POINT, m.add(POINT2, l, scale * np.eye(2))))
    slot = m.add(SE2, AT, 0.01 * np.eye(3)) if mount else -1
    sensor, reported = sensor or km.sensors.RangeBearing(0.1, 0.02), of.pop("reported", None)
    channel = Channel(sensor, AT, slot, POINT, lambda dof: math.inf, [POINT], **of)
    event = km.Scan(1.0, "r", "s", np.array(y), cov=cov, classes=reported)
    given = sensor.noise(event.y) if cov is None else np.broadcast_to(cov, (len(event.y), *np.shape(cov)[-2:]))
    report = km.Report(event, event.y)
    return ScanContext(
        m, tracks, Clones(), km.estimators.Ekf(), channel, 0, event, (None,) * len(event.y), np.array(given), report
    )


def updates(scan: ScanContext, rows: list[int], slots: list[int]) -> list[Any]:
    """Return the corrections by rows of a scan of landmarks of the map, and of the same known exactly."""
    model = scan.channel.models["point"]
    return [
        scan.update(model, np.array(slots), rows),
        scan.known_update(model, LANDMARKS[np.array(slots) - 1], rows),
    ]


@pytest.mark.parametrize(("mount", "second"), [(False, -1), (True, 3)])
def test_a_correction_has_the_mount_behind_the_pose_if_that_is_estimated(mount: bool, second: int) -> None:
    scan = scan_of(EXACT, mount=mount)
    for update in updates(scan, [0, 1], [1, 2]):
        assert (update.robot, update.mount) == (0, second)
    assert scan.start_of(0).parts == (((0, 3), (3, 3)) if mount else ((0, 3),))


def test_of_a_landmark_known_exactly_the_numbers_follow_the_measurement_and_it_has_no_block() -> None:
    y = np.array([*EXACT, *EXACT])
    mapped, known = updates(scan_of(y), [1, 2], [2, 1])
    np.testing.assert_array_equal(known.y, np.column_stack([y[1:3], LANDMARKS[::-1]]))
    np.testing.assert_array_equal(known.slots, [0, 0])
    assert (known.d, mapped.d) == (0, 2)
    np.testing.assert_array_equal(mapped.slots, [2, 1])
    np.testing.assert_array_equal(mapped.y, y[1:3])


@pytest.mark.parametrize(
    ("robust", "weight"),
    [
        ("huber", lambda r2: min(1.0, math.sqrt(chi2.ppf(0.95, 2) / r2))),
        ("student", lambda r2: min(1.0, (4.0 + 2.0) / (4.0 + r2))),
    ],
)
def test_the_noise_of_an_outlier_is_divided_by_its_robust_weight(robust: str, weight: Any) -> None:
    """Where all else is known exactly, the innovation is what is left; r2 = 25 and 1 here."""
    scan = scan_of(EXACT + OUT, robust=robust)
    for update in updates(scan, [0, 1], [1, 2]):
        np.testing.assert_allclose(update.R, [R / weight(3.0**2 + 4.0**2), R / weight(1.0)], rtol=1e-6)
    for update in updates(scan_of(EXACT + OUT), [0, 1], [1, 2]):
        np.testing.assert_array_equal(update.R, [R, R])


def test_an_innovation_that_the_state_explains_is_no_outlier() -> None:
    scan = scan_of(EXACT + np.array([0.3, 0.0]), robust="huber", sure=False)
    assert (updates(scan, [0, 1], [1, 2])[0].R[:, 0, 0] < 1.5 * R[0, 0]).all()


@pytest.mark.parametrize("own", [False, True])
def test_noise_that_varies_is_that_at_the_landmark_unless_the_scan_has_its_own(own: bool) -> None:
    sensor = km.sensors.RangeBearing(0.1, 0.02, sigma_range_rel=0.2)
    scan = scan_of(EXACT + np.array([2.0, 0.0]), sensor, cov=R if own else None)
    assert (scan.own_noise, scan.noise_varies) == (own, not own)
    ranges = [R[0, 0]] * 2 if own else [0.1**2 + (0.2 * 4.0) ** 2, 0.1**2 + (0.2 * 5.0) ** 2]
    for update in updates(scan, [0, 1], [1, 2]):
        np.testing.assert_allclose(update.R[:, 0, 0], ranges)
    model = scan.channel.models["point"]
    Z, d2, noise = scan.predict(model, np.array([2]), [1])
    np.testing.assert_allclose(noise[0, 0, 0], ranges[1])
    np.testing.assert_allclose(Z, noise, rtol=1e-9)
    assert d2[0] == pytest.approx(2.0**2 / ranges[1])


def test_places_and_their_sigmas_are_those_of_range_and_bearing() -> None:
    """Along the ray the sigma is that of the range, across it that of the bearing times the range."""
    places, sigmas = scan_of(EXACT).places()
    np.testing.assert_allclose(places, [[4.0, 0.0], [4.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(sigmas, [math.sqrt(0.5 * (0.1**2 + (0.02 * r) ** 2)) for r in (4.0, 5.0)])


def test_the_class_of_an_observation_adds_to_the_distance_from_each_landmark_and_from_a_new_one() -> None:
    cones = km.Classes(("blue", "yellow"), error=0.1)
    scan = scan_of(EXACT, classes=cones, reported=["blue", None])
    scan.add_reports(["a", "b"], [0, 0], [True, False])
    assert scan.tracks.confirmed["a"].classes == pytest.approx({"blue": math.log(0.9), "yellow": math.log(0.1)})
    assert scan.tracks.confirmed["b"].classes == {}, "it was not used"
    pairs, new = scan.class_distances(["a", "b"])
    none = -2.0 * math.log(0.5 / 0.9)
    np.testing.assert_allclose(pairs, [[-2.0 * math.log(0.82 / 0.9), none], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(new, [none, 0.0], atol=1e-12)
    scan.tracks.tentative["t"] = Track("t", POINT, status=Status.TENTATIVE, classes={"blue": 0.0, "yellow": -9.0})
    assert scan.class_distances(["t"], tentative=True)[0][0, 0] < 0.0 + 1e-3
    assert scan.class_distances(["t"])[0][0, 0] == pytest.approx(none), "it is no landmark of the map"


def test_a_sensor_without_classes_ignores_those_that_are_reported() -> None:
    scan = scan_of(EXACT, reported=["blue", None])
    assert scan.reported is None
    pairs, new = scan.class_distances(["a", "b"])
    assert not pairs.any() and not new.any() and (pairs.shape, new.shape) == ((2, 2), (2,))


def test_a_measurement_is_kept_with_its_clone_its_row_and_its_noise() -> None:
    scan = scan_of(EXACT, cov=4.0 * R)
    kept = scan.measurement(1, 7)
    assert (kept.clone, kept.t_ns, kept.robot, kept.sensor, kept.k) == (7, 1_000_000_000, "r", "s", 1)
    np.testing.assert_array_equal(kept.y, EXACT[1])
    np.testing.assert_array_equal(kept.R, 4.0 * R)
    assert scan.size_of(1) is None
