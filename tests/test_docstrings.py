"""Docstrings: functions of arrays state the shapes, and the prose has the terms of the field."""

from __future__ import annotations

import pytest
from structure import SHAPE, figures_of_speech, of_arrays, prose


def test_public_functions_of_arrays_state_a_shape() -> None:
    missing = [one.place for one in of_arrays() if not one.documented]
    assert not missing, f"no shape such as (K, 3) in the docstrings of {', '.join(missing)}"


def test_the_prose_personifies_nothing_and_has_the_terms_of_the_glossary() -> None:
    found = [place for text in prose() for place in figures_of_speech(text)]
    assert not found, found


@pytest.mark.parametrize(
    "text",
    ["A sensor tells", "the filter believes", "mapped anew", "a sighting", "Poses.  What is left", "# What it does"],
)
def test_a_figure_of_speech_is_recognised(text: str) -> None:
    assert figures_of_speech(text)


@pytest.mark.parametrize("text", ["What is a block?", "the mount that is known", "from what is left"])
def test_questions_and_plain_words_are_none(text: str) -> None:
    assert not figures_of_speech(text)


@pytest.mark.parametrize(
    "text", ["y (K, 3)", "(n,)", "P (..., n, n)", "(4 (2 n - 5), 2)", "(len(t_ns), 3|7)", "(size,)"]
)
def test_a_shape_is_recognised(text: str) -> None:
    assert SHAPE.search(text)


@pytest.mark.parametrize("text", ["[S] (26)", "[S] (26-30)", "(x, y, theta)"])
def test_other_parentheses_are_no_shape(text: str) -> None:
    assert not SHAPE.search(text)
