"""Where the landmarks of a simulated world of space stand: thick cloister, house, random box, room of tags, a list.

The thick cloister and the house are the toolbox's.  [TB] `thickCloister`, `house`.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.random import Generator
from pydantic import Discriminator, Field, Tag, model_validator

from kalmark.config.sections import Number, Positive, Section, expected, type_or
from kalmark.geometry.frames3d import from_euler_pose
from kalmark.simulate.layouts import (
    Cloister,
    Count,
    Loop,
    OfPoints,
    Points,
    RandomField,
    Scenery,
    Walls,
    cloister,
    mapping_of,
)

Array = npt.NDArray[np.float64]
Segment = Annotated[tuple[Number, Number, Number, Number, Number, Number], Field(strict=False)]
Triple = Annotated[tuple[Number, Number, Number], Field(strict=False)]


class ThickCloister(Walls):
    """A cloister of two storeys, at z = 0 and above.  [TB] `thickCloister`."""

    type: Literal["thick_cloister"] = "thick_cloister"
    height_m: Number = 1.0
    """Height of the upper storey."""

    def place(self, rng: Generator) -> Array:
        """Return the landmarks (8 (2 n - 5), 3), the lower storey first."""
        return thick_cloister(self.x_min_m, self.x_max_m, self.y_min_m, self.y_max_m, self.height_m, self.n)


class House(Section):
    """A house of 23 segments: walls, a roof, a door and a window in the western wall.  [TB] `house`."""

    type: Literal["house"] = "house"
    x_m: Number = 0.0
    """South-western corner."""
    y_m: Number = 0.0
    """South-western corner."""
    z_m: Number = 0.0
    """South-western corner."""
    length_m: Positive = 5.0
    """From west to east."""
    width_m: Positive = 5.0
    """From south to north."""
    height_m: Positive = 4.0
    """Of the ridge; the walls are 0.65 of it."""

    def scenery(self, rng: Generator) -> Scenery:
        """Return the segments (23, 6), always the same."""
        return Scenery(segments=house((self.x_m, self.y_m, self.z_m), (self.length_m, self.width_m, self.height_m)))


class RandomBox(OfPoints):
    """Landmarks spread uniformly over a box."""

    type: Literal["random_box"] = "random_box"
    count: Count = 100
    """How many landmarks."""
    min_m: Triple = (0.0, 0.0, 0.0)
    """Lowest corner (x, y, z)."""
    max_m: Triple = (20.0, 20.0, 4.0)
    """Highest corner (x, y, z)."""

    @model_validator(mode="after")
    def _has_room(self) -> RandomBox:
        if not all(low <= high for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise expected("max_m nowhere below min_m")
        return self

    def place(self, rng: Generator) -> Array:
        """Return random landmarks (count, 3)."""
        return rng.uniform(self.min_m, self.max_m, (self.count, 3))


class TagRoom(Section):
    """A room with tags on its four walls, all facing inwards; its south-western corner is the origin."""

    type: Literal["tag_room"] = "tag_room"
    length_m: Positive = 8.0
    """From west to east."""
    width_m: Positive = 6.0
    """From south to north."""
    heights_m: Annotated[tuple[Number, ...], Field(strict=False, min_length=1)] = (0.8, 1.8)
    """Heights of the rows of tags."""
    per_wall: Count = 4
    """Tags in a row of a wall."""
    size_m: Positive = 0.3
    """Side of a tag."""

    def scenery(self, rng: Generator) -> Scenery:
        """Return the tags (4 per_wall heights, 7), always the same."""
        middle = np.array([self.length_m, self.width_m]) / 2
        tags = []
        for wall in range(4):  # west, north, east, south
            reach, along = (middle if wall % 2 == 0 else middle[::-1])[:2]
            c, s = math.cos(-math.pi / 2 * wall), math.sin(-math.pi / 2 * wall)
            for z in self.heights_m:
                for k in range(self.per_wall):
                    x, y = -reach, along * (2 * (k + 1) / (self.per_wall + 1) - 1)
                    place = [middle[0] + c * x - s * y, middle[1] + s * x + c * y, z]
                    tags.append(facing(place, -math.pi / 2 * wall))
        return Scenery(tags=np.array(tags), tag_sizes=np.full(len(tags), self.size_m))


class ListedTag(Section):
    """A tag: x to the right of who looks at it, y down, z away from them, into what it is stuck to."""

    x_m: Number = 0.0
    """Its middle."""
    y_m: Number = 0.0
    """Its middle."""
    z_m: Number = 0.0
    """Its middle."""
    roll_deg: Number = 0.0
    """About x, first."""
    pitch_deg: Number = 0.0
    """About y, second."""
    yaw_deg: Number = 0.0
    """About z, third."""
    size_m: Positive = 0.3
    """Its side."""

    def pose(self) -> Array:
        """Return its pose (7,)."""
        angles = np.radians([self.roll_deg, self.pitch_deg, self.yaw_deg])
        return from_euler_pose(np.array([self.x_m, self.y_m, self.z_m, *angles]))[0]


class Listed(Section):
    """Landmarks at given places: points, segments, tags."""

    type: Literal["list"] = "list"
    points_m: Points = ()
    """One (x, y) or (x, y, z) each; their ids are 1, 2, ..."""
    segments_m: Annotated[tuple[Segment, ...], Field(strict=False)] = ()
    """Both ends of each (x, y, z, x, y, z); their ids follow those of the points."""
    tags: Annotated[tuple[ListedTag, ...], Field(strict=False)] = ()
    """Poses and sizes; their ids follow those of the segments."""

    @model_validator(mode="after")
    def _has_something(self) -> Listed:
        if not (self.points_m or self.segments_m or self.tags):
            raise expected("points_m, segments_m or tags")
        if self.points_m and len(self.points_m[0]) == 2 and (self.segments_m or self.tags):
            raise expected("points [x, y, z] beside segments or tags")
        return self

    def scenery(self, rng: Generator) -> Scenery:
        """Return what is listed."""
        points = np.array(self.points_m, dtype=np.float64) if self.points_m else np.empty((0, 3))
        segments = np.array(self.segments_m, dtype=np.float64).reshape(-1, 6)
        tags = np.array([tag.pose() for tag in self.tags]).reshape(-1, 7)
        return Scenery(points, segments, tags, np.array([tag.size_m for tag in self.tags]))


Layout = Annotated[
    Annotated[
        Annotated[Cloister, Tag("cloister")]
        | Annotated[Loop, Tag("loop")]
        | Annotated[RandomField, Tag("random_field")]
        | Annotated[ThickCloister, Tag("thick_cloister")]
        | Annotated[House, Tag("house")]
        | Annotated[RandomBox, Tag("random_box")]
        | Annotated[TagRoom, Tag("tag_room")]
        | Annotated[Listed, Tag("list")],
        Discriminator(type_or()),
    ],
    mapping_of("cloister", "loop", "random_field", "thick_cloister", "house", "random_box", "tag_room", "list"),
]


def thick_cloister(x_min: float, x_max: float, y_min: float, y_max: float, height: float = 1.0, n: int = 9) -> Array:
    """Return the points (8 (2 n - 5), 3) of a cloister of two storeys.  [TB] `thickCloister`."""
    floor = cloister(x_min, x_max, y_min, y_max, n)
    return np.vstack([np.column_stack([floor, np.full(len(floor), z)]) for z in (0.0, height)])


def house(corner: tuple[float, float, float], size: tuple[float, float, float] = (5.0, 5.0, 4.0)) -> Array:
    """Return the segments (23, 6) of a house with this south-western corner and (length, width, height).  [TB]."""
    wall, top = 0.65, 1.0
    ground = [(0, 0), (1, 0), (1, 1), (0, 1)]
    columns = [((x, y, 0), (x, y, wall)) for x, y in ground]
    floor = [((*ground[i], 0), (*ground[(i + 1) % 4], 0)) for i in range(4)]
    gables = [((x, y, a), (x, y + 0.5, b)) for x in (0, 1) for y, a, b in ((0, wall, top), (0.5, top, wall))]
    along = [((0, y, z), (1, y, z)) for y, z in ((0.5, top), (0, wall), (1, wall))]
    door = _frame([(0.6, 0), (0.8, 0), (0.8, 0.5), (0.6, 0.5)])
    window = _frame([(0.2, 0.25), (0.4, 0.25), (0.4, 0.5), (0.2, 0.5)])
    ends = np.array([*columns, *floor, *gables, *along, *door, *window], dtype=np.float64)
    return (np.array(corner) + ends * np.array(size)).reshape(-1, 6)


def _frame(corners: list[tuple[float, float]]) -> list[Any]:
    """Return the four sides of a frame in the western wall."""
    return [((0, *corners[i]), (0, *corners[(i + 1) % 4])) for i in range(4)]


def facing(place: Any, yaw: float) -> Array:
    """Return the pose (7,) of an upright tag at `place` (3,) that faces along `yaw` (rad), against its z axis."""
    f, _ = from_euler_pose(np.array([*place, -math.pi / 2, 0.0, yaw + math.pi / 2]))
    return f
