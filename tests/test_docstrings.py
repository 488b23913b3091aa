"""Docstrings: functions of arrays state the shapes, and the prose has the terms of the field."""

from __future__ import annotations

import ast
import io
import re
import tokenize

import pytest
from structure import SHAPE, SOURCES, docstrings, of_arrays

PERSONIFIED = re.compile(
    r"\b(anew|asleep|awake|believ\w+|foresee\w*|foresight|hopeless|knows?|leans?|leaning|news|says?|sick|tells?|wakes?|wants?)\b"
)


def test_public_functions_of_arrays_state_a_shape() -> None:
    missing = [one.place for one in of_arrays() if not one.documented]
    assert not missing, f"no shape such as (K, 3) in the docstrings of {', '.join(missing)}"


def test_docstrings_and_comments_personify_nothing() -> None:
    found = []
    for file in sorted(SOURCES.rglob("*.py")):
        text = file.read_text()
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        prose = [*docstrings(ast.parse(text)), *(token.string for token in tokens if token.type == tokenize.COMMENT)]
        found += [f"{file}: {word}" for part in prose for word in PERSONIFIED.findall(part)]
    assert not found, found


@pytest.mark.parametrize("text", ["A sensor tells", "the filter believes", "mapped anew"])
def test_a_personification_is_recognised(text: str) -> None:
    assert PERSONIFIED.search(text)


@pytest.mark.parametrize(
    "text", ["y (K, 3)", "(n,)", "P (..., n, n)", "(4 (2 n - 5), 2)", "(len(t_ns), 3|7)", "(size,)"]
)
def test_a_shape_is_recognised(text: str) -> None:
    assert SHAPE.search(text)


@pytest.mark.parametrize("text", ["[S] (26)", "[S] (26-30)", "(x, y, theta)"])
def test_other_parentheses_are_no_shape(text: str) -> None:
    assert not SHAPE.search(text)
