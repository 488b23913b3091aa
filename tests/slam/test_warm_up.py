"""A Slam that is warm: no event has to wait for the compiler, and nothing of the Slam has changed."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter import corrections

SCRIPT = """
import gc, json, sys
from numba.core.dispatcher import Dispatcher
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

def loaded():
    return {f"{d.py_func.__module__}.{d.py_func.__name__}": len(d.overloads) for d in gc.get_objects()
            if isinstance(d, Dispatcher) and d.py_func.__module__.startswith("kalmark.")}

world = load_world(sys.argv[1], sys.argv[2:])
log = simulate(world, 1)
slam = build_slam(world.config(), log)
slam.warm_up()
before, modules = loaded(), set(sys.modules)
for event in log.events[:400]:
    slam.process(event)
late = [name for name, count in loaded().items() if count != before.get(name, 0)]
print(json.dumps(late + sorted(set(sys.modules) - modules)))
"""


FIELD = ("random_field", "world.size_m=20", "world.count=200")  # so many landmarks that the map is compressed
WORLDS = (
    ("cloister",), ("two_robots",), ("camera",), ("house",), ("arva",), ("self_calibration",), ("hall_of_walls",),
    FIELD, (*FIELD, "ids=false"),
)  # fmt: skip


@pytest.mark.parametrize("world", WORLDS, ids=" ".join)
def test_after_warming_up_no_event_compiles_or_loads_anything(world: tuple[str, ...]) -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT, *world], check=True, capture_output=True, text=True)
    assert json.loads(done.stdout) == []


def test_a_scan_with_its_own_noise_is_corrected_by_the_code_that_is_there() -> None:
    eye = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={"eye": eye})])
    counts = set()
    for k, cov in enumerate((None, None, np.diag([1e-2, 4e-4]), np.diag([1e-2, 4e-4])[None])):
        slam.process(km.Scan(k, "r", "eye", np.array([[2.0, 0.3]]), [1], cov=cov))
        counts.add(len(corrections.invariant.overloads))
    assert len(counts - {0}) == 1


def state(slam: km.Slam) -> tuple[Any, ...]:
    return slam.t_ns, slam.mean("r").tolist(), slam.covariance("r").tolist(), slam.landmarks().ids, slam.map.used


def test_warming_up_changes_nothing_before_the_first_event_or_between_two() -> None:
    eye = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={"eye": eye})], km.association.NearestNeighbour())
    for _ in range(2):
        before = state(slam)
        slam.warm_up()
        assert state(slam) == before
        slam.process(km.Scan(1, "r", "eye", np.array([[2.0, 0.3]])))
