"""Line landmarks of space, and how they look from a pose T = (x, y, z, qx, qy, qz, qw).  [TB] 4.3; Sola et al. 2012.

=========================  =========================================  ==================================
kind                       state l                                    the line
=========================  =========================================  ==================================
pluecker                   n (3), v (3)                               n = p x v for each of its points p
anchored_pluecker          anchor (3), n (3), v (3)                   n = (p - anchor) x v
inverse_depth_line         anchor (3), (azimuth, elevation, rho) x 2  through two inverse-depth points
anchored_homogeneous_line  anchor (3), (m (3), rho) x 2               through two anchored points
homogeneous_line           (h (3), rho) x 2                           through two homogeneous points
=========================  =========================================  ==================================

A camera observes v of a line: the normal, in its frame, of the plane through the optical centre and the line.  The
length of v has no meaning; a line through the optical centre has v = 0, and no image.  `..._from_view` takes the
viewing rays (K, 6) of two points of the line, of any length, and a prior of what they lack: of each end the inverse
distance rho (K, 2), or of Pluecker lines beta (K, 2), the direction of the line in a basis of that plane, as long as
the line's inverse distance.  Of the lines through two points there is only what concerns both: `landmarks` has the
rest.  Intrinsics are k = (fx, fy, cx, cy) in pixels, without lens distortion.

A line has no ends; those of the segment seen so far are abscissas t (K, 2) on it, ascending, and kept beside the
filter.  On Pluecker lines t counts metres along v, from the point closest to the origin or, if anchored, to the anchor;
on lines through two points it goes from 0 at the first to 1 at the second.  Points at infinity have no coordinates: inf
or NaN.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.geometry.directions import unit_many
from kalmark.geometry.frames import multiply_many
from kalmark.geometry.frames3d import to_frame_many, turned_rates
from kalmark.geometry.rotations import matrix, skew
from kalmark.models.landmarks3d import anchored_seen_from, homogeneous_seen_from, inverse_depth_seen_from

PLUECKER_ABSCISSAS_M = (-8.0, 8.0)  # of a new line.  [TB]
POINT_ABSCISSAS = (0.0, 1.0)
NEAREST_M = 1e-3  # a camera observes nothing nearer

View = tuple[Array, Array, Array]
New = tuple[Array, Array, Array, Array]


@compiled
def cross_products(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Return the cross products n = a x b of K pairs of vectors (K, 3), N_a (K, 3, 3) and N_b (K, 3, 3)."""
    n, N_a, N_b = np.empty((len(a), 3)), np.empty((len(a), 3, 3)), np.empty((len(a), 3, 3))
    for i in range(len(a)):
        N_a[i], N_b[i] = -skew(b[i]), skew(a[i])
        for j in range(3):
            n[i, j] = N_b[i, j, 0] * b[i, 0] + N_b[i, j, 1] * b[i, 1] + N_b[i, j, 2] * b[i, 2]
    return n, N_a, N_b


@compiled
def anchored_pluecker_seen_from(T: Array, l: Array) -> View:
    """Return the normals v (K, 3) of anchored Pluecker lines l (K, 9), V_T (K, 3, 6) and V_l (K, 3, 9)."""
    Q = matrix(T[3:]).T.copy()
    k = len(l)
    v, V_T, V_l = np.empty((k, 3)), np.empty((k, 3, 6)), np.empty((k, 3, 9))
    for i in range(k):
        n, N_base, N_v = cross_products(l[i : i + 1, :3] - T[:3], l[i : i + 1, 6:])
        n[0] += l[i, 3:6]
        v[i] = Q @ n[0]
        V_l[i, :, :3], V_l[i, :, 3:6], V_l[i, :, 6:] = Q @ N_base[0], Q, Q @ N_v[0]
        V_T[i, :, :3], V_T[i, :, 3:] = -V_l[i, :, :3], turned_rates(Q, n[0])
    return v, V_T, V_l


@compiled
def pluecker_seen_from(T: Array, l: Array) -> View:
    """Return the normals v (K, 3) of Pluecker lines l (K, 6), V_T (K, 3, 6) and V_l (K, 3, 6): Q' (n - t x v)."""
    v, V_T, V_l = anchored_pluecker_seen_from(T, np.hstack((np.zeros((len(l), 3)), l)))
    return v, V_T, V_l[:, :, 3:].copy()


@compiled
def end_states(l: Array, shared: int) -> tuple[Array, Array]:
    """Return the states of both ends of lines l (K, n), whose first `shared` numbers, the anchor, are those of both."""
    own = (l.shape[1] - shared) // 2
    return l[:, : shared + own].copy(), np.hstack((l[:, :shared], l[:, shared + own :]))


@compiled
def line_jacobians(A: Array, B: Array, shared: int) -> Array:
    """Return the Jacobians (K, a, n) in the state of lines by those in both ends' states; inverse of `end_states`."""
    size = A.shape[2]
    J = np.zeros((len(A), A.shape[1], 2 * size - shared))
    J[:, :, :size] = A
    J[:, :, size:] = B[:, :, shared:]
    J[:, :, :shared] += B[:, :, :shared]
    return J


@compiled
def line_views(a: View, b: View, shared: int) -> View:
    """Return what is seen of lines through two points that are seen as a and b."""
    v, V_a, V_b = cross_products(a[0], b[0])
    return (
        v,
        multiply_many(V_a, a[1]) + multiply_many(V_b, b[1]),
        line_jacobians(multiply_many(V_a, a[2]), multiply_many(V_b, b[2]), shared),
    )


@compiled
def inverse_depth_line_seen_from(T: Array, l: Array) -> View:
    """Return the normals v (K, 3) of inverse-depth lines l (K, 9), V_T (K, 3, 6) and V_l (K, 3, 9)."""
    a, b = end_states(l, 3)
    return line_views(inverse_depth_seen_from(T, a), inverse_depth_seen_from(T, b), 3)


@compiled
def anchored_homogeneous_line_seen_from(T: Array, l: Array) -> View:
    """Return the normals v (K, 3) of anchored homogeneous lines l (K, 11), V_T (K, 3, 6) and V_l (K, 3, 11)."""
    a, b = end_states(l, 3)
    return line_views(anchored_seen_from(T, a), anchored_seen_from(T, b), 3)


@compiled
def homogeneous_line_seen_from(T: Array, l: Array) -> View:
    """Return the normals v (K, 3) of homogeneous lines l (K, 8), V_T (K, 3, 6) and V_l (K, 3, 8)."""
    a, b = end_states(l, 0)
    return line_views(homogeneous_seen_from(T, a), homogeneous_seen_from(T, b), 0)


@compiled
def vectors_in_planes(n: Array, beta: Array) -> tuple[Array, Array, Array]:
    """Return the vectors v = E(n) beta (K, 3) in the planes of unit normals n (K, 3), V_n (K, 3, 3), V_beta (K, 3, 2).

    E(n) has two unit columns: the first, (n_y, -n_x, 0), lies in the image plane too, the second is n x the first.
    For n along the optical axis, of lines seen 90 degrees off it, there is no first: all is NaN.
    """
    k = len(n)
    v, V_n, V_beta = np.empty((k, 3)), np.empty((k, 3, 3)), np.empty((k, 3, 2))
    for i in range(k):
        flat = math.sqrt(n[i, 0] * n[i, 0] + n[i, 1] * n[i, 1])
        a, b, z = n[i, 0] / flat, n[i, 1] / flat, n[i, 2]
        p, q = beta[i, 0], beta[i, 1]
        V_beta[i, 0], V_beta[i, 1], V_beta[i, 2] = (b, z * a), (-a, z * b), (0.0, -flat)
        v[i, 0], v[i, 1], v[i, 2] = b * p + z * a * q, -a * p + z * b * q, -flat * q
        turn_x, turn_y = (z * b * q - a * p) / flat, (-z * a * q - b * p) / flat  # as (a, b) turns by 1 / flat
        V_n[i, 0] = (b * turn_x, -a * turn_x, a * q)
        V_n[i, 1] = (b * turn_y, -a * turn_y, b * q)
        V_n[i, 2] = (-a * q, -b * q, 0.0)
    return v, V_n, V_beta


@compiled
def anchored_pluecker_from_view(T: Array, rays: Array, beta: Array) -> New:
    """Return anchored Pluecker lines l (K, 9) seen on `rays` (K, 6) of T, anchored at T, |n| = 1 and v = E(n) beta.

    With L_T (K, 9, 6), L_rays (K, 9, 6) and L_beta (K, 9, 2).  They are at the distance 1 / |beta|.  [TB]
    `retroProjPlkLin`.
    """
    Q = matrix(T[3:])
    normal, N_a, N_b = cross_products(rays[:, :3].copy(), rays[:, 3:].copy())
    n, N_normal = unit_many(normal)
    v, V_n, V_beta = vectors_in_planes(n, beta)
    k = len(rays)
    l, L_T, L_rays, L_beta = np.empty((k, 9)), np.zeros((k, 9, 6)), np.zeros((k, 9, 6)), np.zeros((k, 9, 2))
    for i in range(k):
        l[i, :3], l[i, 3:6], l[i, 6:] = T[:3], Q @ n[i], Q @ v[i]
        for j in range(3):
            L_T[i, j, j] = 1.0
        L_T[i, 3:6, 3:], L_T[i, 6:, 3:] = -skew(l[i, 3:6]), -skew(l[i, 6:])
        turned = Q @ N_normal[i]
        L_rays[i, 3:6, :3], L_rays[i, 3:6, 3:] = turned @ N_a[i], turned @ N_b[i]
        turned = Q @ V_n[i] @ N_normal[i]
        L_rays[i, 6:, :3], L_rays[i, 6:, 3:] = turned @ N_a[i], turned @ N_b[i]
        L_beta[i, 6:] = Q @ V_beta[i]
    return l, L_T, L_rays, L_beta


@compiled
def anchored_pluecker_to_pluecker(l: Array) -> tuple[Array, Array]:
    """Return the Pluecker lines h (K, 6) of anchored ones l (K, 9), and H_l (K, 6, 9).  [TB] `unanchorPlucker`."""
    h, H_l = np.empty((len(l), 6)), np.zeros((len(l), 6, 9))
    n, N_anchor, N_v = cross_products(l[:, :3].copy(), l[:, 6:].copy())
    for i in range(len(l)):
        h[i, :3], h[i, 3:] = l[i, 3:6] + n[i], l[i, 6:]
        H_l[i, :3, :3], H_l[i, :3, 6:] = N_anchor[i], N_v[i]
        for j in range(6):
            H_l[i, j, 3 + j] = 1.0
    return h, H_l


@compiled
def pluecker_from_view(T: Array, rays: Array, beta: Array) -> New:
    """Return Pluecker lines l (K, 6) seen on `rays` (K, 6) of T with v = E(n) beta, as `anchored_pluecker_from_view`.

    With L_T (K, 6, 6), L_rays (K, 6, 6) and L_beta (K, 6, 2).
    """
    h, H_T, H_rays, H_beta = anchored_pluecker_from_view(T, rays, beta)
    l, L_h = anchored_pluecker_to_pluecker(h)
    return l, multiply_many(L_h, H_T), multiply_many(L_h, H_rays), multiply_many(L_h, H_beta)


@compiled
def stacked_views(a: New, b: New, shared: int) -> New:
    """Return new lines through the new points a and b, which share their first numbers."""
    k, size = a[0].shape
    n = 2 * size - shared
    l, L_T, L_rays, L_rho = np.empty((k, n)), np.empty((k, n, 6)), np.zeros((k, n, 6)), np.zeros((k, n, 2))
    l[:, :size], l[:, size:] = a[0], b[0][:, shared:]
    L_T[:, :size], L_T[:, size:] = a[1], b[1][:, shared:]
    L_rays[:, :size, :3], L_rays[:, size:, 3:] = a[2], b[2][:, shared:]
    L_rho[:, :size, :1], L_rho[:, size:, 1:] = a[3], b[3][:, shared:]
    return l, L_T, L_rays, L_rho


@compiled
def image_lines(v: Array, k: Array) -> tuple[Array, Array]:
    """Return the image lines h (K, 3) of normals v (K, 3), and H_v (K, 3, 3).

    h (x, y, 1) is the signed distance in pixels of a pixel (x, y).  Lines at infinity, v along the optical axis, and
    lines through the optical centre have none: NaN.
    """
    h, H_v = np.empty((len(v), 3)), np.empty((len(v), 3, 3))
    for i in range(len(v)):
        a, b = v[i, 0] / k[0], v[i, 1] / k[1]
        length = math.sqrt(a * a + b * b)
        h[i, 0], h[i, 1], h[i, 2] = a / length, b / length, (v[i, 2] - k[2] * a - k[3] * b) / length
        for j in range(3):  # d h = d (a, b, c) / length - h (h_x d a + h_y d b) / length
            H_v[i, j, 0], H_v[i, j, 1], H_v[i, j, 2] = -h[i, j] * h[i, 0], -h[i, j] * h[i, 1], 0.0
        for j in range(2):
            H_v[i, j, j] += 1.0
            H_v[i, 2, j] -= k[2 + j]
        H_v[i, 2, 2] = 1.0
        for j in range(3):
            H_v[i, j, 0] /= length * k[0]
            H_v[i, j, 1] /= length * k[1]
            H_v[i, j, 2] /= length
    return h, H_v


@compiled
def segment_innovation(v: Array, y: Array, k: Array) -> tuple[Array, Array, Array]:
    """Compare measured endpoints y (K, 4) = (u1, v1, u2, v2) with the expected lines of normals v (K, 3).

    Returns e (K, 4), the feet of the measured endpoints on the expected lines; z (K, 2), minus their signed distances
    in pixels; and E_v (K, 2, 3), with z = E_v dv to first order if v + dv is the true normal.  [TB] `ortDst`.
    """
    h, H_v = image_lines(v, k)
    e, z, E_v = np.empty((len(v), 4)), np.empty((len(v), 2)), np.empty((len(v), 2, 3))
    for i in range(len(v)):
        for end in range(2):
            x, y_end = y[i, 2 * end], y[i, 2 * end + 1]
            z[i, end] = -(h[i, 0] * x + h[i, 1] * y_end + h[i, 2])
            e[i, 2 * end], e[i, 2 * end + 1] = x + z[i, end] * h[i, 0], y_end + z[i, end] * h[i, 1]
            for j in range(3):
                E_v[i, end, j] = x * H_v[i, 0, j] + y_end * H_v[i, 1, j] + H_v[i, 2, j]
    return e, z, E_v


@compiled
def segment_noise(y: Array, R4: Array) -> Array:
    """Return the noise R (K, 2, 2) of both endpoints' distances, from that of the pixels R4, (4, 4) or (K, 4, 4).

    Across the measured segments y (K, 4), which need some length, so that it does not depend on the estimate.
    """
    pixels = R4.copy().reshape((-1, 4, 4))
    R = np.empty((len(y), 2, 2))
    N = np.zeros((2, 4))
    for i in range(len(y)):
        a, b = y[i, 3] - y[i, 1], y[i, 0] - y[i, 2]
        length = math.sqrt(a * a + b * b)
        N[0, 0] = N[1, 2] = a / length
        N[0, 1] = N[1, 3] = b / length
        R[i] = N @ pixels[min(i, len(pixels) - 1)] @ N.T
    return R


# ---------------------------------------------------------------------- segments
@compiled
def anchored_pluecker_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points p (K, 2, 3) at abscissas t (K, 2) of anchored Pluecker lines l (K, 9), and P_l (K, 2, 3, 9)."""
    v = l[:, 6:].copy()
    foot, F_v, F_n = cross_products(v, l[:, 3:6].copy())
    u, U_v = unit_many(v)
    p, P_l = np.empty((len(l), 2, 3)), np.empty((len(l), 2, 3, 9))
    for i in range(len(l)):
        v2 = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]
        for end in range(2):
            for j in range(3):
                p[i, end, j] = l[i, j] + foot[i, j] / v2 + t[i, end] * u[i, j]
                for a in range(3):
                    P_l[i, end, j, a] = 1.0 if a == j else 0.0
                    P_l[i, end, j, 3 + a] = F_n[i, j, a] / v2
                    turn = F_v[i, j, a] / v2 + t[i, end] * U_v[i, j, a]
                    P_l[i, end, j, 6 + a] = turn - 2 * foot[i, j] * v[i, a] / (v2 * v2)
    return p, P_l


@compiled
def pluecker_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points p (K, 2, 3) at abscissas t (K, 2) of Pluecker lines l (K, 6), and P_l (K, 2, 3, 6)."""
    p, P_l = anchored_pluecker_endpoints(np.hstack((np.zeros((len(l), 3)), l)), t)
    return p, P_l[:, :, :, 3:].copy()


@compiled
def points_between(a: tuple[Array, Array], b: tuple[Array, Array], t: Array, shared: int) -> tuple[Array, Array]:
    """Return the points (1 - t) a + t b, t (K, 2), of lines through a, b (K, 3); an unused one may be at infinity."""
    nothing = np.zeros_like(a[1])
    A_l, B_l = line_jacobians(a[1], nothing, shared), line_jacobians(nothing, b[1], shared)
    p, P_l = np.zeros((len(t), 2, 3)), np.zeros((len(t), 2, 3, A_l.shape[2]))
    for i in range(len(t)):
        for end in range(2):
            if t[i, end] != 1.0:
                p[i, end] += (1.0 - t[i, end]) * a[0][i]
                P_l[i, end] += (1.0 - t[i, end]) * A_l[i]
            if t[i, end] != 0.0:
                p[i, end] += t[i, end] * b[0][i]
                P_l[i, end] += t[i, end] * B_l[i]
    return p, P_l


@compiled
def abscissas(T: Array, p: Array, rays: Array) -> Array:
    """Return where rays (K, 6) of T pass nearest the lines through p (K, 2, 3), from 0 at p[:, 0] to 1 at p[:, 1].

    NaN where that is behind T, or nowhere: rays along the line.
    """
    Q = matrix(T[3:])
    t = np.full((len(p), 2), np.nan)
    for i in range(len(p)):
        base, d = T[:3] - p[i, 0], p[i, 1] - p[i, 0]
        for end in range(2):
            r = Q @ rays[i, 3 * end : 3 * end + 3].copy()
            dd, dr, rr, db, rb = np.dot(d, d), np.dot(d, r), np.dot(r, r), np.dot(d, base), np.dot(r, base)
            det = dd * rr - dr * dr
            if det > 1e-14 * dd * rr and dr * db - dd * rb > 0:
                t[i, end] = (rr * db - dr * rb) / det
    return t


@compiled
def crossing_angles(T: Array, p: Array, rays: Array) -> Array:
    """Return the angles (K, 2), 0 to pi/2, between rays (K, 6) of T and the lines through p (K, 2, 3)."""
    Q = matrix(T[3:])
    angles = np.empty((len(p), 2))
    for i in range(len(p)):
        across = skew(p[i, 1] - p[i, 0]) @ Q
        for end in range(2):
            r = rays[i, 3 * end : 3 * end + 3].copy()
            c = across @ r
            angles[i, end] = math.atan2(math.sqrt(np.dot(c, c)), abs(np.dot(p[i, 1] - p[i, 0], Q @ r)))
    return angles


def extend_segments(
    t_old: Array,
    t_measured: Array,
    sigma_px: Array | None = None,
    angles: Array | None = None,
    switch_px: float = 10.0,
    least_angle: float = math.pi / 4,
) -> Array:
    """Return the abscissas (K, 2), ascending, of segments t_old (K, 2) after a measurement at t_measured (K, 2).

    Segments only grow.  Except, if the largest sigmas of their endpoints in the image sigma_px (K,) are given (Pluecker
    lines), those not below `switch_px` become what was measured; and, if the `angles` (K, 2) between rays and lines are
    given (lines through two points), those with one not above `least_angle` stay as they are.  Measured abscissas that
    are not finite leave their segment as it is.  [TB] `extPolicy`, `extSwitch`.
    """
    usable: Flags = np.isfinite(t_measured.sum(axis=1))
    if angles is not None:
        usable = usable & (angles.min(axis=1) > least_angle)
    keeps: Flags = np.ones(len(t_old), dtype=np.bool_) if sigma_px is None else sigma_px < switch_px
    both = np.where(keeps[:, None], t_old, t_measured)
    low, high = np.minimum(both, t_measured).min(axis=1), np.maximum(both, t_measured).max(axis=1)
    return np.where(usable[:, None], np.stack([low, high], axis=1), t_old)


@compiled
def clip_abscissas(a: Array, b: Array) -> tuple[float, float]:
    """Return the first and last s in [0, 1] with all a + s (b - a) >= 0, a, b (n,); none: first > last."""
    first, last = 0.0, 1.0
    for j in range(len(a)):
        if a[j] < 0 and b[j] < 0:
            return 1.0, 0.0
        if a[j] < 0:
            first = max(first, a[j] / (a[j] - b[j]))
        elif b[j] < 0:
            last = min(last, a[j] / (a[j] - b[j]))
    return first, last


@compiled
def from_borders(v: Array, k: Array, size: Array) -> Array:
    """Return depth times the distances (5,) in pixels from the borders of the image; the depth from the nearest."""
    x, y = k[0] * v[0] + k[2] * v[2], k[1] * v[1] + k[3] * v[2]
    return np.array([x, size[0] * v[2] - x, y, size[1] * v[2] - y, v[2] - NEAREST_M])


@compiled
def visible_segment(T: Array, p1: Array, p2: Array, k: Array, size: Array, min_length_px: float) -> tuple[Flags, Array]:
    """Return which segments from p1 to p2 (K, 3) a camera at T sees, and their pixels (K, 4) trimmed to the image.

    Seen are those with at least `min_length_px` in an image of size (2,) = (width, height), borders included, and in
    front of the camera: trimmed in space, so that an end behind it does no harm.  Outside the image or not finite: NaN.
    """
    visible, segment = np.zeros(len(p1), dtype=np.bool_), np.full((len(p1), 4), np.nan)
    a, b = to_frame_many(T, p1)[0], to_frame_many(T, p2)[0]
    for i in range(len(p1)):
        if not math.isfinite(a[i].sum() + b[i].sum()):
            continue
        first, last = clip_abscissas(from_borders(a[i], k, size), from_borders(b[i], k, size))
        if not first <= last:
            continue
        for end, s in ((0, first), (1, last)):
            v = a[i] + s * (b[i] - a[i])
            for j in range(2):
                segment[i, 2 * end + j] = min(max(k[2 + j] + k[j] * v[j] / v[2], 0.0), size[j])
        length = math.hypot(segment[i, 2] - segment[i, 0], segment[i, 3] - segment[i, 1])
        visible[i] = length >= min_length_px
    return visible, segment
