"""Lay one configuration over another: the user's over what the log itself says of its robots, sensors and landmarks."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from kalmark.config.tree import Tree
from kalmark.logs.log import Log

EACH = "each"


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return `below` with `above` laid over it, key by key; another `type` replaces its section, but for a mount."""
    other = "type" in above and above["type"] != below.get("type", above["type"])
    result = {key: value for key, value in below.items() if not other or key == "mount"}
    for key, value in above.items():
        old = result.get(key)
        result[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


def laid_over(tree: Tree, log: Log) -> Tree:
    """Return a configuration laid over what its log describes: what the user wrote wins, key by key.

    Each robot of the log has its own entry then; `each` of the user stands for the robots that he does not name, `each`
    of the log for all.  A value of the log's has the log's path for its place.
    """
    if not log.describes:
        return tree
    below, above = deepcopy(log.describes), deepcopy(tree.values)
    out = Tree(keys=dict(tree.keys), places=dict(tree.places))
    theirs, mine = below.pop("robots", {}), above.get("robots", {})
    below["robots"] = {name: merged(theirs.get(EACH, {}), theirs.get(name, {})) for name in log.robots}
    if isinstance(mine, dict):
        for name in log.robots:
            if name not in mine:
                mine[name] = deepcopy(mine.get(EACH, {}))
                _move(out, ("robots", EACH), ("robots", name))
        above["robots"] = {name: value for name, value in mine.items() if name != EACH}
    out.values = merged(below, above)
    _place(out, out.values, (), str(log.path or log.name))
    return out


def _move(tree: Tree, source: tuple[str, ...], target: tuple[str, ...]) -> None:
    """Note that what stands at `target` was written at `source`."""
    for table in (tree.keys, tree.places):
        table |= {(*target, *path[2:]): place for path, place in table.items() if path[:2] == source}


def _place(tree: Tree, values: dict[str, Any], path: tuple[str, ...], log: str) -> None:
    """Note that what was not written by the user comes from the log."""
    for key, value in values.items():
        here = (*path, key)
        if here not in tree.places:
            tree.places[here] = tree.keys[here] = log
        if isinstance(value, dict):
            _place(tree, value, here, log)
