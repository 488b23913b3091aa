"""The reference of the program in api/: a page for each public module and for each name in its `__all__`.

Signatures and texts are those of the docstrings; of a declared model its parameters, its columns and its name in a
configuration follow from the declaration.
"""

import ast
import inspect
import sys
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, get_origin

from docstrings import plain_names, rst, signature_of

import kalmark as km
from kalmark.declare import Parameter, declared_options, is_own, registered_name, world_of_class

# shown as, module, of what
PARTS = [
    ("Slam and its parts", "kalmark", "kalmark"),
    ("Motions", "km.motion", "kalmark.models.motion"),
    ("Sensors", "km.sensors", "kalmark.models.sensors"),
    ("Landmarks", "km.landmarks", "kalmark.models.landmarks"),
    ("Association", "km.association", "kalmark.association"),
    ("Estimators", "km.estimators", "kalmark.filter.estimators"),
    ("Starts of landmarks", "km.initialization", "kalmark.management.initialization"),
    ("Detectors", "km.detect", "kalmark.detect"),
    ("Images", "km.vision", "kalmark.vision"),
    ("Sensor presets", "km.presets", "kalmark.presets"),
    ("Geometry", "km.geometry", "kalmark.geometry"),
    ("Rotations", "km.geometry.rotations", "kalmark.geometry.rotations"),
    ("Poses in space", "km.geometry.frames3d", "kalmark.geometry.frames3d"),
    ("Directions", "km.geometry.directions", "kalmark.geometry.directions"),
    ("Textbook filters", "km.textbook", "kalmark.filter.textbook"),
    ("Events", "kalmark.events", "kalmark.events"),
    ("Reports", "kalmark.report", "kalmark.report"),
    ("History of a run", "kalmark.results.history", "kalmark.results.history"),
    ("Names of points in a picture", "kalmark.results.labels", "kalmark.results.labels"),
    ("Verdict", "kalmark.diagnosis.verdict", "kalmark.diagnosis.verdict"),
    ("Logs", "kalmark.logs", "kalmark.logs"),
    ("Configurations", "kalmark.config", "kalmark.config"),
    ("Simulation", "kalmark.simulate", "kalmark.simulate"),
    ("Campaigns", "kalmark.campaign", "kalmark.campaign"),
    ("Protocols of models", "kalmark.models.protocols", "kalmark.models.protocols"),
    ("Declarations of models", "kalmark.declare", "kalmark.declare"),
    ("Errors", "kalmark.errors", "kalmark.errors"),
]
HOMES = {module: shown for _, shown, module in PARTS}


def setup(app: Any) -> dict[str, bool]:
    """Write the pages before Sphinx reads them."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "api"))
    return {"parallel_read_safe": True}


def write(folder: Path) -> None:
    """Write all pages that differ, and remove those of names that are gone."""
    pages = {"index": _index()}
    for _, shown, name in PARTS:
        named = {one: (_page(shown, one, thing), thing) for one, thing in public_names(name).items()}
        names = {one: page for one, (page, _) in named.items()}
        pages[shown] = _module(shown, import_module(name), names)
        pages |= {
            page: page_of_name(shown, one, thing) for one, (page, thing) in named.items() if page == f"{shown}.{one}"
        }
    folder.mkdir(exist_ok=True)
    for old in {*folder.glob("*.rst")} - {folder / f"{page}.rst" for page in pages}:
        old.unlink()
    for page, text in pages.items():
        file = folder / f"{page}.rst"
        if not file.exists() or file.read_text() != text:
            file.write_text(text)


def pages() -> dict[str, str]:
    """Return the page of each public name, as `km.geometry.move`, and of each module."""
    shown = {shown.replace("kalmark", "km", 1) if shown == "kalmark" else shown: shown for _, shown, _ in PARTS}
    named = {
        f"{short}.{name}": _page(full, name, thing)
        for (short, full), (_, _, module) in zip(shown.items(), PARTS, strict=True)
        for name, thing in public_names(module).items()
    }
    return shown | named


def public_names(module: str) -> dict[str, Any]:
    """Return the names that a module lists, those of plug-ins included, without modules."""
    home = import_module(module)
    names = [name for name in dir(home) if not name.startswith("_")] if "__dir__" in vars(home) else home.__all__
    things = {name: getattr(home, name) for name in names}
    return {name: thing for name, thing in things.items() if not inspect.ismodule(thing)}


def _page(shown: str, name: str, thing: Any) -> str:
    """Return the page of a name: that of `km` itself where it is one of those."""
    return f"kalmark.{name}" if name in dir(km) and getattr(km, name) is thing else f"{shown}.{name}"


def is_code(thing: Any) -> bool:
    """Return whether a name is that of a class or a function, not of a value or a type with bounds."""
    return callable(thing) and get_origin(thing) is None


def _value(thing: Any) -> str:
    """Return a value that is short, else its type."""
    value = plain_names(repr(thing))
    return f"``{value}``" if len(value) < 200 else f"A ``{type(thing).__name__}``."


@cache
def _told(module: str) -> dict[str, str]:
    """Return the text below the assignment of each name of a module that has one."""
    body = ast.parse(inspect.getsource(import_module(module))).body
    return {
        each.id: inspect.cleandoc(text.value.value)
        for named, text in pairwise(body)
        if isinstance(named, ast.Assign | ast.AnnAssign)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
        for each in ast.walk(named)
        if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)
    }


def told_of_value(name: str, thing: Any) -> str:
    """Return the text of a public value, "" if it has none, from the module that assigns it."""
    homes = [key for key, each in [*sys.modules.items()] if key.startswith("kalmark") and vars(each).get(name) is thing]
    return next(filter(None, (_told(home).get(name, "") for home in homes)), "")


def _head(title: str) -> str:
    return f"{title}\n{'=' * len(title)}\n"


def _toctree(pages: list[str]) -> str:
    return "\n".join([".. toctree::", "   :hidden:", "", *(f"   {page}" for page in pages), ""])


def _list(rows: list[tuple[str, ...]], heads: tuple[str, ...] = ()) -> str:
    out = [".. list-table::", *([f"   :header-rows: {1}"] if heads else []), ""]
    for row in [heads, *rows] if heads else rows:
        out += [f"   {'*' if k == 0 else ' '} - {cell}" for k, cell in enumerate(row)]
    return "\n".join([*out, ""])


def _index() -> str:
    rows = [(f":doc:`{shown} <{shown}>`", title) for title, shown, _ in PARTS]
    said = (
        "Every public name: signature, shapes, units, frames, errors. ``km`` is ``kalmark``: ``import kalmark as km``."
    )
    return "\n".join([_head("Names"), said, "", _list(rows), _toctree([shown for _, shown, _ in PARTS])])


def _module(shown: str, module: Any, names: dict[str, str]) -> str:
    first = (inspect.getdoc(module) or "").split("\n\n")[0]
    parts = [_head(shown), rst(first), ""]
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(_group(getattr(module, name)), []).append(name)
    for group, members in groups.items():
        if len(groups) > 1:
            parts += [group, "-" * len(group), ""]
        told = [
            (f":doc:`{n} <{names[n]}>`", rst(_summary(thing) or told_of_value(n, thing)) or _value(thing))
            for n, thing in ((n, getattr(module, n)) for n in members)
        ]
        parts += [_list(told)]
    inner = [other for _, other, _ in PARTS if other.rpartition(".")[0] == shown]
    below = (
        [other for _, other, _ in PARTS if other.startswith("km.") and other.count(".") == 1]
        if shown == "kalmark"
        else inner
    )
    if below:
        parts += ["Modules", "-------", "", _list([(f":doc:`{o}`", t) for t, o, _ in PARTS if o in below])]
    return "\n".join([*parts, _toctree([page for page in names.values() if page.startswith(f"{shown}.")])])


def _group(thing: Any) -> str:
    world = world_of_class(thing) if isinstance(thing, type) and registered_name(thing) else ""
    if world:
        return f"In the {world}" if world == "plane" else "In space"
    if isinstance(thing, type):
        return "Classes"
    return "Functions" if is_code(thing) else "Values"


def _docstring(thing: Any) -> str:
    """Return the docstring, of a declared model without its parameters; of a value nothing."""
    if isinstance(thing, type):
        return inspect.cleandoc(getattr(vars(thing).get("__doc__"), "text", None) or thing.__doc__ or "")
    return inspect.getdoc(thing) or "" if is_code(thing) else ""


def _summary(thing: Any) -> str:
    text = " ".join(_docstring(thing).partition("\n\n")[0].split())
    return text.partition(".  ")[0].rstrip(".") + "." if text else ""


def page_of_name(shown: str, name: str, thing: Any) -> str:
    """Return the page of a name that a module `shown` has."""
    parts = [
        _head(name),
        f".. py:currentmodule:: {shown.replace('km', 'kalmark', 1) if shown.startswith('km.') else shown}",
        "",
    ]
    if isinstance(thing, type):
        parts += _class(name, thing)
    elif is_code(thing):
        parts += [f".. py:function:: {name}{signature_of(thing)}", "", _indented(rst(_docstring(thing)))]
    else:
        parts += [f".. py:data:: {name}", "", _indented(rst(told_of_value(name, thing))), "", _indented(_value(thing))]
    return "\n".join([*parts, ""])


def _class(name: str, thing: type) -> list[str]:
    told = [f".. py:class:: {name}{signature_of(thing)}", "", _indented(rst(_docstring(thing))), ""]
    named = registered_name(thing)
    if named and is_own(thing):
        return told + _model(name, thing, named)
    told += [line and f"   {line}" for line in "\n".join(_table(declared_options(thing))).splitlines()] + [""]
    own = [each for each in thing.__mro__ if each.__module__.startswith("kalmark")]
    members = {key: member for each in reversed(own) for key, member in vars(each).items() if not key.startswith("_")}
    for key, member in members.items():
        text = _indented(rst(inspect.getdoc(member) or ""), 2)
        if isinstance(member, property):
            told += [f"   .. py:property:: {key}", "", text, ""]
        elif isinstance(member, classmethod | staticmethod) or inspect.isfunction(member):
            kind = {classmethod: "\n      :classmethod:", staticmethod: "\n      :staticmethod:"}.get(type(member), "")
            inner = getattr(member, "__func__", member)
            told += [
                f"   .. py:method:: {key}{signature_of(inner, not isinstance(member, staticmethod))}{kind}",
                "",
                text,
                "",
            ]
    return told


def _model(name: str, thing: Any, named: str) -> list[str]:
    made = thing()
    columns = ", ".join(f"``{column}``" for column in getattr(made, "columns", ()))
    what = "Control" if hasattr(made, "move") else "Measurement"
    where = {"plane": "in the plane", "space": "in space"}.get(world_of_class(thing), "")
    facts = "; ".join(filter(None, [f"{what}: {columns}" if columns else "", where]))
    declared = declared_options(thing)
    some = [p for p in declared if isinstance(p.default, int | float) and p.default != float("inf")][:2]
    home = next((shown for _, shown, module in PARTS if getattr(import_module(module), name, None) is thing), "km")
    keys = "".join(f", {p.name}: {str(p.default).lower() if isinstance(p.default, bool) else p.default}" for p in some)
    told = [facts[:1].upper() + facts[1:] + "." if facts else "", "", ".. code-block:: python", ""]
    call = f"{home.replace('kalmark', 'km', 1)}.{name}({', '.join(f'{p.name}={p.default!r}' for p in some)})"
    told += [f"   {call}", "", "In a configuration:", "", ".. code-block:: yaml", "", f"   {{type: {named}{keys}}}", ""]
    return told + _table(declared)


def _table(declared: Sequence[Parameter]) -> list[str]:
    """Return the table of parameters, none of no parameters."""
    told = [p.on_a_line.partition(f": {p.text}") for p in declared]
    rows = [
        (f"``{p.name}``", "" if p.role else _default(p.default), p.unit, rst(p.text + expected))
        for p, (_, _, expected) in zip(declared, told, strict=True)
    ]
    return [_list(rows, ("parameter", "default", "unit", "meaning"))] if rows else []


def _default(value: Any) -> str:
    return "" if value is None else f"``{value:.6g}``" if isinstance(value, float) else f"``{value!r}``"


def _indented(text: str, by: int = 1) -> str:
    return "\n".join(("   " * by + line) if line else "" for line in text.splitlines())
