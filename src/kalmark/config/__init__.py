"""Configuration: which log, which robots and sensors, which filter, with every default in one frozen model."""

from kalmark.config.reading import load_config, resolve_config, shipped_configs
from kalmark.config.schema import Config

__all__ = ["Config", "load_config", "resolve_config", "shipped_configs"]
