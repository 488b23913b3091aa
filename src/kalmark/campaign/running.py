"""Monte Carlo: N runs of a world over processes, every estimator on the same logs.

Each run takes its seed from the campaign's by `SeedSequence.spawn` and computes with one BLAS thread, so the numbers
are the same whatever the number of workers.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, cpu_count, delayed, parallel_config
from threadpoolctl import threadpool_limits

from kalmark.campaign.campaign import Campaign
from kalmark.campaign.scoring import Scores, score
from kalmark.config.building import build_slam
from kalmark.config.reading import did_you_mean, validate
from kalmark.config.schema import Config
from kalmark.config.tree import Tree
from kalmark.errors import ConfigError, KalmarkError
from kalmark.results.progress import track
from kalmark.simulate.robots import simulation
from kalmark.simulate.worlds import World, load_world

BACKENDS = ("loky", "dask", "ray")
ESTIMATORS = ("invariant", "ekf", "fej")


@dataclass(frozen=True)
class Plan:
    """What every run of a campaign does; sent to the workers."""

    world: World
    configs: dict[str, Config]
    seed: int
    map_every: int

    def steps(self) -> tuple[int, ...]:
        """Return the times (ns) of the steps."""
        return tuple(round(k * self.world.dt_s * 1e9) for k in range(1, self.world.steps + 1))

    def run(self, number: int) -> dict[str, Scores]:
        """Simulate run `number` and score every estimator on it."""
        with threadpool_limits(1):
            simulated = simulation(self.world, np.random.SeedSequence(self.seed, spawn_key=(number,)))
            steps = self.steps()
            return {
                name: score(build_slam(config, simulated.log), simulated, steps, self.map_every)
                for name, config in self.configs.items()
            }


def run_campaign(
    world: World | str | Path,
    runs: int,
    estimators: Sequence[str] | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: str = "loky",
    progress: bool = True,
    map_every: int = 10,
    skip: int = 0,
) -> Campaign:
    """Run a world (or the path or name of one) `runs` times and return the figures of each estimator.

    `estimators` are names like "invariant", "ekf" or, with a key of theirs, "invariant:iterations=1"; by default the
    one in the world's `filter`.  `jobs` is the number of processes (default: one a core).  Landmarks and joint state
    are scored every `map_every` steps; averages of NEES leave out the first `skip` steps.  Raises ConfigError or
    KalmarkError on anything that cannot be run.
    """
    world = world if isinstance(world, World) else load_world(world)
    limits = (("runs", runs, 1), ("seed", seed, 0), ("map_every", map_every, 1), ("jobs", jobs, 1), ("skip", skip, 0))
    for name, value, least in limits:
        if value is not None and (not isinstance(value, int) or value < least):
            raise KalmarkError(f"campaign: {name} is {value!r}, expected a whole number of at least {least}")
    configs = configs_of(world, estimators)
    plan = Plan(world, configs, seed, map_every)
    results = list(track(results_of(plan, runs, jobs, backend), f"campaign {world.name}", runs, show=progress))
    return Campaign(
        world=world.name,
        description=world.to_yaml(),
        seed=seed,
        runs=runs,
        map_every=map_every,
        robots=tuple(world.robots),
        t_s=tuple(t * 1e-9 for t in plan.steps()),
        scores={name: tuple(result[name] for result in results) for name in configs},
        skip=skip,
    )


def configs_of(world: World, estimators: Sequence[str] | None) -> dict[str, Config]:
    """Return the configuration of each estimator, by its label; the world's own keeps the world's keys.

    Raises ConfigError on an unknown one.
    """
    base = world.config()
    if estimators is None:
        return {base.estimator.type: base}
    if not estimators:
        raise ConfigError(f"campaign: got no estimator, expected one of {', '.join(ESTIMATORS)}")
    configs = {}
    for label in estimators:
        name, _, keys = label.partition(":")
        if name not in ESTIMATORS:
            expected = f"expected one of {', '.join(ESTIMATORS)}{did_you_mean(name, ESTIMATORS)}"
            raise ConfigError(f"campaign: estimator is {label!r}, {expected}")
        same = name == base.estimator.type
        section: dict[str, Any] = base.estimator.model_dump() if same else {"type": name}
        for key, _, value in (pair.partition("=") for pair in keys.split(",") if pair):
            section[key.strip()] = int(value) if value.strip().isdecimal() else value
        if label in configs:
            raise ConfigError(f"campaign: estimator {label!r} is given twice, expected each once")
        tree = Tree(values={"estimator": section}, places={(): f"estimator {label}"})
        configs[label] = base.model_copy(update={"estimator": validate(tree, Config).estimator})
    return configs


def results_of(plan: Plan, runs: int, jobs: int | None, backend: str) -> Iterable[dict[str, Scores]]:
    """Yield the results of the runs in their order, as they become ready where the backend can do that."""
    jobs = min(jobs or cpu_count(), runs)
    if jobs == 1 and backend == "loky":
        return (plan.run(number) for number in range(runs))
    with joblib_backend(backend):
        ordered = {"return_as": "generator"} if backend == "loky" else {}
        parallel = Parallel(n_jobs=jobs, batch_size=1, **ordered)
        return parallel(delayed(plan.run)(number) for number in range(runs))


@contextmanager
def joblib_backend(backend: str) -> Iterator[None]:
    """Let joblib use a backend.  Raises KalmarkError if it is unknown or not installed.

    Dask: the cluster of ``DASK_SCHEDULER_ADDRESS`` if that is set, else processes of this machine.
    """
    if backend not in BACKENDS:
        expected = f"expected one of {', '.join(BACKENDS)}{did_you_mean(backend, BACKENDS)}"
        raise KalmarkError(f"campaign: backend is {backend!r}, {expected}")
    with ExitStack() as open_:
        if backend == "dask":
            client = installed("dask.distributed", "dask distributed").Client
            scheduler = os.environ.get("DASK_SCHEDULER_ADDRESS")
            open_.enter_context(client(scheduler) if scheduler else client(processes=True, threads_per_worker=1))
        elif backend == "ray":
            installed("ray.util.joblib", "ray").register_ray()
        open_.enter_context(parallel_config(backend))
        yield


def installed(module: str, packages: str) -> Any:
    """Return an optional module.  Raises KalmarkError, saying what to install, if it is not there."""
    try:
        return import_module(module)
    except ImportError:
        raise KalmarkError(f"campaign: {module} is not installed, expected it: pip install {packages}") from None
