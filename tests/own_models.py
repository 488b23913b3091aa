"""Models of a user's own, one of each kind, as a plugin has them: a tracked robot that observes signs.

A sign is known by its post and the direction of its arm; it is where its board is, at the end of the arm.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

import kalmark as km
from kalmark.declare import NotNegative, Positive
from kalmark.geometry import compose, inverse
from kalmark.geometry.spaces import HEADING, SE2, VECTOR, Space
from kalmark.logs import FORMATS
from kalmark.logs.source import Format

Array = np.ndarray[Any, np.dtype[np.float64]]


@km.register("motion", "tracks")
class Tracks:
    """A robot on two tracks: the speed of each is held until the next control."""

    gauge_m: Annotated[Positive, "Distance of the tracks."] = 0.5
    sigma_mps: Annotated[NotNegative, "Noise of the speed of a track."] = 0.05

    space: ClassVar[Space] = SE2
    columns: ClassVar[tuple[str, ...]] = ("left_mps", "right_mps")
    held: ClassVar[bool] = True

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved pose (3,), R_r (3, 3) and R_u (3, 2)."""
        V_u = np.array([[0.5, 0.5], [-1 / self.gauge_m, 1 / self.gauge_m]])
        r, R_r, R_v = km.motion.Unicycle().move(r, V_u @ u, dt_s)
        return r, R_r, R_v @ V_u

    def control_noise(self, u: Array) -> Array:
        """Return N (2, 2)."""
        return np.eye(2) * self.sigma_mps**2

    def diffusion(self, u: Array, dt_s: float) -> None:
        """Return None: there is none."""


@km.register("sensor", "sign_reader")
class SignReader:
    """Range and bearing of a sign's post, and the direction of its arm."""

    sigma_range_m: Annotated[Positive, "Noise of the range."] = 0.1
    sigma_angle_rad: Annotated[Positive, "Noise of both angles."] = 0.02

    columns: ClassVar[tuple[str, ...]] = ("post_m", "post_rad", "arm_rad")
    angular: ClassVar[tuple[bool, ...]] = (False, True, True)
    world: ClassVar[str] = "plane"

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return what is measured (K, 3) of v (K, 3), and E_v (K, 3, 3)."""
        d, E_v = np.hypot(v[:, 0], v[:, 1]), np.zeros((len(v), 3, 3))
        E_v[:, 0, 0], E_v[:, 0, 1] = v[:, 0] / d, v[:, 1] / d
        E_v[:, 1, 0], E_v[:, 1, 1] = -v[:, 1] / d**2, v[:, 0] / d**2
        E_v[:, 2, 2] = 1.0
        return np.column_stack([d, np.arctan2(v[:, 1], v[:, 0]), v[:, 2]]), E_v

    def noise(self, y: Array) -> Array:
        """Return R (K, 3, 3)."""
        sigmas = [self.sigma_range_m, self.sigma_angle_rad, self.sigma_angle_rad]
        return np.tile(np.diag(np.square(sigmas)), (len(y), 1, 1))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return v (K, 3) of measurements y (K, 3), and V_y (K, 3, 3)."""
        v = np.column_stack([y[:, 0] * np.cos(y[:, 1]), y[:, 0] * np.sin(y[:, 1]), y[:, 2]])
        return v, np.array(np.linalg.inv(self.expect(v)[1]))


@km.register("landmark", "sign")
class Sign:
    """A sign: the pose (x, y, theta) of its post, with the arm ahead."""

    arm_m: Annotated[Positive, "Length of the arm."] = 0.5

    kind: ClassVar[str] = "sign"
    space: ClassVar[Space] = Space("sign", (VECTOR, HEADING))

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return v (K, 3), V_T (K, 3, 3), V_l (K, 3, 3)."""
        to, TO_T = inverse(T)
        v, V_to, V_l = map(np.array, zip(*(compose(to, each) for each in l), strict=True))
        return v, V_to @ TO_T, V_l

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, 3), L_T (K, 3, 3), L_v (K, 3, 3)."""
        l, L_T, L_v = map(np.array, zip(*(compose(T, each) for each in v), strict=True))
        return l, L_T, L_v

    def place(self, l: Array) -> tuple[Array, Array]:
        """Return where the boards are (K, 2), and P_l (K, 2, 3)."""
        board = np.array([self.arm_m, 0.0, 0.0])
        p, P_l, _ = map(np.array, zip(*(compose(each, board) for each in l), strict=True))
        return p[:, :2], P_l[:, :2]


@km.register("association", "by_number")
class ByNumber:
    """Trust the ids of the log, but for one: it is of signs that cannot be read."""

    unread: Annotated[int, "The id of signs that cannot be read."] = -1

    def threshold(self, m: int, default: float) -> float:
        """Return the gate of the estimator."""
        return default

    def associate(self, query: Any) -> list[Any]:
        """Return the ids."""
        return [(None, "cannot be read") if name == self.unread else (name, "") for name in query.ids]


@km.register("estimator", "cautious")
class Cautious:
    """The textbook filter, with more noise than the sensors state."""

    factor: Annotated[Positive, "Of the covariance of the noise."] = 1.0

    coordinates: ClassVar[str] = "world"
    default_gate: ClassVar[float] = 25.0

    def predict(self, map_: Any, movement: Any) -> bool:
        """Move a robot."""
        return km.estimators.Ekf().predict(map_, movement)

    def correct(self, map_: Any, update: Any) -> Any:
        """Fuse a scan."""
        return km.estimators.Ekf().correct(map_, update._replace(R=self.factor * update.R))

    def for_fixes(self) -> Cautious:
        """Return the estimator of absolute positions."""
        return self

    def pose_jacobian(self, map_: Any, robot: int, J: Array) -> Array:
        """Return J (., 3) as it is."""
        return J


def find(path: Path) -> Path | None:
    """Return the path of a log if it is one of tracks and signs."""
    return path if path.suffix == ".signs" else None


def read(path: Path, request: Any) -> km.Log:
    """Return the log in a file: rows of a time, then both speeds, or a sign's number and what is measured of it."""
    events: list[Any] = []
    with path.open(newline="") as file:
        for t, *values in csv.reader(file):
            if len(values) == 2:
                events.append(km.Control(float(t), "crawler", list(map(float, values))))
            else:
                events.append(km.Scan(float(t), "crawler", "eye", [list(map(float, values[1:]))], [int(values[0])]))
    return km.Log(path.stem, ("crawler",), events, "signs", path, skipped=request.skipped)


FORMATS["signs"] = Format("signs", "a file that ends in .signs", find, read)


def where(run: Path) -> None:
    """Print where the signs of a run are: a verb."""
    slam = km.Slam.load(run / "map.kmk")
    for name in slam.landmarks().ids:
        print(name, *slam.place(name)[0].round(3))
