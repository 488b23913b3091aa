"""A hall of walls and corners from a raw laser, without ids: is the covariance right, and is any wall mapped twice?

    python benchmarks/walls.py                  # 50 runs of the shipped world hall_of_walls, both estimators
    python benchmarks/walls.py --runs 20 --set steps=1200

A line an estimator: pose ANEES (3 is right), the share of steps in its 95 % band, the position's RMSE, then over all
runs the walls of the maps, those that are on no true wall (`false`), and those that another wall of the same map joins
on the same true wall (`twice`).
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import kalmark as km
from kalmark.arrays import Array
from kalmark.campaign.campaign import figures
from kalmark.campaign.scoring import score
from kalmark.config.building import build_slam
from kalmark.simulate import World, load_world
from kalmark.simulate.robots import simulation

NEAR_M = 0.5  # from a true wall, within which a wall of the map is on it
JOIN_M = km.landmarks.Wall2D().join_m


def judged(slam: km.Slam, world: World) -> tuple[int, int, int]:
    """Return how many walls are in a map, how many of them are on no true wall, and how many are there twice."""
    true = np.array(world.world.walls_m)
    names = [name for name, track in slam.tracks.confirmed.items() if track.model.kind == "wall"]
    placed = [placed_on(slam.segment(name)[0], true) for name in names]
    known = [each for each in placed if each is not None]
    twice = sum(
        any(other[0] == one[0] and max(one[1], other[1]) - min(one[2], other[2]) <= JOIN_M for other in known[:i])
        for i, one in enumerate(known)
    )
    return len(names), len(names) - len(known), twice


def placed_on(ends: Array, true: Array) -> tuple[int, float, float] | None:
    """Return on which of the true walls (S, 4) a segment (2, 2) is, and from where to where; None if on none."""
    best: tuple[float, int, float, float] | None = None
    for k, (a, b) in enumerate(true.reshape(-1, 2, 2)):
        along = (b - a) / np.linalg.norm(b - a)
        off = ends - a
        t, across = np.sort(off @ along), np.abs(off[:, 0] * along[1] - off[:, 1] * along[0])
        shared = min(t[1], np.linalg.norm(b - a)) - max(t[0], 0.0)
        if across.max() < NEAR_M and (best is None or shared > best[0]):
            best = float(shared), k, float(t[0]), float(t[1])
    return best[1:] if best is not None and best[0] > 0.0 else None


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--set", nargs="*", default=[], help="what is different of the world: steps=600")
    options = parser.parse_args()
    estimators: dict[str, dict[str, Any]] = {"invariant": {"type": "invariant"}, "ekf": {"type": "ekf"}}
    print("estimator  pose ANEES  in band  position m  walls  false  twice  NIS")
    for name, estimator in estimators.items():
        world = load_world("hall_of_walls", [*options.set, f"filter.estimator.type={estimator['type']}"])
        scores, counts = [], np.zeros(3, dtype=np.int64)
        for seed in range(options.runs):
            slam = build_slam(world.config())
            scores.append(score(slam, simulation(world, seed), world.times(), 1_000_000))
            counts += judged(slam, world)
        told = figures(scores, 10)
        walls, false, twice = counts.tolist()
        print(
            f"{name:9}  {told['pose_anees']:10.2f}  {100 * told['pose_inside']:5.0f} %  {told['position_rmse_m']:10.3f}"
            f"  {walls:5}  {false:5}  {twice:5}  {told['nis_per_dof']:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
