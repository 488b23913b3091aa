"""The mounts of the sensors of a bag, by frames of tf that stand still to each other."""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.bag_opening import frame_id
from kalmark.bags.configured_topics import Asked, beams_of
from kalmark.bags.messages import MESSAGES
from kalmark.bags.tf_frames import Frames
from kalmark.bags.topics import Carried, InertialTopic, Posed, Topic
from kalmark.geometry import rotations
from kalmark.geometry.named_poses import describe_pose, pose_of
from kalmark.logs.log import SensorKey
from kalmark.logs.source import Request

LEVEL = math.cos(math.radians(5))  # a sensor tilted by less is taken as level


class Mounts:
    """The mounts of sensors (robot, name), in the shape of a configuration.

    `level` are, by topic of a robot of the plane, the axes R (3, 3) that make its sensor level, and whether it hangs
    upside down.
    """

    def __init__(self, asked: Asked, request: Request) -> None:
        self.asked, self.request = asked, request
        self.frames, self.of_sensor, self.base = Frames(), dict[str, str](), dict[str, str]()
        self.mounts: dict[SensorKey, dict[str, float]] = {}
        self.level: dict[str, tuple[Array, bool]] = {}

    def look_ahead(self) -> None:
        """Note the frames of sensors and robots, and those of tf that stand still: for the mounts of sensors."""
        asked, bag = self.asked, self.asked.bag
        scans = {name for name, topic in asked.topics.items() if isinstance(topic, Carried)}
        if not scans:
            return
        tf = {name for name, told in bag.topics.items() if told.type in MESSAGES and MESSAGES[told.type].transforms}
        moves = {n for n, t in asked.topics.items() if isinstance(t, Posed | InertialTopic) and t.columns}
        for received in bag.messages(tf | {asked.named[name] for name in scans | moves}):
            if received.topic in tf:
                self.frames.take(MESSAGES[received.type].transforms(received.message))  # type: ignore[misc]
                continue
            for name in asked.entries(received):
                topic = asked.topics[name]
                if name in scans and not self.of_sensor.get(name):
                    self.of_sensor[name] = frame_id(received.message)  # none in markers that list nothing
                elif isinstance(topic, InertialTopic):
                    self.base.setdefault(topic.robot, frame_id(received.message))
                elif name in moves:
                    self.base.setdefault(topic.robot, getattr(received.message, "child_frame_id", ""))
        for name in sorted(scans):
            self._mount(name, asked.topics[name])

    def _mount(self, name: str, scan: Topic) -> None:
        """Record the mount of a sensor, if tf has it; in the plane also the rotation that levels its points."""
        assert isinstance(scan, Carried)
        frame = self.of_sensor.get(name, "")
        base = self.frames.base((scan.base_frame, self.base.get(scan.robot)), frame)
        given = scan.mounted()
        mount = pose_of(given) if given else None if base is None else self.frames.fixed(base, frame)
        if mount is None:
            return
        keys = [(scan.robot, sensor) for sensor in scan.sensors(name)]
        if self.asked.in_space(scan.robot):
            self.mounts |= dict.fromkeys(keys, describe_pose(mount))
            return
        R = rotations.matrix(mount[3:])
        yaw = float(np.arctan2(R[1, 0], R[0, 0]))
        raw = self.asked.offers[name].seen is beams_of
        if raw and abs(R[2, 2]) < LEVEL:
            tilt = math.degrees(math.acos(min(1.0, abs(R[2, 2]))))
            self.request.skipped.append(
                f"{self.asked.bag.path}: {name} is tilted by {tilt:.0f} deg in tf, taken as level"
            )
        self.level[name] = (np.eye(3) if raw else R, bool(raw and R[2, 2] < 0))
        flat = {"x_m": float(mount[0]), "y_m": float(mount[1]), "theta_rad": yaw if raw else 0.0}
        self.mounts |= dict.fromkeys(keys, flat)
