"""Cameras on recorded and rendered images: errors of their paths, NEES, matches and time a frame.

python benchmarks/vision.py SEQUENCE [SEEDS]     of `SEQUENCES`; a row a seed, then the worst of them
python benchmarks/vision.py SEQUENCE+lines       with the lines of the images in the map, too
python benchmarks/vision.py WORLD [SEEDS]        of `WORLDS`, rendered: errors against the truth, ANEES of the pose
python benchmarks/vision.py loop [SEEDS]         round `textured_room` with a view of the wall: errors after the first
                                                 round with and without descriptors of what comes into view again
One camera on recorded images is aligned by similarity; what knows its scale and its start is not aligned at all.
The drift of the scale is that of the second half of the path against the first.  One thread; times are of the
processor, so that other programs count little.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import kalmark as km
from kalmark.arrays import Array
from kalmark.config import build_slam, open_run
from kalmark.filter.kernels import one_thread
from kalmark.geometry.frames3d import minus
from kalmark.results.measures import anees_interval
from kalmark.simulate import load_world, simulate
from kalmark.vision import front_end
from kalmark.vision.front_end import FrontEnd

SEQUENCES: dict[str, list[str]] = {
    "fr1_xyz": ["log.path=visual/tum_fr1_xyz"],
    "tsukuba": [
        "log.path=visual/tsukuba150/dataset_images_matlab",
        "log.fps=30",
        *(f"robots.each.sensors.camera.{key}" for key in ("fx_px=615", "fy_px=615", "cx_px=320", "cy_px=240")),
    ],
    "desk": ["log.path=visual/openekf_s3/escritorio_traslacion.mp4"],
}


LINES = (
    "robots.each.sensors.lines={type: segments, images: camera, detector: {type: line_search},"
    " landmark: {type: anchored_homogeneous_line, prior_rho_per_m: 0.5, sigma_rho_per_m: 0.5}}"
)
PARTS = ("search", "match", "start", "update", "filter")  # templates; ...; new landmarks; patches; all of the filter
SINGULAR = 1e12  # condition of a covariance, so much or more: no NEES
WORLDS = ("textured_room", "textured_room_depth", "textured_room_stereo")
LOOP = (
    "steps=520",
    *(f"robots.robot.sensors.camera.{key}" for key in (
        "mount.roll_deg=90", "landmark.prior_rho_per_m=0.8", "landmark.sigma_rho_per_m=0.4"
    )),
)  # fmt: skip
ROUND, NEVER = 410, 10**6  # images of a round; more frames than there are


def similarity(p: Array, q: Array) -> tuple[float, float]:
    """Return the RMS distance of p (N, 3) from q after an alignment by similarity, and its scale.  Umeyama 1991."""
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    U, s, V = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(V))])
    scale = float((s * sign).sum() / np.mean(np.sum(a * a, axis=1)))
    left = scale * a @ ((U * sign) @ V).T - b
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1)))), scale


def run(name: str, seed: int) -> dict[str, float]:
    """Return the figures of one run."""
    name, _, lines = name.partition("+")
    options = [*SEQUENCES[name], f"robots.each.sensors.camera.detector.seed={seed}", *([LINES] if lines else [])]
    config, log = open_run("visual", None, options)
    slam = build_slam(config, log)
    eye = slam.state.sources[log.robots[0], "camera"]
    assert isinstance(eye, FrontEnd)
    way, took, matched, wanted, lines_matched = [], [], 0, 0, 0
    parts = [list(eye.times.values())]  # so far, s
    for frame in log.events:
        image = frame.grey()  # type: ignore[union-attr]
        here = km.Frame(t_ns=frame.t_ns, robot=frame.robot, sensor=frame.sensor, image=image)  # type: ignore[union-attr]
        start = time.process_time()
        report = slam.process(here)
        spent = time.process_time() - start
        if here.sensor == "lines":
            took[-1] += spent
            way[-1] = slam.mean(frame.robot)[:3]
            lines_matched += sum(o.outcome == "associated" for o in report.observations)
            continue
        took.append(spent)
        parts.append(list(eye.times.values()))
        matched += sum(o.outcome == "associated" for o in report.observations)
        assert eye.prospect is not None
        wanted += len(eye.prospect)
        way.append(slam.mean(frame.robot)[:3])
    own = np.diff(parts, axis=0)
    spent_on = 1e3 * np.median(np.column_stack([own, np.array(took) - own.sum(axis=1)]), axis=0)
    p, length = np.array(way), float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    found = {
        "matched": matched / len(took), "found": matched / max(wanted, 1), "ms": 1e3 * float(np.median(took)),
        "hz": 1.0 / float(np.mean(took)), "return": float(np.linalg.norm(p[-1] - p[0])) / length,
        "lines": lines_matched / len(took),
        **{f"{part}_ms": spent for part, spent in zip((*eye.times, "filter"), spent_on, strict=True)},
    }  # fmt: skip
    truth = log.truth.get(log.robots[0])
    if truth is not None:
        q = truth.at([e.t_ns for e in log.events if e.sensor == "camera"])[:, :3]  # type: ignore[union-attr]
        there = np.isfinite(q).all(axis=1)
        p, q = p[there], q[there]
        half = len(p) // 2
        found["ate_m"], found["scale"] = similarity(p, q)
        found["drift"] = similarity(p[half:], q[half:])[1] / similarity(p[:half], q[:half])[1] - 1.0
    return found


def rendered(name: str, seed: int, options: Sequence[str] = ()) -> tuple[Array, Array, float]:
    """Return after each image of a world the position's error [m] and the NEES of the pose (6); a frame's time [ms].

    The NEES is NaN while the pose is known exactly.
    """
    world = load_world(name, options)
    log = simulate(world, seed=seed)
    slam = build_slam(world.config(), log)
    (robot,), off, nees, took = log.robots, [], [], []
    for event in log.events:
        if not isinstance(event, km.Frame):
            slam.process(event)
            continue
        frame = replace(event, image=event.grey(), depth=event.depths())  # rendered here, not in the time
        start = time.process_time()
        slam.process(frame)
        took.append(time.process_time() - start)
        error = minus(slam.mean(robot)[:7], log.truth[robot].at([event.t_ns])[0][:7])
        off.append(float(np.linalg.norm(error[:3])))
        P = slam.covariance(robot)[:6, :6]
        nees.append(float(error @ np.linalg.solve(P, error)) if np.linalg.cond(P) < SINGULAR else np.nan)
    return np.array(off), np.array(nees), 1e3 * float(np.median(took))


def print_rendered(name: str, seeds: int) -> None:
    """Print the errors of each seed, and the mean NEES of all at each image against its 95 % band."""
    off, nees, ms = [], [], []
    for seed in range(seeds):
        found = rendered(name, seed)
        off.append(float(np.sqrt(np.mean(found[0] ** 2))))
        nees.append(found[1] / 6)
        ms.append(found[2])
        print(f"seed {seed}: position {off[-1]:.4f} m, NEES {np.nanmean(nees[-1]):.2f}", flush=True)
    low, high = (bound / 6 for bound in anees_interval(6, seeds))
    mean = np.mean(nees, axis=0)
    mean = mean[np.isfinite(mean)]
    inside = 100 * float(np.mean((mean > low) & (mean < high)))
    print("| world | position, m, RMS of each seed, largest | ANEES of the pose | in its band | ms, median |")
    print("|---|---|---|---|---|")
    print(f"| {name} | {max(off):.3f} | {mean.mean():.2f} | {inside:.0f} % | {np.median(ms):.1f} |")


def print_loop(seeds: int) -> None:
    """Print the errors of the position after a round, of each seed, with and without descriptors."""
    rows, asked = [], front_end.AWAY
    for seed in range(seeds):
        row = []
        for away in (asked, NEVER):
            front_end.AWAY = away
            off = rendered("textured_room", seed, LOOP)[0][ROUND:]
            row.append(float(np.sqrt(np.mean(off**2))))
        rows.append(row)
        print(f"seed {seed}: {row[0]:.3f} m, without descriptors {row[1]:.3f} m", flush=True)
    print("| world | position, m, of each seed | without descriptors |\n|---|---|---|")
    print("| loop | " + " | ".join(" ".join(f"{row[k]:.2f}" for row in rows) for k in (0, 1)) + " |")


def main(name: str, seeds: int) -> None:
    """Print the figures of each seed and the row of all."""
    if name == "loop":
        print_loop(seeds)
        return
    if name in WORLDS:
        print_rendered(name, seeds)
        return
    rows = []
    for seed in range(seeds):
        rows.append(run(name, seed))
        print(f"seed {seed}: " + ", ".join(f"{key} {value:.4g}" for key, value in rows[-1].items()), flush=True)
    head = "| sequence | ATE, m, of each seed | largest | scale drift | end off start | matched a frame"
    print(f"{head} | ms, median | lines | its parts: {', '.join(PARTS)} |")
    print("|---|---|---|---|---|---|---|---|---|")
    ate = [row.get("ate_m", np.nan) for row in rows]
    drift = max(abs(row.get("drift", np.nan)) for row in rows)
    print(
        f"| {name} | {' '.join(f'{a:.3f}' for a in ate)} | {max(ate):.3f} | {100 * drift:.1f} % | "
        f"{100 * max(row['return'] for row in rows):.1f} % | {np.mean([row['matched'] for row in rows]):.0f} | "
        f"{np.median([row['ms'] for row in rows]):.1f} | {np.mean([row['lines'] for row in rows]):.0f} | "
        + " ".join(f"{np.median([row[f'{part}_ms'] for row in rows]):.1f}" for part in PARTS)
        + " |"
    )


if __name__ == "__main__":
    front_end.perf_counter = time.process_time  # of the parts, too
    with one_thread():
        main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 5)
