"""Are the causes of a map of walls named, and none where nothing is wrong?"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

import kalmark as km
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis.verdict import Verdict
from kalmark.events import Control, Event, Scan
from kalmark.simulate import load_world, simulate

SENSORS = "robots.robot.sensors={{walls: {{type: wall, range_max_m: 20.0, mount: {{x_m: 0.2}}, sigma_distance_m: {}}}}}"
WORLD = ("steps=300", "ids=true", "robots.robot.sensing={walls: {every: 2}}")
Change = Callable[[Event], Event]


def verdict_on(change: Change | None = None, sigma_m: float = 0.02) -> Verdict:
    log = simulate(load_world("hall_of_walls", (*WORLD, SENSORS.format(0.02))), 1)
    config = load_world("hall_of_walls", (*WORLD, SENSORS.format(sigma_m))).config()
    log = log if change is None else replace(log, events=[*map(change, log.events)])
    run = km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False)
    return km.diagnose(run)


def measuring(column: int, by: float, from_s: float = 0.0) -> Change:
    def changed(e: Event) -> Event:
        if not isinstance(e, Scan) or not len(e.y) or e.t_s < from_s:
            return e
        y = e.y.copy()
        y[:, column] += by
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=y, ids=e.ids)

    return changed


def turns(e: Event) -> Event:
    return Control(t_ns=e.t_ns, robot=e.robot, u=e.u * [1.0, 1.0, 1.08]) if isinstance(e, Control) else e


CASES: dict[str, tuple[dict[str, Any], str, str]] = {
    "noise": ({"sigma_m": 0.008}, "distance_sigma", "2.5"),
    "offset": ({"change": measuring(0, 0.05)}, "range_offset", "distances of robot.walls are 0.05"),
    "turned": ({"change": measuring(1, -math.radians(10.0), 15.0)}, "mount", "from t=15.* turned by 1?[0-9.]* deg"),
    "wheels": ({"change": turns}, "odometry_turn", "is [78].* too large"),
}


@pytest.mark.parametrize("case", CASES)
def test_the_cause_is_named_first(case: str) -> None:
    given, name, told = CASES[case]
    verdict = verdict_on(**given)
    assert verdict.checked.startswith("batch solution")
    assert verdict.causes[0].name == name, verdict.causes
    assert re.search(told, verdict.causes[0].evidence), verdict.causes[0].evidence


def test_a_clean_hall_is_not_accused() -> None:
    verdict = verdict_on()
    assert (verdict.map, verdict.causes) == ("ok", ())
