"""YAML files as plain values with their places, and `--set` overrides laid over them.

The values of ``robots.each`` or ``sensors.each`` in a file lie below the entries named beside it, key by key.  An
override of `each` is one of all entries; one of a name that the file does not have begins with what `each` is.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.reader import ReaderError

from kalmark.errors import ConfigError
from kalmark.events import short_text
from kalmark.files import refuse_aliases

Plain = dict[str, Any]  # the values of a mapping in YAML
Configuration = Mapping[str, Any]  # such values that are read, of a whole configuration
KeyPath = tuple[str, ...]  # keys, from the whole configuration to one of its values
EACH = "each"
SHARED = ("robots", "sensors")  # the mappings whose entry `each` stands for all
OVERRIDE = "--set "  # how the place begins of what was set on the command line


def name_of(file: Path | None, general: str) -> str:
    """Return a file's name without its ending; of one with the `general` name that all have, that of its folder."""
    if file is None or file.stem != general:
        return file.stem if file else general
    return file.resolve().parent.name or general


def name_on(name: str, log: str) -> str:
    """Return what a configuration over a log is called: by both names, by one if a log has its own beside it."""
    return name if name == log else f"{name} on {log}"


@dataclass
class Tree:
    """Plain values, with the place of every key and every value by path."""

    values: Plain = field(default_factory=dict)
    keys: dict[KeyPath, str] = field(default_factory=dict)
    places: dict[KeyPath, str] = field(default_factory=dict)

    def place(self, path: KeyPath, *, of_key: bool = False) -> str:
        """Return where the value (or its key) at `path` was written, or the nearest thing around it."""
        if of_key and path in self.keys:
            return self.keys[path]
        return place_around(self.places, path)

    def share(self, node: Plain, path: KeyPath, name: str) -> None:
        """Lay the entry `name` of the mapping `node`, at `path`, over its `each`, which then was written there, too."""
        each, own = deepcopy(node[EACH]), node.get(name)
        node[name] = each if own is None else merge_trees(each, own) if isinstance(own, dict) else own
        for table in (self.keys, self.places):
            for p in [p for p in table if p[: len(path) + 1] == (*path, EACH)]:
                table.setdefault((*path, name, *p[len(path) + 1 :]), table[p])


def value_at(values: Any, path: Sequence[str]) -> Any:
    """Return the value at a path of keys, or of indices of lists; None if there is none."""
    for key in path:
        if isinstance(values, list):
            values = {str(k): value for k, value in enumerate(values)}
        values = values.get(key) if isinstance(values, Mapping) else None
    return values


def put(values: Any, path: Sequence[str], value: Any) -> Any:
    """Put a value at a path of a mapping, where mappings that are missing are made, and return the one that has it."""
    for key in path[:-1]:
        if not isinstance(values.get(key), Mapping):
            values[key] = type(values)()
        values = values[key]
    values[path[-1]] = value
    return values


def robot_section(config: Mapping[str, Any], robot: str) -> str:
    """Return the name of the section of a robot: its own, or that of all robots without one."""
    return EACH if value_at(config, ("robots", robot)) is None else robot


def place_around(places: Mapping[KeyPath, str], path: KeyPath) -> str:
    """Return the place of the value at `path`, or of the nearest thing around it, "" if none is known."""
    return next((places[path[:n]] for n in range(len(path), -1, -1) if path[:n] in places), "")


def folder_beside(path: Path | None, place: str) -> Path:
    """Return the folder for files named at a place of the file `path`; for those of an override the working folder."""
    return Path() if path is None or place.startswith(OVERRIDE) else path.resolve().parent


def merge_trees(below: Plain, above: Plain) -> Plain:
    """Return `below` with `above` laid over it, key by key; another `type` replaces its section, but for a mount."""
    other = "type" in above and above["type"] != below.get("type", above["type"])
    result = {key: value for key, value in below.items() if not other or key == "mount"}
    for key, value in above.items():
        old = result.get(key)
        result[key] = merge_trees(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


def with_each(values: Any, path: KeyPath = ()) -> Iterator[tuple[Plain, KeyPath]]:
    """Yield the mappings of robots and of their sensors that have an `each`, robots first, with their paths."""
    for key in SHARED if isinstance(values, dict) else ():
        node = values.get(key)
        if isinstance(node, dict) and isinstance(node.get(EACH), dict):
            yield node, (*path, key)
        for name in list(node) if isinstance(node, dict) else ():
            yield from with_each(node[name], (*path, key, name))


def read_tree(path: Path, overrides: Sequence[str] = ()) -> Tree:
    """Return the YAML 1.2 file at `path` with the overrides applied.

    Raises ConfigError, naming file, line and column, on anything that is not one mapping with distinct text keys.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start} is not UTF-8, expected a YAML text file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    content = _parse(text, str(path))
    if not isinstance(content, CommentedMap) or not content:
        got = "an empty file" if not content and not isinstance(content, int | float) else quote_value(content)
        raise ConfigError(f"{path}:1:1: got {got}, expected a mapping of keys")
    tree = Tree()
    tree.values = _plain(content, (), tree, str(path))
    tree.places[()] = f"{path}:1:1"
    for node, where in with_each(tree.values):
        for name in [name for name in node if name != EACH]:
            tree.share(node, where, name)
    for override in overrides:
        _override(tree, override)
    return tree


def tree_of(values: Plain, overrides: Sequence[str] = ()) -> Tree:
    """Return plain values as a tree with the overrides applied.  Raises ConfigError."""
    tree = Tree(values)
    for override in overrides:
        _override(tree, override)
    return tree


def quote_value(value: Any) -> str:
    """Return a value as an error message quotes it: short, on one line."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    return short_text(value)


def parse_value(text: str, where: str) -> Any:
    """Return a value written in YAML, plain.  Raises ConfigError, naming `where`."""
    return _plain(_parse(text, where), (), Tree(), where)


def _parse(text: str, name: str) -> Any:
    try:
        content = YAML(typ="rt", pure=True).load(io.StringIO(text))
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        raise ConfigError(f"{where}: {_one_line(error)}") from None
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        column = error.position - text.rfind("\n", 0, error.position)
        raise ConfigError(f"{name}:{line}:{column}: got {text[error.position]!r}, expected printable text") from None
    except Exception as error:  # of odd YAML the parser raises anything: unhashable keys, dates, integers, recursion
        raise ConfigError(f"{name}: {_one_line(error)}") from None
    refuse_aliases(content, name, ConfigError)
    return content


def _one_line(error: Exception) -> str:
    if isinstance(error, DuplicateKeyError):
        key = str(error.problem).split('"')[1]
        return f"{key}: got this key a second time, expected each key once"
    problem = next(iter(str(getattr(error, "problem", None) or error).strip().splitlines()), type(error).__name__)
    context = getattr(error, "context", None)
    return f"{problem} ({context}), expected YAML" if context else f"{problem}, expected YAML"


def _plain(node: Any, path: KeyPath, tree: Tree, name: str) -> Any:
    """Return `node` as plain dict, list and scalars, noting where each stood."""
    if isinstance(node, CommentedMap):
        return {str(key): _item(node, key, path, tree, name) for key in node}
    if isinstance(node, CommentedSeq):
        return [_item(node, i, path, tree, name) for i in range(len(node))]
    for kind in (bool, int, float, str):
        if isinstance(node, kind):
            return kind(node)
    return None if node is None else str(node)


def _item(node: CommentedMap | CommentedSeq, key: Any, path: KeyPath, tree: Tree, name: str) -> Any:
    place = (*path, str(key))
    if key in (node.lc.data or ()):
        line, column, *rest = node.lc.data[key]
        tree.keys[place] = f"{name}:{line + 1}:{column + 1}"
        if rest:
            line, column = rest
        tree.places[place] = f"{name}:{line + 1}:{column + 1}"
    if isinstance(node, CommentedMap) and (isinstance(key, bool) or not isinstance(key, str | int)):
        raise ConfigError(f"{tree.place(place)}: got key {quote_value(key)}, expected a text key")
    return _plain(node[key], place, tree, name)


def _override(tree: Tree, override: str) -> None:
    """Lay one `a.b=value` over the tree; the value is YAML.  Another `type` replaces its section, but for a mount."""
    where = f"{OVERRIDE}{override}"
    dotted, equals, text = override.partition("=")
    path = tuple(part.strip() for part in dotted.split("."))
    if not equals or not all(path):
        raise ConfigError(f"{where}: got no key and value, expected key.path=value")
    _set(tree, tree.values, path, 0, parse_value(text, where), where)


def _set(tree: Tree, node: Plain, path: KeyPath, depth: int, value: Any, where: str) -> None:
    """Set the value at `path` below `node`, which is `depth` keys deep."""
    if depth == len(path) - 1:
        _replace(tree, node, path, value, where)
        return
    part, among = path[depth], depth > 0 and path[depth - 1] in SHARED
    if among and part not in node and isinstance(node.get(EACH), dict):
        tree.share(node, path[:depth], part)
    for name in [*node] if among and part == EACH and node else [part]:
        here = (*path[:depth], name)
        if node.get(name) is None:
            node[name] = {}
            tree.keys[here] = tree.places[here] = where
        if not isinstance(node[name], dict):
            raise ConfigError(f"{where}: {'.'.join(here)}: got {quote_value(node[name])}, expected a mapping of keys")
        _set(tree, node[name], (*here, *path[depth + 1 :]), depth + 1, deepcopy(value), where)


def _replace(tree: Tree, node: Plain, path: KeyPath, value: Any, where: str) -> None:
    if path[-1] == "type" and node.get("type", value) != value:  # another type has other keys; a mount stays
        for key in [key for key in node if key != "mount"]:
            del node[key]
    node[path[-1]] = value
    for table in (tree.places, tree.keys):
        for below in [p for p in table if p[: len(path)] == path]:
            del table[below]
        table[path] = where
