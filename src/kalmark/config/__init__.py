"""Configuration: which log, which robots and sensors, which filter, with every default in one frozen model."""

from kalmark.config.building import build_picture, build_slam, config_dict, slam_from_config
from kalmark.config.opening import effective_config, open_config_log, open_run
from kalmark.config.reading import load_config, resolve_config, shipped_configs
from kalmark.config.schema import Config

__all__ = [
    "Config",
    "build_picture",
    "build_slam",
    "config_dict",
    "effective_config",
    "load_config",
    "open_config_log",
    "open_run",
    "resolve_config",
    "shipped_configs",
    "slam_from_config",
]
