"""What is said of ids that mean several places, by hand-made histories."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import kalmark as km
from kalmark.diagnosis.single_ids import GONE, MOVES, OFF_SURVEY, TWO, _meanings, _renamed, _together, _told
from kalmark.events import Scan
from kalmark.logs.log import Log
from kalmark.results.history import History
from kalmark.results.run import Run

PLACES = {
    "a": np.array([0.0, 0.0]),
    "a (2)": np.array([9.0, 0.0]),
    "b": np.array([0.0, 8.0]),
    "c": np.array([5.0, 8.0]),
}


def history(ids: list[str], rejected: str = "") -> History:
    """Return the history of observations of these ids, those of one of them rejected."""
    outcome = ["rejected" if name == rejected else "associated" for name in ids]
    return cast("History", SimpleNamespace(id=np.array(ids), outcome=np.array(outcome)))


def fit(of: History, moving: str = "") -> Any:
    """Return d2 per degree of freedom: that of what is left out, of an id that is `moving`, and of what fits."""
    return np.select([of.outcome == "rejected", of.id == moving], [25.0, 3.0], 1.0)


@pytest.mark.parametrize(
    ("ids", "rejected", "moving", "meaning"),
    [
        (["a"] * 9 + ["a (2)"] * 9, "", "", GONE),
        (["a", "a (2)"] * 9, "", "", TWO),
        (["a"] * 9 + ["a (2)"] * 9, "a (2)", "", MOVES),
        (["a", "a (2)"] * 9, "", "a (2)", MOVES),  # it goes on from there
        (["a (2)"] * 9, "", "", GONE),  # no observation is of where it was given
    ],
)
def test_observations_in_their_order_show_what_an_id_means(
    ids: list[str], rejected: str, moving: str, meaning: str
) -> None:
    of = history(ids, rejected)
    assert _told(of, fit(of, moving), PLACES, "a") == meaning


def test_a_survey_is_off_where_all_observations_of_its_id_are_elsewhere() -> None:
    ids = [name for name in ("a (2)", "b (2)", "c (2)") for _ in range(4)]
    places = {"a (2)": np.array([9.0, 0.0]), "b (2)": np.array([0.1, 8.0])}  # c was never started
    landmarks = SimpleNamespace(
        ids=[*places], positions=lambda: (np.array([*places.values()]), np.tile(np.eye(2), (2, 1, 1)))
    )
    run: Any = SimpleNamespace(history=SimpleNamespace(**vars(history(ids)), d=2), landmarks=landmarks)
    surveys = {name: PLACES[name] for name in "abc"}
    assert _meanings(run, np.ones(12), surveys, ["a", "b", "c"]) == {"a": OFF_SURVEY}
    assert _meanings(run, np.ones(12), {}, ["a"]) == {"a": GONE}


def test_a_thing_in_the_place_of_another_is_exchanged_and_the_only_one_is_not() -> None:
    of = history(["a"] * 9 + ["a (2)"] * 9)
    assert _told(of, fit(of), PLACES | {"b": np.array([9.1, 0.0])}, "a") == "what is called a is where b was"
    assert _told(of, fit(of), {name: PLACES[name] for name in ("a", "a (2)", "b")}, "a") == GONE


def test_ids_of_one_meaning_are_said_together_whatever_their_letters() -> None:
    told = {"1": TWO, "{2}": TWO, "3": "what is called 3 is where {2} was"}
    assert _together(told) == "ids 1, {2} are on two things each; what is called 3 is where {2} was"


def test_observations_of_one_robot_are_renamed_and_not_those_of_another_with_such_a_sensor() -> None:
    scans = [Scan(t_s=1.0, robot=robot, sensor="eye", y=np.ones((1, 2)), ids=["a"]) for robot in ("r", "s")]
    h: Any = SimpleNamespace(
        t_ns=np.array([scans[0].t_ns] * 2),
        robot=np.array(["r", "s"]),
        step=np.array([0, 1]),
        sensor=np.array(["eye", "eye"]),
        index=np.array([0, 0]),
    )
    run = cast("Run", SimpleNamespace(history=h))
    renamed = _renamed(Log("two", ("r", "s"), scans), run, np.array([1]), str.upper)
    assert [event.ids for event in renamed if isinstance(event, km.Scan)] == [("a",), ("A",)]
