"""Does a log have the columns that a filter built in Python takes?  Configurations are held against it when read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from kalmark.declare import is_own, registered_name
from kalmark.errors import LogError
from kalmark.logs.source import nearest

if TYPE_CHECKING:
    from kalmark.logs.log import Log
    from kalmark.slam.slam import Slam


def refuse_other_columns(slam: Slam, log: Log) -> None:
    """Refuse a log whose columns are others than those of kalmark's own motions and sensors.

    Columns that are not known come last, in the file's order: a misspelt one would be taken for another number.
    Raises LogError.
    """
    for robot, sensor, what, given, model in _taken(slam, log):
        columns = tuple(model.columns)
        if is_own(type(model)) and registered_name(type(model)) and given != columns:
            missing = [name for name in columns if name not in given]
            hint = next(filter(None, (nearest(name, missing) for name in given if name not in columns)), "")
            place = log.places.get((robot, sensor))
            where = f"{place[0]}:1" if place is not None else log.path or "log"
            wanted = f"{', '.join(columns)} of its {type(model).__name__}"
            raise LogError(f"{where}: {what} have the columns {', '.join(given)}, expected {wanted}{hint}")


def _taken(slam: Slam, log: Log) -> Iterator[tuple[str, str, str, tuple[str, ...], Any]]:
    for robot, given in log.control_columns.items():
        if robot in slam.robots:
            yield robot, "", f"the controls of {robot}", tuple(given), slam.robots[robot].motion
    for (robot, sensor), given in log.sensor_columns.items():
        mount = slam.robots[robot].sensors.get(sensor) if robot in slam.robots else None
        if mount is not None and mount.detector is None:
            yield robot, sensor, f"the scans of {robot} by {sensor}", tuple(given), mount.sensor
