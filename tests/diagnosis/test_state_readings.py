"""Is it named what is wrong with a sensor of the state, with its figure and its cure?"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import kalmark as km
from kalmark.config.building import build_slam, config_dict
from kalmark.diagnosis.mistakes import change_measurements
from kalmark.diagnosis.named_causes import MISFIT
from kalmark.diagnosis.state_readings import NAMES, reasons
from kalmark.diagnosis.trials import Trials
from kalmark.diagnosis.verdict import diagnose
from kalmark.simulate import load_world
from kalmark.simulate.robots import Simulation, simulation

ARM = {"mount.x_m": 1.2, "mount.sigma_xy_m": 0.0}
SENSORS = "robots.robot.sensors"
KNOWN = f"{SENSORS}.receiver.mount={{x_m: 0.2}}"  # truly there


def run_of(keys: dict[str, float], by: dict[str, tuple[float, ...]], seed: int = 1) -> tuple[km.Run, Simulation]:
    """Return the run of a filter that is told `keys` of a receiver, of readings that are multiplied, and its log."""
    given = [f"filter.{SENSORS}.receiver.{key}={value}" for key, value in keys.items()]
    world = load_world("lever_arm", ["steps=400", KNOWN, *given])
    simulated = simulation(world, seed)
    log = simulated.log
    for sensor, factors in by.items():
        change = change_measurements({("robot", sensor)}, lambda y, factors=factors: y * factors)
        log = replace(log, events=[change(event) for event in log])
    config = world.config()
    run = km.record(build_slam(config, log), log, progress=False, pictures=False, config=config_dict(config))
    return run, replace(simulated, log=log)


@pytest.mark.parametrize(
    ("keys", "by", "name", "cures"),
    [
        ({"sigma_m": 0.05 / 3}, {}, "reading_sigma", {f"{SENSORS}.receiver.sigma_m": 0.05}),
        (ARM, {}, "mount_position", {f"{SENSORS}.receiver.mount.x_m": 0.2, f"{SENSORS}.receiver.mount.y_m": 0.0}),
        ({}, {"receiver": (-1.0, 1.0)}, "reading_sign", {"log.factors.robot.receiver.x_m": -1.0}),
    ],
    ids=["noise", "arm", "sign"],
)
def test_what_is_wrong_with_a_receiver_is_named_with_its_figure(
    keys: dict[str, float], by: dict[str, tuple[float, ...]], name: str, cures: dict[str, float]
) -> None:
    run, simulated = run_of(keys, by)
    verdict = diagnose(run)
    first = verdict.causes[0]
    assert verdict.map != "ok" and first.name == name and "robot.receiver" in first.evidence
    told = dict(part.split("=") for part in first.cure.replace("--set ", "").split())
    assert {key: float(value) for key, value in told.items()} == pytest.approx(cures, abs=0.15)
    assert first.score > 50 and np.isfinite(first.score)
    assert next(cause.name for cause in reasons(run, simulated.log, Trials())[0]) == name


@pytest.mark.parametrize(
    ("sensor", "number", "since_s", "by"),
    [("compass", "declination_rad", 0.0, 0.3), ("gyro", "bias_radps", 30.0, 0.04)],
)
def test_a_constant_that_most_readings_fit_is_found(sensor: str, number: str, since_s: float, by: float) -> None:
    """A declination turns the map, so that only the first readings do not fit; a bias may begin midway."""
    sensors = "{lidar: {type: range_bearing, sigma_range_m: 0.1, sigma_bearing_rad: 0.03, range_max_m: 4.0}"
    sensors += ", compass: {type: heading, sigma_heading_rad: 0.05}, gyro: {type: gyro, sigma_radps: 0.005}}"
    world = load_world("compass_and_gyro", [f"robots.robot.sensors={sensors}", "robots.robot.sensing={}", "steps=600"])
    log, change = simulation(world, 2).log.without_truth(), change_measurements({("robot", sensor)}, lambda y: y + by)
    log = replace(log, events=[change(event) if event.t_s >= since_s else event for event in log])
    run = km.record(build_slam(world.config(), log), log, progress=False, config=config_dict(world.config()))
    first = diagnose(run, brief=True).causes[0]
    assert first.name == "reading_offset" and first.since_s == pytest.approx(since_s, abs=5.0)
    found = re.search(rf"readings of robot.{sensor} fit with {number} (-?[0-9.]+)", first.evidence)
    assert found is not None and abs(float(found[1])) == pytest.approx(by, rel=0.35), first.evidence
    assert first.evidence.startswith("from t=") == (since_s > 0.0) == (not first.cure)


def test_a_right_receiver_is_not_accused() -> None:
    verdicts = [diagnose(run_of({}, {}, seed)[0]) for seed in range(4)]
    names = {cause.name for verdict in verdicts for cause in verdict.causes if not cause.harmless}
    assert not names & {*NAMES, MISFIT}
