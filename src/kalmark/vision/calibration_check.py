"""Check of a configuration against the images of a log: cameras are calibrated, for images of their size."""

from __future__ import annotations

from kalmark.config.schema import Config
from kalmark.events import Frame
from kalmark.logs.log import Log
from kalmark.vision.image_files import image_size


def refuse_uncalibrated(config: Config, key: str, name: str, log: Log) -> None:
    """Refuse images by a camera whose calibration nobody gave, or that is for images of another size."""
    took: dict[str, list[Frame]] = {}
    for event in log.events:
        if isinstance(event, Frame) and event.robot == name:
            took.setdefault(event.sensor, []).append(event)
    for sensor, frames in took.items():
        section = config.robots[key].sensors.get(sensor)
        if section is None or "fx_px" not in type(section).model_fields:
            continue
        where = ("robots", key, "sensors", sensor)
        if "fx_px" not in section.model_fields_set:
            wanted = f"fx_px, ..., or {'.'.join((*where, 'calibration'))}: a file of OpenCV, ROS, Kalibr or EuRoC"
            raise config.error(where, f"got images by a camera without a calibration, expected {wanted}")
        size = image_size(frames)
        if any(getattr(section, name) != pixels for name, pixels in size.items()):
            got = f"got a calibration for {section.width_px:g} x {section.height_px:g} px"
            wanted = " x ".join(map(str, size.values()))
            raise config.error(where, f"{got}, expected one for the images of {wanted} px")
