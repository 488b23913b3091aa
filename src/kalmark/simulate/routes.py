"""Where a simulated robot is told to go: a constant control, waypoints, a random walk between places, lanes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import cycle
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.random import Generator
from pydantic import Discriminator, Field, Tag

from kalmark.config.sections import Number, Positive, Section, type_or
from kalmark.geometry.angles import wrap
from kalmark.models.motion import Ackermann, Odometry2D, Unicycle
from kalmark.simulate.layouts import Points, mapping_of

Array = npt.NDArray[np.float64]
Driver = Callable[[Array], Array]  # true pose -> control of the next step


class Constant(Section):
    """The same control at every step: a circle or a line."""

    type: Literal["constant"] = "constant"
    u: Annotated[tuple[Number, ...], Field(strict=False)]
    """The control, in the motion model's columns."""

    def driver(self, motion: Any, dt_s: float, area: Array, rng: Generator) -> Driver:
        """Return what gives the control at each true pose."""
        u = np.array(self.u)
        return lambda pose: u


class _Drive(Section):
    speed_mps: Positive = 1.0
    """Speed along the route."""
    turn_radius_m: Positive = 1.0
    """Tightest turn; a place counts as reached within twice this."""

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places to drive to, without end."""
        raise NotImplementedError

    def driver(self, motion: Any, dt_s: float, area: Array, rng: Generator) -> Driver:
        """Return what steers from each true pose towards the next place."""
        places = self.places(area, rng)
        target = next(places)
        limit = self.speed_mps / self.turn_radius_m

        def drive(pose: Array) -> Array:
            nonlocal target
            for _ in range(1000):
                if math.dist(target, pose[:2]) > 2 * self.turn_radius_m:
                    break
                target = next(places)
            error = wrap(math.atan2(target[1] - pose[1], target[0] - pose[0]) - pose[2])
            w = min(limit, max(-limit, error / dt_s))
            return control(motion, self.speed_mps, w, dt_s)

        return drive


class Waypoints(_Drive):
    """Given places one after the other, round and round."""

    type: Literal["waypoints"] = "waypoints"
    points_m: Points
    """The places (x, y)."""

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places to drive to, without end."""
        yield from cycle(np.array(self.points_m, dtype=np.float64))


class Wander(_Drive):
    """Random places between the landmarks."""

    type: Literal["wander"] = "wander"

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places to drive to, without end."""
        while True:
            yield rng.uniform(area[0], area[1])


class Lanes(_Drive):
    """Lanes up and down between the landmarks, then back: every part of the area is seen."""

    type: Literal["lanes"] = "lanes"
    spacing_m: Positive = 10.0
    """Distance between lanes."""

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places to drive to, without end."""
        (west, south), (east, north) = area
        lanes = np.linspace(west, east, max(2, math.ceil((east - west) / self.spacing_m) + 1))
        ends = [(x, y) for i, x in enumerate(lanes) for y in ((south, north) if i % 2 == 0 else (north, south))]
        yield from cycle(np.array(ends + ends[-2:0:-1]))


Route = Annotated[
    Annotated[
        Annotated[Constant, Tag("constant")]
        | Annotated[Waypoints, Tag("waypoints")]
        | Annotated[Wander, Tag("wander")]
        | Annotated[Lanes, Tag("lanes")],
        Discriminator(type_or()),
    ],
    mapping_of("constant", "waypoints", "wander", "lanes"),
]


def control(motion: Any, v: float, w: float, dt_s: float) -> Array:
    """Return the control of `motion` that drives at v (m/s) and turns at w (rad/s) for `dt_s`."""
    if isinstance(motion, Unicycle):
        return np.array([v, w])
    if isinstance(motion, Odometry2D):
        a = 0.5 * w * dt_s
        chord = v * dt_s * (math.sin(a) / a if a else 1.0)
        return np.array([chord * math.cos(a), chord * math.sin(a), 2 * a])
    assert isinstance(motion, Ackermann)
    tan = w * motion.wheelbase_m / v
    return np.array([v * (1.0 - tan * motion.encoder_offset_m / motion.wheelbase_m), math.atan(tan)])
