"""The README, the documentation and the examples run as they are printed."""

from __future__ import annotations

import copy
import doctest
import inspect
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import api_pages
import figures
import numpy as np
import pytest

import kalmark as km
from kalmark import declare
from kalmark.cli.app import app
from kalmark.declare import built_in, is_own, registered_name, world_of_class
from kalmark.logs import known_formats
from kalmark.models import protocols

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LESSONS = sorted((ROOT / "docs" / "course").rglob("plot_*.py"))
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("plot_*.py"))
BLOCKS = [
    (page, number, block)
    for page in PAGES
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.S))
]


def run(arguments: list[str], folder: Path) -> str:
    done = subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(("page", "number", "block"), BLOCKS, ids=lambda v: getattr(v, "name", str(v)[:3].strip()))
def test_a_page_s_code_runs(page: Path, number: int, block: str, tmp_path: Path) -> None:
    if 'open_log("' in block and "KALMARK_DATA" not in os.environ:
        pytest.skip("KALMARK_DATA is not set: the real data is not here")
    run(["-c", block], tmp_path)


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=lambda p: p.stem)
def test_an_example_runs(example: Path, tmp_path: Path) -> None:
    assert run([str(example)], tmp_path)


@pytest.mark.parametrize("lesson", LESSONS, ids=lambda p: p.stem)
def test_a_lesson_is_short(lesson: Path) -> None:
    """`make docs` runs lessons and tutorials."""
    text = lesson.read_text()
    code = [line for line in text.split('"""', 2)[2].splitlines() if line.strip() and not line.startswith("#")]
    assert len(code) - code.count("plt.show()") <= 30


@pytest.mark.parametrize("program", [*LESSONS, *TUTORIALS], ids=lambda p: p.stem)
def test_a_figure_is_drawn_in_one_block_or_deferred(program: Path) -> None:
    """The gallery shows and closes all figures at the end of a block."""
    *before, last = re.split(r"^# %%\n", program.read_text(), flags=re.M)
    for k, block in enumerate(before):
        made = re.findall(r"^ *(.*?) = (?:plt\.(?:subplots|figure)|\(?figure\.add_subplot)", block, re.M)
        later = "".join(re.findall(r"^[^#\n].*\n", "".join([*before[k + 1 :], last]), re.M))
        again = re.search(r"^.*plt\.(?:subplots|figure)\(", later, re.M)
        names = set(re.findall(r"\w+", " ".join(made)))
        if names & set(re.findall(r"\w+", later[: again.start() if again else None])):
            assert "# sphinx_gallery_defer_figures" in block, f"{program.name}: {names}"


EXAMPLES = {
    f"{shown}.{name}": (module, thing)
    for _, shown, module in api_pages.PARTS
    for name, thing in api_pages.public_names(module).items()
}


@pytest.mark.parametrize("name", [name for name, (_, thing) in EXAMPLES.items() if ">>>" in (thing.__doc__ or "")])
def test_an_example_of_a_docstring_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(declare, "_CLASSES", copy.deepcopy(declare._CLASSES))  # an example may register a model
    module, thing = EXAMPLES[name]
    names = {**api_pages.public_names(module), "km": km, "np": np}
    example = doctest.DocTestParser().get_doctest(inspect.getdoc(thing), names, name, None, 0)
    told: list[str] = []
    assert doctest.DocTestRunner(verbose=False).run(example, out=told.append).failed == 0, "".join(told)


def test_every_public_class_and_function_has_an_example() -> None:
    lacking = [
        name
        for name, (_, thing) in EXAMPLES.items()
        if api_pages.is_code(thing) and is_own(thing) and ">>>" not in (thing.__doc__ or "")
    ]
    assert not lacking


def test_every_public_value_has_a_text_and_every_signature_is_one_that_a_person_reads() -> None:
    values = {name: thing for name, (_, thing) in EXAMPLES.items() if not api_pages.is_code(thing)}
    assert [name for name, thing in values.items() if not api_pages.told_of_value(name.split(".")[-1], thing)] == []
    pages = {name: api_pages.page_of_name("", name.split(".")[-1], thing) for name, (_, thing) in EXAMPLES.items()}
    assert [name for name, page in pages.items() if "ForwardRef" in page] == []


def test_every_model_can_be_made_as_its_page_says() -> None:
    for name, (_, thing) in EXAMPLES.items():
        if registered_name(thing) if isinstance(thing, type) else None:
            call = re.search(r"^   (km\..*\))$", api_pages.page_of_name("", name.rpartition(".")[2], thing), re.M)
            assert isinstance(eval(call[1], {"km": km}), thing), name


def test_pages_call_kalmark_and_python_as_the_readme_says_once_the_environment_is_active() -> None:
    readme = (ROOT / "README.md").read_text()
    assert readme.index(". .venv/bin/activate") < readme.index("\nkalmark ")
    for page in PAGES:
        assert not re.findall(r"\.venv/bin/(?!activate)\S+", page.read_text()), page.name


ROLES = {  # what a row of CONTRIBUTING is about, and where that is
    "a sensor in plane or space": lambda: [one for one in classes_of("sensor") if not hasattr(one, "views")],
    "a sensor of the robot itself": lambda: sensors_that_view(protocols.POSE, protocols.CHANGE, protocols.TWIST),
    "a sensor between robots and landmarks": lambda: sensors_that_view(protocols.BLOCKS, protocols.PLACES),
    "a landmark in the plane": lambda: classes_of("landmark", "plane"),
    "a landmark in space": lambda: classes_of("landmark", "space"),
    "a motion": lambda: classes_of("motion"),
    "a log format": lambda: [one.read for one in known_formats().values() if is_own(one.read)],
    "an estimator": lambda: classes_of("estimator"),
    "an association": lambda: classes_of("association"),
    "a verb": lambda: [command.callback for command in app.registered_commands if not command.hidden],
}


def sensors_that_view(*views: str) -> list[Any]:
    return [one for one in classes_of("sensor") if getattr(one, "views", "") in views]


def classes_of(role: str, world: str = "") -> list[Any]:
    import kalmark.config
    import kalmark.models.motion
    import kalmark.models.sensors  # noqa: F401

    return [each for each in built_in(role) if world in ("", world_of_class(each))]


def test_the_files_to_touch_are_those_that_have_the_models() -> None:
    source = ROOT / "src" / "kalmark"
    rows = dict(re.findall(r"^\| (an? [^|]+) \| (`[^|]+) \|", (ROOT / "CONTRIBUTING.md").read_text(), re.M))
    assert rows.keys() == ROLES.keys()
    for what, files in rows.items():
        listed = {path for name in re.findall("`(.*?)`", files) for path in source.glob(name.replace("NAME", "*"))}
        having = {Path(inspect.getfile(each)) for each in ROLES[what]() if is_own(each)}
        assert having and having <= listed, f"{what}: {having - listed}"
        for name in re.findall("`(.*?)`", files):
            assert "NAME" in name or (source / name).is_file(), f"{what}: {name}"


def test_every_page_the_documentation_points_to_exists() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} points to {target}"


def test_the_page_of_figures_is_made_of_the_saved_ones() -> None:
    assert figures.PAGE.read_text() == figures.page(), "python benchmarks/figures.py --table writes it anew"
    names = [f"{one.section}: {one.name}" for one in figures.figures()]
    assert len(set(names)) == len(names)
    assert set(json.loads(figures.SAVED.read_text())) <= set(names), "a saved figure that no command measures"


@pytest.mark.parametrize("command", sorted({one.command for one in figures.figures()}))
def test_the_program_of_a_figure_exists(command: str) -> None:
    words = command.split()
    if words[:3] == ["python", "-m", "pytest"]:
        tests = [(file.name, file.read_text()) for file in (ROOT / "tests").rglob("test_*.py")]
        assert any(words[-1] in name or re.search(rf"def test_\w*{words[-1]}", text) for name, text in tests), words[-1]
    elif words[0] in ("python", "bash"):
        assert (ROOT / words[1]).is_file()
    else:
        shipped = {path.stem for path in (ROOT / "src" / "kalmark" / "configs").rglob("*.yaml")}
        assert words[0] == "kalmark" and words[1] in ("campaign", "run") and words[2] in shipped


SOURCES = sorted((ROOT / "src").rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
PROSE = [
    *PAGES,
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *SOURCES,
    *TESTS,
    *sorted((ROOT / "benchmarks").glob("*.py")),
]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", head) for head in re.findall(r"^#+ (.*?)\s*$", text, re.M)]
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in plain}


def test_every_section_that_a_page_points_to_exists() -> None:
    missing = [
        f"{page.name}: {target}#{anchor}"
        for page in [*PAGES, ROOT / "CONTRIBUTING.md"]
        for target, anchor in re.findall(r"\]\(([^)#:\s]*)#([^)\s]+)\)", page.read_text())
        if anchor not in anchors((page.parent / target) if target else page)
    ]
    assert missing == []


def test_every_page_program_and_test_that_prose_names_exists() -> None:
    tests = "\n".join(path.name + "\n" + path.read_text() for path in TESTS)
    for path in PROSE:
        text = path.read_text()
        for name in re.findall(
            r"(?<![\w/.])(?:docs|tests|benchmarks|examples|src/kalmark)/[\w/]+\.(?:md|py|json)", text
        ):
            assert (ROOT / name).exists(), f"{path.name}: {name}"
        if path.suffix == ".md":
            for word in re.findall(r"pytest [^`\n|]*?-k '?(\w+)", text):
                assert re.search(rf"def test_\w*{word}|^\w*{word}\w*\.py", tests, re.M), f"{path.name}: -k {word}"


def test_every_module_and_name_that_prose_puts_into_backticks_exists() -> None:
    package, sources = ROOT / "src" / "kalmark", [path.read_text() for path in (*SOURCES, ROOT / "pyproject.toml")]
    for path in PROSE:
        text = path.read_text()
        for name, told in re.findall(r"`(?:src/kalmark/)?((?:[a-z_]+/)+[a-z_0-9]+\.py)(?:: ([\w., ]+))?`", text):
            file = next((base / name for base in (package, ROOT, ROOT / "src") if (base / name).exists()), None)
            assert file is not None, f"{path.name}: {name}"
            for one in re.split(r", ?", told) if told else ():
                assert re.search(rf"\b{one.rpartition('.')[2]}\b", file.read_text()), f"{path.name}: {name}: {one}"
        for dotted in re.findall(r"`(kalmark(?:\.[a-z_]\w*)+)(?:\.[A-Z]\w*)?`", text):
            parts = dotted.split(".")[1:]
            above = package.joinpath(*parts[:-1])
            known = [any(f'"{dotted}"' in source for source in sources)]  # a group of entry points
            known += [package.joinpath(*parts).with_suffix(".py").exists(), package.joinpath(*parts).is_dir()]
            files = [above.with_suffix(".py"), above / "__init__.py"]
            known += [bool(re.search(rf"\b{parts[-1]}\b", file.read_text())) for file in files if file.exists()]
            assert any(known), f"{path.name}: {dotted}"
