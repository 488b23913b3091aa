"""Causes that pull the solution so far that it has none, or one that says nothing: found with a gate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.batch.problem import Problem
from kalmark.batch.solver import optimum
from kalmark.config import build_slam
from kalmark.config.building import config_dict
from kalmark.events import Event, Scan
from kalmark.geometry import frames
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

WORLD = ("world.count=30", "world.size_m=24", "steps=400", "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0}")
PRECISE = ("robots.rover.sensors.lidar.sigma_range_m=0.03", "robots.rover.sensors.lidar.sigma_bearing_rad=0.01")


@pytest.fixture(autouse=True, params=["solved", "unsolved"])
def solved(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the batch solution be found, or only the robust one, as after a worse start."""

    def only_robust(problem: Problem, *given: Any, **more: Any) -> Any:
        if all(np.isinf(factor.huber) for factor in problem.factors):
            raise km.KalmarkError("no step lowers the cost")
        return optimum(problem, *given, **more)

    if request.param == "unsolved":
        monkeypatch.setattr("kalmark.diagnosis.batch_search.optimum", only_robust)


def run_of(change: Callable[[Scan], Scan], seed: int = 3) -> Run:
    made = load_world("random_field", [*WORLD, *PRECISE])
    log = simulate(made, seed)
    events: list[Event] = [change(e) if isinstance(e, Scan) and e.ids else e for e in log.events]
    log = replace(log, events=events)
    config = made.config()
    return km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False)


def test_ids_of_landmarks_anywhere_are_named() -> None:
    """3 % of the observations have the id of any landmark, most of them many metres away."""
    rng = np.random.default_rng(1)

    def mixed(e: Scan) -> Scan:
        ids = list(e.ids or ())
        for k in np.flatnonzero(rng.random(len(ids)) < 0.03):
            other = int(rng.integers(30))
            ids[k] = ids[k] if other in ids else other
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y, ids=ids)

    run = run_of(mixed)
    verdict = km.diagnose(run)
    assert (verdict.map, verdict.causes[0].name) == ("ok", "wrong_ids")  # the filter leaves them out


def test_a_landmark_that_goes_far_is_named_before_outliers() -> None:
    made = load_world("random_field", [*WORLD, *PRECISE])
    log, rng = simulate(made, 3), np.random.default_rng(0)
    truth, ids = log.truth["rover"], [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    goes = max(set(ids), key=ids.count)

    def moving(e: Scan) -> Scan:
        if goes not in (e.ids or ()):
            return e
        pose = frames.compose(truth.poses[np.searchsorted(truth.t_ns, e.t_ns)], np.array([0.3, 0.0, 0.0]))[0]
        place = np.array(log.landmarks[goes][:2]) + 0.06 * e.t_s * np.array([0.8, 0.6])
        y = frames.observe(pose, place)[0] + rng.normal(size=2) * (0.03, 0.01)
        mine = np.equal(np.array(e.ids), goes)[:, None]
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=np.where(mine, y, e.y), ids=e.ids)

    verdict = km.diagnose(run_of(moving))
    assert verdict.causes[0].name == "moving_landmark" and f"landmark {goes} moves" in verdict.causes[0].evidence
