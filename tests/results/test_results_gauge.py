"""Tests of the gauge: the accuracy of a shape does not depend on what nothing measures, its place in the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
import results_space
import results_world
from kalmark.diagnosis.verdict import diagnose
from kalmark.events import Control, Fix, Scan
from kalmark.geometry.frames import to_frame
from kalmark.results.gauge import generators, shape_of_points
from kalmark.results.measures import rigid
from kalmark.results.plot import draw_map
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.run_page import report_html
from kalmark.results.scene import Scene
from kalmark.results.verdict_text import verdict_lines
from results_world import circle

START = {2: np.diag([0.5, 0.5, 0.3]) ** 2, 3: np.diag([0.5, 0.5, 0.5, 0.1, 0.1, 0.3]) ** 2}


def sigma(P: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.trace(P, axis1=1, axis2=2)))


def mapped(d: int, uncertain: tuple[str, ...] = ("rover",), robots: tuple[str, ...] = ("rover",), **keys: Any) -> Run:
    """Return the run of a log of the tests in the plane or in space; the starts of `uncertain` robots are not known."""
    world: Any = results_world if d == 2 else results_space
    log = circle(robots, 60 * len(robots) ** 2) if d == 2 else results_space.spiral(robots, 40)
    slam = world.slam_for(log, **keys)
    starts = [replace(robot, cov=START[d] if name in uncertain else None) for name, robot in slam.robots.items()]
    return record(km.Slam(starts, **vars(slam.state.settings)), log, progress=False)


def shape(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances of the landmarks of a run: of the shape and in the world."""
    end = run.history.maps[-1]
    return end.shape, end.covariances


@pytest.mark.parametrize("d", [2, 3])
def test_the_shape_of_points_is_that_of_inner_constraints_whatever_the_world_s_covariance(d: int) -> None:
    rng, q = np.random.default_rng(3), 3 * (d - 1)
    points, of = rng.normal(size=(8, d)) * 5, np.arange(8)
    G = generators(points, np.zeros(d))[:, :d].reshape(-1, q)
    P = 1e-4 * np.eye(8 * d)
    S = np.eye(8 * d) - G @ np.linalg.pinv(G)  # equal weights: all are as certain
    expected = np.trace(S @ P @ S.T)
    found = shape_of_points(points, P, of)
    assert np.trace(found, axis1=1, axis2=2).sum() == pytest.approx(expected, rel=0.01)
    loose = P + G @ np.diag([0.5] * d + [0.2] * (q - d)) ** 2 @ G.T
    assert shape_of_points(points, loose, of) == pytest.approx(found, abs=1e-8)
    far = np.vstack([points, np.full(d, 1000.0)])
    P = np.block([[loose, np.zeros((8 * d, d))], [np.zeros((d, 8 * d)), 1e4 * np.eye(d)]])
    assert sigma(shape_of_points(far, P, np.arange(9))[:8]) == pytest.approx(sigma(found), rel=0.05)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("robots", [("rover",), ("rover", "scout")])
def test_the_shape_is_as_accurate_from_an_uncertain_start_as_from_a_known_one(d: int, robots: tuple[str, ...]) -> None:
    known, uncertain = mapped(d, (), robots[:1]), mapped(d, ("rover",), robots[:1])
    if len(robots) > 1:  # the second one is found by what both see
        known, uncertain = mapped(d, ("scout",), robots), mapped(d, ("rover", "scout"), robots)
    (of_known, in_world), (of_uncertain, loose) = shape(known), shape(uncertain)
    assert sigma(loose).min() > 0.5 > 5 * sigma(of_known).max()
    tolerance = 1e-3 if len(robots) == 1 else 0.1  # two starts are two estimates of the world
    assert sigma(of_uncertain) == pytest.approx(sigma(of_known), rel=tolerance)
    assert (np.linalg.eigvalsh(of_known) > 0).all()
    assert sigma(of_known).mean() < sigma(in_world).mean()


def test_errors_of_the_shape_are_as_its_covariance_says() -> None:
    found = []
    for seed in range(20):
        log = circle(steps=40, seed=seed)
        slam = results_world.slam_for(log)
        start = log.truth["rover"].poses[0] + np.random.default_rng(seed).normal(size=3) * [0.5, 0.5, 0.3]
        robot = replace(slam.robots["rover"], start=start, cov=START[2])
        run = record(km.Slam([robot], **vars(slam.state.settings)), log, progress=False)
        places, _ = run.landmarks.positions()
        true = np.array([log.landmarks[i] for i in run.landmarks.ids])
        e = rigid(places, true)(places) - true
        S, W = shape(run)
        found.append([np.sum(e**2) / np.trace(S, axis1=1, axis2=2).sum(), sigma(W).min()])
        assert sigma(W).min() > 2 * np.median(sigma(S))
    assert 0.7 < np.mean(found, axis=0)[0] < 1.3


def test_an_overconfident_filter_states_no_more_in_the_world_than_of_the_shape() -> None:
    for estimator in (km.estimators.Ekf(), km.estimators.Fej()):
        S, W = shape(mapped(2, estimator=estimator))
        assert (np.linalg.eigvalsh(S) > -1e-12).all()
        assert np.trace(S, axis1=1, axis2=2).sum() < np.trace(W, axis1=1, axis2=2).sum()


def test_where_fixes_or_known_landmarks_give_the_place_shape_and_world_coincide() -> None:
    log = circle(steps=60)
    slam = results_world.slam_for(log)
    robot = replace(slam.robots["rover"], cov=START[2])
    fixed = [
        event
        for each in log.events
        for event in (
            [
                each,
                Fix(
                    t_ns=each.t_ns,
                    robot="rover",
                    y=log.truth["rover"].at(np.array([each.t_ns]))[0, :2],
                    cov=1e-6 * np.eye(2),
                ),
            ]
            if isinstance(each, Scan)
            else [each]
        )
    ]
    S, W = shape(record(km.Slam([robot]), replace(log, events=fixed), progress=False))
    assert sigma(S) == pytest.approx(sigma(W), rel=0.3)
    known = km.Slam([robot])
    for i in (1, 2, 3):
        known.add_landmark(i, log.landmarks[i])
    run = record(known, log, progress=False)
    rows = [k for k, i in enumerate(run.landmarks.ids) if i not in run.landmarks.exact]
    S, W = (each[rows] for each in shape(run))
    assert sigma(S) == pytest.approx(sigma(W), rel=1e-3)


def test_robots_that_never_meet_leave_the_place_of_their_maps_open_in_the_shape() -> None:
    lidar = {"lidar": km.Mount(km.sensors.RangeBearing(0.01, 0.001))}
    posts, events = np.array([[2.0, 1.0], [2.0, -1.0], [3.0, 0.0]]), []
    for name, first in (("a", 0), ("b", 10)):
        polar = np.column_stack([np.hypot(*posts.T), np.arctan2(*posts.T[::-1])])
        assert to_frame(np.zeros(3), posts[0])[0] == pytest.approx(posts[0])
        events += [
            Control(t_ns=0, robot=name, u=[0.0, 0.0]),
            Scan(t_ns=1, robot=name, sensor="lidar", y=polar, ids=[first, first + 1, first + 2]),
        ]
    events.sort(key=lambda event: event.t_ns)
    starts = {"a": np.zeros(3), "b": np.array([50.0, 0.0, 0.0])}
    robots = [km.Robot(name, km.motion.Unicycle(), at, lidar, cov=START[2]) for name, at in starts.items()]
    log = km.Log("two", ("a", "b"), events)
    S, _ = shape(record(km.Slam(robots), log, progress=False))
    alone, _ = shape(record(km.Slam(robots[:1]), replace(log, robots=("a",), events=events[::2]), progress=False))
    assert sigma(alone).max() < 0.03
    assert 2 * np.mean(sigma(S) ** 2) > 0.5**2  # half of what is between both, at least


def test_pictures_page_and_verdict_say_whether_accuracy_is_of_the_shape_or_in_the_world(tmp_path: Path) -> None:
    run = mapped(2)
    verdict = diagnose(run).as_dict()
    assert verdict["shape_accuracy_m"] < 0.2 * verdict["accuracy_m"]
    assert verdict["shape_accuracy_m"] == pytest.approx(np.median(sigma(shape(run)[0])), rel=0.3)
    (line, *_) = verdict_lines(verdict)
    assert " m in shape, " in line and " m in the world (1 sigma" in line
    loaded = Run.load(run.save(tmp_path / "run"))
    assert shape(loaded)[0] == pytest.approx(shape(run)[0])
    for world, words in ((False, "of the shape"), (True, "in the world")):
        labels = [text.get_text() for text in draw_map(loaded, world=world).legends[0].get_texts()]
        assert f"estimated landmarks, 3σ {words}" in labels
        assert f"end, 3σ {words}" in labels
        assert ("true landmarks" if world else "true landmarks, aligned") in labels
        assert f"3-sigma ellipses {words};" in report_html(loaded, world)


def test_the_truth_of_a_picture_ends_where_its_path_does() -> None:
    run = mapped(2)
    scene, whole = Scene.of(run, 20), Scene.of(run)
    assert len(scene.ways["rover"].truth) == len(scene.ways["rover"].path) == 21
    assert len(whole.ways["rover"].truth) == len(run.history.t_ns)
    assert scene.low.tolist() == whole.low.tolist()
