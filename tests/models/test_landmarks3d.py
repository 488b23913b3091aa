"""Point landmarks of space: every Jacobian against differences, all types the same point, rotations of the world."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from differences import agree, derivative, frames, turned
from kalmark.geometry import frames3d, rotations
from kalmark.models import landmarks3d as lm

Array = np.ndarray[Any, np.dtype[np.float64]]

TYPES = {
    "inverse_depth": (lm.inverse_depth_seen_from, lm.inverse_depth_from_view, lm.inverse_depth_to_point),
    "anchored": (lm.anchored_seen_from, lm.anchored_from_view, lm.anchored_to_point),
    "homogeneous": (lm.homogeneous_seen_from, lm.homogeneous_from_view, lm.homogeneous_to_point),
}
every_type = pytest.mark.parametrize("name", TYPES)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(9)


def draws(name: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw poses (200, 7) and landmarks (200, n), some of them at infinity, some near a vertical direction."""
    size = {"inverse_depth": 6, "anchored": 7, "homogeneous": 4}[name]
    l = rng.normal(size=(200, size))
    l[:, -1] = 10 ** rng.uniform(-3, 0, 200)
    l[::5, -1] = rng.choice([0.0, 1e-9, -1e-3], 40)
    if name == "inverse_depth":
        l[3::10, 4] = np.pi / 2 - 10.0 ** -rng.integers(1, 5, 20)
    return frames(rng), l


def first(function: Any, *before: Any) -> Any:
    """Return the value, as one row, of a function that takes `before` and then rows."""
    return lambda x: function(*before, x[None])[0][0]


@every_type
def test_seen_from_has_the_jacobians_of_its_differences(name: str, rng: np.random.Generator) -> None:
    seen_from = TYPES[name][0]
    for T, l in zip(*draws(name, rng), strict=True):
        _, V_T, V_l = seen_from(T, l[None])
        agree(V_T[0], derivative(lambda x: seen_from(x, l[None])[0][0], T, "frame"))
        agree(V_l[0], derivative(first(seen_from, T), l))


@every_type
def test_from_view_has_the_jacobians_of_its_differences(name: str, rng: np.random.Generator) -> None:
    from_view = TYPES[name][1]
    poses, l = draws("homogeneous", rng)
    for T, ray, rho in zip(poses, l[:, :3] + [0, 0, 1], l[:, 3], strict=True):
        at = (ray[None], np.array([rho]))
        made, L_T, L_ray, L_rho = from_view(T, *at)
        flat = 1.0 if name != "inverse_depth" else np.cos(made[0, 4])
        step, out = 0.02 * flat * min(1.0, float(np.linalg.norm(ray))), "angles" if flat != 1.0 else "plain"
        agree(L_T[0], derivative(lambda x: from_view(x, *at)[0][0], T, "frame", out, first=step))
        agree(L_ray[0], derivative(lambda x: from_view(T, x[None], at[1])[0][0], ray, out=out, first=step))
        agree(L_rho[0], derivative(lambda x: from_view(T, at[0], x)[0][0], at[1]))


@every_type
def test_what_a_view_made_is_seen_on_its_ray_at_its_distance(name: str, rng: np.random.Generator) -> None:
    seen_from, from_view, to_point = TYPES[name]
    for T in frames(rng):
        ray, rho = rng.normal(size=(6, 3)), 10 ** rng.uniform(-2, 1, 6)
        l = from_view(T, ray, rho)[0]
        unit = ray / np.linalg.norm(ray, axis=1)[:, None]
        np.testing.assert_allclose(seen_from(T, l)[0], unit, atol=1e-12)
        p = frames3d.from_frame(T, unit / rho[:, None])[0]
        np.testing.assert_allclose(to_point(l)[0], p, atol=1e-9)


@every_type
def test_the_ray_is_rho_times_the_point_in_the_frame(name: str, rng: np.random.Generator) -> None:
    seen_from, _, to_point = TYPES[name]
    poses, l = draws(name, rng)
    near = abs(l[:, -1]) > 1e-2
    for T, one in zip(poses[near], l[near], strict=True):
        p = lm.point_seen_from(T, to_point(one[None])[0])[0]
        np.testing.assert_allclose(seen_from(T, one[None])[0], one[-1] * p, atol=1e-10)


@every_type
def test_conversion_to_a_point_has_the_jacobian_of_its_differences(name: str, rng: np.random.Generator) -> None:
    to_point = TYPES[name][2]
    for l in draws(name, rng)[1]:
        if abs(l[-1]) > 1e-8:
            agree(to_point(l[None])[1][0], derivative(first(to_point), l, first=0.02 * min(1.0, 10 * abs(l[-1]))))


def test_inverse_depth_and_anchored_points_turn_into_each_other(rng: np.random.Generator) -> None:
    h = draws("anchored", rng)[1]
    l, L_h = lm.anchored_to_inverse_depth(h)
    again, H_l = lm.inverse_depth_to_anchored(l)
    far = h[:, 6] == 0
    np.testing.assert_allclose(lm.anchored_to_point(again[~far])[0], lm.anchored_to_point(h[~far])[0], rtol=1e-9)
    np.testing.assert_allclose(np.cross(again[:, 3:6], h[:, 3:6]), 0, atol=1e-13)
    for i in range(len(h)):
        step = 0.1 * np.hypot(h[i, 3], h[i, 4])
        agree(L_h[i], derivative(first(lm.anchored_to_inverse_depth), h[i], out="angles", first=step))
        agree(H_l[i], derivative(first(lm.inverse_depth_to_anchored), l[i]))


@every_type
def test_turning_the_world_leaves_every_view_as_it_was(name: str, rng: np.random.Generator) -> None:
    seen_from, from_view, _ = TYPES[name]
    for T, phi in zip(frames(rng), rng.normal(size=(200, 3)), strict=True):
        world = np.concatenate([rng.normal(size=3), rotations.exp(phi)])
        ray, rho = rng.normal(size=(4, 3)), rng.normal(size=4)
        S = frames3d.plus(T, 0.3 * rng.normal(size=6))
        here = seen_from(S, from_view(T, ray, rho)[0])[0]
        there = [frames3d.compose(world, f)[0] for f in (S, T)]
        np.testing.assert_allclose(seen_from(there[0], from_view(there[1], ray, rho)[0])[0], here, atol=1e-12)
    np.testing.assert_allclose(turned(rotations.exp(phi), -phi)[3], 1)


def test_the_linearity_index_falls_with_parallax_and_with_the_sigma_of_rho() -> None:
    l = np.array([[0.0, 0, 0, 0, 0, 0.1]])  # 10 m ahead, along x
    ahead = np.array([0.0, 0, 0, 0, 0, 0, 1])
    beside = np.array([10.0, 10, 0, 0, 0, 0, 1])
    sigma = np.array([0.02])
    index = lm.inverse_depth_linearity(ahead, l, sigma)
    np.testing.assert_allclose(index, 4 * (0.02 / 0.01) / 10)
    np.testing.assert_allclose(lm.inverse_depth_linearity(ahead, l, sigma / 10), index / 10)
    assert lm.inverse_depth_linearity(beside, l, sigma)[0] < 1e-12
    long = lm.inverse_depth_to_anchored(l)[0] * np.array([1, 1, 1, 3, 3, 3, 3])  # the same point, written otherwise
    np.testing.assert_allclose(lm.anchored_linearity(ahead, long, 3 * sigma), index)
