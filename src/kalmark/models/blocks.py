"""Sensors of any blocks of the map: distances and offsets between robots and landmarks, and functions of your own.

An observation names the blocks that it is of (`Scan.of`); `slam/factors.py` corrects by it.  docs/factors.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import Positive, Probability, declared, register
from kalmark.models.landmark_views import Sensing
from kalmark.models.pointwise import noise_covariance
from kalmark.models.protocols import BLOCKS, PLACES

__all__ = ["Distance", "Offset2D", "Offset3D"]


@declared
class _Between(Sensing):
    """Base of sensors that measure between the places of two blocks."""

    sigma_m: Annotated[Positive, "Noise of each number."] = 0.01
    pass_share: Annotated[Probability, "Share of good readings that pass the gate; others are left out."] = 0.9999

    views: ClassVar[str] = PLACES
    sees_kinds = ()

    def expect(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        """Return how far the place b (d,) is from a (d,) along each axis (d,), and both Jacobians (d, d)."""
        return b - a, -np.eye(len(a)), np.eye(len(a))


@register("sensor", "distance")
class Distance(_Between):
    """Distance between two robots or landmarks: a tape measure, a radio.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"tape": km.Mount(km.sensors.Distance())})
    >>> slam = km.Slam(rover)
    >>> for name, place in {"door": (4.0, 0.0), "mast": (0.0, 3.0)}.items():
    ...     slam.add_landmark(name, place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "tape", [[5.2]], of=[["door", "mast"]]))
    >>> float(np.linalg.norm(slam.mean("door") - slam.mean("mast")).round(2))
    5.2
    """

    columns = ("distance_m",)
    sigmas = ("sigma_m",)

    def expect(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        """Return the distance (1,) of the places a and b (d,), and its Jacobians (1, d)."""
        d = b - a
        r = np.linalg.norm(d)
        E_b = d[None] / r if r else 0.0 * d[None]
        return np.array([r]), -E_b, E_b


@register("sensor", "offset")
class Offset2D(_Between):
    """From one robot or landmark to another, along the axes of the map; zero for those that are in one place.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"plan": km.Mount(km.sensors.Offset2D(0.001))})
    >>> slam = km.Slam(rover)
    >>> for name, place in {"door": (4.0, 0.0), "frame": (4.1, 0.1)}.items():
    ...     slam.add_landmark(name, place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "plan", [[0.0, 0.0]], of=[["door", "frame"]]))
    >>> slam.mean("door").round(2), slam.mean("frame").round(2)
    (array([4.05, 0.05]), array([4.05, 0.05]))
    """

    world = "plane"
    columns = ("dx_m", "dy_m")
    sigmas = ("sigma_m",) * 2


@register("sensor", "offset")
class Offset3D(_Between):
    """From one robot or landmark to another, along the axes of the map; zero for those that are in one place.

    >>> drone = km.Robot("drone", km.motion.Odometry3D(), sensors={"plan": km.Mount(km.sensors.Offset3D())})
    >>> slam = km.Slam(drone)
    >>> for name, place in {"roof": (4.0, 0.0, 3.1), "floor": (4.0, 0.0, 0.0)}.items():
    ...     slam.add_landmark(name, place, cov=0.01 * np.eye(3))
    >>> report = slam.process(km.Scan(0.0, "drone", "plan", [[0.0, 0.0, 3.0]], of=[["floor", "roof"]]))
    >>> slam.mean("roof").round(2), slam.mean("floor").round(2)
    (array([4.  , 0.  , 3.05]), array([4.  , 0.  , 0.05]))
    """

    world = "space"
    columns = ("dx_m", "dy_m", "dz_m")
    sigmas = ("sigma_m",) * 3


@dataclass(frozen=True, eq=False)
class BlockSensor:
    """A sensor of blocks made of a function; see `factor`."""

    expect: Callable[..., Any]
    R: Array
    columns: tuple[str, ...]
    angular: tuple[bool, ...]
    views: str = BLOCKS
    pass_share: float = 1.0

    def noise(self, y: Array) -> Array:
        """Return R (K, m, m) of measurements y (K, m)."""
        return np.tile(self.R, (len(y), 1, 1))


def factor(
    expect: Callable[..., Any], noise: Any, *, columns: Sequence[str] = (), angular: Sequence[bool] = (),
    places: bool = False, pass_share: float = 1.0,
) -> BlockSensor:  # fmt: skip
    """Make a sensor of any blocks of the map, of a function `expect(x_1, ..., x_k) -> e` (m,).

    The arguments are the means of the blocks that an observation is `of`, as `Slam.mean` has them, or with `places`
    where they are (2 or 3,), m.  Jacobians in the errors of the blocks, behind e in a tuple, are optional.  `noise` is
    the covariance (m, m); `angular` marks angles.  `pass_share` is the share of good readings that
    pass the gate (1: no gate).

    >>> height = km.factor(lambda a, b: b[2:] - a[2:], noise=[[0.01**2]], places=True)
    >>> height.expect(np.zeros(3), np.array([1.0, 2.0, 3.0]))
    array([3.])
    """
    R = noise_covariance(noise, "factor")
    names = tuple(columns) or tuple(f"y{i}" for i in range(len(R)))
    return BlockSensor(expect, R, names, tuple(angular) or (False,) * len(R), PLACES if places else BLOCKS, pass_share)
