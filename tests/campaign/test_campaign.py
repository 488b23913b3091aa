"""Campaigns: reproducible whatever the workers, honest against chi-square, saved, and strict about input."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.campaign import Campaign, run_campaign
from kalmark.campaign.campaign import curves
from kalmark.campaign.running import Plan, configs_of, joblib_backend
from kalmark.campaign.scoring import SERIES, Scores
from kalmark.errors import ConfigError, KalmarkError
from kalmark.simulate import load_world

FAST = ["new_per_step=null", "max_per_scan=5"]

# Nearly linear: the heading is all but known, so the textbook filter and the invariant one are both optimal.
LINEAR = """\
world: {type: list, points_m: [[3, 1], [3, -1], [5, 2], [-1, -2]]}
robots:
  rover:
    start: {sigma_xy_m: 0.2, sigma_theta_rad: 1.0e-6}
    route: {type: constant, u: [0.05, 0.0, 0.0]}
    motion: {type: odometry_2d, sigma_x_m: 0.05, sigma_y_m: 0.05, sigma_theta_rad: 1.0e-7}
    sensors: {tracker: {type: position, sigma_x_m: 0.1, sigma_y_m: 0.05}}
steps: 30
filter: {association: {type: identity, gate: off}}
"""


@pytest.fixture(scope="module")
def small() -> Campaign:
    return run_campaign(load_world("cloister", [*FAST, "steps=40"]), 3, ["invariant", "ekf"], seed=5, jobs=1)


def same(a: Scores, b: Scores) -> bool:
    """Return whether two scores are equal bit for bit."""
    return all(a.series[key].tobytes() == b.series[key].tobytes() for key in SERIES)


def linear(tmp_path: Path) -> Path:
    path = tmp_path / "linear.yaml"
    path.write_text(LINEAR)
    return path


def test_the_numbers_are_the_same_with_one_worker_and_with_two(small: Campaign) -> None:
    world = load_world("cloister", [*FAST, "steps=40"])
    two = run_campaign(world, 3, ["invariant", "ekf"], seed=5, jobs=2, progress=False)
    assert json.dumps(two.summary()) == json.dumps(small.summary())
    for name, scores in small.scores.items():
        assert all(same(a, b) for a, b in zip(scores, two.scores[name], strict=True))


def test_more_runs_begin_with_the_same_ones_and_another_seed_gives_others(small: Campaign) -> None:
    world = load_world("cloister", [*FAST, "steps=40"])
    one = run_campaign(world, 1, ["invariant"], seed=5, jobs=1)
    other = run_campaign(world, 1, ["invariant"], seed=6, jobs=1)
    assert same(one.scores["invariant"][0], small.scores["invariant"][0])
    assert not same(other.scores["invariant"][0], one.scores["invariant"][0])


def test_on_a_nearly_linear_world_both_filters_are_consistent_and_agree(tmp_path: Path) -> None:
    f = run_campaign(linear(tmp_path), 80, ["ekf", "invariant"], seed=1, jobs=1, map_every=1).summary()["estimators"]
    for figures in f.values():
        assert figures["diverged"] == 0
        for name, ideal in (("pose", 3), ("heading", 1), ("landmarks", 2), ("joint", 1)):
            assert figures[f"{name}_anees"] == pytest.approx(ideal, rel=0.2)
            assert figures[f"{name}_inside"] > 0.8
        assert figures["nis_per_dof"] == pytest.approx(1.0, rel=0.05)
        assert figures["pose_anees_world"] == pytest.approx(figures["pose_anees"], rel=1e-3)
    assert f["ekf"]["position_rmse_m"] == pytest.approx(f["invariant"]["position_rmse_m"], rel=1e-3)


def test_a_filter_told_too_little_noise_is_found_out(tmp_path: Path) -> None:
    half = "{tracker: {sigma_x_m: 0.05, sigma_y_m: 0.025}}"
    sure = f"filter={{association: {{gate: off}}, robots: {{rover: {{sensors: {half}}}}}}}"
    f = run_campaign(load_world(linear(tmp_path), [sure]), 20, seed=1, jobs=1).summary()["estimators"]["invariant"]
    assert f["nis_per_dof"] > 1.8
    assert f["joint_anees"] > 1.8 and f["joint_inside"] < 0.2


def test_map_and_joint_state_are_scored_every_so_many_steps_and_at_the_last(small: Campaign) -> None:
    series = small.scores["invariant"][0].series
    assert np.isfinite(series["landmarks"][0]).nonzero()[0].tolist() == [9, 19, 29, 39]
    assert np.isfinite(series["position_m"]).all()
    assert series["joint_dof"][0, 39] == 3 + 2 * small.scores["invariant"][0].landmarks


def test_withheld_ids_are_scored_by_what_was_really_seen() -> None:
    world = load_world("cloister", [*FAST, "steps=40", "ids=false"])
    score = run_campaign(world, 1, seed=5, jobs=1).scores["invariant"][0]
    assert score.landmarks >= 5
    assert np.isfinite(score.series["joint"][0, 39])
    assert score.landmark_rmse_raw_m < 1.0


def test_several_robots_have_a_row_each() -> None:
    campaign = run_campaign(load_world("two_robots", ["steps=30"]), 1, seed=1, jobs=1)
    series = campaign.scores["invariant"][0].series
    assert campaign.robots == ("alpha", "beta")
    assert series["pose"].shape == (2, 30) and np.isfinite(series["pose"][:, 20:]).any(axis=1).all()
    assert np.nanmax(series["joint_dof"]) > 6


def test_a_robot_that_has_not_been_moved_up_to_a_scan_is_not_held_against_its_truth_of_then(tmp_path: Path) -> None:
    robot = """{motion: {type: unicycle, sigma_v_mps: 0.02}, route: {type: constant, u: [0.5, 0.1]},
      start: {x_m: X, y_m: 3}, sensors: {lidar: {type: range_bearing, sigma_range_m: 0.05, range_max_m: 8}}}"""
    robots = f"robots:\n  a: {robot.replace('X', '3')}\n  b: {robot.replace('X', '8')}\n"
    path = tmp_path / "two.yaml"
    path.write_text(f"world: {{type: random_field, count: 20, size_m: 14}}\n{robots}steps: 20\ndt_s: 0.2\n")
    scores = run_campaign(load_world(path), 3, jobs=1).scores["invariant"]
    last = np.array([s.series["joint"][:, -1] / s.series["joint_dof"][:, -1] for s in scores])
    assert (last < 2.5).all(), "no control follows the last step, so the second robot is moved by its own scan alone"
    assert all(s.series["joint_dof"][0, -1] == s.series["joint_dof"][1, -1] - 3 for s in scores)


def test_a_saved_campaign_has_figures_a_row_a_step_and_a_picture(small: Campaign, tmp_path: Path) -> None:
    folder = small.save(tmp_path / "out")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary == small.summary()
    assert set(summary["estimators"]) == {"invariant", "ekf"}
    assert load_world(folder / "world.yaml").model_dump() == load_world("cloister", [*FAST, "steps=40"]).model_dump()
    with (folder / "anees.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 40
    last = rows[39]
    assert (last["estimator"], last["robot"], last["step"], last["runs"]) == ("invariant", "robot", "40", "3")
    assert float(last["pose_low"]) < 3 < float(last["pose_high"])
    assert (folder / "anees.png").read_bytes().startswith(b"\x89PNG")


def test_no_curve_is_drawn_across_a_gap_in_time_but_across_steps_without_a_value() -> None:
    t_s, value = np.arange(20.0) + 100.0 * (np.arange(20) >= 10), np.arange(20.0)
    value[[3, 15]] = np.nan
    t, mean, double = curves(t_s, value, 2 * value)
    assert np.flatnonzero(np.isnan(t)).tolist() == np.flatnonzero(np.isnan(mean)).tolist() == [9]
    assert mean[[2, 3, 8, 10]].tolist() == [2.0, 4.0, 9.0, 10.0]
    np.testing.assert_array_equal(double, 2 * mean)
    assert [len(row) for row in curves(t_s, np.full(20, np.nan))] == [0, 0]


def test_an_estimator_may_be_given_with_a_key_of_its_own() -> None:
    configs = configs_of(load_world("cloister"), ["invariant", "invariant:iterations=1"])
    assert [c.estimator.iterations for c in configs.values()] == [30, 1]
    assert [*configs_of(load_world("cloister", ["filter.estimator.type=fej"]), None)] == ["fej"]


def test_the_worlds_own_estimator_keeps_its_keys_unless_they_are_given_anew() -> None:
    world = load_world("cloister", ["filter.estimator.type=invariant", "filter.estimator.iterations=2"])
    configs = configs_of(world, ["invariant", "invariant:iterations=3"])
    assert [c.estimator.iterations for c in configs.values()] == [2, 3]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"runs": 0}, "runs is 0, expected a whole number of at least 1"),
        ({"runs": 1, "seed": -1}, "seed is -1, expected"),
        ({"runs": 1, "jobs": 0}, "jobs is 0, expected"),
        ({"runs": 1, "map_every": 0}, "map_every is 0, expected"),
        ({"runs": 1, "skip": 3000}, "skip is 3000, expected less than the [0-9]+ steps"),
        ({"runs": 1, "estimators": ["efk"]}, "estimator is 'efk', expected one of .*did you mean ekf"),
        ({"runs": 1, "estimators": []}, "got no estimator"),
        ({"runs": 1, "estimators": ["ekf", "ekf"]}, "given twice"),
        (
            {"runs": 1, "estimators": ["invariant:iterations=many"]},
            "estimator.iterations: got 'many', expected a whole",
        ),
        ({"runs": 1, "backend": "mpi"}, "backend is 'mpi', expected one of loky, dask, ray"),
    ],
)
def test_bad_arguments_are_refused_with_value_and_expectation(arguments: dict[str, object], said: str) -> None:
    with pytest.raises(KalmarkError, match=said) as error:
        run_campaign(load_world("cloister", ["steps=2"]), **arguments)
    assert "\n" not in str(error.value)


def test_an_unknown_world_is_refused() -> None:
    with pytest.raises(ConfigError, match="did you mean cloister"):
        run_campaign("cloysters", 1)


@pytest.mark.parametrize(("backend", "packages"), [("dask", "dask distributed"), ("ray", "ray")])
def test_a_backend_that_is_not_installed_says_what_to_install(
    backend: str, packages: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, {"dask": "dask.distributed", "ray": "ray.util.joblib"}[backend], None)
    with pytest.raises(KalmarkError, match=f"pip install {packages}"), joblib_backend(backend):
        pass


def test_a_filter_that_refuses_to_go_on_counts_as_diverged(monkeypatch: pytest.MonkeyPatch) -> None:
    from kalmark.errors import DivergedError
    from kalmark.slam.slam import Slam

    whole = Slam.process

    def process(self: Slam, event: Any) -> object:
        if event.t_ns > 1_000_000_000:
            raise DivergedError("no longer positive definite")
        return whole(self, event)

    monkeypatch.setattr(Slam, "process", process)
    world = load_world("cloister", [*FAST, "steps=20"])
    score = Plan(world, configs_of(world, ["ekf"]), 0, 10).run(0)["ekf"]
    assert score.diverged and score.stopped == "no longer positive definite"
    assert np.isnan(score.series["pose"][0, 10:]).all() and np.isfinite(score.series["position_m"][0, :10]).all()
