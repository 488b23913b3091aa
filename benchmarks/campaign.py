"""Steps a core-second of a campaign: the batched engine and the ordinary path, on the same runs.

    python benchmarks/campaign.py [--runs 5] [--steps 1000] [--landmarks 50] [--observations 6]

A robot wanders in a field of landmarks and observes the nearest ones.  For each estimator, run by run in turn, one
thread, processor time: the simulation, the filter and the scores of a run, by `Slam.process` and by the engine; the
least time of a run counts, and the ratio is the result.  Below it the parts of the engine, and the largest difference
of any number of the runs.  Compilation does not count here: `--compile` measures it, with an empty cache, by processor
time: what the engine adds to what the ordinary path compiles, and after how many steps it has paid for that.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ways import conditions, pin

from kalmark.campaign import engine
from kalmark.campaign.running import BATCHED, Plan, configs_of
from kalmark.simulate import World, load_world

ESTIMATORS = ("invariant", "invariant:iterations=1", "ekf")
PARTS = ("drive_all", "by_landmark", "filter_run", "scores_of")
WORLD = """\
world: {{type: random_field, count: {landmarks}, size_m: 20.0}}
robots:
  rover:
    route: {{type: wander}}
    motion: {{type: odometry_2d, sigma_x_m: 0.01, sigma_y_m: 0.002, sigma_theta_rad: 0.01}}
    sensors: {{lidar: {{type: range_bearing, sigma_range_m: 0.1, sigma_bearing_rad: 0.02, range_max_m: 12.0}}}}
steps: {steps}
max_per_scan: {observations}
"""


def world_of(landmarks: int, observations: int, steps: int) -> World:
    """Return a field of so many landmarks, of which so many are observed in each of so many steps."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "field.yaml"
        path.write_text(WORLD.format(landmarks=landmarks, observations=observations, steps=steps))
        return load_world(path)


def timed(call: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Return the seconds of processor time that a call takes, and its result."""
    begin = time.thread_time()
    result = call(*arguments)
    return time.thread_time() - begin, result


def difference(a: Any, b: Any) -> float:
    """Return the largest difference of two scores, relative where numbers are larger than 1."""
    return max(
        float(np.nanmax(np.abs(a.series[key] - b.series[key]) / np.maximum(1.0, np.abs(b.series[key])), initial=0.0))
        for key in a.series
    )


def measure(world: World, estimator: str, runs: int) -> None:
    """Print the row of an estimator."""
    plan = Plan(world, configs_of(world, [estimator]), 0, 10)
    fast = replace(plan, path=BATCHED)
    spent: dict[str, list[float]] = {}

    def part(name: str) -> Any:
        inner = getattr(engine, name)

        def call(*arguments: Any) -> Any:
            seconds, result = timed(inner, *arguments)
            spent.setdefault(name, []).append(seconds)
            return result

        return call

    made = fast.engine()
    assert made is not None

    def by_engine(number: int) -> Any:
        return made.run(np.random.SeedSequence(0, spawn_key=(number,)), plan.map_every)

    by_engine(0), plan.run(0)  # compiles, or loads
    slow_s, fast_s, worst = [], [], 0.0
    for number in range(runs):
        seconds, ordinary = timed(plan.run, number)
        slow_s.append(seconds)
        for _ in range(5):
            seconds, scores = timed(by_engine, number)
            fast_s.append(seconds)
        worst = max(worst, difference(scores[estimator], ordinary[estimator]))
    functions = {name: getattr(engine, name) for name in PARTS}
    for name in PARTS:
        setattr(engine, name, part(name))
    for _ in range(5):
        by_engine(0)
    for name in PARTS:
        setattr(engine, name, functions[name])
    slow, quick = (1e6 * min(times) / world.steps for times in (slow_s, fast_s))
    shares = ", ".join(f"{name} {1e6 * min(spent[name]) / world.steps:.1f}" for name in PARTS)
    print(f"| {estimator} | {1e6 / slow:,.0f} | {1e6 / quick:,.0f} | {slow / quick:.1f} | {worst:.0e} | {shares} |")


def compilation(world: World, estimator: str) -> None:
    """Do a run in a process with an empty cache, along both paths; print what the engine adds."""
    spent = []
    for path in ("", BATCHED):
        code = (
            "import sys, time; from campaign import Plan, configs_of, world_of; n, k, s = map(int, sys.argv[1:4]); "
            "w = world_of(n, k, s); plan = Plan(w, configs_of(w, [sys.argv[4]]), 0, 10, sys.argv[5]); plan.run(0); "
            "plan.run(0) if not sys.argv[5] else next(Plan(w, plan.configs, 0, 10).some((0,)))"
        )
        sizes = [str(len(world.world.scenery(np.random.default_rng(0)).points)), str(world.max_per_scan), "100"]
        with tempfile.TemporaryDirectory() as cache:
            before = os.times()
            subprocess.run(
                [sys.executable, "-c", code, *sizes, estimator, path], check=True, cwd=Path(__file__).parent,
                env={**os.environ, "KALMARK_CACHE": cache}, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            after = os.times()
        spent.append(after.children_user + after.children_system - before.children_user - before.children_system)
    print(f"compiled, {estimator}: ordinary path {spent[0]:.0f} s, the engine adds {spent[1] - spent[0]:.0f} s")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("runs", 5), ("steps", 1000), ("landmarks", 50), ("observations", 6)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--compile", action="store_true", help="measure what the engine adds to compilation")
    options = parser.parse_args()
    pin()
    print(conditions())
    world = world_of(options.landmarks, options.observations, options.steps)
    if options.compile:
        compilation(world, "invariant")
        return
    print(f"\n{options.landmarks} landmarks, {options.observations} observations a step; steps a core-second\n")
    print(
        "| estimator | ordinary path | batched engine | ratio | largest difference | parts of the engine, us a step |"
    )
    print("|---|---|---|---|---|---|")
    for estimator in ESTIMATORS:
        measure(world, estimator, options.runs)


if __name__ == "__main__":
    main()
