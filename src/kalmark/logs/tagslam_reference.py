"""What TagSLAM's own batch made of a test: the path of the rig, the tags, and where the cameras sit on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kalmark.events import Id
from kalmark.geometry.frames3d import compose, inverse
from kalmark.logs.log import Array, Trajectory
from kalmark.logs.ros import components, find_bag, messages, stamp
from kalmark.logs.tagslam_rig import Scene

HERE = np.array([0.0, 0, 0, 0, 0, 0, 1])


@dataclass(frozen=True)
class Reference:
    """Hold the reference in the world: `path` of the rig (None if there is no bag), `tags` and `cameras` by name."""

    path: Trajectory | None = None
    tags: dict[Id, Array] = field(default_factory=dict)
    cameras: dict[str, Array] = field(default_factory=dict)


def read_reference(folder: Path, scene: Scene, rig: str) -> Reference:
    """Return the result in reference.bag, in the map's frame; that of the body with the tags if the rig stands still.

    Tags and cameras are taken from the last transforms in the bag.
    """
    bag = find_bag(folder, "reference")
    if bag is None:
        return Reference()
    world = scene.default_body if scene.static.get(rig) and not scene.static.get(scene.default_body, True) else "map"
    moving = rig if world == "map" else world
    last: dict[tuple[str, str], Array] = {("map", "map"): HERE}
    track: list[tuple[int, Array]] = []
    for topic, message in messages(bag):
        if topic == f"/tagslam/odom/body_{moving}":
            pose = message.pose.pose
            track.append((stamp(message), unit(components(pose.position, pose.orientation))))
        elif topic == "/tf":
            for one in message.transforms:
                pose = one.transform
                last[one.header.frame_id, one.child_frame_id] = unit(components(pose.translation, pose.rotation))
    if world != "map":
        track = [(t_ns, between(pose, last["map", rig])) for t_ns, pose in track]
    tags: dict[Id, Array] = {
        int(child.removeprefix("tag_")): pose if parent == world else compose(last["map", parent], pose)[0]
        for (parent, child), pose in last.items()
        if child.startswith("tag_") and (parent == world or (world == "map" and ("map", parent) in last))
    }
    cameras = {child: pose for (parent, child), pose in last.items() if parent == rig and not child.startswith("tag_")}
    path = Trajectory(np.array([t for t, _ in track]), np.array([p for _, p in track])) if track else None
    return Reference(path, tags, cameras)


def between(a: Array, b: Array) -> Array:
    """Return the frame b in the frame a."""
    return compose(inverse(a)[0], b)[0]


def unit(pose: list[float]) -> Array:
    """Return a frame (7,) with its quaternion normalised."""
    frame = np.array(pose)
    frame[3:] /= np.linalg.norm(frame[3:])
    return frame
