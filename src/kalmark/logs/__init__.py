"""Logs of many formats as one stream of events, with the truth to score against.

Plug-ins add names, as `fetch`, which downloads published logs.
"""

from functools import partial

from kalmark.logs.formats import FORMATS, known_formats, open_log, stream_log
from kalmark.logs.log import Log, PositionTrack, Trajectory
from kalmark.logs.memory_tables import log_from
from kalmark.logs.native_writer import write_native
from kalmark.logs.places import cache_folder, find_data
from kalmark.plugins import name_of_plugin, names_with_plugins

__all__ = [
    "FORMATS",
    "Log",
    "PositionTrack",
    "Trajectory",
    "cache_folder",
    "find_data",
    "known_formats",
    "log_from",
    "open_log",
    "stream_log",
    "write_native",
]
__getattr__ = partial(name_of_plugin, __name__)
__dir__ = partial(names_with_plugins, __name__, __all__)
