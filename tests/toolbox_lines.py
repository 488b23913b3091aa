"""Each of the toolbox's functions of lines beside kalmark's: pairs of outputs in kalmark's error coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from kalmark import geometry
from kalmark.geometry import directions, frames3d, rotations
from kalmark.models import cameras, landmarks, lines
from kalmark.models import landmarks3d as lm
from toolbox import Array, Case, Pair, frame, frame_tangent, k_of, one
from toolbox_functions import calibrate_pinhole

HERE = np.array([0.0, 0, 0, 0, 0, 0, 1])
PIXELS = np.array([1.0, 1, 0, 0])  # intrinsics that leave pixels as they are
NO_LENS = np.zeros(0)
WHOLE = np.array([0.0, 1])
ORDER = {  # of the numbers: the toolbox's pitch, yaw are kalmark's elevation, azimuth
    "pluecker": list(range(6)),
    "anchored_pluecker": list(range(9)),
    "inverse_depth_line": [0, 1, 2, 4, 3, 5, 7, 6, 8],
    "anchored_homogeneous_line": list(range(11)),
    "homogeneous_line": list(range(8)),
}


def line(name: str) -> Any:
    """Return the landmark model of a line."""
    return next(model() for model in landmarks.LINES if model.kind in (name, f"{name}_line"))


def pose(i: Case) -> tuple[Array, Array, Array]:
    """Return the camera's pose, and its Jacobians in those of the robot and of the mount."""
    return frames3d.compose(frame(i["Rf"]), frame(i["Sf"]))


def of_frames(o: Case, name: str, i: Case) -> list[Array]:
    return [o[f"{name}_rf"] @ frame_tangent(i["Rf"]), o[f"{name}_sf"] @ frame_tangent(i["Sf"])]


def image_line(i: Case, o: Case) -> list[Pair]:
    """Compare the line through two pixels, homogeneous and not normalised."""
    ends = np.insert(i["s"].reshape(2, 2), 2, 1.0, axis=1)
    h, H_a, H_b = lines.cross_products(ends[:1], ends[1:])
    return [(h[0], o["hm"]), (np.hstack([H_a[0][:, :2], H_b[0][:, :2]]), o["HM_s"])]


def distances(i: Case, o: Case) -> list[Pair]:
    """Compare the signed distances of a segment's ends from a line: our innovation is minus that."""
    _, z, Z_v = lines.segment_innovation(i["hm"][None], i["seg"][None], PIXELS)
    h = lines.image_lines(i["hm"][None], PIXELS)[0][0, :2]
    return [(-z[0], o["z"]), (Z_v[0], o["Z_hm"]), (np.kron(np.eye(2), h), o["Z_s"])]


def line_innovation(i: Case, o: Case) -> list[Pair]:
    """The recorded noise is across the expected line, ours across the measured one: equal for round pixels."""
    _, z, Z_v = (a[0] for a in lines.segment_innovation(i["e"][None], i["y"][None], PIXELS))
    Z = Z_v @ i["E"] @ Z_v.T + lines.segment_noise(i["y"][None], i["R"])[0]
    distance = geometry.mahalanobis(z, np.zeros(2), Z) ** 2
    return [(-z, o["z"]), (Z_v, o["Z_e"]), (Z, o["Z"]), (distance, o["MD2"][0])]


def pluecker_projection(name: str) -> Callable[[Case, Case], list[Pair]]:
    """Compare a line's image, normalised: its length has no meaning."""
    seen_from = line(name).seen_from

    def compare(i: Case, o: Case) -> list[Pair]:
        T, T_r, T_s = pose(i)
        v, V_T, V_l = seen_from(T, i["l"][None])
        h, H_v = lines.image_lines(v, k_of(i["k"]))
        theirs, norm = (a[0] for a in lines.image_lines(o["hm"].reshape(1, 3).copy(), PIXELS))
        ours = [H_v[0] @ V_T[0] @ T_r, H_v[0] @ V_T[0] @ T_s, H_v[0] @ V_l[0]]
        recorded = [norm @ J for J in [*of_frames(o, "HM", i), o["HM_l"]]]
        return [(h[0], theirs), *zip(ours, recorded, strict=True)]

    return compare


def seen_ends(i: Case, o: Case, p: Array) -> list[Pair]:
    """Compare the pixels of two points p (2, 3) through robot and camera: values, depths, and all but that of p."""
    T, T_r, T_s = pose(i)
    v, V_T, _ = lm.point_seen_from(T, p)
    e, E_v = cameras.project_pinhole(v, k_of(i["k"]), NO_LENS)
    E_T = (E_v @ V_T).reshape(4, 6)
    E_k = calibrate_pinhole(v, k_of(i["k"]), NO_LENS)[0].reshape(4, 4)
    S_r, S_s = of_frames(o, "S", i)
    pairs = [(e.ravel(), o["s"].ravel()), (v[:, 2], o["d"].ravel())]
    return [*pairs, (E_T @ T_r, S_r), (E_T @ T_s, S_s), (E_k, np.roll(o["S_k"], 2, axis=1))]


def pixels_of(i: Case, p: Array) -> Array:
    """Return the Jacobians (2, 2, 3) of the pixels of two points."""
    v, _, V_p = lm.point_seen_from(pose(i)[0], p)
    return cameras.project_pinhole(v, k_of(i["k"]), NO_LENS)[1] @ V_p


def segment_projection(i: Case, o: Case) -> list[Pair]:
    p = i["seg"].reshape(2, 3)
    E_p = pixels_of(i, p)
    theirs = o["S_seg"].reshape(2, 2, 2, 3)
    return [*seen_ends(i, o, p), (E_p[0], theirs[0, :, 0]), (E_p[1], theirs[1, :, 1])]


def line_projection(name: str) -> Callable[[Case, Case], list[Pair]]:
    """Compare a line through two points: the pixels of both, and the image line through them."""
    endpoints, seen_from = line(name).endpoints, line(name).seen_from

    def compare(i: Case, o: Case) -> list[Pair]:
        l = i["l"][ORDER[name]]
        p, P_l = one(endpoints, l, WHOLE[None])
        E_l = (pixels_of(i, p) @ P_l).reshape(4, -1)[:, ORDER[name]]
        h = lines.image_lines(seen_from(pose(i)[0], l[None])[0], k_of(i["k"]))[0][0]
        ends = np.insert(o["s"].reshape(2, 2), 2, 1.0, axis=1)
        through = lines.image_lines(np.cross(*ends)[None], PIXELS)[0][0]
        return [*seen_ends(i, o, p), (E_l, o["S_l"]), (h, through)]

    return compare


def pluecker_start(name: str) -> Callable[[Case, Case], list[Pair]]:
    """Compare a new line seen as the image line hm: as the segment of which seg2hmgLin makes hm."""
    from_view = line(name).of

    def compare(i: Case, o: Case) -> list[Pair]:
        a, b, c = i["hm"]
        foot = -c * np.array([a, b]) / (a * a + b * b)
        s = np.stack([foot, foot + np.array([-b, a])])
        if np.cross(*np.insert(s, 2, 1.0, axis=1)) @ i["hm"] < 0:
            s[1] = foot - np.array([-b, a])
        HM_s = image_line({"s": s.ravel()}, {"hm": i["hm"], "HM_s": np.zeros((3, 4))})[1][0]
        T, T_r, T_s = pose(i)
        m, M_y = cameras.back_project_pinhole(s, k_of(i["k"]), NO_LENS)
        l, L_T, L_rays, L_beta = (each[0] for each in from_view(T, m.reshape(1, 6), i["n"][None]))
        L_s = np.hstack([L_rays[:, :3] @ M_y[0], L_rays[:, 3:] @ M_y[1]])
        theirs = (o["l"], *of_frames(o, "L", i), o["L_hm"] @ HM_s, o["L_n"])
        return list(zip((l, L_T @ T_r, L_T @ T_s, L_s, L_beta), theirs, strict=True))

    return compare


def line_start(name: str) -> Callable[[Case, Case], list[Pair]]:
    """Compare a new line through two points.

    The recorded Jacobians of homogeneous ones lack the projection (I - m m') of the exact one.  Of the second end of
    anchored ones there is only that in u, in the place of that in v.
    """
    from_view = line(name).of
    at = {"inverse_depth_line": (), "anchored_homogeneous_line": (3, 7), "homogeneous_line": (0, 4)}[name]

    def compare(i: Case, o: Case) -> list[Pair]:
        T, T_r, T_s = pose(i)
        m, M_y = cameras.back_project_pinhole(i["seg"].reshape(2, 2), k_of(i["k"]), NO_LENS)
        l, L_T, L_rays, L_rho = (each[0][ORDER[name]] for each in from_view(T, m.reshape(1, 6), i["n"][None]))
        L_s = np.hstack([L_rays[:, :3] @ M_y[0], L_rays[:, 3:] @ M_y[1]])
        theirs = o["L_seg"].copy()
        if name == "anchored_homogeneous_line":
            theirs, L_s = theirs[:, [0, 1, 3]], L_s[:, :3]
        for ray, end in zip(m, at, strict=False):
            direction = rotations.matrix(T[3:]) @ ray
            theirs[end : end + 3] -= np.outer(direction, direction @ theirs[end : end + 3])
        recorded = (o["l"], *of_frames(o, "L", i), theirs, o["L_n"])
        return list(zip((l, L_T @ T_r, L_T @ T_s, L_s, L_rho), recorded, strict=True))

    return compare


def whole_segment(name: str) -> Callable[[Case, Case], list[Pair]]:
    """Compare the two points of a line through them, at abscissas 0 and 1 or others."""
    endpoints = line(name).endpoints

    def compare(i: Case, o: Case) -> list[Pair]:
        p, P_l = one(endpoints, i["l"][ORDER[name]], i.get("t", WHOLE)[None])
        value, jacobian = ("seg", "SEG_l") if "seg" in o else ("s", "S_l")
        return [(p.ravel(), o[value].ravel()), (P_l.reshape(6, -1)[:, ORDER[name]], o[jacobian])]

    return compare


def pluecker_ends(i: Case, o: Case) -> list[Pair]:
    p, P_l = one(lines.pluecker_endpoints, i["l"], i["t"][None])
    along = (p[1] - p[0]) / (i["t"][1] - i["t"][0])
    pairs = [(p[0], o["e1"].ravel()), (p[1], o["e2"].ravel()), (P_l[0], o["E1_l"]), (P_l[1], o["E2_l"])]
    return [*pairs, (along, o["E1_t"].ravel()), (along, o["E2_t"].ravel())]


def anchored_pluecker_ends(i: Case, o: Case) -> list[Pair]:
    """The toolbox's abscissas count from the point closest to the origin, ours from that closest to the anchor."""
    anchor, v = i["l"][:3], i["l"][6:]
    u, U_v = one(directions.unit_many, v)
    p, P_l = one(lines.anchored_pluecker_endpoints, i["l"], (i["t"] - anchor @ u)[None])
    slipped = np.outer(u, np.concatenate([-u, np.zeros(3), -(anchor @ U_v)]))
    return [(p.ravel(), o["seg"].ravel()), ((P_l + slipped).reshape(6, 9), o["SEG_l"])]


def pluecker_to_frame(i: Case, o: Case) -> list[Pair]:
    v, V_T, V_l = lines.pluecker_seen_from(frame(i["F"]), i["l"][None])
    theirs = o["L_f"] @ frame_tangent(i["F"])
    return [(v[0], o["lf"][:3]), (V_T[0], theirs[:3]), (V_l[0], o["L_l"][:3])]


def pluecker_from_frame(i: Case, o: Case) -> list[Pair]:
    """What the frame's line is in the world is what is seen of it from the world, which is the inverse frame."""
    T, T_f = frames3d.inverse(frame(i["F"]))
    v, V_T, V_l = lines.pluecker_seen_from(T, i["l"][None])
    theirs = o["L_f"] @ frame_tangent(i["F"])
    return [(v[0], o["lw"][:3]), (V_T[0] @ T_f, theirs[:3]), (V_l[0], o["L_l"][:3])]


def without_anchor(i: Case, o: Case) -> list[Pair]:
    h, H_l = one(lines.anchored_pluecker_to_pluecker, i["l"])
    return [(h, o["pl"].ravel()), (H_l, o["PL_l"])]


def with_anchor(i: Case, o: Case) -> list[Pair]:
    """The normal of the plane through the anchor is what is seen from there."""
    v, V_T, V_l = lines.pluecker_seen_from(np.concatenate([i["x"], HERE[3:]]), i["l"][None])
    return [(v[0], o["al"].ravel()[3:6]), (V_l[0], o["AL_l"][3:6]), (V_T[0][:, :3], o["AL_x"][3:6])]


def visible(i: Case, s: Array, depths: Array, least: float) -> tuple[bool, Array]:
    """Return what is seen of a segment with the pixels s (4,) at these depths."""
    p = np.insert(s.reshape(2, 2), 2, 1.0, axis=1) * depths[:, None]
    seen, e = lines.visible_segment(HERE, p[:1], p[1:], PIXELS, i["imSize"], least)
    return bool(seen[0]), e[0]


def visible_segment(i: Case, o: Case) -> list[Pair]:
    seen, e = visible(i, i["s"], i["d"], i["lmin"][0])
    return [(seen, bool(o["vis"].ravel()[0])), (e if seen else np.zeros(4), o["sv"].ravel())]


def trimmed_segment(i: Case, o: Case) -> list[Pair]:
    return [(visible(i, i["s"], np.ones(2), 0.0)[1], o["e"].ravel())]


def trimmed_line(i: Case, o: Case) -> list[Pair]:
    """A whole line is a segment longer than the image, in either order."""
    a, b, c = i["hm"]
    s = -c * np.array([a, b]) / (a * a + b * b) + np.outer([1e4, -1e4], [-b, a])
    e = visible(i, s.ravel(), np.ones(2), 0.0)[1].reshape(2, 2)
    theirs = o["e"].reshape(2, 2)
    return [(e[::-1] if abs(e[0] - theirs[0]).max() > abs(e[1] - theirs[0]).max() else e, theirs)]


LINE_COUNTERPARTS: dict[str, Callable[[Case, Case], list[Pair]]] = {
    "seg2hmgLin": image_line,
    "hms2hh": distances,
    "innovation_lin": line_innovation,
    "retroProjPlkLinFromPinHoleOnRob": pluecker_start("pluecker"),
    "retroProjAplLinFromPinHoleOnRob": pluecker_start("anchored_pluecker"),
    "retroProjIdpLinFromPinHoleOnRob": line_start("inverse_depth_line"),
    "retroProjAhmLinFromPinHoleOnRob": line_start("anchored_homogeneous_line"),
    "retroProjHmgLinFromPinHoleOnRob": line_start("homogeneous_line"),
    "projPlkLinIntoPinHoleOnRob": pluecker_projection("pluecker"),
    "projAplLinIntoPinHoleOnRob": pluecker_projection("anchored_pluecker"),
    "projSegLinIntoPinHoleOnRob": segment_projection,
    "projIdpLinIntoPinHoleOnRob": line_projection("inverse_depth_line"),
    "projAhmLinIntoPinHoleOnRob": line_projection("anchored_homogeneous_line"),
    "projHmgLinIntoPinHoleOnRob": line_projection("homogeneous_line"),
    "idpLin2seg": whole_segment("inverse_depth_line"),
    "ahmLin2seg": whole_segment("anchored_homogeneous_line"),
    "hmgLin2seg": whole_segment("homogeneous_line"),
    "idpLinSegment": whole_segment("inverse_depth_line"),
    "pluckerEndpoints": pluecker_ends,
    "aPluckerSegment": anchored_pluecker_ends,
    "toFramePlucker": pluecker_to_frame,
    "fromFramePlucker": pluecker_from_frame,
    "unanchorPlucker": without_anchor,
    "anchorPlucker": with_anchor,
    "visibleSegment": visible_segment,
    "trimSegment": trimmed_segment,
    "trimHmgLin": trimmed_line,
}
