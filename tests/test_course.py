"""The table of the four documents is complete, and each page and name in it exists."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import api_pages
import course_pages
import pytest

import kalmark
from kalmark.cli.app import app
from test_docs import LESSONS, ROOT, anchors

DOCS = ROOT / "docs"
ITEMS = course_pages.items(DOCS)
IN_PYTHON = sorted({name for each in ITEMS for name in each.names if re.match(r"(km|kalmark)\b[^ ]*$", name)})
COMMANDS = sorted({name for each in ITEMS for name in each.names if name.startswith("kalmark ")})


def found(name: str) -> Any:
    """Return what a dotted name stands for."""
    parts = re.sub(r"^km\b", "kalmark", name).split(".")
    thing = import_module(parts[0])
    for k, part in enumerate(parts[1:], start=2):
        if not hasattr(thing, part):
            import_module(".".join(parts[:k]))
        thing = getattr(thing, part)
    return thing


@pytest.mark.parametrize("name", IN_PYTHON)
def test_a_name_of_the_table_exists(name: str) -> None:
    assert found(name) is not None


def test_the_page_of_figures_shows_the_numbered_ones_and_each_lesson_of_the_slides() -> None:
    shown = {seed: course_pages.drawn_items(ITEMS, seed) for seed in course_pages.SEEDS}
    assert [title for title, _ in shown["T"]] == ["Figure 1", "Figure 2", "Figure 3", "Figure 4"]
    slides = [each.page for _, each in shown["F"]]
    assert slides == [f"slides/{path.stem}" for path in LESSONS if path.parent.name == "slides"]
    titles = course_pages.pictures(ITEMS, DOCS / "lessons")
    assert titles.count("{grid-item-card}") == sum(map(len, shown.values()))


def test_commands_and_names_of_the_table_are_those_of_kalmark() -> None:
    verbs = {command.name or command.callback.__name__.replace("_", "-") for command in app.registered_commands}
    assert {command.split()[1] for command in COMMANDS} <= verbs
    assert {name for each in ITEMS for name in each.names} == {*IN_PYTHON, *COMMANDS}


def test_a_page_of_the_table_exists() -> None:
    shown = set(api_pages.pages().values())
    for each in ITEMS:
        where, _, anchor = each.page.partition("#")
        assert (each.page == "") == (each.state == "missing") or each.chapter.startswith("Settings"), each
        if where.startswith("api/"):
            assert where.removeprefix("api/") in shown, each
        elif where:
            folder = Path("tutorials" if where.startswith("how/") else "course")
            file = DOCS / where if where.endswith(".md") else DOCS / folder / f"{where.removeprefix('how/')}.py"
            assert file.is_file(), each
            assert not anchor or anchor in anchors(file), each


def test_states_and_documents_are_known_ones() -> None:
    assert {each.state for each in ITEMS} <= set(course_pages.STATES)
    assert {each.seed for each in ITEMS} == course_pages.SEEDS.keys()


def test_each_lesson_is_a_page_of_the_table() -> None:
    named = {each.page for each in ITEMS}
    assert [name for path in LESSONS if (name := f"{path.parent.name}/{path.stem}") not in named] == []


@pytest.mark.parametrize(
    ("seed", "kind", "last"),
    [("S", "equation", 87), ("S", "Figure", 9), ("S", "Table", 3), ("T", "Figure", 4), ("T", "equation", 6),
     ("TB", "Figure", 19), ("TB", "Table", 1)],
)  # fmt: skip
def test_every_number_of_a_document_is_in_the_table(seed: str, kind: str, last: int) -> None:
    numbers = {number for each in ITEMS if each.seed == seed for number in each.numbers[kind]}
    assert numbers == set(range(1, last + 1))


def test_a_key_beside_a_setting_of_the_toolbox_is_one_of_kalmark() -> None:
    known = "".join((DOCS / page).read_text() for page in ("configuration.md", "worlds.md", "datasets.md"))
    known += " ".join(dir(kalmark.Slam))
    for each in course_pages.options((DOCS / "toolbox.md").read_text()):
        for code in re.findall(r"`([^`]+)`", each.item):
            for key in re.findall(r"\b[a-z][a-z0-9]*(?:_[a-z0-9]+)+\b|[a-z]+(?=:)", code):
                assert key in known, f"{each.place}: {key}"
