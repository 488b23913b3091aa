"""The counts of the structure (`benchmarks/structure.py`), and their limits in docs/architecture.md."""

from __future__ import annotations

import ast
from collections import Counter

import pytest
from structure import against_limits, branches, docstrings, lowered, of_module, of_node, raised_without_reason

LIMITS = "| a | 3 | of old |\n| b | 1000 | |\n"


def counted(source: str) -> Counter[str]:
    """Return the counts of a source by their names."""
    tree = ast.parse(source)
    return Counter([name for node in ast.walk(tree) for name in of_node(node)] + [*of_module(tree)])


def test_a_count_is_held_by_its_limit() -> None:
    assert against_limits(LIMITS, {"a": 3, "b": 998}) == []
    above, unknown = against_limits(LIMITS, {"a": 4, "b": 998, "c": 0})
    assert above.startswith("a: 4, at most 3: remove") and unknown.startswith("c: 0, at most None")
    assert against_limits(LIMITS, {"a": 3, "b": 900})[0].endswith("lower the limit by --write")
    assert against_limits(LIMITS, {"a": 3})[0].startswith("b: 0, at most 1000: lower"), "a count of nothing is 0"
    assert lowered(LIMITS, {"a": 4, "b": 900}) == "| a | 3 | of old |\n| b | 900 | |\n"


def test_a_limit_is_raised_with_a_reason_of_its_own_alone() -> None:
    def row(limit: int, why: str) -> str:
        return f"| a | {limit} | {why}|\n"

    before = [row(4, "of old "), row(3, "of old "), row(9, "older ")]
    assert raised_without_reason(row(5, "a race track "), before) == []
    assert raised_without_reason(row(3, "of old "), before) == []
    assert raised_without_reason(row(5, "of old "), before) == [
        "a: the limit rose from 3 to 5, expected a reason of its own"
    ]
    assert raised_without_reason(row(4, "of old "), before), "it was lower meanwhile"
    assert raised_without_reason(row(5, ""), before)
    assert raised_without_reason(row(5, ""), []) == []


@pytest.mark.parametrize(
    ("source", "number"),
    [
        ("x = 1 if a and b else 2", 2),
        ("try:\n    f()\nexcept ValueError:\n    pass", 1),
        ("[x for x in y if x]", 2),
        ("match x:\n    case 1:\n        pass\n    case _:\n        pass", 2),
    ],
)
def test_branch_points_are_those_of_expressions_too(source: str, number: int) -> None:
    assert branches(ast.parse(source)) == number


@pytest.mark.parametrize(
    ("source", "name", "number"),
    [
        ("A, B = 1, -2\nC = 2 * A\nd = 1\nE = [1]", "named numbers and texts", 3),
        ("def f(twin: Estimate): ...\ndef g(state): ...\ndef h(x: StateReader): ...",
         "functions that take the slam or its state whole", 2),
        ("import_module('kalmark.config')\nimport_module('ray')\nimport_module(name)",
         "imports hidden from the contract", 1),
        ("def f(a, b, c, d, /, e, *, f, g): ...\ndef g(self, a, b, c, d, e, f): ...",
         "functions of 7 arguments or more", 1),
    ],
)  # fmt: skip
def test_each_way_to_write_it_is_counted(source: str, name: str, number: int) -> None:
    assert counted(source)[name] == number


def test_docstrings_are_those_of_fields_and_annotations_too() -> None:
    source = (
        '"""A."""\nclass B:\n    """B."""\n    c: int = 1\n    """C."""\n    d: Annotated[Literal["x"], f(help="D d.")]'
    )
    assert sorted(docstrings(ast.parse(source))) == ["A.", "B.", "C.", "D d."]
