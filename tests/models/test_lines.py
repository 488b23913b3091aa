"""Lines of space: Jacobians against differences, views there and back, motions of the world, and where lines end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from differences import agree, derivative, frames
from kalmark.geometry import directions, frames3d, rotations
from kalmark.models import cameras, landmarks, lines

Array = np.ndarray[Any, np.dtype[np.float64]]

K = np.array([320.0, 330.0, 310.0, 245.0])
SIZE = np.array([640.0, 480.0])
LOOKING_ALONG_X = np.array([0, 0, 0, -0.5, 0.5, -0.5, 0.5])  # z of the camera is x of the world, its y is -z
PIECES = {  # of a state: what they are, and their sizes
    "pluecker": "nv",
    "anchored_pluecker": "anv",
    "inverse_depth_line": "asrsr",
    "anchored_homogeneous_line": "amrmr",
    "homogeneous_line": "hrhr",
}
SIZES = {"n": 3, "v": 3, "a": 3, "s": 2, "r": 1, "m": 3, "h": 3}
every_kind = pytest.mark.parametrize("name", PIECES)
through_points = pytest.mark.parametrize("name", [name for name in PIECES if "pluecker" not in name])


@dataclass(frozen=True)
class Kind:
    seen_from: Callable[..., Any]
    from_view: Callable[..., Any]
    endpoints: Callable[..., Any]
    abscissas: Callable[..., Any]


def kind(name: str) -> Kind:
    """Return what there is of a line, `from_view` with rays and prior apart."""
    line: Any = next(line() for line in landmarks.LINES if line.kind in (name, f"{name}_line"))
    return Kind(line.seen_from, line.of, line.endpoints, line.abscissas)


KINDS = {name: kind(name) for name in PIECES}


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(12)


def parts(name: str, l: Array) -> list[tuple[str, Array]]:
    """Return the pieces of one state."""
    out, at = [], 0
    for piece in PIECES[name]:
        out.append((piece, l[at : at + SIZES[piece]]))
        at += SIZES[piece]
    assert at == len(l)
    return out


def draws(name: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw poses (200, 7) and lines (200, n): ends at infinity, vertical directions, lines that almost meet T."""
    poses, columns = frames(rng), []
    for piece in PIECES[name]:
        columns.append(rng.normal(size=(200, SIZES[piece])))
        if piece == "r":
            columns[-1] = 10 ** rng.uniform(-3, 0, (200, 1))
            columns[-1][::5, 0] = rng.choice([0.0, 1e-9, -1e-3], 40)
        if piece == "s":
            columns[-1][:, 1] = rng.uniform(-1.5, 1.5, 200)
            columns[-1][3::10, 1] = np.pi / 2 - 10.0 ** -rng.integers(1, 5, 20)
    l = np.hstack(columns)
    if name == "pluecker":
        l[7::10, :3] = np.cross(poses[7::10, :3], l[7::10, 3:]) + rng.normal(size=(20, 3)) * 1e-6
    elif name == "anchored_pluecker":
        l[7::10, 3:6] = np.cross(poses[7::10, :3] - l[7::10, :3], l[7::10, 6:]) + rng.normal(size=(20, 3)) * 1e-6
    elif name != "homogeneous_line":
        l[7::10, :3] = poses[7::10, :3] + rng.normal(size=(20, 3)) * 1e-6
    return poses, l


def rays_of(rng: np.random.Generator, count: int = 200) -> Array:
    """Draw pairs of viewing rays: any length, close together, near the axis, and almost across the axis."""
    rays = rng.normal(size=(count, 6)) * 0.5 + [0, 0, 1, 0, 0, 1]
    rays[::5, 3:] = rays[::5, :3] + rng.normal(size=(count // 5, 3)) * 0.05
    rays[1::5, [0, 1, 3, 4]] *= 0.1
    rays[2::5, 2] = rays[2::5, 5] = rng.choice([0.1, -0.1, 0.02], count // 5)
    return rays * 10 ** rng.uniform(-1, 1, (count, 1))


def priors(name: str, rng: np.random.Generator, count: int = 200) -> Array:
    if "pluecker" in name:
        return np.array([0.1, 0]) + rng.normal(size=(count, 2)) * [0.25, 1]
    return rng.normal(size=(count, 2)) * rng.choice([0, 1e-6, 0.5], (count, 1))


def moved(name: str, world: Array, l: Array) -> Array:
    """Return one line after the world was turned and shifted by a frame."""
    Q, p = rotations.matrix(world[3:]), world[:3]
    out = []
    for piece, x in parts(name, l):
        if piece == "s":
            turned = directions.direction_many(x[None])[0] @ Q.T
            out.append(directions.spherical_many(turned)[0][0, 1:])
        elif piece == "r":
            out.append(x)
        else:
            out.append(Q @ x + (p if piece == "a" else 0.0))
    if name == "pluecker":
        out[0] += np.cross(p, out[1])
    elif name == "homogeneous_line":
        out[0], out[2] = out[0] + out[1] * p, out[2] + out[3] * p
    return np.concatenate(out)


def generator(name: str, l: Array) -> Array:
    """Return the rates (n, 6) of one line as the world is shifted and turned about its origin."""
    rows = []
    for piece, x in parts(name, l):
        turn, shift = np.zeros((len(x), 3)), np.zeros((len(x), 3))
        if piece in "anvmh":
            turn = -rotations.skew(x)
        if piece == "a":
            shift = np.eye(3)
        if piece == "s":
            m = directions.direction_many(x[None])[0]
            turn = directions.spherical_many(m)[1][0, 1:] @ -rotations.skew(m[0])
        rows.append(np.hstack([shift, turn]))
    if name == "pluecker":
        rows[0][:, :3] = -rotations.skew(l[3:])
    elif name == "homogeneous_line":
        rows[0][:, :3], rows[2][:, :3] = l[3] * np.eye(3), l[7] * np.eye(3)
    return np.vstack(rows)


def first(function: Any, *before: Any) -> Any:
    """Return the value, as numbers in a row, of a function that takes `before` and then rows."""
    return lambda x: function(*before, x[None])[0][0].ravel()


@every_kind
def test_seen_from_has_the_jacobians_of_its_differences(name: str, rng: np.random.Generator) -> None:
    seen_from = KINDS[name].seen_from
    for T, l in zip(*draws(name, rng), strict=True):
        _, V_T, V_l = seen_from(T, l[None])
        agree(V_T[0], derivative(lambda x: seen_from(x, l[None])[0][0], T, "frame"))
        agree(V_l[0], derivative(first(seen_from, T), l))


@every_kind
def test_from_view_has_the_jacobians_of_its_differences(name: str, rng: np.random.Generator) -> None:
    from_view = KINDS[name].from_view
    for T, rays, prior in zip(frames(rng), rays_of(rng), priors(name, rng), strict=True):
        made, L_T, L_rays, L_prior = from_view(T, rays[None], prior[None])
        flat, out = 1.0, "plain"
        if name == "inverse_depth_line":
            flat, out = float(np.cos(made[0, [4, 7]]).min()), "angles"
        agree(L_T[0], derivative(lambda x: from_view(x, rays[None], prior[None])[0][0], T, "frame", out, 0.02 * flat))
        a, b = rays[:3] / np.linalg.norm(rays[:3]), rays[3:] / np.linalg.norm(rays[3:])
        n = np.cross(a, b)  # as short as the rays are close together, and as flat as their plane is across the axis
        near = float(np.hypot(n[0], n[1])) if "pluecker" in name else 1.0
        step = 0.1 * flat * near * min(np.linalg.norm(rays[:3]), np.linalg.norm(rays[3:]))
        agree(L_rays[0], derivative(lambda x: from_view(T, x[None], prior[None])[0][0], rays, out=out, first=step))
        agree(L_prior[0], derivative(first(from_view, T, rays[None]), prior))


@every_kind
def test_what_a_view_made_is_seen_on_the_plane_of_its_rays(name: str, rng: np.random.Generator) -> None:
    kind = KINDS[name]
    for T in frames(rng, 40):
        rays, prior = rays_of(rng, 10), priors(name, rng, 10)
        v = kind.seen_from(T, kind.from_view(T, rays, prior)[0])[0]
        normal = np.cross(rays[:, :3], rays[:, 3:])
        unit = [each / np.linalg.norm(each, axis=1)[:, None] for each in (v, normal)]
        np.testing.assert_allclose(*unit, atol=1e-12)


@every_kind
def test_a_new_line_is_as_far_as_its_prior_says(name: str, rng: np.random.Generator) -> None:
    kind = KINDS[name]
    for T, rays, prior in zip(frames(rng), rays_of(rng), abs(priors(name, rng)) + 0.01, strict=True):
        l = kind.from_view(T, rays[None], prior[None])[0]
        p = kind.endpoints(l, np.array([[0.0, 1.0]]))[0][0] - T[:3]
        if "pluecker" in name:
            u = (p[1] - p[0]) / np.linalg.norm(p[1] - p[0])
            np.testing.assert_allclose(np.linalg.norm(p[0] - u * (u @ p[0])), 1 / np.linalg.norm(prior), rtol=1e-9)
        else:
            np.testing.assert_allclose(1 / np.linalg.norm(p, axis=1), prior, rtol=1e-9)


@every_kind
def test_the_normal_is_square_to_every_point_of_the_line(name: str, rng: np.random.Generator) -> None:
    kind = KINDS[name]
    for T, rays, prior in zip(frames(rng), rays_of(rng), abs(priors(name, rng)) + 0.01, strict=True):
        l = kind.from_view(T, rays[None], prior[None])[0]
        S = frames3d.plus(T, 0.3 * rng.normal(size=6))
        p = kind.endpoints(l, rng.normal(size=(1, 2)))[0][0]
        v, seen = kind.seen_from(S, l)[0][0], frames3d.to_frame(S, p)[0]
        assert abs(seen @ v).max() < 1e-10 * np.linalg.norm(v) * np.linalg.norm(seen)


@every_kind
def test_moving_camera_and_line_together_changes_nothing_that_is_seen(name: str, rng: np.random.Generator) -> None:
    kind = KINDS[name]
    poses, l = draws(name, rng)
    for T, one, world in zip(poses, l, frames(rng), strict=True):
        here, there = kind.seen_from(T, one[None])[0], frames3d.compose(world, T)[0]
        np.testing.assert_allclose(kind.seen_from(there, moved(name, world, one)[None])[0], here, atol=1e-11)


@every_kind
def test_the_rates_of_a_moving_world_sum_to_zero(name: str, rng: np.random.Generator) -> None:
    kind = KINDS[name]
    for T, l in zip(*draws(name, rng), strict=True):
        _, V_T, V_l = kind.seen_from(T, l[None])
        of_pose = np.eye(6)
        of_pose[:3, 3:] = -rotations.skew(T[:3])
        of_line = generator(name, l)
        np.testing.assert_allclose(V_T[0] @ of_pose + V_l[0] @ of_line, 0, atol=1e-13 * abs(of_line).max())


def normals(rng: np.random.Generator) -> Array:
    """Draw planes through the optical centre: some through the axis, some almost square to it, any length."""
    v = rng.normal(size=(200, 3))
    v[::5, 2] = rng.choice([0.0, 1e-9], 40)
    v[1::5, :2] *= 1e-2
    return v * 10 ** rng.uniform(-6, 3, (200, 1))


def test_the_image_line_passes_through_the_pixels_of_the_plane_and_has_its_jacobian(rng: np.random.Generator) -> None:
    v = normals(rng)
    h, H_v = lines.image_lines(v, K)
    np.testing.assert_allclose(np.hypot(h[:, 0], h[:, 1]), 1)
    for i in range(200):
        beta = rng.normal(size=(1, 2))
        p = lines.vectors_in_planes(v[i : i + 1] / np.linalg.norm(v[i]), beta)[0]
        pixel = cameras.project_pinhole(p, K, np.zeros(0))[0][0]
        assert abs(h[i] @ [*pixel, 1]) < 1e-9 * (1 + abs(pixel).max())
        step = 0.1 * float(np.hypot(*v[i, :2]))
        agree(H_v[i], derivative(lambda x: lines.image_lines(x[None], K)[0][0], v[i], first=step))


def test_the_innovation_has_the_jacobian_of_its_differences_and_vanishes_on_the_line(rng: np.random.Generator) -> None:
    v, y = normals(rng), rng.uniform(0, 640, (200, 4))
    e, z, E_v = lines.segment_innovation(v, y, K)
    np.testing.assert_allclose(lines.segment_innovation(v, e, K)[1], 0, atol=1e-9 * abs(z).max())
    np.testing.assert_allclose(np.hypot(*(y - e).reshape(-1, 2).T), abs(z).ravel(), rtol=1e-9)
    for i in range(200):
        step = 0.1 * float(np.hypot(*v[i, :2]))
        rates = derivative(lambda x: lines.segment_innovation(x[None], y[i : i + 1], K)[1][0], v[i], first=step)
        agree(E_v[i], -rates)


def test_the_true_normal_explains_the_innovation_to_first_order(rng: np.random.Generator) -> None:
    ends = np.array([0, 0, 1]) + rng.uniform(-0.5, 0.5, (50, 2, 3))
    y = np.hstack([cameras.project_pinhole(ends[:, i].copy(), K, np.zeros(0))[0] for i in (0, 1)])
    true = np.cross(ends[:, 0], ends[:, 1])
    dv = rng.normal(size=true.shape) * 1e-7
    _, z, E_v = lines.segment_innovation(true - dv, y, K)
    np.testing.assert_allclose(z, np.einsum("kij,kj->ki", E_v, dv), rtol=1e-3, atol=1e-7)


def test_the_noise_of_both_distances_is_that_of_the_pixels_across_the_segment() -> None:
    y = np.array([[0.0, 0, 10, 0], [0, 0, 0, 10], [0, 0, 10, 10]])
    R4 = np.diag([1.0, 4, 9, 16])
    expected = [np.diag([4, 16]), np.diag([1, 9]), np.diag([2.5, 12.5])]
    np.testing.assert_allclose(lines.segment_noise(y, R4), expected, atol=1e-14)
    np.testing.assert_allclose(lines.segment_noise(y, np.stack([R4] * 2 + [9 * R4]))[2], 9 * expected[2], atol=1e-13)
    both = R4 + 0.5
    turned = lines.segment_noise(y[1:2], both)[0]
    np.testing.assert_allclose(turned, both[np.ix_([0, 2], [0, 2])])


@every_kind
def test_endpoints_have_the_jacobian_of_their_differences(name: str, rng: np.random.Generator) -> None:
    for l in draws(name, rng)[1]:
        rhos = [float(x[0]) for piece, x in parts(name, l) if piece == "r"]
        size = float(np.linalg.norm(l[-3:])) if "pluecker" in name else 1.0
        if min(map(abs, rhos), default=1) < 1e-8:
            continue
        t = rng.normal(size=(1, 2)) * 3
        P_l = KINDS[name].endpoints(l[None], t)[1][0].reshape(6, -1)
        step = 0.02 * min([1.0, size, *(10 * abs(rho) for rho in rhos)])
        agree(P_l, derivative(lambda x: KINDS[name].endpoints(x[None], t)[0][0].ravel(), l, first=step))


@through_points
def test_one_end_at_infinity_leaves_the_other_where_it_is(name: str) -> None:
    T = np.array([1.0, 2, 3, 0, 0, 0, 1])
    l = KINDS[name].from_view(T, np.array([[1.0, 0, 0, 0, 0, 1]]), np.array([[0.5, 0.0]]))[0]
    p, P_l = KINDS[name].endpoints(l, np.array([[0.0, 1.0]]))
    np.testing.assert_allclose(p[0, 0], [3, 2, 3])
    assert np.isfinite(P_l[0, 0]).all() and not np.isfinite(p[0, 1]).all()


@every_kind
def test_rays_to_points_of_a_line_pass_it_at_their_abscissas(name: str, rng: np.random.Generator) -> None:
    kind = KINDS[name]
    for T, rays, prior in zip(frames(rng), rays_of(rng), abs(priors(name, rng)) + 0.05, strict=True):
        l, t = kind.from_view(T, rays[None], prior[None])[0], rng.normal(size=(1, 2))
        p = kind.endpoints(l, t)[0]
        S = frames3d.plus(T, 0.1 * rng.normal(size=6))
        seen = frames3d.to_frame(S, p[0])[0]
        np.testing.assert_allclose(kind.abscissas(S, l, seen.reshape(1, 6)), t, rtol=1e-5, atol=1e-6)
        assert np.isnan(kind.abscissas(S, l, -seen.reshape(1, 6))).all()
        u = p[0, 1] - p[0, 0]
        cos = abs((p[0] - S[:3]) @ u) / np.linalg.norm(p[0] - S[:3], axis=1) / np.linalg.norm(u)
        np.testing.assert_allclose(np.cos(lines.crossing_angles(S, p, seen.reshape(1, 6)))[0], cos, atol=1e-9)


def test_a_ray_beside_a_line_counts_at_the_nearest_point_and_one_along_it_nowhere() -> None:
    l = np.array([[0.0, -6, 0, 0, 0, 3]])  # parallel to z, through (2, 0, 0)
    T = np.array([0.0, 1, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(lines.pluecker_endpoints(l, np.array([[-1.0, 4]]))[0], [[[2, 0, -1], [2, 0, 4]]])
    t = KINDS["pluecker"].abscissas(T, l, np.array([[1.0, 0, 1, 0, 0, 5]]))
    np.testing.assert_allclose(t, [[2, np.nan]])


def test_segments_grow_unless_their_ends_are_uncertain_or_seen_along_the_line() -> None:
    old, seen = np.array([[0.0, 1]] * 4), np.array([[0.5, -1], [1.5, 0.5], [0.2, 0.8], [np.nan, 9]])
    grown = [[-1, 1], [0, 1.5], [0, 1], [0, 1]]
    np.testing.assert_allclose(lines.extend_segments(old, seen), grown)
    sigma_px = np.array([12.0, 8, 12, 12])
    np.testing.assert_allclose(lines.extend_segments(old, seen, sigma_px), [[-1, 0.5], [0, 1.5], [0.2, 0.8], [0, 1]])
    np.testing.assert_allclose(lines.extend_segments(old, seen, sigma_px, switch_px=20), grown)
    angles = np.radians([[50.0, 80], [50, 40], [90, 90], [90, 90]])
    np.testing.assert_allclose(lines.extend_segments(old, seen, angles=angles), [[-1, 1], [0, 1], [0, 1], [0, 1]])


def seen(p1: Any, p2: Any, least: float = 10.0, T: Array = LOOKING_ALONG_X) -> tuple[bool, Array]:
    points = np.array([p1, p2], dtype=float)
    visible, pixels = lines.visible_segment(T, points[:1], points[1:], K, SIZE, least)
    return bool(visible[0]), pixels[0]


def test_a_segment_in_the_image_is_seen_whole_and_a_larger_one_trimmed_to_the_borders() -> None:
    visible, pixels = seen([10, 1, 1], [10, -1, 0])
    assert visible
    np.testing.assert_allclose(pixels, [310 - 32, 245 - 33, 310 + 32, 245])
    visible, pixels = seen([10, 100, 0], [10, -100, 0])
    assert visible
    np.testing.assert_allclose(pixels, [0, 245, 640, 245])


def test_short_segments_and_segments_outside_the_image_or_behind_are_not_seen() -> None:
    assert not seen([10, 0.1, 0], [10, -0.1, 0])[0]
    assert seen([10, 0.1, 0], [10, -0.1, 0], least=6)[0]
    for p1, p2 in [
        ([-1, 1, 0], [-1, -1, 0]),
        ([10, 50, 0], [10, 60, 9]),
        ([1, 9, 0], [1, 0, 9]),
        ([np.inf] * 3, [1] * 3),
    ]:
        visible, pixels = seen(p1, p2, least=0)
        assert not visible and np.isnan(pixels).all()


def test_a_segment_that_runs_past_the_camera_is_seen_up_to_the_border_of_the_image(rng: np.random.Generator) -> None:
    visible, pixels = seen([10, 1, -1], [-1e3, 1, -1])  # beside the camera, off behind it
    assert visible
    np.testing.assert_allclose(pixels[:2], [310 - 32, 245 + 33])
    away = pixels[2:] - [310, 245]  # on the ray from the vanishing point, at the lower border
    np.testing.assert_allclose(away[0] / K[0], -away[1] / K[1])
    np.testing.assert_allclose(pixels[3], 480)
    for T in frames(rng):
        ends = rng.normal(size=(2, 3)) * 3
        visible, pixels = seen(*ends, least=0, T=T)
        inner = ends[0] + np.linspace(0, 1, 2001)[:, None] * (ends[1] - ends[0])
        v = frames3d.to_frame(T, inner)[0]
        e = cameras.project_pinhole(v, K, np.zeros(0))[0]
        inside = cameras.in_image(e, v, SIZE)
        assert visible >= inside.any()
        if inside.any():
            u = pixels.reshape(2, 2)
            low, high = e[inside].min(axis=0), e[inside].max(axis=0)
            assert (u.min(axis=0) <= low + 1e-9).all() and (u.max(axis=0) >= high - 1e-9).all()
            assert (u >= 0).all() and (u <= SIZE).all()


def test_a_line_through_the_optical_centre_is_seen_as_a_point() -> None:
    visible, pixels = seen([10, 0, 0], [-10, 0, 0])
    assert not visible
    np.testing.assert_allclose(pixels, [310, 245, 310, 245], atol=1e-9)
