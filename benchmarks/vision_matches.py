"""Matches in rendered rooms against the pixels of their true points: how far off, for how long, by which noise.

python benchmarks/vision_matches.py WORLD [SEEDS]     of `vision.WORLDS`; 3 seeds
A landmark is the point that its first pixel shows.  Printed are the RMS of the errors of its later matches and their
median (as of a Rayleigh distribution), px; their correlation from one frame to the next and over 50 frames; and the
chi-square of the errors by the noise that the filter was given, mean and median, each over that of white noise.  Errors
that last are averaged by no filter that takes them for white: with a correlation c from each frame to the next, their
noise has to be (1 + c) / (1 - c) times their variance.  Errors beyond `LOST_PX` are counted apart.
"""

from __future__ import annotations

import sys

import numpy as np

import kalmark as km
from kalmark.arrays import Array
from kalmark.config import build_slam
from kalmark.events import Id
from kalmark.filter.kernels import one_thread
from kalmark.geometry.frames3d import from_frame_many, to_frame_many
from kalmark.simulate import load_world, simulate
from kalmark.vision.front_end import FrontEnd

LOST_PX, LATER = 3.0, 50


def errors(name: str, seed: int) -> dict[Id, dict[int, tuple[Array, float]]]:
    """Return for each landmark, by frame, the error (2,) [px] of its match and its square over the noise."""
    world = load_world(name)
    log = simulate(world, seed=seed)
    slam = build_slam(world.config(), log)
    (robot,) = log.robots
    front_end, sensor = slam.state.sources[robot, "camera"], slam.state.channels[robot, "camera"].sensor
    assert isinstance(front_end, FrontEnd)
    places: dict[Id, Array] = {}
    found: dict[Id, dict[int, tuple[Array, float]]] = {}
    for event in log.events:
        report = slam.process(event)
        if not isinstance(event, km.Frame):
            continue
        renderer, T = event.image.args[:2]  # type: ignore[union-attr]
        depth = renderer.render(T)[1]
        assert front_end.observation is not None
        scan = front_end.observation.scan
        R = sensor.noise(report.y) if scan.cov is None else np.asarray(scan.cov)
        for o in report.observations:
            if o.landmark is None or o.outcome not in ("new", "associated"):
                continue
            y = report.y[o.index, :2]
            if o.outcome == "new":
                ray, u = sensor.rays(y[None])[0], np.rint(y).astype(np.int64)
                places[o.landmark] = from_frame_many(T, (ray * (depth[u[1], u[0]] / ray[2]))[None])[0][0]
                found[o.landmark] = {}
            elif o.landmark in places:
                e = sensor.expect(to_frame_many(T, places[o.landmark][None])[0])[0][0]
                z = y - e[:2]
                found[o.landmark][front_end.frame] = z, float(z @ np.linalg.solve(R[o.index, :2, :2], z))
    return found


def correlation(landmarks: list[dict[int, tuple[Array, float]]], lag: int) -> float:
    """Return the correlation of errors with those of the same landmarks so many frames later."""
    pairs = [(z, one[k + lag][0]) for one in landmarks for k, (z, _) in one.items() if k + lag in one]
    a, b = np.array(pairs).transpose(1, 0, 2)
    both = (np.hypot(*a.T) < LOST_PX) & (np.hypot(*b.T) < LOST_PX)
    a, b = a[both], b[both]
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def main(name: str, seeds: int) -> None:
    """Print the row of a world."""
    landmarks = [one for seed in range(seeds) for one in errors(name, seed).values()]
    z = np.array([match[0] for one in landmarks for match in one.values()])
    d2 = np.array([match[1] for one in landmarks for match in one.values()])
    off = np.hypot(*z.T)
    near = off < LOST_PX  # not so where the point is behind the camera, nor of another thing
    rms, middle = np.sqrt(np.mean(off[near] ** 2) / 2), np.median(off[near]) / np.sqrt(2 * np.log(2))
    mean, median = d2[near].mean() / 2, np.median(d2[near]) / (2 * np.log(2))
    print("| world | matches | RMS, px | median | lost | correlation, next | later | chi-square / dof | median |")
    print("|---|---|---|---|---|---|---|---|---|")
    lasts = correlation(landmarks, 1), correlation(landmarks, LATER)
    row = f"| {name} | {near.sum():,} | {rms:.2f} | {middle:.3f} | {100 * np.mean(~near):.2f} % | "
    print(row + f"{lasts[0]:.2f} | {lasts[1]:.2f} | {mean:.2f} | {median:.3f} |")


if __name__ == "__main__":
    with one_thread():
        main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 3)
