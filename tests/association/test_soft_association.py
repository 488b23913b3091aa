"""Matchings that are averaged over: those worth it, their landmarks numbered anew, and what is reported of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from kalmark.association.averaging import average, outcomes
from kalmark.association.posterior import Posterior
from kalmark.association.protocol import NEW, Decision, Mixture

SLOTS = {"a": 4, "b": 5, "c": 9}


def scan() -> Any:
    """Return a scan of three positions; the noise of each tells of which slot it would be."""
    model = SimpleNamespace(model="points", d=2)

    def noise(model: Any, slots: Any, rows: Any) -> np.ndarray:
        return np.array([slot * np.eye(2) for slot in slots.tolist()])

    return SimpleNamespace(
        tracks=SimpleNamespace(
            slots_of=lambda names: np.array([SLOTS[name] for name in names]), sorts=dict.fromkeys("abc", "point")
        ),
        channel=SimpleNamespace(models={"point": model}, second=lambda robot: -1),
        robot=0, y=np.arange(6.0).reshape(3, 2), noise=noise,
    )  # fmt: skip


def decisions(pairs: Any, weights: Any) -> list[Decision]:
    mixture = Mixture(np.array([0, 2]), ["a", "b", "c"], Posterior(np.array(pairs), np.array(weights), 0.0, 0, True))
    return [(mixture, ""), (NEW, ""), (mixture, "")]


PAIRS, WEIGHTS = [[0, 2], [2, 0], [0, -1], [1, -1]], [0.6, 0.3, 0.0995, 0.0005]


def test_matchings_of_less_than_a_thousandth_of_the_likeliest_are_left_out() -> None:
    found = average(scan(), decisions(PAIRS, WEIGHTS))
    assert found is not None
    assert found.names == ["a", "c"], "b was in the fourth one only"
    assert found.pairs.tolist() == [[0, 1], [1, 0], [0, -1]]
    np.testing.assert_allclose(found.weights, np.array(WEIGHTS[:3]) / 0.9995)
    assert found.update.slots.tolist() == [4, 9]
    np.testing.assert_array_equal(found.update.y, [[0.0, 1.0], [4.0, 5.0]])
    np.testing.assert_array_equal(found.update.R, [4 * np.eye(2), 9 * np.eye(2)])  # of the likeliest of each


def test_without_a_landmark_there_is_nothing_to_average() -> None:
    assert average(scan(), [(NEW, "")] * 3) is None
    assert average(scan(), decisions([[-1, -1]], [1.0])) is None


def test_an_observation_is_reported_with_its_shares_the_likeliest_first() -> None:
    given = decisions(PAIRS, WEIGHTS)
    found = average(scan(), given)
    assert found is not None
    first, second = outcomes(found, given, np.array([1.5, np.nan]))
    assert (first.index, first.landmark, first.d2, first.outcome) == (0, "a", 1.5, "associated")
    assert first.reason == "averaged: 'a' 0.70, 'c' 0.30"
    assert (second.index, second.landmark, second.d2) == (2, "c", None)
    np.testing.assert_allclose([share for _, share in second.shares], [0.6 / 0.9995, 0.3 / 0.9995])
