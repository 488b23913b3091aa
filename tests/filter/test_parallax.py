"""Inverse distances corrected by their parallax: the compiled correction against the filter written out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.estimators import Update
from kalmark.filter.map import StochasticMap
from kalmark.geometry.rotations import exp, left_jacobian, matrix, multiply, skew
from kalmark.geometry.spaces import ANCHOR, DIRECTION, MOUNTS, RHO, ROTATION, SCALAR, SE3, TURNED, VECTOR3
from kalmark.models.observe import expectation, view_of

CAMERA = km.sensors.PinHole(sigma_px=2.0)
POINT = km.landmarks.AnchoredHomogeneous()
MOUNT = np.concatenate([[0.2, -0.1, 0.6], [-0.5, 0.5, -0.5, 0.5]])
OTHERS: list[
    tuple[Any, list[float]]
] = [  # not seen in this scan: an anchored point, an inverse depth, a line with two of them, a Euclidean point
    (POINT, [0.3, -0.2, 0.5, 0.9, 0.1, -0.2, 0.2]),
    (km.landmarks.InverseDepth3D(), [-0.1, 0.2, 0.4, 0.3, -0.2, 0.15]),
    (km.landmarks.AnchoredHomogeneousLine(), [0.1, 0, 0.6, 1, 0.3, 0, 0.2, 1, -0.3, 0.1, 0.3]),
    (km.landmarks.Point3D(), [4.0, 1.0, -0.5]),
]


class Written:
    """The invariant filter whose errors are xi and, for inverse distances, the parallax n d_rho + g.d_t; dense."""

    def __init__(self, map_: StochasticMap, mounted: bool) -> None:
        self.blocks, self.mounted = [], mounted
        x_at = p_at = 0
        for space in map_.spaces:
            assert space is not None
            self.blocks.append((space, x_at, p_at))
            x_at, p_at = x_at + space.size, p_at + space.dof
        self.x, P = map_.x[:x_at].copy(), map_.covariance(range(len(map_.spaces)))
        self.c2: list[float] = []
        self.c2 = [float(np.trace(D @ P @ D.T)) + 1e-12 for *_, D in self.depths(self.x)]
        self.B = self.to_errors(self.x) @ P @ self.to_errors(self.x).T

    def atoms(self) -> Any:
        for space, x_at, p_at in self.blocks:
            for kind, x, p in space.atoms:
                yield kind, x + x_at, p + p_at

    def depths(self, x: np.ndarray) -> Any:
        """Yield (place of rho in x and in P, t, the Jacobian D of t) of each inverse distance."""
        mount, R = x[7:14] if self.mounted else MOUNT, matrix(x[3:7])
        size = sum(space.dof for space, *_ in self.blocks)
        S = np.zeros((3, size))
        S[:, :6] = np.hstack([np.eye(3), -skew(R @ mount[:3])])
        if self.mounted:
            S[:, 6:9] = R
        for kind, at, p in self.atoms():
            if kind == ANCHOR:
                D, t = S.copy(), x[:3] + R @ mount[:3] - x[at : at + 3]
                D[:, p : p + 3] -= np.eye(3)
            elif kind == RHO:
                yield at, p, t, D

    def to_errors(self, x: np.ndarray) -> np.ndarray:
        size = sum(space.dof for space, *_ in self.blocks)
        B = np.eye(size)
        for space, x_at, p_at in self.blocks:
            if space.axes == 3:
                turn = space.generator(x[x_at : x_at + space.size])
                B[p_at : p_at + space.dof, 3:6] -= turn
                if self.mounted:  # the map turns with the sensor: d_theta_r + R_r d_theta_s
                    B[p_at : p_at + space.dof, 9:12] -= turn @ matrix(x[3:7])
        B[3:6] = np.eye(size)[3:6]
        if self.mounted:
            B[3:6, 9:12] = matrix(x[3:7])
        for (at, p, t, D), c2 in zip(self.depths(x), self.c2, strict=True):
            n = np.sqrt(t @ t + c2)
            B[p] = n * np.eye(size)[p] + x[at] / n * t @ D
        return B

    def moved(self, xi: np.ndarray) -> np.ndarray:
        x, whole = self.x.copy(), xi[3:6]
        E, V = matrix(exp(whole)), left_jacobian(whole)
        for kind, at, p in self.atoms():
            own = xi[p : p + 3]
            if kind in (VECTOR3, ANCHOR):
                x[at : at + 3] = E @ x[at : at + 3] + V @ own
            elif kind == SCALAR:
                x[at] += xi[p]
            elif kind == ROTATION:
                own = exp(-matrix(x[at : at + 4]) @ xi[9:12] if self.mounted else np.zeros(3))
                x[at : at + 4] = multiply(exp(whole), multiply(own, x[at : at + 4]))
            elif kind == TURNED:
                x[at : at + 4] = multiply(exp(own), x[at : at + 4])
            elif kind == DIRECTION:
                azimuth, elevation = x[at : at + 2]
                m = E @ [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
                x[at : at + 2] = np.arctan2(m[1], m[0]) + xi[p], np.arcsin(m[2]) + xi[p + 1]
        before = self.depths(self.x)
        for (at, p, t, _), (*_, t_now, _), c2 in zip(before, self.depths(x), self.c2, strict=True):
            x[at] = (np.sqrt(t @ t + c2) * self.x[at] + xi[p]) / np.sqrt(t_now @ t_now + c2)
        return x

    def correct(self, y: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        x, xi, head = self.x, np.zeros(len(self.B)), 12 if self.mounted else 6
        first = self.blocks[-1]  # the one that is seen is the last
        for _ in range(most):
            l = x[first[1] : first[1] + 7][None]
            e, E_r, E_s, E_l = expectation(x[:7], x[7:14] if self.mounted else MOUNT, CAMERA, POINT, l)
            H = np.zeros((2, len(self.B)))
            H[:, :head], H[:, first[2] :] = np.hstack([E_r[0], E_s[0]])[:, :head], E_l[0]
            H = H @ np.linalg.inv(self.to_errors(x))
            K = self.B @ H.T @ np.linalg.inv(H @ self.B @ H.T + 4 * np.eye(2))
            step = K @ (y[0] - e[0] + H @ xi)
            change = np.abs(np.linalg.solve(self.to_errors(self.x), step - xi)[:head]).max()
            xi, x = step, self.moved(step)
            if change < 1e-9:
                break
        P = self.B - K @ H @ self.B
        B = np.linalg.inv(self.to_errors(x))
        return x, B @ P @ B.T


def map_of(rng: np.random.Generator, mounted: bool) -> StochasticMap:
    map_ = StochasticMap()
    map_.add(SE3, np.concatenate([[0.8, -0.3, 0.2], exp(np.array([0.1, -0.2, 0.3]))]))
    if mounted:
        map_.add(MOUNTS[7], MOUNT)
    for kind, mean in OTHERS:
        map_.add(kind.space, np.array(mean, dtype=np.float64))
    map_.add(POINT.space, np.array([0.2, 0.1, 0.6, 0.95, 0.2, -0.1, 0.25]))
    A = 0.03 * rng.normal(size=(map_.n, map_.n))
    map_.P[: map_.n, : map_.n] = np.tril(A @ A.T)
    return map_


@pytest.mark.parametrize("mounted", [False, True], ids=["mounted fast", "mount in the map"])
def test_a_correction_equals_the_filter_written_out_in_parallaxes(mounted: bool) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        map_ = map_of(rng, mounted)
        written, slot = Written(map_, mounted), len(map_.spaces) - 1
        e = expectation(map_.mean(0), MOUNT, CAMERA, POINT, map_.mean(slot)[None])[0]
        y = e + rng.normal(size=(1, 2)) * 20
        x, P = written.correct(y, 30)
        scan = 0, 1 if mounted else -1, np.array([slot]), 7, y, 4 * np.eye(2)[None]
        done = km.estimators.Invariant(30, 1e-9).correct(map_, Update(view_of(CAMERA, POINT, MOUNT), *scan))
        assert done.fused.all()
        np.testing.assert_allclose(map_.x[: len(x)], x, atol=1e-6)
        np.testing.assert_allclose(map_.covariance(range(len(map_.spaces))), P, atol=1e-7)


def test_a_change_of_scale_moves_the_inverse_distance_along_its_hyperbola() -> None:
    map_ = StochasticMap()
    map_.add(SE3, np.array([2.0, 0, 0, 0, 0, 0, 1]))
    map_.add(POINT.space, np.array([0.0, 0, 0, 0, 1, 0, 0.2]))
    scale = np.zeros(13)
    scale[0], scale[12] = 2.0, -0.2  # the way and the distance are known up to a common factor
    map_.P[:13, :13] = np.tril(np.outer(scale, scale)) * 0.3**2 + 1e-9 * np.eye(13)
    antenna = np.array([0.0, 0, 0, 0, 0, 0, 1])
    scan = 0, -1, np.array([], dtype=np.int64), 0, np.array([[2.6, 0, 0]]), 1e-6 * np.eye(3)[None]
    km.estimators.Invariant(30, 1e-9).correct(map_, Update(view_of(km.sensors.Gps3D(), None, antenna), *scan))
    assert map_.x[0] == pytest.approx(2.6, abs=1e-3)
    assert map_.x[13] == pytest.approx(0.2 / 1.3, abs=2e-3), "a plain correction would make it 0.14"
