"""Are the associations of a log right after the batch solution has decided them again?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hall import hall, mapped

import kalmark as km
from kalmark.batch.data import BatchReplay, replay_events
from kalmark.batch.reassociation import Reassociated, reassociate
from kalmark.batch.solver import optimum
from kalmark.config import build_slam
from kalmark.logs.log import Log
from kalmark.results.batch import batch_entry, batch_input
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

WORLD = ("world.count=20", "world.size_m=18", "steps=200", "robots.rover.start={x_m: 9, y_m: 9, theta_rad: 0}")


@pytest.fixture(scope="module")
def known() -> tuple[Run, Log]:
    """Return a run of a log that tells the ids."""
    world = load_world("random_field", WORLD)
    log = simulate(world, 3)
    return km.record(build_slam(world.config(), log), log, progress=False, pictures=False), log


def decided_again(run: Run, log: Log, names: Sequence[Any], free: bool = True) -> Reassociated:
    given = batch_input(run)
    given = replace(given, associations=replace(given.associations, landmark=names))
    return reassociate(BatchReplay.of(given, log), np.full(len(names), free))


def parts(names: Sequence[Any]) -> set[frozenset[int]]:
    """Return the sets of the observations of each landmark."""
    return {frozenset(k for k, other in enumerate(names) if other == name) for name in {*names} - {None}}


def shared(found: Sequence[Any], right: Sequence[Any]) -> float:
    """Return the share of the observations that are in the set in which they should be."""
    best = {name: max(parts(found), key=lambda p, name=name: sum(right[k] == name for k in p)) for name in {*right}}
    return float(np.mean([k in best[name] for k, name in enumerate(right)]))


def test_a_right_association_stays(known: tuple[Run, Log]) -> None:
    run, log = known
    names = list(batch_input(run).associations.landmark)
    found = decided_again(run, log, names)
    assert found.settled and not found.merged and not found.new
    assert {a for a, b in zip(found.landmark, names, strict=True) if a != b} <= {None}
    assert sum(name is None for name in found.landmark) < 0.03 * len(names)  # 1 % are outside the gate


def test_what_is_held_does_not_change_and_its_optimum_is_that_of_the_filters_associations(
    known: tuple[Run, Log],
) -> None:
    run, log = known
    names = list(batch_input(run).associations.landmark)
    found = decided_again(run, log, names, free=False)
    assert found.landmark == names and found.rounds == 1
    np.testing.assert_allclose(found.batch.means, optimum(replay_events(batch_input(run), log)).means, atol=1e-7)


def test_a_doubled_a_split_a_lost_landmark_and_wrong_observations_are_found(known: tuple[Run, Log]) -> None:
    run, log = known
    right = list(batch_input(run).associations.landmark)
    often = sorted({*right}, key=lambda name: (-right.count(name), name))
    doubled, lost = often[:2]
    places = dict(zip(run.landmarks.ids, run.landmarks.positions()[0], strict=True))
    near = min((n for n in often if n not in (doubled, lost)), key=lambda n: np.linalg.norm(places[n] - places[lost]))
    names: list[Any] = list(right)
    of = [k for k, name in enumerate(right) if name == doubled]
    for k in of[len(of) // 2 :]:
        names[k] = "again"  # the same landmark, mapped a second time
    for k, name in enumerate(right):
        if name == lost:
            names[k] = None
    rng = np.random.default_rng(0)
    for k in rng.choice(len(names), len(names) // 50, replace=False).tolist():
        names[k] = near if names[k] != near else None
    found = decided_again(run, log, names)
    assert found.settled
    assert found.merged in ({"again": doubled}, {doubled: "again"})
    assert len(found.new) == 1
    assert len(parts(found.landmark)) == len({*right})
    assert shared(found.landmark, right) > 0.97
    mine = dict(zip(found.batch.ids, found.batch.means, strict=True))
    best = optimum(replay_events(batch_input(run), log))
    for name, place in zip(best.ids, best.means, strict=True):
        other = found.new[0] if name == lost else found.merged.get(name, name)
        np.testing.assert_allclose(mine[other], place, atol=0.1)


def test_the_second_opinion_on_a_hall_without_ids_agrees_with_a_right_map(monkeypatch: pytest.MonkeyPatch) -> None:
    log, bars = hall(1), list[str]()
    run = mapped(log)

    def tracked(items: Any, what: str, **_: Any) -> Any:
        bars.append(what)
        return items

    monkeypatch.setattr("kalmark.results.batch.track", tracked)
    entry = batch_entry(run, log)
    assert bars == ["second opinion: round of association"]  # a long log takes minutes
    assert entry["landmarks"] == 24 and entry["association_settled"]
    assert entry["landmarks_merged"] == entry["landmarks_split"] == entry["landmarks_found"] == 0
    assert entry["observations_changed"] <= 0.001 * entry["observations"]
    assert entry["map_difference_filter_sigma"] < 1.0 and entry["path_difference_sigma"] < 1.0
    assert len(entry["pose_differences"]) == 10
    assert all(row["sigmas"] < 1.0 for row in entry["pose_differences"])
