"""Logs of many formats as one stream of events, with the truth to score against."""

from kalmark.logs.download import Dataset, cache_folder, fetch, find_data, list_data
from kalmark.logs.formats import FORMATS, known_formats, open_log, stream_log
from kalmark.logs.log import Log, PositionTrack, Trajectory
from kalmark.logs.memory_tables import log_from
from kalmark.logs.native_writer import write_native

__all__ = [
    "FORMATS",
    "Dataset",
    "Log",
    "PositionTrack",
    "Trajectory",
    "cache_folder",
    "fetch",
    "find_data",
    "known_formats",
    "list_data",
    "log_from",
    "open_log",
    "stream_log",
    "write_native",
]
