"""Whether the map of a run can be trusted, to what accuracy, and if not, why."""

from __future__ import annotations

from kalmark.batch.data import replayed
from kalmark.batch.solver import optimum
from kalmark.diagnosis.causes import Finding, Where
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.search import Search
from kalmark.results.batch import given_by, log_of
from kalmark.results.run import Run

NEAR = 1e-4


def sensors_of(run: Run) -> dict[Where, tuple[str, ...]]:
    """Return the columns that each sensor of a run measures, by robot and sensor."""
    robots = run.final_slam().robots.values()
    return {(r.name, name): tuple(m.sensor.columns) for r in robots for name, m in r.sensors.items()}


def findings(run: Run) -> tuple[Search, list[Finding]]:
    """Return the causes that explain a run, the one that explains most first, and the search that found them."""
    problem = replayed(given_by(run), log_of(run))
    batch = optimum(problem, tolerance=NEAR)
    search = Search(Linear.of(problem, batch.state), sensors_of(run), run.history.robot, run.history.t_ns)
    return search, search.run()
