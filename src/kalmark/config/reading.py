"""Read a configuration: YAML in, a checked `Config` out, or one line of error."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from kalmark.config.data_sheets import take_data_sheets
from kalmark.config.schema import Config
from kalmark.config.tree import KeyPath, Tree, folder_beside, quote_value, read_tree, value_at
from kalmark.declare import classes, load_plugin
from kalmark.errors import ConfigError, KalmarkError

Model = TypeVar("Model", bound=BaseModel)

ENDINGS = (".yaml", ".yml")
_EXPECTED = {
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping of keys",
    "model_type": "a mapping of keys",
    "model_attributes_type": "a mapping of keys",
}


def load_config(path_or_name: str | Path, overrides: Sequence[str] = ()) -> Config:
    """Return the configuration at a path or of a shipped name, with overrides like ``log.path=my_log`` applied.

    Raises ConfigError: ``file:line:column: key.path: got value, expected what``.

    >>> from kalmark.config import load_config
    >>> load_config("native", ["association.type=auto"]).association.type
    'auto'
    """
    path = resolve_config(path_or_name)
    return config_of(read_tree(path, overrides), path)


def config_of(tree: Tree, path: Path | None) -> Config:
    """Return the configuration that a tree read from the file `path` is.  Raises ConfigError."""
    run_plugins(tree, path)
    take_data_sheets(tree, path)
    config = validate(tree, Config)
    config._file = path
    config._where.update(tree.places)
    return config


def run_plugins(tree: Tree, path: Path | None) -> None:
    """Run the `plugins` that a tree read from the file `path` names, and replace their paths by absolute ones.

    They are looked for beside that file, those of an override in the working directory.  Raises ConfigError.
    """
    plugins = tree.values.get("plugins")
    for n, plugin in enumerate(plugins if isinstance(plugins, list) else ()):
        place = tree.place(("plugins", str(n)))
        file = folder_beside(path, place) / str(plugin)
        try:
            load_plugin(file)
        except KalmarkError as error:
            raise ConfigError(f"{place}: plugins: {error}") from None
        tree.values["plugins"][n] = str(file.resolve())


def shipped_configs(folder: str = "configs") -> dict[str, Path]:
    """Return the configurations that come with kalmark, by name, or what another folder of it has.

    >>> from kalmark.config import shipped_configs
    >>> "native" in shipped_configs()
    True
    """
    return {path.stem: path for path in sorted((Path(str(resources.files("kalmark"))) / folder).glob("*.yaml"))}


def resolve_config(path_or_name: str | Path) -> Path:
    """Return the file of a path or shipped name; a missing ``anywhere/mrclam.yaml`` is the shipped `mrclam`.

    >>> from kalmark.config import resolve_config
    >>> resolve_config("native").name
    'native.yaml'
    """
    return resolve_name(path_or_name, shipped_configs(), "configuration")


def resolve_name(path_or_name: str | Path, shipped: dict[str, Path], what: str) -> Path:
    """Return the file that a path or one of the shipped names means.  Raises ConfigError naming the nearest name."""
    path = Path(path_or_name)
    if path.is_file():
        return path
    if str(path_or_name) in shipped:
        return shipped[str(path_or_name)]
    if path.is_dir():
        raise ConfigError(f"{path}: got a folder, expected a {what}: a YAML file or one of {', '.join(shipped)}")
    if path.suffix in ENDINGS and path.stem in shipped:
        return shipped[path.stem]
    nearest = did_you_mean(path.stem, [*shipped])
    raise ConfigError(f"{path}: no such file, expected a {what}: a YAML file or one of {', '.join(shipped)}{nearest}")


def validate(tree: Tree, model: type[Model]) -> Model:
    """Return the tree as a `model`, or raise the first error in it as one ConfigError.

    An unknown type is the first: others may follow from it.  Else the order is that of the file.
    """
    try:
        return model.model_validate(tree.values)
    except ValidationError as error:
        order = {path: n for n, path in enumerate(tree.keys)}
        errors = [
            ((*_path(e["loc"], tree.values), *e.get("ctx", {}).get("below", ())), e)
            for e in error.errors(include_url=False)
        ]
        errors.sort(key=lambda e: (e[1]["type"] != "union_tag_invalid", order.get(e[0], 0)))
        raise _one_error(*errors[0], tree) from None


def did_you_mean(word: str, words: Sequence[str]) -> str:
    """Return "; did you mean NEAREST?", or nothing if no word is near."""
    near = difflib.get_close_matches(word, words, n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def one_near(words: Sequence[str], word: str) -> str:
    """Return that one of these words is expected, and the nearest one."""
    return f"expected one of {', '.join(words)}{did_you_mean(word, words)}"


def _one_error(path: KeyPath, error: ErrorDetails, tree: Tree) -> ConfigError:
    context: dict[str, Any] = error.get("ctx", {})
    kind = error["type"]
    if kind == "unknown_key":
        key, keys = str(context["key"]), context["keys"]
        path = (*path, key)
        value = value_at(tree.values, path)
        near = did_you_mean(key, keys)
        message = f"got {context['what']} (value {quote_value(value)}), expected {_one_of(keys)}{near}"
        return ConfigError(f"{tree.place(path, of_key=True)}: {'.'.join(path)}: {message}")
    value = value_at(tree.values, path)
    if kind == "union_tag_invalid":
        path, got = (path, value) if isinstance(value, str) else ((*path, "type"), value.get("type"))
        message = _not_one_of(got, context["types"], path) + context["missing"]
    elif kind == "literal_error":
        message = _not_one_of(value, re.findall(r"'([^']+)'", context["expected"]), path)
    elif kind == "union_tag_not_found":
        names = f": {_one_of(context['types'])}" if "types" in context else ""
        message = f"got {quote_value(value)}, expected a mapping with a type{names}"
        if _kind(path) == "sensor":
            others = [name for name in value_at(tree.values, path[:-1]) if name != path[-1]]
            message += did_you_mean(path[-1], others).replace("mean ", "mean the sensor ")
    else:
        message = f"got {quote_value(value)}, expected {_expected(kind, context, error['msg'])}"
    return ConfigError(f"{tree.place(path)}: {'.'.join(path)}: {message}")


def _path(loc: tuple[int | str, ...], values: Any) -> KeyPath:
    """Return the path of keys that an error's location means, without the types of the choices taken on the way."""
    path: KeyPath = ()
    node = values
    for part in loc:
        here = part in node and part != node.get("type") if isinstance(node, dict) else False
        if here or (isinstance(node, list) and isinstance(part, int) and part < len(node)):
            node = node[part]
            path = (*path, str(part))
    return path


def _expected(kind: str, context: dict[str, Any], message: str) -> str:
    if kind == "expected":
        return str(context["what"])
    return _EXPECTED.get(kind, message[0].lower() + message[1:])


def _not_one_of(got: Any, words: Sequence[str], path: KeyPath) -> str:
    kind = _kind(path[:-1])
    for here, there, world in (("space", "the plane", "plane"), ("the plane", "space", "space")):
        if kind == "sensor" and path[-1] == "type" and str(got) in classes("sensor", world):
            return f"got {quote_value(got)}, a sensor of {there} on a robot of {here}, expected {_one_of(words)}"
    return f"got {quote_value(got)}, expected {_one_of(words)}{did_you_mean(str(got), words)}"


def _kind(path: KeyPath) -> str:
    """Return what is chosen at `path`: motion, sensor, landmark, association, estimator or map."""
    if len(path) > 1 and path[-2] == "sensors":
        return "sensor"
    return "landmark" if path[-1:] == ("landmarks",) else path[-1] if path else ""


def _one_of(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else "one of " + ", ".join(words)
