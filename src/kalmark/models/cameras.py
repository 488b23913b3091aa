"""Cameras: pixels of what lies at v = (x, y, z) in the optical frame (x right, y down, z forward), and rays back.

===============  =============================================================  ===============================
lens             from v to the pixel                                            `par`
===============  =============================================================  ===============================
RADIAL           x_d = x (1 + d1 r^2 + d2 r^4 + ...), x on the plane z = 1       fx fy cx cy, limit, n, d (n), c
RADTAN           the same with k1 k2 k3, and tangential p1 p2 (OpenCV)          fx fy cx cy, limit, 5, k1 k2 k3 p1 p2
EQUIDISTANT      theta_d = theta (1 + k1 theta^2 + k2 theta^4 + ...)            fx fy cx cy, limit, n, k (n)
TSAI             x = x_d (1 + c1 r_d^2 + c2 r_d^4 + ...)                        fx fy cx cy, limit, n, c (n), its limit
DAVISON          r_d = r / sqrt(1 + 2 k r^2)                                    fx fy cx cy, limit, 1, k
FOV              r_d = atan(2 r tan(w / 2)) / w                                 fx fy cx cy, limit, 1, w
OMNI             a polynomial of the angle above the image plane                cx cy c d e, n, a (n), b
===============  =============================================================  ===============================

Intrinsics are k = (fx, fy, cx, cy) in pixels.  `limit` is the radius on the plane z = 1 (EQUIDISTANT: the angle theta)
at which the distortion stops growing and the image would fold over.  Pixels and Jacobians are NaN where a lens shows
nothing: beyond the limit, and behind the camera (z <= 0; an EQUIDISTANT lens images that too, up to its limit, and OMNI
gives a pixel to every direction).  `lens_parameters` makes `par`.  The correction c of a radial distortion has its
form.  TSAI (1987) has a polynomial that takes the distortion off, limited in r_d; DAVISON (MonoSLAM, 2007) and FOV
(Devernay and Faugeras, 2001) have one number.  OMNI is Scaramuzza's (2006): the polynomial a gives the radius in the
image from the angle above the image plane, atan2(z, hypot(x, y)), b the height z of a ray (p, q, z) from that radius;
(cx, cy) and [[1, e], [d, c]] are the centre and the affine matrix of the pixels (u, v).  Nothing depends on the length
of v, so that v may be the ray to a landmark of unknown depth.  [TB] `pinHole`, `invPinHole`, `omniCam`, `invOmniCam`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.errors import ModelError
from kalmark.geometry.directions import unit_many
from kalmark.geometry.frames import multiply_many

RADIAL, RADTAN, EQUIDISTANT, OMNI, TSAI, DAVISON, FOV = range(7)
LENSES = {
    "radial": RADIAL, "radtan": RADTAN, "equidistant": EQUIDISTANT, "omnidirectional": OMNI, "tsai": TSAI,
    "davison": DAVISON, "fov": FOV,
}  # fmt: skip
HEAD = 6  # numbers before the coefficients
ROUNDING = 1e-15


def lens_parameters(lens: str, k: Any, forward: Any = (), backward: Any = None, size: Any = None) -> Array:
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
    elif lens == "equidistant":
        limit = min(valid_radius(d), math.pi)
    elif lens == "tsai":
        c = np.array([valid_radius(d)])
        limit = float(distortion_polynomial(c[0], d)[0]) if np.isfinite(c[0]) else math.inf
    else:
        limit = one_number_limit(lens, d)
    return np.concatenate([k, [limit, len(d)], d, c])


def one_number_limit(lens: str, d: Array) -> float:
    """Return the limit of a lens of one number d (1,): DAVISON and FOV.  Raises ModelError."""
    if len(d) != 1 or (lens == "fov" and not 0.0 < d[0] < math.pi):
        wanted = "k" if lens == "davison" else "w, an angle in rad above 0 and below pi"
        raise ModelError(f"distortion {d.tolist()}: {lens} expects one number, {wanted}")
    return 1.0 / math.sqrt(-2.0 * d[0]) if lens == "davison" and d[0] < 0.0 else math.inf


@compiled
def project(lens: int, v: Array, par: Array) -> tuple[Array, Array]:
    """Return the pixels e (K, 2) of v (K, 3), and E_v (K, 2, 3); NaN where the lens shows nothing."""
    d = par[HEAD : HEAD + int(par[5])]
    if lens == RADTAN:
        e, E_v = _project_radtan(v, par[:4], d)
    elif lens == RADIAL:
        e, E_v = project_pinhole(v, par[:4], d)
    else:
        return _project_round(lens, v, par)
    for i in range(len(v)):
        for a in range(0 if is_shown(lens, math.hypot(v[i, 0], v[i, 1]), v[i, 2], par) else 2):
            e[i, a] = E_v[i, a, 0] = E_v[i, a, 1] = E_v[i, a, 2] = np.nan
    return e, E_v


@compiled
def is_shown(lens: int, flat: float, z: float, par: Array) -> bool:
    """Return whether a lens shows what is `flat` off the axis and z ahead."""
    if lens == EQUIDISTANT:
        return math.atan2(flat, z) < par[4]
    return lens == OMNI or (z > 0.0 and flat < par[4] * z)


def back_project(lens: int, y: Array, par: Array) -> tuple[Array, Array]:
    """Return the viewing rays m (K, 3), unit vectors, of pixels y (K, 2), and M_y (K, 3, 2).

    RADIAL and OMNI are as good as their second polynomial; all others invert `project` to the last digit, NaN for
    pixels that the lens cannot reach.
    """
    return _back_project_radtan(y, par) if lens == RADTAN else _back_project_round(lens, y, par)


def is_in_view(lens: int, v: Array, par: Array, size: Array) -> Flags:
    """Return which of v (K, 3) the lens shows at a pixel of the image (width, height), borders included.

    OMNI: where the ray back through the pixel is v's, within 2.6 degrees; elsewhere the polynomial has no meaning.
    """
    e, _ = project(lens, v, par)
    seen: Flags = np.all((e >= 0.0) & (e <= size), axis=1)  # not where a lens shows nothing: those are NaN
    if lens == OMNI:
        m, _ = back_project(lens, e, par)
        seen &= np.sum(m * v, axis=1) > 0.999 * np.linalg.norm(v, axis=1)
    return seen


@compiled
def distortion_polynomial(r: float, d: Array) -> tuple[float, float]:
    """Return r_d = r (1 + d1 r^2 + d2 r^4 + ...) of d (n,), and its derivative."""
    scale, rate = 0.0, 0.0  # of the sum, in r^2
    for j in range(len(d) - 1, -1, -1):
        rate = rate * r * r + scale
        scale = scale * r * r + d[j]
    rate = rate * r * r + scale
    scale = 1.0 + scale * r * r
    return r * scale, scale + 2 * r * r * rate


@compiled
def invert_distortion(rd: float, d: Array, limit: float) -> float:
    """Return the r in [0, limit) with r_d(r, d) = rd >= 0, d (n,), by bracketed Newton; NaN if there is none."""
    low, high = 0.0, min(limit, 100.0 + 2 * rd)
    if distortion_polynomial(high, d)[0] <= rd:
        return np.nan
    r = min(rd, 0.5 * high)
    for _ in range(100):
        value, rate = distortion_polynomial(r, d)
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
    xd, XD_x = radial_many(x, d[:3])
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
    return _pixels(k, xd, XD_x, X_v)


@compiled
def _back_project_radtan(y: Array, par: Array) -> tuple[Array, Array]:
    v, V_y = np.ones((len(y), 3)), np.zeros((len(y), 3, 2))
    for i in range(len(y)):
        u0, u1 = (y[i, 0] - par[2]) / par[0], (y[i, 1] - par[3]) / par[1]
        v[i, :2] = undistort(u0, u1, par[HEAD : HEAD + 5], par[4])
        J = radtan_many(v[i : i + 1, :2], par[HEAD : HEAD + 5])[1][0]
        det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
        V_y[i, 0, 0], V_y[i, 0, 1] = J[1, 1] / (det * par[0]), -J[0, 1] / (det * par[1])
        V_y[i, 1, 0], V_y[i, 1, 1] = -J[1, 0] / (det * par[0]), J[0, 0] / (det * par[1])
    m, M_v = unit_many(v)
    return m, multiply_many(M_v, V_y)


@compiled
def undistort(u0: float, u1: float, d: Array, limit: float) -> Array:
    """Return the x (2,) that `radtan_many` carries to (u0, u1), NaN if there is none below the limit.

    Newton's method, from where the radial part alone comes from.
    """
    rd = math.hypot(u0, u1)
    r = invert_distortion(rd, d[:3], limit)
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


# ---------------------------------------------------------------------- lenses that are round: radius to radius
@compiled
def image_affine(lens: int, par: Array) -> tuple[float, float, float, float, float, float]:
    """Return the centre of the image in pixels, and the matrix A, row by row, from a place about it to pixels."""
    if lens == OMNI:
        return par[0], par[1], 1.0, par[4], par[3], par[2]
    return par[2], par[3], par[0], 0.0, 0.0, par[1]


@compiled
def image_radius(lens: int, flat: float, z: float, par: Array) -> tuple[float, float, float]:
    """Return the radius in the image of what is `flat` off the axis and z ahead, and its derivatives in both."""
    d = par[HEAD : HEAD + int(par[5])]
    if lens in (EQUIDISTANT, OMNI):
        if lens == OMNI:
            radius, rate = polynomial(d, math.atan2(z, flat))
        else:
            radius, rate = distortion_polynomial(math.atan2(flat, z), d)
        rate *= (-1.0 if lens == OMNI else 1.0) / (flat * flat + z * z)
        return radius, rate * z, -rate * flat
    radius, rate = distorted_radius(lens, flat / z, par)
    return radius, rate / z, -rate * flat / (z * z)


@compiled
def ray_at_radius(lens: int, radius: float, par: Array) -> tuple[float, float, float, float]:
    """Return how far off the axis and ahead the ray of a radius in the image goes, each with its derivative."""
    n = HEAD + int(par[5])
    if lens == OMNI:
        ahead, rate = polynomial(par[n:], radius)
        return radius, 1.0, ahead, rate
    if lens == EQUIDISTANT:
        angle = invert_distortion(radius, par[HEAD:n], par[4])
        rate = 1.0 / distortion_polynomial(angle, par[HEAD:n])[1]
        return math.sin(angle), rate * math.cos(angle), math.cos(angle), -rate * math.sin(angle)
    flat, rate = undistorted_radius(lens, radius, par)
    return flat, rate, 1.0, 0.0


@compiled
def scale_radius(x: float, y: float, radius: float, rate: float, S: Array) -> tuple[float, float, float]:
    """Return the direction of (x, y), (0, 0) at the centre, and the scale that brings it to a radius.

    S (2, 2) becomes the Jacobian of what is scaled, `rate` being the derivative of the radius.
    """
    r = math.hypot(x, y)
    p, q, scale = (x / r, y / r, radius / r) if r > 0.0 else (0.0, 0.0, rate)
    S[0, 0], S[1, 1] = scale + (rate - scale) * p * p, scale + (rate - scale) * q * q
    S[0, 1] = S[1, 0] = (rate - scale) * p * q
    return p, q, scale


@compiled
def _project_round(lens: int, v: Array, par: Array) -> tuple[Array, Array]:
    """Project by the radius; OMNI: what is next to the axis itself is at the centre."""
    e, E_v, S = np.empty((len(v), 2)), np.empty((len(v), 2, 3)), np.empty((2, 2))
    c_u, c_v, a, b, c, d = image_affine(lens, par)
    for i in range(len(v)):
        x, y, z = v[i]
        flat = math.hypot(x, y)
        if flat <= 1e-12 * abs(z):
            x = y = flat = 0.0
        shown = is_shown(lens, flat, z, par)
        radius, along, ahead = image_radius(lens, flat, z, par) if shown else (np.nan, np.nan, np.nan)
        p, q, scale = scale_radius(x, y, radius, along, S)
        e[i, 0], e[i, 1] = c_u + scale * (a * x + b * y), c_v + scale * (c * x + d * y)
        for j in range(2):
            E_v[i, 0, j], E_v[i, 1, j] = a * S[0, j] + b * S[1, j], c * S[0, j] + d * S[1, j]
        E_v[i, 0, 2], E_v[i, 1, 2] = ahead * (a * p + b * q), ahead * (c * p + d * q)
    return e, E_v


@compiled
def _back_project_round(lens: int, y: Array, par: Array) -> tuple[Array, Array]:
    v, V_y, S = np.empty((len(y), 3)), np.empty((len(y), 3, 2)), np.empty((2, 2))
    c_u, c_v, a, b, c, d = image_affine(lens, par)
    det = a * d - b * c
    for i in range(len(y)):
        du, dv = y[i, 0] - c_u, y[i, 1] - c_v
        x_d, y_d = (d * du - b * dv) / det, (a * dv - c * du) / det
        flat, rate, v[i, 2], ahead = ray_at_radius(lens, math.hypot(x_d, y_d), par)
        p, q, scale = scale_radius(x_d, y_d, flat, rate, S)
        v[i, 0], v[i, 1] = scale * x_d, scale * y_d
        for j in range(3):
            V_p, V_q = (S[j, 0], S[j, 1]) if j < 2 else (ahead * p, ahead * q)
            V_y[i, j, 0], V_y[i, j, 1] = (V_p * d - V_q * c) / det, (V_q * a - V_p * b) / det
    m, M_v = unit_many(v)
    return m, multiply_many(M_v, V_y)


@compiled
def distorted_radius(lens: int, r: float, par: Array) -> tuple[float, float]:
    """Return the r_d in the image of r >= 0 on the plane z = 1 by TSAI, DAVISON or FOV, and its derivative."""
    d = par[HEAD]
    if lens == DAVISON:
        root = math.sqrt(1.0 + 2.0 * d * r * r)
        return r / root, 1.0 / (root * root * root)
    if lens == FOV:
        t = 2.0 * math.tan(0.5 * d)
        return math.atan(t * r) / d, t / (d * (1.0 + t * t * r * r))
    n = HEAD + int(par[5])
    rd = invert_distortion(r, par[HEAD:n], par[n])
    return rd, 1.0 / distortion_polynomial(rd, par[HEAD:n])[1]


@compiled
def undistorted_radius(lens: int, rd: float, par: Array) -> tuple[float, float]:
    """Return the r on the plane z = 1 of r_d >= 0 in the image, and its derivative; or NaN.  RADIAL: the correction."""
    if lens == RADIAL:
        return distortion_polynomial(rd, par[HEAD + int(par[5]) :])
    d = par[HEAD]
    if lens == DAVISON:
        rest = 1.0 - 2.0 * d * rd * rd
        return (rd / math.sqrt(rest), rest**-1.5) if rest > 0.0 else (np.nan, np.nan)
    if lens == FOV:
        t, c = 2.0 * math.tan(0.5 * d), math.cos(rd * d)
        return (math.tan(rd * d) / t, d / (t * c * c)) if rd * d < 0.5 * math.pi else (np.nan, np.nan)
    n = HEAD + int(par[5])
    return distortion_polynomial(rd, par[HEAD:n]) if rd < par[n] else (np.nan, np.nan)


# ---------------------------------------------------------------------- pin holes
@compiled
def radial_many(x: Array, d: Array) -> tuple[Array, Array]:
    """Scale x (K, 2) by 1 + d1 r^2 + d2 r^4 + ...: xd (K, 2) and XD_x (K, 2, 2).  [TB] `distort`, `undistort`."""
    xd, XD_x = np.empty((len(x), 2)), np.empty((len(x), 2, 2))
    for i in range(len(x)):
        r2 = x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1]
        scale, rate, power = 1.0, 0.0, 1.0  # rate: d scale / d r^2
        for j in range(len(d)):
            rate += (j + 1) * d[j] * power
            power *= r2
            scale += d[j] * power
        for a in range(2):
            xd[i, a] = scale * x[i, a]
            for b in range(2):
                XD_x[i, a, b] = 2 * rate * x[i, a] * x[i, b] + (scale if a == b else 0.0)
    return xd, XD_x


@compiled
def plane_many(v: Array) -> tuple[Array, Array]:
    """Project v (K, 3) on the plane z = 1: x (K, 2) and X_v (K, 2, 3)."""
    k = len(v)
    x, X_v = np.empty((k, 2)), np.zeros((k, 2, 3))
    for i in range(k):
        for a in range(2):
            x[i, a] = v[i, a] / v[i, 2]
            X_v[i, a, a], X_v[i, a, 2] = 1.0 / v[i, 2], -x[i, a] / v[i, 2]
    return x, X_v


@compiled
def _pixels(k: Array, xd: Array, XD_x: Array, X_v: Array) -> tuple[Array, Array]:
    """Return the pixels e (K, 2) of distorted xd (K, 2) on the plane z = 1, and E_v (K, 2, 3)."""
    e, E_v = np.empty((len(xd), 2)), np.empty((len(xd), 2, 3))
    for i in range(len(xd)):
        for a in range(2):
            e[i, a] = k[2 + a] + k[a] * xd[i, a]
            for b in range(3):
                E_v[i, a, b] = k[a] * (XD_x[i, a, 0] * X_v[i, 0, b] + XD_x[i, a, 1] * X_v[i, 1, b])
    return e, E_v


@compiled
def project_pinhole(v: Array, k: Array, d: Array) -> tuple[Array, Array]:
    """Return the pixels e (K, 2) of v (K, 3), and E_v (K, 2, 3); meaningful where z > 0."""
    x, X_v = plane_many(v)
    xd, XD_x = radial_many(x, d)
    return _pixels(k, xd, XD_x, X_v)


def back_project_pinhole(y: Array, k: Array, c: Array) -> tuple[Array, Array]:
    """Return the viewing rays m (K, 3), unit vectors, of pixels y (K, 2), M_y (K, 3, 2); c: `fit_correction`."""
    return back_project(RADIAL, y, np.concatenate([k, [math.inf, 0.0], c]))


def valid_radius(d: Any) -> float:
    """Return the radius on the plane z = 1 up to which the distortion d grows; beyond it the image folds over."""
    d = np.asarray(d, dtype=np.float64)
    rates = np.concatenate([[1.0], (2 * np.arange(len(d)) + 3) * d])  # d r_d / d r, in powers of r^2
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(rates, "b"))
    turns = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return math.sqrt(turns.min()) if len(turns) else math.inf


def fit_correction(d: Any, k: Any, size: Any, tolerance_px: float = 0.005) -> Array:
    """Fit the shortest correction c (n,) of the distortion d (k,) within `tolerance_px` over an image (width, height).

    Least squares of pixels at Chebyshev nodes of r_d^2 from the centre to the farthest corner.  Raise ModelError where
    that is more than the distortion can reach, or if 20 coefficients do not suffice, as where the lens almost folds the
    image.
    """
    d, k, size = (np.asarray(a, dtype=np.float64) for a in (d, k, size))
    if not d.any():
        return np.zeros(0)
    reach = np.maximum(k[2:], size - k[2:]) / k[:2]
    rd = math.hypot(*reach) * np.sqrt(0.5 - 0.5 * np.cos(np.pi * np.arange(201) / 200))[1:]
    r = undistorted_radii(rd, d)
    n_d = np.arange(1, len(d) + 1)
    pixels = (1 + r[:, None] ** (2 * n_d) @ ((2 * n_d + 1) * d)) * k[:2].max()  # d pixel / d r
    for n in range(1, 21):
        powers = (rd[:, None] / rd[-1]) ** (2 * np.arange(1, n + 1))
        c = np.linalg.lstsq((pixels * rd)[:, None] * powers, pixels * (r - rd), rcond=None)[0]
        if np.abs(pixels * (rd + rd * (powers @ c) - r)).max() < tolerance_px:
            return c / rd[-1] ** (2 * np.arange(1, n + 1))
    raise ModelError(f"distortion {d.tolist()}: no correction of 20 coefficients within {tolerance_px} px")


def undistorted_radii(rd: Array, d: Array) -> Array:
    """Return the radii that the distortion d carries to rd (ascending), by bisection below the valid radius."""
    powers = np.arange(1, len(d) + 1)

    def distorted(r: Array) -> Array:
        return r * (1 + (r[:, None] ** (2 * powers)) @ d)

    top = min(valid_radius(d), 100 * rd[-1])
    low, high = np.zeros_like(rd), np.full_like(rd, top)
    if distorted(high[:1])[0] < rd[-1]:
        raise ModelError(
            f"distortion {d.tolist()}: reaches radius {distorted(high[:1])[0]:.4g}, image has {rd[-1]:.4g}"
        )
    for _ in range(100):
        middle = 0.5 * (low + high)
        below = distorted(middle) < rd
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return 0.5 * (low + high)


@compiled
def polynomial(a: Array, x: float) -> tuple[float, float]:
    """Return a0 + a1 x + a2 x^2 + ... of a (n,), and its derivative."""
    value, rate = 0.0, 0.0
    for j in range(len(a) - 1, -1, -1):
        rate = rate * x + value
        value = value * x + a[j]
    return value, rate


@compiled
def project_stereo(v: Array, k: Array, baseline_m: float) -> tuple[Array, Array]:
    """Return the pixels e (K, 4) = (u, v of the left, u, v of the right camera) of v (K, d), and E_v (K, 4, d).

    A rectified pair: v is in the left camera's frame, the right one is at (baseline, 0, 0) in it; v is a point, d = 3,
    or a ray with its inverse distance, d = 4.  A sensor without the right image's v takes the first three rows.
    """
    d = v.shape[1]
    e, E_v = np.empty((len(v), 4)), np.zeros((len(v), 4, d))
    for i in range(len(v)):
        z, right = v[i, 2], baseline_m * (v[i, 3] if d == 4 else 1.0)
        for a in range(4):
            b = a % 2
            x = v[i, b] - (right if a == 2 else 0.0)
            e[i, a] = k[2 + b] + k[b] * x / z
            E_v[i, a, b], E_v[i, a, 2] = k[b] / z, -k[b] * x / (z * z)
        if d == 4:
            E_v[i, 2, 3] = -k[0] * baseline_m / z
    return e, E_v


@compiled
def back_project_stereo(y: Array, k: Array, baseline_m: float) -> tuple[Array, Array]:
    """Return the unit ray and the inverse distance v (K, 4) seen at y (K, 4), and V_y (K, 4, 4): regular far away, too.

    The inverse distance is the disparity over fx baseline, over the length of (x, y, 1).
    """
    v, V_y = np.empty((len(y), 4)), np.zeros((len(y), 4, 4))
    ray, R_y = np.ones((len(y), 3)), np.zeros((3, 4))
    R_y[0, 0], R_y[1, 1], R_y[1, 3] = 1.0 / k[0], 0.5 / k[1], 0.5 / k[1]
    for i in range(len(y)):
        ray[i, 0] = (y[i, 0] - k[2]) / k[0]
        ray[i, 1] = (0.5 * (y[i, 1] + y[i, 3]) - k[3]) / k[1]
    m, M_ray = unit_many(ray)
    for i in range(len(y)):
        scale = m[i, 2] / (k[0] * baseline_m)  # m[2] is 1 / |(x, y, 1)|
        v[i, :3], v[i, 3] = m[i], (y[i, 0] - y[i, 2]) * scale
        V_y[i, :3] = M_ray[i] @ R_y
        V_y[i, 3] = V_y[i, 2] * (y[i, 0] - y[i, 2]) / (k[0] * baseline_m)
        V_y[i, 3, 0] += scale
        V_y[i, 3, 2] -= scale
    return v, V_y


def in_image(e: Array, v: Array, size: Any) -> Flags:
    """Return which pixels e (K, 2 or 4) lie in an image (width, height), borders included, with v (K, 3) in front."""
    inside = (e >= 0) & (e <= np.tile(np.asarray(size, dtype=np.float64), e.shape[1] // 2))
    return np.logical_and(inside.all(axis=1), v[:, 2] > 0)
