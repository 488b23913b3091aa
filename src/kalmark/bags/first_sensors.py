"""The topics of observations in a first configuration: their entries and the sections of their sensors."""

from __future__ import annotations

from typing import Any

from kalmark.arrays import Array
from kalmark.bags.configured_topics import sensor_name
from kalmark.bags.first_text import GUESS, yaml_mapping
from kalmark.bags.survey import Survey, TopicSummary
from kalmark.bags.topics import Scans
from kalmark.geometry.named_poses import describe_pose
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.logs.log import Section
from kalmark.logs.table_columns import BEAM, CORNERS, POSE3, POSITION

CAMERA = {"fx_px": 600.0, "fy_px": 600.0, "cx_px": 640.0, "cy_px": 512.0, "width_px": 1280, "height_px": 1024}
IDS, CLUSTERS = ("id", "ids", "track_id", "label"), ("cluster", "cluster_id", "segment")


def is_tag(topic: TopicSummary) -> bool:
    """Return whether a topic sees tags."""
    return topic.what.endswith("of tags")


def entry_of(topic: TopicSummary, space: bool) -> Section:
    """Return the entry of a topic of observations."""
    entry: Section = {"type": "scan", "sensor": sensor_name(topic.name, Scans())}
    for key, names in (("ids", IDS), ("clusters", CLUSTERS)):
        name = next((each for each in topic.fields if each in names), None)
        if name and not {"ids", "clusters"} & entry.keys():
            entry[key] = name
    if topic.columns == CORNERS:
        entry["size_m"] = 0.16
    if topic.stated:
        entry["fields"] = topic.stated
    elif topic.columns == ("range_m",):
        entry["landmark"] = sensor_name(topic.name, Scans())
    if topic.columns == POSE3 and not is_tag(topic):
        entry["take"] = [*POSITION] if space else [*POSITION[:2]]
    return entry


def section_line(found: Survey, topic: TopicSummary, control: Any, space: bool) -> str:
    """Return the line of a sensor's section."""
    mount = mount_of(found, topic, control)
    section, why = sensor_section(found, topic, space)
    if mount is None:
        section["mount"] = dict.fromkeys(describe_pose(ORIGIN[7]), 0.0) if space else {
            "x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0}  # fmt: skip
        why = f"{why}; {GUESS} the mount: tf does not have {topic.frame or 'its frame'}".removeprefix("; ")
    else:
        why = f"{why}; its mount is that of tf".removeprefix("; ")
    return f"{sensor_name(topic.name, Scans())}: {yaml_mapping(section)}  # {why}"


def mount_of(found: Survey, topic: TopicSummary, control: Any) -> Array | None:
    """Return the pose of a sensor's frame in its robot's by tf."""
    named = control.child if isinstance(control, TopicSummary) else control[1] if control else ""
    base = found.frames.base([named], topic.frame)
    return None if base is None else found.frames.fixed(base, topic.frame)


def sensor_section(found: Survey, topic: TopicSummary, space: bool) -> tuple[Section, str]:
    """Return a sensor's section, and why."""
    columns = topic.columns
    if columns[:2] == BEAM and not topic.stated:
        detector = {"type": "trunks"}
        section = {"type": "range_bearing", "detector": detector, "association": {"type": "auto"}}
        return section, f"{GUESS} posts and trunks are its landmarks; or corners, reflectors"
    if columns == ("range_m",):
        section = {"type": "range"} if space else {"type": "range", "initialization": {"type": "trilateration"}}
        return section, "" if topic.stated else f"{GUESS} `landmark` of its topic is what it measures"
    if columns == CORNERS or columns[:1] == ("u_px",):
        numbers, why = camera_of_topic(found, topic)
        return {"type": "tag_corners" if columns == CORNERS else "pinhole"} | numbers, why
    if topic.stated and columns[0] in BEAM:
        kind = "_".join(column.rpartition("_")[0] for column in columns if column in BEAM)
        return {"type": kind if columns[-1] != "elevation_rad" else "range_bearing_3d"}, ""
    kind = ("tag_pose" if is_tag(topic) else "position_3d") if space else "position"
    named = {} if topic.named or {*topic.fields} & {*IDS} else {"association": {"type": "auto"}}
    return {"type": kind} | named, ""


def camera_of_topic(found: Survey, topic: TopicSummary) -> tuple[Section, str]:
    """Return the numbers of the camera of a topic, by the CameraInfo of its frame, or else the only one, and why."""
    infos = [each for each in found.topics if each.offers.camera is not None and each.count]
    mine = [each for each in infos if each.frame == topic.frame] or infos
    if len(mine) == 1 and mine[0].camera is not None:
        raw = f"; {GUESS} the images were not rectified" if "lens" in mine[0].camera else ""
        return mine[0].camera, f"its numbers are those of CameraInfo{raw}"
    said = f"{mine[0].name} has {mine[0].error}" if len(mine) == 1 else "there is no CameraInfo of its frame"
    return dict(CAMERA), f"{GUESS} its numbers: {said}"
