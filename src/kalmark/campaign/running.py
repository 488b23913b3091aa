"""Monte Carlo: N runs of a world, or of a log's replay, over processes, every estimator on the same logs.

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
from kalmark.campaign.replay import Replay, replay_of
from kalmark.campaign.scoring import Scores, score
from kalmark.config.building import build_slam
from kalmark.config.opening import open_run
from kalmark.config.reading import did_you_mean, resolve_config, resolve_name, shipped_configs, validate
from kalmark.config.schema import Config
from kalmark.config.tree import Tree, read_tree
from kalmark.errors import ConfigError, KalmarkError
from kalmark.results.progress import track
from kalmark.simulate.robots import simulation
from kalmark.simulate.worlds import World, load_world, shipped_worlds

BACKENDS = ("loky", "dask", "ray")
ESTIMATORS = ("invariant", "ekf", "fej")


@dataclass(frozen=True)
class Plan:
    """What every run of a campaign does; sent to the workers."""

    world: World | Replay
    configs: dict[str, Config]
    seed: int
    map_every: int

    def run(self, number: int) -> dict[str, Scores]:
        """Simulate run `number` and score every estimator on it."""
        with threadpool_limits(1):
            seed = np.random.SeedSequence(self.seed, spawn_key=(number,))
            scene, steps = self.world, self.world.times()
            simulated = scene.simulation(seed) if isinstance(scene, Replay) else simulation(scene, seed)
            return {
                name: score(build_slam(config, simulated.log), simulated, steps, self.map_every)
                for name, config in self.configs.items()
            }


def run_campaign(
    world: World | Replay | str | Path,
    runs: int,
    estimators: Sequence[str] | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: str = "loky",
    progress: bool = True,
    map_every: int = 10,
    skip: int = 0,
) -> Campaign:
    """Run a world, or the replay of a log, `runs` times and return the figures of each estimator.

    `world` may be the path or name of a world, or of a configuration that has a log (`open_scene` takes more of it).
    `estimators` are names like "invariant", "ekf" or, with a key of theirs, "invariant:iterations=1"; by default the
    one of the configuration or in the world's `filter`.  `jobs` is the number of processes (default: one a core).
    Landmarks and joint state are scored every `map_every` steps; averages of NEES leave out the first `skip` steps.
    Raises ConfigError, LogError or KalmarkError on anything that cannot be run.
    """
    limits = (("runs", runs, 1), ("seed", seed, 0), ("map_every", map_every, 1), ("jobs", jobs, 1), ("skip", skip, 0))
    for name, value, least in limits:
        if value is not None and (not isinstance(value, int) or value < least):
            raise KalmarkError(f"campaign: {name} is {value!r}, expected a whole number of at least {least}")
    refuse_unknown(estimators)
    world = world if isinstance(world, World | Replay) else open_scene(world, progress=progress)
    if skip >= len(world.times()):
        raise KalmarkError(f"campaign: skip is {skip}, expected less than the {len(world.times())} steps")
    configs = configs_of(world, estimators)
    plan = Plan(world, configs, seed, map_every)
    results = list(track(results_of(plan, runs, jobs, backend), f"campaign {world.name}", runs, show=progress))
    scores = {name: tuple(result[name] for result in results) for name in configs}
    robots, t_s = tuple(world.robots), tuple(t * 1e-9 for t in world.times())
    kind = "world" if isinstance(world, World) else "config"
    return Campaign(world.name, world.to_yaml(), seed, runs, map_every, robots, t_s, scores, skip, kind)


def open_scene(
    path_or_name: str | Path, overrides: Sequence[str] = (), log: str | Path | None = None, progress: bool = True
) -> World | Replay:
    """Return the world, or the replay of the configuration, at a path or of a shipped name; of both, the world.

    `log` is the log to use instead of the configuration's.  Raises ConfigError, LogError, KalmarkError.
    """
    shipped, path = shipped_worlds(), Path(path_or_name)
    named = str(path_or_name) in shipped or (path.stem in shipped and path.suffix in (".yaml", ".yml"))
    both = path.stem in shipped_configs()
    if "world" in read_tree(path).values if path.is_file() else named and not (both and log is not None):
        if log is not None:
            raise ConfigError(f"--log {log}: {path} is a world, expected a configuration to use it in")
        return load_world(path_or_name, overrides)
    resolve_name(path_or_name, shipped_configs() | shipped, "world or a configuration")
    config, found = open_run(resolve_config(path_or_name), log, overrides)
    return replay_of(config, found, progress)


def refuse_unknown(estimators: Sequence[str] | None) -> None:
    """Refuse estimators that there are not, or that are given twice, before anything is simulated."""
    if estimators is not None and not estimators:
        raise ConfigError(f"campaign: got no estimator, expected one of {', '.join(ESTIMATORS)}")
    for i, label in enumerate(estimators or ()):
        name = label.partition(":")[0]
        if name not in ESTIMATORS:
            expected = f"expected one of {', '.join(ESTIMATORS)}{did_you_mean(name, ESTIMATORS)}"
            raise ConfigError(f"campaign: estimator is {label!r}, {expected}")
        if label in (estimators or ())[:i]:
            raise ConfigError(f"campaign: estimator {label!r} is given twice, expected each once")


def configs_of(world: World | Replay, estimators: Sequence[str] | None) -> dict[str, Config]:
    """Return the configuration of each estimator, by its label; the world's own keeps the world's keys.

    Raises ConfigError on an unknown one.
    """
    base = world.config()
    if estimators is None:
        return {base.estimator.type: base}
    refuse_unknown(estimators)
    configs = {}
    for label in estimators:
        name, _, keys = label.partition(":")
        same = name == base.estimator.type
        section: dict[str, Any] = base.estimator.model_dump() if same else {"type": name}
        for key, _, value in (pair.partition("=") for pair in keys.split(",") if pair):
            section[key.strip()] = int(value) if value.strip().isdecimal() else value
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
