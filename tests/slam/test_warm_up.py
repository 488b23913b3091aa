"""A Slam that is warm: no event has to wait for the compiler, and nothing of the Slam has changed."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import kalmark as km

SCRIPT = """
import gc, json, sys
from numba.core.dispatcher import Dispatcher
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

def loaded():
    return {f"{d.py_func.__module__}.{d.py_func.__name__}": len(d.overloads) for d in gc.get_objects()
            if isinstance(d, Dispatcher) and d.py_func.__module__.startswith("kalmark.")}

world = load_world(sys.argv[1])
log = simulate(world, 1)
slam = build_slam(world.config(), log)
slam.warm_up()
before = loaded()
for event in log.events[:400]:
    slam.process(event)
print(json.dumps([name for name, count in loaded().items() if count != before.get(name, 0)]))
"""


@pytest.mark.parametrize("world", ["cloister", "two_robots", "camera", "house", "arva"])
def test_after_warming_up_no_event_compiles_or_loads_anything(world: str) -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT, world], check=True, capture_output=True, text=True)
    assert json.loads(done.stdout) == []


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
