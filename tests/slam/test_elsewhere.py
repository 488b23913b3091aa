"""A robot that is carried away is found by its landmarks: in its own map or a surveyed one, with ids or without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, open_run
from kalmark.events import Event
from kalmark.geometry import compose, frames3d, inverse
from kalmark.geometry.angles import wrap
from kalmark.geometry.rotations import exp
from kalmark.results.batch import batch_input
from kalmark.simulate import load_world, simulate

RANGE_M, RATE_HZ = 8.0, 5.0
LIMITS = {"range_max_m": RANGE_M, "fov_rad": 4.6}


def trees(seed: int, number: int = 60) -> Any:
    """Return places (N, 2) at least 1 m apart, and from the path, in a field of 30 m by 20 m."""
    rng, found, way = np.random.default_rng(seed), list[Any](), path(1)[:, :2]
    while len(found) < number:
        p = rng.uniform((0.0, 0.0), (30.0, 20.0))
        if np.linalg.norm(np.array([*found, *way]) - p, axis=1).min() > 1.0:
            found.append(p)
    return np.array(found)


def path(laps: int) -> Any:
    """Return poses (S, 3) of so many laps in the field, .1 m and 1/5 s apart."""
    a = np.linspace(0.0, 2 * np.pi * laps, 550 * laps)
    x, y = 15.0 + 10.0 * np.cos(a), 10.0 + 6.0 * np.sin(a)
    return np.column_stack([x, y, np.arctan2(np.gradient(y), np.gradient(x))])


def log_of(
    poses: Any, places: Any, seed: int, ids: bool, jump: int | None = None, skip: int = 0, felled: int | None = None
) -> list[Event]:
    """Return increments and scans of trees along poses.

    Before the step `jump` the robot is carried past `skip` poses; a third of the trees falls at the step `felled`.
    """
    rng, events = np.random.default_rng(seed), list[Event]()
    steps = [*range(len(poses))] if jump is None else [*range(jump), *range(jump + skip, len(poses))]
    for k, (before, now) in enumerate(pairwise(steps)):
        t_s = (k + 1) / RATE_HZ
        step = compose(inverse(poses[before])[0], poses[now])[0] if now == before + 1 else np.zeros(3)
        u = step + rng.normal(0.0, (0.004, 0.002, 0.003))
        events.append(km.Control(t_s, "rover", u))
        x, y, theta = poses[now]
        standing = np.arange(len(places)) % 3 > 0 if felled is not None and k >= felled else np.ones(len(places), bool)
        d = places - (x, y)
        r, b = np.hypot(*d.T), wrap(np.arctan2(d[:, 1], d[:, 0]) - theta)
        seen = np.flatnonzero((r < RANGE_M) & (np.abs(b) < 2.3) & (rng.random(len(r)) < 0.9) & standing)
        z = np.column_stack([r[seen], b[seen]]) + rng.normal(0.0, (0.05, 0.01), (len(seen), 2))
        events.append(km.Scan(t_s, "rover", "laser", z, ids=seen.tolist() if ids else None))
    return events


def slam_at(start: Any, ids: bool, limits: dict[str, float] = LIMITS) -> km.Slam:
    sensor = km.sensors.RangeBearing(sigma_range_m=0.05, sigma_bearing_rad=0.01, **limits)
    motion = km.motion.Odometry2D(sigma_x_m=0.004, sigma_y_m=0.002, sigma_theta_rad=0.003)
    rover = km.Robot("rover", motion, start=start, sensors={"laser": km.Mount(sensor)})
    return km.Slam(rover, association=km.association.ByIdentity() if ids else km.association.Automatic())


def errors(slam: km.Slam, events: list[Event], poses: Any) -> tuple[Any, list[Any]]:
    """Return the distances (S,) of a robot from its path after each scan, and how it was carried."""
    off, carried = [], list[Any]()
    for event in events:
        report = slam.process(event)
        carried += [gap for gap in report.gaps if gap.kind == "elsewhere"]
        if isinstance(event, km.Scan):
            off.append(slam.mean("rover")[:2])
    return np.linalg.norm(np.array(off) - poses[:, :2], axis=1), carried


def carried_log(seed: int, ids: bool) -> tuple[Any, list[Event], Any]:
    """Return trees, the log of a robot that is carried away in its second lap, and its poses after each scan."""
    places, poses, jump, skip = trees(seed), path(3), 750, 200
    there = np.concatenate([poses[1:jump], poses[jump + skip :]])
    return places, log_of(poses, places, seed, ids, jump, skip), there


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("surveyed", ["no", "exactly", "uncertain"])
@pytest.mark.parametrize("ids", [True, False])
def test_a_robot_that_is_carried_away_is_found(ids: bool, surveyed: str, seed: int) -> None:
    places, events, poses = carried_log(seed, ids)
    slam = slam_at(path(1)[0], ids)
    for name, place in enumerate(places) if surveyed != "no" else ():
        slam.add_landmark(name, place, 1e-4 * np.eye(2) if surveyed == "uncertain" else None)
    off, carried = errors(slam, events, poses)
    assert [gap.robot for gap in carried] == ["rover"]
    assert carried[0].end_ns * 1e-9 < 750 / RATE_HZ + 30.0
    assert off[:749].max() < 0.8
    assert off[-300:].max() < 0.8
    assert len(slam.landmarks()) <= len(places) + 1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_carried_robot_is_found_though_somebody_walks_about(seed: int) -> None:
    """In each scan is an observation of no landmark: the landmarks that are not near it are missed all the same."""
    _, events, poses = carried_log(seed, ids=False)
    rng, about = np.random.default_rng(seed), []
    for event in events:
        if isinstance(event, km.Scan):
            y = np.vstack([event.y, rng.uniform((1.0, -2.0), (RANGE_M, 2.0))])
            about.append(km.Scan(event.t_s, "rover", "laser", y))
        else:
            about.append(event)
    off, carried = errors(slam_at(path(1)[0], ids=False), about, poses)
    assert len(carried) == 1 and carried[0].end_ns * 1e-9 < 750 / RATE_HZ + 30.0
    assert off[-300:].max() < 0.8


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_a_carried_robot_began_before_it_saw_an_old_landmark_is_none(seed: int) -> None:
    """With ids, it sees new trees alone for 1 s, which fit wherever it is; from then on old ones, too."""
    poses, jump, skip = path(3), 750, 200
    new = poses[jump + skip, :2] + np.array([(2.0, 1.5), (2.5, -1.0), (-1.0, 2.0)])
    places, t_s = np.concatenate([trees(seed), new]), jump / RATE_HZ
    slam, first = slam_at(poses[0], ids=True), len(places) - len(new)
    for event in log_of(poses, places, seed, True, jump, skip):
        if isinstance(event, km.Control):
            slam.process(event)
            continue
        assert isinstance(event, km.Scan) and event.ids
        is_new = np.array(event.ids) >= first
        shown = ~is_new if event.t_s < t_s else is_new | (event.t_s > t_s + 1.0)
        slam.process(km.Scan(event.t_s, "rover", "laser", event.y[shown], ids=np.array(event.ids)[shown].tolist()))
    found = slam.landmarks()
    off = np.linalg.norm(np.array(found.means)[:, :2] - places[np.array(found.ids, dtype=np.int64)], axis=1)
    assert off.max() < 0.8
    assert {*range(first, len(places))} <= {*found.ids}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_carried_robot_is_found_by_bearings_of_one_landmark_at_a_time(seed: int) -> None:
    """No scan determines its pose, and none of them moves the map: together they do, by how it moved between them."""
    places, events, poses = carried_log(seed, ids=True)
    motion = km.motion.Odometry2D(sigma_x_m=0.004, sigma_y_m=0.002, sigma_theta_rad=0.003)
    camera = km.Mount(km.sensors.Bearing(sigma_bearing_rad=0.01, range_max_m=RANGE_M, fov_rad=4.6))
    slam = km.Slam(km.Robot("rover", motion, start=path(1)[0], sensors={"laser": camera}))
    for name, place in enumerate(places):
        slam.add_landmark(name, place, 1e-4 * np.eye(2))
    bearings = list[Event]()
    for event in events:
        if isinstance(event, km.Scan) and event.ids:
            k = round(event.t_s * RATE_HZ)
            some = slice(None) if k < 750 else slice(k % len(event.ids), k % len(event.ids) + 1)
            bearings.append(km.Scan(event.t_s, "rover", "laser", event.y[some, 1:], ids=event.ids[some]))
        else:
            bearings.append(event)
    off, carried = errors(slam, bearings, poses)
    assert [gap.robot for gap in carried] == ["rover"]
    assert carried[0].end_ns * 1e-9 < 750 / RATE_HZ + 5.0
    assert off[-300:].max() < 0.8
    table = slam.landmarks()
    assert np.linalg.norm(np.array(table.means) - places[np.array(table.ids, dtype=np.int64)], axis=1).max() < 0.05


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_robot_is_found_by_a_sensor_whose_limits_are_not_stated(seed: int) -> None:
    """Its range is counted from its observations; landmarks beyond it contradict no pose."""
    _, events, poses = carried_log(seed, ids=False)
    off, carried = errors(slam_at(path(1)[0], ids=False, limits={}), events, poses)
    assert [gap.robot for gap in carried] == ["rover"]
    assert off[-300:].max() < 0.8


@pytest.mark.parametrize("seed", [4, 5])
@pytest.mark.parametrize("ids", [True, False])
def test_a_robot_that_is_not_stays_where_it_is(ids: bool, seed: int) -> None:
    places, poses = trees(seed), path(2)
    off, carried = errors(slam_at(poses[0], ids), log_of(poses, places, seed, ids), poses[1:])
    assert not carried
    assert off.max() < 0.8


def test_ids_that_are_wrong_on_the_way_carry_no_robot_that_closes_its_loop(data: Callable[[str], Path]) -> None:
    data("dlr")
    config, log = open_run("dlr", None, ("association.gate=0.9999",))
    run = km.record(build_slam(config, log), log, progress=False, pictures=False)
    assert not run.history.carried()
    assert len(run.landmarks.ids) == 576


def test_a_batch_solution_has_no_observation_of_a_robot_that_was_elsewhere_nor_of_the_scan_that_placed_it() -> None:
    places, events, _ = carried_log(2, ids=False)
    slam = slam_at(path(1)[0], ids=False)
    for name, place in enumerate(places):
        slam.add_landmark(name, place)
    run = km.record(slam, events, progress=False)
    (gap,) = run.history.carried()
    used = run.history.t_ns[batch_input(run).associations.scan]
    assert not ((gap.start_ns <= used) & (used <= gap.end_ns)).any()
    assert used.min() < gap.start_ns < gap.end_ns < used.max()


def test_trees_that_were_felled_do_not_carry_a_robot() -> None:
    places, poses = trees(6), path(2)
    off, carried = errors(slam_at(poses[0], False), log_of(poses, places, 6, False, felled=550), poses[1:])
    assert not carried
    assert off.max() < 0.8


@pytest.mark.parametrize("repeats", ["off", "merge"])
def test_the_onset_is_found_although_the_way_led_through_an_empty_place_first(repeats: str) -> None:
    """A car spins by 2 rad and maps cones again where there are none, and only then misses those that are there.

    Where no two places are alike it is placed before, by the shape of what it maps again.
    """
    log = simulate(load_world("race_track"), 0)
    slam, carried = (
        build_slam(load_world("race_track", [f"filter.upkeep.repeats={repeats}"]).config(), log),
        list[Any](),
    )
    for event in log:
        during = 55.0 <= event.t_s < 57.0
        if isinstance(event, km.Control) and during:
            carried += slam.process(replace(event, u=event.u * [0.6, 1.0] - [0.0, 1.0])).gaps
        elif not during:
            carried += slam.process(event).gaps
    assert [gap.kind for gap in carried] == ["elsewhere"]
    assert 54.0 < carried[0].start_ns * 1e-9 < 60.0
    assert carried[0].end_ns * 1e-9 < (62.0 if repeats == "merge" else 90.0)
    assert len(slam.landmarks()) <= len(log.landmarks) + 1


def test_two_things_with_one_id_and_one_that_drives_about_bend_no_map() -> None:
    """With ids and no gate: a far observation is left out while the others of its scan fit."""
    places, poses = trees(7), path(2)
    events = log_of(poses, places, 7, True)
    other, moving = int(np.argmax(np.linalg.norm(places - places[0], axis=1))), 5
    rng = np.random.default_rng(7)
    for k, event in enumerate(events):
        if not isinstance(event, km.Scan):
            continue
        assert event.ids is not None
        y = event.y.copy()
        for row, name in enumerate(event.ids):
            y[row] += rng.uniform(-2.0, 2.0, 2) * (1.0, 0.2) if name == moving and len(events) // 4 < k else 0.0
        ids = [0 if name == other else name for name in event.ids]
        events[k] = km.Scan(event.t_s, "rover", "laser", y, ids=ids)
    off, carried = errors(slam_at(poses[0], True), events, poses[1:])
    assert not carried
    assert off.max() < 0.8


def test_a_lost_robot_goes_on_from_a_file_bit_for_bit(tmp_path: Any) -> None:
    _, events, _ = carried_log(1, False)
    slam = slam_at(path(1)[0], False)
    at = 2 * 750 - 3
    for event in events[: at + 1]:
        slam.process(event)
    assert slam.state.evidence
    slam.save(tmp_path / "map.kmk")
    other = km.Slam.load(tmp_path / "map.kmk")
    for event in events[at + 1 : at + 200]:
        slam.process(event)
        other.process(event)
    np.testing.assert_array_equal(slam.mean("rover"), other.mean("rover"))
    assert len(slam.landmarks()) == len(other.landmarks())


def test_a_robot_of_space_that_coasts_is_placed_once_with_another_velocity() -> None:
    rng, start = np.random.default_rng(0), np.array([2.0, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5), 0, 0.8, 0, 0, 0, 0.4])
    stones = rng.uniform(-4.0, 4.0, (16, 3))
    sonar = km.Mount(km.sensors.RangeBearing3D(0.05, 0.02, 0.02))
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=0.01, sigma_w_radps_per_sqrt_s=0.01)
    slam = km.Slam(km.Robot("diver", motion, start, {"sonar": sonar}, cov=1e-4 * np.eye(12)))
    for k, place in enumerate(stones):
        slam.add_landmark(k, place)
    truth, gaps, off = start.copy(), [], []
    for k in range(60):
        if k == 30:  # carried to where it was at first, upside down, and turning the other way
            truth = np.array([2.0, 0, 0, 1.0, 0, 0, 0, 0.6, -0.5, 0.0, 0, 0, -0.4])
        truth = motion.move(truth, np.zeros(6), 0.1)[0] if k else truth
        y = sonar.sensor.expect(frames3d.to_frame(truth[:7], stones)[0])[0]
        y += rng.normal(0.0, (0.05, 0.02, 0.02), y.shape)
        gaps += slam.process(km.Scan(0.1 * k, "diver", "sonar", y, range(len(y)))).gaps
        off.append(np.linalg.norm(frames3d.minus(slam.mean("diver")[:7], truth[:7])))
    assert [gap.kind for gap in gaps] == ["elsewhere"]
    assert max(off[32:]) < 0.15
    error = motion.space.minus(slam.mean("diver"), truth)
    assert error @ np.linalg.solve(slam.covariance("diver"), error) < 32.9, ".999 of chi-square of 12"


DIRECTIONS = "robots.robot.sensors.sonar={type: bearing, sigma_azimuth_rad: 0.01, sigma_elevation_rad: 0.01}"
POSES = "robots.rig.sensors.camera={type: tag_pose, sigma_position_m: 0.02, sigma_rotation_rad: 0.02}"


@pytest.mark.parametrize(("name", "keys"), [("tags_room", []), ("tags_room", [POSES]), ("diver", [DIRECTIONS])])
def test_a_robot_of_space_is_found_in_its_own_map(name: str, keys: list[str]) -> None:
    """By tags, and by directions, of whose landmarks it knows the places, though none is a Euclidean point yet."""
    world = load_world(name, [*keys, "filter.map={known: null}"])
    log = simulate(world, seed=1)
    slam, times = build_slam(world.config(), log), sorted({event.t_ns for event in log.events})
    first, last = times[len(times) * 6 // 10], times[len(times) * 7 // 10]
    gaps, found = list[Any](), dict[int, Any]()
    for event in log.events:
        if not first < event.t_ns <= last:
            moved = event if event.t_ns <= first else replace(event, t_ns=event.t_ns - last + first)
            gaps += [gap.kind for gap in slam.process(moved).gaps]
            found[event.t_ns] = slam.mean(event.robot)[:3]
    truth = next(iter(log.truth.values())).at(np.array([*found]))[:, :3]
    off = np.linalg.norm(np.array([*found.values()]) - truth, axis=1)
    assert gaps == ["elsewhere"]
    assert off[-20:].max() < 0.3


@pytest.mark.parametrize("height_m", [4.0, 0.0])
def test_a_robot_of_space_is_found_by_ranges_to_beacons_at_a_ceiling_too(height_m: float) -> None:
    rng, truth = np.random.default_rng(1), np.array([2.0, 1.0, 0.5, 0, 0, 0, 1.0])
    beacons = np.column_stack([rng.uniform(-6.0, 6.0, (8, 2)), 3.0 + height_m * rng.random(8)])
    sonar = km.Mount(km.sensors.Range3D(sigma_range_m=0.05))
    slam = km.Slam(km.Robot("diver", km.motion.Odometry3D(0.02, 0.02, 0.02, 0.01), truth, {"sonar": sonar}))
    for k, place in enumerate(beacons):
        slam.add_landmark(k, place)
    step, gaps, off = np.array([0.1, 0, 0, 0, 0, 0.05]), [], []
    for k in range(40):
        if k == 20:  # carried below, and turned by a third of a turn
            truth = np.array([-3.0, -2.0, -1.0, 0, 0, np.sin(np.pi / 3), np.cos(np.pi / 3)])
        truth = frames3d.compose(truth, np.array([0.1, 0, 0, *exp(step[3:])]))[0]
        slam.process(km.Control(0.1 * k, "diver", step))
        y = np.linalg.norm(beacons - truth[:3], axis=1) + rng.normal(0.0, 0.05, 8)
        gaps += slam.process(km.Scan(0.1 * k, "diver", "sonar", y[:, None], range(8))).gaps
        off.append(np.linalg.norm(slam.mean("diver")[:3] - truth[:3]))
    assert [gap.kind for gap in gaps] == ["elsewhere"]
    assert max(off[21:]) < 0.3
