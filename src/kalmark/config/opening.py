"""The log of a configuration, and the values in force: the user's over those that the log describes."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

from kalmark.config.reading import ENDINGS, config_of, one_near, resolve_config, shipped_configs
from kalmark.config.schema import TRUTH, Config, LogConfig
from kalmark.config.tree import EACH, OVERRIDE, KeyPath, Plain, Tree, merge_trees, read_tree, tree_of, with_each
from kalmark.errors import ConfigError, LogError
from kalmark.logs import find_data, known_formats, open_log
from kalmark.logs.formats import recognise
from kalmark.logs.log import Log
from kalmark.plugins import entry_points_of, load


def open_run(
    path_or_name: str | Path,
    log_path: str | Path | None = None,
    overrides: Sequence[str] = (),
    *,
    progress: bool = False,
) -> tuple[Config, Log]:
    """Return a configuration as it is in force, and the log it names, or the one at `log_path` read in the same way.

    The log's description of its robots, sensors and landmarks is in force where the configuration has no value.
    In the place of a configuration there may be a log that describes all of its rig itself.
    Raises ConfigError, LogError.

    >>> from kalmark.logs import write_native
    >>> controls = {"t_s": [0.0, 0.1], "robot": ["rover"] * 2, "v_mps": [0.5, 0.5], "w_radps": [0.0, 0.1]}
    >>> folder = write_native(km.log_from(controls=controls), "my_log")
    >>> config, log = open_run("native", "my_log", ["association.type=auto"])
    >>> config.association.type, len(log), build_slam(config, log)
    ('auto', 2, <Slam of 'rover' before its first event: 0 landmarks, Invariant, Automatic>)
    """
    path, tree = tree_at(path_or_name, overrides)
    values = {key: value for key, value in tree.values.items() if key in ("log", "plugins")}
    alone = effective_config(config_of(Tree(values, tree.keys, tree.places), path), log_path)
    log = open_config_log(alone, progress=progress)
    refuse_idle(tree, log)
    resolve_each(tree, log)
    whole = overlay_on_log(tree, log)
    given = {path[-1] for path in whole.places if path}
    parts = [load("keys", name) for name in entry_points_of("keys") if name in given]
    for part in parts:
        part.complete(whole)
    config = config_of(whole, path)
    found = {"known": str(known_map_path(config))} if config.map.known not in (None, TRUTH) else {}
    for part in parts:
        log = part.with_events(config, log)
    return config.model_copy(update={"log": alone.log, "map": config.map.model_copy(update=found)}), log


def tree_at(path_or_name: str | Path, overrides: Sequence[str]) -> tuple[Path | None, Tree]:
    """Return a configuration's file, None of a log alone, and its tree.  Raises ConfigError."""
    try:
        path = resolve_config(path_or_name)
    except ConfigError:
        log = log_alone(path_or_name)
        if log is None:
            raise
        return None, tree_of({"log": {"path": str(log)}}, overrides)
    if path.suffix not in ENDINGS and (log := log_alone(path)) is not None:
        return None, tree_of({"log": {"path": str(log)}}, overrides)
    return path, read_tree(path, overrides)


def log_alone(path: str | Path) -> Path | None:
    """Return where a log is that describes all of its rig itself, as images do; None if there is none."""
    try:
        found = find_data(path)
        entry, _ = recognise(found, None)
    except LogError:
        return None
    return found.resolve() if entry.describes_all else None


def known_map_path(config: Config) -> Path:
    """Return where the known map is: beside the configuration, or where logs are looked for.

    Raises LogError, naming all places.
    """
    beside = config.file.resolve().parent if config.file and not config.overridden("map", "known") else None
    return find_data(str(config.map.known), beside).resolve()


def with_log_description(config: Config, log: Log) -> Config:
    """Return a configuration with its log's description in force where it has no value."""
    if not log.describes:
        return config
    tree = Tree(config.model_dump(exclude_unset=True), places=dict(config._where))
    return config_of(overlay_on_log(tree, log), config.file)


def effective_config(config: Config, log_path: str | Path | None = None) -> Config:
    """Return the configuration with its log's path found, or replaced by `log_path`.  Raises ConfigError, LogError.

    >>> from kalmark.logs import write_native
    >>> controls = {"t_s": [0.0, 0.1], "robot": ["rover"] * 2, "v_mps": [0.5, 0.5], "w_radps": [0.0, 0.1]}
    >>> folder = write_native(km.log_from(controls=controls), "my_log")
    >>> effective_config(load_config("native"), "my_log").log.path.endswith("my_log")
    True
    """
    named: Plain = {name: resolve_path(config, getattr(config.log, name)) for name in ("truth", "fixes")}
    log = config.log.model_copy(update=named | resolve_options(config) | {"path": str(find_log(config, log_path))})
    return config.model_copy(update={"log": log})


def open_config_log(config: Config, log_path: str | Path | None = None, *, progress: bool = False) -> Log:
    """Return the log that a configuration names, or the one at `log_path` read in the same way.

    >>> from kalmark.logs import write_native
    >>> controls = {"t_s": [0.0, 0.1], "robot": ["rover"] * 2, "v_mps": [0.5, 0.5], "w_radps": [0.0, 0.1]}
    >>> folder = write_native(km.log_from(controls=controls), "my_log")
    >>> len(open_config_log(load_config("native"), "my_log"))
    2
    """
    path, options = find_log(config, log_path), resolve_options(config)
    check_format(config, path)
    common = config.log.model_dump(include={*LogConfig.model_fields} - {"path", "without_events"})
    common |= {name: resolve_path(config, common[name]) for name in ("truth", "fixes")}
    found = open_log(path, **common, **options, progress=progress)
    if not found.events:
        raise LogError(f"{path}: true poses alone, expected a log with events; as `log.truth` it scores one")
    return found


def resolve_options(config: Config) -> Plain:
    """Return the options of a configuration's log, with the files found that they name.  Raises LogError."""
    options = config.log.options()
    for option in (option for entry in known_formats().values() for option in entry.options.values()):
        ending = option.values.ending if option.values else ""
        if ending and option.name in options:
            given = options[option.name].items()
            options[option.name] = {k: str(resolve_path(config, v)) if v.endswith(ending) else v for k, v in given}
    return options


def resolve_path(config: Config, path: Any) -> Any:
    """Return where the files are that a configuration names: beside it, or where logs are looked for.

    Raises LogError.
    """
    if path is None or isinstance(path, dict):
        return {robot: resolve_path(config, each) for robot, each in path.items()} if path else None
    return str(find_data(path, own_folder(config)).resolve())


def own_folder(config: Config) -> Path | None:
    """Return the folder of a configuration's file, None of a shipped one."""
    shipped = config.file is None or config.file in shipped_configs().values()
    return None if shipped or config.file is None else config.file.resolve().parent


def find_log(config: Config, log_path: str | Path | None = None) -> Path:
    """Return where the log is: beside the configuration, in ``KALMARK_DATA``, or in the download cache.

    A path given from outside (`log_path`, an override) is looked for in the working directory instead of beside the
    configuration.  Raises ConfigError or LogError, naming all places.
    """
    if log_path is not None:
        return find_data(log_path).resolve()
    if config.log.path is None:
        raise config.error(("log", "path"), "got nothing, expected the path of a log: here, or with --log PATH")
    beside = None if config.overridden("log", "path") else own_folder(config)
    try:
        return find_data(config.log.path, beside).resolve()
    except LogError as error:
        raise config.error(("log", "path"), str(error)) from None


def check_format(config: Config, path: Path) -> None:
    """Refuse a format that does not exist and options that the log's format does not have."""
    name = config.log.format
    if name is not None and name not in known_formats():
        raise config.error(("log", "format"), f"got {name!r}, {one_near([*known_formats()], name)}")
    entry, _ = recognise(path, name)
    for key, value in config.log.options().items():
        if key not in entry.options:
            known = f"one of {', '.join(entry.options)}" if entry.options else "none"
            message = f"got {value!r}, which logs of format {entry.name} do not take, expected {known} of their options"
            raise config.error(("log", key), message)


def overlay_on_log(tree: Tree, log: Log) -> Tree:
    """Return a configuration laid over what its log describes: what the user wrote wins, key by key.

    Each robot of the log has its own entry then; `each` of the user stands for the robots that he does not name, `each`
    of the log for all.  A value of the log's has the log's path for its place.
    """
    if not log.describes:
        return tree
    below, above = deepcopy(log.describes), deepcopy(tree.values)
    out = Tree(keys=dict(tree.keys), places=dict(tree.places))
    theirs, mine = below.pop("robots", {}), above.get("robots", {})
    below["robots"] = {name: merge_trees(theirs.get(EACH, {}), theirs.get(name, {})) for name in log.robots}
    if isinstance(mine, dict):
        for name in log.robots:
            if name not in mine and EACH in mine:
                out.share(mine, ("robots",), name)
        above["robots"] = {name: value for name, value in mine.items() if name != EACH}
    out.values = merge_trees(below, above)
    _place(out, out.values, (), str(log.path or log.name))
    return out


def resolve_each(tree: Tree, log: Log) -> None:
    """Let ``sensors.each`` stand for the log's sensors; leave ``robots.each`` out where all robots have entries."""
    for node, path in with_each(tree.values):
        if path[-1] == "sensors":
            for sensor in sorted({sensor for robot, sensor in log.sensors() if path[1] in (robot, EACH)} - node.keys()):
                tree.share(node, path, sensor)
        if path[-1] == "sensors" or all(name in node for name in log.robots):
            del node[EACH]


def _place(tree: Tree, values: Plain, path: KeyPath, log: str) -> None:
    """Note that what was not written by the user comes from the log."""
    for key, value in values.items():
        here = (*path, key)
        if here not in tree.places:
            tree.places[here] = tree.keys[here] = log
        if isinstance(value, dict):
            _place(tree, value, here, log)


def refuse_idle(tree: Tree, log: Log) -> None:
    """Refuse what was set on the command line for robots of which the log has none."""
    named: Any = tree.values.get("robots")
    for path, place in tree.places.items() if isinstance(named, dict) else ():
        if path[:1] != ("robots",) or len(path) < 2 or path[1] in (*log.robots, EACH) or not place.startswith(OVERRIDE):
            continue
        what = "got a robot that is not in this log or run"
        raise ConfigError(f"{place}: robots.{path[1]}: {what}, {one_near(log.robots, path[1])}")
