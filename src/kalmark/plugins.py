"""Plug-ins: what installed packages, kalmark's own parts among them, add to the core through entry points.

| group | entry |
|---|---|
| `kalmark.formats` | a `kalmark.logs.source.Format` of logs, under its name |
| `kalmark.tables` | a file of native logs: a module with `read(path, request, note)` and `rows(log, folder)` |
| `kalmark.sheets` | a key of sensors, a file of parameters: a module with `fits(type)`, `values(given, folder, type)` |
| `kalmark.checks` | a check of raw data: `(config, key, robot, log)`, which raises ConfigError |
| `kalmark.models` | a module that registers models (`kalmark.register`) |
| `kalmark.layouts` | a layout of simulated worlds, under its `type` |
| `kalmark.keys` | a key of sensors: a module with `complete(tree)` and `with_events(config, log)` |
| `kalmark.verbs` | a function of the command line, or a `typer.Typer` of several |
| `kalmark.writers` | what `kalmark convert` writes, under the ending of its file: `(path, log, run) -> {part: count}` |
| `kalmark.viewers` | a viewer of runs: a module with `replay(run, save)` and `follow(slam, log, picture, save)` |
| `kalmark.names` | a name of the package `kalmark`, or of its `logs` or `detect`, as `logs.fetch` |
| `kalmark.data` | how a log that is not found can be had: `(path) -> text`, "" of another's |

Nothing is imported before it is asked for, and one that cannot be loaded stops no other.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from kalmark.errors import PluginError


@cache
def _installed() -> Any:
    return entry_points()  # of all groups at once: it reads a file of each package


@cache
def entry_points_of(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of `kalmark.GROUP` by name, none of them loaded."""
    return {entry.name: entry for entry in _installed().select(group=f"kalmark.{group}")}


def load(group: str, name: str) -> Any:
    """Return what an entry point names.  Raises PluginError if no package has it, or if it cannot be loaded."""
    if name not in entry_points_of(group):
        raise PluginError(f"no installed package has {name!r} among its kalmark.{group}, expected one")
    entry = entry_points_of(group)[name]
    try:
        return entry.load()
    except Exception as error:
        raise PluginError(f"{name!r} of {entry.value} cannot be loaded: {error}{_cure(entry, error)}") from None


def _cure(entry: EntryPoint, error: Exception) -> str:
    """Return how to install a plug-in of which a module is missing."""
    package, missing = entry.module.partition(".")[0], getattr(error, "name", None) or ""
    if not isinstance(error, ImportError) or missing.partition(".")[0] != package or entry.dist is None:
        return ""
    return f"; expected it installed: pip install --force-reinstall --no-deps {entry.dist.name}"


def load_all(group: str) -> tuple[dict[str, Any], dict[str, PluginError]]:
    """Return what the entry points of a group name, and the errors of those that cannot be loaded, both by name."""
    loaded: dict[str, Any] = {}
    failed: dict[str, PluginError] = {}
    for name in entry_points_of(group):
        try:
            loaded[name] = load(group, name)
        except PluginError as error:
            failed[name] = error
    return loaded, failed


def name_of_plugin(module: str, name: str) -> Any:
    """Return what a plug-in adds under a name to a module of kalmark.  Raises AttributeError."""
    named = f"{module}.{name}".removeprefix("kalmark.")
    if named not in entry_points_of("names"):
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    try:
        return load("names", named)
    except PluginError as error:
        raise AttributeError(str(error)) from None


def names_with_plugins(module: str, own: Iterable[str]) -> list[str]:
    """Return the names of a module of kalmark, its own and those of plug-ins."""
    within = f"{module}.".removeprefix("kalmark.")
    added = (name.removeprefix(within) for name in entry_points_of("names") if name.startswith(within))
    return sorted({*own, *(name for name in added if "." not in name)})
