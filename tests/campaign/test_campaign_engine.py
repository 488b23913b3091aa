"""The batched engine has the numbers of the ordinary path, and says why where it does not run a world."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.campaign import run_campaign, running
from kalmark.campaign.engine import Engine, refusal
from kalmark.campaign.running import BATCHED, Plan, configs_of, group_tasks, path_of
from kalmark.campaign.scoring import SERIES, Scores
from kalmark.simulate import World, load_world

DRIVE = """\
world: {{type: random_field, count: 12, size_m: 12.0}}
robots:
  rover:
    start: {{x_m: 1.0, y_m: -2.0, theta_rad: 0.5, sigma_xy_m: 0.2, sigma_theta_rad: 0.05}}
    route: {route}
    motion: {{type: {motion}, sigma_along_m_per_sqrt_s: 0.01, sigma_across_m_per_sqrt_s: 0.01}}
    sensors:
      laser: {{type: {sensor}, mount: {{x_m: 0.3, y_m: -0.1, theta_rad: 0.2}}}}
    sensing: {{laser: {sensing}}}
steps: 150
dt_s: 0.3
{rest}
"""
WAYPOINTS = "{type: waypoints, points_m: [[3, 1], [-2, 4], [-3, -3]], speed_mps: 0.7, turn_radius_m: 0.8}"
LOOKING_ALL_ROUND = "range_bearing, sigma_range_m: 0.05, sigma_bearing_rad: 0.02"
PLACES = "position, sigma_x_m: 0.05, sigma_y_m: 0.1, range_max_m: 6.0"
SIGNATURES = "range_bearing_signature, sigma_range_m: 0.05, sigma_range_rel: 0.02, sigma_signature: 0.3"
HALF_BLIND = (
    "range_bearing, sigma_range_m: 0.05, sigma_range_rel: 0.03, range_min_m: 0.5, range_max_m: 4.0, fov_rad: 4.0"
)
WRONG_SCALE = "range_bearing, scale: 1.1, bias_m: 0.05, range_max_m: 8.0"
CASES: dict[str, tuple[str, list[str]]] = {
    "one new landmark a step": ("cloister", ["steps=60"]),
    "a range noise that grows": ("loop_b2", ["steps=200"]),
    "velocities": (
        DRIVE.format(
            route="{type: wander, turn_radius_m: 0.5}", motion="unicycle", sensor=HALF_BLIND,
            sensing="{every: 2, first: 1}", rest="noise_on: robot",
        ),
        [],
    ),
    "a car": (
        DRIVE.format(
            route=WAYPOINTS, motion="ackermann, wheelbase_m: 0.5, encoder_offset_m: 0.2", sensor=WRONG_SCALE,
            sensing="{dropouts: 0.2, faults_from_step: 20}", rest="max_per_scan: 4",
        ),
        [],
    ),
    "increments along lanes": (
        DRIVE.format(
            route="{type: lanes, spacing_m: 4.0}", motion="odometry_2d", sensor=LOOKING_ALL_ROUND, sensing="{}",
            rest="{new_per_step: 2, max_per_scan: 5}".strip("{}").replace(", ", "\n"),
        ),
        [],
    ),
    "places": (DRIVE.format(route=WAYPOINTS, motion="unicycle", sensor=PLACES, sensing="{}", rest=""), []),
    "signatures, and a range noise that grows": (
        DRIVE.format(route=WAYPOINTS, motion="odometry_2d", sensor=SIGNATURES, sensing="{every: 2}", rest=""), [],
    ),
    "hidden landmarks": ("cloister", ["steps=60", "robots.robot.sensing={lidar: {dropouts: 0.1, hidden: [3]}}"]),
    "stops of the robot": (
        "loop_b2", ["steps=200", "robots.robot.route={type: constant, u: [0.25, 0, 0.025], stop_s: 3.0, ramp_s: 1.0}"],
    ),
    "stops without noise": (
        "loop_b2",
        ["steps=200", "noise_on=robot", "robots.robot.motion.sigma_along_m_per_sqrt_s=0.01",
         "robots.robot.route={type: constant, u: [0.25, 0, 0.025], stop_s: 3.0}"],
    ),
}  # fmt: skip


def world_of(case: str, tmp_path: Path) -> World:
    text, overrides = CASES[case]
    if "\n" not in text:
        return load_world(text, overrides)
    (tmp_path / "drive.yaml").write_text(text)
    return load_world(tmp_path / "drive.yaml", overrides)


def assert_equal(a: Scores, b: Scores, tolerance: float) -> None:
    """Compare two scores; NaN stands at the same steps."""
    for key in SERIES:
        np.testing.assert_allclose(a.series[key], b.series[key], rtol=tolerance, atol=tolerance, err_msg=key)
    for key in ("landmark_rmse_m", "landmark_rmse_raw_m", "nis"):
        assert getattr(a, key) == pytest.approx(getattr(b, key), rel=tolerance)
    for key in ("landmarks", "nis_dof", "diverged", "stopped"):
        assert getattr(a, key) == getattr(b, key)


@pytest.mark.parametrize("case", CASES)
def test_a_run_has_the_numbers_of_the_ordinary_path(case: str, tmp_path: Path) -> None:
    world = world_of(case, tmp_path)
    plan = Plan(world, configs_of(world, ["invariant", "ekf", "invariant:iterations=1"]), seed=3, map_every=7)
    assert refusal(plan.world, plan.configs) == ""
    engine = Engine(world, plan.configs)
    for number in range(2):
        scores, ordinary = engine.run(np.random.SeedSequence(3, spawn_key=(number,)), 7), plan.run(number)
        assert scores is not None and np.isfinite(ordinary["ekf"].series["joint"]).any()
        for name, score in scores.items():
            assert_equal(score, ordinary[name], 1e-9)
            for key in ("position_m", "heading_rad"):  # of the estimate; a held control's last part has its own error
                np.testing.assert_allclose(score.series[key][:, :-1], ordinary[name].series[key][:, :-1], 0, 1e-12)


@pytest.mark.parametrize(
    ("name", "overrides", "estimator", "why"),
    [
        ("two_robots", [], "ekf", "one robot of the plane"),
        ("thick_cloister", [], "ekf", "one robot of the plane"),
        ("cloister", [], "fej", "no estimator fej"),
        ("loop_c", ["world.count=200"], "invariant", "up to 193 landmarks"),
        ("cloister", ["ids=false"], "invariant", "known ids"),
        ("camera", [], "invariant", "determine points"),
        ("cloister", ["robots.robot.sensing={lidar: {outliers: 0.1}}"], "invariant", "no outliers"),
        ("cloister", ["filter={landmarks: {type: polar}}"], "invariant", "determine points"),
        ("cloister", ["filter={map: {type: postponed}}"], "invariant", "dense maps"),
    ],
)
def test_what_the_engine_does_not_run_is_said(name: str, overrides: list[str], estimator: str, why: str) -> None:
    world = load_world(name, overrides)
    assert why in refusal(world, configs_of(world, [estimator]))


def small(world: World, monkeypatch: pytest.MonkeyPatch, **arguments: Any) -> Any:
    """Run a campaign whose few steps are worth the engine."""
    monkeypatch.setattr(running, "WORTH", 1)
    return run_campaign(world, 5, ["invariant"], seed=5, progress=False, **arguments)


def test_a_campaign_says_its_path_and_its_numbers_do_not_depend_on_the_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = load_world("loop_b2", ["steps=40"])
    assert "so few steps" in run_campaign(world, 1, ["invariant"], progress=False).summary()["path"]
    monkeypatch.setattr(running, "AT_ONCE", 80)
    one, two = (small(world, monkeypatch, jobs=jobs) for jobs in (1, 2))
    one.save(tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["path"] == "batched engine"
    for a, b in zip(one.scores["invariant"], two.scores["invariant"], strict=True):
        assert all(a.series[key].tobytes() == b.series[key].tobytes() for key in SERIES)


def test_a_run_that_the_engine_leaves_takes_the_ordinary_path(monkeypatch: pytest.MonkeyPatch) -> None:
    world, run = load_world("loop_b2", ["steps=40"]), Engine.run
    whole = small(world, monkeypatch, jobs=1).scores["invariant"]
    left = np.random.SeedSequence(5, spawn_key=(2,)).spawn_key

    def sometimes(self: Engine, seed: np.random.SeedSequence, map_every: int) -> Any:
        return None if seed.spawn_key == left else run(self, seed, map_every)

    monkeypatch.setattr(Engine, "run", sometimes)
    for number, (a, b) in enumerate(zip(small(world, monkeypatch, jobs=1).scores["invariant"], whole, strict=True)):
        assert_equal(a, b, 1e-9 if number == 2 else 0.0)


def test_runs_of_the_engine_are_done_many_at_once_and_those_of_the_ordinary_path_alone() -> None:
    world = load_world("cloister", ["steps=10"])
    plan = Plan(world, configs_of(world, ["ekf", "invariant"]), 0, 10)
    fast = replace(plan, path=path_of(plan, running.WORTH))
    assert fast.path == BATCHED and path_of(plan, 1) == running.FEW
    tasks = [(cell, number) for cell in range(2) for number in range(3)]
    assert group_tasks([plan, fast], tasks) == [(0, [0]), (0, [1]), (0, [2]), (1, [0, 1, 2])]
