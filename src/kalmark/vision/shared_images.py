"""Images of this camera of the robot, straightened; intrinsics and mount are that camera's if absent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from kalmark.config.reading import did_you_mean
from kalmark.config.schema import Config
from kalmark.config.sections import model_of
from kalmark.config.tree import Tree
from kalmark.events import Event, Frame
from kalmark.logs.log import Log
from kalmark.vision.straight import Straightened

TAKEN = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px", "mount")
TAKERS = "pinhole", "segments"  # types of sensors that can take them


def complete(tree: Tree) -> None:
    """Give sensors of the images of a camera the values that they lack, its intrinsics and its mount, in place."""
    robots: Any = tree.values.get("robots")
    for robot in robots.values() if isinstance(robots, dict) else ():
        sensors: Any = robot.get("sensors") if isinstance(robot, dict) else None
        for name, sensor in sensors.items() if isinstance(sensors, dict) else ():
            images = sensor.get("images") if isinstance(sensor, dict) else None
            camera = sensors.get(images) if isinstance(images, str) else None
            if isinstance(camera, dict) and sensor.get("type", TAKERS[0]) in TAKERS:
                sensors[name] = {key: camera[key] for key in TAKEN if key in camera} | sensor


def with_events(config: Config, log: Log) -> Log:
    """Return a log in which each frame of a camera is one of the sensors, too, that take its images.

    Raises ConfigError.
    """
    taken = {name: _cameras(config, name if name in config.robots else "each") for name in log.robots}
    if not any(taken.values()):
        return log
    events, newest = list[Event](), Newest()
    for event in log.events:
        takers = taken[event.robot].get(event.sensor, ()) if isinstance(event, Frame) else ()
        if not isinstance(event, Frame) or not takers:
            events.append(event)
            continue
        frame = replace(event, image=partial(newest.of, event.image)) if callable(event.image) else event
        events.append(frame)
        for name, straight in takers:
            image = frame.image if straight is None else partial(straight.of, frame)
            events.append(Frame(t_ns=event.t_ns, robot=event.robot, sensor=name, image=image))
    return replace(log, events=events)


class Newest:
    """The image that was read last: sensors that take it one after another have it read once."""

    def __init__(self) -> None:
        self.source: Any = None
        self.image: Any = None

    def of(self, source: Any) -> Any:
        """Return the image of a source."""
        if source is not self.source:
            self.image, self.source = source(), source
        return self.image


def _cameras(config: Config, robot: str) -> dict[str, list[tuple[str, Any]]]:
    """Return by camera the sensors that take its images, and how these are straightened, None if they are straight."""
    found: dict[str, list[tuple[str, Any]]] = {}
    sensors: Mapping[str, Any] = config.robots[robot].sensors if robot in config.robots else {}
    for name, sensor in sensors.items():
        camera = getattr(sensor, "images", None)
        if camera is None:
            continue
        where = "robots", robot, "sensors", name, "images"
        own = [other for other, section in sensors.items() if not getattr(section, "images", None)]
        if camera not in own:
            what = f"got {camera!r}, expected a sensor of the robot with images of its own: one of {', '.join(own)}"
            raise config.error(where, what + did_you_mean(camera, own))
        if sensor.type not in TAKERS:
            raise config.error(where, f"got {camera!r} for a {sensor.type}, expected one for {' or '.join(TAKERS)}")
        source, model = (model_of(sensors[of], "space") for of in (camera, name))
        numbers = [[getattr(of, key, None) for key in TAKEN[:-1]] for of in (source, model)]
        bent = numbers[0] != numbers[1] or bool(getattr(source, "distortion", None))
        straight = Straightened(source, model.intrinsics, model.image) if bent else None
        found.setdefault(camera, []).append((name, straight))
    return found
