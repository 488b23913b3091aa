"""Tags seen by their corners: mirror images, observations far from their expectation, their residuals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.batch.batch_state import POSES
from kalmark.batch.solver import optimum
from kalmark.errors import DivergedError, KalmarkError
from kalmark.geometry import SE3
from kalmark.geometry.frames3d import compose
from kalmark.geometry.rotations import from_euler, multiply
from kalmark.management.ambiguous_tags import AGAIN, settle
from kalmark.models.imaging import TELLING
from kalmark.results.batch import tag_problem
from kalmark.tracks.track import Pending

FORWARD = from_euler(np.radians([-90.0, 0.0, -90.0]))[0]  # a camera that looks along the robot's x
AT = np.concatenate([[0.0, 0.0, 0.6], FORWARD])
SIZE, SIGMA = 0.16, 0.3
SENSOR = km.sensors.TagCorners(sigma_px=SIGMA)
TAG = km.landmarks.Tag()
NEAR = [(1.0, y, 0.6) for y in (-0.25, 0.25)]


def facing(*tilt: float) -> Any:
    """Return the orientation of a tag that faces a camera that looks along x, tilted by Euler angles in rad."""
    return multiply(FORWARD, from_euler(np.array([np.pi + tilt[0], tilt[1], tilt[2]]))[0])


def tags(*places: tuple[float, float, float], tilt: tuple[float, float, float] = (0.5, 0.3, 0.2)) -> Any:
    return np.array([[*place, *facing(*tilt)] for place in places])


def slam_of(sensor: Any = SENSOR, sigma_m: float = 0.01, sigma_rad: float = 0.005) -> km.Slam:
    motion = km.motion.Odometry3D(sigma_m, sigma_m, sigma_m, sigma_rad)
    return km.Slam([km.Robot("r", motion, None, {"eye": km.Mount(sensor, AT)})])


def sight(t: float, pose: Any, l: Any, rng: np.random.Generator, ids: Any = None, sigma: float = SIGMA) -> km.Scan:
    v = TAG.seen_from(compose(pose, AT)[0], l)[0]
    sizes = np.column_stack([np.zeros((len(l), 8)), np.full(len(l), SIZE)])
    y = SENSOR.expect(v, sizes)[0] + np.column_stack([sigma * rng.normal(size=(len(l), 8)), np.zeros(len(l))])
    return km.Scan(t, "r", "eye", y, range(len(l)) if ids is None else ids)


def angle(a: Any, b: Any) -> float:
    return float(np.linalg.norm(SE3.minus(a, b)[3:]))


def test_a_tag_that_may_be_its_mirror_image_waits_until_several_scans_tell() -> None:
    l, waited, right, wrong = tags((4.0, 0.3, 0.8)), 0, 0, 0  # 13 px across
    for seed in range(20):
        rng, slam = np.random.default_rng(seed), slam_of()
        for t in range(150):
            pose = np.array([0.0, 0.01 * t, 0, 0, 0, 0, 1])
            slam.process(km.Control(t, "r", np.array([0, 0.01 * (t > 0), 0, 0, 0, 0])))
            (seen,) = slam.process(sight(t, pose, l, rng)).observations
            if seen.outcome == "new":
                right, wrong = right + (angle(slam.mean(0), l[0]) < 0.5), wrong + (angle(slam.mean(0), l[0]) > 0.5)
                break
            assert (seen.outcome, seen.reason) == ("deferred", "its mirror image fits as well")
            waited += 1
    assert waited > 200, "one scan does not tell"
    assert (right, wrong) == (20, 0)


def test_evidence_of_one_tag_adds_up_and_poses_are_paired_by_their_orientations() -> None:
    pair = np.stack([tags((3.0, 0, 1))[0], tags((3.0, 0, 1), tilt=(-0.5, -0.3, 0.2))[0]])
    which, known = settle(Pending(("r", "eye"), 7), pair, 8.0, 0)
    assert which is None
    for k in range(1, 3):  # the other way round, twice by chance
        which, known = settle(known, pair[::-1], 3.0, k)
        assert which is None
    assert known.evidence == pytest.approx(8.0 - 2 * AGAIN * 3.0)
    np.testing.assert_array_equal(known.poses, pair)
    assert settle(known, pair[::-1], (TELLING + 7.0) / AGAIN, 3)[0] == 0  # the first of the pair that is given here
    which, known = settle(Pending(("r", "eye"), 7), pair, 5.0, 4)
    assert which is None
    which, known = settle(known, pair[::-1], 11.0, 2_000_000_000)  # so long not seen: begun anew
    assert which is None
    assert known.evidence == 11.0


def back_from(seed: int) -> float:
    """Return the NEES (6) of a robot that saw nothing for a while, then two tags it knows, far from their places."""
    rng, slam, l = np.random.default_rng(seed), slam_of(sigma_m=0.3, sigma_rad=0.3), tags(*NEAR, tilt=(0.6, 0.5, 0.2))
    for i in range(2):
        slam.add_landmark(i, l[i], np.diag(np.full(6, 1e-12)), TAG)
    pose = SE3.plus(np.eye(7)[6], np.append(rng.normal(size=3) * 0.225, rng.normal(size=3) * [0.3, 0.12, 0.12]))
    slam.process(km.Control(1, "r", np.zeros(6)))
    try:
        report = slam.process(sight(1, pose, l, rng))
    except DivergedError:
        return np.inf
    assert [o.outcome for o in report.observations] == ["associated", "associated"]
    d = SE3.minus(slam.mean("r"), pose)
    return float(d @ np.linalg.solve(slam.covariance("r"), d))


def test_tags_far_from_where_they_are_expected_bring_the_robot_back() -> None:
    nees = [back_from(seed) for seed in range(40)]
    assert max(nees) < 30 and 4 < np.mean(nees) < 8  # six degrees of freedom


@pytest.mark.parametrize("cov", [None, np.diag(np.full(6, 1e-12))])
def test_two_surveyed_tags_that_are_expected_behind_the_camera_bring_a_carried_robot_back_at_once(cov: Any) -> None:
    rng, slam, l = np.random.default_rng(1), slam_of(), tags(*NEAR, tilt=(0.6, 0.5, 0.2))
    for i in range(2):
        slam.add_landmark(i, l[i], cov, TAG)
    away = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0])  # turned about, the tags behind it
    slam.process(km.Control(0, "r", np.zeros(6)))
    slam.process(sight(0, np.eye(7)[6], l, rng))
    slam.state.map.set_predicted(slam.state.moving["r"].slot, away)
    report = slam.process(sight(1, np.eye(7)[6], l, rng))
    assert [(gap.kind, round(gap.sigma_m, 1)) for gap in report.gaps] == [("elsewhere", 1.0)]
    d = SE3.minus(slam.mean("r"), np.eye(7)[6])
    assert np.linalg.norm(d[:3]) < 0.02 and np.linalg.norm(d[3:]) < 0.02


def test_one_surveyed_tag_that_is_expected_behind_the_camera_is_left_out_as_a_misfit() -> None:
    rng, slam, l = np.random.default_rng(1), slam_of(), tags(*NEAR, tilt=(0.6, 0.5, 0.2))
    for i, place in enumerate([l[0], l[1] - [6.0, 0, 0, 0, 0, 0, 0]]):
        slam.add_landmark(i, place, None, TAG)
    for t in range(5):
        report = slam.process(sight(t, np.eye(7)[6], l, rng))
        fits, out = report.observations
        assert fits.outcome == "associated"
        assert (out.outcome, out.d2, out.reason) == ("rejected", np.inf, "nothing can be expected of it from here")
    assert slam.state.surveys.misfits == {1: (5, frozenset([0]))}  # of one other landmark: it may be either


def test_doubts_are_saved_and_resume_bit_for_bit(tmp_path: Path) -> None:
    rng, slam, l = np.random.default_rng(3), slam_of(), tags((4.0, 0.3, 0.8))
    pose = np.array([0.0, 0, 0, 0, 0, 0, 1])
    slam.process(sight(0, pose, l, rng))
    slam.save(tmp_path / "map.kmk")
    again, scan = km.Slam.load(tmp_path / "map.kmk"), sight(0.1, pose, l, rng)
    for one in (slam, again):
        assert one.process(scan).observations[0].outcome == "deferred"
    mine, theirs = (one.tracks.pending[0].pending for one in (slam, again))
    assert mine is not None and theirs is not None and mine.poses is not None
    assert (mine.evidence, mine.t_ns) == (theirs.evidence, theirs.t_ns)
    np.testing.assert_array_equal(mine.poses, theirs.poses)
    for t in range(2, 100):
        scan = sight(0.1 * t, pose, l, rng)
        assert slam.process(scan).observations == again.process(scan).observations
    assert slam.landmarks().ids == [0], "several scans tell"
    np.testing.assert_array_equal(slam.covariance("r", 0), again.covariance("r", 0))


@pytest.fixture(scope="module")
def run() -> km.Run:
    """Return a run that passes tags on the left, then others on the right that no scan shares with the first."""
    rng, slam, events = np.random.default_rng(6), slam_of(), []
    l = tags(*((2.0, y, 0.6) for y in (-0.5, 0.0, 0.5, 99.4, 100.2)))
    for t in range(40):
        step = 0.01 if t != 20 else 99.6
        u = np.array([0, step, 0, 0, 0, 0])
        pose = np.array([0, 0.01 * t + (99.59 if t >= 20 else 0.0), 0, 0, 0, 0, 1])
        ids = [0, 1, 2] if t < 20 else [3, 4]
        if t:
            events.append(km.Control(t, "r", u + rng.normal(size=6) * [0.01, 0.01, 0.01, 0.005, 0.005, 0.005]))
        events.append(sight(t, pose, l[ids], rng, ids))
    return km.record(slam, events, progress=False, pictures=False)


def test_what_is_left_of_the_corners_is_the_noise_and_is_kept(run: km.Run, tmp_path: Path) -> None:
    summary = run.evaluate(batch=True)
    assert 0.6 * SIGMA * np.sqrt(2) < summary["corner_rms_px"] < 1.05 * SIGMA * np.sqrt(2)
    assert summary["batch"]["rms_px"] <= summary["batch"]["filter_rms_px"]
    again = km.Run.load(run.save(tmp_path))
    assert again.evaluate()["corner_rms_px"] == summary["corner_rms_px"]
    np.testing.assert_array_equal(again.history.left_px, run.history.left_px)


def test_parts_of_a_path_that_share_no_tag_are_adjusted_each_for_itself(run: km.Run) -> None:
    problem = tag_problem(run)
    held = problem.start.columns(POSES, np.array([0, 20]))[:, None] + np.arange(6)
    np.testing.assert_array_equal(np.flatnonzero(~problem.free), held.ravel())
    poses = optimum(problem).state.groups[POSES]
    np.testing.assert_allclose(poses[[0, 20]], problem.start.groups[POSES][[0, 20]], rtol=0, atol=1e-15)
    problem.free[held[1]] = True
    with pytest.raises(KalmarkError, match="do not determine all poses and tags"):
        optimum(problem)
