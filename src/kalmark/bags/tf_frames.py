"""Frames of tf and tf_static that stand still to each other: where sensors are mounted."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.messages import Transform
from kalmark.geometry.frames3d import compose, inverse
from kalmark.geometry.pose_frames import ORIGIN

BASES = ("base_link", "base_footprint")
STILL = 1e-6
"""m, and of a quaternion: a transform that changed by less did not move."""


class Frames:
    """The frames of a bag: those that moved against each other, and those that stood still."""

    def __init__(self) -> None:
        self.first: dict[tuple[str, str], Array] = {}
        self.moving: set[tuple[str, str]] = set()

    def take(self, transforms: Iterable[Transform]) -> None:
        """Take the transforms of a message."""
        for _, parent, child, frame in transforms:
            known = self.first.setdefault((parent, child), frame)
            if (parent, child) in self.moving or known is frame:
                continue
            turned = 1 - abs(float(known[3:] @ frame[3:]))
            if np.abs(known[:3] - frame[:3]).max() > STILL or turned > STILL**2:
                self.moving.add((parent, child))

    def fixed(self, parent: str, child: str) -> Array | None:
        """Return the frame `child` (7,) in the frame `parent`, None if it is not known or moves."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        found: dict[str, Array] = {parent: ORIGIN[7]}
        waiting = deque([parent])
        while waiting:
            here = waiting.popleft()
            for (a, b), frame in self.first.items():
                other = b if a == here else a
                if here not in (a, b) or other in found or (a, b) in self.moving:
                    continue
                found[other] = compose(found[here], frame if a == here else inverse(frame)[0])[0]
                waiting.append(other)
        return found.get(child)

    def base(self, named: Iterable[str | None], frame: str) -> str | None:
        """Return the robot's frame, to which a sensor's frame is fixed: the first of these names that there is.

        Else one of BASES, with the prefix of several robots or without, None if there is none.
        """
        there = {name for pair in self.first for name in pair}
        for each in named:
            if each and each.lstrip("/") in there:
                return each.lstrip("/")
        bases = [name for base in BASES for name in sorted(there) if name.split("/")[-1] == base]
        return next((base for base in bases if self.fixed(base, frame) is not None), None)
