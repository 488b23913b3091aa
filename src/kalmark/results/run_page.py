"""``report.html``: one file that shows a run, with everything it needs inside.

Its pictures are drawn from data: the scene at each position of the slider, and curves thinned to some 2,000 points.
"""

from __future__ import annotations

import base64
import html
import io
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from PIL import Image

from kalmark.arrays import Array
from kalmark.picture_options import Picture
from kalmark.report import OUTCOMES
from kalmark.results.camera_log import images_of_cameras
from kalmark.results.evaluate import headline, summary_of
from kalmark.results.explain import Explanation, Fate, explain_step
from kalmark.results.figure_texts import (
    BATCH,
    DIFFERENCE_COLUMNS,
    DIFFERENCE_TITLE,
    MORE,
    ROBOT,
    TOTALS,
    Figures,
    column_header,
    difference_rows,
    flatten,
    rows_with_labels,
)
from kalmark.results.filter_description import KEPT
from kalmark.results.history import WHOLE, Camera, History, Ints, LandmarkChange, MapSnapshot
from kalmark.results.measures import anees_interval, associated_nis, nees, nis_of_groups, pose_error, sigmas
from kalmark.results.plot import BEHIND, Projection
from kalmark.results.recording import Recording, config_yaml
from kalmark.results.scene import (
    POINTS,
    ImageObservation,
    Scene,
    break_path,
    colour_of,
    gaps_in,
    group_steps,
    images,
    join_polylines,
    map_shapes,
    picture_of,
    spread_indices,
    squares,
    steps_of,
    stretches_of,
    thin,
)
from kalmark.results.self_calibration import MOUNT_COLUMNS, mount_rows
from kalmark.results.verdict_text import overall, verdict_lines

Data = dict[str, Any]  # of the page, as JSON
NOT_FIGURES = ("robots", "warnings", "advice", "notes", "gaps", "repeats", "verdict")
LISTS = (".directions", ".pose_differences")  # with tables of their own
BINS = 120
LANDMARKS = 40_000  # in all the maps of a page together
SCANS = 60  # drawn at most, the most ambiguous ones
CHANGES = 200  # in the table
MARKS = 2000  # in the timeline
TENTATIVE = "tentative: "  # how the reasons of those begin that never were landmarks
UNSURE = ("between ", "its nearest ", "it does not fit", "cliques as large")  # how reasons of ambiguity begin
_ROBOT = (
    ("scans", "scans", ""),
    ("path_m", "path", "m"),
    *ROBOT,
    ("pose_nees_world", "in world coordinates", ""),
    *(row for row in TOTALS if row[0] in ("fix_median_m", "fix_rms_10m", "fix_within_10m")),
    ("diverged", "diverged", ""),
)
_HINTS = {
    False: "ellipses {}; arrow keys: single steps",
    True: "ellipsoids {}; drag to turn, scroll to come closer, arrow keys: single steps",
}


def tagged(tag: str, texts: Iterable[Any]) -> str:
    """Return texts side by side, each as an element of a page."""
    return "".join(f"<{tag}>{html.escape(str(text))}</{tag}>" for text in texts)


def report_html(run: Recording, world: bool = False) -> str:
    """Return the page: the map over time, errors, NEES and NIS, associations, figures and configuration.

    The map has the ellipses of its shape or those in the `world`.
    """
    from plotly.offline import get_plotlyjs  # slow to import

    title, figures = headline(run)
    summary, scene = summary_of(run), Scene.of(run, world=world)
    verdict = summary.get("verdict")
    notes = [*summary.get("notes", ()), *summary.get("advice", ())]
    return read_page("report.html").format(
        title=html.escape(title),
        style=read_page("report.css"),
        figures=tagged("span", figures),
        robots=robot_table(summary),
        summary=summary_table(summary),
        map="" if verdict is None else overall(verdict),
        verdict=tagged("li", [] if verdict is None else verdict_lines(verdict)),
        warnings=tagged("li", summary.get("warnings", ())),
        advice=tagged("li", notes),
        mounts=_section("Mounts that calibrate themselves", mount_rows(summary), MOUNT_COLUMNS)
        + _section(DIFFERENCE_TITLE, difference_rows(summary), DIFFERENCE_COLUMNS),
        reasons=html_table(common_reasons(run), ("outcome", "reason", "observations")),
        changes=_section("Landmarks merged and removed", [*change_rows(run)], ("t (s)", "landmark", "", "why")),
        skipped=_skipped(run, summary),
        config=html.escape(config_yaml(run.config)),
        plotly=get_plotlyjs(),
        data=json.dumps(series(run, scene), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        scene=read_page("scene.js"),
        script=read_page("report.js"),
        hint=map_hint(scene),
    )


def map_hint(scene: Scene) -> str:
    """Return the line beside the title of the map."""
    ellipses, _, keys = _HINTS[scene.d == 3].format(scene.of_what).partition("; ")
    return keys if scene.picture.ellipses == "off" else f"{scene.picture.sigmas:g}-sigma {ellipses}; {keys}"


def robot_table(summary: Figures) -> str:
    """Return the table of the figures of each robot."""
    robots = summary["robots"]
    columns = [row for row in _ROBOT if any(row[0] in figures for figures in robots.values())]
    rows = [(name, *(figure_text(f.get(key), unit) for key, _, unit in columns)) for name, f in robots.items()]
    return html_table(rows, ("robot", *(column_header(label, unit) for _, label, unit in columns)))


def summary_table(summary: Figures) -> str:
    """Return the table of all other figures in words; the tooltip of each is its key in ``summary.json``."""
    told = flatten({key: value for key, value in summary.items() if key not in NOT_FIGURES})
    figures = {path: value for path, value in told if not path.endswith(LISTS)}
    words = [*TOTALS, *MORE, *((f"batch.{key}", f"batch solution: {label}", unit) for key, label, unit in BATCH)]
    others = [name for name, value in summary.items() if isinstance(value, dict) and "ate_raw_m" in value]
    words += [(f"{name}.{key}", f"{name}: {label}", unit) for name in others for key, label, unit in ROBOT]
    rows = "".join(
        f'<tr title="{html.escape(key)}"><td{" class=part" if label.startswith(" ") else ""}>'
        f"{html.escape(label.strip())}</td><td>{html.escape(figure_text(value, unit))}</td><td>{unit}</td></tr>"
        for key, label, value, unit in rows_with_labels(figures, tuple(words))
    )
    return f"<table>{rows}</table>"


def figure_text(value: Any, unit: str = "") -> str:
    """Return a figure as it is printed: four significant digits, a dash for what is not there; a share in per cent."""
    if value is None:
        return "–"  # noqa: RUF001 - a dash
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        value = 100.0 * value if unit == "%" else value
        return f"{value:,.4g}" if 1e-3 <= abs(value) < 1e5 or value == 0 else f"{value:.3e}"
    if isinstance(value, list):
        return ", ".join(figure_text(item, unit) for item in value)
    return str(value)


def html_table(rows: Sequence[Sequence[Any]], head: Sequence[str]) -> str:
    """Return a table with a head, nothing without rows."""
    if not rows:
        return ""
    body = "".join(f"<tr>{tagged('td', row)}</tr>" for row in rows)
    return f"<table><tr>{tagged('th', head)}</tr>{body}</table>"


def _section(title: str, rows: list[Any], head: tuple[str, ...]) -> str:
    return f"<h2>{title}</h2>{html_table(rows, head)}" if rows else ""


def _skipped(run: Recording, summary: Figures) -> str:
    lines = ([f"stopped: {run.stopped}"] if run.stopped else []) + run.skipped
    if not lines:
        return ""
    shown = "\n".join(html.escape(line) for line in lines[:200])
    return f"<h2>Left out <small>{summary['skipped']}</small></h2><pre>{shown}</pre>"


def read_page(name: str) -> str:
    """Return a part of a page."""
    return (resources.files("kalmark.results") / "page" / name).read_text(encoding="utf-8")


def series(run: Recording, scene: Scene) -> Data:
    """Return all that the pictures of a report need; times in seconds since the first step."""
    t, pictures = run.history.t_s, images_of_cameras(run)
    dof, maps = (3, 6)[scene.d - 2], run.history.maps
    stride = max(1, -(-sum(len(m.ids) for m in maps) // LANDMARKS))  # the page stays of a size to open
    maps = maps[::-1][::stride][::-1]  # the last among them
    true = scene.true_points()
    return {
        "box": {"low": round_values(scene.low, 3), "high": round_values(scene.high, 3)},
        "picture": page_options(scene),
        "correlationsOf": KEPT,
        "ellipses": scene.of_what,
        "how": scene.how,
        "maps": [_map(m, float(t[m.step]), scene) for m in maps],
        "trueLandmarks": {"id": [str(i) for i in true], **xy(np.array([*true.values()]).reshape(-1, scene.d))},
        "knownLandmarks": {"id": [str(i) for i in scene.known_ids], **xy(scene.known)},
        "unseenLandmarks": xy(scene.unseen),
        "classes": {name: xy(places) for name, places in scene.classes.items()},
        "trueLines": xy(join_polylines(scene.true_lines(), scene.d)),
        "fixes": {robot: xy(thin(way.fixes)) for robot, way in scene.ways.items() if len(way.fixes)},
        "repeats": xy(scene.repeats),
        "usedFixes": {robot: xy(thin(way.used)) for robot, way in scene.ways.items() if len(way.used)},
        "bodies": {robot: xy(join_polylines(scene.body(robot))[:, : scene.d]) for robot in scene.ways},
        "cameras": [_camera(run, camera, maps, t, pictures) for camera in run.history.cameras],
        "robots": [_robot(run, scene, robot, t) for robot in scene.ways],
        "innovations": _innovations(run, scene),
        "nis": _nis(run, t),
        "dof": dof,
        "neesBounds": anees_interval(dof),
        "outcomes": _outcomes(run, t),
        "association": _association(run, t, scene.world),
    }


def page_options(scene: Scene) -> Data:
    """Return the options of the pictures of a page; `eye` is the direction to the eye in space."""
    picture = scene.picture
    view = "normal" if picture.view == "self" else picture.view
    eye = Projection.of(scene, view).axes[2] if scene.d == 3 else np.zeros(3)
    return {
        "eye": None if view in ("normal", "orbit") else round_values(eye, 4),
        "flat": view in ("top", "side", "front"),
        "orbit": view == "orbit",
        "behind": [*BEHIND[:2], BEHIND[2] * scene.size] if picture.view == "self" else None,
        "sensorWidth": picture.sensor_width_px,
        "sigmas": 0.0 if picture.ellipses == "off" else picture.sigmas,
        "labels": bool(picture.labels),
        "truth": picture.truth,
        "colours": {name: to_hex(colour) for name, colour in (picture.colours or {}).items()},
    }


def _map(m: MapSnapshot, t_s: float, scene: Scene) -> Data:
    """Return a map: all points, the endpoints of lines last, with the group that each is drawn in."""
    drawn = map_shapes(m, scene.d, scene.world)
    lines = {"lines": xy(join_polylines(drawn.lines, scene.d))}
    head = {"t": round(t_s, 3), "id": [str(m.ids[row]) for row in drawn.row], "group": drawn.group.tolist()}
    tags = {"tags": xy(join_polylines(squares(drawn.tags, scene.size)))} if scene.d == 3 else {}
    P = {"P": correlation_image(m.correlations)} if m.correlations.size else {}
    return {**head, "count": len(m.ids), **lines, **tags, **gaussians(drawn.means, drawn.covariances), **P}


def correlation_image(correlations: Array) -> str:
    """Return correlations (n, n), parts of `WHOLE`, as an image in a URI: blue -1, white 0, red 1."""
    image, out = Image.fromarray((correlations + WHOLE).astype(np.uint8), mode="P"), io.BytesIO()
    image.putpalette(
        (255 * colormaps["RdBu_r"](np.linspace(0.0, 1.0, 2 * WHOLE + 1))[:, :3]).astype(np.uint8).tobytes()
    )
    image.save(out, "PNG")
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


def _camera(
    run: Recording, camera: Camera, maps: Sequence[MapSnapshot], t: Array, pictures: Any
) -> Data:  # fmt: skip
    """Return the last images of a camera at the maps: `frames` are indices of its `scans`, None before the first."""
    steps, options = steps_of(run.history, camera), picture_of(run)
    last = np.searchsorted(steps, [m.step for m in maps], side="right") - 1
    used = np.unique(last[last >= 0])
    scans = []
    for step in steps[used].tolist():
        seen = []
        for image in images(run.history, camera, step):
            picture = pictures and pictures.uri(camera, step, image.side)
            seen.append({"side": image.side, "seen": [_seen(one, options) for one in image.observations]}
                        | ({"picture": picture} if picture else {}))  # fmt: skip
        scans.append({"t": round(float(t[step]), 3), "images": seen})
    frames = [int(np.searchsorted(used, k)) if k >= 0 else None for k in last]
    size = [float(side) for side in camera.size]
    return {"name": f"{camera.robot} · {camera.sensor}", "size": size, "scans": scans, "frames": frames}


def _seen(s: ImageObservation, options: Picture) -> Data:
    colour, meaning = colour_of(s, options)
    colour = to_hex(colour)
    out: Data = {"name": s.name, "outcome": s.outcome, "y": [round_values(p, 2) for p in s.measured]}
    if np.isfinite(s.expected).all():
        out |= {"e": [round_values(p, 2) for p in s.expected], "colour": colour, "meaning": meaning}
    if np.isfinite(s.Z).all():
        out["Z"] = round_values(np.array([s.Z[0, 0], s.Z[0, 1], s.Z[1, 1]]), 3)
    return out


def _robot(run: Recording, scene: Scene, robot: str, t: Array) -> Data:
    rows, way, d = thin(np.flatnonzero(run.history.robot == robot)), scene.ways[robot], scene.d
    mean, stretches = run.history.poses[rows], thin(way.stretches)
    out: Data = {"name": robot, "colour": scene.colour(robot), "t": round_significant(t[rows], 7)}
    out |= gaussians(mean[:, :d], thin(way.covariances))
    out["gaps"] = gaps_in(stretches).tolist()
    out["dotted"] = gaps_in(thin(np.cumsum(way.dotted))).tolist()
    out |= _orientations(mean)
    if np.isfinite(way.dead).any():
        out["dead"] = xy(break_path(thin(way.dead), stretches))
    if len(way.truth):
        out["truth"] = xy(thin(way.truth)[:, :d]) | _orientations(thin(way.truth))
    return out | _errors(run, rows, len(way.truth) > 0)


def _orientations(poses: Array) -> Data:
    """Return the headings of poses (N, 3), or the quaternions of poses (N, 7)."""
    if poses.shape[1] == 3:
        return {"theta": round_significant(poses[:, 2], 5)}
    return {"q": round_columns(poses[:, 3:], 5)}


def _errors(run: Recording, rows: Ints, scored: bool) -> Data:
    """Return errors (estimate less truth) and sigmas in m and degrees, and the NEES in the estimator's coordinates."""
    mean, P = run.history.poses[rows], run.history.pose_covariances[rows]
    scale = np.where(np.arange(P.shape[1]) < run.history.d, 1.0, 180.0 / np.pi)
    out: Data = {"sigma": round_columns(sigmas(P) * scale)}
    if scored:
        truth = run.truth.poses_in_map()[rows]
        out["error"] = round_columns(-pose_error(mean, truth) * scale)
        out["nees"] = round_significant(nees(pose_error(mean, truth, run.coordinates), P))
    return out


def _nis(run: Recording, t: Array) -> Data:
    """Return NIS per degree of freedom over windows of steps, the 95 % bounds of each, and where gaps in time are."""
    history = run.history
    value, dof, step = associated_nis(history)
    steps, at = np.unique(step, return_inverse=True)
    window = max(1, -(-len(t) // (POINTS // 4)))
    groups, gaps = group_steps(steps, history.t_ns[steps], window)
    _, per_dof, bounds = nis_of_groups(value, dof, groups[at])
    low, high = map(round_significant, bounds.T)
    return {
        "t": round_significant(np.bincount(groups, t[steps]) / np.bincount(groups), 7),
        "value": round_significant(per_dof),
        "low": low,
        "high": high,
        "gaps": gaps.tolist(),
        "window": window,
    }


def _outcomes(run: Recording, t: Array) -> Data:
    """Return the numbers of observations by outcome in each of some 120 stretches of time."""
    history = run.history
    edges = np.linspace(0.0, max(float(t[-1]), 1e-9) if len(t) else 1.0, BINS + 1)
    when = t[history.step]
    counts = {name: np.histogram(when[history.outcome == name], edges)[0].tolist() for name in OUTCOMES}
    return {
        "t": round_significant((edges[:-1] + edges[1:]) / 2, 7),
        "counts": {name: column for name, column in counts.items() if any(column)},
    }


def _innovations(run: Recording, scene: Scene) -> list[Data]:
    """Return each robot's innovations of fixes and their sigmas in m, thinned, and by themselves those rejected."""
    begin_ns, out = int(run.history.t_ns[:1].sum()), []
    for robot in scene.ways:
        fixes = [fix for fix in run.history.fixes if fix.robot == robot]
        if not fixes:
            continue
        t_ns, z = np.array([fix.t_ns for fix in fixes]), np.array([fix.z for fix in fixes])
        t, rows = (t_ns - begin_ns) * 1e-9, spread_indices(len(fixes))
        bad = thin(np.flatnonzero([not fix.used for fix in fixes]))
        sigma = sigmas(np.array([fix.Z for fix in fixes]))
        curves = {"z": round_columns(z[rows]), "sigma": round_columns(sigma[rows])}
        rejected = {"t": round_significant(t[bad], 7), "z": round_columns(z[bad])}
        head = {"name": robot, "colour": scene.colour(robot), "t": round_significant(t[rows], 7)}
        out.append({**head, **curves, "gaps": gaps_in(stretches_of(t_ns)[rows]).tolist(), "rejected": rejected})
    return out


def common_reasons(run: Recording, most: int = 15) -> list[tuple[str, str, int]]:
    """Return the commonest (outcome, reason, count); of too many, those that differ in a number only count as one."""
    pairs = zip(run.history.outcome.tolist(), run.history.reason.tolist(), strict=True)
    counts = Counter((outcome, reason) for outcome, reason in pairs if reason)
    if len(counts) > most:
        merged: Counter[tuple[str, str]] = Counter()
        for (outcome, reason), count in counts.items():
            merged[outcome, re.sub(r"(?<!\bd)\d+(\.\d+)?(e[+-]?\d+)?", "…", reason)] += count
        counts = merged
    return [(outcome, reason, count) for (outcome, reason), count in counts.most_common(most)]


def _association(run: Recording, t: Array, world: bool) -> Data:
    """Return ambiguous scans in the order of time, and when landmarks were merged or removed."""
    changes = _told_changes(run.history)
    return {
        "scans": [_ambiguous(run.history, explain_step(run, step), world) for step in ambiguous(run.history).tolist()],
        "changes": {
            what: round_significant(np.array([t[c.step] for c in changes if c.what == what][:MARKS]), 7)
            for what in dict.fromkeys(c.what for c in changes)
        },
    }


def ambiguous(history: History) -> Ints:
    """Return the steps of the most ambiguous scans, in the order of time: those with most ambiguous observations."""
    if not len(history.candidate_row):
        return np.zeros(0, dtype=np.int64)
    doubt = (history.outcome == "deferred").astype(np.int64)
    doubt += history.reason_begins(UNSURE)
    shown = np.zeros(len(history.step), dtype=np.bool_)
    shown[history.candidate_row] = True
    score = np.bincount(history.step[shown], doubt[shown], len(history.t_ns))
    best = np.argsort(-score, kind="stable")[:SCANS]
    return np.sort(best[score[best] > 0])


def _told_changes(history: History) -> list[LandmarkChange]:
    return [c for c in history.changes if not c.reason.startswith(TENTATIVE)]


def change_rows(run: Recording) -> Iterator[tuple[str, str, str, str]]:
    """Return rows of what became of landmarks: when, which, what, why; tentative ones that went are not among them."""
    history = run.history
    told = _told_changes(history)
    for c in told[:CHANGES]:
        yield f"{history.t_s[c.step]:.1f}", c.landmark, c.what, c.reason
    if len(told) > CHANGES:
        yield "", "", "", f"and {len(told) - CHANGES} more: see associations.csv"


def _ambiguous(history: History, told: Explanation, world: bool) -> Data:
    here, P = told.pose[None, :2], told.covariance[None, :2, :2]
    pose = gaussians(here, P if world else history.robot_shape(np.array([told.step]))[:, :2, :2])
    out = {"t": round(told.t_s, 3), "in_log": told.in_log, "robot": told.robot, "sensor": told.sensor, "pose": pose}
    return out | {"seen": [_fate(fate) for fate in told.fates]}


def _fate(fate: Fate) -> Data:
    x, y = round_values(fate.seen_at[:2], 4)
    near = [
        {"name": str(c.landmark), "d2": float(f"{c.d2:.3g}")}
        | dict(zip("xy", round_values(c.place[:2], 4), strict=True))
        for c in fate.near
    ]
    text = f"{fate.outcome}{' ' + fate.landmark if fate.landmark else ''}{': ' if fate.reason else ''}{fate.reason}"
    return {
        "x": x, "y": y, "k": fate.index, "outcome": fate.outcome, "landmark": fate.landmark, "text": text, "near": near,
    }  # fmt: skip


def xy(points: Array) -> Data:
    """Return points (N, 2 or 3) to a tenth of a millimetre."""
    return {axis: round_values(column, 4) for axis, column in zip("xyz", points.T, strict=False)}


def gaussians(means: Array, covariances: Array) -> Data:
    """Return means (N, d) and covariances (N, d, d) column by column: x, y, pxx, pxy, pyy, in space more."""
    pairs = combinations_with_replacement(range(means.shape[1]), 2)
    return xy(means) | {f"p{'xyz'[i]}{'xyz'[j]}": round_significant(covariances[:, i, j]) for i, j in pairs}


def round_values(values: Array, digits: int) -> list[float | None]:
    """Return values to so many decimals, None for NaN and infinity."""
    return [value if math.isfinite(value) else None for value in np.round(values, digits).tolist()]


def round_columns(values: Array, digits: int = 4) -> list[list[float | None]]:
    """Return the columns of values (N, n) to so many significant digits."""
    return [round_significant(column, digits) for column in values.T]


def round_significant(values: Array, digits: int = 4) -> list[float | None]:
    """Return values to so many significant digits, None for NaN and infinity."""
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values.tolist()]
