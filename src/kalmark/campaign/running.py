"""Monte Carlo: N runs of a world, or of a log's replay, over processes, every estimator on the same logs.

Each run takes its seed from the campaign's by `SeedSequence.spawn` and computes with one BLAS thread, so the numbers
are the same whatever the number of workers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, cpu_count, delayed, parallel_config
from joblib.parallel import get_active_backend
from threadpoolctl import threadpool_limits

from kalmark.campaign.campaign import Campaign
from kalmark.campaign.engine import Engine, refusal
from kalmark.campaign.finished_runs import Kept, cell_digest
from kalmark.campaign.replay import Replay
from kalmark.campaign.scoring import Scores, score
from kalmark.campaign.sweep import Sweep
from kalmark.campaign.sweep_cells import Cell, Scene, open_scene, parse_estimator, refuse_unknown
from kalmark.config.building import build_slam
from kalmark.config.reading import one_near, validate
from kalmark.config.schema import Config
from kalmark.config.tree import Tree, parse_value
from kalmark.errors import ConfigError, KalmarkError
from kalmark.logs.progress import track
from kalmark.simulate.robots import simulation
from kalmark.simulate.worlds import World

Task = tuple[int, int]  # the number of a cell, and of a run of it
Group = tuple[int, list[int]]  # the number of a cell, and of some runs of it
Result = dict[str, Scores]  # by estimator

BACKENDS = ("loky", "dask", "ray")
DEATHS = {"BrokenProcessPool", "KilledWorker", "CancelledError", "RayActorError", "WorkerCrashedError"}
TRIES = 3
ROUND = 4  # groups of runs a worker in one round, where results come in rounds
BATCHED, FEW = "batched engine", "ordinary path: so few steps are done before the batched engine is compiled"
WORTH = 200_000  # steps of a campaign from which the engine saves more than it takes to compile
AT_ONCE = 20_000  # steps of the runs that the engine does in one group


@dataclass(frozen=True)
class Plan:
    """Task of every run of a cell; sent to the workers.  `path` is the way of `path_of`."""

    world: Scene
    configs: dict[str, Config]
    seed: int
    map_every: int
    path: str = ""

    @property
    def steps(self) -> int:
        """The filter's steps in a run, of all estimators."""
        return len(self.world.times()) * len(self.configs)

    def engine(self) -> Engine | None:
        """Return the engine for its runs, compiled, if it is the one that does them."""
        return Engine(self.world, self.configs) if self.path == BATCHED and isinstance(self.world, World) else None

    def run(self, number: int) -> Result:
        """Simulate run `number` and score every estimator on it."""
        return next(self.some((number,)))

    def some(self, numbers: Sequence[int]) -> Iterator[Result]:
        """Yield the results of `run` for some numbers; a run that the engine leaves takes the ordinary path."""
        with threadpool_limits(1):
            engine = self.engine()
            for number in numbers:
                seed = np.random.SeedSequence(self.seed, spawn_key=(number,))
                result = None if engine is None else engine.run(seed, self.map_every)
                yield self._ordinary(number) if result is None else result

    def _ordinary(self, number: int) -> Result:
        """Return the scores of a run by `Slam.process`."""
        seed = np.random.SeedSequence(self.seed, spawn_key=(number,))
        scene, steps = self.world, self.world.times()
        simulated = scene.simulation(seed) if isinstance(scene, Replay) else simulation(scene, seed)
        return {
            name: score(build_slam(config, simulated.log), simulated, steps, self.map_every)
            for name, config in self.configs.items()
        }


def path_of(plan: Plan, runs: int) -> str:
    """Return the way of so many runs of a plan: `BATCHED`, or the ordinary path and the reason.

    That depends on nothing but the world, its filters and the number of runs: so do the last digits of the numbers.
    """
    if plan.steps * runs < WORTH:
        return FEW
    why = refusal(plan.world, plan.configs)
    return f"ordinary path: {why}" if why else BATCHED


def run_campaign(
    world: Scene | str | Path,
    runs: int,
    estimators: Sequence[str] | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: str = "loky",
    progress: bool = True,
    map_every: int = 10,
    skip: int = 0,
    address: str | None = None,
    folder: str | Path | None = None,
    resume: bool = True,
) -> Campaign:
    """Run a world, or the replay of a log, `runs` times and return the figures of each estimator.

    `world` may be the path or name of a world, or of a configuration that has a log (`open_scene` takes more of it).
    `estimators` are names like "invariant", "ekf" or, with a key of theirs, "invariant:iterations=1"; by default the
    one of the configuration or in the world's `filter`.  `jobs` is the number of processes (default: one a core).
    Landmarks and joint state are scored every `map_every` steps; averages of NEES leave out the first `skip` steps.
    `address` is that of a dask or ray cluster.  Finished runs are kept in `folder`, if given, and are not run again
    unless `resume` is False.  Raises ConfigError, LogError or KalmarkError on anything that cannot be run.

    >>> from kalmark.simulate import load_world
    >>> world = load_world("cloister", ["steps=10"])
    >>> campaign = run_campaign(world, 2, ["ekf"], jobs=1, progress=False)
    >>> [*campaign.scores], len(campaign.scores["ekf"]), len(campaign.t_s)
    (['ekf'], 2, 10)
    """
    scene = world if isinstance(world, World | Replay) else open_scene(world, progress=progress, estimators=estimators)
    sweep = run_sweep(
        [Cell({}, scene)], runs, estimators, seed, jobs, backend, progress, map_every, skip, address, folder, resume
    )
    return sweep.campaigns[0]


def run_sweep(
    cells: Sequence[Cell],
    runs: int,
    estimators: Sequence[str] | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: str = "loky",
    progress: bool = True,
    map_every: int = 10,
    skip: int = 0,
    address: str | None = None,
    folder: str | Path | None = None,
    resume: bool = True,
) -> Sweep:
    """Run each of the cells (`open_cells`) as `run_campaign` does, all with the same seeds.

    >>> sweep = run_sweep(open_cells("cloister", ["steps=5,10"], progress=False), 1, ["ekf"], jobs=1, progress=False)
    >>> [(cell.label, len(campaign.t_s)) for cell, campaign in zip(sweep.cells, sweep.campaigns)]
    [('steps=5', 5), ('steps=10', 10)]
    """
    limits = (("runs", runs, 1), ("seed", seed, 0), ("map_every", map_every, 1), ("jobs", jobs, 1), ("skip", skip, 0))
    for name, value, least in limits:
        if value is not None and (not isinstance(value, int) or value < least):
            raise KalmarkError(f"campaign: {name} is {value!r}, expected a whole number of at least {least}")
    refuse_unknown(estimators)
    check_backend(backend, address)
    for cell in cells:
        if skip >= len(cell.scene.times()):
            raise KalmarkError(f"campaign: skip is {skip}, expected less than the {len(cell.scene.times())} steps")
        if estimators and any("estimator" in key.split(".") for key in cell.settings):
            raise ConfigError(
                "campaign: got estimators and a sweep over keys of the estimator, expected one of the two"
            )
    plans = [Plan(cell.scene, configs_of(cell.scene, estimators), seed, map_every) for cell in cells]
    plans = [replace(plan, path=path_of(plan, runs)) for plan in plans]
    kept = None
    digests = [cell_digest(plan.world, plan.configs) for plan in plans]
    if folder is not None:
        of = {cell.label: digest for cell, digest in zip(cells, digests, strict=True)}
        kept = Kept(Path(folder), {"seed": seed, "map_every": map_every}, of, resume)
    ready = results_of_plans(plans, digests, runs, kept, jobs, backend, address)
    bar = track(ready, f"campaign {cells[0].scene.name}", runs * len(plans), show=progress)
    results = dict(bar)
    campaigns = []
    for i, plan in enumerate(plans):
        scores = {name: tuple(results[i, number][name] for number in range(runs)) for name in plan.configs}
        campaigns.append(_campaign_of(plan, scores, runs, skip))
    return Sweep(tuple(cells), tuple(campaigns))


def _campaign_of(plan: Plan, scores: dict[str, tuple[Scores, ...]], runs: int, skip: int) -> Campaign:
    world = plan.world
    robots, t_s = tuple(world.robots), tuple(t * 1e-9 for t in world.times())
    kind = "world" if isinstance(world, World) else "config"
    return Campaign(
        world.name, world.to_yaml(), plan.seed, runs, plan.map_every, robots, t_s, scores, skip, kind, plan.path
    )


def configs_of(world: Scene, estimators: Sequence[str] | None) -> dict[str, Config]:
    """Return the configuration of each estimator, by its label; the world's own keeps the world's keys.

    Raises ConfigError on an unknown one.
    """
    base = world.config()
    if estimators is None:
        return {base.estimator.type: base}
    refuse_unknown(estimators)
    configs = {}
    for label in estimators:
        name, keys = parse_estimator(label)
        same = name == base.estimator.type
        section: dict[str, Any] = base.estimator.model_dump() if same else {"type": name}
        section |= {key: parse_value(value, f"estimator {label}") for key, value in keys.items()}
        tree = Tree(values={"estimator": section}, places={(): f"estimator {label}"})
        configs[label] = base.model_copy(update={"estimator": validate(tree, Config).estimator})
    return configs


def results_of_plans(
    plans: Sequence[Plan],
    digests: Sequence[str],
    runs: int,
    kept: Kept | None,
    jobs: int | None,
    backend: str,
    address: str | None,
) -> Iterator[tuple[Task, Result]]:
    """Yield each run of each plan once: first what is kept, then the others as they become ready, to be kept."""
    missing = []
    for task in ((cell, number) for cell in range(len(plans)) for number in range(runs)):
        result = kept.read(digests[task[0]], task[1]) if kept else None
        if result is None:
            missing.append(task)
        else:
            yield task, result
    for (cell, number), result in results_of(plans, missing, jobs, backend, address):
        if kept:
            kept.write(digests[cell], number, result)
        yield (cell, number), result


def results_of(
    plans: Sequence[Plan], tasks: Sequence[Task], jobs: int | None, backend: str, address: str | None
) -> Iterator[tuple[Task, Result]]:
    """Yield the result of each task once, as they become ready.

    Where a worker dies, the runs that are not finished are done again.  Raises KalmarkError if workers die `TRIES`
    times and no run was finished meanwhile.
    """
    if not tasks:
        return
    if backend == "loky":
        groups = group_tasks(plans, tasks)
        jobs = min(jobs or cpu_count(), len(groups))
        if jobs == 1:
            for cell, numbers in groups:
                yield from zip(((cell, n) for n in numbers), plans[cell].some(numbers), strict=True)
            return
        batched = next((plans[cell] for cell, _ in groups if plans[cell].path == BATCHED), None)
        if batched is not None:
            next(batched.some((0,)))  # workers load what that has compiled
    left, tries = dict.fromkeys(tasks), 0
    while left:
        before = len(left)
        try:
            with joblib_backend(backend, address):
                for task, result in _in_parallel(plans, group_tasks(plans, [*left]), jobs or -1):
                    del left[task]
                    yield task, result
        except KalmarkError:
            raise
        except Exception as error:
            if not worker_died(error):
                raise
            tries = tries + 1 if len(left) == before else 0
            if tries == TRIES:
                message = (
                    f"campaign: workers died {TRIES} times ({type(error).__name__}), expected them to finish a run"
                )
                raise KalmarkError(message) from error


def group_tasks(plans: Sequence[Plan], tasks: Sequence[Task]) -> list[Group]:
    """Return tasks as groups that a worker does at once: of the engine many short runs, else each alone."""
    groups: list[Group] = []
    for cell, number in tasks:
        plan = plans[cell]
        size = AT_ONCE // plan.steps if plan.path == BATCHED else 1
        if not groups or groups[-1][0] != cell or len(groups[-1][1]) >= size:
            groups.append((cell, []))
        groups[-1][1].append(number)
    return groups


def _done(plan: Plan, group: Group) -> list[tuple[Task, Result]]:
    cell, numbers = group
    return [((cell, number), result) for number, result in zip(numbers, plan.some(numbers), strict=True)]


def _in_parallel(plans: Sequence[Plan], groups: Sequence[Group], jobs: int) -> Iterator[tuple[Task, Result]]:
    """Yield results as they become ready; in rounds where the backend of joblib gives only whole lists."""
    backend = get_active_backend()[0]
    each = backend.supports_return_generator
    size = len(groups) if each else ROUND * backend.effective_n_jobs(jobs)
    parallel = Parallel(n_jobs=jobs, batch_size=1, return_as="generator_unordered" if each else "list")
    for start in range(0, len(groups), size):
        for done in parallel(delayed(_done)(plans[group[0]], group) for group in groups[start : start + size]):
            yield from done


def worker_died(error: BaseException | None) -> bool:
    """Return whether an exception, or its cause, is the death of a worker of loky, dask or ray."""
    while error is not None:
        if {cls.__name__ for cls in type(error).__mro__} & DEATHS:
            return True
        error = error.__cause__
    return False


def check_backend(backend: str, address: str | None) -> None:
    """Refuse an unknown backend, and an address for one that takes none."""
    if backend not in BACKENDS:
        raise KalmarkError(f"campaign: backend is {backend!r}, {one_near(BACKENDS, backend)}")
    if address is not None and backend == "loky":
        raise KalmarkError(f"campaign: address is {address!r}, expected none with loky, or backend dask or ray")


@contextmanager
def joblib_backend(backend: str, address: str | None = None) -> Iterator[None]:
    """Let joblib use a backend.  Raises KalmarkError if it is unknown, not installed or cannot be reached.

    Without an address: the cluster that dask or ray itself is configured for (``DASK_SCHEDULER_ADDRESS``,
    ``RAY_ADDRESS``), else processes of this machine.
    """
    check_backend(backend, address)
    with ExitStack() as open_:
        try:
            if backend == "dask":
                client = require_module("dask.distributed", "dask distributed").Client
                local = {} if address else {"processes": True, "threads_per_worker": 1}
                open_.enter_context(client(address, **local))
            elif backend == "ray":
                register, ray = require_module("ray.util.joblib", "ray").register_ray, import_module("ray")
                if not ray.is_initialized():
                    ray.init(address, log_to_driver=False)
                    open_.callback(ray.shutdown)
                register()
        except (OSError, ValueError) as error:
            raise KalmarkError(f"campaign: {backend} at {address}: {' '.join(str(error).split())}") from error
        open_.enter_context(parallel_config(backend))
        yield


def require_module(module: str, packages: str) -> Any:
    """Return an optional module.  Raises KalmarkError with what to install if it is not there."""
    try:
        return import_module(module)
    except ImportError:
        raise KalmarkError(f"campaign: {module} is not installed, expected it: pip install {packages}") from None
