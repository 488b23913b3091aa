"""Workers of loky, dask and ray: the same numbers with each, and when one dies, its runs are done again, once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from kalmark.campaign import open_scene, run_campaign
from kalmark.campaign.running import Plan, configs_of, results_of, worker_died
from kalmark.errors import KalmarkError

WORLD = """\
world: {type: list, points_m: [[3, 1], [3, -1], [5, 2], [-1, -2]]}
robots:
  rover:
    route: {type: constant, u: [0.05, 0.0, 0.0]}
    motion: {type: odometry_2d, sigma_x_m: 0.05, sigma_y_m: 0.05, sigma_theta_rad: 0.01}
    sensors: {tracker: {type: position, sigma_x_m: 0.1, sigma_y_m: 0.05}}
steps: 10
plugins: [own.py]
filter: {landmarks: {type: post}}
"""
OWN = """\
from typing import ClassVar
import kalmark as km

@km.register("landmark", "post")
class Post(km.landmarks.Point2D):
    kind: ClassVar = "post"

"""
# The first worker that meets it dies, as one that is out of memory; the campaign's own process goes on.
DEADLY = """\
import os, signal
from pathlib import Path
here = Path({folder!r})
if os.getpid() != {parent} and not (here / "died").exists():
    (here / "died").touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""
HOPELESS = "import os, signal\nif os.getpid() != {parent}:\n    os.kill(os.getpid(), signal.SIGKILL)\n"


def scene(folder: Path, plugin: str) -> Any:
    (folder / "own.py").write_text(OWN + plugin.format(folder=str(folder), parent=os.getpid()))
    (folder / "world.yaml").write_text(WORLD)
    return open_scene(folder / "world.yaml")


@pytest.fixture
def address(request: pytest.FixtureRequest, backend: str) -> Any:
    """Start a cluster of two workers on this machine, as one elsewhere would be; None for the backend without one."""
    if backend == "dask":
        distributed = pytest.importorskip("distributed", reason="dask distributed is not installed")
        cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
        request.addfinalizer(cluster.close)
        return cluster.scheduler_address
    if backend == "ray":
        pytest.importorskip("ray", reason="ray is not installed")
        from ray.cluster_utils import Cluster

        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False})
        request.addfinalizer(cluster.shutdown)
        return cluster.address
    return None


@pytest.mark.parametrize("backend", ["loky", "dask", "ray"])
def test_the_runs_of_a_worker_that_dies_are_done_again_and_counted_once(
    backend: str, address: str | None, tmp_path: Path
) -> None:
    world = scene(tmp_path, DEADLY)
    plan = Plan(world, configs_of(world, None), 3, 10)
    tasks = [(0, number) for number in range(6)]
    got = [*results_of([plan], tasks, 2, backend, address)]
    assert (tmp_path / "died").exists(), "no worker died, so nothing was tested"
    assert sorted(task for task, _ in got) == tasks
    for task, result in got:
        alone = plan.run(task[1])["invariant"].series
        assert all(alone[name].tobytes() == values.tobytes() for name, values in result["invariant"].series.items())


def test_workers_that_always_die_end_the_campaign_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kalmark.campaign.running.TRIES", 2)
    with pytest.raises(KalmarkError, match="workers died 2 times") as error:
        run_campaign(scene(tmp_path, HOPELESS), 2, jobs=2, progress=False)
    assert "\n" not in str(error.value)


def test_an_error_of_a_run_itself_is_no_death_of_a_worker() -> None:
    assert not worker_died(ValueError("a mistake in a model"))
    wrapped = RuntimeError("a task failed")
    wrapped.__cause__ = type("RayActorError", (Exception,), {})()
    assert worker_died(wrapped)
