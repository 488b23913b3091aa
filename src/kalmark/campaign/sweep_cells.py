"""Cells: what a campaign runs, one scene for each combination of the values that are swept."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kalmark.campaign.replay import Replay, replay_of
from kalmark.config.opening import open_run
from kalmark.config.reading import one_near, resolve_config, resolve_name, shipped_configs
from kalmark.config.schema import Config
from kalmark.config.sections import Choice
from kalmark.config.tree import OVERRIDE, parse_value, read_tree
from kalmark.errors import ConfigError
from kalmark.logs.log import Log
from kalmark.simulate.worlds import World, load_world, shipped_worlds

Scene = World | Replay


@dataclass(frozen=True, eq=False)
class Cell:
    """A scene, and the values of the swept keys that are set in it.

    >>> [cell.label for cell in open_cells("cloister", ["steps=5,10"])]
    ['steps=5', 'steps=10']
    """

    settings: dict[str, Any]
    scene: Scene

    @property
    def label(self) -> str:
        """The settings in words: "a.b=1, c=2"; empty without a sweep."""
        return ", ".join(f"{key}={value_as_yaml(value)}" for key, value in self.settings.items())


def value_as_yaml(value: Any) -> str:
    """Return a swept value as it is written in YAML."""
    return value if isinstance(value, str) else json.dumps(value)


def open_scene(
    path_or_name: str | Path, overrides: Sequence[str] = (), log: str | Path | None = None, progress: bool = True,
    estimators: Sequence[str] | None = None,
) -> Scene:  # fmt: skip
    """Return the world, or the replay of the configuration, at a path or of a shipped name; of both, the world.

    `log` is the log to use instead of the configuration's.  Raises ConfigError, LogError, KalmarkError.

    >>> len(open_scene("cloister", ["steps=10"]).times())
    10
    """
    found = _found(path_or_name, overrides, log)
    refuse_unknown(estimators)
    return found if isinstance(found, World) else replay_of(*found, progress)


def open_cells(
    path_or_name: str | Path,
    sweeps: Sequence[str] = (),
    overrides: Sequence[str] = (),
    log: str | Path | None = None,
    progress: bool = True,
    estimators: Sequence[str] | None = None,
) -> list[Cell]:
    """Return a cell for each combination of swept values, the last key's changing fastest; one without a sweep.

    A sweep is "key.path=value,value"; values are YAML.  All cells are read before anything is simulated.
    Raises ConfigError on a key or value that the file cannot have.

    >>> cells = open_cells("cloister", ["steps=5,10", "filter.estimator.type=ekf,fej"])
    >>> len(cells), cells[0].settings
    (4, {'steps': 5, 'filter.estimator.type': 'ekf'})
    """
    grid: dict[str, list[Any]] = {}
    for text in sweeps:
        key, values = parse_sweep(text)
        if key in grid:
            raise ConfigError(f"--sweep {text}: {key} is given twice, expected each key once")
        grid[key] = values
    combinations = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
    found = []
    for settings in combinations:
        told = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
        try:
            found.append(_found(path_or_name, [*overrides, *told], log))
        except ConfigError as error:
            message = str(error)
            for override in told:
                message = message.replace(f"{OVERRIDE}{override}", f"--sweep {override}")
            raise ConfigError(message) from None
    refuse_unknown(estimators)
    scenes = [one if isinstance(one, World) else replay_of(*one, progress) for one in found]
    return [Cell(settings, scene) for settings, scene in zip(combinations, scenes, strict=True)]


def parse_estimator(label: str) -> tuple[str, dict[str, str]]:
    """Return the name of an estimator and the values of its keys: name, file:Class or name:key=value,key=value.

    >>> parse_estimator("invariant:iterations=1"), parse_estimator("mine:Textbook")
    (('invariant', {'iterations': '1'}), ('mine:Textbook', {}))
    """
    name, _, keys = label.rpartition(":") if "=" in label else (label, "", "")
    pairs = (pair.partition("=") for pair in keys.split(",") if pair)
    return name, {key.strip(): value.strip() for key, _, value in pairs}


def refuse_unknown(estimators: Sequence[str] | None) -> None:
    """Refuse unknown estimators, and those that are given twice, before anything is simulated."""
    known = Choice("estimator")
    if estimators is not None and not estimators:
        raise ConfigError(f"campaign: got no estimator, expected one of {', '.join(known.names())}")
    for i, label in enumerate(estimators or ()):
        name, _ = parse_estimator(label)
        if not known.has(name):
            raise ConfigError(f"campaign: estimator is {label!r}, {one_near(known.names(), name)}")
        if label in (estimators or ())[:i]:
            raise ConfigError(f"campaign: estimator {label!r} is given twice, expected each once")


def parse_sweep(text: str) -> tuple[str, list[Any]]:
    """Return the key and the values of a sweep.  Raises ConfigError if there are none, or one twice."""
    key, equals, values = (part.strip() for part in text.partition("="))
    where = f"--sweep {text}"
    if not key or not equals or not values:
        raise ConfigError(f"{where}: got no key and values, expected key.path=value,value")
    listed: list[Any] = parse_value(f"[{values}]", where)
    if len({json.dumps(value) for value in listed}) < len(listed):
        raise ConfigError(f"{where}: got a value twice, expected each once")
    return key, listed


def _found(path_or_name: str | Path, overrides: Sequence[str], log: str | Path | None) -> World | tuple[Config, Log]:
    """Return the world, or the configuration and its log."""
    shipped, path = shipped_worlds(), Path(path_or_name)
    named = str(path_or_name) in shipped or (path.stem in shipped and path.suffix in (".yaml", ".yml"))
    both = path.stem in shipped_configs()
    if "world" in read_tree(path).values if path.is_file() else named and not (both and log is not None):
        if log is not None:
            raise ConfigError(f"--log {log}: {path} is a world, expected a configuration to use it in")
        return load_world(path_or_name, overrides)
    resolve_name(path_or_name, shipped_configs() | shipped, "world or a configuration")
    return open_run(resolve_config(path_or_name), log, overrides)
