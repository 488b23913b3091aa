"""Where the landmarks of a simulated world stand: Sola's cloister ([S] App. C), a loop, a random field, a list.

Layouts of the plane serve robots of space as well: their landmarks are at z = 0.  Those of space are in `layouts3d`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.random import Generator
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from kalmark.config.sections import NotNegative, Number, Positive, Section, expected

Array = npt.NDArray[np.float64]
Count = Annotated[int, Field(ge=1)]


def _some(points: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if not points:
        raise expected("at least one point [x, y]")
    sizes = {len(point) for point in points}
    if len(sizes) > 1 or not sizes <= {2, 3}:
        raise expected("points [x, y], or all of them [x, y, z]")
    return points


Point = Annotated[tuple[Number, ...], Field(strict=False)]
Points = Annotated[tuple[Point, ...], Field(strict=False), AfterValidator(_some)]


def mapping_of(*types: str) -> BeforeValidator:
    """Return the check that a section chosen by `type` is a mapping that names one."""

    def check(value: Any) -> Any:
        if not isinstance(value, Section) and not (isinstance(value, dict) and "type" in value):
            raise expected("a mapping with a type: one of " + ", ".join(types))
        return value

    return BeforeValidator(check)


@dataclass(frozen=True, eq=False)
class Scenery:
    """What there is to see: points (N, 2|3), segments (S, 6) from end to end, tags (T, 7) as poses, in m.

    `tag_sizes` (T,) are the sides of the tags.
    """

    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    segments: Array = field(default_factory=lambda: np.empty((0, 6)))
    tags: Array = field(default_factory=lambda: np.empty((0, 7)))
    tag_sizes: Array = field(default_factory=lambda: np.empty(0))

    @property
    def of_space(self) -> bool:
        """Whether it cannot be in the plane."""
        return self.points.shape[1] == 3 or bool(len(self.segments)) or bool(len(self.tags))


class OfPoints(Section):
    """A layout that places points alone."""

    def place(self, rng: Generator) -> Array:
        """Return the landmarks (N, 2|3)."""
        raise NotImplementedError

    def scenery(self, rng: Generator) -> Scenery:
        """Return what there is to see."""
        return Scenery(self.place(rng))


class Walls(OfPoints):
    """The limits of a cloister."""

    x_min_m: Number = -4.0
    """Western wall."""
    x_max_m: Number = 4.0
    """Eastern wall."""
    y_min_m: Number = -4.0
    """Southern wall."""
    y_max_m: Number = 4.0
    """Northern wall."""
    n: Annotated[int, Field(ge=4)] = 9
    """Rows and columns; 7 gives 36 landmarks."""

    @model_validator(mode="after")
    def _has_room(self) -> Walls:
        if self.x_max_m <= self.x_min_m or self.y_max_m <= self.y_min_m:
            raise expected("x_max_m above x_min_m and y_max_m above y_min_m")
        return self


class Cloister(Walls):
    """Sola's cloister: a square walk, an outer wall and an inner row of columns.  [S] cloister.m."""

    type: Literal["cloister"] = "cloister"

    def place(self, rng: Generator) -> Array:
        """Return the landmarks (4 (2 n - 5), 2), always the same."""
        return cloister(self.x_min_m, self.x_max_m, self.y_min_m, self.y_max_m, self.n)


class Loop(OfPoints):
    """Landmarks on both sides of a circle."""

    type: Literal["loop"] = "loop"
    count: Count = 20
    """How many landmarks."""
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
            raise expected(f"radius_spread_m at most radius_m, {self.radius_m:g}")
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
    """How many landmarks."""
    size_m: Positive = 50.0
    """Side of the square; its south-western corner is the origin."""

    def place(self, rng: Generator) -> Array:
        """Return random landmarks (count, 2)."""
        return rng.uniform(0.0, self.size_m, (self.count, 2))


def cloister(x_min: float, x_max: float, y_min: float, y_max: float, n: int = 9) -> Array:
    """Return the points (4 (2 n - 5), 2) of a cloister within these limits, in the guide's order.  [S] cloister.m."""
    outer = np.arange(n - 2) - (n - 3) / 2
    inner = outer[:-1]
    north = np.vstack(
        [np.column_stack([outer, np.full(n - 2, (n - 1) / 2)]), np.column_stack([inner, np.full(n - 3, (n - 3) / 2)])]
    )
    east = north @ np.array([[0.0, -1.0], [1.0, 0.0]]).T  # the guide's name: a quarter turn to the left
    points = np.vstack([north, east, -north, -east])
    return points * np.array([x_max - x_min, y_max - y_min]) / (n - 1) + [(x_min + x_max) / 2, (y_min + y_max) / 2]
