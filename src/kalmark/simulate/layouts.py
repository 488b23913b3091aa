"""Layouts of landmarks of a simulated world: Sola's cloister ([S] App. C), a loop, a field, a race track, a list.

Layouts of the plane serve robots of space as well: their landmarks are at z = 0.  Those of space are the toolbox's
thick cloister and house ([TB] `thickCloister`, `house`), a random box, a room of tags.  Plug-ins may
have others (`kalmark.layouts`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.random import Generator
from pydantic import AfterValidator, Field, model_validator

from kalmark.arrays import Array, Index
from kalmark.config.sections import Numbers, OneOf, Section, unexpected_value
from kalmark.declare import Count, NotNegative, Number, Positive, Within
from kalmark.events import Raw
from kalmark.geometry.frames3d import from_euler_pose

TOUCH_M = 1e-3  # walls this near to each other meet
STRAIGHT = 0.05  # sine of an angle between walls, below which they make no corner

Segment = Annotated[tuple[Number, Number, Number, Number, Number, Number], Field(strict=False)]
Wall = Annotated[tuple[Number, Number, Number, Number], Field(strict=False)]
Triple = Annotated[tuple[Number, Number, Number], Field(strict=False)]


def _some(points: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if not points:
        raise unexpected_value("at least one point [x, y]")
    sizes = {len(point) for point in points}
    if len(sizes) > 1 or not sizes <= {2, 3}:
        raise unexpected_value("points [x, y], or all of them [x, y, z]")
    return points


Points = Annotated[tuple[Numbers, ...], Field(strict=False), AfterValidator(_some)]


def closed(points: tuple[tuple[float, ...], ...], *below: str) -> tuple[tuple[float, ...], ...]:
    """Refuse points that no smooth closed line goes through."""
    again = any(a == b for a, b in zip(points, (*points[1:], points[0]), strict=True))
    if len(points) < 3 or len(points[0]) != 2 or again:
        raise unexpected_value(
            "at least 3 points [x, y], none of them twice in a row, the first not at the end", *below
        )
    return points


@dataclass(frozen=True, eq=False)
class Scenery:
    """The landmarks of a world: points (N, 2|3), segments (S, 6) from end to end, tags (T, 7) as poses, in m.

    In the plane the segments (S, 4) are walls.  `tag_sizes` (T,) are the sides of the tags, `classes` (N,) the classes
    of the points by number, None where the layout has none.

    `raw_of`, of a plug-in's layout, returns of a sensor and its `sensing` what makes its raw data from its pose (7,),
    the time in ns, the names of robot and sensor, and a seed.  Its content is between the `corners` (N, 3).
    """

    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    segments: Array = field(default_factory=lambda: np.empty((0, 6)))
    tags: Array = field(default_factory=lambda: np.empty((0, 7)))
    tag_sizes: Array = field(default_factory=lambda: np.empty(0))
    corners: Array = field(default_factory=lambda: np.empty((0, 3)))
    classes: Index | None = None
    raw_of: Callable[[Any, Any], Callable[[Array, int, str, str, int], Raw]] | None = None

    @property
    def of_space(self) -> bool:
        """True if it cannot be in the plane, but for points at heights."""
        solid = bool(len(self.segments)) and self.segments.shape[1] == 6
        return solid or bool(len(self.tags)) or self.raw_of is not None


class LayoutSection(Section):
    """A layout; `gives_raw` are the types of sensors whose raw data it can give."""

    gives_raw: ClassVar[tuple[str, ...]] = ()


class OfPoints(LayoutSection):
    """A layout that places points alone."""

    def place(self, rng: Generator) -> Array:
        """Return the landmarks (N, 2|3)."""
        raise NotImplementedError

    def scenery(self, rng: Generator) -> Scenery:
        """Return what there is to see."""
        return Scenery(self.place(rng))


class WallLayout(OfPoints):
    """The limits of a cloister."""

    x_min_m: Number = -4.0
    """Western wall."""
    x_max_m: Number = 4.0
    """Eastern wall."""
    y_min_m: Number = -4.0
    """Southern wall."""
    y_max_m: Number = 4.0
    """Northern wall."""
    n: Annotated[int, Within(ge=4)] = 9
    """Rows and columns; 7 gives 36 landmarks."""

    @model_validator(mode="after")
    def _has_room(self) -> WallLayout:
        if self.x_max_m <= self.x_min_m or self.y_max_m <= self.y_min_m:
            raise unexpected_value("x_max_m above x_min_m and y_max_m above y_min_m")
        return self

    def floor(self) -> Array:
        """Return the points (4 (2 n - 5), 2) of one storey, in the guide's order.  [S] cloister.m."""
        n, low, high = self.n, np.array([self.x_min_m, self.y_min_m]), np.array([self.x_max_m, self.y_max_m])
        outer = np.arange(n - 2) - (n - 3) / 2
        walls = (outer, (n - 1) / 2), (outer[:-1], (n - 3) / 2)
        north = np.vstack([np.column_stack([along, np.full(len(along), off)]) for along, off in walls])
        east = north @ np.array([[0.0, -1.0], [1.0, 0.0]]).T  # the guide's name: a quarter turn to the left
        return np.vstack([north, east, -north, -east]) * (high - low) / (n - 1) + (low + high) / 2


class Cloister(WallLayout):
    """Sola's cloister: a square walk, an outer wall and an inner row of columns.  [S] cloister.m."""

    type: Literal["cloister"] = "cloister"

    def place(self, rng: Generator) -> Array:
        """Return the landmarks (4 (2 n - 5), 2), always the same."""
        return self.floor()


class Loop(OfPoints):
    """Landmarks on both sides of a circle."""

    type: Literal["loop"] = "loop"
    count: Count = 20
    """Number of landmarks."""
    radius_m: Positive = 10.0
    """The circle's radius."""
    x_m: Number = 0.0
    """The circle's centre."""
    y_m: Number = 0.0
    """The circle's centre."""
    radius_spread_m: NotNegative = 3.0
    """Radii are uniform within this of the circle's."""
    angles: Literal["uniform", "even"] = "uniform"
    """Anywhere, or evenly spread."""
    angle_spread_rad: NotNegative = 0.0
    """Even angles are moved uniformly within this."""

    @model_validator(mode="after")
    def _is_outside_the_centre(self) -> Loop:
        if self.radius_spread_m > self.radius_m:
            raise unexpected_value(f"radius_spread_m at most radius_m, {self.radius_m:g}")
        return self

    def place(self, rng: Generator) -> Array:
        """Return random landmarks (count, 2)."""
        if self.angles == "uniform":
            angle = rng.uniform(0.0, 2 * math.pi, self.count)
        else:
            even = np.arange(self.count) * (2 * math.pi / self.count)
            angle = even + rng.uniform(-self.angle_spread_rad, self.angle_spread_rad, self.count)
        radius = self.radius_m + rng.uniform(-self.radius_spread_m, self.radius_spread_m, self.count)
        return np.column_stack([self.x_m + radius * np.cos(angle), self.y_m + radius * np.sin(angle)])


class RandomField(OfPoints):
    """Landmarks spread uniformly over a square."""

    type: Literal["random_field"] = "random_field"
    count: Count = 100
    """Number of landmarks."""
    size_m: Positive = 50.0
    """Side of the square; its south-western corner is the origin."""

    def place(self, rng: Generator) -> Array:
        """Return random landmarks (count, 2)."""
        return rng.uniform(0.0, self.size_m, (self.count, 2))


def along_closed_line(points: Array, spacing_m: float) -> tuple[Array, Array]:
    """Return places (N, 2) evenly spaced along a smooth closed line through points (K, 2), and its normals (N, 2).

    A normal points to the left.  The spacing is the nearest to the one given that divides the length of the line.
    """
    from scipy.interpolate import CubicSpline

    closed = np.vstack([points, points[:1]])
    chords = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1)))
    line = CubicSpline(chords, closed, bc_type="periodic")
    at = np.linspace(0.0, chords[-1], 100 * len(closed))
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line(at), axis=0), axis=1)))
    count = max(1, round(float(lengths[-1]) / spacing_m))
    along = np.interp(np.arange(count) * lengths[-1] / count, lengths, at)
    ahead = line(along, 1) / np.linalg.norm(line(along, 1), axis=1, keepdims=True)
    return np.asarray(line(along)), ahead[:, ::-1] * [-1.0, 1.0]


class RaceTrack(LayoutSection):
    """Cones on both sides of a closed track: classes 0 to its left, 1 to its right and 2, two pairs, at its start."""

    type: Literal["race_track"] = "race_track"
    line_m: Annotated[Points, AfterValidator(closed)]
    """Places (x, y) on the middle of the track, the start first; a smooth closed line goes through them."""
    width_m: Positive = 3.5
    """Distance between the cones of both sides."""
    spacing_m: Positive = 4.0
    """Distance between the cones of one side, along the middle."""

    def scenery(self, rng: Generator) -> Scenery:
        """Return the cones, always the same: those to the left, those to the right, those at the start."""
        middle, left = along_closed_line(np.array(self.line_m, dtype=np.float64), self.spacing_m)
        sides = [middle + side * 0.5 * self.width_m * left for side in (1.0, -1.0)]
        start = [side[0] + step * left[0] @ [[0.0, -1.0], [1.0, 0.0]] for side in sides for step in (-0.3, 0.3)]
        cones = np.vstack([sides[0][1:], sides[1][1:], start])
        return Scenery(cones, classes=np.repeat([0, 1, 2], [len(middle) - 1, len(middle) - 1, len(start)]))


class ThickCloister(WallLayout):
    """A cloister of two storeys, at z = 0 and above.  [TB] `thickCloister`."""

    type: Literal["thick_cloister"] = "thick_cloister"
    height_m: Number = 1.0
    """Height of the upper storey."""

    def place(self, rng: Generator) -> Array:
        """Return the landmarks (8 (2 n - 5), 3), the lower storey first."""
        floor = self.floor()
        return np.vstack([np.column_stack([floor, np.full(len(floor), z)]) for z in (0.0, self.height_m)])


class House(LayoutSection):
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
        wall, top = 0.65, 1.0
        ground = [(0, 0), (1, 0), (1, 1), (0, 1)]
        columns = [((x, y, 0), (x, y, wall)) for x, y in ground]
        floor = [((*ground[i], 0), (*ground[(i + 1) % 4], 0)) for i in range(4)]
        gables = [((x, y, a), (x, y + 0.5, b)) for x in (0, 1) for y, a, b in ((0, wall, top), (0.5, top, wall))]
        along = [((0, y, z), (1, y, z)) for y, z in ((0.5, top), (0, wall), (1, wall))]
        door, window = [(0.6, 0), (0.8, 0), (0.8, 0.5), (0.6, 0.5)], [(0.2, 0.25), (0.4, 0.25), (0.4, 0.5), (0.2, 0.5)]
        frames = [((0, *frame[i]), (0, *frame[(i + 1) % 4])) for frame in (door, window) for i in range(4)]
        ends = np.array([*columns, *floor, *gables, *along, *frames]) * [self.length_m, self.width_m, self.height_m]
        return Scenery(segments=(np.array([self.x_m, self.y_m, self.z_m]) + ends).reshape(-1, 6))


class RandomBox(OfPoints):
    """Landmarks spread uniformly over a box."""

    type: Literal["random_box"] = "random_box"
    count: Count = 100
    """Number of landmarks."""
    min_m: Triple = (0.0, 0.0, 0.0)
    """Lowest corner (x, y, z)."""
    max_m: Triple = (20.0, 20.0, 4.0)
    """Highest corner (x, y, z)."""

    @model_validator(mode="after")
    def _has_room(self) -> RandomBox:
        if not all(low <= high for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise unexpected_value("max_m nowhere below min_m")
        return self

    def place(self, rng: Generator) -> Array:
        """Return random landmarks (count, 3)."""
        return rng.uniform(self.min_m, self.max_m, (self.count, 3))


def pose_at_wall(
    size: tuple[float, float], wall: int, off_m: float, along: float, z: float, turned: float = 0.0
) -> Array:  # fmt: skip
    """Return the pose (7,) of a tag or picture on a wall of a room: 0 the western, 1 northern, 2 eastern, 3 southern.

    `size` is the length and width of the room, whose corner is the origin; the middle of the picture is `off_m` before
    the wall, at `along` from -1 to 1 on it and at the height `z` [m]; it is turned about its upright axis [rad].
    """
    middle = np.array(size) / 2
    reach, half = middle if wall % 2 == 0 else middle[::-1]
    c, s = math.cos(-math.pi / 2 * wall), math.sin(-math.pi / 2 * wall)
    x, y = reach - off_m, half * along
    place = middle[0] - c * x - s * y, middle[1] - s * x + c * y, z
    return from_euler_pose(np.array([*place, -math.pi / 2, 0.0, math.pi / 2 * (1 - wall) + turned]))[0]


class TagRoom(LayoutSection):
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
        across = (2 * np.arange(1, self.per_wall + 1) / (self.per_wall + 1) - 1).tolist()
        size = self.length_m, self.width_m
        tags = [pose_at_wall(size, wall, 0.0, y, z) for wall in range(4) for z, y in product(self.heights_m, across)]
        return Scenery(tags=np.array(tags), tag_sizes=np.full(len(tags), self.size_m))


def wall_corners(walls: Array) -> Array:
    """Return where walls (S, 4) meet (N, 2): where an end of one is on another that has another direction."""
    found: list[Array] = []
    a, u = walls[:, :2], walls[:, 2:] - walls[:, :2]
    length = np.linalg.norm(u, axis=1)
    for end, along, size in zip(np.vstack([a, a + u]), np.vstack([u, u]), np.tile(length, 2), strict=True):
        off = end - a
        t, across = np.einsum("kj,kj->k", off, u) / length, (off[:, 0] * u[:, 1] - off[:, 1] * u[:, 0]) / length
        turned = np.abs(along[0] * u[:, 1] - along[1] * u[:, 0]) > STRAIGHT * size * length
        meets = (np.abs(across) < TOUCH_M) & (t > -TOUCH_M) & (t < length + TOUCH_M) & turned
        if meets.any() and not any(np.linalg.norm(end - other) < TOUCH_M for other in found):
            found.append(end)
    return np.array(found).reshape(-1, 2)


class ViewerPose(Section):
    """A pose: x to the right of a viewer, y down, z away from the viewer."""

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

    def pose(self) -> Array:
        """Return its pose (7,)."""
        turns = np.radians([self.roll_deg, self.pitch_deg, self.yaw_deg])
        return from_euler_pose(np.array([self.x_m, self.y_m, self.z_m, *turns]))[0]


class ListedTag(ViewerPose):
    """A tag: x to the right of a viewer, y down, z away from the viewer, into the wall behind it."""

    size_m: Positive = 0.3
    """Its side."""


class Listed(LayoutSection):
    """Landmarks at given places: points, segments, tags; walls of the plane, whose corners are points."""

    type: Literal["list"] = "list"
    points_m: Points | None = None
    """One (x, y) or (x, y, z) each; their ids are 1, 2, ..."""
    segments_m: Annotated[tuple[Segment, ...], Field(strict=False)] = ()
    """Both ends of each (x, y, z, x, y, z); their ids follow those of the points."""
    tags: Annotated[tuple[ListedTag, ...], Field(strict=False)] = ()
    """Poses and sizes; their ids follow those of the segments."""
    walls_m: Annotated[tuple[Wall, ...], Field(strict=False)] = ()
    """Both ends of each (x, y, x, y), in the plane; ids follow those of the points and of the corners of the walls."""

    @model_validator(mode="after")
    def _has_something(self) -> Listed:
        if not (self.points_m or self.segments_m or self.tags or self.walls_m):
            raise unexpected_value("points_m, segments_m, tags or walls_m")
        if self.walls_m and (self.segments_m or self.tags or (self.points_m and len(self.points_m[0]) == 3)):
            raise unexpected_value("walls_m without anything of space")
        if any(wall[:2] == wall[2:] for wall in self.walls_m):
            raise unexpected_value("walls_m with two ends each")
        if self.points_m and len(self.points_m[0]) == 2 and (self.segments_m or self.tags):
            raise unexpected_value("points [x, y, z] beside segments or tags")
        return self

    def scenery(self, rng: Generator) -> Scenery:
        """Return what is listed."""
        points = np.array(self.points_m, dtype=np.float64) if self.points_m else np.empty((0, 3))
        if self.walls_m:
            walls = np.array(self.walls_m, dtype=np.float64)
            return Scenery(np.concatenate([points.reshape(-1, 2), wall_corners(walls)]), walls)
        segments = np.array(self.segments_m, dtype=np.float64).reshape(-1, 6)
        tags = np.array([tag.pose() for tag in self.tags]).reshape(-1, 7)
        return Scenery(points, segments, tags, np.array([tag.size_m for tag in self.tags]))


class Empty(LayoutSection):
    """No landmark: for sensors of the robot itself."""

    type: Literal["empty"] = "empty"

    def scenery(self, rng: Generator) -> Scenery:
        """Return nothing to see."""
        return Scenery(np.empty((0, 2)))


Layout = Annotated[Any, OneOf(
    Cloister, Loop, RandomField, RaceTrack, ThickCloister, House, RandomBox, TagRoom, Listed, Empty, group="layouts"
)]  # fmt: skip
