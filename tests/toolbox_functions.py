"""Each of the toolbox's functions beside kalmark's: pairs of outputs in kalmark's error coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from kalmark import geometry
from kalmark.geometry import directions, frames3d, rotations
from kalmark.models import cameras
from kalmark.models import landmarks3d as lm
from kalmark.simulate.layouts import Cloister, House, ThickCloister
from toolbox import (
    TURNED,
    Array,
    Case,
    Pair,
    frame,
    frame_error,
    frame_pairs,
    frame_tangent,
    k_of,
    one,
    quaternion_pairs,
    tangent,
    unstacked,
    xyzw,
)


def from_frame(i: Case, o: Case) -> list[Pair]:
    v, V_f, V_p = frames3d.from_frame(frame(i["F"]), i["p"])
    return [(v, o["pw"]), (V_f, o["PW_f"] @ frame_tangent(i["F"])), (V_p, o["PW_p"])]


def to_frame(i: Case, o: Case) -> list[Pair]:
    v, V_f, V_p = frames3d.to_frame(frame(i["F"]), i["p"])
    return [(v, o["pf"]), (V_f, o["PF_f"] @ frame_tangent(i["F"])), (V_p, o["PF_p"])]


def compose(i: Case, o: Case) -> list[Pair]:
    h, H_f, H_g = frames3d.compose(frame(i["F"]), frame(i["G"]))
    back = frame_error(o["H"])
    theirs = (back @ o["H_f"] @ frame_tangent(i["F"]), back @ o["H_g"] @ frame_tangent(i["G"]))
    return [*frame_pairs(h, o["H"]), (H_f, theirs[0]), (H_g, theirs[1])]


def invert(i: Case, o: Case) -> list[Pair]:
    b, B_f = frames3d.inverse(frame(i["F"]))
    return [*frame_pairs(b, o["I"]), (B_f, frame_error(o["I"]) @ o["I_f"] @ frame_tangent(i["F"]))]


def odometry(i: Case, o: Case) -> list[Pair]:
    b, B_f, B_u = frames3d.move(frame(i["F"]), i["u"])
    back = frame_error(o["F1"])
    return [*frame_pairs(b, o["F1"]), (B_f, back @ o["F_r"] @ frame_tangent(i["F"])), (B_u, back @ o["F_u"])]


def constant_velocity(i: Case, o: Case) -> list[Pair]:
    x, dt = i["x"], float(i["dt"][0])
    moved, _, _ = frames3d.move(frame(x[:7]), np.concatenate([np.zeros(3), x[10:] * dt]))
    moved[:3] += x[7:10] * dt
    return [*frame_pairs(moved, o["x1"][:7]), (x[7:] + i["u"], o["x1"][7:])]


def q_to_matrix(i: Case, o: Case) -> list[Pair]:
    return [
        (rotations.matrix(xyzw(i["q"])), o["R"]),
        (np.eye(3), unstacked(o["R_q"] @ tangent(i["q"]), o["R"])),
    ]


def matrix_to_q(i: Case, o: Case) -> list[Pair]:
    return [quaternion_pairs(rotations.from_matrix(i["R"]), o["q"])]


def vector_to_q(i: Case, o: Case) -> list[Pair]:
    theirs = 4 * tangent(o["q"]).T @ o["Q_v"]
    return [quaternion_pairs(rotations.exp(i["v"]), o["q"]), (rotations.left_jacobian(i["v"]), theirs)]


def q_to_vector(i: Case, o: Case) -> list[Pair]:
    v = rotations.log(xyzw(i["q"]))
    theirs = o["v"]
    if (length := np.linalg.norm(theirs)) > np.pi:  # the toolbox gives the longer way round where w < 0
        return [(v, theirs * (1 - 2 * np.pi / length))]
    return [(v, theirs), (rotations.left_jacobian_inverse(v), o["V_q"] @ tangent(i["q"]))]


def product(i: Case, o: Case) -> list[Pair]:
    q, back = rotations.multiply(xyzw(i["q1"]), xyzw(i["q2"])), 4 * tangent(o["q"]).T
    theirs = (back @ o["Q_q1"] @ tangent(i["q1"]), back @ o["Q_q2"] @ tangent(i["q2"]))
    return [quaternion_pairs(q, o["q"]), (np.eye(3), theirs[0]), (rotations.matrix(xyzw(i["q1"])), theirs[1])]


def euler_to_q(i: Case, o: Case) -> list[Pair]:
    q, Q_e = rotations.from_euler(i["e"])
    return [quaternion_pairs(q, o["q"]), (Q_e, 4 * tangent(o["q"]).T @ o["Q_e"])]


def q_to_euler(i: Case, o: Case) -> list[Pair]:
    e, E_q = rotations.to_euler(xyzw(i["q"]))
    return [(e, o["e"]), (E_q, o["E_q"] @ tangent(i["q"]))]


def euler_to_matrix(i: Case, o: Case) -> list[Pair]:
    q, Q_e = rotations.from_euler(i["e"])
    return [(rotations.matrix(q), o["R"]), (Q_e, unstacked(o["R_e"], o["R"]))]


def euler_pose(i: Case, o: Case) -> list[Pair]:
    f, F_e = frames3d.from_euler_pose(i["ep"])
    return [*frame_pairs(f, o["qp"]), (F_e, frame_error(o["qp"]) @ o["QP_ep"])]


def pose_euler(i: Case, o: Case) -> list[Pair]:
    e, E_f = frames3d.to_euler_pose(frame(i["qp"]))
    return [(e, o["ep"]), (E_f, o["EP_qp"] @ frame_tangent(i["qp"]))]


def calibrate_radial(x: Array, d: Array) -> Array:
    """Return the Jacobian XD_d (K, 2, n) of `cameras.radial_many` in the distortion."""
    r2 = np.sum(x * x, axis=1)[:, None]
    return x[:, :, None] * (r2 ** np.arange(1, len(d) + 1))[:, None]


def calibrate_pinhole(v: Array, k: Array, d: Array) -> tuple[Array, Array]:
    """Return the Jacobians E_k (K, 2, 4) and E_d (K, 2, n) of `cameras.project_pinhole`."""
    x = v[:, :2] / v[:, 2:]
    xd = cameras.radial_many(x, d)[0]
    E_k = np.concatenate([xd[:, :, None] * np.eye(2), np.tile(np.eye(2), (len(v), 1, 1))], axis=2)
    return E_k, k[:2, None] * calibrate_radial(x, d)


def pinhole(i: Case, o: Case) -> list[Pair]:
    k = k_of(i["k"])
    e, E_v = one(cameras.project_pinhole, i["p"], k, i["d"])
    E_k, E_d = one(calibrate_pinhole, i["p"], k, i["d"])
    theirs = np.roll(o["U_k"], 2, axis=1)
    return [(e, o["u"]), (E_v, o["U_p"]), (E_k, theirs), (E_d, o["U_d"].reshape(2, -1))]


def back_pinhole(i: Case, o: Case) -> list[Pair]:
    """The toolbox's ray ends at depth s: p = s m / m_z, so that P_y = s (M_y - m M_y[z] / m_z) / m_z."""
    m, M_y = one(cameras.back_project_pinhole, i["u"], k_of(i["k"]), i.get("c", np.zeros(0)))
    scale = i["s"] / m[2]
    P_y = scale * (M_y - np.outer(m, M_y[2]) / m[2])
    return [(scale * m, o["p"]), (P_y, o["P_u"]), (m[:, None] / m[2], o["P_s"])]


def radial(i: Case, o: Case) -> list[Pair]:
    d = i["d"] if "d" in i else i["c"]
    x, X_x = one(cameras.radial_many, i["u"], d)
    X_d = calibrate_radial(i["u"][None], d)
    theirs = [o[n] for n in (("ud", "UD_u", "UD_d") if "d" in i else ("uc", "UC_u", "UC_c"))]
    return list(zip((x, X_x, X_d.reshape(theirs[2].shape)), theirs, strict=True))


def omni(i: Case, o: Case) -> list[Pair]:
    par = cameras.lens_parameters("omnidirectional", i["k"], i["pol"], ())
    e, E_v = cameras.project(cameras.OMNI, i["p"][None], par)
    return [(e[0], o["u"]), (E_v[0], o["U_p"])]


def back_omni(i: Case, o: Case) -> list[Pair]:
    """The recorded P_u lacks the projection (I - m m') of the exact one."""
    par = cameras.lens_parameters("omnidirectional", i["k"], (), i["pol"])
    m, M_y = (a[0] for a in cameras.back_project(cameras.OMNI, i["u"][None], par))
    return [(m, o["p"]), (M_y, (np.eye(3) - np.outer(m, m)) @ o["P_u"])]


def retro_projection(name: str) -> Callable[[Case, Case], list[Pair]]:
    """Compare an initialisation: robot, camera, pixel and the prior's inverse distance to a landmark."""
    from_view = getattr(lm, f"{name}_from_view")

    def compare(i: Case, o: Case) -> list[Pair]:
        T, T_r, T_s = frames3d.compose(frame(i["Rf"]), frame(i["Sf"]))
        m, M_y = cameras.back_project_pinhole(i["u"][None], k_of(i["k"]), i["c"])
        l, L_T, L_ray, L_rho = from_view(T, m, i["n"])
        theirs = o["L_u"]
        if name != "inverse_depth":  # the recorded L_u lacks the projection (I - m m') of the exact one
            at = slice(3, 6) if name == "anchored" else slice(0, 3)
            direction = l[0][at] if name == "anchored" else l[0][:3] - l[0][3] * T[:3]
            theirs = theirs.copy()
            theirs[at] -= np.outer(direction, direction @ theirs[at])
        ours = [l[0], L_T[0] @ T_r, L_T[0] @ T_s, L_ray[0] @ M_y[0], L_rho[0]]
        if name == "inverse_depth":
            ours = [each[TURNED] for each in ours]
        L_rf, L_sf = o["L_rf"] @ frame_tangent(i["Rf"]), o["L_sf"] @ frame_tangent(i["Sf"])
        return list(zip(ours, (o["l"], L_rf, L_sf, theirs, o["L_n"]), strict=True))

    return compare


def projection(name: str) -> Callable[[Case, Case], list[Pair]]:
    """Compare a landmark's pixel, through robot and camera."""
    seen_from = getattr(lm, f"{name}_seen_from")

    def compare(i: Case, o: Case) -> list[Pair]:
        T, T_r, T_s = frames3d.compose(frame(i["Rf"]), frame(i["Sf"]))
        order = TURNED if name == "inverse_depth" else list(range(len(i["l"])))
        v, V_T, V_l = seen_from(T, i["l"][None, order])
        k = k_of(i["k"])
        e, E_v = cameras.project_pinhole(v, k, i["d"])
        E_k, E_d = one(calibrate_pinhole, v[0], k, i["d"])
        E_T = E_v[0] @ V_T[0]
        return [
            (e[0], o["u"]),
            (E_T @ T_r, o["U_rf"] @ frame_tangent(i["Rf"])),
            (E_T @ T_s, o["U_sf"] @ frame_tangent(i["Sf"])),
            (E_v[0] @ V_l[0][:, order], o["U_l"]),
            (E_k, np.roll(o["U_k"], 2, axis=1)),
            (E_d, o["U_d"].reshape(2, -1)),
        ]

    return compare


def conversion(function: Callable[..., Any], value: str, jacobian: str, given: str = "l") -> Any:
    """Compare a function of one argument."""
    return lambda i, o: list(zip(one(function, i[given]), (o[value], o[jacobian]), strict=True))


def from_inverse_depth(function: Callable[..., Any], value: str, jacobian: str) -> Any:
    """Compare a function of an inverse-depth point."""

    def compare(i: Case, o: Case) -> list[Pair]:
        h, H_l = one(function, i["l"][TURNED])
        return [(h, o[value]), (H_l[:, TURNED], o[jacobian])]

    return compare


def anchored_to_inverse_depth(i: Case, o: Case) -> list[Pair]:
    """The toolbox keeps rho itself, true for unit vectors; ours keeps rho / |m|: equal across, not along, m."""
    l, L_h = one(lm.anchored_to_inverse_depth, i["l"])
    m = i["l"][3:6]
    P = np.eye(7)
    P[3:6, 3:6] -= np.outer(m, m)
    return [(l[TURNED], o["i"]), ((L_h @ P)[TURNED], o["I_l"] @ P)]


def azimuth_elevation(i: Case, o: Case) -> list[Pair]:
    y, Y_v = one(directions.spherical_many, i["v"])
    return [(y[[2, 1]], o["py"]), (Y_v[[2, 1]], o["PY_v"])]


def direction(i: Case, o: Case) -> list[Pair]:
    m, M_a = one(directions.direction_many, i["py"][::-1])
    return [(m, o["v"]), (M_a[:, ::-1], o["V_py"])]


def point_to_inverse_depth(i: Case, o: Case) -> list[Pair]:
    """The recorded rho is 1 / |m|^2, a defect: compared is all else, and rho to its root."""
    ray, T = i["p"] - i["p0"], np.concatenate([i["p0"], [0, 0, 0, 1]])
    l, _, L_ray, _ = lm.inverse_depth_from_view(T, ray[None], np.array([1 / np.linalg.norm(ray)]))
    value, L_p = l[0, TURNED], L_ray[0, TURNED]
    return [(value[:5], o["l"][:5]), (value[5] ** 2, o["l"][5]), (L_p[:5], o["L_p"][:5])]


def from_frame_homogeneous(i: Case, o: Case) -> list[Pair]:
    """The toolbox's ray has any length, ours is made a unit vector first: compared for the unit ray."""
    h, length = i["l"], np.linalg.norm(i["l"][:3])
    T = frame(i["F"])
    l, L_T, _, L_rho = lm.homogeneous_from_view(T, h[None, :3], h[3:] / length)
    return [
        (l[0] * length, o["lw"]),
        (L_T[0] * length, o["L_f"] @ frame_tangent(i["F"])),
        (L_rho[0], o["L_l"][:, 3:]),
    ]


def to_frame_homogeneous(i: Case, o: Case) -> list[Pair]:
    v, V_T, V_l = lm.homogeneous_seen_from(frame(i["F"]), i["l"][None])
    theirs = o["L_f"] @ frame_tangent(i["F"])
    return [(v[0], o["lf"][:3]), (V_T[0], theirs[:3]), (V_l[0], o["L_l"][:3]), (i["l"][3], o["lf"][3])]


def linearity(name: str) -> Callable[[Case, Case], list[Pair]]:
    function, state = getattr(lm, f"{name}_linearity"), {"inverse_depth": "idp", "anchored": "ahm"}[name]

    def compare(i: Case, o: Case) -> list[Pair]:
        T = frames3d.compose(frame(i["Rf"]), frame(i["Sf"]))[0]
        sigma = np.sqrt(i[f"P_{state}"][-1, -1:])
        l = i[state][TURNED] if state == "idp" else i[state]
        return [(function(T, l[None], sigma), o["Ld"].ravel())]

    return compare


def normalised(i: Case, o: Case) -> list[Pair]:
    return [(rotations.normalize(i["v"]), o["vn"])]


def point_innovation(i: Case, o: Case) -> list[Pair]:
    return [(geometry.mahalanobis(i["y"], i["e"], i["E"] + i["R"]) ** 2, o["MD2"][0])]


def ellipse(i: Case, o: Case) -> list[Pair]:
    contour = geometry.ellipse(i["x"], i["P"], float(i["ns"][0]), int(i["NP"][0]))
    theirs = np.stack([o["X"].ravel(), o["Y"].ravel()], axis=1)
    # Where each starts on the contour depends on the signs of an SVD's columns: compared is the distance in sigmas.
    at = [geometry.mahalanobis(p, i["x"], i["P"]) for p in theirs]
    return [(at, np.full(len(at), i["ns"][0])), (contour.shape, theirs.shape)]


def placed(kind: Any, i: Case) -> Any:
    *limits, n = i["args"]
    names = ("x_min_m", "x_max_m", "y_min_m", "y_max_m", "height_m")
    return kind.model_construct(**dict(zip(names, limits, strict=False)), n=int(n)).place(np.random.default_rng()).T


def cloister_walk(i: Case, o: Case) -> list[Pair]:
    return [(placed(Cloister, i), o["world"])]


def two_storeys(i: Case, o: Case) -> list[Pair]:
    return [(placed(ThickCloister, i), o["world"])]


def house_of_segments(i: Case, o: Case) -> list[Pair]:
    x, y, z = i["args"].tolist()
    return [(House(x_m=x, y_m=y, z_m=z).scenery(np.random.default_rng()).segments.T, o["world"])]


COUNTERPARTS: dict[str, Callable[[Case, Case], list[Pair]]] = {
    "fromFrame": from_frame,
    "toFrame": to_frame,
    "composeFrames": compose,
    "invertFrame": invert,
    "odo3": odometry,
    "constVel_nojac_exact": constant_velocity,
    "q2R": q_to_matrix,
    "R2q": matrix_to_q,
    "v2q": vector_to_q,
    "q2v": q_to_vector,
    "qProd": product,
    "e2q": euler_to_q,
    "q2e": q_to_euler,
    "e2R": euler_to_matrix,
    "epose2qpose": euler_pose,
    "qpose2epose": pose_euler,
    "normvec_exact": normalised,
    "normvec_scalar": normalised,
    "pinHole": pinhole,
    "invPinHole": back_pinhole,
    "invPinHole_noc": back_pinhole,
    "distort": radial,
    "undistort": radial,
    "omniCam": omni,
    "invOmniCam": back_omni,
    "retroProjIdpPntFromPinHoleOnRob": retro_projection("inverse_depth"),
    "retroProjAhmPntFromPinHoleOnRob": retro_projection("anchored"),
    "retroProjHmgPntFromPinHoleOnRob": retro_projection("homogeneous"),
    "projEucPntIntoPinHoleOnRob": projection("point"),
    "projIdpPntIntoPinHoleOnRob": projection("inverse_depth"),
    "projAhmPntIntoPinHoleOnRob": projection("anchored"),
    "projHmgPntIntoPinHoleOnRob": projection("homogeneous"),
    "idp2euc": from_inverse_depth(lm.inverse_depth_to_point, "p", "P_l"),
    "ahm2euc": conversion(lm.anchored_to_point, "p", "P_l"),
    "hmg2euc": conversion(lm.homogeneous_to_point, "p", "P_l"),
    "idp2ahp": from_inverse_depth(lm.inverse_depth_to_anchored, "a", "A_l"),
    "ahp2idp": anchored_to_inverse_depth,
    "p2idp": point_to_inverse_depth,
    "py2vec": direction,
    "vec2py": azimuth_elevation,
    "fromFrameHmg": from_frame_homogeneous,
    "toFrameHmg": to_frame_homogeneous,
    "idpLinearTest": linearity("inverse_depth"),
    "ahmLinearTest": linearity("anchored"),
    "innovation_pnt": point_innovation,
    "cov2elli": ellipse,
    "cloister": cloister_walk,
    "thickCloister": two_storeys,
    "house": house_of_segments,
}
