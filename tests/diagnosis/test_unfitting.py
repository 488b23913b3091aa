"""Are observations named that fit nothing, where no other cause explains them?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis.verdict import Verdict
from kalmark.events import Event, Fix, Scan, sort_key
from kalmark.logs.log import Log
from kalmark.simulate import load_world, simulate

rng = np.random.default_rng(5)


def with_ghosts(log: Log) -> Log:
    """Add an observation of nothing to each scan."""

    def more(e: Event) -> Event:
        if not isinstance(e, Scan):
            return e
        y = np.vstack([e.y.reshape(-1, 2), [rng.uniform(1.0, 8.0), rng.uniform(-3.0, 3.0)]])
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=y)

    return replace(log, events=[more(e) for e in log.events])


def with_fixes(log: Log) -> Log:
    """Add a fix every second; a fifth of them are far away."""
    truth = log.truth["rover"]
    at = zip(truth.t_ns[10::10].tolist(), truth.poses[10::10, :2], strict=True)
    sigma_m = 0.3
    fixes = [
        Fix(
            t_ns=t, robot="rover", y=p + sigma_m * rng.normal(size=2) + 9.0 * (rng.random() < 0.2), cov=0.09 * np.eye(2)
        )
        for t, p in at
    ]
    return replace(log, events=sorted([*log.events, *fixes], key=sort_key))


def verdict_on(change: Callable[[Log], Log], *settings: str) -> Verdict:
    made = load_world("random_field", ["steps=300", *settings])
    log, config = simulate(made, 1), made.config()
    slam = build_slam(config, log)
    return km.diagnose(km.record(slam, change(log), progress=False, config=config_dict(config)), brief=True)


@pytest.mark.parametrize(
    ("change", "ids", "of"),
    [(with_ghosts, "false", "observations of rover.lidar"), (with_fixes, "true", "fixes of rover")],
    ids=["ghosts", "fixes"],
)
def test_what_fits_nothing_is_named_and_counted_and_does_no_harm(
    change: Callable[[Log], Log], ids: str, of: str
) -> None:
    verdict = verdict_on(change, f"ids={ids}")
    assert verdict.map == "ok", verdict.causes
    outliers = next(cause for cause in verdict.causes if cause.name == "outliers")
    assert outliers.harmless and of in outliers.evidence, verdict.causes
    left_out, _, number, *_ = outliers.evidence.split()
    assert 0.05 < int(left_out) / int(number) < 0.35


def test_no_observation_of_a_clean_log_is_named() -> None:
    verdict = verdict_on(lambda log: log, "ids=false")
    assert (verdict.map, [cause.name for cause in verdict.causes]) == ("ok", [])
