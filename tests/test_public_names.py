"""Tests of what a user sees of kalmark in a console: names of modules, and objects on a line."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

import numpy as np
import pytest

import kalmark as km
from kalmark.logs.log import Log

MODULES = (
    "association", "detect", "estimators", "geometry", "initialization", "landmarks", "motion", "presets", "sensors",
    "textbook", "vision",
)  # fmt: skip
OF_PLUGINS = ("Verdict", "diagnose", "vision")
PACKAGES = (
    "kalmark.campaign", "kalmark.config", "kalmark.declare", "kalmark.errors", "kalmark.events", "kalmark.logs",
    "kalmark.models.protocols", "kalmark.report", "kalmark.results.history", "kalmark.simulate",
    "kalmark.geometry.directions", "kalmark.geometry.frames3d", "kalmark.geometry.rotations",
)  # fmt: skip


def test_a_console_offers_the_names_of_kalmark_and_no_others() -> None:
    assert dir(km) == sorted([*km.__all__, *OF_PLUGINS, "__version__"])
    assert all(hasattr(km, name) for name in dir(km))
    assert {name for name in dir(km) if isinstance(getattr(km, name), ModuleType)} == {*MODULES}


@pytest.mark.parametrize("module", [*(getattr(km, name) for name in MODULES), *map(import_module, PACKAGES)])
def test_a_public_module_lists_its_names(module: ModuleType) -> None:
    names = module.__all__
    assert len({*names}) == len(names)
    for name in names:
        assert not name.startswith("_")
        home = getattr(getattr(module, name), "__module__", "kalmark")
        assert home.startswith(("kalmark", "builtins", "types")), f"{name} is of {home}"
    defined = [n for n, v in vars(module).items() if isinstance(v, type) and v.__module__ == module.__name__]
    assert {name for name in defined if not name.startswith("_")} <= {*names}


def test_a_slam_a_log_and_a_run_are_shown_on_a_line() -> None:
    lidar = {"lidar": km.Mount(km.sensors.RangeBearing())}
    slam = km.Slam([km.Robot(f"r{k}", km.motion.Unicycle(), sensors=lidar) for k in range(5)])
    assert repr(slam) == "<Slam of 'r0', 'r1', 'r2', 2 more before its first event: 0 landmarks, Invariant, ByIdentity>"
    scans = [km.Scan(t_ns=k * 10**9, robot="r0", sensor="lidar", y=[[2.0, 0.1]], ids=[7]) for k in range(4)]
    log = Log("walk", ("r0",), scans, landmarks={7: np.zeros(2)})
    assert repr(log) == "<Log 'walk' of 'r0': 4 events in 3.0 s, with truth>"
    run = km.record(slam, log, progress=False)
    assert repr(slam) == "<Slam of 'r0', 'r1', 'r2', 2 more at t=3 s: 1 landmarks, Invariant, ByIdentity>"
    assert repr(run) == "<Run 'walk' of 'r0': 4 steps, 4 observations, 1 landmarks>"
    assert repr(run.history) == "<History of 'r0': 4 steps, 4 observations>"
    assert repr(Log("", (), [])) == "<Log '' of none: 0 events>"
