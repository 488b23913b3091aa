"""Cameras with a lens: pixels of what lies at v in the optical frame and rays back, one pair of functions for all.

===============  =============================================================  ===============================
lens             from v to the pixel                                            `par`
===============  =============================================================  ===============================
RADIAL           x_d = x (1 + d1 r^2 + d2 r^4 + ...), x on the plane z = 1       fx fy cx cy, limit, n, d (n), c
RADTAN           the same with k1 k2 k3, and tangential p1 p2 (OpenCV)          fx fy cx cy, limit, 5, k1 k2 k3 p1 p2
EQUIDISTANT      theta_d = theta (1 + k1 theta^2 + k2 theta^4 + ...)            fx fy cx cy, limit, n, k (n)
OMNI             `project_omni`, `back_project_omni`                            cx cy c d e, n, a (n), b
===============  =============================================================  ===============================

`limit` is the radius on the plane z = 1 (EQUIDISTANT: the angle theta) at which the distortion stops growing and the
image would fold over.  Pixels and Jacobians are NaN where a lens shows nothing: beyond the limit, and behind the camera
(z <= 0; an EQUIDISTANT lens sees there too, up to its limit, and OMNI gives a pixel to every direction).  `parameters`
makes `par`.  Nothing depends on the length of v.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.errors import ModelError
from kalmark.geometry.directions import unit_many
from kalmark.models.cameras import (
    back_project_omni,
    back_project_pinhole,
    fit_correction,
    plane_many,
    project_omni,
    project_pinhole,
    radial_many,
    valid_radius,
)

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

RADIAL, RADTAN, EQUIDISTANT, OMNI = 0, 1, 2, 3
LENSES = {"radial": RADIAL, "radtan": RADTAN, "equidistant": EQUIDISTANT, "omnidirectional": OMNI}
HEAD = 6  # numbers before the coefficients
ROUNDING = 1e-15


def parameters(lens: str, k: Any, forward: Any = (), backward: Any = None, size: Any = None) -> Array:
    """Return `par` of a lens of `LENSES`.

    k: (fx, fy, cx, cy) or, omnidirectional, (cx, cy, c, d, e).  forward: the distortion (radtan: OpenCV's k1 k2 p1
    p2 and perhaps k3) or, omnidirectional, the polynomial from angle to radius.  backward: omnidirectional, that from
    the radius to the height; radial, the correction (None: fitted over the image of `size`).  Raises ModelError.
    """
    if lens not in LENSES:
        raise ModelError(f"lens {lens!r}: expected one of {', '.join(LENSES)}")
    k, d = np.asarray(k, dtype=np.float64), np.asarray(forward, dtype=np.float64)
    if lens == "omnidirectional":
        return np.concatenate([k, [len(d)], d, np.asarray(backward, dtype=np.float64)])
    c = np.zeros(0)
    if lens == "radial":
        c = fit_correction(d, k, size) if backward is None else np.asarray(backward, dtype=np.float64)
        limit = valid_radius(d)
    elif lens == "radtan":
        if len(d) not in (0, 4, 5):
            raise ModelError(f"distortion {d.tolist()}: radtan expects k1, k2, p1, p2 and perhaps k3")
        d = np.pad(d, (0, 5 - len(d)))[[0, 1, 4, 2, 3]]
        limit = valid_radius(d[:3])
    else:
        limit = min(valid_radius(d), math.pi)
    return np.concatenate([k, [limit, len(d)], d, c])


@compiled
def project(lens: int, v: Array, par: Array) -> tuple[Array, Array]:
    """Return the pixels e (K, 2) of v (K, 3), and E_v (K, 2, 3); NaN where the lens shows nothing."""
    d = par[HEAD : HEAD + int(par[5])]
    if lens == OMNI:
        return project_omni(v, par[:5], d)
    if lens == EQUIDISTANT:
        e, E_v = _project_equidistant(v, par[:4], d)
    elif lens == RADTAN:
        e, E_v = _project_radtan(v, par[:4], d)
    else:
        e, E_v = project_pinhole(v, par[:4], d)
    for i in range(len(v)):
        flat = math.hypot(v[i, 0], v[i, 1])
        angle = math.atan2(flat, v[i, 2])
        shown = angle < par[4] if lens == EQUIDISTANT else v[i, 2] > 0.0 and flat < par[4] * v[i, 2]
        if not shown:
            e[i], E_v[i] = np.nan, np.nan
    return e, E_v


@compiled
def back_project(lens: int, y: Array, par: Array) -> tuple[Array, Array]:
    """Return the viewing rays m (K, 3), unit vectors, of pixels y (K, 2), and M_y (K, 3, 2).

    RADTAN and EQUIDISTANT invert `project` to the last digit, NaN for pixels that the lens cannot reach.  RADIAL and
    OMNI are as good as their second polynomial.
    """
    n = HEAD + int(par[5])
    if lens == OMNI:
        return back_project_omni(y, par[:5], par[n:])
    if lens == EQUIDISTANT:
        return _back_project_equidistant(y, par)
    if lens == RADTAN:
        return _back_project_radtan(y, par)
    return back_project_pinhole(y, par[:4], par[n:])


@compiled
def in_view(lens: int, v: Array, par: Array, size: Array) -> Bools:
    """Return which of v (K, 3) the lens shows at a pixel of the image (width, height), borders included.

    OMNI: where the ray back through the pixel is v's, within 2.6 degrees; elsewhere the polynomial has no meaning.
    """
    e, _ = project(lens, v, par)
    seen = np.empty(len(v), dtype=np.bool_)
    for i in range(len(v)):
        seen[i] = 0.0 <= e[i, 0] <= size[0] and 0.0 <= e[i, 1] <= size[1]
    if lens == OMNI:
        m, _ = back_project(lens, e, par)
        for i in range(len(v)):
            length = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
            along = m[i, 0] * v[i, 0] + m[i, 1] * v[i, 1] + m[i, 2] * v[i, 2]
            seen[i] = seen[i] and along > 0.999 * length
    return seen


@compiled
def grown(r: float, d: Array) -> tuple[float, float]:
    """Return r_d = r (1 + d1 r^2 + d2 r^4 + ...) of d (n,), and its derivative."""
    scale, rate = 0.0, 0.0  # of the sum, in r^2
    for j in range(len(d) - 1, -1, -1):
        rate = rate * r * r + scale
        scale = scale * r * r + d[j]
    rate = rate * r * r + scale
    scale = 1.0 + scale * r * r
    return r * scale, scale + 2 * r * r * rate


@compiled
def shrunk(rd: float, d: Array, limit: float) -> float:
    """Return the r in [0, limit) with `grown(r, d)` = rd >= 0, d (n,), by bracketed Newton; NaN if there is none."""
    low, high = 0.0, min(limit, 100.0 + 2 * rd)
    if grown(high, d)[0] <= rd:
        return np.nan
    r = min(rd, 0.5 * high)
    for _ in range(100):
        value, rate = grown(r, d)
        if value > rd:
            high = r
        else:
            low = r
        new = r - (value - rd) / rate
        if not low <= new <= high:
            new = 0.5 * (low + high)
        if abs(new - r) <= ROUNDING * r:
            return new
        r = new
    return r


@compiled
def radtan_many(x: Array, d: Array) -> tuple[Array, Array]:
    """Distort x (K, 2) on the plane z = 1 by d = (k1, k2, k3, p1, p2): xd (K, 2) and XD_x (K, 2, 2).  OpenCV."""
    xd, XD_x, _ = radial_many(x, d[:3])
    p1, p2 = d[3], d[4]
    for i in range(len(x)):
        a, b = x[i, 0], x[i, 1]
        xd[i, 0] += 2 * p1 * a * b + p2 * (3 * a * a + b * b)
        xd[i, 1] += p1 * (a * a + 3 * b * b) + 2 * p2 * a * b
        XD_x[i, 0, 0] += 2 * p1 * b + 6 * p2 * a
        XD_x[i, 0, 1] += 2 * p1 * a + 2 * p2 * b
        XD_x[i, 1, 0] += 2 * p1 * a + 2 * p2 * b
        XD_x[i, 1, 1] += 6 * p1 * b + 2 * p2 * a
    return xd, XD_x


@compiled
def _project_radtan(v: Array, k: Array, d: Array) -> tuple[Array, Array]:
    x, X_v = plane_many(v)
    xd, XD_x = radtan_many(x, d)
    e, E_v = np.empty((len(v), 2)), np.empty((len(v), 2, 3))
    for i in range(len(v)):
        for a in range(2):
            e[i, a] = k[2 + a] + k[a] * xd[i, a]
            for b in range(3):
                E_v[i, a, b] = k[a] * (XD_x[i, a, 0] * X_v[i, 0, b] + XD_x[i, a, 1] * X_v[i, 1, b])
    return e, E_v


@compiled
def _back_project_radtan(y: Array, par: Array) -> tuple[Array, Array]:
    v, X_y = np.ones((len(y), 3)), np.empty((len(y), 2, 2))
    for i in range(len(y)):
        u0, u1 = (y[i, 0] - par[2]) / par[0], (y[i, 1] - par[3]) / par[1]
        v[i, :2] = undistorted(u0, u1, par[HEAD : HEAD + 5], par[4])
        J = radtan_many(v[i : i + 1, :2], par[HEAD : HEAD + 5])[1][0]
        det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
        X_y[i, 0, 0], X_y[i, 0, 1] = J[1, 1] / (det * par[0]), -J[0, 1] / (det * par[1])
        X_y[i, 1, 0], X_y[i, 1, 1] = -J[1, 0] / (det * par[0]), J[0, 0] / (det * par[1])
    m, M_v = unit_many(v)
    M_y = np.empty((len(y), 3, 2))
    for i in range(len(y)):
        for a in range(3):
            for b in range(2):
                M_y[i, a, b] = M_v[i, a, 0] * X_y[i, 0, b] + M_v[i, a, 1] * X_y[i, 1, b]
    return m, M_y


@compiled
def undistorted(u0: float, u1: float, d: Array, limit: float) -> Array:
    """Return the x (2,) that `radtan_many` carries to (u0, u1), NaN if there is none below the limit.

    Newton's method, from where the radial part alone comes from.
    """
    rd = math.hypot(u0, u1)
    r = shrunk(rd, d[:3], limit)
    scale = 1.0 if rd == 0.0 else (limit if math.isnan(r) else r) / rd
    x, size = np.array([[scale * u0, scale * u1]]), np.inf
    for _ in range(50):
        xd, J = radtan_many(x, d)
        r0, r1 = u0 - xd[0, 0], u1 - xd[0, 1]
        det = J[0, 0, 0] * J[0, 1, 1] - J[0, 0, 1] * J[0, 1, 0]
        s0, s1 = (J[0, 1, 1] * r0 - J[0, 0, 1] * r1) / det, (J[0, 0, 0] * r1 - J[0, 1, 0] * r0) / det
        x[0, 0] += s0
        x[0, 1] += s1
        before, size = size, math.hypot(s0, s1)
        if size == 0.0 or (size < 1e-12 and size >= 0.5 * before):
            break
    if not (size < 1e-12 and math.hypot(x[0, 0], x[0, 1]) < limit):
        x[:] = np.nan
    return x[0]


@compiled
def _project_equidistant(v: Array, k: Array, d: Array) -> tuple[Array, Array]:
    """Project by the angle from the axis: regular on the axis ahead, and at right angles to it."""
    e, E_v = np.empty((len(v), 2)), np.empty((len(v), 2, 3))
    for i in range(len(v)):
        x, y, z = v[i, 0], v[i, 1], v[i, 2]
        flat = math.hypot(x, y)
        r2 = flat * flat + z * z
        radius, rate = grown(math.atan2(flat, z), d)
        cos, sin, scale = (x / flat, y / flat, radius / flat) if flat > 0.0 else (1.0, 0.0, 1.0 / z)
        along, ahead = rate * z / r2, -rate * flat / r2  # d radius / d flat, / d z
        e[i, 0], e[i, 1] = k[2] + k[0] * radius * cos, k[3] + k[1] * radius * sin
        E_v[i, 0, 0] = k[0] * (along * cos * cos + scale * sin * sin)
        E_v[i, 1, 1] = k[1] * (along * sin * sin + scale * cos * cos)
        E_v[i, 0, 1], E_v[i, 1, 0] = k[0] * (along - scale) * cos * sin, k[1] * (along - scale) * cos * sin
        E_v[i, 0, 2], E_v[i, 1, 2] = k[0] * ahead * cos, k[1] * ahead * sin
    return e, E_v


@compiled
def _back_project_equidistant(y: Array, par: Array) -> tuple[Array, Array]:
    d = par[HEAD : HEAD + int(par[5])]
    m, M_y = np.empty((len(y), 3)), np.empty((len(y), 3, 2))
    for i in range(len(y)):
        p, q = (y[i, 0] - par[2]) / par[0], (y[i, 1] - par[3]) / par[1]
        radius = math.hypot(p, q)
        theta = shrunk(radius, d, par[4])
        c, s = math.cos(theta), math.sin(theta)
        cos, sin, scale = (p / radius, q / radius, s / radius) if radius > 0.0 else (1.0, 0.0, 1.0)
        rate = 1.0 / grown(theta, d)[1]
        m[i, 0], m[i, 1], m[i, 2] = s * cos, s * sin, c
        M_y[i, 0, 0] = (rate * c * cos * cos + scale * sin * sin) / par[0]
        M_y[i, 1, 1] = (rate * c * sin * sin + scale * cos * cos) / par[1]
        M_y[i, 0, 1], M_y[i, 1, 0] = (rate * c - scale) * cos * sin / par[1], (rate * c - scale) * cos * sin / par[0]
        M_y[i, 2, 0], M_y[i, 2, 1] = -rate * s * cos / par[0], -rate * s * sin / par[1]
    return m, M_y
