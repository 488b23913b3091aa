"""kalmark: EKF-SLAM with a covariance that stays consistent.

import kalmark as km

rover = km.Robot("rover", motion=km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
slam = km.Slam([rover])
slam.process(km.Control(t_s=0.0, robot="rover", u=(0.5, 0.02)))
report = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="lidar", y=[[4.2, 0.3]], ids=[7]))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from kalmark.errors import KalmarkError
from kalmark.plugins import name_of_plugin, names_with_plugins

if TYPE_CHECKING:
    from pathlib import Path

    from kalmark import association, detect, geometry
    from kalmark.declare import register
    from kalmark.events import Control, Fix, Frame, Scan
    from kalmark.filter import estimators, textbook
    from kalmark.logs import Log, log_from, open_log, stream_log
    from kalmark.management import initialization
    from kalmark.management.attention import Attention
    from kalmark.management.delayed import Delayed
    from kalmark.management.upkeep import Upkeep
    from kalmark.models import landmarks, motion, sensors
    from kalmark.models.blocks import factor
    from kalmark.models.pointwise import pointwise
    from kalmark.report import Expectations, Observation, Report
    from kalmark.results.filter_picture import draw
    from kalmark.results.record import record
    from kalmark.results.run import Run
    from kalmark.slam.robot import Mount, Robot
    from kalmark.slam.slam import Slam
    from kalmark.tracks.classes import Classes

__version__ = "0.1.0"

__all__ = [
    "Attention", "Classes", "Control", "Delayed", "Expectations", "Fix", "Frame", "KalmarkError", "Log", "Mount",
    "Observation", "Report", "Robot", "Run", "Scan", "Slam", "Upkeep", "association", "detect", "draw", "estimators",
    "factor", "geometry", "initialization", "landmarks", "log_from", "motion", "open_log", "pointwise", "presets",
    "record", "register", "sensors", "stream_log", "textbook",
]  # fmt: skip

_MODULES = {
    "association": "kalmark.association",
    "detect": "kalmark.detect",
    "estimators": "kalmark.filter.estimators",
    "geometry": "kalmark.geometry",
    "initialization": "kalmark.management.initialization",
    "landmarks": "kalmark.models.landmarks",
    "motion": "kalmark.models.motion",
    "presets": "kalmark.presets",
    "sensors": "kalmark.models.sensors",
    "textbook": "kalmark.filter.textbook",
}
_NAMES = {
    "kalmark.declare": ("register",),
    "kalmark.events": ("Control", "Fix", "Frame", "Scan"),
    "kalmark.logs": ("Log", "log_from", "open_log", "stream_log"),
    "kalmark.management.attention": ("Attention",),
    "kalmark.management.delayed": ("Delayed",),
    "kalmark.management.upkeep": ("Upkeep",),
    "kalmark.models.blocks": ("factor",),
    "kalmark.models.pointwise": ("pointwise",),
    "kalmark.report": ("Expectations", "Observation", "Report"),
    "kalmark.results.filter_picture": ("draw",),
    "kalmark.results.record": ("record",),
    "kalmark.results.run": ("Run",),
    "kalmark.slam.robot": ("Mount", "Robot"),
    "kalmark.slam.slam": ("Slam",),
    "kalmark.tracks.classes": ("Classes",),
}


def __getattr__(name: str) -> Any:
    """Import a name on its first use: the compiled models take a second that `kalmark --help` need not wait."""
    home = _MODULES.get(name) or next((module for module, names in _NAMES.items() if name in names), None)
    if home is None:
        globals()[name] = name_of_plugin(__name__, name)
    else:
        module: Any = import_module(home)
        globals()[name] = module if name in _MODULES else vars(module)[name]
        if name == "Slam":
            globals()[name].from_config = staticmethod(_slam_from_config)
    return globals()[name]


def _slam_from_config(path: str | Path) -> Slam:
    """Build the Slam that a configuration (a path or a shipped name) describes."""
    from kalmark.config import slam_from_config

    return slam_from_config(path)


def __dir__() -> list[str]:
    return names_with_plugins(__name__, (*__all__, "__version__"))
