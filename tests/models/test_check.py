"""`kalmark check` on models of a user's own: right ones pass, wrong ones are named."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

import kalmark as km
from kalmark.errors import ModelError
from kalmark.geometry.spaces import HEADING, SCALAR, VECTOR, Space
from kalmark.models.landmarks import Point2D
from kalmark.models.model_check import CheckResult, check_model
from kalmark.models.motion import Unicycle
from kalmark.simulate.robots import add_diffusion

Array = npt.NDArray[np.float64]


def check(model: Any) -> dict[str, CheckResult]:
    return {finding.what: finding for finding in check_model(model, np.random.default_rng(0))}


def wrong(model: Any) -> set[str]:
    return {what for what, finding in check(model).items() if not finding.ok}


class Speed:
    """A robot whose speed is in its state and whose controls are changes of speed and heading, not wrapped."""

    space: ClassVar = Space("SE2 with speed", (VECTOR, HEADING, SCALAR))
    columns: ClassVar = ("dv_mps", "dtheta_rad")
    held: ClassVar = False
    coasts: ClassVar = True
    spread = 1.0  # of a right Jacobian

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        x, y, a, v = r
        a, v = a + u[1], v + u[0]
        c, s = np.cos(a), np.sin(a)
        R_r = np.eye(4)
        R_r[:2, 2], R_r[:2, 3] = (-s * v * dt_s, c * v * dt_s), (c * dt_s, self.spread * s * dt_s)
        R_u = np.stack([R_r[:, 3], R_r[:, 2]], axis=1)
        return np.array([x + c * v * dt_s, y + s * v * dt_s, a, v]), R_r, R_u

    def control_noise(self, u: Array) -> Array:
        return np.diag([0.1, 0.02]) ** 2

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        return np.diag([0.1, 0.1, 0.02]) * dt_s


class Bearing:
    """A bearing in [0, 2 pi): it jumps ahead of the robot."""

    columns: ClassVar = ("bearing_rad",)
    angular: ClassVar = (True,)
    finds_depth: ClassVar = False

    def expect(self, v: Array) -> tuple[Array, Array]:
        d2 = np.sum(v * v, axis=1)
        E_v = np.stack([-v[:, 1] / d2, v[:, 0] / d2], axis=1)[:, None]
        return np.arctan2(v[:, 1], v[:, 0])[:, None] % (2 * np.pi), E_v

    def noise(self, y: Array) -> Array:
        return np.full((len(y), 1, 1), 0.01)

    def invert(self, y: Array) -> tuple[Array, Array]:
        c, s = np.cos(y), np.sin(y)
        return np.hstack([c, s]), np.stack([-s, c], axis=1)


class Camera:
    """A pin hole that finds no depth, in pixels from its principal point."""

    columns: ClassVar = ("u_px", "v_px")
    angular: ClassVar = (False, False)
    world: ClassVar = "space"
    finds_depth: ClassVar = False
    sees_kinds: ClassVar = ("point3",)
    back = 1.0  # of a right inverse

    def expect(self, v: Array) -> tuple[Array, Array]:
        E_v = np.zeros((len(v), 2, 3))
        E_v[:, 0, 0] = E_v[:, 1, 1] = 400 / v[:, 2]
        E_v[:, :, 2] = -400 * v[:, :2] / v[:, 2:] ** 2
        return 400 * v[:, :2] / v[:, 2:], E_v

    def noise(self, y: Array) -> Array:
        return np.tile(np.eye(2), (len(y), 1, 1))

    def invert(self, y: Array) -> tuple[Array, Array]:
        V_y = np.zeros((len(y), 3, 2))
        V_y[:, 0, 0] = V_y[:, 1, 1] = self.back / 400
        return np.column_stack([self.back * y / 400, np.ones(len(y))]), V_y

    def sees(self, v: Array) -> Any:
        return v[:, 2] > 0.1


class Sign:
    """A sign: a point and the direction that it faces, seen with the direction from the robot's."""

    kind: ClassVar = "sign"
    space: ClassVar = Space("sign", (VECTOR, HEADING))
    turned = 1.0  # of a right Jacobian

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        v, V_T, V_l = Point2D().seen_from(T, l[:, :2])
        k = len(l)
        whole_T, whole_l = np.zeros((k, 3, 3)), np.zeros((k, 3, 3))
        whole_T[:, :2], whole_T[:, 2, 2] = V_T, -self.turned
        whole_l[:, :2, :2], whole_l[:, 2, 2] = V_l, 1.0
        return np.column_stack([v, wrapped(l[:, 2] - T[2])]), whole_T, whole_l

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        l, L_T, L_v = Point2D().from_view(T, v[:, :2])
        k = len(v)
        whole_T, whole_v = np.zeros((k, 3, 3)), np.zeros((k, 3, 3))
        whole_T[:, :2], whole_T[:, 2, 2] = L_T, 1.0
        whole_v[:, :2, :2], whole_v[:, 2, 2] = L_v, 1.0
        return np.column_stack([l, wrapped(v[:, 2] + T[2])]), whole_T, whole_v

    def place(self, l: Array) -> tuple[Array, Array]:
        return np.array(l[:, :2]), np.tile(np.eye(2, 3), (len(l), 1, 1))


def wrapped(a: Array) -> Array:
    return (a + np.pi) % (2 * np.pi) - np.pi


def polar(x: Array, y: Array) -> tuple[Array, Array, Array]:
    d = x - y
    rho = np.hypot(*d)
    D = np.array([d / rho, [-d[1] / rho**2, d[0] / rho**2]])
    return np.array([rho, np.arctan2(d[1], d[0])]), D, -D


def not_polar(x: Array, y: Array) -> tuple[Array, Array, Array]:
    value, D_x, D_y = polar(x, y)
    return value, D_x, -D_y


@pytest.mark.parametrize(
    "model", [Speed(), Bearing(), Camera(), Sign(), polar], ids=["speed", "bearing", "camera", "sign", "polar"]
)
def test_a_right_model_passes(model: Any) -> None:
    assert wrong(model) == set()


def test_a_model_with_a_wrong_jacobian_is_told_which() -> None:
    speed, camera, sign = Speed(), Camera(), Sign()
    speed.spread, camera.back, sign.turned = 1.1, 1.1, 0.9
    assert wrong(speed) == {"R_r", "R_u"}
    assert wrong(camera) == {"expect(invert(y)) = y"}
    assert wrong(sign) == {"V_T"}
    assert wrong(not_polar) == {"Jacobian 2"}


def test_an_angle_that_is_not_called_one_does_not_come_back() -> None:
    class Flat(Bearing):
        angular: ClassVar = (False,)

        def invert(self, y: Array) -> tuple[Array, Array]:
            return super().invert(y - 0.1)

    assert wrong(Flat()) == {"expect(invert(y)) = y"}


def test_a_motion_that_divides_by_no_turn_is_refused() -> None:
    class Naive(Unicycle):
        def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
            moved, R_r, R_u = super().move(r, u, dt_s)
            return moved * (u[1] / u[1]), R_r, R_u

    finding = check(Naive())["R_r"]
    assert not finding.ok
    assert "u = (0, 0)" in finding.where


def test_a_covariance_that_is_none_is_named() -> None:
    class Skew(Bearing):
        def noise(self, y: Array) -> Array:
            return np.full((len(y), 1, 1), -0.01)

    assert wrong(Skew()) == {"noise is a covariance"}


def test_wrong_shapes_and_missing_methods_are_refused() -> None:
    class Wide(Bearing):
        def noise(self, y: Array) -> Array:
            return np.ones((len(y), 2, 2))

    class Half:
        columns: ClassVar = ("x_m",)

        def expect(self, v: Array) -> Any:
            raise AssertionError

    with pytest.raises(ModelError, match=r"noise has shape \(200, 2, 2\), expected \(200, 1, 1\)"):
        check(Wide())
    with pytest.raises(ModelError, match="Half has no angular, noise"):
        check(Half())
    with pytest.raises(ModelError, match="expected a function, or a model"):
        check(3)


def test_a_robot_of_the_plane_with_a_speed_in_its_state_diffuses_in_its_pose() -> None:
    slam = km.Slam([km.Robot("r", Speed(), start=(0, 0, 1.0, 0.5), sensors={"l": km.Mount(km.sensors.RangeBearing())})])
    for t_s in (0.0, 1.0):
        slam.process(km.Control(t_s, "r", (0.1, 0.1)))
    slam.process(km.Scan(2.0, "r", "l", [[2.0, 0.3]], [1]))
    np.testing.assert_allclose(slam.mean("r")[2:], (1.2, 0.7))
    np.testing.assert_allclose(np.diag(slam.covariance("r"))[2:], (2 * 0.02 + 2 * 0.02**2, 2 * 0.1**2))
    moved = add_diffusion(Speed(), np.array([0, 0, 1.0, 0.5]), np.zeros(2), 1.0, np.random.default_rng(0))
    assert moved[3] == 0.5
