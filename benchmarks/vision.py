"""One camera on recorded images: the error of its path after an alignment by similarity, matches and time a frame.

python benchmarks/vision.py SEQUENCE [SEEDS]     of `SEQUENCES`; a row a seed, then the worst of them
The drift of the scale is that of the second half of the path against the first.  One thread.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import kalmark as km
from kalmark.arrays import Array
from kalmark.config import build_slam, open_run
from kalmark.events import Id
from kalmark.filter.kernels import one_thread
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
    options = [*SEQUENCES[name], f"robots.each.sensors.camera.detector.seed={seed}"]
    config, log = open_run("visual", None, options)
    slam = build_slam(config, log)
    (front_end,) = slam.state.front_ends.values()
    assert isinstance(front_end, FrontEnd)
    way, took, matched, wanted = [], [], 0, 0
    seen: list[dict[Id, Array]] = []  # where landmarks were in each frame
    for frame in log.events:
        image = frame.grey()  # type: ignore[union-attr]
        here = km.Frame(t_ns=frame.t_ns, robot=frame.robot, sensor="camera", image=image)
        start = time.perf_counter()
        report = slam.process(here)
        took.append(time.perf_counter() - start)
        fits = [o for o in report.observations if o.outcome in ("new", "associated") and o.landmark is not None]
        seen.append({o.landmark: report.y[o.index] for o in fits if o.landmark is not None})
        matched += sum(o.outcome == "associated" for o in report.observations)
        assert front_end.prospect is not None
        wanted += len(front_end.prospect)
        way.append(slam.mean(frame.robot)[:3])
    shifts = [float(np.hypot(*(seen[-1][name] - y))) for name, y in seen[0].items() if name in seen[-1]]
    p, length = np.array(way), float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    found = {
        "matched": matched / len(took), "found": matched / max(wanted, 1), "ms": 1e3 * float(np.median(took)),
        "hz": 1.0 / float(np.mean(took)), "return": float(np.linalg.norm(p[-1] - p[0])) / length,
        "back": len(shifts), "shift_px": float(np.median(shifts)) if shifts else np.nan,
        **{f"{part}_ms": 1e3 * spent / len(took) for part, spent in front_end.times.items()},
    }  # fmt: skip
    truth = log.truth.get(log.robots[0])
    if truth is not None:
        q = truth.at([frame.t_ns for frame in log.events])[:, :3]
        there = np.isfinite(q).all(axis=1)
        p, q = p[there], q[there]
        half = len(p) // 2
        found["ate_m"], found["scale"] = similarity(p, q)
        found["drift"] = similarity(p[half:], q[half:])[1] / similarity(p[:half], q[:half])[1] - 1.0
    return found


if __name__ == "__main__":
    name, seeds = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 5
    rows = []
    with one_thread():
        for seed in range(seeds):
            rows.append(run(name, seed))
            print(f"seed {seed}: " + ", ".join(f"{key} {value:.4g}" for key, value in rows[-1].items()), flush=True)
    print("| sequence | ATE, m, of each seed | largest | scale drift | end off start | matched a frame | ms, median |")
    print("|---|---|---|---|---|---|---|")
    ate = [row.get("ate_m", np.nan) for row in rows]
    drift = max(abs(row.get("drift", np.nan)) for row in rows)
    print(
        f"| {name} | {' '.join(f'{a:.3f}' for a in ate)} | {max(ate):.3f} | {100 * drift:.1f} % | "
        f"{100 * max(row['return'] for row in rows):.1f} % | {np.mean([row['matched'] for row in rows]):.0f} | "
        f"{np.median([row['ms'] for row in rows]):.1f} |"
    )
