"""The start in a known map, step by step: bases, poses of two pairs, tests, refinement, chance, ambiguity."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, chi2

import kalmark as km
from kalmark.association import global_start
from kalmark.association.global_start import (
    REACH,
    GlobalPose,
    Proposal,
    bases,
    by_chance,
    chance_of_fit,
    distinct,
    hypotheses,
    locate_points,
    locate_ranges,
    locate_rays,
    locate_tags,
    points_at_poses,
    refine_pose,
    search,
)
from kalmark.association.relocalization import align_points, is_same_pose
from kalmark.geometry import frames3d
from kalmark.geometry.frames import to_frame
from kalmark.geometry.pose_frames import FRAMES
from kalmark.geometry.rotations import exp
from kalmark.geometry.spaces import SE2, SE3
from kalmark.tracks.known_landmarks import Known

PLACES = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [9.0, 1.0], [5.0, 8.0], [-6.0, 3.0]])
T = np.array([1.0, -2.0, 0.7])
SIGMA = np.full(6, 0.01)


def known(places: np.ndarray) -> Known:
    of = Known(km.landmarks.Point2D())
    for i, place in enumerate(places):
        of.add(i, place)
    return of


def test_pairs_that_are_far_apart_come_first_and_no_observation_is_in_most() -> None:
    line = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [10.0, 0.0]])
    assert bases(line, np.ones(4)) == [(0, 3), (1, 3), (0, 2), (1, 2)]
    assert bases(line, np.array([1.0, 1.0, 0.01, 1.0]))[0] == (2, 3), "8 m of one sigma are more than 10 of two"
    many = np.random.default_rng(0).uniform(-9, 9, (30, 2))
    assert len(bases(many, np.ones(30))) == 8


def test_two_observations_are_of_two_landmarks_from_two_poses() -> None:
    """Only one pair of landmarks is 3 m apart: from the origin, and from the other one, turned about."""
    found = hypotheses(known(PLACES[:3]), np.array([[0.0, 0.0], [3.0, 0.0]]), SIGMA[:2], 0, 1)
    np.testing.assert_allclose(sorted(found.tolist()), [[0.0, 0.0, 0.0], [3.0, 0.0, np.pi]], atol=1e-12)


def test_places_are_turned_and_shifted() -> None:
    poses = np.array([[1.0, 2.0, np.pi / 2], [0.0, 0.0, np.pi]])
    np.testing.assert_allclose(
        points_at_poses(poses, np.array([[1.0, 0.0]])), [[[1.0, 3.0]], [[-1.0, 0.0]]], atol=1e-12
    )


def test_a_pose_that_most_of_a_scan_agrees_with_is_kept_with_its_pairs() -> None:
    v = to_frame(T, PLACES[[1, 3, 4]])[0]
    poses = np.array([T + np.array([0.0, 0.0, 0.3]), T])
    (one,) = global_start.supported_poses(known(PLACES), v, SIGMA[:3], poses, (0, 1))
    np.testing.assert_array_equal(one.T, T)
    assert one.matched.tolist() == [1, 3, 4]


def test_a_pose_is_refined_to_the_least_squares_of_all_pairs_and_each_landmark_has_one() -> None:
    rng = np.random.default_rng(1)
    v = to_frame(T, PLACES)[0] + rng.normal(size=(6, 2)) * 0.01
    v = np.vstack([v, v[2] + 0.02])  # a second one of the third landmark, farther off
    sigma = np.full(7, 0.01)
    start = GlobalPose(T + np.array([0.02, -0.02, 0.002]), np.array([0, 1, 2, 3, -1, -1, -1]))
    found = refine_pose(known(PLACES), v, sigma, start)
    assert found.matched.tolist()[:6] == [*range(6)]
    assert found.matched[6] == -1
    again = align_points(v[:6], PLACES, sigma[:6] ** -2)
    np.testing.assert_allclose(found.T, again, atol=0.01)
    assert np.abs(found.T - T).max() < 0.02


def test_poses_are_one_within_half_a_metre_and_a_tenth_of_a_radian() -> None:
    assert is_same_pose(T, T + np.array([0.3, 0.39, 0.0])) and not is_same_pose(T, T + np.array([0.3, 0.41, 0.0]))
    assert is_same_pose(T, T + np.array([0.0, 0.0, 0.099])) and not is_same_pose(T, T + np.array([0.0, 0.0, 0.101]))
    assert is_same_pose(np.array([0.0, 0.0, 3.13]), np.array([0.0, 0.0, -3.13])), "across the seam"
    poses = [
        GlobalPose(T + np.array([0.1, 0, 0]), np.array([0, -1])),
        GlobalPose(T, np.array([0, 1])),
        GlobalPose(T + np.array([9, 0, 0]), np.array([-1, -1])),
    ]
    assert [pose.pairs for pose in distinct(poses)] == [2, 0]


def test_supporters_are_counted_as_one_by_one_of_the_poses_that_may_be_the_best() -> None:
    rng = np.random.default_rng(3)
    places, v, reach = rng.uniform(-20, 20, (60, 2)), rng.uniform(-15, 15, (12, 2)), rng.uniform(1.0, 4.0, 12)
    poses = np.column_stack([rng.uniform(-5, 5, (400, 2)), rng.uniform(-3, 3, 400)])
    gaps = np.linalg.norm(global_start.points_at_poses(poses, v)[:, :, None] - places, axis=3).min(axis=2)
    each = (gaps <= reach).sum(axis=1)
    counts = global_start.count_supporters(poses, v, reach, places[np.argsort(places[:, 0])], 5)
    assert set(counts[each < 5]) == {0} and each.max() > 6
    assert (counts[each > each.max() - 2] == each[each > each.max() - 2]).all()
    assert np.isin(counts, [0, *each]).all() and (counts <= each).all()


def test_matchings_by_chance_are_the_tail_of_a_binomial() -> None:
    of = known(PLACES)
    p = of.density() * np.pi * chi2.ppf(REACH, 2) * 2 * 0.3**2
    assert 0 < p < 1
    assert chance_of_fit(of, np.full(7, 0.3), 2, 7, 40) == pytest.approx(p), "a pair fits by construction"
    for count in (3, 5, 7):
        assert by_chance(p, 7, count, 40) == pytest.approx(40 * binom.sf(count - 3, 5, p))


def test_a_fit_is_as_likely_by_chance_as_the_best_wrong_pose_has_it() -> None:
    p = chance_of_fit(known(PLACES), np.full(9, 0.01), 6, 9, 300)
    assert by_chance(p, 9, 6, 300) == pytest.approx(1.0)


def test_what_fits_in_a_row_is_likely_by_chance() -> None:
    row = np.column_stack([3.0 * np.arange(12), np.zeros(12)])
    places = np.vstack([row, [[40.0, 7.0], [44.0, -3.0], [-9.0, 5.0]]])
    found = search(known(places), places, np.full(len(places), 0.01))
    assert isinstance(found, GlobalPose)
    assert found.p > 0.3
    apart = search(known(PLACES), PLACES, np.full(len(PLACES), 0.01))
    assert isinstance(apart, GlobalPose)
    assert apart.p < 0.3


def test_a_scan_that_fits_in_one_place_gives_its_pose() -> None:
    found = search(known(PLACES), to_frame(T, PLACES)[0], SIGMA)
    assert isinstance(found, GlobalPose)
    np.testing.assert_allclose(found.T, T, atol=1e-9)
    assert found.matched.tolist() == [*range(6)]


def test_a_scan_that_does_not_determine_a_pose_is_refused_with_the_reason() -> None:
    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    corners = to_frame(T, square)[0]
    assert search(known(square), corners[:2], SIGMA[:2]) == "its scan has 2 observations, a start needs 3"
    alike = "its scan fits 4 landmarks from another pose, and 4 from this one"
    assert search(known(square), corners, SIGMA[:4]) == alike
    elsewhere = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 70.0]])
    assert search(known(PLACES), elsewhere, SIGMA[:3]) == "no pose in the known map explains most of its 3 observations"
    strange = np.vstack([to_frame(T, PLACES[:3])[0], [[50.0, 50.0], [70.0, -40.0], [-60.0, 33.0]]])
    assert search(known(PLACES), strange, SIGMA) == "3 observations agree, 0.003 poses as good are expected by chance"
    few = "its scan has 0 landmarks with ids, a pose by these needs 3"
    assert (
        locate_rays(Known(km.landmarks.Point2D()), ["a", "b"], corners[:2], SIGMA[:2]) == few
    )  # before any is in the map


@pytest.mark.parametrize("d", [2, 3])
def test_points_with_ids_determine_a_pose_if_all_agree(d: int) -> None:
    """Two of twelve stand elsewhere."""
    rng = np.random.default_rng(d)
    l, frames = rng.uniform(-9, 9, (12, d)), FRAMES[3 if d == 2 else 7]
    pose = T if d == 2 else np.array([1.0, -2.0, 0.5, 0.1, 0.5, -0.5, 0.7])
    of = Known(km.landmarks.Point2D() if d == 2 else km.landmarks.Point3D())
    for i, place in enumerate(l):
        of.add(i, place + (3.0 if i < 2 else 0.0))
    v = frames.to_frame(pose, l)[0] + rng.normal(0.0, 0.01, l.shape)
    assert isinstance(locate_points(of, [*range(12)], v, np.full(12, 0.01)), str)
    found = locate_points(of, ["no", "ne", *range(2, 12)], v, np.full(12, 0.01))
    assert isinstance(found, Proposal)
    assert found.matched.tolist() == [-1, -1, *range(2, 12)]
    assert found.gain == 7.0 * (10 - d)
    assert is_same_pose(found.T, pose)
    np.testing.assert_allclose(found.T, pose, atol=0.02)
    assert isinstance(locate_points(of, [*range(12)], 3.0 * v, np.full(12, 0.01)), str)
    assert isinstance(locate_points(of, [0, *[None] * 11], v, np.full(12, 0.01)), Proposal if d == 2 else str)


def test_the_tag_with_which_most_agree_determines_a_pose() -> None:
    rng = np.random.default_rng(1)
    of, seen, pose = Known(km.landmarks.Tag()), [], np.array([1.0, -2.0, 0.5, 0.0, 0.0, 0.6, 0.8])
    for i in range(5):
        l = np.append(rng.uniform(-3, 3, 3), rng.normal(size=4))
        l[3:] /= np.linalg.norm(l[3:])
        of.add(i, l + np.array([2.0 * (i == 0), 0, 0, 0, 0, 0, 0]))
        seen.append(frames3d.compose(frames3d.inverse(pose)[0], l)[0])
    cov = np.tile(1e-4 * np.eye(6), (6, 1, 1))
    found = locate_tags(of, [*range(5), 9], np.array([*seen, np.full(7, np.nan)]), cov)
    assert isinstance(found, Proposal)
    assert found.matched.tolist() == [-1, 1, 2, 3, 4, -1]
    assert found.gain == 21.0
    np.testing.assert_allclose(found.T, pose, atol=1e-9)
    assert isinstance(locate_tags(of, [9], np.array(seen[:1]), cov[:1]), str)


@pytest.mark.parametrize(("d", "moved_m"), [(2, 0.0), (2, 2.0), (3, 0.0), (3, 0.5)])
def test_directions_determine_a_pose_if_all_agree(d: int, moved_m: float) -> None:
    """Some of them were seen from another place, so far away, as a robot that moves sees them one after the other."""
    rng = np.random.default_rng(d + 5)
    l, frames = rng.uniform(-9, 9, (14, d)), FRAMES[3 if d == 2 else 7]
    pose = T if d == 2 else np.array([1.0, -2.0, 0.5, 0.1, 0.5, -0.5, 0.7])
    pose[3:] /= np.linalg.norm(pose[3:]) if d == 3 else 1.0
    of = Known(km.landmarks.Point2D() if d == 2 else km.landmarks.Point3D())
    for i, place in enumerate(l):
        of.add(i, place + (4.0 if i == 0 else 0.0))
    o = np.zeros(l.shape)
    o[:7, 0] = moved_m
    v = frames.to_frame(pose, l)[0] - o
    v = v / np.linalg.norm(v, axis=1, keepdims=True) + rng.normal(0.0, 0.002, v.shape)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    assert isinstance(locate_rays(of, [*range(14)], v, np.full(14, 0.002), o), str)
    found = locate_rays(of, ["no", *range(1, 14)], v, np.full(14, 0.002), o)
    assert isinstance(found, Proposal)
    assert found.matched.tolist() == [-1, *range(1, 14)]
    off = SE2.minus(found.T, pose) if d == 2 else SE3.minus(found.T, pose)
    assert off @ np.linalg.solve(found.cov, off) < 12.0
    assert isinstance(locate_rays(of, [0, 1], v[:2], np.full(2, 0.002), o[:2]), str)


@pytest.mark.parametrize("flat", [False, True])
def test_four_directions_of_space_determine_a_pose_or_several_and_then_none(flat: bool) -> None:
    rng, frames, outcomes = np.random.default_rng(4), FRAMES[7], list[str]()
    for _ in range(60):
        pose = np.append(rng.uniform(-6.0, 6.0, 3), exp(rng.normal(size=3)))
        l = rng.uniform(-5.0, 5.0, (4, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
        of = Known(km.landmarks.Point3D())
        for i, place in enumerate(l):
            of.add(i, place)
        v = frames.to_frame(pose, l)[0]
        v = v / np.linalg.norm(v, axis=1, keepdims=True) + rng.normal(0.0, 0.002, v.shape)
        found = locate_rays(of, [*range(4)], v / np.linalg.norm(v, axis=1, keepdims=True), np.full(4, 0.002))
        if isinstance(found, str):
            outcomes.append(found)
        else:
            off = SE3.minus(found.T, pose)
            outcomes.append(
                "right" if off @ np.linalg.solve(found.cov, off) < 22.5 else "wrong"
            )  # .999 of chi-square of 6
    assert outcomes.count("right") >= (36 if flat else 48)
    assert outcomes.count("wrong") <= 1


def test_four_ranges_determine_a_place_of_space_or_that_and_its_mirror_image() -> None:
    rng, pose = np.random.default_rng(8), np.array([1.0, -2.0, 0.5, 0.0, 0.0, 0.6, 0.8])
    sigma = np.full(9, 0.02)
    for height_m, number in ((6.0, 9), (6.0, 4), (0.0, 9)):  # landmarks up to so high over 4 m, and how many are seen
        l = np.column_stack([rng.uniform(-9, 9, (9, 2)), 4.0 + rng.uniform(0.0, height_m, 9)])
        of = Known(km.landmarks.Point3D())
        for i, place in enumerate(l):
            of.add(i, place)
        r = np.linalg.norm(l - pose[:3], axis=1) + rng.normal(0.0, sigma)
        found = locate_ranges(of, [*range(9)][:number], pose, r[:number], sigma[:number])
        assert isinstance(found, Proposal)
        off = found.T[:3] - pose[:3]
        assert off @ np.linalg.solve(found.cov[:3, :3], off) < 16.3, ".999 of chi-square of 3"
        np.testing.assert_array_equal(found.T[3:], pose[3:])
        above = locate_ranges(of, [*range(number)], pose + np.eye(7)[2] * 20.0, r[:number], sigma[:number])
        assert isinstance(above, Proposal)
        assert (above.T[2] > 4.0) == (height_m == 0.0), "of a flat ceiling the place on the side where it was"
    assert isinstance(locate_ranges(of, [0, 1, 2], pose, r[:3], sigma[:3]), str)
    assert isinstance(locate_ranges(of, [*range(9)], pose, r + np.eye(9)[0], sigma), str), "one does not agree"


def test_landmarks_with_ids_that_stand_in_one_place_determine_no_pose() -> None:
    here = known(np.zeros((3, 2)))
    assert isinstance(locate_rays(here, [0, 1, 2], np.tile([1.0, 0.0], (3, 1)), np.full(3, 0.01)), str)
    assert isinstance(locate_rays(here, [0, 1, 2], np.full((3, 2), np.nan), np.full(3, 0.01)), str)
