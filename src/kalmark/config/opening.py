"""From a configuration to its log, and to what is in force once the log has said what it knows of itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kalmark.config.locate import check_format, find_log
from kalmark.config.merging import laid_over
from kalmark.config.misfit import refuse_idle
from kalmark.config.reading import config_of, resolve_config
from kalmark.config.schema import Config
from kalmark.config.tree import Tree, read_tree
from kalmark.logs import open_log
from kalmark.logs.log import Log


def open_run(
    path_or_name: str | Path, log_path: str | Path | None = None, overrides: Sequence[str] = ()
) -> tuple[Config, Log]:
    """Return a configuration as it is in force, and the log it names, or the one at `log_path` read in the same way.

    What the log describes of its robots, sensors and landmarks is in force where the configuration says nothing.
    Raises ConfigError, LogError.
    """
    path = resolve_config(path_or_name)
    tree = read_tree(path, overrides)
    values = {key: value for key, value in tree.values.items() if key in ("log", "plugins")}
    alone = in_force(config_of(Tree(values, tree.keys, tree.places), path), log_path)
    log = open_config_log(alone)
    refuse_idle(tree, log)
    return config_of(laid_over(tree, log), path).model_copy(update={"log": alone.log}), log


def described(config: Config, log: Log) -> Config:
    """Return a configuration with what its log describes in force where it says nothing."""
    if not log.describes:
        return config
    tree = Tree(config.model_dump(exclude_unset=True), places=dict(config._where))
    return config_of(laid_over(tree, log), config.file)


def in_force(config: Config, log_path: str | Path | None = None) -> Config:
    """Return the configuration with its log's path found, or replaced by `log_path`.  Raises ConfigError, LogError."""
    log = config.log.model_copy(update={"path": str(find_log(config, log_path))})
    return config.model_copy(update={"log": log})


def open_config_log(config: Config, log_path: str | Path | None = None) -> Log:
    """Return the log that a configuration names, or the one at `log_path` read in the same way."""
    log, path = config.log, find_log(config, log_path)
    check_format(config, path)
    return open_log(
        path,
        log.format,
        robots=None if log.robots is None else list(log.robots),
        from_s=log.from_s,
        to_s=log.to_s,
        on_error=log.on_error,
        ids=log.ids,
        **log.options(),
    )
