"""Worlds as they are described: layouts, routes, files, and what is refused."""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.config.opening import merge_trees
from kalmark.errors import ConfigError
from kalmark.simulate import World, load_world, shipped_worlds, simulate
from kalmark.simulate.layouts import (
    Cloister,
    House,
    Listed,
    ListedTag,
    Loop,
    RandomBox,
    RandomField,
    TagRoom,
    ThickCloister,
    along_closed_line,
)
from kalmark.simulate.robots import simulation
from kalmark.simulate.routes import Constant, Lanes, Wander, Waypoints, control_of_velocity
from kalmark.simulate.sights import SimulatedSensing
from kalmark.simulate.worlds import SimulatedRobot
from kalmark.vision.textured_layouts import ListedPlane, TexturedPlanes, TexturedRoom

SMALL = ["steps=20"]
PAGE = Path(__file__).parents[2] / "docs" / "worlds.md"


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return path


MINE = """\
world: {type: list, points_m: [[1, 0], [0, 1]]}
robots:
  rover:
    route: {type: constant, u: [0.5, 0.1]}
    motion: {type: unicycle}
    sensors: {laser: {type: range_bearing}}
steps: 5
"""


def test_the_cloister_has_the_recorded_landmarks_in_the_recorded_order(oracle: Callable[[str], Path]) -> None:
    recorded = json.loads(gzip.decompress(oracle("course2d.json.gz").read_bytes()))
    points = Cloister(x_min_m=-4, x_max_m=4, y_min_m=-4, y_max_m=4, n=7).floor()
    assert np.abs(points - np.array(recorded["W"]).T).max() < 1e-14
    log = simulate(load_world("cloister"), 1)
    assert np.abs(np.array(list(log.landmarks.values())) - np.array(recorded["W"]).T).max() < 1e-14
    true = np.array([step["R"] for step in recorded["steps"]])
    assert np.abs(log.truth["robot"].poses[1:201] - true).max() < 1e-12


def test_a_cloister_is_symmetric_and_fills_its_limits() -> None:
    points = Cloister(x_min_m=-3, x_max_m=5, y_min_m=0, y_max_m=2, n=9).floor()
    assert len(points) == 4 * (2 * 9 - 5)
    assert points.min(axis=0) == pytest.approx([-3, 0])
    assert points.max(axis=0) == pytest.approx([5, 2])
    turned = points * -1 + 2 * np.array([1, 1])
    assert {(round(x, 9), round(y, 9)) for x, y in turned} == {(round(x, 9), round(y, 9)) for x, y in points}


def test_landmarks_of_a_loop_lie_around_the_circle() -> None:
    loop = Loop(count=500, radius_m=10.0, radius_spread_m=3.0, x_m=1.0)
    radius = np.linalg.norm(loop.place(np.random.default_rng(3)) - [1.0, 0.0], axis=1)
    assert 7.0 <= radius.min() < 7.1 and 12.9 < radius.max() <= 13.0
    even = Loop(count=90, radius_m=40.0, angles="even", angle_spread_rad=0.03).place(np.random.default_rng(3))
    spacing = np.diff(np.unwrap(np.arctan2(even[:, 1], even[:, 0])))
    assert abs(spacing.mean() - 2 * math.pi / 90) < 1e-3 and spacing.max() < 2 * math.pi / 90 + 0.06


def test_a_random_field_fills_its_square() -> None:
    points = RandomField(count=2000, size_m=30.0).place(np.random.default_rng(0))
    assert points.min() >= 0 and points.max() <= 30
    assert np.abs(points.mean(axis=0) - 15).max() < 1.0


def test_cones_stand_on_both_sides_of_a_race_track_and_are_reported_by_their_classes() -> None:
    world = load_world("race_track", ["steps=400"])
    things = world.world.scenery(np.random.default_rng(0))
    assert things.classes is not None
    assert np.bincount(things.classes).tolist() == [78, 78, 4]
    middle, left = along_closed_line(np.array(world.world.line_m), 4.0)
    sides = [things.points[things.classes == k] - middle[1:] for k in (0, 1)]
    np.testing.assert_allclose(np.sum(sides[0] * left[1:], axis=1), 1.75)
    np.testing.assert_allclose(sides[1], -sides[0], atol=1e-9)
    found, wrong = simulation(world, 3), []
    for scan in (e for e in found.log if isinstance(e, km.Scan)):
        assert scan.classes is not None
        truth = found.origins[scan.t_ns, "car", "lidar"]
        wrong += [
            of != ("blue", "yellow", "orange")[things.classes[i - 1]] for of, i in zip(scan.classes, truth, strict=True)
        ]
    assert 0.03 < np.mean(wrong) < 0.07


def test_a_lag_is_drawn_and_scans_are_stamped_late_by_it() -> None:
    late = []
    for seed in range(30):
        log = simulate(load_world("race_track", ["steps=4"]), seed)
        late.append(min(e.t_s for e in log if isinstance(e, km.Scan)) % 0.05 + 0.0)
    first = [
        min(
            e.t_s
            for e in simulate(load_world("race_track", ["steps=4", "robots.car.sensing.lidar.late_s=0.5"]), 0)
            if isinstance(e, km.Scan)
        )
    ]
    assert np.std(late) > 0.005
    assert first[0] > 0.55


def test_every_shipped_world_simulates_and_gives_its_filter_the_simulated_noise() -> None:
    for name in shipped_worlds():
        world = load_world(name, SMALL)
        log = simulate(world, 1)
        config = world.config()
        assert log.robots == tuple(config.robots) and len(log) >= 20
        for robot, simulated in world.robots.items():
            assert config.robots[robot].motion == simulated.motion
            assert config.robots[robot].sensors == simulated.sensors
            assert config.robots[robot].start == simulated.start


def test_the_scenarios_have_the_documented_length_and_noise() -> None:
    steps = {name: load_world(name).steps for name in ("cloister", "loop_b", "loop_b2", "loop_c")}
    assert steps == {"cloister": 1260, "loop_b": 2010, "loop_b2": 2010, "loop_c": 1256}
    b, sw = load_world("loop_b").robots["robot"].motion, 0.05 * 0.25
    assert (b.sigma_x_m, b.sigma_theta_rad) == pytest.approx((sw / math.sqrt(2), math.sqrt(2) * sw / 0.5))
    for name, bearing_deg in (("cloister", 1), ("loop_b", 10), ("loop_b2", 3), ("loop_c", 3)):
        sensor = load_world(name).robots["robot"].sensors["lidar"]
        assert math.degrees(sensor.sigma_bearing_rad) == pytest.approx(bearing_deg)


def test_a_robot_with_waypoints_passes_all_of_them() -> None:
    log = simulate(load_world("two_robots"), 2)
    path = log.truth["beta"].poses[:, :2]
    for corner in ([17, 3], [17, 17], [3, 17], [3, 3]):
        assert np.linalg.norm(path - corner, axis=1).min() < 2.2


def test_a_robot_on_lanes_comes_near_every_landmark() -> None:
    lanes = "robots.rover.route={type: lanes, speed_mps: 2.0, turn_radius_m: 1.0, spacing_m: 8.0}"
    log = simulate(load_world("random_field", [lanes, "steps=1200"]), 2)
    path = log.truth["rover"].poses[:, :2]
    assert max(np.linalg.norm(path - l, axis=1).min() for l in log.landmarks.values()) < 7.0


def test_a_wandering_robot_stays_around_the_field_and_moves_smoothly() -> None:
    poses = simulate(load_world("random_field"), 2).truth["rover"].poses
    assert poses[:, :2].min() > -4 and poses[:, :2].max() < 54
    turn = np.diff(np.unwrap(poses[:, 2]))
    assert np.abs(turn).max() <= 0.2 * 1.0 / 1.5 + 1e-9
    assert np.ptp(poses[:, :2], axis=0).min() > 20


@pytest.mark.parametrize("w", [0.0, 0.3])
def test_every_motion_is_told_to_drive_the_same_arc(w: float) -> None:
    from kalmark.models.motion import Ackermann, Odometry2D, Unicycle

    start = np.array([1.0, 2.0, 0.3])
    ends = [m.move(start, control_of_velocity(m, 2.0, w, 0.5), 0.5)[0] for m in (Odometry2D(), Unicycle(), Ackermann())]
    assert np.abs(np.array(ends) - ends[0]).max() < 1e-12


def test_overrides_change_a_world() -> None:
    world = load_world("loop_b", ["steps=10", "world.count=3", "robots.robot.start.x_m=9.5"])
    assert (world.steps, world.world.count, world.robots["robot"].start.x_m) == (10, 3, 9.5)


def test_the_filter_section_departs_from_what_is_simulated(tmp_path: Path) -> None:
    more = "filter:\n  estimator: {type: ekf}\n  robots: {rover: {motion: {sigma_v_mps: 0.4}}}\n"
    world = load_world(written(tmp_path, MINE + more))
    config = world.config()
    assert config.estimator.type == "ekf"
    assert config.robots["rover"].motion.sigma_v_mps == 0.4
    assert config.robots["rover"].motion.sigma_w_radps == world.robots["rover"].motion.sigma_w_radps


def test_a_world_without_ids_is_associated_by_distance() -> None:
    assert load_world("cloister", ["ids=false"]).config().association.type == "nearest"
    assert load_world("cloister").config().association.type == "identity"


def test_laying_over_replaces_a_section_of_another_type() -> None:
    below = {"motion": {"type": "unicycle", "sigma_v_mps": 1.0}, "start": {"x_m": 1.0}}
    above = {"motion": {"type": "odometry_2d"}, "start": {"y_m": 2.0}}
    assert merge_trees(below, above) == {"motion": {"type": "odometry_2d"}, "start": {"x_m": 1.0, "y_m": 2.0}}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("steps: 5", "stepz: 5"), r"mine.yaml:7:1: stepz: .*did you mean steps"),
        (("steps: 5", "steps: 0"), r"mine.yaml:7:8: steps: got 0, expected a whole number of at least 1"),
        (("steps: 5", "dt_s: -1"), r"mine.yaml:7:7: dt_s: got -1, expected a positive number"),
        (("steps: 5", "dt_s: .nan"), r"mine.yaml:7:7: dt_s: got nan, expected"),
        (("type: list", "type: lists"), r"mine.yaml:1:15: world.type: got 'lists', expected one of .*mean list"),
        (("type: list, ", ""), r"mine.yaml:1:8: world: got .* expected a mapping with a type: one of cloister"),
        (("[[1, 0], [0, 1]]", "[]"), r"mine.yaml:1:31: world.points_m: got \[\], expected at least one point"),
        (("u: [0.5, 0.1]", "u: [0.5]"), r"robots.rover: got .* expected a route whose u has the 2 numbers"),
        (("type: constant", "type: konstant"), r"robots.rover.route.type: got 'konstant', .*did you mean constant"),
        (("steps: 5", "filter: {motion: 3}"), r"mine.yaml:7:10: motion: got an unknown key"),
        (("steps: 5", "noise_on: both"), r"mine.yaml:7:11: noise_on: got 'both', expected"),
        *(
            ((MINE.splitlines()[0], f"world: {{type: race_track, line_m: {line}}}"), "line_m: got .* at least 3 points")
            for line in ("[[0, 0]]", "[[0, 0], [0, 0], [9, 9]]", "[[0, 0], [9, 0], [9, 9], [0, 0]]")
        ),
        (
            ("type: constant, u: [0.5, 0.1]", "type: waypoints, points_m: [[0, 0], [9, 0]], smooth_m: 1"),
            "robots.rover.route.points_m: got .*, expected at least 3 points",
        ),
    ],
)
def test_a_wrong_world_is_refused_with_place_value_and_expectation(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    assert change[0] in MINE
    with pytest.raises(ConfigError, match=said) as error:
        load_world(written(tmp_path, MINE.replace(*change)))
    assert "\n" not in str(error.value)


def test_an_unknown_world_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean cloister"):
        load_world("cloyster")


def test_a_world_is_written_as_a_file_and_read_back(tmp_path: Path) -> None:
    for name in shipped_worlds():
        world = load_world(name, ["filter={estimator: {type: fej}}"])
        assert load_world(written(tmp_path, world.to_yaml())).model_dump() == world.model_dump()


def test_a_world_can_be_written_in_python() -> None:
    world = World(
        world={"type": "cloister", "n": 5},
        robots={"r": {"motion": {"type": "unicycle"}, "route": {"type": "constant", "u": (0.1, 0.0)}}},
        steps=3,
    )
    assert len(simulate(world, 0).truth["r"]) == 4


def test_the_page_about_worlds_names_every_world_key_and_figure() -> None:
    from kalmark.campaign import run_campaign

    page = PAGE.read_text(encoding="utf-8")
    sections = (World, Cloister, Loop, RandomField, Listed, Constant, Waypoints, Wander, Lanes, SimulatedSensing)
    sections += (
        ThickCloister,
        House,
        RandomBox,
        TagRoom,
        ListedTag,
        SimulatedRobot,
        TexturedPlanes,
        TexturedRoom,
        ListedPlane,
    )
    keys = {key for section in sections for key in section.model_fields} - {"type"}
    assert not [key for key in [*keys, *shipped_worlds()] if f"`{key}`" not in page]
    figures = run_campaign(load_world("cloister", ["steps=2"]), 1, jobs=1).summary()["estimators"]["invariant"]
    plain = {key for key in figures if not key.endswith(("_world", "_inside"))} - {"runs", "landmarks"}
    assert not [key for key in plain if f"`{key}`" not in page]


def test_the_examples_on_the_page_about_worlds_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = PAGE.read_text(encoding="utf-8")
    world = load_world(written(tmp_path, page.split("```yaml")[1].split("```")[0]), SMALL)
    assert len(simulate(world, 0).truth["rover"]) == 21
    assert world.config().robots["rover"].motion.sigma_w_radps == 0.04
    monkeypatch.chdir(tmp_path)
    exec(page.split("```python")[1].split("```")[0].replace("steps=300", "steps=30"), {})
    assert (tmp_path / "out/two_robots/map.png").exists()
