"""Surveyed landmarks whose observations do not fit: the landmark stands elsewhere, or the robot is elsewhere."""

from __future__ import annotations

from kalmark.tracks.survey_checks import MISFITS, TRUSTED, Surveys


def test_a_landmark_of_which_five_observations_misfit_while_two_others_fit_stands_elsewhere() -> None:
    surveys = Surveys()
    for k in range(MISFITS):
        assert surveys.wrong() == []
        assert surveys.judge("r", ["b", "c"], ["a"]) is False
        assert surveys.misfits["a"] == (k + 1, frozenset("bc"))
    assert surveys.wrong() == ["a"]


def test_one_landmark_that_fits_is_not_enough_against_it() -> None:
    surveys = Surveys()
    for _ in range(2 * MISFITS):
        surveys.judge("r", ["b"], ["a"])
    assert surveys.wrong() == []
    surveys.judge("r", ["c"], [])
    assert surveys.wrong() == ["a"], "b and c have fitted meanwhile"


def test_an_observation_that_fits_ends_the_row() -> None:
    surveys = Surveys()
    for _ in range(MISFITS - 1):
        surveys.judge("r", ["b", "c"], ["a"])
    surveys.judge("r", ["a"], [])
    assert surveys.misfits == {}
    surveys.judge("r", ["b", "c"], ["a"])
    assert surveys.wrong() == []


def test_two_misfits_with_nothing_between_that_fits_are_the_robot_s() -> None:
    surveys = Surveys()
    assert [surveys.judge("r", [], [name]) for name in "aab"] == [False, False, True]
    assert surveys.misfits == {} and surveys.misfitting["r"] == set()
    assert surveys.judge("r", [], ["b"]) is False, "it begins again"


def test_an_observation_that_fits_between_two_misfits_or_another_robot_s_does_not_count_together() -> None:
    surveys = Surveys()
    assert [surveys.judge("r", fit, off) for fit, off in (([], ["a"]), (["c"], []), ([], ["b"]))] == [False] * 3
    surveys = Surveys()
    assert [surveys.judge(robot, [], [name]) for robot, name in (("r", "a"), ("s", "b"))] == [False, False]


def test_five_observations_that_fit_end_the_trial_of_a_survey() -> None:
    surveys = Surveys()
    surveys.trial["a"] = 0
    for k in range(1, TRUSTED):
        surveys.judge("r", ["a", "b"], [])
        assert surveys.trial == {"a": k}
    surveys.judge("r", ["a"], [])
    assert surveys.trial == {}


def test_surveys_contradict_each_other_where_no_more_fit_than_do_not() -> None:
    surveys = Surveys()
    surveys.judge("r", ["c"], ["a"])
    assert not surveys.contradict(), "one is no contradiction"
    surveys.judge("r", ["d"], ["b"])
    assert surveys.contradict(), "a and b against c and d"
    surveys.judge("r", ["e"], [])
    assert not surveys.contradict(), "against three"


def test_a_landmark_that_is_forgotten_is_nowhere_any_more() -> None:
    surveys = Surveys()
    surveys.trial["a"] = 1
    surveys.judge("r", [], ["a"])
    surveys.forget("a")
    assert (surveys.trial, surveys.misfits, surveys.misfitting) == ({}, {}, {"r": set()})
